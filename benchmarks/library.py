"""The library's updates and decisions, taken out of its training loops: one call does one timed unit.

Tests hold both against :func:`crptpro.training.pretrain` and :func:`crptpro.training.train_downstream`, bit for bit.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import step_mdp
from tqdm.auto import tqdm

from benchmarks.synthetic import episodes
from crptpro.envs import make_env
from crptpro.errors import CRPTproError
from crptpro.modules import PixelEncoder, Projector, Prototypes, resolve_precision, set_compute_dtype
from crptpro.modules.precision import Precision
from crptpro.objectives import ProtoLoss, method_of
from crptpro.pretrained import Pretrained
from crptpro.seeding import derive_seed, seed_everything
from crptpro.training import DownstreamConfig
from crptpro.training.agent import EnvThread, uniform_action
from crptpro.training.compile import accelerate
from crptpro.training.downstream import (
    attach_transforms,
    env_builder,
    frozen_copy,
    make_agent,
    make_replay,
)
from crptpro.training.pretrain import make_optimizer, normalise_prototypes, open_datasets, total_loss
from crptpro.training.run import Generators, Run


def precisions(device: torch.device | str = "cpu") -> list[Precision]:
    """Return fp32, the reference, and bf16 if that is what ``"auto"`` picks on a device."""
    return ["fp32"] if resolve_precision("auto", device) == torch.float32 else ["fp32", "bf16"]


def fresh_loss(*, image_size: int = 84, prototypes: int = 512, seed: int = 0) -> ProtoLoss:
    """Return the pre-training loss with the paper's sizes; the same seed gives the same weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return ProtoLoss(PixelEncoder(image_size=image_size), num_prototypes=prototypes)


