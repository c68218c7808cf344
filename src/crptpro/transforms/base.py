"""What transforms share: their keys, seen from an environment's step and from a replay batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.data.tensor_specs import Composite, Unbounded
from torchrl.envs.transforms import Transform

if TYPE_CHECKING:
    from typing import Self

KeyPair = tuple[NestedKey, NestedKey]

PIXEL_KEYS: list[NestedKey] = ["pixels", ("next", "pixels")]


def is_next(key: NestedKey) -> bool:
    """Whether a key lies under ``"next"``, where replay batches keep what followed."""
    return isinstance(key, tuple) and key[0] == "next"


def with_next(key: NestedKey) -> NestedKey:
    """Return where a replay batch keeps this entry of an environment's step."""
    return key if is_next(key) else unravel_key(("next", key))


def without_next(key: NestedKey) -> NestedKey:
    """Return where an environment's step keeps this entry of a replay batch."""
    return unravel_key(key[1:]) if is_next(key) else unravel_key(key)


def as_key_list(keys: NestedKey | Sequence[NestedKey]) -> list[NestedKey]:
    """Return a list of keys.

    As in TorchRL, a string or a tuple of strings is one (nested) key and a list is several. A tuple that
    holds tuples can only be meant as several.

    Examples:
        >>> as_key_list(("next", "pixels"))
        [('next', 'pixels')]
        >>> as_key_list(("pixels", ("next", "pixels")))
        ['pixels', ('next', 'pixels')]
    """
    is_one = isinstance(keys, str) or (isinstance(keys, tuple) and all(isinstance(k, str) for k in keys))
    return [unravel_key(key) for key in ([keys] if is_one else keys)]


class PixelTransform(Transform):
    """Computes one entry from each image entry, in replay batches (``forward``) and in environments.

    Keys under ``"next"`` belong to replay batches: on an environment only root keys count, at each reset and each step,
    because what they name there is the root entry of the next step. A subclass writes ``_apply_transform`` and
    :meth:`written_spec`.

    Args:
        in_keys: images; ``"pixels"`` and, where a batch has it, ``("next", "pixels")`` if None. Keys that are named
            must be present.
        out_keys: one key per image; in place if None.

    Raises:
        ValueError: ``in_keys`` and ``out_keys`` of unequal length.
    """

    def __init__(
        self,
        in_keys: NestedKey | Sequence[NestedKey] | None,
        out_keys: NestedKey | Sequence[NestedKey] | None,
    ) -> None:
        read = PIXEL_KEYS if in_keys is None else as_key_list(in_keys)
        written = read if out_keys is None else as_key_list(out_keys)
        if len(read) != len(written):
            raise ValueError(f"in_keys {read} and out_keys {written} must pair up.")
        super().__init__(in_keys=read, out_keys=written)
        self._pairs: list[KeyPair] = list(zip(read, written))
        self._optional = PIXEL_KEYS[1:] if in_keys is None else []

    def written_spec(self, read: Any) -> Any:
        """Return the spec of what is written for an image of spec ``read``."""
        return read.clone()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Transform every key of a sampled batch.

        As TorchRL's transforms do, this sets new tensors in the very tensordict it is given. A buffer's
        ``sample()`` and ``buffer[indices]`` hand over a fresh one, so what is stored stays as it is.

        Raises:
            KeyError: a named key is missing.
        """
        return self._apply_to(tensordict, self._pairs)

    def _apply_to(self, tensordict: TensorDictBase, pairs: list[KeyPair]) -> TensorDictBase:
        for in_key, out_key in pairs:
            pixels = tensordict.get(in_key, None)
            if pixels is not None:
                tensordict.set(out_key, self._apply_transform(pixels))
            elif in_key not in self._optional and not self.missing_tolerance:
                present = list(tensordict.keys(True, True))
                raise KeyError(f"{type(self).__name__} found no {in_key!r} among {present}; set in_keys.")
        return tensordict

    def _root_pairs(self) -> list[KeyPair]:
        return [pair for pair in self._pairs if not is_next(pair[0])]

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._apply_to(next_tensordict, self._root_pairs())

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._apply_to(tensordict_reset, self._root_pairs())

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Register what the root keys write.

        Raises:
            KeyError: the environment has no such observation.
        """
        for in_key, out_key in self._root_pairs():
            if in_key not in observation_spec.keys(True, True):
                name = type(self).__name__
                raise KeyError(f"{name} found no {in_key!r} in the observations {observation_spec}.")
            observation_spec[out_key] = self.written_spec(observation_spec[in_key])
        return observation_spec

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Register new root keys; keys under ``"next"`` belong to replay batches and are not an env's."""
        output_spec = output_spec.clone()
        observation_spec = output_spec["full_observation_spec"]
        output_spec["full_observation_spec"] = self.transform_observation_spec(observation_spec)
        return output_spec


