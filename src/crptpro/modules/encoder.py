"""The convolutional encoder that every method pre-trains and every downstream agent freezes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from crptpro.modules.chunks import apply_to_chunks
from crptpro.modules.convolutions import conv_relu_stack
from crptpro.modules.initialisation import WeightInit, init_weights_, require_weight_init

KERNEL_SIZE = 3


class PixelEncoder(nn.Module):
    r"""Four un-padded 3x3 convolutions with ReLU, flattened: :math:`f_\theta` of the paper.

    84x84 -> 41 -> 39 -> 37 -> 35 with 32 channels gives 39,200 features. Weights are orthogonal on the
    flattened kernel (gain sqrt 2, not delta-orthogonal), biases zero, as in the released implementation
    (liuxin0824/CRPTpro ``proto.py``) and denisyarats/proto.

    Numerics. In float32 the network sees ``pixels * pixel_scale - pixel_offset``. In bfloat16 it sees the raw
    0..255 values, which bfloat16 holds exactly, and the scale is folded into the first kernel; an offset of
    0.5 (with scale 1/255) is exact too. Parameters stay float32 in both, and each chunk of the batch
    accumulates its weight gradient in float32. Memory layout and chunking change rounding only.

    Args:
        in_channels: colour channels times stacked frames (3 x 3).
        channels: output channels of each convolution.
        strides: stride of each convolution.
        image_size: height and width in pixels.
        pixel_scale: factor on the 0..255 values.
        pixel_offset: subtracted after scaling (0 here; 0.5 in URLB-style methods).
        init: ``"orthogonal"``, or ``"kaiming"`` (normal, fan-in, for ReLU), as ATC's own encoder.

    Attributes:
        feature_dim: length of the flattened output, in (C, H, W) order.
        feature_map_shape: ``(C, H, W)`` before flattening.
        config: the constructor arguments, JSON-able.
        compute_dtype: ``torch.float32`` (the parameters' own dtype) or ``torch.bfloat16``; also the output
            dtype.
        micro_batch: chunk length on CPU, where smaller chunks stay in cache and go to different cores; other
            devices take the whole batch.
        channels_last: whether convolutions compute with the channels of a pixel beside each other in memory, or in
            PyTorch's usual layout.

    Raises:
        ValueError: lists of unequal length, an image too small for the convolutions, or an unknown ``init``.

    Examples:
        >>> encoder = PixelEncoder(3, channels=(4, 4), strides=(2, 1), image_size=16)
        >>> encoder(torch.zeros(5, 3, 16, 16, dtype=torch.uint8)).shape
        torch.Size([5, 100])
    """

    def __init__(
        self,
        in_channels: int = 9,
        *,
        channels: Sequence[int] = (32, 32, 32, 32),
        strides: Sequence[int] = (2, 1, 1, 1),
        image_size: int = 84,
        pixel_scale: float = 1 / 255,
        pixel_offset: float = 0.0,
        init: WeightInit = "orthogonal",
    ) -> None:
        super().__init__()
        require_weight_init(init)
        if not channels or len(channels) != len(strides):
            raise ValueError(
                f"channels and strides must be non-empty and of equal length, got {channels} and {strides}."
            )
        size = image_size
        for stride in strides:
            size = (size - KERNEL_SIZE) // stride + 1
            if size < 1:
                raise ValueError(
                    f"image_size {image_size} is too small for strides {tuple(strides)}; use larger images."
                )
        self.in_channels = in_channels
        self.image_size = image_size
        self.pixel_scale = float(pixel_scale)
        self.pixel_offset = float(pixel_offset)
        self.strides = tuple(strides)
        self.convs = nn.ModuleList(
            nn.Conv2d(c_in, c_out, KERNEL_SIZE, stride)
            for c_in, c_out, stride in zip([in_channels, *channels[:-1]], channels, strides)
        )
        self.feature_map_shape: tuple[int, int, int] = (channels[-1], size, size)
        self.feature_dim: int = math.prod(self.feature_map_shape)
        self.config: dict[str, Any] = {
            "in_channels": in_channels,
            "channels": list(channels),
            "strides": list(strides),
            "image_size": image_size,
            "pixel_scale": self.pixel_scale,
            "pixel_offset": self.pixel_offset,
            "init": init,
        }
        self.init: WeightInit = init
        self.compute_dtype: torch.dtype = torch.float32
        self.micro_batch: int = 64
        self.channels_last: bool = True
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draw the kernels (orthogonal ones with gain sqrt 2) and zero the biases."""
        for conv in self.conv_layers:
            init_weights_(conv, self.init, gain=math.sqrt(2.0))

    @property
    def conv_layers(self) -> list[nn.Conv2d]:
        """The convolutions in order, each followed by a ReLU."""
        return cast("list[nn.Conv2d]", list(self.convs))

    def forward(self, pixels: Tensor) -> Tensor:
        """Encode images.

        Args:
            pixels: ``[*, in_channels, image_size, image_size]``, uint8 or floating, values 0..255. In
                bfloat16, non-integer floating values are rounded to eight significant bits.

        Returns:
            ``[*, feature_dim]`` non-negative features in ``compute_dtype``. Non-finite input propagates.

        Raises:
            ValueError: the last three dimensions are not what the encoder was built for.
        """
        expected = (self.in_channels, self.image_size, self.image_size)
        if tuple(pixels.shape[-3:]) != expected:
            raise ValueError(
                f"PixelEncoder was built for pixels of shape [*, {', '.join(map(str, expected))}], "
                f"got {tuple(pixels.shape)}."
            )
        return self.feature_map(pixels).flatten(-3)

    def feature_map(self, pixels: Tensor) -> Tensor:
        """Encode images of any height and width without flattening.

        Args:
            pixels: ``[*, in_channels, H, W]``, uint8 or floating, values 0..255.

        Returns:
            ``[*, C, h, w]`` in ``compute_dtype``; contiguous where the batch took several chunks, else in the layout of
            the convolutions.
        """
        lead = pixels.shape[:-3]
        images = pixels.reshape(-1, *pixels.shape[-3:])
        chunk = self.micro_batch if pixels.device.type == "cpu" else 0
        parameters = [p for conv in self.conv_layers for p in (conv.weight, cast(Tensor, conv.bias))]
        if chunk and images.shape[0] > chunk and not images.requires_grad:
            maps = apply_to_chunks(self._convolve, images.split(chunk), parameters)
        else:
            maps = self._convolve(images, parameters)
        return maps.reshape(*lead, *maps.shape[1:])

    def _convolve(self, images: Tensor, parameters: Sequence[Tensor]) -> Tensor:
        """Encode one chunk with weights and biases given in turn; called from several threads at a time."""
        low = self.compute_dtype != torch.float32
        if low:
            x = images.to(self.compute_dtype)
            if self.pixel_offset:
                # In pixel units: 127.5 and its differences to 0..255 are exact in bfloat16.
                x = x - self.pixel_offset / self.pixel_scale
        else:
            x = images.to(parameters[0].dtype) * self.pixel_scale
            if self.pixel_offset:
                x = x - self.pixel_offset
        x = x.contiguous(memory_format=torch.channels_last if self.channels_last else torch.contiguous_format)
        weights, biases = list(parameters[::2]), list(parameters[1::2])
        if low:
            weights[0] = weights[0] * self.pixel_scale
            weights = [weight.to(self.compute_dtype) for weight in weights]
            biases = [bias.to(self.compute_dtype) for bias in biases]
        largest = max(255.0, self.pixel_offset / self.pixel_scale) if images.dtype == torch.uint8 else None
        return conv_relu_stack(x, weights, biases, self.strides, largest=largest)

    def extra_repr(self) -> str:
        """Show the shapes that matter when reading a printed model."""
        return f"image_size={self.image_size}, feature_dim={self.feature_dim}"