def fresh_pretrained(*, image_size: int = 84, prototypes: int = 512, seed: int = 0) -> Pretrained:
    """Return encoder, projector and prototypes at initialisation: their values do not change what they cost."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        encoder = PixelEncoder(image_size=image_size)
        heads = Projector(encoder.feature_dim), Prototypes(prototypes)
    for network in (encoder, *heads):
        network.requires_grad_(False).eval()
    return Pretrained(encoder, heads[0], prototypes=heads[1], card={"method": "crptpro"})


class PretrainUpdates:
    """One update of ``pretrain(...)`` per call: a batch of the domain whose turn it is, shifted, learned from.

    Args:
        loss: trained in place.
        datasets: directories.
        batch_size: transitions per update.
        precision: as of ``pretrain``; likewise the others.
        device: where to train.
        compile: compile the update.
        cuda_graph: record it.
    """

    def __init__(
        self, loss: ProtoLoss, datasets: Sequence[Path], *, batch_size: int, precision: Precision = "auto",
        device: torch.device | str = "cpu", compile: bool = False, cuda_graph: bool = False,
    ) -> None:  # fmt: skip
        self.device, self.batch_size, self.done = torch.device(device), batch_size, 0
        method = method_of(loss)
        self.loss = loss.to(self.device).train()
        set_compute_dtype(loss, resolve_precision(precision, self.device))
        self._open = open_datasets(list(datasets), loss, seed=0, device=self.device)
        self.buffers, _ = (
            self._open.__enter__()
        )  # they and their shifts belong to this object as long as it lives
        torch.manual_seed(0)
        assert method.encoder_tau is not None
        optimizer, self.schedule, targets = make_optimizer(
            loss, method, learning_rate=method.learning_rate, warmup_updates=method.warmup_updates,
            encoder_tau=method.encoder_tau, updates=method.updates, cuda_graph=cuda_graph,
        )  # fmt: skip

        assert targets is not None

        def update(batch: TensorDictBase) -> TensorDictBase:
            normalise_prototypes(loss)
            losses = loss(batch)
            optimizer.zero_grad(set_to_none=True)
            total_loss(losses).backward()
            optimizer.step()
            targets.step()
            return losses.detach()

        self._update = accelerate(update, compile=compile, cuda_graph=cuda_graph)

    def __call__(self) -> TensorDictBase:
        """Do one update."""
        buffer = list(self.buffers.values())[self.done % len(self.buffers)]
        losses = self._update(buffer.sample(self.batch_size).to(self.device))
        self.schedule.step()
        self.done += 1
        return losses


class Downstream:
    """A run of ``train_downstream(...)``: its updates alone, or its whole decisions.

    Args:
        pretrained: encoder, projector and prototypes.
        config: every number.
        task: what is learned.
        env_factory: makes the environment.
        run_dir: for the replay's files; ``None`` keeps them in memory.
        runs_ahead: draw the next observation during the update.

    Attributes:
        seconds: time spent by stage of a decision.
    """

    def __init__(
        self, pretrained: Pretrained, config: DownstreamConfig, *, task: str = "cheetah_run",
        env_factory: Callable[..., Any] = make_env, run_dir: Path | None = None, runs_ahead: bool = False,
    ) -> None:  # fmt: skip
        self.config = config = config.resolved(task, pretrained)
        self.device, self.image_size = torch.device(config.device), pretrained.encoder.image_size
        dtype = resolve_precision(config.precision, self.device)
        seed_everything(derive_seed(config.seed, "downstream"))
        names = ("replay", "shift", "bonus", "policy", "random_actions")
        self.generators = Generators(config.seed, *names)
        run = Run(run_dir, unit="env_steps", streams=("train",))
        run.require_same({"features": config.features})
        encoder = frozen_copy(pretrained.encoder, self.device, dtype)
        self.env = EnvThread(
            env_builder(task, pretrained.encoder, config, env_factory), runs_ahead=runs_ahead
        )
        env = self.env.env
        self.learner, self.agent = make_agent(pretrained, encoder, env, config, self.generators["policy"])
        set_compute_dtype(self.learner.loss, dtype)
        self.replay = make_replay(env, config, self.generators["replay"], run)
        attach_transforms(self.replay, pretrained, encoder, config, self.generators, run, reserved_bytes=0)
        self.features = run.settings["features"]
        if config.features == "auto" and self.features != "dense":
            self.env.close()
            raise CRPTproError(
                "The dense maps do not fit the memory. Ask for fewer transitions, or free memory."
            )
        self.agent_step = self.episode = 0
        self.seconds: dict[str, float] = {}
        self._td: TensorDictBase | None = None

    def fill(self, transitions: int) -> None:
        """Store drifting pictures and encode them, so that updates can begin."""
        sizes = {"image_size": self.image_size, "action_dim": self.env.env.action_spec.shape[-1]}
        for episode in episodes(transitions, **sizes):
            self.replay.extend(episode)
        if self.features != "reencode":
            for first in tqdm(range(0, len(self.replay), 500), desc="encoding", leave=False, disable=None):
                self.replay[first : first + 500]  # its transforms encode what they have not seen
        self.agent_step = self.config.random_agent_steps

    def update(self) -> TensorDictBase:
        """Do one update; actor, temperature and target critic take part in every second one."""
        losses = self.learner.update(self._sample(), agent_step=self.agent_step)
        self.agent_step += 1
        return losses

    def decide(self) -> None:
        """Act, step, update and store: one pass of the loop of ``train_downstream``."""
        config = self.config
        if self._td is None:
            with self._stage("reset of the episode"):
                seed = derive_seed(config.seed, "downstream", "episode", self.episode)
                self._td = self.env.reset(seed)
        td, is_random = self._td, self.agent_step < config.random_agent_steps
        with self._stage("act"):
            td["action"] = (
                uniform_action(self.env.env, self.generators["random_actions"])
                if is_random
                else self.agent.explore(td["pixels"], self.generators["policy"])
            )
        with self._stage("env step, or waiting for it"):
            step = self.env.step(td)
        if not is_random:
            with self._stage("sample: features and bonus"):
                batch = self._sample()
            with self._stage("learn"):
                self.learner.update(batch, agent_step=self.agent_step)
        with self._stage("env step, or waiting for it"):
            transition = step.result()
        with self._stage("store"):
            self.replay.extend(transition)
        is_over = bool(transition["next", "done"].item())
        self._td = None if is_over else step_mdp(transition)
        self.agent_step, self.episode = self.agent_step + 1, self.episode + is_over

    def close(self) -> None:
        """Free the render context."""
        self.env.close()

    def _sample(self) -> TensorDictBase:
        return self.replay.sample(self.config.batch_size).to(self.device)

    @contextlib.contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
