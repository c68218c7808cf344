"""The encoder: shapes, initialisation, what it is shown, and equality of its fast paths with plain convolutions."""

from __future__ import annotations

import copy
import json
import logging

import pytest
import torch
from torch import Tensor, nn

from crptpro.modules import PixelEncoder

each_dtype = pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
each_offset = pytest.mark.parametrize("offset", [0.0, 0.5])


def small(dtype: torch.dtype = torch.float32, **options) -> PixelEncoder:
    torch.manual_seed(0)
    encoder = PixelEncoder(3, **{"channels": (8, 8, 8), "strides": (2, 1, 1), "image_size": 21, **options})
    encoder.compute_dtype = dtype
    return encoder


def pixels(count: int = 5, channels: int = 3, size: int = 21) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randint(0, 256, (count, channels, size, size), dtype=torch.uint8, generator=generator)


def plain(encoder: PixelEncoder) -> nn.Sequential:
    """The published network: NCHW convolutions and ReLU, holding copies of the encoder's parameters."""
    layers: list[nn.Module] = []
    for conv in encoder.convs:
        layers += [copy.deepcopy(conv), nn.ReLU()]
    return nn.Sequential(*layers, nn.Flatten())


def relative_error(actual: Tensor, expected: Tensor) -> float:
    return ((actual.float() - expected).norm() / expected.norm().clamp_min(1e-12)).item()


def test_default_encoder_is_the_papers() -> None:
    encoder = PixelEncoder()
    assert encoder.feature_dim == 39_200
    assert encoder.feature_map_shape == (32, 35, 35)
    assert sum(p.numel() for p in encoder.parameters()) == 30_368
    images = pixels(2, 9, 84)
    with torch.no_grad():
        torch.testing.assert_close(encoder(images), plain(encoder)(images / 255), rtol=0, atol=1e-5)
    for conv in encoder.convs:
        flat = conv.weight.flatten(1)
        torch.testing.assert_close(flat @ flat.T, 2 * torch.eye(32), rtol=0, atol=1e-4)
        assert not conv.bias.any()
        # Delta-orthogonal kernels would be zero off the centre.
        assert conv.weight[:, :, 0, 0].abs().sum() > 0


@each_offset
def test_float32_features_and_gradients_equal_plain_convolutions(offset: float) -> None:
    encoder = small(pixel_offset=offset)
    encoder.micro_batch = 2  # five images in three chunks
    reference = plain(encoder)
    expected = reference(pixels().float() / 255 - offset)
    features = encoder(pixels())
    torch.testing.assert_close(features, expected, rtol=0, atol=1e-5)
    weights = torch.randn_like(expected)
    (features * weights).sum().backward()
    (expected * weights).sum().backward()
    for ours, theirs in zip(encoder.parameters(), reference.parameters(), strict=True):
        torch.testing.assert_close(ours.grad, theirs.grad, rtol=1e-4, atol=1e-4)


@each_offset
def test_bfloat16_features_are_within_two_percent_and_gradients_within_five(offset: float) -> None:
    encoder = small(pixel_offset=offset)
    images = pixels(16)
    reference = encoder(images)
    # Positive: with random signs the sums cancel, and flipped ReLUs dominate what is left.
    weights = torch.rand_like(reference)
    (reference * weights).sum().backward()
    expected = [p.grad.clone() for p in encoder.parameters()]
    encoder.zero_grad()
    encoder.compute_dtype = torch.bfloat16
    features = encoder(images)
    assert features.dtype == torch.bfloat16
    assert relative_error(features, reference) < 0.02
    (features.float() * weights).sum().backward()
    for parameter, gradient in zip(encoder.parameters(), expected):
        assert parameter.dtype == parameter.grad.dtype == torch.float32
        assert relative_error(parameter.grad, gradient) < 0.05


@each_dtype
def test_chunks_change_rounding_only_and_compiled_equals_eager(dtype: torch.dtype) -> None:
    encoder = small(dtype)
    whole = encoder(pixels(7))
    encoder.micro_batch = 3
    torch.testing.assert_close(encoder(pixels(7)), whole, rtol=1e-2, atol=1e-5)
    compiled = torch.compile(encoder, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(pixels(7)), whole, rtol=1e-2, atol=1e-5)


