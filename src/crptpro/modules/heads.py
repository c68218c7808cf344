"""What sits on the encoder during pre-training: projector, predictor and prototypes (CRPTpro, Sec. III)."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from crptpro.modules.initialisation import WeightInit, init_weights_, orthogonal_linear_, require_weight_init
from crptpro.modules.precision import linear_in

NORM_EPS = 1e-12


class Projector(nn.Module):
    r"""One linear layer from features to the latent space: :math:`g_\theta`.

    Orthogonal weights (gain 1), zero bias. The product runs in ``compute_dtype``; the result has the
    parameters' dtype, so normalisation, softmax and Sinkhorn stay float32. Source: denisyarats/proto and
    liuxin0824/CRPTpro ``proto.py`` (a single layer there too).

    Args:
        feature_dim: input length (39,200 for the default encoder).
        latent_dim: output length D.
        init: ``"orthogonal"``, or ``"kaiming"`` (normal, fan-in, for ReLU), as ATC draws its own.

    Raises:
        ValueError: unknown ``init``.
    """

    def __init__(
        self, feature_dim: int = 39_200, latent_dim: int = 128, init: WeightInit = "orthogonal"
    ) -> None:
        super().__init__()
        require_weight_init(init)
        self.linear = nn.Linear(feature_dim, latent_dim)
        self.init: WeightInit = init
        self.config: dict[str, Any] = {"feature_dim": feature_dim, "latent_dim": latent_dim, "init": init}
        self.compute_dtype: torch.dtype = torch.float32
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draw the weights and zero the bias."""
        init_weights_(self.linear, self.init)

    def forward(self, features: Tensor) -> Tensor:
        """Project ``[*, feature_dim]`` (any floating dtype) to ``[*, latent_dim]``, not normalised."""
        return linear_in(features, self.linear.weight, self.linear.bias, self.compute_dtype)


class Predictor(nn.Module):
    r"""Two-layer perceptron in the latent space, online branch only: :math:`v_\psi`.

    Orthogonal weights (gain 1), zero biases. Source: denisyarats/proto and liuxin0824/CRPTpro ``proto.py``.

    Args:
        latent_dim: input and output length D.
        hidden_dim: hidden width. 1024 as in the paper's table; the released code has 512.
    """

    def __init__(self, latent_dim: int = 128, hidden_dim: int = 1024) -> None:
        super().__init__()
        self.hidden = nn.Linear(latent_dim, hidden_dim)
        self.output = nn.Linear(hidden_dim, latent_dim)
        self.config: dict[str, Any] = {"latent_dim": latent_dim, "hidden_dim": hidden_dim}
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draw orthogonal weights and zero the biases."""
        orthogonal_linear_(self.hidden)
        orthogonal_linear_(self.output)

    def forward(self, latents: Tensor) -> Tensor:
        """Map ``[*, D]`` to ``[*, D]``."""
        return self.output(F.relu(self.hidden(latents)))


class Prototypes(nn.Module):
    """M trainable vectors; what matters of each is its direction.

    Orthogonal initialisation (a tight frame when M > D). Training keeps the rows at unit length by calling
    :meth:`normalize_` before every update, as the released code does; every read goes through
    :meth:`unit_weight`, so rows of any length give the same scores. Source: denisyarats/proto and
    liuxin0824/CRPTpro ``proto.py``; the idea is SwaV's (arXiv 2006.09882).

    Args:
        num_prototypes: M.
        latent_dim: D.
    """

    def __init__(self, num_prototypes: int = 512, latent_dim: int = 128) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(num_prototypes, latent_dim))
        self.config: dict[str, Any] = {"num_prototypes": num_prototypes, "latent_dim": latent_dim}
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draw an orthogonal matrix and scale its rows to unit length."""
        nn.init.orthogonal_(self.weight)
        self.normalize_()

    @torch.no_grad()
    def normalize_(self) -> Prototypes:
        """Scale every row to unit length in place, outside autograd. Returns self."""
        self.weight.div_(self.weight.norm(dim=-1, keepdim=True).clamp_min(NORM_EPS))
        return self

    def unit_weight(self, *, through_norm: bool = False) -> Tensor:
        """Return the rows at unit length ``[M, D]``.

        Args:
            through_norm: differentiate the normalisation. By default the length is a constant, so the
                gradient reaches the raw weight as it does in the released code, radial part included.
        """
        norm = self.weight.norm(dim=-1, keepdim=True).clamp_min(NORM_EPS)
        return self.weight / (norm if through_norm else norm.detach())

    def forward(self, latents: Tensor) -> Tensor:
        """Cosine scores ``[*, M]`` in [-1, 1] of l2-normalised latents ``[*, D]``."""
        return F.linear(latents, self.unit_weight())


def latent_dim_of(head: nn.Module) -> int | None:
    """Return the length D of the latents a head works in, where it says so, else None.

    Args:
        head: one of the above, or any module with a ``config`` that has ``"latent_dim"``.
    """
    config = getattr(head, "config", None)
    return config.get("latent_dim") if isinstance(config, dict) else None


def require_one_latent_dim(**heads: nn.Module) -> None:
    """Refuse heads that could not be multiplied; those that do not tell their length are left to the product.

    Raises:
        ValueError: naming each head's length.
    """
    dims = {name: dim for name, head in heads.items() if (dim := latent_dim_of(head)) is not None}
    if len(set(dims.values())) > 1:
        told = ", ".join(f"{name} {dim}" for name, dim in dims.items())
        raise ValueError(
            f"The heads must share one latent length, got {told}; pass latent_dim= for those that are not given."
        )
