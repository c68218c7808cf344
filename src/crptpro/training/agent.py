"""What acts and what learns: the agent on pixels, the learner that steps its optimisers, the environment's thread."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.objectives import SoftUpdate

from crptpro.artifact import read_artifact, write_artifact
from crptpro.errors import CheckpointError, NonFiniteError
from crptpro.modules import PixelEncoder, SquashedGaussianActor, resolve_precision, set_compute_dtype
from crptpro.objectives import RADSACLoss, SkillDDPGLoss
from crptpro.provenance import provenance
from crptpro.training.compile import accelerate

AGENT_FORMAT, AGENT_VERSION = "crptpro-agent", 2
T = TypeVar("T")


class PixelAgent:
    """An encoder and the actor on it, acting on one observation at a time; callable as a deterministic policy.

    Args:
        encoder: maps pixels to features.
        actor: maps features to actions.
    """

    def __init__(self, encoder: nn.Module, actor: SquashedGaussianActor) -> None:
        self.encoder, self.actor = encoder, actor

    @torch.no_grad()
    def __call__(self, pixels: Tensor) -> Tensor:
        """Return ``tanh`` of the mean, float32 ``[A]``, for uint8 ``[C, H, W]`` (no shift, no noise)."""
        device = next(self.actor.parameters()).device
        return self.actor.mode(self.encoder(pixels.unsqueeze(0).to(device))).squeeze(0).float().cpu()

    @torch.no_grad()
    def explore(self, pixels: Tensor, generator: torch.Generator) -> Tensor:
        """Return a sample of the policy, float32 ``[A]`` in ``[-1, 1]``, for uint8 ``[C, H, W]``.

        Raises:
            NonFiniteError: the policy has diverged; no simulator should see its actions.
        """
        device = next(self.actor.parameters()).device
        features = self.encoder(pixels.unsqueeze(0).to(device))
        action = self.actor.sample(features, generator=generator)[0].squeeze(0).float().cpu().clamp(-1, 1)
        if not torch.isfinite(action).all():
            raise NonFiniteError(
                f"The policy acts {action.tolist()}: it has diverged. The last checkpoint is kept; lower the learning "
                "rate or use precision='fp32'."
            )
        return action

    def snapshot(self) -> PixelAgent:
        """Return the agent as it is now; an encoder that is trained is copied, a frozen one is shared."""
        trains_encoder = any(parameter.requires_grad for parameter in self.encoder.parameters())
        encoder = copy.deepcopy(self.encoder) if trains_encoder else self.encoder
        return PixelAgent(encoder, copy.deepcopy(self.actor))


def save_agent(path: str | Path, agent: PixelAgent, *, card: Mapping[str, Any]) -> Path:
    """Write encoder and actor with a card; whole or not at all.

    Args:
        path: directory to write or replace.
        agent: what to keep; its encoder must be a :class:`~crptpro.modules.PixelEncoder` to be rebuilt from the card.
        card: what else the reader should know: task, seed, env steps, where the encoder came from.

    Raises:
        DiskSpaceError: if the disk is full; an agent there is kept.
    """
    modules = {"encoder": agent.encoder, "actor": agent.actor}
    content = {
        "modules": {name: getattr(module, "config", None) for name, module in modules.items()},
        "encoder_class": type(agent.encoder).__name__,
        **card,
        **provenance(),
    }
    return write_artifact(path, modules, card=content, format_name=AGENT_FORMAT, version=AGENT_VERSION)


def load_agent(path: str | Path, *, encoder: nn.Module | None = None) -> tuple[PixelAgent, dict[str, Any]]:
    """Rebuild an agent from its artifact.

    It acts in the arithmetic that its run learned in: what the card's ``precision`` means on this machine.

    Args:
        path: directory.
        encoder: a module of the class that the agent was trained with, for an encoder of your own; its weights are
            loaded. A :class:`~crptpro.modules.PixelEncoder` is rebuilt from the card.

    Returns:
        The agent, ready to act, and its card.

    Raises:
        CheckpointError: if the directory is missing, damaged, or not an agent.
    """
    card, tensors = read_artifact(
        path, format_name=AGENT_FORMAT, version=AGENT_VERSION, error=CheckpointError
    )
    try:
        if encoder is None:
            if card["encoder_class"] != PixelEncoder.__name__:
                raise CheckpointError(
                    f"{path} acts on a {card['encoder_class']}, which only its author can build: pass encoder=."
                )
            encoder = PixelEncoder(**card["modules"]["encoder"])
        actor = SquashedGaussianActor(**card["modules"]["actor"])
        dtype = resolve_precision(card.get("config", {}).get("precision", "fp32"), "cpu")
        for name, module in (("encoder", encoder), ("actor", actor)):
            prefix = f"{name}."
            module.load_state_dict(
                {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
            )
            set_compute_dtype(module.requires_grad_(False).eval(), dtype)
    except (KeyError, TypeError, ValueError, RuntimeError) as reason:
        if isinstance(reason, CheckpointError):
            raise
        raise CheckpointError(f"{path} holds no agent that can be rebuilt: {reason!r}") from reason
    return PixelAgent(encoder, actor), card


class SACLearner:
    """Steps critic, actor and temperature, and moves the target critic, on the reference schedule.

    Each of the three has its own Adam, as in Proto-RL's and CRPTpro's released agents. Actor and temperature step at
    every ``actor_interval``-th agent step, the target moves at every ``target_interval``-th.

    Args:
        loss: the SAC losses; their parameters are trained in place.
        learning_rate: of the three optimisers.
        critic_tau: EMA rate of the target critic.
        actor_interval: agent steps between two actor steps.
        target_interval: agent steps between two target updates.
        compile: compile the losses.
    """

    def __init__(
        self,
        loss: RADSACLoss,
        *,
        learning_rate: float = 1e-4,
        critic_tau: float = 0.01,
        actor_interval: int = 2,
        target_interval: int = 2,
        compile: bool = False,
    ) -> None:
        self.loss = loss
        self.actor_interval, self.target_interval = actor_interval, target_interval
        self.targets = SoftUpdate(loss, tau=critic_tau)
        groups = {
            "critic": loss.critic.parameters(),
            "actor": loss.actor.parameters(),
            "temperature": [loss.log_alpha],
        }
        self.optimizers = {
            name: torch.optim.Adam(list(group), lr=learning_rate, fused=True)
            for name, group in groups.items()
        }
        self._critic_loss = accelerate(loss.critic_loss, compile=compile)
        self._actor_loss = accelerate(loss.actor_and_temperature_loss, compile=compile)

    def update(self, batch: TensorDictBase, *, agent_step: int) -> TensorDictBase:
        """Do one update on a batch with features and rewards; returns detached scalars."""
        losses = self._critic_loss(batch)
        self._step(losses["loss_qvalue"], "critic")
        if agent_step % self.actor_interval == 0:
            actor_losses = self._actor_loss(batch)
            self._step(actor_losses["loss_actor"] + actor_losses["loss_alpha"], "actor", "temperature")
            losses = losses.update(actor_losses)
        if agent_step % self.target_interval == 0:
            self.targets.step()
        return losses.detach()

    def _step(self, loss: Tensor, *names: str) -> None:
        for name in names:
            self.optimizers[name].zero_grad(set_to_none=True)
        loss.backward()
        for name in names:
            self.optimizers[name].step()

    def components(self) -> dict[str, Any]:
        """Return what a checkpoint must hold."""
        return {"agent_loss": self.loss, "agent_targets": self.targets,
                **{f"optimizer_{name}": optimizer for name, optimizer in self.optimizers.items()}}  # fmt: skip


class SkillDDPGLearner:
    """Steps the critic, then the actor against it, then moves the target, every time (BeCL's explorer).

    Source: rll-research/url_benchmark ``agent/ddpg.py``.

    Args:
        loss: the DDPG losses; their parameters are trained in place.
        learning_rate: of both optimisers.
        critic_tau: EMA rate of the target critic.
    """

    def __init__(self, loss: SkillDDPGLoss, *, learning_rate: float = 1e-4, critic_tau: float = 0.01) -> None:
        self.loss = loss
        self.targets = SoftUpdate(loss, tau=critic_tau)
        groups = {"critic": loss.critic.parameters(), "actor": loss.actor.parameters()}
        self.optimizers = {
            name: torch.optim.Adam(list(group), lr=learning_rate, fused=True)
            for name, group in groups.items()
        }

    def update(self, batch: TensorDictBase, *, agent_step: int) -> TensorDictBase:
        """Do one update on a batch with features, skills and n-step rewards; returns detached scalars."""
        losses = self.loss.critic_loss(batch)
        SACLearner._step(self, losses["loss_qvalue"], "critic")  # type: ignore[arg-type]
        losses["loss_actor"] = self.loss.actor_loss(batch)
        SACLearner._step(self, losses["loss_actor"], "actor")  # type: ignore[arg-type]
        self.targets.step()
        return losses.detach()

    def components(self) -> dict[str, Any]:
        """Return what a checkpoint must hold."""
        return SACLearner.components(self)  # type: ignore[arg-type]


class EnvThread:
    """Makes, steps and closes one environment in a thread of its own, where its render context is.

    MuJoCo lets other threads run while it simulates and draws: the next observation is drawn while an update computes.
    What an environment returns does not depend on when it is asked, so that this changes no number.

    Args:
        make_env: builds the environment.
        runs_ahead: ``False`` does everything in the caller's thread.
    """

    def __init__(self, make_env: Callable[[], EnvBase], *, runs_ahead: bool) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="environment") if runs_ahead else None
        try:
            self.env = self._submit(make_env).result()
        except BaseException:
            self._shutdown()
            raise

    def reset(self, seed: int) -> TensorDictBase:
        """Seed the environment and begin the episode of the seed."""

        def reset() -> TensorDictBase:
            self.env.set_seed(seed)
            return self.env.reset()

        return self._submit(reset).result()

    def step(self, td: TensorDictBase) -> Future[TensorDictBase]:
        """Begin the step that ``td["action"]`` asks for; nobody may change ``td`` until its result is there."""
        return self._submit(lambda: self.env.step(td))

    def close(self) -> None:
        """Free the render context."""
        try:
            self._submit(self.env.close).result()
        finally:
            self._shutdown()

    def _submit(self, work: Callable[[], T]) -> Future[T]:
        if self._thread is not None:
            return self._thread.submit(work)
        future: Future[T] = Future()
        try:
            future.set_result(work())
        except BaseException as reason:
            future.set_exception(reason)
        return future

    def _shutdown(self) -> None:
        if self._thread is not None:
            self._thread.shutdown()


def uniform_action(env: EnvBase, generator: torch.Generator) -> Tensor:
    """Return a uniformly random action in ``[-1, 1]^A``."""
    return 2 * torch.rand(env.action_spec.shape, generator=generator) - 1
