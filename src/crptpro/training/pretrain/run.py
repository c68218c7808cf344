"""One pre-training run: its updates, its record, its checkpoints."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.objectives import LossModule

from crptpro.cards import provenance, require_disk
from crptpro.errors import CheckpointError
from crptpro.loggers import RunLogger
from crptpro.modules import is_channels_last
from crptpro.seeding import global_rng_state, set_global_rng_state
from crptpro.training.checkpoint import CHECKPOINTS, CheckpointDir
from crptpro.training.collapse import CollapseMonitor
from crptpro.training.fingerprint import require_same
from crptpro.training.pretrain.identity import identity_of
from crptpro.training.pretrain.learner import Learner
from crptpro.training.pretrain.progress import PretrainProgress
from crptpro.training.pretrain.result import PretrainResult, metrics_of, training_record
from crptpro.training.pretrain.turns import Turns
from crptpro.training.pretrain.window import Window, cosine_threshold, memory_row, num_prototypes
from crptpro.training.stop_request import StopRequest, what_is_kept

_LOG = logging.getLogger(__name__)

STREAM = "pretrain"
CHECKPOINT_SECONDS = 300.0


class PretrainRun:
    """State of one call of :func:`~crptpro.training.pretrain`: what is done, logged and checkpointed.

    Args:
        loss: on ``device``, in its compute dtype.
        turns: makes the batches, by the schedule of the domains.
        learner: does the updates.
        settings: ``updates``, ``batch_size``, intervals, ``seed``, ``patience_updates``.
        device: where to train.
        precision: for the record.
        logger: record, if any.
        run_dir: directory of the checkpoints, if any.
        at_updates: what to call with the loss when so many updates are done.
    """

    def __init__(
        self,
        loss: LossModule,
        turns: Turns,
        *,
        learner: Learner,
        settings: dict[str, Any],
        device: torch.device,
        precision: str,
        logger: RunLogger | None,
        run_dir: Path | None,
        at_updates: Mapping[int, Callable[[LossModule], Any]] | None = None,
    ) -> None:
        self.loss, self.turns, self.learner = loss, turns, learner
        self.settings, self.device, self.precision = settings, device, precision
        self.logger, self.run_dir, self.at_updates = logger, run_dir, at_updates or {}
        self.window = Window(loss, turns.names, is_mixed=turns.schedule == "mixed")
        self.monitor = CollapseMonitor(
            num_prototypes(loss),
            patience_updates=settings["patience_updates"],
            cosine_threshold=cosine_threshold(loss),
        )
        self.checkpoints = None if run_dir is None else CheckpointDir(run_dir / CHECKPOINTS)
        self.history: list[dict[str, Any]] = []
        self.done = self.resumed_from = 0
        self.is_repeated = False
        self.saved_at: int | None = None
        self.earlier_seconds = 0.0
        self.made_with = provenance()
        self.started = self.row_started = self.saved_time = time.monotonic()
        self.row_updates = 0
        self.fingerprint = identity_of(learner, turns, settings, precision=precision)

    @property
    def seconds(self) -> float:
        """Training time so far, resumptions included."""
        return self.earlier_seconds + time.monotonic() - self.started

    def prepare(self, state: dict[str, Any] | None) -> None:
        """Continue from what :func:`read_state` found, or clear the record for a fresh start."""
        if state is not None:
            self._load(state)
            return
        if self.checkpoints is not None:
            # Rows of an attempt that was killed before its first checkpoint; elsewhere they may be another run's.
            if self.logger is not None and self.logger.writes_into(self.checkpoints.path.parent):
                self.logger.truncate_to(STREAM, "updates", -1)
            size = sum(p.numel() * p.element_size() for p in self.loss.parameters())
            # Weights, targets and two Adam moments; two checkpoints kept while a third is written.
            require_disk(self.checkpoints.path, 4 * 3 * size, "Checkpointing this run")

    def train(self, *, progress: bool) -> PretrainResult:
        """Do the updates that are left and say how it went."""
        total, interval = self.settings["updates"], self.settings["log_interval"]
        shown = PretrainProgress(total, self.done, is_shown=progress)
        if progress and self.done < total:
            _LOG.info(
                "pretrain: %s updates of batch %d, %s (%s); %s on %s",
                f"{total:,}", self.settings["batch_size"], self.turns.words, ", ".join(self.turns.domains),
                self.precision, self.device,
            )  # fmt: skip
        with StopRequest() as stop, shown:
            while self.done < total:
                self._update(interval)
                shown.update()
                if self.done % interval == 0:
                    self.learner.check(self.done)
                    row = self._log()
                    self.window.close()
                    shown.row(self.done, row["loss"])
                if self.done in self.at_updates:
                    self._call_back()
                if self.done == total or stop.signal is not None or self._checkpoint_is_due():
                    self.save()
                if stop.signal is not None:
                    kept = what_is_kept(self.checkpoints)
                    _LOG.warning("Stopped at update %d of %d; %s.", self.done, total, kept)
                    stop.leave()
        return self._finish()

    def save(self) -> None:
        """Write a checkpoint of everything that a resumed run needs."""
        self.learner.check(self.done)
        if self.checkpoints is None or self.saved_at == self.done:
            return
        state = {
            "fingerprint": self.fingerprint,
            "updates": self.done,
            "seconds": self.seconds,
            "learner": self.learner.state_dict(),
            **self.turns.state_dict(),
            "global_rng": global_rng_state(),
            "window": self.window.state_dict(),
            "monitor": self.monitor.state_dict(),
            "made_with": self.made_with,
            "logger": None if self.logger is None else self.logger.state_dict([STREAM]),
        }
        self.checkpoints.save(state, counter=self.done)
        self.saved_at, self.saved_time = self.done, time.monotonic()

    def _call_back(self) -> None:
        """Hand the loss out, before this update's checkpoint: what a checkpoint has behind it was handed out."""
        self.learner.check(self.done)
        row = self.history[-1] if self.history else {}
        self._describe(self.seconds, metrics_of(row), self.monitor.verdict(self.done))
        self.at_updates[self.done](self.loss)

    def _load(self, state: dict[str, Any]) -> None:
        require_same(state["fingerprint"], self.fingerprint, self.run_dir)
        if state["updates"] > self.settings["updates"]:
            raise CheckpointError(
                f"{self.run_dir} has done {state['updates']} updates, {self.settings['updates']} are asked: "
                "ask for at least as many, or choose another run directory."
            )
        self.done = self.resumed_from = self.saved_at = state["updates"]
        self.row_updates = self.done
        self.earlier_seconds = state["seconds"]
        self.learner.load_state_dict(state["learner"])
        self.turns.load_state_dict(state)
        set_global_rng_state(state["global_rng"])
        self.window.load_state_dict(state["window"], self.device)
        self.monitor.load_state_dict(state["monitor"])
        self.is_repeated = (
            self.done == self.settings["updates"] and self._last_row().get("updates") == self.done
        )
        if self.logger is not None and state["logger"] is not None and not self.is_repeated:
            self.logger.load_state_dict(state["logger"])
        if self.done == self.settings["updates"]:
            self.made_with = state["made_with"]  # nothing is trained now: say what did it
        else:
            _LOG.info("Pre-training continues from update %d.", self.done)

    def _update(self, log_interval: int) -> None:
        turn = self.turns.turn(self.done)
        batch = self.turns.batch(turn)
        values = self.learner.update(batch, index=self.done, domain=self.turns.names[turn])
        self.window.add(values, turn)
        self.done += 1
        is_last_of_window = -self.done % log_interval < self.turns.probed_updates
        is_last_of_run = self.settings["updates"] - self.done < self.turns.probed_updates
        if (is_last_of_window or is_last_of_run) and "embedding_cosine" not in self.learner.names:
            self.window.probe(batch, turn)

    def _log(self) -> dict[str, float]:
        row = self._row()
        self.monitor.observe(self.done, comp=_comp(row), cosine=self.window.cosines or None)
        self._write(row)
        return row

    def _row(self) -> dict[str, float]:
        now = time.monotonic()
        row = self.window.row(self.learner.names)
        if self.done > max(self.row_updates, self.resumed_from) and now > self.row_started:
            row["updates_per_s"] = (self.done - self.row_updates) / (now - self.row_started)
        return {**row, **memory_row(self.device)}

    def _write(self, row: dict[str, float]) -> None:
        self.row_started, self.row_updates = time.monotonic(), self.done
        self.history.append({"updates": self.done, **row})
        if self.logger is not None:
            self.logger.log(row, stream=STREAM, updates=self.done)

    def _checkpoint_is_due(self) -> bool:
        interval = self.settings["checkpoint_interval"]
        if interval is not None:
            return self.done % interval == 0
        return time.monotonic() - self.saved_time >= CHECKPOINT_SECONDS

    def _finish(self) -> PretrainResult:
        if self.done % self.settings["log_interval"]:
            # A last row for the part of a window; it is not in the checkpoint, so an extended run takes it
            # back.
            row = self._log() if not self.is_repeated else self._last_row()
            if self.is_repeated:
                # The checkpoint was written before this row measured its cosines.
                self.window.row(self.learner.names)
                self.monitor.observe(self.done, comp=_comp(row), cosine=self.window.cosines or None)
        else:
            row = self.history[-1] if self.history else self._last_row()
        metrics, seconds = metrics_of(row), self.seconds
        verdict = self.monitor.finish(self.done)
        self._describe(seconds, metrics, verdict)
        return PretrainResult(
            updates=self.done,
            resumed_from=self.resumed_from,
            seconds=seconds,
            precision=self.precision,
            metrics=metrics,
            collapse=verdict,
            history=self.history,
            run_dir=self.run_dir,
        )

    def _describe(self, seconds: float, metrics: dict[str, float], verdict: dict[str, Any]) -> None:
        """Say on the loss how it was trained so far, for an artifact's card."""
        self.loss.training_record = training_record(
            self.loss,
            updates=self.done,
            seconds=seconds,
            precision=self.precision,
            channels_last=is_channels_last(self.loss),
            compile=self.learner.compiled.is_on,
            cuda_graph=self.learner.captured is not None,
            device=str(self.device),
            settings={
                key: value for key, value in self.fingerprint.items() if key not in ("loss", "datasets")
            },
            datasets=[source.facts() for source in self.turns.sources],
            metrics=metrics,
            collapse=verdict,
            made_with=self.made_with,
        )

    def _last_row(self) -> dict[str, Any]:
        rows = [] if self.logger is None else self.logger.rows(STREAM)
        return {key: value for key, value in rows[-1].items() if key != "unix_time_s"} if rows else {}


def read_state(run_dir: str | Path, *, resume: bool) -> dict[str, Any] | None:
    """Return what a run directory's newest checkpoint holds; ``None`` where there is none.

    Raises:
        CheckpointError: there is one and it is not to be continued, or all are damaged.
    """
    checkpoints = CheckpointDir(Path(run_dir) / CHECKPOINTS)
    if not resume and checkpoints.latest_counter() is not None:
        raise CheckpointError(f"{run_dir} already holds a run. Choose another directory, or resume it.")
    return checkpoints.load_latest()


def _comp(row: dict[str, float]) -> float | None:
    """The comparative loss in nats, without its coefficient."""
    return row.get("comp", row.get("loss_comp"))
