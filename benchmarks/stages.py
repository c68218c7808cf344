"""The stages whose memory is measured, each run in a process of its own that does nothing else.

``python -m benchmarks.stages NAME ARGUMENTS``, with keyword arguments as a JSON object, is what
:func:`run_watched` starts. Each stage calls what a user calls, at the sizes it is given, and prints one JSON object.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from tqdm.auto import tqdm

from benchmarks.resident import Resident, python_module, watch
from benchmarks.sampling_ways import WAYS
from benchmarks.synthetic import drifting_episode
from crptpro.console import configure_logging
from crptpro.data import FrameDataset, Layout, collect_random
from crptpro.downstream_config import DownstreamConfig
from crptpro.loggers import RunLogger
from crptpro.modules import PixelEncoder, Projector, Prototypes
from crptpro.modules.precision import Precision
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import Pretrained
from crptpro.training import pretrain
from crptpro.training.checkpoint import CheckpointDir
from crptpro.training.downstream_run import DownstreamRun

logger = logging.getLogger("crptpro.benchmarks.stages")

#: Runs a stage, given its name and arguments, and says what it took.
Runner = Callable[[str, Mapping[str, Any]], Resident]


def run_watched(name: str, arguments: Mapping[str, Any]) -> Resident:
    """Run a stage in a process of its own and watch its memory."""
    return watch(python_module("benchmarks.stages", name, json.dumps(dict(arguments))))


def imports() -> dict[str, Any]:
    """Do nothing: what is resident then are the imports."""
    return {"python": sys.version.split()[0]}


def sampling(*, way: str, path: str, batch_size: int, scratch: str, samples: int = 5) -> dict[str, Any]:
    """Build one of :data:`benchmarks.sampling_ways.WAYS` and sample a few batches."""
    built = WAYS[way].build(FrameDataset.open(path), batch_size, Path(scratch))
    for _ in range(samples):
        batch = built.sample()
    return {"transitions": len(batch), "stored_bytes": built.stored_bytes}


def collection(
    *, task: str, root: str, transitions: int, workers: int, quality: Literal["exact", "fast"]
) -> dict[str, Any]:
    """Collect a dataset and measure its files.

    Returns:
        ``transitions``; ``bytes_on_disk``, allocated, of all files; ``layout``, from which other sizes follow.
    """
    path = collect_random(task, root, transitions=transitions, workers=workers, quality=quality)
    dataset = FrameDataset.open(path)
    return {
        "transitions": len(dataset),
        "bytes_on_disk": allocated_bytes(path),
        "layout": Layout.from_dict(dataset.card["layout"]).to_dict(),
    }


def pretraining(
    *, datasets: list[str], run_dir: str, updates: int, batch_size: int, precision: Precision = "auto"
) -> dict[str, Any]:
    """Pre-train the paper's networks for a few updates, with a record and a checkpoint."""
    loss = ProtoLoss(PixelEncoder())
    result = pretrain(
        loss,
        [FrameDataset.open(path) for path in datasets],
        updates=updates,
        batch_size=batch_size,
        precision=precision,
        run_dir=run_dir,
        progress=False,
    )
    return {"updates": result.updates, "precision": result.precision, "threads": torch.get_num_threads()}


def downstream(
    *,
    task: str,
    run_dir: str,
    features: Literal["dense", "reencode"],
    replay_transitions: int,
    updates: int,
    batch_size: int,
    episode_transitions: int = 500,
) -> dict[str, Any]:
    """Fill the replay of a downstream run with drifting pictures as its loop would, update, and write a checkpoint.

    The run has its environment, and two processes that evaluate meanwhile; only acting and rendering are left out.

    Returns:
        ``transitions`` in the replay, ``replay_bytes_on_disk``, ``frame_slots`` and ``window`` of its ring, and the
        feature ``mode``.
    """
    config = DownstreamConfig(
        replay_capacity=replay_transitions,
        random_agent_steps=min(DownstreamConfig.random_agent_steps, replay_transitions),
        batch_size=batch_size,
        features=features,
        action_repeat=2,
        eval_episodes=2,
        eval_workers=2,
    )
    directory = Path(run_dir)
    from crptpro.envs import make_env

    with RunLogger(directory) as records:
        run = DownstreamRun(
            task, untrained(), directory, config, records, progress=True, env_factory=make_env
        )
        try:
            run.env.reset(seed=0)
            run.evaluation.start(run.agent(), run.counters())
            _fill(run, replay_transitions, episode_transitions)
            run.agent_steps = replay_transitions
            for _ in range(updates):
                run.update()
            run.evaluation.finish()
            run.save(CheckpointDir(directory / "checkpoints"))
        finally:
            run.close()
    replay = run.parts.replay
    return {
        "transitions": len(replay),
        "replay_bytes_on_disk": allocated_bytes(directory / "replay"),
        "frame_slots": replay.frame_slots,
        "window": replay.window,
        "mode": run.parts.feature_mode,
    }


STAGES: dict[str, Callable[..., dict[str, Any]]] = {
    "imports": imports,
    "sampling": sampling,
    "collection": collection,
    "pretraining": pretraining,
    "downstream": downstream,
}


def untrained() -> Pretrained:
    """Return the paper's networks as a downstream run takes them, as they are before any training."""
    torch.manual_seed(0)
    encoder = PixelEncoder()
    networks = (encoder, Projector(encoder.feature_dim, 128), Prototypes(512, 128))
    for network in networks:
        network.requires_grad_(False).eval()
    return Pretrained(encoder, projector=networks[1], prototypes=networks[2], card={"method": "crptpro"})


def allocated_bytes(directory: Path) -> int:
    """Return what the files below a directory take on disk."""
    return sum(512 * file.stat().st_blocks for file in directory.rglob("*") if file.is_file())


def _fill(run: DownstreamRun, transitions: int, episode_transitions: int) -> None:
    replay, features = run.parts.replay, run.parts.features
    action_dim = run.env.env.action_spec.shape[-1]
    size = run.parts.encoder.image_size
    with tqdm(total=transitions, desc="fill replay", unit="transition", leave=False, disable=None) as bar:
        while len(replay) < transitions:
            length = min(episode_transitions, transitions - len(replay))
            episode = drifting_episode(length, seed=len(replay), image_size=size, action_dim=action_dim)
            frames, actions = torch.from_numpy(episode.pixels), torch.from_numpy(episode.action)
            stack = [frames[0]] * 3
            features.observe(torch.cat(stack), replay.begin_episode(frames[0]))
            for step in range(length):
                stack = [*stack[1:], frames[step + 1]]
                is_last = step == length - 1
                slot = replay.append(
                    actions[step], float(episode.reward[step]), False, is_last, frames[step + 1]
                )
                features.observe(torch.cat(stack), slot)
            bar.update(length)


def _main(name: str, arguments: str) -> None:
    configure_logging()
    print(json.dumps(STAGES[name](**json.loads(arguments))))


if __name__ == "__main__":
    _main(*sys.argv[1:])
