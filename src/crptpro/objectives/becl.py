"""BeCL's representation loss: observations reached with the same skill belong together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import nn

from crptpro.modules import SkillHead
from crptpro.modules.heads import latent_dim_of
from crptpro.objectives.base import PretrainingLoss, require_positive
from crptpro.objectives.functional import becl_loss, mean_pairwise_cosine


class BeCLLoss(PretrainingLoss):
    r"""Behaviour contrastive learning (BeCL, arXiv 2305.04477; Rooshy-yang/BeCL ``agent/becl.py``).

    :func:`~crptpro.objectives.functional.becl_loss` of :math:`F = h(f_\theta(x'))` with the head h of
    :class:`~crptpro.modules.SkillHead`: for every row, one other row of the same skill is told from all other
    rows. :math:`x'` is the next observation (three agent steps ahead with the method's n-step batches). The
    gradient reaches encoder and head; there is no target network. All rows should come from one domain, where
    skills are comparable. A batch of one is legal and uninformative (loss 0).

    Args:
        encoder: images ``[B, C, H, W]`` to features ``[B, encoder.feature_dim]``.
        projector: the whole head, features to ``[B, D]``; default
            ``SkillHead(encoder.feature_dim, skill_dim, hidden_dim)``.
        skill_dim: D, equal to the number of skills in the source.
        hidden_dim: hidden width of the default head.
        temperature: tau, divides the cosines; positive.

    Raises:
        ValueError: a temperature that is not positive.

    Returns (``forward``):
        Scalar ``loss_contrast`` (nats) and, detached, ``embedding_cosine`` (mean pairwise cosine of F).
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can change.

        Attributes:
            next_observation: images that the skill led to.
            skill: one-hot skills ``[B, K]``, floating.
        """

        next_observation: NestedKey = ("next", "pixels")
        skill: NestedKey = "skill"

    default_keys = _AcceptedKeys  # type: ignore[assignment]
    tensor_keys: _AcceptedKeys  # type: ignore[assignment]

    network_names = ("encoder", "projector")
    default_out_keys = ("loss_contrast", "embedding_cosine")
    _schedulable_buffers = frozenset({"temperature"})

    def __init__(
        self,
        encoder: nn.Module,
        *,
        projector: nn.Module | None = None,
        skill_dim: int = 16,
        hidden_dim: int = 1024,
        temperature: float = 0.5,
    ) -> None:
        super().__init__()
        require_positive(temperature=temperature)
        if projector is None:
            projector = SkillHead(cast(int, encoder.feature_dim), skill_dim, hidden_dim)
        self.convert_to_functional(encoder, "encoder")
        self.convert_to_functional(projector, "projector")
        self.skill_dim = latent_dim_of(projector) or skill_dim
        self._register_coefficients(temperature=temperature)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss and diagnostics of one batch; see the class."""
        latents = self._latents(self._read(tensordict, self.tensor_keys.next_observation))
        skills = self._read(tensordict, self.tensor_keys.skill, event_dims=1).argmax(dim=-1)
        with torch.autocast(device_type=latents.device.type, enabled=False):
            if latents.shape[0] < 2:
                contrast = 0 * latents.sum()  # nothing to contrast with
            else:
                contrast = becl_loss(latents, skills, temperature=self.temperature)
            out = {
                "loss_contrast": contrast,
                "embedding_cosine": mean_pairwise_cosine(F.normalize(latents.detach(), dim=-1)),
            }
        return TensorDict(out, batch_size=[])
