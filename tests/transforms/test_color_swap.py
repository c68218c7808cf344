from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from crptpro.transforms import ColorSwap


def test_every_frame_of_a_stack_has_its_channels_reversed_and_none_changes_place() -> None:
    stack = torch.arange(2 * 6 * 4 * 5, dtype=torch.uint8).view(2, 6, 4, 5)
    swap = ColorSwap(["pixels"])
    td = swap(TensorDict({"pixels": stack.clone()}, [2]))
    assert td["pixels"].dtype == torch.uint8
    assert torch.equal(td["pixels"], stack[:, [2, 1, 0, 5, 4, 3]])
    assert torch.equal(swap(td)["pixels"], stack)


@pytest.mark.parametrize("shape", [(4, 8, 8), (8, 8)])
def test_what_is_no_rgb_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="RGB"):
        ColorSwap(["pixels"])(TensorDict({"pixels": torch.zeros(shape)}))
