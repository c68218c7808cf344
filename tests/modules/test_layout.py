"""Choosing and setting the memory layout of the convolutions."""

from __future__ import annotations

import pytest
import torch

from crptpro.modules import (
    PixelEncoder,
    computing,
    is_channels_last,
    resolve_channels_last,
    set_channels_last,
)
from crptpro.objectives import ProtoLoss

SIZES = {"channels": (4, 4), "strides": (2, 1), "image_size": 16}


def test_auto_puts_channels_last() -> None:
    assert resolve_channels_last("auto")
    assert resolve_channels_last("on")
    assert not resolve_channels_last("off")
    with pytest.raises(ValueError, match="`channels_last` must be 'auto', 'on' or 'off', got 'never'"):
        resolve_channels_last("never")  # type: ignore[arg-type]


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_both_layouts_give_the_same_features_and_gradients_up_to_rounding(dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    last = PixelEncoder(3, **SIZES)
    usual = PixelEncoder(3, **SIZES)
    usual.load_state_dict(last.state_dict())
    set_channels_last(usual, False)
    pixels = torch.randint(0, 256, (70, 3, 16, 16), dtype=torch.uint8)  # more than one chunk
    outputs = []
    for encoder in (last, usual):
        encoder.compute_dtype = dtype
        features = encoder(pixels)
        features.float().square().mean().backward()
        outputs.append([features, *(parameter.grad for parameter in encoder.parameters())])
    tolerance = 1e-5 if dtype == torch.float32 else 2e-2
    for one, two in zip(*outputs):
        torch.testing.assert_close(one, two, rtol=tolerance, atol=tolerance * two.abs().max().item())


@pytest.mark.parametrize("channels_last", [True, False])
def test_maps_lie_in_memory_as_the_switch_says(channels_last: bool) -> None:
    encoder = set_channels_last(PixelEncoder(3, **SIZES), channels_last)
    maps = encoder.feature_map(torch.zeros(2, 3, 16, 16, dtype=torch.uint8))
    assert maps.is_contiguous(memory_format=torch.channels_last) is channels_last
    assert maps.is_contiguous() is not channels_last


def test_networks_that_a_loss_hides_are_reached() -> None:
    loss = ProtoLoss(PixelEncoder(3, **SIZES), latent_dim=8, hidden_dim=16, num_prototypes=4)
    set_channels_last(loss, False)
    assert not loss.encoder.channels_last
    assert not is_channels_last(loss)
    encoders = [module for module in vars(loss).values() if isinstance(module, PixelEncoder)]
    assert not any(encoder.channels_last for encoder in encoders)
    assert is_channels_last(set_channels_last(loss, True))


def test_computing_ends_with_fp32_and_channels_last_whatever_happened_inside() -> None:
    encoder = PixelEncoder(3, **SIZES)

    def break_off() -> None:
        with computing(encoder, torch.bfloat16, channels_last=False):
            assert (encoder.compute_dtype, encoder.channels_last) == (torch.bfloat16, False)
            raise RuntimeError("inside")

    with pytest.raises(RuntimeError, match="inside"):
        break_off()
    assert (encoder.compute_dtype, encoder.channels_last) == (torch.float32, True)
