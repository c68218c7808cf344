"""Heads of the contrastive methods: ATC's anchor head, and BeCL's embedding and projection."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from crptpro.modules.initialisation import orthogonal_linear_
from crptpro.modules.precision import linear_in


class AnchorHead(nn.Module):
    r"""ATC's contrast model on the anchor's side: :math:`W(a + \mathrm{MLP}(a))`, online branch only.

    Two-layer residual perceptron and a bilinear matrix without bias; the logits are the inner products of the
    result with the positives' latents. PyTorch's default initialisation, as in the source: astooke/rlpyt
    ``rlpyt/ul/models/ul/atc_models.py`` (ATC, arXiv 2009.08319).

    Args:
        latent_dim: length D of the latents.
        hidden_dim: hidden width of the perceptron.
    """

    def __init__(self, latent_dim: int = 128, hidden_dim: int = 512) -> None:
        super().__init__()
        self.hidden = nn.Linear(latent_dim, hidden_dim)
        self.output = nn.Linear(hidden_dim, latent_dim)
        self.bilinear = nn.Linear(latent_dim, latent_dim, bias=False)
        self.config: dict[str, Any] = {"latent_dim": latent_dim, "hidden_dim": hidden_dim}

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draw the weights and biases as PyTorch's linear layers do."""
        for layer in (self.hidden, self.output, self.bilinear):
            layer.reset_parameters()

    def forward(self, anchors: Tensor) -> Tensor:
        """Map latents ``[*, D]`` to ``[*, D]``, not normalised."""
        return self.bilinear(anchors + self.output(F.relu(self.hidden(anchors))))


class SkillHead(nn.Module):
    """BeCL's head: embedding of the features, then projection, in one module.

    features -> hidden ReLU -> hidden ReLU -> D (embedding) -> hidden ReLU -> D (projection). Orthogonal weights
    (gain 1), zero biases. The product with the features runs in ``compute_dtype``; everything after it, and the
    result, has the parameters' dtype. Source: Rooshy-yang/BeCL ``agent/becl.py`` (arXiv 2305.04477).

    Args:
        feature_dim: input length (39,200 for the default encoder).
        latent_dim: length D of the embedding and of the result; the number of skills in the source.
        hidden_dim: hidden width of both parts.
    """

    def __init__(self, feature_dim: int = 39_200, latent_dim: int = 16, hidden_dim: int = 1024) -> None:
        super().__init__()
        self.embed_input = nn.Linear(feature_dim, hidden_dim)
        self.embed_hidden = nn.Linear(hidden_dim, hidden_dim)
        self.embed_output = nn.Linear(hidden_dim, latent_dim)
        self.project_hidden = nn.Linear(latent_dim, hidden_dim)
        self.project_output = nn.Linear(hidden_dim, latent_dim)
        self.config: dict[str, Any] = {
            "feature_dim": feature_dim,
            "latent_dim": latent_dim,
            "hidden_dim": hidden_dim,
        }
        self.compute_dtype: torch.dtype = torch.float32
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draw orthogonal weights and zero the biases."""
        for layer in self.children():
            if isinstance(layer, nn.Linear):
                orthogonal_linear_(layer)

    def forward(self, features: Tensor) -> Tensor:
        """Map features ``[*, feature_dim]`` (any floating dtype) to ``[*, D]``, not normalised."""
        first = self.embed_input
        hidden = F.relu(linear_in(features, first.weight, first.bias, self.compute_dtype))
        embedding = self.embed_output(F.relu(self.embed_hidden(hidden)))
        return self.project_output(F.relu(self.project_hidden(embedding)))
