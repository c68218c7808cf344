"""Losses of agents: RAD-SAC on frozen features, its average over two views, DrQ with the encoder, DDPG with skills."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import unravel_key
from torch import Tensor
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, ValueEstimators

from crptpro.modules import DeterministicActor, PixelEncoder, SquashedGaussianActor, TwinCritic
from crptpro.modules.actor_critic import PixelCritic
from crptpro.objectives.base import NetworkLoss, require_positive
from crptpro.values import as_float, read_entry

REGRESSION_KEYS = ("q_mean", "target_q_mean", "td_error")


def squared_errors(values: Tensor, target: Tensor) -> TensorDict:
    """Squared error of the values ``[B, views, 2]`` of two heads to a target ``[B]``, and diagnostics.

    The loss is the mean over the batch of the sum over views and heads.
    """
    errors = values - target[..., None, None]
    out = {
        "loss_qvalue": errors.square().sum((-2, -1)).mean(),
        "q_mean": values.detach().mean(-2).mean(),
        "target_q_mean": target.mean(),
        "td_error": errors.detach().abs().amax(-1).mean(-1).mean(),
    }
    return TensorDict(out, batch_size=[])


class RADSACLoss(NetworkLoss, SACLoss):
    r"""RAD-SAC of CRPTpro (liuxin0824/CRPTpro and denisyarats/proto, ``proto.py``) on TorchRL's ``SACLoss``.

    With :math:`h, h'` the features of an observation and the next, :math:`a' \sim \pi(h')`:

    * :math:`y = r + \gamma (1-\mathrm{terminated}) (\min(Q_1', Q_2')(h', a') - \alpha \log\pi(a'|h'))`
    * ``loss_qvalue`` = MSE(Q1, y) + MSE(Q2, y), gradient to the critic only;
    * ``loss_actor`` = mean(alpha log pi(a|h) - min(Q1, Q2)(h, a)), gradient to the actor only;
    * ``loss_alpha`` = mean(exp(log_alpha) * sg(-log pi - target_entropy)), gradient to ``log_alpha`` only.

    With the ``steps_to_next_obs`` of TorchRL's ``MultiStepTransform`` in the batch, gamma is raised to the number of
    agent steps; it is not an in_key. Features never receive a gradient.

    Differences from ``SACLoss``: squared error; alpha in place of its logarithm in the temperature loss; the log-std
    squash and pre-tanh log-probability of
    :class:`~crptpro.modules.SquashedGaussianActor`; one critic network with two outputs and a shared trunk; and
    separate :meth:`critic_loss` and :meth:`actor_and_temperature_loss`, because the actor learns at every second
    update, against the updated critic.

    Deviation: the released code always bootstraps; here ``terminated`` stops it, which no task of the paper sets.

    ``forward`` returns the losses and, detached, ``alpha``, ``entropy`` (-log pi, nats), ``q_mean``, ``target_q_mean``,
    ``td_error`` (mean over rows of the larger of the two heads' absolute errors).

    ``gamma`` in [0, 1] is the discount per agent step, ``alpha_init`` the initial temperature, ``target_entropy`` in
    nats by default minus the action dimension. ``generator`` draws all action noise (torch's global one if None) and is
    not part of the state dictionary.
    """

    @dataclass
    class _AcceptedKeys(SACLoss._AcceptedKeys):
        observation: NestedKey = "features"  # at the root and under "next"

    default_keys = _AcceptedKeys
    tensor_keys: Any
    view_names: ClassVar[tuple[str, ...]] = ("observation",)  # configurable keys; the actor learns from the first

    default_out_keys = ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy", *REGRESSION_KEYS)

    def __init__(
        self,
        actor: SquashedGaussianActor,
        critic: TwinCritic | PixelCritic,
        *,
        gamma: float = 0.99,
        alpha_init: float = 0.1,
        target_entropy: float | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        if not (hasattr(actor, "sample") and hasattr(actor, "action_dim")):
            expected = "an actor such as SquashedGaussianActor, then a critic such as TwinCritic"
            raise TypeError(f"{type(self).__name__} takes {expected}; got a {type(actor).__name__} as the actor.")
        configs = [getattr(network, "config", {}) for network in (actor, getattr(critic, "head", critic))]
        for name in ("feature_dim", "action_dim"):
            given, other = (config.get(name) for config in configs)
            if None not in (given, other) and given != other:
                raise ValueError(f"The actor was built with {name}={given}, the critic with {other}.")
        if target_entropy is not None:
            target_entropy = as_float(target_entropy, "target_entropy")
        gamma = as_float(gamma, "gamma", minimum=0, maximum=1)
        require_positive(alpha_init=alpha_init)
        views = [self.default_keys().observation]
        moments = ["loc", "scale"]
        policy = ProbabilisticActor(
            TensorDictModule(actor, views, moments), moments, distribution_class=TanhNormal, return_log_prob=True
        )
        super().__init__(
            policy,
            TensorDictModule(critic, [*views, "action"], ["state_action_value"]),
            # With any other count SACLoss stacks copies of the parameters, and re-initialises those of a single
            # module without orthogonal initialisation.
            num_qvalue_nets=0,
            alpha_init=float(alpha_init),
            target_entropy=-float(actor.action_dim) if target_entropy is None else target_entropy,
        )
        self.generator = generator
        self.make_value_estimator(ValueEstimators.TD0, gamma=gamma)

    @property
    def actor(self) -> Any:
        return cast(Any, self.actor_network)[0].module

    @property
    def critic(self) -> Any:
        return cast(Any, self.qvalue_network).module

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.critic_loss(tensordict).update(self.actor_and_temperature_loss(tensordict))

    def critic_loss(self, tensordict: TensorDictBase) -> TensorDictBase:
        """``loss_qvalue`` with ``q_mean``, ``target_q_mean`` and ``td_error``; the input is not changed."""
        for key in self.in_keys:
            read_entry(self, tensordict, key)
        target = self._compute_target_v2(tensordict)  # (B,)
        action = tensordict.get(self.tensor_keys.action)
        values = torch.stack([self.critic(view, action) for view in self._views(tensordict)], -2)
        return squared_errors(values, target)

    def actor_and_temperature_loss(self, tensordict: TensorDictBase) -> TensorDictBase:
        """``loss_actor`` and ``loss_alpha`` of one action draw, with ``alpha`` and ``entropy``."""
        loss_actor, drawn = self.actor_loss(tensordict)
        out = {
            "loss_actor": loss_actor,
            "loss_alpha": self.alpha_loss(drawn["log_prob"]).mean(),
            "alpha": self._alpha,
            "entropy": -drawn["log_prob"].mean(),
        }
        return TensorDict(out, batch_size=[])

    # Methods with SACLoss's names and return values.

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """``loss_qvalue``, and the diagnostics of :meth:`critic_loss`."""
        out = dict(self.critic_loss(tensordict).items())
        return out.pop("loss_qvalue"), out

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """``loss_actor``, and the detached ``log_prob`` ``[B]`` of its actions."""
        features = self._policy_features(self._views(tensordict)[0])
        action, log_prob = self.actor.sample(features, generator=self.generator)
        # Detached weights: the gradient passes through Q to the action and to nothing else.
        with self._cached_detached_qvalue_params.to_module(self.qvalue_network, preserve_module_state=False):
            value = self._q_values_on_features(features, action).amin(-1)
        return (self._alpha * log_prob - value).mean(), {"log_prob": log_prob.detach()}

    def _alpha_loss(self, log_prob: Tensor) -> Tensor:
        return self.log_alpha.exp() * (-log_prob - self.target_entropy)

    @torch.no_grad()
    def _compute_target_v2(self, tensordict: TensorDictBase) -> Tensor:
        soft_values = []
        for view in self._views(tensordict.get("next")):
            action, log_prob = self.actor.sample(self._policy_features(view), generator=self.generator)
            with self._as_target("qvalue_network"):
                soft_values.append(self.critic(view, action).amin(-1) - self._alpha * log_prob)
        soft_value = torch.stack(soft_values).mean(0).unsqueeze(-1)
        names = (self.tensor_keys.reward, self.tensor_keys.done, self.tensor_keys.terminated)
        keys = [unravel_key(("next", name)) for name in names]
        steps_ahead = self.value_estimator.tensor_keys.steps_to_next_obs
        estimate = tensordict.select(*keys, steps_ahead, strict=False)
        estimate.set(("next", self.value_estimator.tensor_keys.value), soft_value)
        return self.value_estimator.value_estimate(estimate).squeeze(-1)

    def _views(self, tensordict: TensorDictBase) -> list[Tensor]:
        return [read_entry(self, tensordict, getattr(self.tensor_keys, name)).detach() for name in self.view_names]

    # DrQ overrides these two, because its views are images.

    def _policy_features(self, view: Tensor) -> Tensor:
        return view

    def _q_values_on_features(self, features: Tensor, action: Tensor) -> Tensor:
        return self.critic(features, action)

    def _make_vmap(self) -> None:
        pass  # of SACLoss, for a stack of critics; its closure cannot be pickled

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        views = [getattr(keys, name) for name in self.view_names]
        following = (*views, keys.reward, keys.done, keys.terminated)
        self._in_keys = [*views, keys.action, *(unravel_key(("next", key)) for key in following)]

    @torch.no_grad()
    def reset_parameters_recursive(self) -> None:
        super().reset_parameters_recursive()
        self.log_alpha.copy_(self.alpha_init.log())


class AveragedSACLoss(RADSACLoss):
    """:class:`RADSACLoss` with two views of each observation (DrQ, arXiv 2004.13649, K = M = 2).

    Each view of the next observation has its own action; y is the mean of their targets. ``loss_qvalue`` is the sum,
    not the mean, over the views, as in denisyarats/drq ``drq.py``; ``loss_actor`` and ``loss_alpha`` use the first one.
    The exploration agent of APT learns with it on detached features (forhaoliu/mini_apt averages likewise).
    """

    @dataclass
    class _AcceptedKeys(RADSACLoss._AcceptedKeys):
        observation_view: NestedKey = "features_view"  # of the second view, at the root and under "next"

    default_keys = _AcceptedKeys
    view_names = ("observation", "observation_view")


class DrQLoss(AveragedSACLoss):
    """DrQ (arXiv 2004.13649; denisyarats/drq ``drq.py``): :class:`AveragedSACLoss` with the encoder inside.

    Actor and critic share the convolutions, which learn from ``loss_qvalue`` alone; the target critic copies
    convolutions and head. In DrQ, actor and critic have ``has_tanh=True``. The actor acts on features: a policy is
    ``actor.sample(encoder(pixels))``. ``options`` are those of :class:`RADSACLoss`.

    Raises:
        ValueError: the critic does not fit the encoder.
    """

    @dataclass
    class _AcceptedKeys(AveragedSACLoss._AcceptedKeys):
        observation: NestedKey = "pixels"  # images of the first view, at the root and under "next"
        observation_view: NestedKey = "pixels_view"  # of the second view, likewise

    default_keys = _AcceptedKeys

    def __init__(self, encoder: PixelEncoder, actor: SquashedGaussianActor, critic: TwinCritic, **options: Any) -> None:
        super().__init__(actor, PixelCritic(encoder, critic), **options)

    @property
    def encoder(self) -> PixelEncoder:
        return self.critic.encoder

    @torch.no_grad()
    def _policy_features(self, view: Tensor) -> Tensor:
        return self.critic.encoder(view)

    def _q_values_on_features(self, features: Tensor, action: Tensor) -> Tensor:
        return self.critic.head(features, action)


class SkillDDPGLoss(NetworkLoss):
    r"""DDPG of the unsupervised RL benchmark (rll-research/url_benchmark ``agent/ddpg.py``; BeCL's own agent).

    With :math:`s = [h, z]` the features of an observation and its skill, :math:`s^+ = [h^+, z]` n agent steps later:

    * :math:`y = R_n + \gamma^n (1 - \mathrm{terminated}) \min(Q_1', Q_2')(s^+, a^+)`, where :math:`R_n` is
      ``("next", "reward")`` and n is ``steps_to_next_obs``, 1 without that entry;
    * ``loss_qvalue`` = MSE(Q1, y) + MSE(Q2, y), gradient to the critic only;
    * ``loss_actor`` = -mean(min(Q1, Q2)(s, a)), gradient to the actor only.

    Both actions have Gaussian noise clipped to ``noise_clip``, from ``generator`` (torch's global one if None). Only
    the critic has a target; in the released code its trunk ends with a tanh. Features never receive a gradient.
    Diagnostics and both halves of ``forward`` are as in :class:`RADSACLoss`.

    Raises:
        ValueError: the critic's input size does not match that of the actor.
    """

    @dataclass
    class _AcceptedKeys:
        observation: NestedKey = "features"  # at the root and under "next"
        skill: NestedKey = "skill"  # one-hot, at the root
        action: NestedKey = "action"
        reward: NestedKey = "reward"  # n-step return, under "next"
        terminated: NestedKey = "terminated"  # under "next"
        steps_to_next_obs: NestedKey = "steps_to_next_obs"  # n, at the root

    default_keys = _AcceptedKeys
    tensor_keys: Any
    default_out_keys = ("loss_actor", "loss_qvalue", *REGRESSION_KEYS)

    actor_network: DeterministicActor
    qvalue_network: TwinCritic
    qvalue_network_params: Any

    def __init__(
        self,
        actor: DeterministicActor,
        critic: TwinCritic,
        *,
        gamma: float = 0.99,
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
        self.gamma = as_float(gamma, "gamma", minimum=0, maximum=1)
        self.noise_clip = as_float(noise_clip, "noise_clip", minimum=0)
        self.generator = generator
        self._convert(("qvalue_network",), actor_network=actor, qvalue_network=critic)

    @property
    def actor(self) -> Any:
        return self.actor_network

    @property
    def critic(self) -> Any:
        return self.qvalue_network

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        following = (keys.observation, keys.reward, keys.terminated)
        root = [keys.observation, keys.skill, keys.action]
        self._in_keys = [*root, *(unravel_key(("next", key)) for key in following)]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.critic_loss(tensordict).update(self.actor_and_temperature_loss(tensordict))

    def critic_loss(self, tensordict: TensorDictBase) -> TensorDictBase:
        """``loss_qvalue`` with ``q_mean``, ``target_q_mean`` and ``td_error``; the input is not changed."""
        for key in self.in_keys:
            read_entry(self, tensordict, key)
        target = self._target(tensordict)  # (B,)
        inputs = self._inputs(tensordict, tensordict)
        values = self.qvalue_network(inputs, tensordict.get(self.tensor_keys.action))  # (B, 2)
        return squared_errors(values.unsqueeze(-2), target)

    def actor_and_temperature_loss(self, tensordict: TensorDictBase) -> TensorDictBase:
        """``loss_actor``; the name is that of :class:`RADSACLoss`, which has a temperature."""
        inputs = self._inputs(tensordict, tensordict)
        action = self._act(inputs)
        # Detached weights: the gradient passes through Q to the action and to nothing else.
        with self.qvalue_network_params.data.to_module(self.qvalue_network, preserve_module_state=False):
            value = self.qvalue_network(inputs, action).amin(-1)
        return TensorDict({"loss_actor": -value.mean()}, batch_size=[])

    @torch.no_grad()
    def _target(self, tensordict: TensorDictBase) -> Tensor:
        following = tensordict.get("next")
        inputs = self._inputs(following, tensordict)
        action = self._act(inputs)
        with self._as_target("qvalue_network"):
            value = self.qvalue_network(inputs, action).amin(-1)
        reward = following.get(self.tensor_keys.reward).squeeze(-1)
        bootstraps = ~following.get(self.tensor_keys.terminated).squeeze(-1)
        steps_ahead = tensordict.get(self.tensor_keys.steps_to_next_obs, None)
        discount = self.gamma if steps_ahead is None else self.gamma ** steps_ahead.squeeze(-1)
        return reward + discount * bootstraps * value

    def _act(self, inputs: Tensor) -> Tensor:
        return self.actor_network.sample(inputs, noise_clip=self.noise_clip, generator=self.generator)

    def _inputs(self, observed: TensorDictBase, root: TensorDictBase) -> Tensor:
        features = read_entry(self, observed, self.tensor_keys.observation).detach()
        return torch.cat([features, read_entry(self, root, self.tensor_keys.skill).to(features.dtype)], dim=-1)
