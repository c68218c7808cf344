"""The encoder: shapes, initialisation, and equality of its fast paths with plain convolutions."""

from __future__ import annotations

import json

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from crptpro.modules import PixelEncoder


def small(**options) -> PixelEncoder:
    torch.manual_seed(0)
    return PixelEncoder(3, channels=(8, 8, 8), strides=(2, 1, 1), image_size=21, **options)


def pixels(count: int = 5, channels: int = 3, size: int = 21) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randint(0, 256, (count, channels, size, size), dtype=torch.uint8, generator=generator)


def plain(encoder: PixelEncoder) -> nn.Sequential:
    """The published network: NCHW convolutions and ReLU, holding copies of the encoder's parameters."""
    layers: list[nn.Module] = []
    for conv, stride in zip(encoder.convs, encoder.strides):
        layers += [nn.Conv2d(conv.in_channels, conv.out_channels, 3, stride=stride), nn.ReLU()]
        layers[-2].load_state_dict(conv.state_dict())
    return nn.Sequential(*layers, nn.Flatten())


def test_default_encoder_has_39200_features_and_30368_parameters() -> None:
    encoder = PixelEncoder()
    assert encoder.feature_dim == 39_200
    assert encoder.feature_map_shape == (32, 35, 35)
    assert sum(p.numel() for p in encoder.parameters()) == 30_368
    assert encoder(pixels(2, 9, 84)).shape == (2, 39_200)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_parameter_or_a_pixel_that_is_not_a_number_is_seen_in_the_features(dtype: torch.dtype) -> None:
    encoder = small()
    encoder.compute_dtype = dtype
    images = pixels().float()
    images[0, 0, 0, 0] = float("nan")
    assert encoder(images)[0].isnan().any()
    with torch.no_grad():
        encoder.conv_layers[0].weight.view(-1)[0] = float("nan")
    assert encoder(pixels()).isnan().any(dim=1).all()