def test_features_are_flattened_maps_of_any_size_and_leading_dimensions_are_kept() -> None:
    encoder, images = small(), pixels(6)
    features = encoder(images)
    assert torch.equal(features.reshape(6, *encoder.feature_map_shape), encoder.feature_map(images))
    assert encoder.feature_map(pixels(2, size=31)).shape[-1] == 11
    assert torch.equal(encoder(images.reshape(2, 3, 3, 21, 21)), features.reshape(2, 3, -1))
    assert encoder(images[0]).shape == (encoder.feature_dim,)
    assert small().double()(images).dtype == torch.float64
    for nothing in (images[:0], images[:0].float()):
        assert encoder(nothing).shape == (0, encoder.feature_dim)


@each_dtype
@each_offset
def test_floating_pixels_in_the_unit_interval_are_never_scaled_twice_and_that_is_said_once(
    caplog: pytest.LogCaptureFixture, dtype: torch.dtype, offset: float
) -> None:
    encoder = small(dtype, pixel_offset=offset)
    scaled = pixels().float().div(255)
    with caplog.at_level(logging.WARNING):
        found = encoder(scaled)
        encoder(scaled)
    assert [record.message for record in caplog.records] == [
        "PixelEncoder is given float32 pixels in [0, 1]; they are taken as divided by 255 already."
    ]
    atol = 1e-5 if dtype == torch.float32 else 2e-2
    torch.testing.assert_close(found, encoder(pixels()), rtol=2e-2, atol=atol)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: PixelEncoder(3, image_size=21.5), r"`image_size` must be a whole number, got 21\.5"),
        (lambda: PixelEncoder(3, channels=(8, 8), strides=(2,)), "sequences of one length"),
        (lambda: PixelEncoder(3, channels=8), "sequences of one length"),
        (lambda: PixelEncoder(3, image_size=5), "image_size 5 is too small"),
        (lambda: small().standardise(torch.zeros(3), torch.ones(3)), "one per feature"),
        (lambda: small().standardise(torch.full((288,), torch.nan), torch.ones(288)), "`mean` must hold 288 finite"),
        (lambda: small().standardise(torch.zeros(288), torch.zeros(288)), "`scale` must be positive"),
        (lambda: small()(255.0 * torch.ones(1, 3, 21, 21)), r"values from 255 to 255; pass 0..255 as uint8"),
        (lambda: small()(-0.1 * torch.ones(1, 3, 21, 21)), r"in \[0, 1\], got values from -0.1"),
        (lambda: small()(torch.nan * torch.ones(1, 3, 21, 21)), "nan"),
        (lambda: small()(torch.zeros(1, 3, 21, 21, dtype=torch.int64)), "int64"),
        (lambda: small()(torch.zeros(1, 3, 21, 21, dtype=torch.uint16)), "uint16"),
        (lambda: small()(pixels(2, size=20)), r"\[\*, 3, 21, 21\], got \(2, 3, 20, 20\)"),
    ],
)
def test_sizes_standardisations_and_images_that_cannot_be_are_refused_by_name(act, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        act()


@each_dtype
def test_a_standardised_encoder_gives_features_of_mean_zero_and_deviation_one(dtype: torch.dtype) -> None:
    encoder = small()
    raw = encoder(pixels(64)).detach()
    mean, scale = raw.mean(0), raw.std(0).clamp_min(0.1)
    encoder.compute_dtype = dtype
    assert encoder.standardise(mean, scale) is encoder
    features = encoder(pixels(64))
    assert features.dtype == dtype
    atol = 1e-4 if dtype == torch.float32 else 0.2
    torch.testing.assert_close(features.float(), (raw - mean) / scale, rtol=0, atol=atol)
    twin = PixelEncoder(**json.loads(json.dumps(encoder.config)))
    twin.load_state_dict(encoder.state_dict())
    twin.compute_dtype = dtype
    assert torch.equal(twin(pixels()), encoder(pixels()))
    assert torch.equal(copy.deepcopy(encoder)(pixels()), encoder(pixels()))


@pytest.mark.parametrize("scale", [None, 255])
def test_gradients_per_sample_by_functional_transforms_equal_those_one_by_one(scale: int | None) -> None:
    encoder, images = small(), pixels(3) if scale is None else pixels(3) / scale
    parameters = dict(encoder.named_parameters())

    def loss(values: dict[str, Tensor], image: Tensor) -> Tensor:
        return torch.func.functional_call(encoder, values, (image,)).square().sum()

    found = torch.func.vmap(torch.func.grad(loss), (None, 0))(parameters, images)
    for index, image in enumerate(images):
        expected = torch.autograd.grad(loss(parameters, image), list(parameters.values()))
        for gradient, one in zip(found.values(), expected, strict=True):
            torch.testing.assert_close(gradient[index], one, rtol=1e-3, atol=1e-4)
