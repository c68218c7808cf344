"""Embeddings of sampled observations, and how they are spread."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from crptpro.analysis.embeddings import effective_rank, embed_pixels


class Brightness(nn.Module):
    """An encoder whose feature is the mean pixel."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(1))

    def forward(self, pixels: Tensor) -> Tensor:
        return self.weight * pixels.flatten(1).double().mean(1, keepdim=True)


def test_embeddings_are_features_or_projections_computed_in_batches_on_the_encoders_device() -> None:
    pixels = torch.arange(150, dtype=torch.uint8).view(150, 1, 1, 1).expand(150, 9, 8, 8)
    points = embed_pixels(Brightness(), pixels)
    assert torch.equal(points, torch.arange(150.0).unsqueeze(1))
    assert (points.dtype, points.requires_grad) == (torch.float32, False)
    head = nn.Linear(1, 3, dtype=torch.float64)
    assert embed_pixels(Brightness(), pixels, projector=head).shape == (150, 3)
    assert embed_pixels(Brightness().to("meta"), pixels).device.type == "meta"


def test_effective_rank_counts_directions_and_changes_nothing() -> None:
    axes = torch.cat([torch.eye(5), -torch.eye(5)])
    assert effective_rank(axes) == pytest.approx(5)
    assert effective_rank(axes + 100) == pytest.approx(5, rel=1e-4)  # of centred samples
    assert effective_rank(torch.arange(6.0)[:, None] * torch.ones(1, 9)) == pytest.approx(1)
    assert effective_rank(torch.ones(4, 3)) == 0
    wide = torch.randn(8, 9_000, dtype=torch.float64)
    before = wide.clone()
    singular = torch.linalg.svdvals(wide - wide.mean(0))[:7]
    entropy = torch.special.entr(singular / singular.sum()).sum()
    assert effective_rank(wide) == pytest.approx(entropy.exp().item(), rel=1e-6)
    assert wide.equal(before)
