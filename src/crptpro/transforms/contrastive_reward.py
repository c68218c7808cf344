"""The exploration bonus of BeCL: how well a new state tells the skill that led to it from the others."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from crptpro.objectives.base import require_positive
from crptpro.objectives.functional import becl_loss
from crptpro.transforms.base import IntrinsicReward, read_entry


class ContrastiveReward(IntrinsicReward):
    r"""Compute the skill-contrastive reward (BeCL, arXiv 2305.04477; Rooshy-yang/BeCL ``agent/becl.py``).

    .. math::
        \hat r_i = e^{-\ell_i} = \frac{\exp(f_i \cdot f_{p(i)} / T)}{\sum_{j \ne i} \exp(f_i \cdot f_j / T)}

    with :math:`f_i` the l2-normalised embeddings of a batch of next observations and p(i) the first other
    element with the same skill, or the first other one where nobody shares it: the loss that BeCL trains its
    embedding with (:func:`~crptpro.objectives.functional.becl_loss`), per row. It lies in (0, 1].

    Deviation: the published code fails on a batch of one; here that has nothing to be contrasted with and earns 0.

    Args:
        head: maps features to the embedding; None if ``in_keys`` already names embeddings.
        temperature: T.
        skill_key: one-hot ``[*, K]``, the skill that acted, at the root.
        **options: ``coef``, ``in_keys``, ``out_keys`` and ``reward_key`` of
            :class:`~crptpro.transforms.base.IntrinsicReward`.

    Raises:
        ValueError: a non-positive temperature, or more than one key.
    """

    head: nn.Module | None

    def __init__(
        self,
        head: nn.Module | None,
        *,
        temperature: float = 0.5,
        skill_key: NestedKey = "skill",
        **options: Any,
    ) -> None:
        require_positive(temperature=temperature)
        super().__init__({"head": head}, **options)
        self.temperature = float(temperature)
        self.skill_key = skill_key

    @torch.no_grad()
    def intrinsic_reward(self, features: Tensor, skills: Tensor) -> Tensor:
        """Return the reward before the coefficient.

        Args:
            features: ``[B, feature_dim]``, or embeddings without a head; any floating dtype.
            skills: one-hot ``[B, K]``.

        Returns:
            float32 ``[B]``, in (0, 1]; 0 for a batch of one.
        """
        embeddings = (features if self.head is None else self.head(features)).float()
        if len(embeddings) < 2:
            return embeddings.new_zeros(len(embeddings))
        indices = skills.argmax(dim=-1)
        return becl_loss(embeddings, indices, temperature=self.temperature, reduction="none").neg().exp()

    def _intrinsic_reward(self, features: Tensor, tensordict: TensorDictBase) -> Tensor:
        skills = read_entry(self, tensordict, self.skill_key)
        return self.intrinsic_reward(features, skills.reshape(len(features), -1))
