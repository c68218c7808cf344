"""Build what the downstream loop is made of, from an artifact and an environment."""

from __future__ import annotations

import copy
import functools
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from crptpro.data import FrameReplay
from crptpro.downstream_config import DownstreamConfig
from crptpro.errors import CheckpointError
from crptpro.modules import (
    PixelEncoder,
    resolve_channels_last,
    resolve_precision,
    set_channels_last,
    set_compute_dtype,
)
from crptpro.pretrained import Pretrained
from crptpro.training.actor_transfer import transferred_actor
from crptpro.training.agent import PixelAgent
from crptpro.training.captured import resolve_cuda_graph
from crptpro.training.compiled import Compiled, resolve_compile
from crptpro.training.downstream_algorithms import DownstreamAlgorithm, Learner, make_algorithm
from crptpro.training.downstream_bonus import build_bonus, require_queue
from crptpro.training.downstream_checkpoint import is_complete
from crptpro.training.downstream_replay import empty_replay, make_replay
from crptpro.training.fingerprint import precision_to_continue
from crptpro.training.frozen_features import FrozenFeatures, dense_slots
from crptpro.training.trained_features import TrainedFeatures
from crptpro.transforms import PrototypeReward, choose_feature_mode
from crptpro.transforms.free_memory import free_bytes
from crptpro.transforms.shift_cache import dense_cache_bytes

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Parts:
    """Everything that learns or remembers in a downstream run: the loop's one partner, whatever the algorithm.

    Attributes:
        encoder: pixels to features; frozen unless the algorithm trains it.
        algorithm: who acts and learns.
        replay: what was seen and done.
        features: what the encoder makes of it, to act and to learn.
        bonus: exploration bonus, if there is one.
        feature_mode: how features are had.
    """

    encoder: PixelEncoder
    algorithm: DownstreamAlgorithm
    replay: FrameReplay
    features: FrozenFeatures | TrainedFeatures
    bonus: PrototypeReward | None
    feature_mode: Literal["dense", "reencode", "trained"]

    @property
    def learner(self) -> Learner:
        """What updates."""
        return self.algorithm.learner

    def is_due(self, agent_step: int) -> bool:
        """Whether an update belongs before the decision ``agent_step``."""
        return agent_step % self.algorithm.update_interval == 0

    def update(self, batch_size: int, *, agent_step: int) -> dict[str, Tensor]:
        """Sample, shift, add the bonus, and let the learner step; returns detached scalars."""
        batch = self.features.sample(batch_size)
        for name, value in self.algorithm.constants.items():
            batch.set(name, value.expand(batch_size, *value.shape))
        if self.bonus is not None:
            batch = self.bonus(batch)
        metrics = self.learner.update(batch, agent_step=agent_step)
        if self.bonus is not None:
            metrics["intrinsic_reward"] = batch["next", "intrinsic_reward"].mean()
        return metrics

    def agent(self) -> PixelAgent:
        """Return the policy as it is now; it goes on learning."""
        return PixelAgent(self.encoder, self.algorithm.actor, trains_encoder=self.algorithm.trains_encoder)

    def state_dict(self) -> dict[str, Any]:
        """Return all that changes; frames are already on disk, in the replay's own files."""
        return {
            "learner": self.learner.state_dict(),
            "bonus": None if self.bonus is None else self.bonus.state_dict(),
            "replay": self.replay.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any], *, with_replay: bool = True) -> None:
        """Restore what :meth:`state_dict` returned; dense feature maps are rebuilt by the caller.

        Args:
            state: from :meth:`state_dict`.
            with_replay: False leaves the replay as it is, for a run that is only read.
        """
        self.learner.load_state_dict(state["learner"])
        if self.bonus is not None:
            self.bonus.load_state_dict(state["bonus"])
        if with_replay:
            self.replay.load_state_dict(state["replay"])


