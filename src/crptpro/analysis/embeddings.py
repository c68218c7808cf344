"""Embeddings of a frozen encoder on sampled observations, and their principal components."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torchrl.data import ReplayBuffer


@torch.no_grad()
def embed_samples(
    encoder: nn.Module,
    datasets: Mapping[str, ReplayBuffer],
    *,
    projector: nn.Module | None = None,
    samples: int = 125,
    seed: int = 0,
) -> dict[str, Tensor]:
    """Encode random observations of every dataset, without augmentation.

    Args:
        encoder: maps uint8 ``[B, C, H, W]`` to features ``[B, D]``.
        datasets: domain name to replay buffer whose samples hold ``pixels``.
        projector: if given, embeddings are its outputs, else the features themselves.
        samples: observations per domain (125 in the paper's figure).
        seed: which observations.

    Returns:
        Domain name to float32 embeddings ``[samples, D]``.
    """
    embeddings = {}
    for name, dataset in datasets.items():
        dataset.set_rng(torch.Generator().manual_seed(seed))
        features = encoder(dataset.sample(samples)["pixels"])
        embeddings[name] = (features if projector is None else projector(features)).float()
    return embeddings


def principal_components(points: Tensor, *, components: int = 3) -> tuple[Tensor, Tensor]:
    """Project centred points on their leading principal directions.

    Args:
        points: float ``[N, D]`` with ``N`` at least 2.
        components: how many directions, at most ``min(N, D)``.

    Returns:
        Coordinates ``[N, components]`` and the fraction of the total variance each explains
        ``[components]``, in decreasing order. The sign of each direction is fixed so that its
        largest coordinate is positive.

    Raises:
        ValueError: if ``components`` exceeds ``min(N, D)``.
    """
    if components > min(points.shape):
        raise ValueError(f"`components` must be at most min(N, D) = {min(points.shape)}, got {components}.")
    centred = (points - points.mean(0)).double()
    left, singular, _ = torch.linalg.svd(centred, full_matrices=False)
    coordinates = left[:, :components] * singular[:components]
    largest = coordinates.abs().argmax(0)
    coordinates = coordinates * coordinates[largest, torch.arange(components)].sign()
    variance = singular.square()
    return coordinates.to(points.dtype), (variance[:components] / variance.sum()).to(points.dtype)
