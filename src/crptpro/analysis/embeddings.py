"""Embeddings of a frozen encoder on sampled observations, and measures of their spread."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torchrl.data import ReplayBuffer

from crptpro.modules.precision import device_of


def sample_pixels(dataset: ReplayBuffer, samples: int, *, seed: int) -> Tensor:
    """Draw observations ``[samples, C, H, W]``, which depend on the seed alone, not on earlier samples."""
    dataset.set_rng(torch.Generator().manual_seed(seed))
    return dataset.sample(samples)["pixels"]


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


def principal_components(points: Tensor, *, components: int = 3) -> tuple[Tensor, Tensor]:
    """Project centred points ``[N, D]`` on their leading principal directions (scikit-learn's ``PCA``).

    Returns coordinates ``[N, components]``, and the fraction of the variance that each explains, in decreasing order.
    """
    from sklearn.decomposition import PCA

    pca = PCA(components, svd_solver="full")
    coordinates = pca.fit_transform(points.double().numpy())
    return torch.from_numpy(coordinates), torch.from_numpy(pca.explained_variance_ratio_)


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
    # The Gram matrix has half of the digits: smaller values are rounding errors.
    singular = singular[singular > 1e-7 * singular.max()]
    if not len(singular):
        return 0.0
    shares = singular / singular.sum()
    return float(np.exp(-(shares * np.log(shares)).sum()))


def mean_cosine(features: Tensor) -> float:
    """Return the mean cosine between different samples' features ``[N, D]``; 1 if all point the same way.

    A sample whose features are all 0 has the cosine 0 with every other; a single one gives 0.
    """
    count = len(features)
    if count < 2:
        return 0.0
    unit = nn.functional.normalize(features, dim=1)
    of_sum = unit.sum(0, dtype=torch.float64).square().sum()
    return float(of_sum - unit.square().sum(dtype=torch.float64)) / (count * (count - 1))
