"""SAC averaged over two augmented views of every observation, on features (DrQ's K = M = 2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from tensordict import NestedKey

from crptpro.modules import PixelCritic, SquashedGaussianActor, TwinCritic
from crptpro.objectives.rad_sac import RADSACLoss


class AveragedSACLoss(RADSACLoss):
    r""":class:`RADSACLoss` with two views of each observation (DrQ, arXiv 2004.13649, K = M = 2).

    With :math:`h_m, h_m'` the features of view m of an observation and the next, each with its own
    :math:`a_m' \sim \pi(h_m')`:

    * :math:`y = \frac12 \sum_m [r + \gamma (1-\mathrm{terminated}) (\min(Q_1', Q_2')(h_m', a_m') - \alpha
      \log\pi(a_m'|h_m'))]`
    * ``loss_qvalue`` = :math:`\sum_m` (MSE(Q1, y) + MSE(Q2, y)), a sum and not a mean over the views, as in
      denisyarats/drq ``drq.py``;
    * ``loss_actor`` and ``loss_alpha`` on the first view.

    The exploration agent of APT learns with it on detached features (forhaoliu/mini_apt averages likewise).

    Args:
        actor: on features.
        critic: on features and actions; the target is a copy of all of it.
        observation: key of the first view's features; also read under ``"next"``.
        observation_view: key of the second view's, likewise.
        **options: of :class:`RADSACLoss`. A ``generator`` is asked for the next actions of the first view, of
            the second, then for the actor's.

    Returns (``forward``):
        As :class:`RADSACLoss`; ``q_mean`` and ``td_error`` are means over the views too.
    """

    @dataclass
    class _AcceptedKeys(RADSACLoss._AcceptedKeys):
        """``RADSACLoss``'s keys and one more.

        Attributes:
            observation_view: features of the second view, at the root and under ``"next"``.
        """

        observation_view: NestedKey = "features_view"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    view_names: ClassVar[tuple[str, ...]] = ("observation", "observation_view")

    def __init__(
        self,
        actor: SquashedGaussianActor,
        critic: TwinCritic | PixelCritic,
        *,
        observation: NestedKey = "features",
        observation_view: NestedKey = "features_view",
        **options: Any,
    ) -> None:
        super().__init__(actor, critic, observation=observation, **options)
        self.set_keys(observation_view=observation_view)
