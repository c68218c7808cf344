"""Contrastive losses: the positives are successors in ATC, second views in SimCLR (APT), the same skill in BeCL."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor, nn

from crptpro.modules import AnchorHead, Projector, SkillHead
from crptpro.modules.heads import latent_dim_of, require_one_latent_dim
from crptpro.objectives.base import PretrainingLoss, require_positive, skills_of
from crptpro.objectives.functional import becl_loss, info_nce, mean_pairwise_cosine


class ContrastiveLoss(PretrainingLoss):
    """Returns ``loss_contrast`` (nats) and, detached, ``embedding_cosine`` (pairwise mean) of augmented images."""

    default_out_keys = ("loss_contrast", "embedding_cosine")

    def _contrast(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return the loss, and latents at unit length."""
        raise NotImplementedError

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        loss, unit = self._contrast(tensordict)
        out = {"loss_contrast": loss, "embedding_cosine": mean_pairwise_cosine(unit.detach())}
        return TensorDict(out, batch_size=[])


class ATCLoss(ContrastiveLoss):
    r"""Augmented temporal contrast (ATC, arXiv 2009.08319; astooke/rlpyt ``ul/algos/ul_for_rl``).

    With anchors :math:`a = g_\theta(f_\theta(x_t))` and positives
    :math:`p = g_{\bar\theta}(f_{\bar\theta}(x_{t+1}))` (no gradient), neither normalised,

    .. math:: L = -\frac1B\sum_i \log\mathrm{softmax}_j\big(W(a_i + \mathrm{MLP}(a_i))\cdot p_j\big)_i .

    A loss of ln B (6.238 for a batch of 512) is chance. The source masks the ends of episodes; here ``("next",
    "pixels")`` is the true successor also there. The default heads are a ``Projector`` with ATC's Kaiming-normal
    weights and an ``AnchorHead``; heads of different latent lengths raise a ``ValueError``.
    """

    anchor_head: nn.Module

    def __init__(
        self,
        encoder: nn.Module,
        *,
        projector: nn.Module | None = None,
        anchor_head: nn.Module | None = None,
        latent_dim: int = 128,
        hidden_dim: int = 512,
    ) -> None:
        super().__init__()
        projector = projector or Projector(cast(int, encoder.feature_dim), latent_dim, init="kaiming")
        anchor_head = anchor_head or AnchorHead(latent_dim, hidden_dim)
        require_one_latent_dim(projector=projector, anchor_head=anchor_head)
        self._convert(("encoder", "projector"), encoder=encoder, projector=projector, anchor_head=anchor_head)
        # Recorded in the card of an artifact.
        self.latent_dim = latent_dim_of(anchor_head) or latent_dim
        self.hidden_dim = getattr(anchor_head, "config", {}).get("hidden_dim", hidden_dim)

    def _contrast(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        anchors = self._latents(self._read(tensordict, self.tensor_keys.observation))
        positives = self._target_latents(self._read(tensordict, self.tensor_keys.next_observation))
        queries = self.anchor_head(anchors)
        with torch.autocast(queries.device.type, enabled=False):
            return info_nce(queries, positives.to(queries.dtype)), F.normalize(anchors.detach(), dim=-1)


class SimCLRLoss(ContrastiveLoss):
    r"""Contrast of two independently shifted views, without target network (APT, arXiv 2103.04551).

    Views :math:`z = g_\theta(f_\theta(\cdot))/\|\cdot\|` of both images of B observations; each of the 2B has the
    other view of its observation as positive and the remaining 2B - 2 as negatives:

    .. math:: L = -\frac1{2B}\sum_i \log\frac{\exp(z_i\cdot z_{p(i)}/\tau)}{\sum_{j\ne i}\exp(z_i\cdot z_j/\tau)} .

    Deviation: APT has published no code for DeepMind Control; loss and temperature are those of the authors' code
    for Atari, the head (a ``Projector``) is that of the other methods here.
    """

    @dataclass
    class _AcceptedKeys:
        observation: NestedKey = "pixels"  # images
        observation_view: NestedKey = "pixels_view"  # the same images, augmented independently

    default_keys = _AcceptedKeys
    _schedulable_buffers = frozenset({"temperature"})

    def __init__(
        self,
        encoder: nn.Module,
        *,
        projector: nn.Module | None = None,
        latent_dim: int = 128,
        temperature: float = 0.07,
    ) -> None:
        super().__init__()
        require_positive(temperature=temperature)
        projector = projector or Projector(cast(int, encoder.feature_dim), latent_dim)
        self._convert(encoder=encoder, projector=projector)
        self.latent_dim = latent_dim_of(projector) or latent_dim
        self._register_coefficients(temperature=temperature)

    @property
    def views(self) -> dict[NestedKey, NestedKey]:
        return {self.tensor_keys.observation_view: self.tensor_keys.observation}

    def _contrast(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        keys = (self.tensor_keys.observation, self.tensor_keys.observation_view)
        latents = self._latents(torch.cat([self._read(tensordict, key) for key in keys]))
        with torch.autocast(latents.device.type, enabled=False):
            one, two = F.normalize(latents, dim=-1).chunk(2)
            return info_nce(one, two, temperature=self.temperature, negatives="both"), one


class BeCLLoss(ContrastiveLoss):
    r"""Behaviour contrastive learning (BeCL, arXiv 2305.04477; Rooshy-yang/BeCL ``agent/becl.py``).

    :func:`~crptpro.objectives.functional.becl_loss` of :math:`h(f_\theta(x'))`, where :math:`x'` is the next
    observation (three agent steps ahead in the method's n-step batches) and the head h is ``projector``, by default a
    ``SkillHead``. All rows should come from one domain, where skills are comparable. A batch of one has the loss 0.
    """

    @dataclass
    class _AcceptedKeys:
        next_observation: NestedKey = ("next", "pixels")  # images that the skill led to
        skill: NestedKey = "skill"  # one-hot [B, K]

    default_keys = _AcceptedKeys
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
        projector = projector or SkillHead(cast(int, encoder.feature_dim), skill_dim, hidden_dim)
        self._convert(encoder=encoder, projector=projector)
        self.skill_dim = latent_dim_of(projector) or skill_dim
        self._register_coefficients(temperature=temperature)

    def _contrast(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        latents = self._latents(self._read(tensordict, self.tensor_keys.next_observation))
        skills = skills_of(self._read(tensordict, self.tensor_keys.skill, event_dims=1), len(latents))
        with torch.autocast(latents.device.type, enabled=False):
            unit = F.normalize(latents.detach(), dim=-1)
            if len(latents) < 2:
                return 0 * latents.sum(), unit
            return becl_loss(latents, skills, temperature=self.temperature), unit
