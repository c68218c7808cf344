from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from crptpro.transforms import ColorSwap
from crptpro.transforms.color_swap import swap_colors


def test_every_frame_of_a_stack_has_its_channels_reversed_and_none_changes_place() -> None:
    stack = torch.arange(2 * 6 * 4 * 5, dtype=torch.uint8).view(2, 6, 4, 5)
    swapped = swap_colors(stack)
    assert swapped.dtype == torch.uint8
    for channel, source in enumerate([2, 1, 0, 5, 4, 3]):
        assert torch.equal(swapped[:, channel], stack[:, source])
    assert torch.equal(swap_colors(swapped), stack)


@pytest.mark.parametrize("shape", [(4, 8, 8), (8, 8)])
def test_what_is_no_rgb_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="RGB"):
        swap_colors(torch.zeros(shape))


def test_a_batch_that_lacks_a_key_keeps_what_it_has() -> None:
    pixels = torch.arange(3, dtype=torch.uint8).view(1, 3, 1, 1)
    swapped = ColorSwap()(TensorDict({"pixels": pixels.clone()}, batch_size=[1]))
    assert swapped["pixels"].flatten().tolist() == [2, 1, 0]


def test_keys_must_pair_up() -> None:
    with pytest.raises(ValueError, match="pair"):
        ColorSwap(in_keys=["pixels"], out_keys=["a", "b"])


def test_a_named_key_that_a_batch_lacks_is_an_error() -> None:
    with pytest.raises(KeyError, match="found no 'pixel' among"):
        ColorSwap(in_keys=["pixel"])(TensorDict({"pixels": torch.zeros(1, 3, 2, 2)}, batch_size=[1]))
