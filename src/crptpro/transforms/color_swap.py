"""Images with their colour channels in reverse order."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.tensor_specs import Composite
from torchrl.envs.transforms import Transform

from crptpro.transforms.keys import as_key_list
from crptpro.transforms.root_keys import KeyPair, OnRootKeys

CHANNELS = 3


def swap_colors(pixels: Tensor) -> Tensor:
    """Reverse the channel order, RGB to BGR, of every frame of a stack; twice gives the images back.

    Args:
        pixels: ``[*, 3 k, H, W]`` of k frames, any dtype.

    Returns:
        The same shape and dtype; a copy.

    Raises:
        ValueError: if the channels are no whole number of RGB frames.

    Examples:
        >>> import torch
        >>> swap_colors(torch.tensor([1, 2, 3, 4, 5, 6]).view(6, 1, 1)).flatten().tolist()
        [3, 2, 1, 6, 5, 4]
    """
    if pixels.ndim < 3 or pixels.shape[-3] % CHANNELS:
        raise ValueError(f"swap_colors expects RGB frames [*, 3 k, H, W], got {tuple(pixels.shape)}.")
    return pixels.unflatten(-3, (-1, CHANNELS)).flip(-3).flatten(-4, -3)


class ColorSwap(OnRootKeys, Transform):
    """Reverses the channel order of whole images: the simplest reading of the paper's unseen colours.

    Everything changes its colour with it, the robot too; ``make_env(..., colors="reversed_background")`` changes the
    background alone. Works on RGB frames and on stacks of them, in environments and on replay batches.

    Args:
        in_keys: Images ``[*, 3 k, H, W]``; ``pixels`` and ``("next", "pixels")`` if None.
        out_keys: Where they go; in place if None.

    Raises:
        ValueError: ``out_keys`` that do not pair with ``in_keys``.
    """

    def __init__(
        self,
        in_keys: NestedKey | Sequence[NestedKey] | None = None,
        out_keys: NestedKey | Sequence[NestedKey] | None = None,
    ) -> None:
        read = ["pixels", ("next", "pixels")] if in_keys is None else as_key_list(in_keys)
        written = read if out_keys is None else as_key_list(out_keys)
        if len(read) != len(written):
            raise ValueError(f"in_keys {read} and out_keys {written} must pair up.")
        super().__init__(in_keys=read, out_keys=written)
        self._pairs: list[KeyPair] = list(zip(read, written))
        self._may_lack = in_keys is None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Swap the keys of a batch; of the default ones, those that it has.

        Raises:
            KeyError: a named key is missing.
        """
        held = tensordict.keys(True)
        pairs = [pair for pair in self._pairs if pair[0] in held]
        if not self._may_lack and len(pairs) < len(self._pairs):
            lacking = [read for read, _ in self._pairs if read not in held]
            raise KeyError(f"ColorSwap found no {lacking[0]!r} among {list(tensordict.keys(True, True))}.")
        return self._apply_to(tensordict, pairs)

    def _apply_to(self, tensordict: TensorDictBase, pairs: list[KeyPair]) -> TensorDictBase:
        for read, written in pairs:
            tensordict.set(written, swap_colors(tensordict.get(read)))
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Register what is written, images of the same form."""
        observation_spec = observation_spec.clone()
        for read, written in self._root_pairs():
            observation_spec[written] = observation_spec[read].clone()
        return observation_spec
