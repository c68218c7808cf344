"""Observations for an encoder that is being trained: encoded anew whenever somebody acts, shifted twice to learn."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from crptpro.data import FrameReplay
from crptpro.modules import PixelEncoder
from crptpro.transforms import draw_offsets, random_shift


class TrainedFeatures:
    """What :class:`~crptpro.training.frozen_features.FrozenFeatures` is where the encoder changes at every update.

    Args:
        encoder: whatever it is when it is asked.
        replay: where observations live.
        pad: largest random shift in pixels.
        generator: source of the shifts.
        device: where batches go.
    """

    mode = "trained"
    keeps_projections = False

    def __init__(
        self,
        encoder: PixelEncoder,
        replay: FrameReplay,
        *,
        pad: int,
        generator: torch.Generator,
        device: torch.device | str = "cpu",
    ) -> None:
        self.encoder = encoder
        self.replay = replay
        self.pad = pad
        self.generator = generator
        self.device = torch.device(device)

    @torch.no_grad()
    def observe(self, pixels: Tensor, slot: int) -> Tensor:
        """Return the features of the newest observation as the encoder is now, ``[1, feature_dim]``.

        Args:
            pixels: uint8 ``[C, H, W]``.
            slot: not read; nothing is kept.
        """
        return self.encoder(pixels.unsqueeze(0).to(self.device))

    def sample(self, batch_size: int) -> TensorDictBase:
        """Sample transitions in two views: every observation shifted twice, each time by an offset of its own.

        Args:
            batch_size: B.

        Returns:
            The replay's sample ``[B]`` with shifted ``pixels`` and ``("next", "pixels")`` and, from the same images,
            ``pixels_view`` and ``("next", "pixels_view")``; uint8 ``[B, C, H, W]``, on :attr:`device`.
        """
        batch = self.replay.sample(batch_size).to(self.device)
        for part in (batch, batch["next"]):
            pixels = part["pixels"]
            for key in ("pixels", "pixels_view"):
                offsets = draw_offsets(len(pixels), self.pad, self.generator, self.device)
                part.set(key, random_shift(pixels, offsets, pad=self.pad))
        return batch

    def rebuild(self, *, progress: bool = True) -> None:
        """Nothing is kept, so nothing is to be rebuilt."""
