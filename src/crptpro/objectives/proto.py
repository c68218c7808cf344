"""CRPTpro's self-supervised loss: prototype prediction across one time step, and prototype dispersion."""

from __future__ import annotations

from typing import ClassVar, cast

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams, dispatch
from torch import Tensor, nn

from crptpro.modules import Predictor, Projector, Prototypes
from crptpro.modules.heads import require_one_latent_dim
from crptpro.objectives import metrics
from crptpro.objectives.base import PretrainingLoss
from crptpro.objectives.functional import (
    DispersionReduction,
    comparative_loss,
    prototype_dispersion,
    sinkhorn_knopp,
)


class ProtoLoss(PretrainingLoss):
    r"""Prototype representation learning of CRPTpro (arXiv 2302.05614; liuxin0824/CRPTpro ``proto.py``).

    :math:`L = L_{comp} + \alpha L_{intr}` with

    * :math:`\hat u = v_\psi(g_\theta(f_\theta(x_t)))/\|\cdot\|`,
      :math:`\hat z' = g_{\bar\theta}(f_{\bar\theta}(x_{t+1}))/\|\cdot\|` (no gradient),
    * :math:`L_{comp} = -\frac1B\sum_i q_i\cdot\log\mathrm{softmax}(\hat u_i C^T/\tau)`,
      :math:`q = \mathrm{sinkhorn}(\hat z' C^T)` (no gradient),
    * :math:`L_{intr}` = :func:`~crptpro.objectives.functional.prototype_dispersion` of the prototypes.

    ``loss_comp`` that stays at ln M (6.238 for 512 prototypes), or ``embedding_cosine`` that stays near 1, is
    a dead run. Images must already be augmented. Normalisation, softmax and Sinkhorn always run in float32 or
    wider. Non-finite weights or latents propagate to the loss; the training loop raises
    :class:`~crptpro.errors.NonFiniteError`. A batch of one is legal and uninformative (uniform assignments).

    Call :meth:`before_update` before each forward of a training loop: it keeps the prototype rows at unit
    length, as the released code does in place. ``forward`` itself never writes to a parameter.

    Args:
        encoder: images ``[B, C, H, W]`` to features ``[B, encoder.feature_dim]``.
        projector: features to latents ``[B, D]``; default ``Projector(encoder.feature_dim, latent_dim)``.
        predictor: latents to latents; default ``Predictor(latent_dim, hidden_dim)``.
        prototypes: default ``Prototypes(num_prototypes, latent_dim)``.
        num_prototypes: M.
        latent_dim: D.
        hidden_dim: predictor width; 1024 in the paper's table, 512 in the released code.
        intr_loss_coef: alpha, weight of the dispersion.
        offset: w, denominator offset of the dispersion.
        intr_reduction: ``"mean_all"`` (as published numbers), ``"sum"`` (as printed), ``"mean_offdiag"``.
        through_norm: differentiate the prototype normalisation (the released code does not).
        temperature: tau of the prediction.
        assignment_temperature: tau of the assignments; None follows ``temperature``.
        annealing_updates: calls of :meth:`before_update` over which the tau of the assignments moves in a straight
            line from ``assignment_temperature`` to ``temperature``, to stay there; None for a constant one.
            Deviation: the paper and the released code have one constant temperature.
        sinkhorn_iterations: scalings of the assignments.
        reduction: of ``loss_comp`` over the batch; ``loss_intr`` has no batch and stays a scalar.

    Raises:
        ValueError: a coefficient out of its range, heads of different latent lengths, or annealing from nowhere.

    Returns (``forward``):
        Scalars ``loss_comp`` and ``loss_intr`` (already times alpha; their sum is minimised) and, detached,
        ``comp``, ``intr`` (without alpha), ``assignment_entropy`` (nats), ``prototypes_in_use`` (count),
        ``embedding_cosine`` (mean pairwise cosine of the online latents), ``prototype_ane``.

    Examples:
        >>> from crptpro.modules import PixelEncoder
        >>> encoder = PixelEncoder(3, channels=(4, 4), strides=(2, 1), image_size=12)
        >>> loss = ProtoLoss(encoder, num_prototypes=8, latent_dim=4, hidden_dim=16)
        >>> pixels = torch.randint(0, 256, (6, 3, 12, 12), dtype=torch.uint8)
        >>> from torchrl.objectives import SoftUpdate
        >>> updater = SoftUpdate(loss, tau=0.05)
        >>> out = loss.before_update()(TensorDict({"pixels": pixels, "next": {"pixels": pixels}}, [6]))
        >>> (out["loss_comp"] + out["loss_intr"]).backward()
    """

    encoder: nn.Module
    encoder_params: TensorDictParams
    target_encoder_params: TensorDictParams
    projector: nn.Module
    projector_params: TensorDictParams
    target_projector_params: TensorDictParams
    predictor: nn.Module
    predictor_params: TensorDictParams
    target_predictor_params: TensorDictParams
    prototypes: Prototypes
    prototypes_params: TensorDictParams
    target_prototypes_params: TensorDictParams
    updates_begun: Tensor

    network_names: ClassVar[tuple[str, ...]] = ("encoder", "projector", "predictor", "prototypes")
    default_out_keys: ClassVar[tuple[str, ...]] = (
        "loss_comp",
        "loss_intr",
        "comp",
        "intr",
        "assignment_entropy",
        "prototypes_in_use",
        "embedding_cosine",
        "prototype_ane",
    )
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
        intr_reduction: DispersionReduction = "mean_all",
        through_norm: bool = False,
        temperature: float = 0.1,
        assignment_temperature: float | None = None,
        annealing_updates: int | None = None,
        sinkhorn_iterations: int = 3,
        reduction: str | None = None,
    ) -> None:
        super().__init__(reduction=reduction)
        _check_options(offset, intr_reduction, temperature, assignment_temperature, sinkhorn_iterations)
        _check_annealing(annealing_updates, assignment_temperature)
        if projector is None:
            projector = Projector(cast(int, encoder.feature_dim), latent_dim)
        if predictor is None:
            predictor = Predictor(latent_dim, hidden_dim)
        if prototypes is None:
            prototypes = Prototypes(num_prototypes, latent_dim)
        require_one_latent_dim(projector=projector, predictor=predictor, prototypes=prototypes)
        self.convert_to_functional(encoder, "encoder", create_target_params=True)
        self.convert_to_functional(projector, "projector", create_target_params=True)
        self.convert_to_functional(predictor, "predictor")
        self.convert_to_functional(prototypes, "prototypes")
        self.intr_reduction = intr_reduction
        self.through_norm = through_norm
        self.sinkhorn_iterations = sinkhorn_iterations
        self.annealing_updates = annealing_updates
        # float64 scalars: they do not promote float32 tensors, and 0.1 stays 0.1.
        self.register_coeff_buffer("intr_loss_coef", intr_loss_coef, dtype=torch.float64)
        self.register_coeff_buffer("offset", offset, dtype=torch.float64)
        self.register_coeff_buffer("temperature", temperature, dtype=torch.float64)
        self.register_coeff_buffer("assignment_temperature", assignment_temperature, dtype=torch.float64)
        if annealing_updates is not None:  # only then: other losses' checkpoints stay as they were
            self.register_buffer("updates_begun", torch.zeros((), dtype=torch.int64))

    def before_update(self) -> ProtoLoss:
        """Scale the prototype rows to unit length in place, outside autograd, and count the update if annealing.

        Returns self.
        """
        if self.annealing_updates is not None:
            self.updates_begun.add_(1)
        with self.prototypes_params.to_module(self.prototypes, preserve_module_state=False):
            self.prototypes.normalize_()
        return self

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss terms and diagnostics of one batch; see the class."""
        keys = self.tensor_keys
        pixels, next_pixels, valid, lead = self._read_images(
            tensordict, keys.observation, keys.next_observation
        )
        latents, predictions = self._online(pixels)
        targets = self._target(next_pixels)
        # The prototypes' precision from here on, also in a caller's autocast region or after a half-precision head.
        with torch.autocast(device_type=latents.device.type, enabled=False):
            unit = self._unit_prototypes()
            latents, predictions, targets = (x.to(unit.dtype) for x in (latents, predictions, targets))
            assignments = self._assign(targets, unit.detach())
            scores = F.normalize(predictions, dim=-1) @ unit.T  # (B, D) x (D, M) -> (B, M)
            rows = comparative_loss(scores, assignments, temperature=self.temperature, reduction="none")
            comp = self._reduce_rows(rows, valid, lead)
            intr = prototype_dispersion(unit, offset=self.offset, reduction=self.intr_reduction)
            out = {
                "loss_comp": comp,
                "loss_intr": (self.intr_loss_coef * intr).to(intr.dtype),
                "comp": comp.detach(),
                "intr": intr.detach(),
                "assignment_entropy": metrics.assignment_entropy(assignments),
                "prototypes_in_use": metrics.prototypes_in_use(assignments),
                "embedding_cosine": metrics.mean_pairwise_cosine(F.normalize(latents.detach(), dim=-1)),
                "prototype_ane": metrics.prototype_ane(unit.detach()),
            }
        return TensorDict(out, batch_size=[])

    def _online(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        latents = self._apply_network("projector", self._apply_network("encoder", pixels))
        return latents, self._apply_network("predictor", latents)

    @torch.no_grad()
    def _target(self, next_pixels: Tensor) -> Tensor:
        features = self._apply_network("encoder", next_pixels, target=True)
        return self._apply_network("projector", features, target=True)

    def _unit_prototypes(self) -> Tensor:
        with self.prototypes_params.to_module(self.prototypes, preserve_module_state=False):
            return self.prototypes.unit_weight(through_norm=self.through_norm)

    @torch.no_grad()
    def _assign(self, targets: Tensor, unit_prototypes: Tensor) -> Tensor:
        return sinkhorn_knopp(
            F.normalize(targets, dim=-1) @ unit_prototypes.T,
            temperature=self._assignment_temperature_now(),
            iterations=self.sinkhorn_iterations,
        )

    def _assignment_temperature_now(self) -> Tensor:
        """Tau of the assignments in the update that has begun; a tensor's arithmetic, so that it can be recorded."""
        first, last = self.assignment_temperature, self.temperature
        if first is None:
            return last
        if self.annealing_updates is None:
            return first
        # Update number u (from 0) has begun u + 1 times; exactly `last` at the end, as lerp is from weight 0.5 on.
        progress = ((self.updates_begun - 1) / self.annealing_updates).clamp(0, 1)
        return torch.lerp(first, last, progress.to(first.dtype))


