"""What training an encoder costs: some of its updates on the clock, the whole of it by proportion."""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from typing import Any, NamedTuple

import torch
from torchrl.objectives import LossModule

from crptpro.errors import RecordError
from crptpro.experiments.budgets import budget, exploration_config, exploration_plan
from crptpro.experiments.building import JobSettings, new_loss
from crptpro.experiments.measurements import TimingPiece
from crptpro.experiments.pieces import DatasetPiece, EncoderPiece, ExploredPiece, PretrainedPiece
from crptpro.experiments.row_files import read_rows
from crptpro.experiments.store import Store
from crptpro.training import pretrain, pretrain_active

COLUMNS = (
    "method", "domains", "encoder_updates", "decisions", "seconds", "seconds_per_update", "seconds_per_decision",
    "budget_updates", "budget_decisions", "projected_hours", "paper_updates", "paper_decisions",
    "paper_seconds_per_update", "paper_projected_hours", "collection_seconds", "threads", "device",
)  # fmt: skip
"""Of ``timing.csv``, which has one row: what was timed; what that makes per encoder update (the decisions and the
agents' updates that go with it included) and per decision; the whole pre-training at the scale of the request, and at
that of the paper by updates with the paper's batches and decisions (empty if those were not timed), both without the
random decisions before the first update; and the collection of the datasets, which is not part of the other times."""

WINDOWS = 5
"""Parts whose median duration counts, so that one hiccup of the machine does not."""
RANDOM_AGENT_STEPS = 24
"""Random decisions per domain before a timed exploration, instead of the method's own."""


class Timed(NamedTuple):
    """A timed part of a training.

    Args:
        updates: of the encoder.
        decisions: of exploring agents.
        seconds: of all of it.
        seconds_per_update: by the median over windows.
    """

    updates: int
    decisions: int
    seconds: float
    seconds_per_update: float


class UpdateClock:
    """Notes when every ``window``-th update of a loss begins, once it is warm.

    Args:
        loss: whose forward calls count as updates.
        period: updates after which all domains have had their turn; windows and warm-up are multiples of it.
        updates: that are timed at least.
        device: waited for at every note.
    """

    def __init__(self, loss: LossModule, period: int, updates: int, device: str) -> None:
        self.window = period * math.ceil(updates / (WINDOWS * period))
        self.warm_up = period * math.ceil(updates / period)
        self._device = torch.device(device)
        self._count = 0
        self._notes: list[float] = []
        self._handle = loss.register_forward_pre_hook(self._note)

    @property
    def updates(self) -> int:
        """How many have to be made."""
        return self.warm_up + WINDOWS * self.window + 1

    def read(self, decisions_per_update: float) -> Timed:
        """Return what was measured; the loss is left as it was."""
        self._handle.remove()
        spans = [later - earlier for earlier, later in zip(self._notes, self._notes[1:])][:WINDOWS]
        updates = self.window * WINDOWS
        return Timed(
            updates,
            round(updates * decisions_per_update),
            sum(spans),
            statistics.median(spans) / self.window,
        )

    def _note(self, *_: Any) -> None:
        since = self._count - self.warm_up
        self._count += 1
        if since >= 0 and since % self.window == 0:
            if self._device.type == "cuda":
                torch.cuda.synchronize(self._device)
            self._notes.append(time.perf_counter())


def time_training(encoder: EncoderPiece, store: Store, job: JobSettings, *, updates: int) -> Timed:
    """Train an encoder for a short while, in a temporary directory, and time the later half.

    Rows of the record and checkpoints are not part of it.

    Args:
        encoder: whose training; its datasets must be there, it itself need not.
        store: where the datasets are.
        job: device and threads.
        updates: encoder updates to time.

    Raises:
        RecordError: for an encoder that is not trained on datasets or by exploring.
    """
    torch.set_num_threads(job.threads)
    if isinstance(encoder, PretrainedPiece):
        return _time_datasets(encoder, store, job, updates)
    if isinstance(encoder, ExploredPiece):
        return _time_exploration(encoder, job, updates)
    raise RecordError(f"{encoder.key} has no training of its own to be timed.")


def _time_datasets(encoder: PretrainedPiece, store: Store, job: JobSettings, updates: int) -> Timed:
    loss = new_loss(encoder)
    clock = UpdateClock(loss, len(encoder.datasets), updates, job.device)
    pretrain(
        loss,
        [store.dataset(dataset) for dataset in encoder.datasets],
        updates=clock.updates,
        seed=encoder.seed,
        device=job.device,
        progress=False,
        **{**dict(encoder.training), "log_interval": 2 * clock.updates},
    )
    return clock.read(0)


