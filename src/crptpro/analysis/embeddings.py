"""Embeddings of a frozen encoder on sampled observations, and their principal components."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torchrl.data import ReplayBuffer

from crptpro.modules.placement import device_of

_BATCH = 64


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


@torch.no_grad()
def embed_samples(
    encoder: nn.Module,
    datasets: Mapping[str, ReplayBuffer],
    *,
    projector: nn.Module | None = None,
    samples: int = 125,
    seed: int = 0,
) -> dict[str, Tensor]:
    """Encode random observations of every dataset, without augmentation, where the encoder lives.

    Args:
        encoder: maps uint8 ``[B, C, H, W]`` to features ``[B, D]``.
        datasets: domain name to replay buffer whose samples hold ``pixels``; on any device. Their generators are
            left as they were.
        projector: if given, embeddings are its outputs, else the features themselves.
        samples: observations per domain (125 in the paper's figure).
        seed: which observations.

    Returns:
        Domain name to float32 embeddings ``[samples, D]`` on the encoder's device.

    Raises:
        ValueError: images of another shape than the encoder takes.
    """
    embeddings = {}
    for name, dataset in datasets.items():
        pixels = sample_pixels(dataset, samples, seed=seed)
        embeddings[name] = embed_pixels(encoder, pixels, projector=projector)
    return embeddings


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
