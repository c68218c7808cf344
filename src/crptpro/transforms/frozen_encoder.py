"""A frozen encoder as a TorchRL transform from pixels to features."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torchrl.data.tensor_specs import Unbounded

from crptpro.modules.precision import device_of, evaluating
from crptpro.transforms.base import Keys, PixelTransform


class FrozenEncoder(PixelTransform):
    """Encode images ``[*, C, H, W]`` without gradient, on environments (single and batched) and in replay buffers.

    The encoder is any ``nn.Module`` from ``[N, C, H, W]`` to features ``[N, ...]``. It gets the images unscaled and
    computes in evaluation mode. It is not copied: training it changes the features, and a buffer that prefetches
    switches its mode from another thread. Images are moved to its device, and the features, in its output dtype, back
    to the device of the images.

    Examples:
        >>> from crptpro.modules import PixelEncoder
        >>> from tensordict import TensorDict
        >>> encoder = PixelEncoder(3, channels=(4, 4), strides=(2, 1), image_size=16)
        >>> FrozenEncoder(encoder)(TensorDict(pixels=torch.zeros(2, 3, 16, 16, dtype=torch.uint8)))["features"].shape
        torch.Size([2, 100])
    """

    encoder: nn.Module

    def __init__(self, encoder: nn.Module, *, in_keys: Keys = "pixels", out_keys: Keys = "features") -> None:
        super().__init__(in_keys, out_keys)
        # Hidden from nn.Module: the caller owns the network, which is not part of a replay's state.
        self.__dict__["encoder"] = encoder

    @torch.no_grad()
    def _apply_transform(self, obs: Tensor) -> Tensor:
        lead = obs.shape[:-3]
        device = device_of(self.encoder) or obs.device
        with evaluating(self.encoder):
            features = self.encoder(obs.reshape(-1, *obs.shape[-3:]).to(device))
        if not isinstance(features, Tensor):
            raise TypeError(
                f"The encoder {type(self.encoder).__name__} returned {type(features).__name__}, not a tensor of "
                "features; wrap it in a module that returns a tensor."
            )
        return features.to(obs.device).reshape(*lead, *features.shape[1:])

    def written_spec(self, read: Any) -> Unbounded:
        features = self._apply_transform(torch.zeros(read.shape[-3:], dtype=read.dtype, device=read.device))
        return Unbounded(shape=(*read.shape[:-3], *features.shape), dtype=features.dtype, device=read.device)