class IntrinsicReward(Transform):
    r"""Computes an intrinsic reward from the features of next observations.

    .. math:: r = r_\mathrm{ext} + c \hat r

    A subclass writes ``_intrinsic_reward``. Works on replay batches (``forward``, keys under ``"next"``) and on
    environments, where the batch is what one step returns: all of a vectorised environment, one sample of a
    single one. A reset is not rewarded. Nothing depends on training mode.

    In an environment's step the entries are those without the leading ``"next"``; it may be left out of the keys.

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
        coef: float | None,
        in_keys: NestedKey | Sequence[NestedKey],
        out_keys: NestedKey | Sequence[NestedKey],
        reward_key: NestedKey,
    ) -> None:
        read, written = as_key_list(in_keys), as_key_list(out_keys)
        if len(read) != 1 or len(written) != 1:
            raise ValueError(
                f"{type(self).__name__} reads and writes one key each, got {read} and {written}."
            )
        super().__init__(in_keys=[without_next(read[0])], out_keys=[without_next(written[0])])
        self._networks = tuple(networks)
        self.__dict__.update(networks)
        self.coef = coef
        self.reward_key = without_next(reward_key)

    def _intrinsic_reward(self, features: Tensor, root: TensorDictBase) -> Tensor:
        """Return the reward of each row before the coefficient, float32 ``[B]``, without gradient.

        Args:
            features: ``[B, D]``, of next observations.
            root: of the same rows, what was there before the step; its batch may have more dimensions.
        """
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the intrinsic reward of a sampled batch, under ``"next"``, and add it to the reward.

        As TorchRL's transforms do, this sets new tensors in the very tensordict it is given. A buffer's
        ``sample()`` and ``buffer[indices]`` hand over a fresh one, so stored rewards stay as they are.

        Raises:
            KeyError: features or reward are missing.
        """
        return self._add(tensordict, tensordict, with_next)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._add(tensordict, next_tensordict, without_next)

    @torch.no_grad()
    def _add(
        self, root: TensorDictBase, tensordict: TensorDictBase, place: Callable[[NestedKey], NestedKey]
    ) -> TensorDictBase:
        features = self._read(tensordict, place(self.in_keys[0]))
        intrinsic = self._intrinsic_reward(features.reshape(-1, features.shape[-1]), root)
        if self.coef is None:
            tensordict.set(place(self.out_keys[0]), intrinsic.reshape(*features.shape[:-1], 1))
            return tensordict
        reward = self._read(tensordict, place(self.reward_key))
        intrinsic = intrinsic.to(reward).view_as(reward)
        tensordict.set(place(self.out_keys[0]), intrinsic)
        # A new tensor: the sampled reward may share memory with the storage.
        tensordict.set(place(self.reward_key), reward + self.coef * intrinsic)
        return tensordict

    def _read(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        value = tensordict.get(key, None)
        if value is None:
            present = list(tensordict.keys(True, True))
            name = type(self).__name__
            raise KeyError(f"{name} found no {key!r} among {present}; set in_keys or reward_key.")
        return value

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Register the intrinsic reward and the sum, both unbounded.

        Raises:
            KeyError: the environment has no such reward.
        """
        shape, dtype, device = (*reward_spec.shape, 1), torch.float32, reward_spec.device
        if self.coef is not None:
            if self.reward_key not in reward_spec.keys(True, True):
                name = type(self).__name__
                raise KeyError(f"{name} found no {self.reward_key!r} in the rewards {reward_spec}.")
            external = reward_spec[self.reward_key]
            shape, dtype, device = external.shape, external.dtype, external.device
            reward_spec[self.reward_key] = Unbounded(shape=shape, dtype=dtype, device=device)
        reward_spec[self.out_keys[0]] = Unbounded(shape=shape, dtype=dtype, device=device)
        return reward_spec

    def clone(self) -> Self:
        """Return a transform without parent, with a state of its own; networks and generator are shared."""
        copy = super().clone()
        copy._buffers = {name: value.clone() for name, value in self._buffers.items() if value is not None}
        return copy

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        # The networks are hidden from nn.Module, but go where the transform goes.
        for name in self._networks:
            network = getattr(self, name)
            if network is not None:
                network._apply(fn)
        return super()._apply(fn, recurse)
