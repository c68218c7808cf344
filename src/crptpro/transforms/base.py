"""What transforms share: their keys, seen from an environment's step and from a replay batch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.data.tensor_specs import Composite, Unbounded
from torchrl.envs.transforms import Transform

if TYPE_CHECKING:
    from typing import Self

Keys = Any
"""One key, or a sequence of them."""

PIXEL_KEYS: list[NestedKey] = ["pixels", ("next", "pixels")]


def is_next(key: NestedKey) -> bool:
    """Whether a key lies under ``"next"``, where replay batches keep what followed."""
    return isinstance(key, tuple) and key[0] == "next"


def without_next(key: NestedKey) -> NestedKey:
    """Return where an environment's step keeps this entry of a replay batch."""
    return unravel_key(key[1:]) if is_next(key) else unravel_key(key)


def as_key_list(keys: Keys) -> list[NestedKey]:
    """Return a list of keys: as in TorchRL, a string or a tuple of strings is one (nested) key and a list is several.

    Examples:
        >>> as_key_list(("next", "pixels"))
        [('next', 'pixels')]
        >>> as_key_list(("pixels", ("next", "pixels")))
        ['pixels', ('next', 'pixels')]
    """
    is_one = isinstance(keys, str) or (isinstance(keys, tuple) and all(isinstance(k, str) for k in keys))
    return [unravel_key(key) for key in ([keys] if is_one else keys)]


def paired_keys(in_keys: Keys, out_keys: Keys | None) -> tuple[list[NestedKey], list[NestedKey]]:
    """Return both lists of keys; in place if there are no ``out_keys``.

    Raises:
        ValueError: lists of unequal length.
    """
    read = as_key_list(in_keys)
    written = read if out_keys is None else as_key_list(out_keys)
    if len(read) != len(written):
        raise ValueError(f"in_keys {read} and out_keys {written} must pair up.")
    return read, written


