from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict

from crptpro.transforms import RandomShift, draw_offsets, random_shift


def pad_then_slice(pixels, offsets, pad):
    padded = F.pad(pixels.double(), (pad,) * 4, mode="replicate").to(pixels.dtype)
    height, width = pixels.shape[-2:]
    crops = [padded[i, :, r : r + height, c : c + width] for i, (r, c) in enumerate(offsets.tolist())]
    return torch.stack(crops)


@pytest.mark.parametrize(("dtype", "needs_gradient"), [
    (torch.uint8, False), (torch.float32, False), (torch.float32, True), (torch.bfloat16, False), (torch.bfloat16, True)
])  # fmt: skip
@pytest.mark.parametrize(("pad", "size"), [(4, (11, 14)), (1, (11, 14)), (0, (11, 14)), (4, (3, 2))])
def test_every_shift_equals_replicate_padding_and_slicing(dtype, needs_gradient, pad, size):
    side = torch.arange(2 * pad + 1)
    offsets = torch.cartesian_prod(side, side)
    pixels = torch.randint(0, 256, (len(offsets), 3, *size)).to(dtype)
    before = pixels.clone()
    shifted = random_shift(pixels.clone().requires_grad_() if needs_gradient else pixels, offsets, pad=pad).detach()
    assert shifted.dtype == dtype
    assert torch.equal(shifted, pad_then_slice(pixels, offsets, pad))
    shifted.fill_(9)  # shares no memory with the input
    assert torch.equal(pixels, before)


def test_non_contiguous_and_empty_batches_are_shifted():
    pixels = torch.randint(0, 256, (10, 12, 12, 3), dtype=torch.uint8).permute(0, 3, 1, 2)[::2]
    offsets = draw_offsets(5, 4)
    assert torch.equal(random_shift(pixels, offsets), pad_then_slice(pixels, offsets, 4))
    assert random_shift(pixels[:0], offsets[:0]).shape == (0, 3, 12, 12)


def test_gradients_flow_back_to_the_pixels_that_stayed_in_view():
    pixels = torch.rand(1, 1, 4, 4, requires_grad=True)
    random_shift(pixels, torch.tensor([[0, 1]]), pad=1).sum().backward()
    # Moved down by one row: the first row shows twice and the last not at all.
    assert torch.equal(pixels.grad[0, 0].sum(1), torch.tensor([8.0, 4.0, 4.0, 0.0]))


def test_offsets_are_uniform_over_all_81_shifts():
    draws = 81 * 400
    offsets = draw_offsets(draws, 4, torch.Generator().manual_seed(0))
    counts = torch.bincount(offsets[:, 0] * 9 + offsets[:, 1], minlength=81).double()
    chi_square = ((counts - 400) ** 2 / 400).sum()
    assert 45 < chi_square < 130  # 80 degrees of freedom: 0.1 % on either side


def test_it_compiles_as_a_whole_with_and_without_a_gradient():
    compiled = torch.compile(random_shift, fullgraph=True, backend="eager")
    offsets = draw_offsets(3, 4)
    for pixels in (torch.rand(3, 2, 8, 8), torch.rand(3, 2, 8, 8, requires_grad=True)):
        assert torch.equal(compiled(pixels, offsets), random_shift(pixels, offsets))


@pytest.mark.parametrize(
    ("act", "named"),
    [
        (lambda: random_shift(torch.zeros(1, 1, 8, 8), torch.tensor([[9, 0]])), r"0\.\.8"),
        (lambda: random_shift(torch.zeros(1, 1, 8, 8).requires_grad_(), torch.tensor([[0, -1]])), r"0\.\.8"),
        (lambda: random_shift(torch.zeros(2, 1, 8, 8), torch.zeros(3, 2, dtype=torch.int64)), "offsets"),
        (lambda: RandomShift(["pixels"], pad=-1), "pad"),
        (lambda: RandomShift(in_keys=["a", "b"], out_keys=["c"]), "pair up"),
    ],
)
def test_offsets_shapes_and_keys_that_do_not_fit_are_refused(act, named):
    with pytest.raises(ValueError, match=named):
        act()


def test_keys_and_samples_draw_independent_shifts_from_the_generator_in_order():
    same = torch.randint(0, 256, (1, 9, 12, 12), dtype=torch.uint8).expand(64, 9, 12, 12)
    td = TensorDict({"pixels": same.clone(), "next": {"pixels": same.clone()}}, [64])
    RandomShift(["pixels", ("next", "pixels")], generator=torch.Generator().manual_seed(7))(td)
    draws = torch.Generator().manual_seed(7)
    for key in ("pixels", ("next", "pixels")):
        assert torch.equal(td[key], random_shift(same, draw_offsets(64, 4, draws)))
    assert len(td["pixels"].flatten(1).unique(dim=0)) > 30


def test_a_missing_image_is_named():
    with pytest.raises(KeyError, match="next"):
        RandomShift(["pixels", ("next", "pixels")])(TensorDict(pixels=torch.zeros(2, 3, 8, 8)))
