"""Make a piece: the one stage of the pipeline that its description names, resumed if it was interrupted."""

from __future__ import annotations

import functools
import logging
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import torch

import crptpro.experiments.measurements  # noqa: F401 - makes its kinds of pieces known
from crptpro.cards import cpu_cores, provenance, write_json
from crptpro.directory_lock import DirectoryLock
from crptpro.errors import RecordError
from crptpro.experiments.pieces import (
    DatasetPiece,
    ExploredPiece,
    FinetunedPiece,
    Piece,
    PretrainedPiece,
    RunPiece,
    UntrainedPiece,
)
from crptpro.experiments.store import CLOCK, DONE, Store
from crptpro.experiments.work_clock import WorkClock

if TYPE_CHECKING:
    from torchrl.objectives import LossModule

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class JobSettings:
    """Where and how pieces are made; none of it is part of what they are.

    Args:
        device: of networks.
        threads: of torch, in each job.
        workers: collecting processes of a job that collects.
        plugins: modules that a job loads first, for methods and domains of the user's own.
    """

    device: str = "cpu"
    threads: int = 1
    workers: int = 1
    plugins: tuple[str, ...] = ()


def build(piece: Piece, store: Store, job: JobSettings | None = None) -> None:
    """Make a piece, or continue it; what it needs must be finished. A finished piece is left as it is.

    Args:
        piece: to make.
        store: where it is kept.
        job: where and how it is made.

    Raises:
        RecordError: if something it needs is missing, or its directory is in use.
        CRPTproError: whatever the stage refuses.
    """
    import crptpro.experiments.measuring  # noqa: F401 - imports this module; what it registers is needed below

    if store.is_done(piece):
        _remove_leftovers(piece, store)  # of a job that was killed before it came to that
        return
    for needed in piece.needs:
        if not store.is_done(needed, for_piece=piece):
            raise RecordError(f"{piece.key} needs {needed.key}, which is not finished in {store.root}.")
    job = job or JobSettings(threads=cpu_cores())
    torch.set_num_threads(job.threads)
    store.describe(piece)
    directory = store.path(piece)
    with DirectoryLock(directory, error=RecordError, is_reentrant=True):
        if store.is_recorded(piece):  # and no more than that: the records are made again too
            store.forget(piece)
        with WorkClock(directory / CLOCK) as clock:
            make(piece, store, job)
        spent = {"seconds": clock.seconds, "attempts": clock.attempts}
        write_json(directory / DONE, {**spent, "job": asdict(job), **provenance()})
        clock.path.unlink(missing_ok=True)
        _remove_leftovers(piece, store)


def _remove_leftovers(piece: Piece, store: Store) -> None:
    for name in piece.leftovers:  # gigabytes, of a downstream run
        shutil.rmtree(store.path(piece) / name, ignore_errors=True)


@functools.singledispatch
def make(piece: Piece, store: Store, job: JobSettings) -> None:
    """Make one kind of piece; every kind registers its own way here."""
    raise RecordError(f"Nothing makes a piece of kind {piece.kind!r}.")


register: Callable[..., Any] = make.register


def new_loss(piece: PretrainedPiece | ExploredPiece) -> LossModule:
    """Return what an encoder's training starts from: its method's loss on a fresh encoder."""
    from crptpro.objectives import get_method
    from crptpro.seeding import seed_everything

    method = get_method(piece.method)
    seed_everything(piece.seed)
    options = dict(piece.encoder) if isinstance(piece, PretrainedPiece) else {}
    return method.build(method.build_encoder(**options), **dict(piece.loss))


@register
def _(piece: DatasetPiece, store: Store, job: JobSettings) -> None:
    from crptpro.data import collect_random

    collect_random(
        piece.domain,
        store.path(piece),
        transitions=piece.transitions,
        seed=piece.seed,
        workers=job.workers,
        quality=piece.quality,
        colors=piece.colors,
    )


@register
def _(piece: UntrainedPiece, store: Store, job: JobSettings) -> None:
    from crptpro.pretrained import random_pretrained, save_pretrained

    save_pretrained(random_pretrained(seed=piece.seed), store.encoder(piece))


@register
def _(piece: PretrainedPiece, store: Store, job: JobSettings) -> None:
    from crptpro.loggers import RunLogger
    from crptpro.pretrained import encoder_snapshots, save_pretrained
    from crptpro.training import pretrain

    loss = new_loss(piece)
    run_dir = store.path(piece)
    with RunLogger(run_dir, config=_record(piece)) as records:
        pretrain(
            loss,
            [store.dataset(dataset) for dataset in piece.datasets],
            updates=piece.updates,
            seed=piece.seed,
            device=job.device,
            run_dir=run_dir,
            logger=records,
            at_updates=encoder_snapshots(run_dir, piece.snapshots),
            **dict(piece.training),
        )
        save_pretrained(loss, store.encoder(piece))


@register
def _(piece: ExploredPiece, store: Store, job: JobSettings) -> None:
    from crptpro.loggers import RunLogger
    from crptpro.objectives import exploration_defaults
    from crptpro.pretrained import save_pretrained
    from crptpro.training import ActiveConfig, pretrain_active

    loss = new_loss(piece)
    run_dir = store.path(piece)
    # A job of one core does one thing at a time: another job has the other cores.
    ahead: dict[str, Any] = {"render_ahead": False} if job.threads == 1 else {}
    config = ActiveConfig(**dict(piece.explore), **ahead, seed=piece.seed, device=job.device)
    with RunLogger(run_dir, config=_record(piece)) as records:
        result = pretrain_active(loss, piece.domains, config=config, run_dir=run_dir, logger=records)
        hands_over = exploration_defaults(loss).transfers_actor
        actor = next(iter(result.actors.values())) if hands_over else None
        save_pretrained(loss, store.encoder(piece), actor=actor)


@register
def _(piece: FinetunedPiece, store: Store, job: JobSettings) -> None:
    from crptpro.loggers import RunLogger
    from crptpro.pretrained import finetune, load_pretrained, save_pretrained
    from crptpro.seeding import seed_everything

    seed_everything(piece.seed)
    run_dir = store.path(piece)
    with RunLogger(run_dir, config=_record(piece)) as records:
        loss, _ = finetune(
            load_pretrained(store.encoder(piece.base)),
            store.dataset(piece.dataset),
            updates=piece.updates,
            seed=piece.seed,
            device=job.device,
            run_dir=run_dir,
            logger=records,
            **dict(piece.training),
        )
        save_pretrained(loss, store.encoder(piece))


@register
def _(piece: RunPiece, store: Store, job: JobSettings) -> None:
    from crptpro.experiments.budgets import run_config
    from crptpro.loggers import RunLogger
    from crptpro.pretrained import load_pretrained
    from crptpro.training import train_downstream

    # As above; neither changes a number. With several cores a run evaluates in no more processes than it has threads.
    alone: dict[str, Any] = {"eval_workers": 0, "render_ahead": False} if job.threads == 1 else {}
    config = run_config(piece, device=job.device, **alone)
    run_dir = store.path(piece)
    pretrained = None if piece.encoder is None else load_pretrained(store.encoder(piece.encoder))
    with RunLogger(run_dir, config={"task": piece.task, **asdict(config)}) as records:
        train_downstream(piece.task, pretrained, config=config, run_dir=run_dir, logger=records)


def _record(piece: Piece) -> dict[str, Any]:
    return {"piece": piece.to_json()}
