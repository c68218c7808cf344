"""Heads on the encoder for pre-training: those of CRPTpro and Proto-RL, of ATC, and of BeCL.

Every head keeps its arguments in ``config``. A size that is not a positive whole number raises a ``ValueError``.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from crptpro.modules.precision import linear_in
from crptpro.values import as_int

WeightInit = Literal["orthogonal", "kaiming"]


@torch.no_grad()
def init_weights_(layer: nn.Linear | nn.Conv2d, init: WeightInit = "orthogonal", gain: float = 1.0) -> None:
    """Set a kernel orthogonal when flattened, times ``gain``, or normal of variance 2 / fan-in; and zero bias."""
    if init not in get_args(WeightInit):
        raise ValueError(f"init must be one of {', '.join(get_args(WeightInit))}, got {init!r}.")
    if init == "kaiming":
        nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    else:
        nn.init.orthogonal_(layer.weight, gain=gain)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)


def plain_sizes(**sizes: Any) -> dict[str, int]:
    """Return sizes as plain positive integers, which JSON can hold."""
    return {name: as_int(value, name, minimum=1) for name, value in sizes.items()}


class LinearNetwork(nn.Module):
    """Linear layers, initialised by ``init`` with gain 1 and zero biases; LayerNorms start as the identity."""

    init: WeightInit = "orthogonal"
    config: dict[str, Any]

    def __init__(self, **sizes: Any) -> None:
        super().__init__()
        self.config = dict(plain_sizes(**sizes))

    def reset_parameters(self) -> None:
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                init_weights_(layer, self.init)
            elif isinstance(layer, nn.LayerNorm):
                layer.reset_parameters()


class Projector(LinearNetwork):
    r"""One linear layer from features to latents of length D, :math:`g_\theta` (denisyarats/proto ``proto.py``).

    The product runs in ``compute_dtype``; the result has the parameters' dtype. ATC uses ``init="kaiming"`` (normal,
    fan-in, for ReLU).
    """

    def __init__(self, feature_dim: int = 39_200, latent_dim: int = 128, init: WeightInit = "orthogonal") -> None:
        super().__init__(feature_dim=feature_dim, latent_dim=latent_dim)
        self.linear = nn.Linear(*self.config.values())
        self.config["init"] = self.init = init
        self.compute_dtype = torch.float32
        self.reset_parameters()

    def forward(self, features: Tensor) -> Tensor:
        """Project ``[*, feature_dim]`` (any floating dtype) to ``[*, D]``, not normalised."""
        return linear_in(features, self.linear, self.compute_dtype)


class Predictor(LinearNetwork):
    r"""Perceptron in the latent space ``[*, D]``, online only: :math:`v_\psi` (denisyarats/proto ``proto.py``)."""

    def __init__(self, latent_dim: int = 128, hidden_dim: int = 1024) -> None:
        super().__init__(latent_dim=latent_dim, hidden_dim=hidden_dim)
        latent_dim, hidden_dim = self.config.values()
        self.hidden = nn.Linear(latent_dim, hidden_dim)
        self.output = nn.Linear(hidden_dim, latent_dim)
        self.reset_parameters()

    def forward(self, latents: Tensor) -> Tensor:
        return self.output(F.relu(self.hidden(latents)))


class Prototypes(nn.Module):
    """M trainable vectors of length D, of which only the direction counts (the idea is SwaV's, arXiv 2006.09882).

    Orthogonal initialisation (a tight frame when M > D). :meth:`normalize_` before every update keeps the rows at unit
    length, as in liuxin0824/CRPTpro ``proto.py``; losses read :meth:`unit_weight`.
    """

    def __init__(self, num_prototypes: int = 512, latent_dim: int = 128) -> None:
        super().__init__()
        self.config = plain_sizes(num_prototypes=num_prototypes, latent_dim=latent_dim)
        self.weight = nn.Parameter(torch.empty(*self.config.values()))
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        nn.init.orthogonal_(self.weight)
        self.normalize_()

    @torch.no_grad()
    def normalize_(self) -> Prototypes:
        """Scale every row to unit length in place, outside autograd. Returns self."""
        self.weight.copy_(F.normalize(self.weight, dim=-1))
        return self

    def unit_weight(self) -> Tensor:
        """Return the rows at unit length ``[M, D]``; as in the released code, the length is a constant to autograd."""
        return self.weight / self.weight.detach().norm(dim=-1, keepdim=True).clamp_min(1e-12)

    def forward(self, latents: Tensor) -> Tensor:
        """Cosine scores ``[*, M]`` in [-1, 1] of l2-normalised latents ``[*, D]``."""
        return F.linear(latents, self.unit_weight())


class AnchorHead(nn.Module):
    r"""ATC's head on the anchors, :math:`W(a + \mathrm{MLP}(a))`, online branch only, with PyTorch's initialisation.

    Source: astooke/rlpyt ``rlpyt/ul/models/ul/atc_models.py`` (ATC, arXiv 2009.08319).
    """

    def __init__(self, latent_dim: int = 128, hidden_dim: int = 512) -> None:
        super().__init__()
        self.config = plain_sizes(latent_dim=latent_dim, hidden_dim=hidden_dim)
        latent_dim, hidden_dim = self.config.values()
        self.hidden = nn.Linear(latent_dim, hidden_dim)
        self.output = nn.Linear(hidden_dim, latent_dim)
        self.bilinear = nn.Linear(latent_dim, latent_dim, bias=False)

    def forward(self, anchors: Tensor) -> Tensor:
        """Map latents ``[*, D]`` to ``[*, D]``, not normalised."""
        return self.bilinear(anchors + self.output(F.relu(self.hidden(anchors))))


class SkillHead(LinearNetwork):
    """BeCL's head: embedding of the features, then projection (Rooshy-yang/BeCL ``agent/becl.py``, arXiv 2305.04477).

    D is the number of skills in the source. Only the product with the features runs in ``compute_dtype``.
    """

    def __init__(self, feature_dim: int = 39_200, latent_dim: int = 16, hidden_dim: int = 1024) -> None:
        super().__init__(feature_dim=feature_dim, latent_dim=latent_dim, hidden_dim=hidden_dim)
        feature_dim, latent_dim, hidden_dim = self.config.values()
        self.embed_input = nn.Linear(feature_dim, hidden_dim)
        self.embed_hidden = nn.Linear(hidden_dim, hidden_dim)
        self.embed_output = nn.Linear(hidden_dim, latent_dim)
        self.project_hidden = nn.Linear(latent_dim, hidden_dim)
        self.project_output = nn.Linear(hidden_dim, latent_dim)
        self.compute_dtype = torch.float32
        self.reset_parameters()

    def forward(self, features: Tensor) -> Tensor:
        """Map features ``[*, feature_dim]`` (any floating dtype) to ``[*, D]``, not normalised."""
        hidden = F.relu(linear_in(features, self.embed_input, self.compute_dtype))
        embedding = self.embed_output(F.relu(self.embed_hidden(hidden)))
        return self.project_output(F.relu(self.project_hidden(embedding)))


def latent_dim_of(head: nn.Module) -> int | None:
    """Return the latent length D in the ``config`` of a head, or None."""
    config = getattr(head, "config", None)
    return config.get("latent_dim") if isinstance(config, dict) else None


def require_one_latent_dim(**heads: nn.Module) -> None:
    """Require that all heads with a known latent length share it."""
    dims = {name: dim for name, head in heads.items() if (dim := latent_dim_of(head)) is not None}
    if len(set(dims.values())) > 1:
        found = ", ".join(f"{name} {dim}" for name, dim in dims.items())
        raise ValueError(f"The heads must share one latent length, got {found}; pass latent_dim= for the others.")
