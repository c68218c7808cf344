"""The agent on pixels, and the learner that steps its optimisers."""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate

from crptpro.artifact import read_artifact, write_artifact
from crptpro.errors import CheckpointError
from crptpro.modules import resolve_precision, set_compute_dtype
from crptpro.modules.precision import evaluating
from crptpro.modules.registry import describe_network, rebuild_networks
from crptpro.objectives import RADSACLoss, SkillDDPGLoss
from crptpro.provenance import provenance
from crptpro.training.compile import Update, accelerate

AGENT_FORMAT, AGENT_VERSION = "crptpro-agent", 3


class PixelAgent(nn.Module):
    """An encoder and the actor on its features, acting on one observation; callable as a deterministic policy."""

    encoder: nn.Module
    actor: Any

    def __init__(self, encoder: nn.Module, actor: nn.Module) -> None:
        super().__init__()
        self.encoder, self.actor = encoder, actor

    @torch.no_grad()
    def forward(self, pixels: Tensor) -> Tensor:
        """Return ``tanh`` of the mean, float32 ``[A]``, for uint8 ``[C, H, W]`` (no shift, no noise)."""
        return self.actor.mode(self.encode(pixels)).squeeze(0).float().cpu()

    @torch.no_grad()
    def encode(self, pixels: Tensor) -> Tensor:
        """Return the features, ``[1, feature_dim]`` on the actor's device, of uint8 ``[C, H, W]``."""
        device = next(self.actor.parameters()).device
        with evaluating(self.encoder):
            return self.encoder(pixels.unsqueeze(0).to(device))

    @torch.no_grad()
    def explore(self, features: Tensor, generator: torch.Generator, *, skill: Tensor | None = None) -> Tensor:
        """Return a sample of the policy, float32 ``[A]`` in ``[-1, 1]``, for features ``[1, feature_dim]``.

        ``skill`` is one-hot ``[S]``, for an actor that takes one.
        """
        if skill is not None:
            features = torch.cat([features, skill.unsqueeze(0).to(features.device)], -1)
        sampled = self.actor.sample(features, generator=generator)
        action = sampled if isinstance(sampled, Tensor) else sampled[0]
        return action.squeeze(0).float().cpu().clamp(-1, 1)

    def snapshot(self) -> PixelAgent:
        """Return a copy of the agent; an encoder that is trained is copied, a frozen one is shared."""
        is_trained = any(parameter.requires_grad for parameter in self.encoder.parameters())
        return copy.deepcopy(self, {} if is_trained else {id(self.encoder): self.encoder})


def save_agent(path: str | Path, agent: PixelAgent, *, card: Mapping[str, Any]) -> Path:
    """Write encoder and actor into a directory, whole or not at all; ``card`` holds further entries of the card."""
    modules = {"encoder": agent.encoder, "actor": agent.actor}
    described = {role: describe_network(network) for role, network in modules.items()}
    content = {"modules": described, **card, **provenance()}
    check = functools.partial(_rebuilt, path)
    return write_artifact(path, modules, card=content, format_name=AGENT_FORMAT, version=AGENT_VERSION, check=check)


def load_agent(path: str | Path) -> tuple[PixelAgent, dict[str, Any]]:
    """Rebuild an agent from its directory, to act in the precision it was trained in; return it and its card.

    An encoder of your own class needs :func:`~crptpro.modules.register_network`. A directory that is missing, damaged,
    or not an agent raises a ``CheckpointError``.
    """
    card, tensors = read_artifact(path, format_name=AGENT_FORMAT, version=AGENT_VERSION, error=CheckpointError)
    return _rebuilt(path, card, tensors), card


def _rebuilt(path: str | Path, card: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> PixelAgent:
    networks, _ = rebuild_networks(path, card, tensors, roles=("encoder", "actor"), error=CheckpointError)
    try:
        agent, dtype = PixelAgent(**networks), resolve_precision(card.get("precision", "fp32"), "cpu")
    except (TypeError, ValueError) as reason:
        raise CheckpointError(f"{path} holds no agent that can be rebuilt: {reason!r}") from reason
    return set_compute_dtype(agent.eval(), dtype)


class SACLearner:
    """Steps critic, actor and temperature, and updates the target critic, on the schedule of the released agents.

    Each of the three has its own Adam, as in Proto-RL's and CRPTpro's released agents. Actor, temperature and target,
    whose EMA rate is ``critic_tau``, are updated at every ``interval``-th update; it is 1 in the source of
    ``SkillDDPGLoss``, which has no temperature.
    """

    def __init__(
        self,
        loss: RADSACLoss | SkillDDPGLoss,
        *,
        learning_rate: float = 1e-4,
        critic_tau: float = 0.01,
        interval: int = 2,
        compile: bool = False,
        cuda_graph: bool = False,
    ) -> None:
        self.loss, self.targets = loss, SoftUpdate(loss, tau=critic_tau)
        self.interval = interval
        groups = {"critic": [*loss.critic.parameters()], "actor": [*loss.actor.parameters()]}
        if isinstance(loss, RADSACLoss):
            groups["temperature"] = [loss.log_alpha]
        self.optimizers = {
            name: torch.optim.Adam(group, lr=learning_rate, fused=True, capturable=cuda_graph)
            for name, group in groups.items()
        }
        self._critic_loss = accelerate(loss.critic_loss, compile=compile)
        self._actor_loss = accelerate(loss.actor_and_temperature_loss, compile=compile)
        recording: dict[str, Any] = {"cuda_graph": cuda_graph, "device": groups["critic"][0].device}
        self._updates: dict[bool, Update] = {
            critic_only: accelerate(functools.partial(self._update, critic_only), **recording)
            for critic_only in (True, False)
        }

    def update(self, batch: TensorDictBase, *, agent_update: int) -> TensorDictBase:
        """Do update number ``agent_update`` on a batch with features and rewards; returns detached scalars."""
        return self._updates[agent_update % self.interval != 0](batch)

    def _update(self, critic_only: bool, batch: TensorDictBase) -> TensorDictBase:
        critic, *others = self.optimizers.values()
        losses = self._critic_loss(batch)
        _step(losses["loss_qvalue"], critic)
        if not critic_only:
            actor_losses = self._actor_loss(batch)
            terms = [value for name, value in actor_losses.items() if name.startswith("loss")]
            _step(torch.stack(terms).sum(), *others)
            losses = losses.update(actor_losses)
            self.targets.step()
        return losses.detach()

    def components(self) -> dict[str, Any]:
        """Return what a checkpoint must hold."""
        optimizers = {f"optimizer_{name}": optimizer for name, optimizer in self.optimizers.items()}
        return {"agent_loss": self.loss, "agent_targets": self.targets, **optimizers}


def _step(loss: Tensor, *optimizers: torch.optim.Optimizer) -> None:
    for optimizer in optimizers:
        optimizer.zero_grad(set_to_none=True)
    loss.backward()
    for optimizer in optimizers:
        optimizer.step()