def read_entry(transform: Transform, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """Return an entry.

    Raises:
        KeyError: naming what is there instead.
    """
    value = tensordict.get(key, None)
    if value is None:
        present = list(tensordict.keys(True, True))
        raise KeyError(f"{type(transform).__name__} found no {key!r} among {present}; set its keys.")
    return value


class PixelTransform(Transform):
    """Computes one entry from each image entry, in replay batches (``forward``) and in environments.

    Keys under ``"next"`` belong to replay batches: on an environment only root keys count, at each reset and each step.
    A subclass writes ``_apply_transform`` and, where it is not that of the image, :meth:`written_spec`.

    Args:
        in_keys: images; ``"pixels"`` and, where a batch has it, ``("next", "pixels")`` if None. Keys that are named
            must be present.
        out_keys: one key per image; in place if None.

    Raises:
        ValueError: ``in_keys`` and ``out_keys`` of unequal length.
    """

    def __init__(self, in_keys: Keys | None, out_keys: Keys | None) -> None:
        read, written = paired_keys(PIXEL_KEYS if in_keys is None else in_keys, out_keys)
        super().__init__(in_keys=read, out_keys=written)
        self._pairs = list(zip(read, written))
        self._root_pairs = [pair for pair in self._pairs if not is_next(pair[0])]
        self._optional = PIXEL_KEYS[1:] if in_keys is None else []

    def written_spec(self, read: Any) -> Any:
        """Return the spec of what is written for an image of spec ``read``."""
        return read.clone()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Transform every key of a sampled batch; what is stored stays as it is.

        Raises:
            KeyError: a named key is missing.
        """
        return self._apply_to(tensordict, self._pairs)

    def _apply_to(
        self, tensordict: TensorDictBase, pairs: list[tuple[NestedKey, NestedKey]]
    ) -> TensorDictBase:
        for in_key, out_key in pairs:
            if in_key in self._optional and in_key not in tensordict.keys(True):
                continue
            tensordict.set(out_key, self._apply_transform(read_entry(self, tensordict, in_key)))
        return tensordict

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._apply_to(next_tensordict, self._root_pairs)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._apply_to(tensordict_reset, self._root_pairs)

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Register what the root keys write.

        Raises:
            KeyError: the environment has no such observation.
        """
        output_spec = output_spec.clone()
        observations = output_spec["full_observation_spec"]
        for in_key, out_key in self._root_pairs:
            if in_key not in observations.keys(True, True):
                name = type(self).__name__
                raise KeyError(f"{name} found no {in_key!r} in the observations {observations}.")
            observations[out_key] = self.written_spec(observations[in_key])
        return output_spec


class IntrinsicReward(Transform):
    r"""Computes an intrinsic reward from the features of next observations.

    .. math:: r = r_\mathrm{ext} + c \hat r

    A subclass writes ``_intrinsic_reward``. Works on replay batches (``forward``) and on environments, where the batch
    is what one step returns: all of a vectorised environment. A reset is not rewarded.

    Args:
        networks: that are read, by attribute name. They are somebody else's, and no part of the state dictionary.
        coef: :math:`c`; None leaves the reward alone.
        in_keys: one key, features ``[*, D]`` of the next observation.
        out_keys: one key for :math:`\hat r`, of the reward's shape.
        reward_key: :math:`r_\mathrm{ext}`, ``[*, 1]``, which :math:`r` replaces; read where there is a ``coef``.

    Raises:
        ValueError: more than one key.
    """

    def __init__(
        self,
        networks: dict[str, nn.Module | None],
        *,
        coef: float | None = None,
        in_keys: Keys = ("next", "features"),
        out_keys: Keys = ("next", "intrinsic_reward"),
        reward_key: NestedKey = ("next", "reward"),
    ) -> None:
        read, written = paired_keys(in_keys, out_keys)
        if len(read) != 1:
            raise ValueError(f"{type(self).__name__} reads and writes one key each, got {read}.")
        super().__init__(in_keys=read, out_keys=written)
        self.__dict__.update(networks)
        self.coef = coef
        self.reward_key = reward_key

    def _intrinsic_reward(self, features: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Return the reward of each row ``[B, D]`` of the batch before the coefficient, float32 ``[B]``."""
        raise NotImplementedError

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the intrinsic reward of a batch and add it to the reward; stored rewards stay as they are.

        Raises:
            KeyError: features or reward are missing.
        """
        features = read_entry(self, tensordict, self.in_keys[0])
        intrinsic = self._intrinsic_reward(features.reshape(-1, features.shape[-1]), tensordict)
        if self.coef is None:
            tensordict.set(self.out_keys[0], intrinsic.reshape(*features.shape[:-1], 1))
            return tensordict
        reward = read_entry(self, tensordict, self.reward_key)
        intrinsic = intrinsic.to(reward).view_as(reward)
        tensordict.set(self.out_keys[0], intrinsic)
        # A new tensor: the sampled reward may share memory with the storage.
        tensordict.set(self.reward_key, reward + self.coef * intrinsic)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(tensordict.copy().set("next", next_tensordict)).get("next")

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Register the intrinsic reward and the sum, both unbounded.

        Raises:
            KeyError: the environment has no such reward.
        """
        output_spec = output_spec.clone()
        rewards = output_spec["full_reward_spec"]
        spec = Unbounded(shape=(*rewards.shape, 1), dtype=torch.float32, device=rewards.device)
        if self.coef is not None:
            key = without_next(self.reward_key)
            if key not in rewards.keys(True, True):
                raise KeyError(f"{type(self).__name__} found no {key!r} in the rewards {rewards}.")
            spec = Unbounded(shape=rewards[key].shape, dtype=rewards[key].dtype, device=rewards.device)
            rewards[key] = spec.clone()
        rewards[without_next(self.out_keys[0])] = spec
        return output_spec

    def clone(self) -> Self:
        """Return a transform without parent, with a state of its own; networks and generator are shared."""
        copy = super().clone()
        copy._buffers = {name: value.clone() for name, value in self._buffers.items() if value is not None}
        return copy