@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_float32_features_and_gradients_equal_plain_convolutions(offset: float) -> None:
    encoder = small(pixel_offset=offset)
    encoder.micro_batch = 2  # five images in three chunks
    reference = plain(encoder)
    images = pixels()
    expected = reference(images.float() / 255 - offset)
    features = encoder(images)
    torch.testing.assert_close(features, expected, rtol=0, atol=1e-5)
    weights = torch.randn_like(expected)
    (features * weights).sum().backward()
    (expected * weights).sum().backward()
    for conv, twin in zip(encoder.convs, reference[::2]):
        torch.testing.assert_close(conv.weight.grad, twin.weight.grad, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(conv.bias.grad, twin.bias.grad, rtol=1e-4, atol=1e-4)


def test_full_size_float32_features_equal_plain_convolutions() -> None:
    encoder = PixelEncoder()
    images = pixels(3, 9, 84)
    with torch.no_grad():
        torch.testing.assert_close(encoder(images), plain(encoder)(images / 255), rtol=0, atol=1e-5)


@pytest.mark.parametrize("offset", [0.0, 0.5])
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


def test_bfloat16_input_loses_nothing_of_raw_pixels() -> None:
    values = torch.arange(256)
    assert torch.equal(values.to(torch.bfloat16).long(), values)
    assert torch.equal(((values.to(torch.bfloat16) - 127.5) * 2).long(), 2 * values - 255)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_chunk_length_does_not_change_features(dtype: torch.dtype) -> None:
    encoder = small()
    encoder.compute_dtype = dtype
    whole = encoder(pixels(7))
    encoder.micro_batch = 3
    torch.testing.assert_close(encoder(pixels(7)), whole, rtol=1e-2, atol=1e-5)


def test_features_are_flattened_in_channel_row_column_order() -> None:
    encoder = small()
    images = pixels(2)
    feature_map = encoder.feature_map(images)
    assert feature_map.shape == (2, *encoder.feature_map_shape)
    features = encoder(images).reshape(2, *encoder.feature_map_shape)
    assert torch.equal(features, feature_map)


def test_feature_map_takes_images_of_another_size() -> None:
    assert small().feature_map(pixels(2, size=31)).shape[-1] == 11


def test_leading_dimensions_are_kept_and_an_empty_batch_is_legal() -> None:
    encoder = small()
    images = pixels(6)
    assert torch.equal(encoder(images.reshape(2, 3, 3, 21, 21)), encoder(images).reshape(2, 3, -1))
    assert encoder(images[0]).shape == (encoder.feature_dim,)
    assert encoder(images[:0]).shape == (0, encoder.feature_dim)


def test_float_pixels_equal_uint8_pixels_and_are_not_changed() -> None:
    encoder = small()
    images = pixels().float()
    before = images.clone()
    assert torch.equal(encoder(images), encoder(pixels()))
    assert torch.equal(images, before)


def test_kernels_are_orthogonal_with_gain_sqrt_two_and_biases_zero() -> None:
    for conv in PixelEncoder().convs:
        flat = conv.weight.flatten(1)
        torch.testing.assert_close(flat @ flat.T, 2 * torch.eye(32), rtol=0, atol=1e-4)
        assert not conv.bias.any()
        # Delta-orthogonal kernels would be zero off the centre.
        assert conv.weight[:, :, 0, 0].abs().sum() > 0


def test_same_seed_draws_the_same_encoder_and_another_seed_does_not() -> None:
    torch.manual_seed(3)
    first = PixelEncoder(3, image_size=21).convs[1].weight
    torch.manual_seed(3)
    assert torch.equal(PixelEncoder(3, image_size=21).convs[1].weight, first)
    assert not torch.equal(PixelEncoder(3, image_size=21).convs[1].weight, first)


def test_config_survives_json_and_rebuilds_the_encoder() -> None:
    encoder = small(pixel_offset=0.5)
    twin = PixelEncoder(**json.loads(json.dumps(encoder.config)))
    twin.load_state_dict(encoder.state_dict())
    assert torch.equal(twin(pixels()), encoder(pixels()))


def test_functional_call_uses_the_given_parameters() -> None:
    encoder, other = small(), PixelEncoder(3, channels=(8, 8, 8), strides=(2, 1, 1), image_size=21)
    expected, own = other(pixels()), encoder(pixels())
    with TensorDict.from_module(other).to_module(encoder, preserve_module_state=False):
        assert torch.equal(encoder(pixels()), expected)
    assert torch.equal(encoder(pixels()), own)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_compiled_encoder_equals_eager(dtype: torch.dtype) -> None:
    encoder = small()
    encoder.compute_dtype, encoder.micro_batch = dtype, 3
    compiled = torch.compile(encoder, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(pixels()), encoder(pixels()))


def test_double_parameters_compute_in_double() -> None:
    assert small().double()(pixels()).dtype == torch.float64


def test_atcs_own_strides_give_its_published_sizes() -> None:
    x, sizes = torch.zeros(1, 9, 84, 84), []
    for conv in PixelEncoder(strides=(2, 2, 2, 1)).conv_layers:
        x = conv(x)
        sizes.append(x.shape[-1])
    assert sizes == [41, 20, 9, 7]
    assert PixelEncoder(strides=(2, 2, 2, 1)).feature_map_shape == (32, 7, 7)


def test_wrong_image_shape_is_named() -> None:
    with pytest.raises(ValueError, match=r"\[\*, 3, 21, 21\], got \(2, 3, 20, 20\)"):
        small()(pixels(2, size=20))


def test_impossible_geometry_is_refused() -> None:
    with pytest.raises(ValueError, match="equal length"):
        PixelEncoder(channels=(8, 8), strides=(2,))
    with pytest.raises(ValueError, match="image_size 5 is too small"):
        PixelEncoder(image_size=5)


def relative_error(actual: Tensor, expected: Tensor) -> float:
    return ((actual.float() - expected).norm() / expected.norm().clamp_min(1e-12)).item()