def _time_exploration(encoder: ExploredPiece, job: JobSettings, updates: int) -> Timed:
    config, plan = exploration_config(encoder), exploration_plan(encoder)
    loss = new_loss(encoder)
    period = len(encoder.domains) * plan.encoder_updates_each
    clock = UpdateClock(loss, period, updates, job.device)
    first = max(min(plan.random_agent_steps, RANDOM_AGENT_STEPS), config.n_step or 1)
    interval = plan.encoder_update_interval
    # The first update comes with the first multiple of the interval that is not random.
    rounds = interval * (math.ceil(first / interval) + math.ceil(clock.updates / period) - 1) + 1
    share = sum(plan.repeats) if config.steps_budget == "total" else max(plan.repeats)
    short = dataclasses.replace(
        config,
        env_steps=rounds * share,
        random_agent_steps=min(plan.random_agent_steps, first),
        log_interval=10 * clock.updates,
        checkpoint_interval_env_steps=rounds * sum(plan.repeats),
        device=job.device,
    )
    pretrain_active(loss, encoder.domains, config=short, progress=False)
    return clock.read(interval / plan.encoder_updates_each)


def timing_row(piece: TimingPiece, store: Store, job: JobSettings) -> dict[str, Any]:
    """Return the row of a timing, by :data:`COLUMNS`; of several encoders, the sum over theirs."""
    if len(piece.encoders) > 1:
        return _sum([read_rows(store.path(part) / "timing.csv")[0] for part in piece.parts])
    (encoder,), (paper,) = piece.encoders, piece.paper
    job = dataclasses.replace(job, device=piece.device, threads=piece.threads)
    timed = time_training(encoder, store, job, updates=piece.updates)
    whole, at_paper = budget(encoder), budget(paper)
    per_paper_update = _time_paper(piece, timed, store, job)
    data = [store.seconds(needed) for needed in piece.needs if isinstance(needed, DatasetPiece)]
    return {
        "method": encoder.method,
        "domains": len(encoder.domain_names),
        "encoder_updates": timed.updates,
        "decisions": timed.decisions,
        "seconds": timed.seconds,
        "seconds_per_update": timed.seconds_per_update,
        "seconds_per_decision": _per_decision(timed.seconds_per_update, timed.updates, timed.decisions),
        "budget_updates": whole.updates,
        "budget_decisions": whole.decisions,
        "projected_hours": timed.seconds_per_update * whole.updates / 3600,
        "paper_updates": at_paper.updates,
        "paper_decisions": at_paper.decisions,
        "paper_seconds_per_update": "" if per_paper_update is None else per_paper_update,
        "paper_projected_hours": ""
        if per_paper_update is None
        else per_paper_update * at_paper.updates / 3600,
        "collection_seconds": sum(data) if data else "",
        "threads": job.threads,
        "device": job.device,
    }


def _time_paper(piece: TimingPiece, timed: Timed, store: Store, job: JobSettings) -> float | None:
    """Return the seconds per encoder update with the paper's batches; ``None`` if they are not asked for."""
    (encoder,), (paper,) = piece.encoders, piece.paper
    if encoder == paper:
        return timed.seconds_per_update
    if not piece.paper_timed:
        return None
    if isinstance(encoder, PretrainedPiece) and isinstance(paper, PretrainedPiece):
        paper = dataclasses.replace(
            paper, datasets=encoder.datasets
        )  # what is in them does not change the time
    return time_training(paper, store, job, updates=piece.paper_timed).seconds_per_update


def _sum(rows: list[dict[str, str]]) -> dict[str, Any]:
    """Add the costs of several encoders up; per update, what the whole takes."""
    same = {name: rows[0][name] for name in ("method", "threads", "device")}
    counted = {
        name: sum(int(row[name]) for row in rows)
        for name in (
            "domains", "encoder_updates", "decisions", "budget_updates", "budget_decisions", "paper_updates",
            "paper_decisions",
        )
    }  # fmt: skip
    measured: dict[str, Any] = {
        name: sum(float(row[name]) for row in rows) for name in ("seconds", "projected_hours")
    }
    at_paper: dict[str, float | str] = {"paper_seconds_per_update": "", "paper_projected_hours": ""}
    if all(row["paper_projected_hours"] for row in rows):
        hours = sum(float(row["paper_projected_hours"]) for row in rows)
        at_paper["paper_projected_hours"] = hours
        at_paper["paper_seconds_per_update"] = 3600 * hours / counted["paper_updates"]
    data = [float(row["collection_seconds"]) for row in rows if row["collection_seconds"]]
    per_update = 3600 * measured["projected_hours"] / counted["budget_updates"]
    return {
        **same,
        **counted,
        **measured,
        **at_paper,
        "seconds_per_update": per_update,
        "seconds_per_decision": _per_decision(per_update, counted["encoder_updates"], counted["decisions"]),
        "collection_seconds": sum(data) if data else "",
    }


def _per_decision(seconds_per_update: float, updates: int, decisions: int) -> float | str:
    return seconds_per_update * updates / decisions if decisions else ""
