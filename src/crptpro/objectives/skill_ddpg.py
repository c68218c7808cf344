"""Skill-conditioned DDPG on frozen features: the agent of BeCL and of URLB's skill methods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import unravel_key
from torch import Tensor

from crptpro.modules import DeterministicActor, TwinCritic
from crptpro.objectives.base import NetworkLoss
from crptpro.objectives.sac import REGRESSION_KEYS, squared_errors
from crptpro.values import as_float


class SkillDDPGLoss(NetworkLoss):
    r"""DDPG of the unsupervised RL benchmark (rll-research/url_benchmark ``agent/ddpg.py``; BeCL's own agent).

    With :math:`s = [h, z]` the features of an observation and its skill, :math:`s^+ = [h^+, z]` n steps later:

    * :math:`y = R_n + d_n \min(Q_1', Q_2')(s^+, a^+)`, where :math:`R_n` is ``("next", "reward")`` and
      :math:`d_n = \gamma^n \prod (\text{discounts of the environment})` is ``("next", "discount")``;
    * ``loss_qvalue`` = MSE(Q1, y) + MSE(Q2, y), gradient to the critic only;
    * ``loss_actor`` = -mean(min(Q1, Q2)(s, a)), gradient to the actor only.

    Both actions have Gaussian noise clipped to ``noise_clip``, from ``generator`` (the target's first; torch's global
    one if None). Only the critic has a target. In the released code the critic's trunk ends with a tanh. Features never
    receive a gradient. ``forward`` also returns the diagnostics of :class:`~crptpro.objectives.RADSACLoss`. A critic
    that does not fit the actor is a ``ValueError``.
    """

    @dataclass
    class _AcceptedKeys:
        observation: NestedKey = "features"  # at the root and under "next"
        skill: NestedKey = "skill"  # one-hot, at the root
        action: NestedKey = "action"
        reward: NestedKey = "reward"  # n-step return, under "next"
        discount: NestedKey = "discount"  # of the value n steps later, under "next"

    default_keys = _AcceptedKeys
    tensor_keys: Any
    default_out_keys = ("loss_actor", "loss_qvalue", *REGRESSION_KEYS)

    actor_network: DeterministicActor
    actor_network_params: Any
    target_actor_network_params: Any
    qvalue_network: TwinCritic
    qvalue_network_params: Any
    target_qvalue_network_params: Any

    def __init__(
        self,
        actor: DeterministicActor,
        critic: TwinCritic,
        *,
        noise_clip: float = 0.3,
        generator: torch.Generator | None = None,
    ) -> None:
        inputs = actor.config["feature_dim"] + actor.skill_dim
        if critic.config["feature_dim"] != inputs:
            raise ValueError(
                f"The critic was built for {critic.config['feature_dim']} inputs, the actor sees {inputs} (features "
                f"and skill); build the critic with feature_dim={inputs}."
            )
        super().__init__()
        self.noise_clip = as_float(noise_clip, "noise_clip", minimum=0)
        self.generator = generator
        self.convert_to_functional(actor, "actor_network")
        self.convert_to_functional(critic, "qvalue_network", create_target_params=True)

    @property
    def actor(self) -> Any:
        return self.actor_network

    @property
    def critic(self) -> Any:
        return self.qvalue_network

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        following = (keys.observation, keys.reward, keys.discount)
        root = [keys.observation, keys.skill, keys.action]
        self._in_keys = [*root, *(unravel_key(("next", key)) for key in following)]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.critic_loss(tensordict).set("loss_actor", self.actor_loss(tensordict))

    def critic_loss(self, tensordict: TensorDictBase) -> TensorDictBase:
        """``loss_qvalue`` with ``q_mean``, ``target_q_mean`` and ``td_error``; the input is not changed."""
        target = self._target(tensordict)  # (B,)
        inputs = self._inputs(tensordict, tensordict)
        with self._holding("qvalue_network"):
            values = self.qvalue_network(inputs, tensordict.get(self.tensor_keys.action))  # (B, 2)
        return squared_errors(values.unsqueeze(-2), target)

    def actor_loss(self, tensordict: TensorDictBase) -> Tensor:
        inputs = self._inputs(tensordict, tensordict)
        action = self._act(inputs)
        # Detached weights: the gradient passes through Q to the action and to nothing else.
        with self.qvalue_network_params.data.to_module(self.qvalue_network, preserve_module_state=False):
            return -self.qvalue_network(inputs, action).amin(-1).mean()

    @torch.no_grad()
    def _target(self, tensordict: TensorDictBase) -> Tensor:
        following = tensordict.get("next")
        inputs = self._inputs(following, tensordict)
        action = self._act(inputs)
        with self._holding("qvalue_network", target=True):
            value = self.qvalue_network(inputs, action).amin(-1)
        reward = following.get(self.tensor_keys.reward).squeeze(-1)
        discount = following.get(self.tensor_keys.discount).squeeze(-1)
        return reward + discount * value

    def _act(self, inputs: Tensor) -> Tensor:
        with self._holding("actor_network"):
            return self.actor_network.sample(inputs, noise_clip=self.noise_clip, generator=self.generator)

    def _inputs(self, observed: TensorDictBase, root: TensorDictBase) -> Tensor:
        features = observed.get(self.tensor_keys.observation).detach()
        skill = root.get(self.tensor_keys.skill).to(features.dtype)
        return torch.cat([features, skill.expand(*features.shape[:-1], skill.shape[-1])], dim=-1)
