"""The library's own updates, set up as its training loops set them up, so that one call does one timed unit."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import torch
from torchrl.data import Unbounded
from torchrl.envs import EnvBase

from benchmarks.synthetic import drifting_episode
from crptpro.data import Episode, FrameReplay
from crptpro.downstream_config import DownstreamConfig
from crptpro.errors import CRPTproError
from crptpro.modules import PixelEncoder, Projector, Prototypes, resolve_precision, set_compute_dtype
from crptpro.modules.precision import Precision
from crptpro.objectives import ProtoLoss, method_defaults
from crptpro.pretrained import Pretrained
from crptpro.training.downstream_parts import build_parts, dense_dtype, worth_keeping_projections
from crptpro.training.frozen_features import dense_slots
from crptpro.training.pretrain.augmenter import Augmenter
from crptpro.training.pretrain.learner import Learner
from crptpro.training.pretrain.sources import keys_read, open_sources
from crptpro.transforms import choose_feature_mode, dense_shift_geometry

#: Of the cheetah.
ACTION_DIM = 6
STREAMS = ("replay", "shift", "bonus", "policy", "random_actions")


def precisions(device: torch.device | str = "cpu") -> list[Precision]:
    """Return fp32, the reference, and bf16 if that is what ``"auto"`` picks on a device."""
    return ["fp32"] if resolve_precision("auto", device) == torch.float32 else ["fp32", "bf16"]


def fresh_loss(*, image_size: int = 84, prototypes: int = 512, seed: int = 0) -> ProtoLoss:
    """Build the pre-training loss with its paper defaults; the same seed gives the same weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return ProtoLoss(PixelEncoder(image_size=image_size), num_prototypes=prototypes)


def fresh_pretrained(*, image_size: int = 84, prototypes: int = 512, seed: int = 0) -> Pretrained:
    """Build encoder, projector and prototypes at initialisation: what they hold does not change what they cost."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        encoder = PixelEncoder(image_size=image_size)
        heads = Projector(encoder.feature_dim), Prototypes(prototypes)
    return Pretrained(encoder, heads[0], prototypes=heads[1], card={"method": "at initialisation"})


class PretrainUpdates:
    """One update of ``pretrain(...)`` per call: sample a batch of the domain whose turn it is, shift, learn.

    Args:
        loss: trained in place.
        datasets: as for :func:`crptpro.training.pretrain`.
        batch_size: transitions per update.
        precision: ``"fp32"``, ``"bf16"`` or ``"auto"``.
    """

    def __init__(
        self, loss: ProtoLoss, datasets: Sequence[Any], *, batch_size: int, precision: Precision
    ) -> None:
        defaults = method_defaults(loss)
        set_compute_dtype(loss.train(), resolve_precision(precision, "cpu"))
        self.batch_size, self.done = batch_size, 0
        self.sources = open_sources(datasets, seed=0, device=torch.device("cpu"))
        for source in self.sources:
            source.require_fit(loss.encoder)
        self.augmenter, self.keys = Augmenter("random_shift", seed=0), keys_read(loss)
        self.learner = Learner(
            loss, defaults, learning_rate=defaults.lr, encoder_tau=defaults.encoder_tau,
            updates=defaults.updates,
        )  # fmt: skip

    def __call__(self) -> None:
        """Do one update."""
        source = self.sources[self.done % len(self.sources)]
        batch = self.augmenter.sample(source, self.batch_size, self.keys)
        self.learner.update(batch, index=self.done, domain=source.name)
        self.done += 1


class DownstreamUpdates:
    """One update of ``train_downstream(...)`` per call: sample features, add the bonus, learn.

    The actor, the temperature and the target critic take part in every second call.

    Args:
        pretrained: encoder, projector and prototypes.
        episodes: what the replay holds, with actions of six numbers.
        config: every number; ``features`` must not be ``"auto"``.
        run_dir: for the replay's files.

    Raises:
        CRPTproError: if the dense maps do not fit the memory.
    """

    def __init__(
        self, pretrained: Pretrained, episodes: Iterable[Episode], *, config: DownstreamConfig, run_dir: Path
    ) -> None:
        channels, size = pretrained.encoder.in_channels, pretrained.encoder.image_size
        env = SimpleNamespace(
            observation_spec={"pixels": Unbounded((channels, size, size), dtype=torch.uint8)},
            action_spec=Unbounded((ACTION_DIM,)),
        )
        if config.features == "dense":
            require_dense(pretrained, config)
        self.config, self.agent_step = config, 0
        streams = {name: torch.Generator().manual_seed(0) for name in STREAMS}
        self.parts = build_parts(pretrained, "cheetah_run", cast(EnvBase, env), config, streams, run_dir)
        store_episodes(self.parts.replay, episodes)
        self.parts.features.rebuild()

    def __call__(self) -> None:
        """Do one update."""
        batch = self.parts.features.sample(self.config.batch_size)
        if self.parts.bonus is not None:
            batch = self.parts.bonus(batch)
        self.parts.learner.update(batch, agent_step=self.agent_step)
        self.agent_step += 1


def store_episodes(replay: FrameReplay, episodes: Iterable[Episode]) -> None:
    """Append episodes to a replay, decision by decision as the loop does."""
    for episode in episodes:
        frames, actions = torch.from_numpy(episode.pixels), torch.from_numpy(episode.action)
        replay.begin_episode(frames[0])
        for t in range(len(episode)):
            replay.append(
                actions[t], float(episode.reward[t]), bool(episode.terminated[t]), bool(episode.truncated[t]),
                frames[t + 1],
            )  # fmt: skip


def synthetic_episodes(
    transitions: int, image_size: int, *, action_dim: int = ACTION_DIM
) -> Iterator[Episode]:
    """Yield whole episodes of 500 transitions and one with the rest."""
    for seed, first in enumerate(range(0, transitions, 500)):
        length = min(500, transitions - first)
        yield drifting_episode(length, seed=seed, image_size=image_size, action_dim=action_dim)


def dense_bytes(pretrained: Pretrained, config: DownstreamConfig) -> int:
    """Return the memory of the dense maps of a full replay, and of the projections where they are kept too."""
    dtype = dense_dtype(config, resolve_precision(config.precision, config.device))
    geometry = dense_shift_geometry(pretrained.encoder, config.shift_pad)
    projections = 4 * (_kept_latent_dim(pretrained, config) or 0) * (2 * config.shift_pad + 1) ** 2
    return (geometry.values * dtype.itemsize + projections) * _slots(config)


def require_dense(pretrained: Pretrained, config: DownstreamConfig) -> None:
    """Refuse dense maps that the library would not choose on this machine now.

    Raises:
        CRPTproError: with the library's reason.
    """
    dtype = dense_dtype(config, resolve_precision(config.precision, config.device))
    mode, reason = choose_feature_mode(
        "auto", pretrained.encoder, _slots(config), dtype, pad=config.shift_pad,
        latent_dim=_kept_latent_dim(pretrained, config),
    )  # fmt: skip
    if mode != "dense":
        raise CRPTproError(f"{reason}. Ask for fewer transitions, or free memory.")


def _kept_latent_dim(pretrained: Pretrained, config: DownstreamConfig) -> int | None:
    if pretrained.prototypes is None or not worth_keeping_projections(config):
        return None
    return pretrained.prototypes.get_parameter("weight").shape[1]


def _slots(config: DownstreamConfig) -> int:
    replay = FrameReplay(config.resolved_replay_capacity, frame_shape=(1, 1, 1), action_dim=1)
    return dense_slots(replay, config.env_steps // config.resolved_action_repeat)
