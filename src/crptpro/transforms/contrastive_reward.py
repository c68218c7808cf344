"""The exploration bonus of BeCL: how well a new state tells the skill that led to it from the others."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.data.tensor_specs import Composite

from crptpro.objectives.functional import becl_loss
from crptpro.transforms.base import IntrinsicReward
from crptpro.values import as_float


class ContrastiveReward(IntrinsicReward):
    r"""Compute the skill-contrastive reward (BeCL, arXiv 2305.04477).

    .. math::
        \hat r_i = e^{-\ell_i} = \frac{\exp(f_i \cdot f_{p(i)} / T)}{\sum_{j \ne i} \exp(f_i \cdot f_j / T)}

    with :math:`f_i` the l2-normalised embeddings of a batch of next observations and p(i) the first other
    element with the same skill, or the first other one where nobody shares it: the loss that BeCL trains its
    embedding with (:func:`~crptpro.objectives.functional.becl_loss`), per row. Source: Rooshy-yang/BeCL
    ``agent/becl.py``. It lies in (0, 1]. Every call looks at its own batch only; nothing is kept.

    Works on replay batches (``forward``: features and rewards under ``"next"``, the skill at the root, where
    the transition's skill is also if the next observation is several steps ahead) and on environments, where
    the batch is what one step returns and the skill is read from what was given to the step: a vectorised
    environment of N is a batch of N. On a single environment that is one sample, which has nothing to be
    contrasted with: it earns 0. Skills that are part of an environment's observations are declared an input
    of its step, so that workers of a vectorised environment receive them. Nothing depends on training mode.

    Deviation: the published code fails on a batch of one.

    Args:
        head: maps features to the embedding; None if ``in_keys`` already names embeddings.
        coef: :math:`c` in :math:`r_\mathrm{ext} + c \hat r`; None writes :math:`\hat r` only.
        temperature: T.
        in_keys: one key, features ``[*, feature_dim]`` (or embeddings) of the next observation.
        out_keys: one key for :math:`\hat r`, of the reward's shape.
        skill_key: one-hot ``[*, K]``, the skill that acted; at the root also in replay batches.
        reward_key: :math:`r_\mathrm{ext}`, ``[*, 1]``, which the sum replaces.

    In an environment's step the entries are those without the leading ``"next"``.

    Raises:
        ValueError: a non-positive temperature, or more than one key.

    Examples:
        >>> from tensordict import TensorDict
        >>> bonus = ContrastiveReward(None)  # features that are embeddings already
        >>> skill = torch.eye(2)[[0, 0, 1, 1]]
        >>> batch = bonus(TensorDict({"skill": skill, "next": {"features": torch.randn(4, 3)}}, [4]))
        >>> batch["next", "intrinsic_reward"].shape
        torch.Size([4, 1])
    """

    head: nn.Module | None

    def __init__(
        self,
        head: nn.Module | None,
        *,
        coef: float | None = None,
        temperature: float = 0.5,
        in_keys: NestedKey | Sequence[NestedKey] = ("next", "features"),
        out_keys: NestedKey | Sequence[NestedKey] = ("next", "intrinsic_reward"),
        skill_key: NestedKey = "skill",
        reward_key: NestedKey = ("next", "reward"),
    ) -> None:
        temperature = as_float(temperature, "temperature")
        if not temperature > 0:
            raise ValueError(f"`temperature` must be positive, got {temperature}.")
        super().__init__({"head": head}, coef=coef, in_keys=in_keys, out_keys=out_keys, reward_key=reward_key)
        self.temperature = temperature
        self.skill_key = unravel_key(skill_key)

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

    def _intrinsic_reward(self, features: Tensor, root: TensorDictBase) -> Tensor:
        skills = root.get(self.skill_key, None)
        if skills is None:
            present = list(root.keys(True, True))
            raise KeyError(
                f"ContrastiveReward found no {self.skill_key!r} among {present}; set skill_key, or let the "
                "policy or the environment write the skill before the step."
            )
        return self.intrinsic_reward(features, skills.reshape(len(features), -1))

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Declare a skill that the environment observes an input of its step."""
        parent = self.parent
        observed = None if parent is None else parent.full_observation_spec.get(self.skill_key, None)
        if observed is not None and self.skill_key not in state_spec.keys(True, True):
            state_spec[self.skill_key] = observed.clone()
        return state_spec