def build_parts(
    pretrained: Pretrained,
    task: str,
    env: EnvBase,
    config: DownstreamConfig,
    generators: Mapping[str, torch.Generator],
    run_dir: Path,
    *,
    reserved_bytes: int = 0,
    state: Mapping[str, Any] | None = None,
) -> Parts:
    """Build networks, replay, features and bonus; encoder, projector and prototypes are copies, frozen ones.

    An algorithm that trains its encoder trains its copy. The artifact stays as it is, on its device and in its dtype:
    another run may hold it too.

    Args:
        pretrained: encoder, and projector and prototypes for the bonus.
        task: what is learned; decides whether the artifact's actor is of use.
        env: what is learned in; read for its image, stack and action sizes.
        config: every number.
        generators: streams ``"replay"``, ``"shift"``, ``"bonus"`` and ``"policy"``.
        run_dir: the replay's frames go below it.
        reserved_bytes: of the CPU's memory, that others will need.
        state: of the checkpoint that the run continues from, if any. Features are had as they were then; a run that
            is complete is given neither frames nor room for maps.

    Raises:
        CheckpointError: if dense maps were kept and do not fit the memory now.
        PretrainedError: if the artifact was made for other images than the environment's, or brings a queue of
            another length than is asked for.
        DiskSpaceError: if the replay's frames do not fit the disk.
    """
    channels, image_size, _ = env.observation_spec["pixels"].shape
    pretrained.require(image_size=image_size, frame_stack=channels // 3)
    require_queue(pretrained, config)
    dtype = resolve_precision(precision_to_continue(config.precision, state), config.device)
    networks = (pretrained.encoder, pretrained.projector, pretrained.prototypes)
    encoder, projector, prototypes = copy.deepcopy(networks)
    for module in (encoder, projector, prototypes):
        if module is not None:
            set_compute_dtype(module.requires_grad_(False).eval().to(config.device), dtype)
    set_channels_last(encoder, resolve_channels_last(config.channels_last))

    action_dim = env.action_spec.shape[-1]
    algorithm = make_algorithm(
        encoder,
        action_dim,
        config,
        seed=config.seed,
        generator=generators["policy"],
        actor=transferred_actor(task, pretrained, config, action_dim=action_dim),
        compiled=Compiled(is_on=resolve_compile(config.compile)),
        captures=resolve_cuda_graph(config.cuda_graph, config.device),
    )
    set_compute_dtype(algorithm.learner.loss, dtype)
    complete = state is not None and is_complete(state, config)
    replay = empty_replay(env) if complete else make_replay(env, config, generators["replay"], run_dir)
    shifts: dict[str, Any] = {
        "pad": config.shift_pad,
        "generator": generators["shift"],
        "device": config.device,
    }
    if algorithm.trains_encoder:
        trained = TrainedFeatures(encoder, replay, **shifts)
        return Parts(encoder, algorithm, replay, trained, None, "trained")

    slots, maps_dtype = dense_slots(replay, _agent_steps(config)), dense_dtype(config, dtype)
    latent_dim = None
    if (
        prototypes is not None
        and projector is not None
        and config.intrinsic_reward_coef
        and worth_keeping_projections(config)
    ):
        latent_dim = prototypes.get_parameter("weight").shape[1]
    before: Mapping[str, Any] = {} if state is None else state["fingerprint"]
    if before and before.get("projections") != "kept":
        latent_dim = None
    available = _available_bytes(config, reserved_bytes)
    mode: Literal["dense", "reencode"]
    if before and config.features == "auto":
        # What there was room for when the run began: the other way rounds differently.
        mode, keeps_projections = before["features"], latent_dim is not None
        if mode == "dense" and not complete:
            _require_room(config, encoder, slots, maps_dtype, available, run_dir, latent_dim=latent_dim)
    else:
        mode, keeps_projections = _choose_features(
            config, encoder, slots, maps_dtype, available, latent_dim=latent_dim
        )
    features = FrozenFeatures(
        encoder,
        replay,
        mode=mode,
        slots=slots,
        maps_dtype=maps_dtype,
        projector=projector if keeps_projections else None,
        n_step=algorithm.n_step,
        discount=config.discount,
        **shifts,
    )
    bonus = build_bonus(
        projector,
        prototypes,
        pretrained.queue,
        config,
        generators["bonus"],
        reads_projections=keeps_projections,
    )
    return Parts(encoder, algorithm, replay, features, bonus, mode)


def _available_bytes(config: DownstreamConfig, reserved_bytes: int) -> int:
    """Free memory of the run's device, less what others will need of the CPU's."""
    device = torch.device(config.device)
    return max(0, free_bytes(device) - (reserved_bytes if device.type == "cpu" else 0))


def _choose_features(
    config: DownstreamConfig,
    encoder: PixelEncoder,
    slots: int,
    dtype: torch.dtype,
    available: int,
    *,
    latent_dim: int | None,
) -> tuple[Literal["dense", "reencode"], bool]:
    """Return how features are had, and whether projections are kept beside dense maps; says so.

    Args:
        config: what was asked for.
        encoder: frozen.
        slots: observations.
        dtype: of the dense maps.
        available: bytes.
        latent_dim: length of the projections, if they are to be kept where there is room.
    """
    choose = functools.partial(
        choose_feature_mode, config.features, encoder, slots, dtype, available, pad=config.shift_pad
    )
    mode, reason = choose(latent_dim=latent_dim)
    keeps_projections = latent_dim is not None and mode == "dense"
    if latent_dim is not None and mode == "reencode":
        mode, reason = choose()  # a tenth less
    logger.info("features: %s", reason)
    return mode, keeps_projections


def _require_room(
    config: DownstreamConfig,
    encoder: PixelEncoder,
    slots: int,
    dtype: torch.dtype,
    available: int,
    run_dir: Path,
    *,
    latent_dim: int | None,
) -> None:
    """Refuse to go on where the dense maps that a run began with do not fit any more."""
    needed = dense_cache_bytes(encoder, slots, dtype, pad=config.shift_pad, latent_dim=latent_dim)
    size = f"{needed / 2**30:.1f} GiB for {slots} observations"
    if needed > available:
        kept = "dense maps and projections" if latent_dim else "dense maps"
        raise CheckpointError(
            f"{run_dir} began with {kept} of its observations, {size}, and {available / 2**30:.1f} GiB are free. "
            "Free memory, or say features='dense' to try it all the same; encoding at every update would round "
            "differently, so it takes another run directory."
        )
    logger.info("features: dense-shift cache, as the run began (%s)", size)


def dense_dtype(config: DownstreamConfig, compute_dtype: torch.dtype) -> torch.dtype:
    """Return in which format dense maps are kept by a run whose networks compute in ``compute_dtype``."""
    return torch.bfloat16 if config.dense_precision == "bf16" else compute_dtype


def worth_keeping_projections(config: DownstreamConfig) -> bool:
    """Whether projections are kept for every shift of an observation instead of computed in every update.

    An update projects the whole batch, an agent step every shift of one observation; with a batch of twice as many
    rows or more, keeping them costs less.
    """
    return config.batch_size >= 2 * (2 * config.shift_pad + 1) ** 2


def _agent_steps(config: DownstreamConfig) -> int:
    return -(-config.env_steps // config.resolved_action_repeat)
