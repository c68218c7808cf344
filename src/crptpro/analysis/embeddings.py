"""Embeddings of a frozen encoder on sampled observations, and measures of their spread."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from crptpro.modules.precision import device_of


@torch.no_grad()
def embed_pixels(encoder: nn.Module, pixels: Tensor, *, projector: nn.Module | None = None) -> Tensor:
    """Encode observations without augmentation, in batches: float32 ``[N, D]`` on the encoder's device.

    The encoder maps uint8 ``[B, C, H, W]`` to features. ``pixels`` are ``[N, C, H, W]`` on any device. With a projector
    its outputs are the embeddings.
    """
    device = device_of(encoder) or pixels.device
    parts = []
    for batch in pixels.split(64):
        features = encoder(batch.to(device))
        parts.append((features if projector is None else projector(features)).float())
    return torch.cat(parts)


def gram_matrix(features: Tensor, mean: Tensor, scale: Tensor) -> np.ndarray:
    """Return the inner products, float64 ``[N, N]``, of ``(features - mean) / scale``; features on the CPU."""
    standardized = features.to(torch.float64, copy=True).sub_(mean).div_(scale).numpy()
    return standardized @ standardized.T


def effective_rank(features: Tensor) -> float:
    """Return the exponential of the entropy of the centred samples' normalised singular values.

    Between 1 (all on a line) and min(N - 1, D) of features ``[N, D]``; 0 if all samples coincide. Source: Roy and
    Vetterli, "The effective rank: a measure of effective dimensionality", 2007.
    """
    mean = features.mean(0, dtype=torch.float64)
    gram = gram_matrix(features, mean, torch.ones_like(mean))
    singular = np.sqrt(np.linalg.eigvalsh(gram).clip(min=0))
    # From a Gram matrix, singular values have half the significant digits: smaller ones are rounding errors.
    singular = singular[singular > 1e-7 * singular.max()]
    if not len(singular):
        return 0.0
    shares = singular / singular.sum()
    return float(np.exp(-(shares * np.log(shares)).sum()))
