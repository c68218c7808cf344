"""Embeddings of a frozen encoder on sampled observations, and how they are spread."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torchrl.data import ReplayBuffer

from crptpro.modules.precision import device_of

_BATCH = 64
FEATURES = 4096
"""That are taken to float64 at a time: all at once would take gigabytes."""


def sample_pixels(dataset: ReplayBuffer, samples: int, *, seed: int) -> Tensor:
    """Draw the same observations whenever asked with the same seed; the dataset's own generator is put back.

    Args:
        dataset: its samples hold ``pixels``.
        samples: B, how many.
        seed: which ones.

    Returns:
        ``[B, C, H, W]``, dtype and device as the dataset has them.
    """
    before = getattr(dataset, "_rng", None)  # TorchRL has a setter but no getter
    device = getattr(dataset.storage, "device", "cpu") if before is None else before.device
    if not isinstance(device, torch.device):
        device = torch.device("cpu")  # "auto": nobody has said
    dataset.set_rng(torch.Generator(device).manual_seed(seed))
    try:
        return dataset.sample(samples)["pixels"]
    finally:
        dataset.set_rng(before)


@torch.no_grad()
def embed_pixels(encoder: nn.Module, pixels: Tensor, *, projector: nn.Module | None = None) -> Tensor:
    """Encode observations without augmentation, where the encoder lives, some at a time.

    Args:
        encoder: maps uint8 ``[B, C, H, W]`` to features ``[B, D]``.
        pixels: ``[N, C, H, W]``, on any device.
        projector: if given, embeddings are its outputs, else the features themselves.

    Returns:
        float32 ``[N, D]`` on the encoder's device.
    """
    device = device_of(encoder) or pixels.device
    parts = []
    for batch in pixels.split(_BATCH):
        features = encoder(batch.to(device))
        parts.append((features if projector is None else projector(features)).float())
    return torch.cat(parts)


def principal_components(points: Tensor, *, components: int = 3) -> tuple[Tensor, Tensor]:
    """Project centred points on their leading principal directions.

    Args:
        points: float ``[N, D]`` with ``N`` at least 2, not all equal.
        components: how many directions, at most ``min(N, D)``.

    Returns:
        Coordinates ``[N, components]`` and the fraction of the total variance each explains
        ``[components]``, in [0, 1] and in decreasing order. The sign of each direction is fixed so that
        its largest coordinate is positive.

    Raises:
        ValueError: fewer than two points, or ``components`` outside ``1..min(N, D)``.
    """
    if points.shape[0] < 2:
        raise ValueError(f"`points` must be at least 2, got {points.shape[0]}: one point has no variance.")
    if not 1 <= components <= min(points.shape):
        raise ValueError(f"`components` must be at most min(N, D) = {min(points.shape)}, got {components}.")
    centred = (points - points.mean(0)).double()
    left, singular, _ = torch.linalg.svd(centred, full_matrices=False)
    coordinates = left[:, :components] * singular[:components]
    largest = coordinates.abs().argmax(0)
    coordinates = coordinates * coordinates[largest, torch.arange(components)].sign()
    variance = singular.square()
    return coordinates.to(points.dtype), (variance[:components] / variance.sum()).to(points.dtype)


def gram_matrix(features: Tensor, mean: Tensor, scale: Tensor) -> np.ndarray:
    """Return the inner products of ``(features - mean) / scale``, summed in float64.

    Args:
        features: ``[N, D]``, any floating dtype, on the CPU.
        mean: ``[D]``.
        scale: ``[D]``.

    Returns:
        float64 ``[N, N]``.
    """
    from scipy.linalg.blas import dsyrk

    upper = np.zeros((len(features), len(features)), order="F")
    for block, m, s in zip(*(each.split(FEATURES, dim=-1) for each in (features, mean, scale))):
        standardized = (block.double() - m) / s
        upper = dsyrk(1.0, standardized.numpy().T, beta=1.0, c=upper, trans=1, overwrite_c=1)
    return np.triu(upper) + np.triu(upper, 1).T


def effective_rank(features: Tensor) -> float:
    """Return the exponential of the entropy of the centred samples' normalised singular values.

    Between 1 (all on a line) and min(N - 1, D); 0 if all samples coincide. Source: Roy and Vetterli, "The effective
    rank: a measure of effective dimensionality", 2007.

    Args:
        features: ``[N, D]``.

    Examples:
        >>> round(effective_rank(torch.tensor([[1.0, 0], [-1, 0], [0, 1], [0, -1]])), 6)
        2.0
    """
    mean = features.mean(0, dtype=torch.float64)
    gram = gram_matrix(features, mean, torch.ones_like(mean))
    singular = np.sqrt(np.linalg.eigvalsh(gram).clip(min=0))
    # Squaring has cost half of the digits: what is below is rounding.
    singular = singular[singular > 1e-7 * singular.max()]
    if not len(singular):
        return 0.0
    shares = singular / singular.sum()
    return float(np.exp(-(shares * np.log(shares)).sum()))


def mean_cosine(features: Tensor) -> float:
    """Return the mean cosine between different samples' features; 1 if all point the same way, 0 for one sample.

    A sample whose features are all 0 has the cosine 0 with every other.

    Args:
        features: ``[N, D]``, any floating dtype.
    """
    count = len(features)
    if count < 2:
        return 0.0
    unit = nn.functional.normalize(features, dim=1)
    of_sum = unit.sum(0, dtype=torch.float64).square().sum()
    return float(of_sum - unit.square().sum(dtype=torch.float64)) / (count * (count - 1))
