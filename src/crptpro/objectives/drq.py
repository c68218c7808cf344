"""DrQ: soft actor-critic from pixels, its encoder trained by the critic alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor

from crptpro.modules import PixelCritic, PixelEncoder, SquashedGaussianActor, TwinCritic
from crptpro.objectives.averaged_sac import AveragedSACLoss


class DrQLoss(AveragedSACLoss):
    r"""DrQ (arXiv 2004.13649; denisyarats/drq ``drq.py``): :class:`AveragedSACLoss` with the encoder inside.

    Actor and critic share the convolutions, tied, and each has a head of its own. The convolutions learn from
    ``loss_qvalue`` alone: the actor, its critic and the policy of the targets see detached features. The target
    critic has its own copy of convolutions and head. Give actor and critic ``has_tanh=True``: DrQ's heads end
    with a tanh.

    Deviation: as in :class:`RADSACLoss`, ``terminated`` cuts the bootstrap.

    Args:
        encoder: trained in place.
        actor: on the encoder's features.
        critic: on the encoder's features and actions.
        observation: key of the first view, images ``[B, C, H, W]``; also read under ``"next"``.
        observation_view: key of the second view, likewise.
        **options: of :class:`RADSACLoss`.

    Raises:
        ValueError: a critic that does not fit the encoder; otherwise as :class:`RADSACLoss`.
    """

    @dataclass
    class _AcceptedKeys(AveragedSACLoss._AcceptedKeys):
        """The keys of :class:`AveragedSACLoss` with other defaults.

        Attributes:
            observation: images of the first view, at the root and under ``"next"``.
            observation_view: images of the second view, likewise.
        """

        observation: NestedKey = "pixels"
        observation_view: NestedKey = "pixels_view"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    critic: PixelCritic

    def __init__(
        self,
        encoder: PixelEncoder,
        actor: SquashedGaussianActor,
        critic: TwinCritic,
        *,
        observation: NestedKey = "pixels",
        observation_view: NestedKey = "pixels_view",
        **options: Any,
    ) -> None:
        super().__init__(
            actor,
            PixelCritic(encoder, critic),
            observation=observation,
            observation_view=observation_view,
            **options,
        )

    @property
    def encoder(self) -> PixelEncoder:
        """The convolutions that actor and critic share."""
        return self.critic.encoder

    @torch.no_grad()
    def _policy_features(self, view: Tensor) -> Tensor:
        with self.qvalue_network_params.to_module(self.qvalue_network, preserve_module_state=False):
            return self.critic.encoder(view)

    def _q_values_on_features(self, features: Tensor, action: Tensor) -> Tensor:
        return self.critic.head(features, action)
