"""Augmented temporal contrast: tell an observation's successor from those of other observations."""

from __future__ import annotations

from typing import Any, cast

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import nn

from crptpro.modules import AnchorHead, Projector
from crptpro.modules.heads import latent_dim_of, require_one_latent_dim
from crptpro.objectives.base import PretrainingLoss
from crptpro.objectives.functional import info_nce, mean_pairwise_cosine


class ATCLoss(PretrainingLoss):
    r"""Augmented temporal contrast (ATC, arXiv 2009.08319; astooke/rlpyt ``ul/algos/ul_for_rl``).

    With anchors :math:`a = g_\theta(f_\theta(x_t))` and positives
    :math:`p = g_{\bar\theta}(f_{\bar\theta}(x_{t+1}))` (no gradient), neither normalised,

    .. math:: L = -\frac1B\sum_i \log\mathrm{softmax}_j\big(W(a_i + \mathrm{MLP}(a_i))\cdot p_j\big)_i .

    There is no temperature. A loss that stays at ln B (6.238 for a batch of 512) says that anchors are not told
    apart. Images must already be augmented, each independently. In TorchRL batches ``("next", "pixels")`` is the
    true successor, so ends of episodes need no mask as in the source.

    Args:
        encoder: images ``[B, C, H, W]`` to features ``[B, encoder.feature_dim]``.
        projector: features to latents ``[B, D]``; default ``Projector(encoder.feature_dim, latent_dim)`` with ATC's
            Kaiming-normal weights.
        anchor_head: latents of anchors to ``[B, D]``; default ``AnchorHead(latent_dim, hidden_dim)``.
        latent_dim: D.
        hidden_dim: width of the anchors' perceptron.

    Raises:
        ValueError: heads of different latent lengths.

    Returns (``forward``):
        Scalar ``loss_contrast`` (nats) and, detached, ``embedding_cosine`` (mean pairwise cosine of the anchors'
        latents).
    """

    anchor_head: nn.Module
    anchor_head_params: Any
    target_anchor_head_params: Any

    network_names = ("encoder", "projector", "anchor_head")
    default_out_keys = ("loss_contrast", "embedding_cosine")

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
        if projector is None:
            projector = Projector(cast(int, encoder.feature_dim), latent_dim, init="kaiming")
        if anchor_head is None:
            anchor_head = AnchorHead(latent_dim, hidden_dim)
        require_one_latent_dim(projector=projector, anchor_head=anchor_head)
        self.convert_to_functional(encoder, "encoder", create_target_params=True)
        self.convert_to_functional(projector, "projector", create_target_params=True)
        self.convert_to_functional(anchor_head, "anchor_head")
        # What an artifact's card needs to build the anchor head again.
        self.latent_dim = latent_dim_of(anchor_head) or latent_dim
        self.hidden_dim = getattr(anchor_head, "config", {}).get("hidden_dim", hidden_dim)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss and diagnostics of one batch; see the class."""
        anchors = self._latents(self._read(tensordict, self.tensor_keys.observation))
        positives = self._target_latents(self._read(tensordict, self.tensor_keys.next_observation))
        queries = self._apply_network("anchor_head", anchors)
        with torch.autocast(device_type=queries.device.type, enabled=False):
            out = {
                "loss_contrast": info_nce(queries, positives.to(queries.dtype)),
                "embedding_cosine": mean_pairwise_cosine(F.normalize(anchors.detach(), dim=-1)),
            }
        return TensorDict(out, batch_size=[])