def _check_options(
    offset: float,
    intr_reduction: str,
    temperature: float,
    assignment_temperature: float | None,
    sinkhorn_iterations: int,
) -> None:
    """Refuse values that would only show as NaN thousands of updates later."""
    if not offset > 1:
        raise ValueError(f"offset must exceed 1, the largest negative cosine, got {offset}.")
    if intr_reduction not in ("mean_all", "sum", "mean_offdiag"):
        raise ValueError(
            f"intr_reduction must be 'mean_all', 'sum' or 'mean_offdiag', got {intr_reduction!r}."
        )
    for name, value in (("temperature", temperature), ("assignment_temperature", assignment_temperature)):
        if value is not None and not value > 0:
            raise ValueError(f"{name} must be positive, got {value}.")
    if sinkhorn_iterations < 0:
        raise ValueError(f"sinkhorn_iterations must not be negative, got {sinkhorn_iterations}.")


def _check_annealing(annealing_updates: int | None, assignment_temperature: float | None) -> None:
    if annealing_updates is None:
        return
    if annealing_updates < 1:
        raise ValueError(f"annealing_updates must be at least 1, got {annealing_updates}.")
    if assignment_temperature is None:
        raise ValueError("annealing_updates needs an assignment_temperature to start from, such as 0.05.")
