"""Every task on one artifact: the last stage of a comparison."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path

from crptpro.downstream_config import DownstreamConfig
from crptpro.loggers import RunLogger, WandbOptions
from crptpro.pretrained import Pretrained
from crptpro.seeding import derive_seed
from crptpro.training.downstream import DownstreamResult, train_downstream


def train_tasks(
    tasks: Iterable[str],
    pretrained: Pretrained | str | Path | None,
    out: str | Path,
    *,
    name: str,
    config: DownstreamConfig,
    wandb: WandbOptions | None = None,
) -> dict[str, DownstreamResult]:
    """Train an agent on every task, one after the other; what is finished is found again.

    Each run has its own directory ``OUT/<task>_<name>_seed_<seed>`` with its records, and a seed of its own that does
    not depend on the other tasks.

    Args:
        tasks: by name.
        pretrained: as of :func:`~crptpro.training.train_downstream`.
        out: run directories are made below this one.
        name: what tells these runs from those on other artifacts, e.g. ``"atc_group_A"``.
        config: every number; its seed is the one that all stages of a recipe start from.
        wandb: mirror the records there.

    Returns:
        What each run left, by task.
    """
    results = {}
    for task in tasks:
        run_dir = Path(out) / f"{task}_{name}_seed_{config.seed}"
        own = dataclasses.replace(config, seed=derive_seed(config.seed, "task", task))
        with RunLogger(run_dir, config={"task": task, **dataclasses.asdict(own)}, wandb=wandb) as records:
            results[task] = train_downstream(task, pretrained, run_dir=run_dir, config=own, logger=records)
    return results
