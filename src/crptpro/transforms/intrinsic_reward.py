"""What all intrinsic rewards share: where they read and write, on replay batches and on environments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.tensor_specs import Composite, Unbounded
from torchrl.envs.transforms import Transform

from crptpro.transforms.keys import as_key_list, with_next, without_next

if TYPE_CHECKING:
    from typing import Self


class IntrinsicReward(Transform):
    r"""Add a bonus computed from the features of next observations to the reward.

    .. math:: r = r_\mathrm{ext} + \beta \hat r

    A subclass writes :meth:`_bonus`. Works on replay batches (``forward``, keys under ``"next"``) and on
    environments, where the batch is what one step returns: all of a vectorised environment, one sample of a
    single one. A reset is not rewarded. Nothing depends on training mode.

    Keys name entries of an environment's step; in replay batches they are read and written under
    ``"next"``. A leading ``"next"`` in a key is therefore ignored.

    Args:
        intrinsic_reward_coef: :math:`\beta`.
        in_keys: one key, features ``[*, feature_dim]`` of the next observation.
        out_keys: one key for :math:`\hat r`, of the reward's shape.
        reward_key: :math:`r_\mathrm{ext}`, ``[*, 1]``; None writes :math:`\hat r` only.
        out_reward_key: where :math:`r_\mathrm{ext} + \beta \hat r` goes; ``reward_key`` when None.

    Raises:
        ValueError: more than one key.
    """

    own_state: ClassVar[tuple[str, ...]] = ()
    """Names of the buffers that a clone does not share with its original."""

    def __init__(
        self,
        *,
        intrinsic_reward_coef: float,
        in_keys: NestedKey | Sequence[NestedKey],
        out_keys: NestedKey | Sequence[NestedKey],
        reward_key: NestedKey | None,
        out_reward_key: NestedKey | None,
    ) -> None:
        in_keys, out_keys = as_key_list(in_keys), as_key_list(out_keys)
        if len(in_keys) != 1 or len(out_keys) != 1:
            name = type(self).__name__
            raise ValueError(f"{name} reads and writes one key each, got {in_keys} and {out_keys}.")
        super().__init__(
            in_keys=[without_next(k) for k in in_keys], out_keys=[without_next(k) for k in out_keys]
        )
        self.intrinsic_reward_coef = intrinsic_reward_coef
        self.reward_key = None if reward_key is None else without_next(reward_key)
        self.out_reward_key = self.reward_key if out_reward_key is None else without_next(out_reward_key)

    def _bonus(self, features: Tensor, root: TensorDictBase) -> Tensor:
        """Return the bonus of each row before the coefficient, without gradient.

        Args:
            features: ``[B, feature_dim]``, of next observations.
            root: of the same elements, what was there before the step; its batch may have more dimensions.

        Returns:
            float32 ``[B]``.
        """
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add the bonus to a sampled batch, under ``"next"``.

        As TorchRL's transforms do, this sets new tensors in the very tensordict it is given. A buffer's
        ``sample()`` and ``buffer[indices]`` hand over a fresh one, so stored rewards stay as they are. Only
        ``buffer[:]`` on a full tensor storage hands over the storage itself, whose rewards are then replaced.

        Raises:
            KeyError: features or reward are missing.
        """
        return self._add_bonus(tensordict, tensordict, with_next)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._add_bonus(tensordict, next_tensordict, without_next)

    def _add_bonus(
        self, root: TensorDictBase, tensordict: TensorDictBase, place: Callable[[NestedKey], NestedKey]
    ) -> TensorDictBase:
        in_key, out_key = place(self.in_keys[0]), place(self.out_keys[0])
        features = self._read(tensordict, in_key)
        reward = None if self.reward_key is None else self._read(tensordict, place(self.reward_key))
        bonus = self._bonus(features.reshape(-1, features.shape[-1]), root)
        bonus = bonus.reshape(*features.shape[:-1], 1) if reward is None else bonus.to(reward).view_as(reward)
        tensordict.set(out_key, bonus)
        if reward is not None:
            # A new tensor: the sampled reward may share memory with the storage.
            tensordict.set(place(self.out_reward_key), reward + self.intrinsic_reward_coef * bonus)
        return tensordict

    def _read(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        value = tensordict.get(key, None)
        if value is None:
            present = list(tensordict.keys(True, True))
            name = type(self).__name__
            raise KeyError(f"{name} found no {key!r} among {present}; set in_keys or reward_key.")
        return value

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Register the bonus and the total, both unbounded.

        Raises:
            KeyError: the environment has no such reward.
        """
        if self.reward_key is not None and self.reward_key not in reward_spec.keys(True, True):
            name = type(self).__name__
            raise KeyError(f"{name} found no {self.reward_key!r} in the rewards {reward_spec}.")
        if self.reward_key is None:
            shape, dtype, device = (*reward_spec.shape, 1), torch.float32, reward_spec.device
        else:
            external = reward_spec[self.reward_key]
            shape, dtype, device = external.shape, external.dtype, external.device
        reward_spec[self.out_keys[0]] = Unbounded(shape=shape, dtype=dtype, device=device)
        if self.out_reward_key is not None:
            reward_spec[self.out_reward_key] = Unbounded(shape=shape, dtype=dtype, device=device)
        return reward_spec

    def clone(self) -> Self:
        """Return a transform without parent, with a state of its own; networks and generator are shared."""
        copy = super().clone()
        for name in self.own_state:
            copy._buffers[name] = getattr(self, name).clone()
        return copy
