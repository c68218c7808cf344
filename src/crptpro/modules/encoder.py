"""The convolutional encoder that every method pre-trains and every downstream agent freezes."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from crptpro.modules.convolutions import apply_to_chunks
from crptpro.modules.heads import WeightInit, init_weights_, plain_sizes
from crptpro.values import as_float, as_int

KERNEL_SIZE = 3

logger = logging.getLogger(__name__)


class PixelEncoder(nn.Module):
    r"""Four un-padded 3x3 convolutions with ReLU, flattened: :math:`f_\theta` of the paper.

    84x84 -> 41 -> 39 -> 37 -> 35 with 32 channels gives 39,200 features. Weights are orthogonal on the flattened kernel
    (gain sqrt 2, not delta-orthogonal), biases zero, as in liuxin0824/CRPTpro and denisyarats/proto ``proto.py``.

    The input is ``pixels * pixel_scale - pixel_offset``, and ``pixel_offset`` is 0.5 in URLB-style methods. In bfloat16
    it is the raw 0..255 values, which are exact there, and the first kernel is scaled instead. Parameters and gradients
    stay float32. Images are uint8, or floating in [0, 1], which count as already divided by 255 (one warning per
    encoder); others raise a ``ValueError``.

    ``in_channels`` are the colour channels times the stacked frames; ``init="kaiming"`` (normal, fan-in, for ReLU) is
    that of ATC's encoder; ``standardised`` creates the buffers of :meth:`standardise` (0 and 1), to load weights into.

    Attributes:
        feature_dim: length of the output, the flattened ``feature_map_shape`` (C, H, W).
        config: the constructor arguments, JSON-able.
        compute_dtype: ``torch.float32`` (the parameters' own dtype) or ``torch.bfloat16``; also of the output.
        micro_batch: chunk length on a CPU, where chunks stay in cache and go to different cores.
    """

    convs: Any
    feature_mean: Tensor
    feature_scale: Tensor

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
        standardised: bool = False,
    ) -> None:
        super().__init__()
        if any(isinstance(each, (int, str)) for each in (channels, strides)) or not 0 < len(channels) == len(strides):
            raise ValueError(f"channels and strides must be sequences of one length, got {channels} and {strides}.")
        sizes = plain_sizes(in_channels=in_channels, image_size=image_size)
        self.in_channels, self.image_size = sizes.values()
        channels = [as_int(count, "channels", minimum=1) for count in channels]
        self.strides = tuple(as_int(stride, "strides", minimum=1) for stride in strides)
        size = self.image_size
        for stride in self.strides:
            size = (size - KERNEL_SIZE) // stride + 1
            if size < 1:
                raise ValueError(f"image_size {image_size} is too small for strides {self.strides}; use larger images.")
        self.pixel_scale = as_float(pixel_scale, "pixel_scale")
        self.pixel_offset = as_float(pixel_offset, "pixel_offset")
        self.convs = nn.ModuleList(
            nn.Conv2d(c_in, c_out, KERNEL_SIZE, stride)
            for c_in, c_out, stride in zip([self.in_channels, *channels[:-1]], channels, self.strides)
        )
        self.feature_map_shape: tuple[int, int, int] = (channels[-1], size, size)
        self.feature_dim: int = math.prod(self.feature_map_shape)
        self.config: dict[str, Any] = {
            **sizes, "channels": channels, "strides": list(self.strides), "pixel_scale": self.pixel_scale,
            "pixel_offset": self.pixel_offset, "init": init, "standardised": bool(standardised),
        }  # fmt: skip
        self.compute_dtype = torch.float32
        self.micro_batch = 64
        self._has_warned = False
        if standardised:
            self.register_buffer("feature_mean", torch.zeros(self.feature_dim))
            self.register_buffer("feature_scale", torch.ones(self.feature_dim))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        for conv in self.convs:
            init_weights_(conv, self.config["init"], gain=math.sqrt(2.0))

    @torch.no_grad()
    def standardise(self, mean: Tensor, scale: Tensor) -> PixelEncoder:
        """From now on output ``(features - mean) / scale``; both are finite ``[feature_dim]``, saved as buffers."""
        for name, value in (("mean", mean), ("scale", scale)):
            value = torch.as_tensor(value).to(self.convs[0].weight)
            if value.shape != (self.feature_dim,) or not bool(value.isfinite().all()):
                raise ValueError(
                    f"`{name}` must hold {self.feature_dim} finite numbers, one per feature, got {tuple(value.shape)}."
                )
            if name == "scale" and not bool((value > 0).all()):
                raise ValueError("`scale` must be positive; use 1 for constant features.")
            self.register_buffer(f"feature_{name}", value.clone())
        self.config["standardised"] = True
        return self

    def forward(self, pixels: Tensor) -> Tensor:
        """Encode images ``[*, in_channels, image_size, image_size]`` to ``[*, feature_dim]`` in ``compute_dtype``."""
        expected = (self.in_channels, self.image_size, self.image_size)
        if tuple(pixels.shape[-3:]) != expected:
            shape = ", ".join(map(str, expected))
            raise ValueError(f"PixelEncoder was built for pixels of shape [*, {shape}], got {tuple(pixels.shape)}.")
        return self.standardised(self.feature_map(pixels).flatten(-3))

    def standardised(self, features: Tensor) -> Tensor:
        """Shift and scale raw features ``[*, feature_dim]`` if :meth:`standardise` was called; their dtype is kept."""
        if not self.config["standardised"]:
            return features
        centred = features.to(self.feature_mean.dtype) - self.feature_mean
        return (centred / self.feature_scale).to(features.dtype)

    def feature_map(self, pixels: Tensor) -> Tensor:
        """Encode images ``[*, in_channels, H, W]`` of any size to ``[*, C, h, w]``, not flattened or standardised."""
        self._require_pixels(pixels)
        lead = pixels.shape[:-3]
        images = pixels.reshape(-1, *pixels.shape[-3:])
        parameters = [p for conv in self.convs for p in (conv.weight, conv.bias)]
        if len(images) > self.micro_batch and not images.requires_grad and _can_chunk(images.device):
            maps = apply_to_chunks(self._convolve, images.split(self.micro_batch), parameters)
        else:
            maps = self._convolve(images, parameters)
        return maps.reshape(*lead, *maps.shape[1:])

    def _require_pixels(self, pixels: Tensor) -> None:
        if pixels.dtype == torch.uint8:
            return
        if not pixels.is_floating_point():
            raise ValueError(f"Pixels must be uint8, or floating in [0, 1], got {pixels.dtype}; use .to(torch.uint8).")
        if torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active() or not pixels.numel():
            return  # their values cannot be read
        low, high = (float(bound) for bound in torch.aminmax(pixels.detach()))
        if not (low >= 0 and high <= 1):
            raise ValueError(
                f"Floating pixels must lie in [0, 1], got values from {low:g} to {high:g}; pass 0..255 as uint8."
            )
        if not self._has_warned:
            self._has_warned = True
            logger.warning(
                "PixelEncoder is given %s pixels in [0, 1]; they are taken as divided by 255 already.",
                str(pixels.dtype).removeprefix("torch."),
            )

    def _convolve(self, images: Tensor, parameters: Sequence[Tensor]) -> Tensor:
        """Encode one chunk with alternating weights and biases; several threads call it at a time."""
        weights, biases = list(parameters[::2]), list(parameters[1::2])
        scale = self.pixel_scale if images.dtype == torch.uint8 else 255 * self.pixel_scale
        if self.compute_dtype == torch.float32:
            x = images.to(weights[0].dtype) * scale
            offset = self.pixel_offset
        else:
            x = images.to(self.compute_dtype)
            weights[0] = weights[0] * scale
            offset = self.pixel_offset / scale  # in pixel units: 127.5 less 0..255 is exact in bfloat16
        if offset:
            x = x - offset
        # Forward and backward pass of 512 images in bfloat16 were 3 and 15 % faster than in PyTorch's usual layout on
        # two CPUs with AVX512-BF16, and a third faster on one with AMX.
        if torch.compiler.is_compiling() or not torch._C._are_functorch_transforms_active():  # vmap has no layouts
            x = x.contiguous(memory_format=torch.channels_last)
        for weight, bias, stride in zip(weights, biases, self.strides):
            x = F.relu(F.conv2d(x, weight.to(x.dtype), bias.to(x.dtype), stride=stride), inplace=True)
        return x.contiguous()


def images_of(encoder: object) -> dict[str, Any]:
    """Return ``image_size`` and ``frame_stack`` of the images that an encoder takes, by default 84 and 3.

    They are read from its attributes ``image_size`` and ``in_channels``, or from these entries of its ``config``.
    """
    declared: dict[str, Any] = {"image_size": 84, "in_channels": 9} | (getattr(encoder, "config", None) or {})
    size, channels = (getattr(encoder, name, declared[name]) for name in ("image_size", "in_channels"))
    return {"image_size": size, "frame_stack": channels // 3}


def _can_chunk(device: torch.device) -> bool:
    """Whether other threads may compute: autocast and functional transforms act on the calling thread alone."""
    return (
        device.type == "cpu"
        and not torch.compiler.is_compiling()
        and not torch.is_autocast_enabled("cpu")
        and not torch._C._are_functorch_transforms_active()
    )
