"""The exploration bonus of BeCL: how well a new state tells the skill that led to it from the others."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.data.tensor_specs import Composite

from crptpro.objectives.functional import becl_loss
from crptpro.transforms.intrinsic_reward import IntrinsicReward


class SkillContrastReward(IntrinsicReward):
    r"""Add the skill-contrastive bonus to the reward (BeCL, arXiv 2305.04477).

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
    of its step, so that workers of a vectorised environment receive them. Sampling leaves stored rewards as
    they are; see :meth:`forward` for the one way of reading a buffer that does not. Nothing depends on
    training mode.

    Deviation: the published code fails on a batch of one.

    Args:
        head: maps features to the embedding; None if ``in_keys`` already names embeddings.
        temperature: T.
        intrinsic_reward_coef: :math:`\beta` in :math:`r_\mathrm{ext} + \beta \hat r`.
        in_keys: one key, features ``[*, feature_dim]`` (or embeddings) of the next observation.
        out_keys: one key for :math:`\hat r`, of the reward's shape.
        skill_key: one-hot ``[*, K]``, the skill that acted; at the root also in replay batches.
        reward_key: :math:`r_\mathrm{ext}`, ``[*, 1]``; None writes :math:`\hat r` only.
        out_reward_key: where :math:`r_\mathrm{ext} + \beta \hat r` goes; ``reward_key`` when None.

    The other keys name entries of an environment's step; in replay batches they are read and written under
    ``"next"``. A leading ``"next"`` in them is therefore ignored.

    Raises:
        ValueError: a non-positive temperature, or more than one key.

    Examples:
        >>> from tensordict import TensorDict
        >>> bonus = SkillContrastReward(None, reward_key=None)  # features that are embeddings already
        >>> skill = torch.eye(2)[[0, 0, 1, 1]]
        >>> batch = bonus(TensorDict({"skill": skill, "next": {"features": torch.randn(4, 3)}}, [4]))
        >>> batch["next", "intrinsic_reward"].shape
        torch.Size([4, 1])
    """

    def __init__(
        self,
        head: nn.Module | None,
        *,
        temperature: float = 0.5,
        intrinsic_reward_coef: float = 0.2,
        in_keys: NestedKey | Sequence[NestedKey] = "features",
        out_keys: NestedKey | Sequence[NestedKey] = "intrinsic_reward",
        skill_key: NestedKey = "skill",
        reward_key: NestedKey | None = "reward",
        out_reward_key: NestedKey | None = None,
    ) -> None:
        if temperature <= 0:
            raise ValueError(f"temperature must be positive, got {temperature}.")
        super().__init__(
            intrinsic_reward_coef=intrinsic_reward_coef,
            in_keys=in_keys,
            out_keys=out_keys,
            reward_key=reward_key,
            out_reward_key=out_reward_key,
        )
        self.head = head
        self.temperature = temperature
        self.skill_key = unravel_key(skill_key)

    @torch.no_grad()
    def intrinsic_reward(self, features: Tensor, skills: Tensor) -> Tensor:
        r"""Return the bonus before :math:`\beta`.

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

    def _bonus(self, features: Tensor, root: TensorDictBase) -> Tensor:
        skills = root.get(self.skill_key, None)
        if skills is None:
            present = list(root.keys(True, True))
            raise KeyError(
                f"SkillContrastReward found no {self.skill_key!r} among {present}; set skill_key, or let the "
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
