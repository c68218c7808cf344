"""CRPTpro's self-supervised loss: prototype prediction across one time step, and prototype dispersion."""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import nn

from crptpro.modules import Predictor, Projector, Prototypes
from crptpro.modules.heads import require_one_latent_dim
from crptpro.objectives import functional
from crptpro.objectives.base import PretrainingLoss, require_positive
from crptpro.values import as_float, as_int


class ProtoLoss(PretrainingLoss):
    r"""Prototype representation learning of CRPTpro (arXiv 2302.05614; liuxin0824/CRPTpro ``proto.py``).

    :math:`L = L_{comp} + \alpha L_{intr}` with

    * :math:`\hat u = v_\psi(g_\theta(f_\theta(x_t)))/\|\cdot\|`,
      :math:`\hat z' = g_{\bar\theta}(f_{\bar\theta}(x_{t+1}))/\|\cdot\|` (no gradient),
    * :math:`L_{comp} = -\frac1B\sum_i q_i\cdot\log\mathrm{softmax}(\hat u_i C^T/\tau)`,
      :math:`q = \mathrm{sinkhorn}(\hat z' C^T)` (no gradient),
    * :math:`L_{intr}` = :func:`~crptpro.objectives.functional.prototype_dispersion` of the prototypes.

    Images must already be augmented. A training loop calls :meth:`before_update` before each forward.

    ``forward`` returns scalars ``loss_comp`` and ``loss_intr`` (already times alpha; their sum is minimised) and,
    detached, ``comp``, ``intr`` (without alpha), ``assignment_entropy`` (nats), ``prototypes_in_use`` (count),
    ``embedding_cosine`` (mean pairwise cosine of the online latents), ``prototype_ane``. A ``loss_comp`` that stays at
    ln M (6.238 for 512 prototypes), or an ``embedding_cosine`` that stays near 1, is a collapse.

    The predictor's ``hidden_dim`` is 1024 in the paper's table, 512 in the released code. ``intr_loss_coef`` is alpha,
    and ``assignment_temperature`` replaces tau in the assignments. A coefficient out of its range, or heads of
    different latent lengths, raise a ``ValueError``.
    """

    predictor: nn.Module
    prototypes: Prototypes

    default_out_keys = (
        "loss_comp", "loss_intr", "comp", "intr", "assignment_entropy", "prototypes_in_use", "embedding_cosine",
        "prototype_ane",
    )  # fmt: skip
    _schedulable_buffers = frozenset({"intr_loss_coef", "offset", "temperature", "assignment_temperature"})

    def __init__(
        self,
        encoder: nn.Module,
        *,
        projector: nn.Module | None = None,
        predictor: nn.Module | None = None,
        prototypes: Prototypes | None = None,
        num_prototypes: int = 512,
        latent_dim: int = 128,
        hidden_dim: int = 1024,
        intr_loss_coef: float = 5e-3,
        offset: float = 1.5,
        temperature: float = 0.1,
        assignment_temperature: float | None = None,
        sinkhorn_iterations: int = 3,
    ) -> None:
        super().__init__()
        offset = as_float(offset, "offset")
        if not offset > 1:
            raise ValueError(f"`offset` must exceed 1, the largest negative cosine, got {offset}.")
        temperature, intr_loss_coef = as_float(temperature, "temperature"), as_float(intr_loss_coef, "intr_loss_coef")
        require_positive(temperature=temperature, assignment_temperature=assignment_temperature)
        projector = projector or Projector(cast(int, encoder.feature_dim), latent_dim)
        predictor = predictor or Predictor(latent_dim, hidden_dim)
        prototypes = prototypes or Prototypes(num_prototypes, latent_dim)
        require_one_latent_dim(projector=projector, predictor=predictor, prototypes=prototypes)
        self._convert(
            ("encoder", "projector"), encoder=encoder, projector=projector, predictor=predictor, prototypes=prototypes
        )
        self.sinkhorn_iterations = as_int(sinkhorn_iterations, "sinkhorn_iterations", minimum=0)
        self._register_coefficients(
            intr_loss_coef=intr_loss_coef, offset=offset, temperature=temperature,
            assignment_temperature=assignment_temperature,
        )  # fmt: skip

    def before_update(self) -> ProtoLoss:
        """Scale the prototype rows to unit length in place, as the released code does. Returns self."""
        self.prototypes.normalize_()
        return self

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        latents = self._latents(self._read(tensordict, self.tensor_keys.observation))
        predictions = self.predictor(latents)
        targets = self._target_latents(self._read(tensordict, self.tensor_keys.next_observation))
        # From here on in the precision of the prototypes, also under autocast or after a half-precision head.
        with torch.autocast(latents.device.type, enabled=False):
            unit = self.prototypes.unit_weight()
            latents, predictions, targets = (x.to(unit.dtype) for x in (latents, predictions, targets))
            assignments = functional.sinkhorn_knopp(
                F.normalize(targets, dim=-1) @ unit.detach().T,
                temperature=self.temperature if self.assignment_temperature is None else self.assignment_temperature,
                iterations=self.sinkhorn_iterations,
            )
            scores = F.normalize(predictions, dim=-1) @ unit.T  # (B, D) x (D, M) -> (B, M)
            comp = functional.comparative_loss(scores, assignments, temperature=self.temperature)
            intr = functional.prototype_dispersion(unit, offset=self.offset)
            unit_latents = F.normalize(latents.detach(), dim=-1)
            out = {
                "loss_comp": comp,
                "loss_intr": (self.intr_loss_coef * intr).to(intr.dtype),
                "comp": comp.detach(),
                "intr": intr.detach(),
                "assignment_entropy": functional.assignment_entropy(assignments),
                "prototypes_in_use": functional.prototypes_in_use(assignments),
                "embedding_cosine": functional.mean_pairwise_cosine(unit_latents),
                "prototype_ane": functional.prototype_ane(unit.detach()),
            }
        return TensorDict(out, batch_size=[])
