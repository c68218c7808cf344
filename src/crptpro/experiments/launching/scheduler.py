"""Make the pieces of a plan: each when what it needs is there, several at a time, again where a job was lost."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from tqdm import tqdm

from crptpro.errors import SubmissionError
from crptpro.experiments.building import JobSettings
from crptpro.experiments.durations import duration
from crptpro.experiments.launching.launchers import Job, Launcher, Outcome
from crptpro.experiments.launching.work import Work
from crptpro.experiments.pieces import DatasetPiece, Piece
from crptpro.experiments.plan import Plan
from crptpro.experiments.store import Store
from crptpro.training.stop_request import StopRequest

logger = logging.getLogger(__name__)

POLL_S = 0.2
REFUSED_S = 60.0
"""How long a queue is left alone that refused a job: a controller restarts, or jobs of others end."""

LAST_WAIT_S = 10.0
"""How long jobs have that were told to end at once."""


@dataclass(frozen=True)
class Failure:
    """A piece that was not made.

    Args:
        piece: which.
        reason: why, in a line.
        log: what its jobs said; ``None`` if none was started, since something that it needs failed.
        attempts: how many jobs tried.
    """

    piece: Piece
    reason: str
    log: Path | None = None
    attempts: int = 0

    @property
    def is_skipped(self) -> bool:
        """Whether it was never tried."""
        return self.log is None


@dataclass
class _Running:
    piece: Piece
    job: Job
    began: float


def run_pieces(
    plan: Plan,
    store: Store,
    settings: JobSettings,
    launcher: Launcher,
    *,
    jobs: int = 1,
    attempts: int = 3,
    poll_s: float = POLL_S,
    refused_s: float = REFUSED_S,
    failures: list[Failure] | None = None,
) -> list[Failure]:
    """Make every missing piece of a plan.

    A piece starts when all that it needs is finished, in the order of the plan; one that must be alone on its machine
    starts when nothing else can. Ctrl-C and SIGTERM stop all jobs at their next checkpoint, a second one at once.

    Args:
        plan: what is wanted; its finished pieces are left alone.
        store: where pieces are kept.
        settings: of every job. Where jobs share this machine, datasets have more workers while there is less to do than
            ``jobs``, and a piece that is alone has the threads of all.
        launcher: where jobs run.
        jobs: most jobs at a time.
        attempts: jobs that may try a piece whose job was lost or failed. An error of this library is final: the next
            attempt would end with it, too.
        poll_s: seconds between two looks at the jobs.
        refused_s: seconds until a queue is asked again that refused a job after it took others; no attempt is counted.
        failures: a list that what was not made is added to, also where an error ends this.

    Returns:
        What was not made: failures first, then what depends on them.

    Raises:
        SubmissionError: if a queue refuses the first job.
        KeyboardInterrupt: after Ctrl-C, when all jobs have ended.
        SystemExit: likewise after SIGTERM.
    """
    for piece in plan.pieces:
        store.describe(piece)
    missing = {piece.key for piece in plan.missing}
    for reader in plan.missing:
        for needed in reader.needs:
            # Finished, but without what this reader needs of it: its job would find nothing to do. What is finished
            # otherwise was finished by another command since the plan was made.
            is_lacking = store.is_done(needed) and not store.is_done(needed, for_piece=reader)
            if needed.key in missing and is_lacking:
                store.forget(needed)
    scheduler = _Scheduler(plan, store, settings, launcher, jobs, attempts, refused_s)
    shown = tqdm(total=len(plan.pieces), initial=len(plan.done), desc="pieces", unit="piece", disable=None)
    announcement = "Stopping at the next checkpoints; press Ctrl-C again to stop at once."
    with StopRequest(announcement) as stop, _hangup_as_termination(), shown:
        try:
            while scheduler.is_busy:
                if stop.signal is not None:
                    scheduler.stop()
                    stop.leave()
                shown.update(scheduler.look())
                if scheduler.start():
                    continue  # a job that ran in this process may have made way for others
                time.sleep(poll_s)
        except BaseException:
            scheduler.stop(LAST_WAIT_S)
            raise
        finally:
            if failures is not None:
                failures += scheduler.failures
    return scheduler.failures


class _Scheduler:
    def __init__(
        self,
        plan: Plan,
        store: Store,
        settings: JobSettings,
        launcher: Launcher,
        jobs: int,
        attempts: int,
        refused_s: float,
    ) -> None:
        self.store, self.settings, self.launcher = store, settings, launcher
        self.jobs, self.attempts, self.refused_s = jobs, attempts, refused_s
        self.total = len(plan.pieces)
        self.is_stopping = False
        self.waiting = list(plan.missing)
        self.finished = set(plan.done)
        self.running: list[_Running] = []
        self.tried: Counter[str] = Counter()
        self.failed: dict[str, Failure] = {}
        self.skipped: dict[str, Failure] = {}
        self.refused: set[str] = set()  # keys of pieces, until they are queued
        self.refusals: set[str] = set()  # what was said of them
        self.resumes = -math.inf

    @property
    def is_busy(self) -> bool:
        return bool(self.waiting or self.running)

    @property
    def failures(self) -> list[Failure]:
        return [*self.failed.values(), *self.skipped.values()]

    def start(self) -> bool:
        """Start what can be started, and say whether anything was."""
        self._skip()
        if time.monotonic() < self.resumes:
            return False
        ready = [p for p in self.waiting if all(needed.key in self.finished for needed in p.needs)]
        shared = [piece for piece in ready if not piece.is_exclusive]
        alone = [piece for piece in ready if piece.is_exclusive]
        if any(running.piece.is_exclusive for running in self.running):
            return False
        chosen = shared[: self.jobs - len(self.running)]
        if not shared and not self.running:
            chosen = alone[:1]
        share = max(1, self.jobs // max(1, len(self.running) + len(chosen)))
        for piece in chosen:
            try:
                self._start(piece, share)
            except SubmissionError as refusal:
                if not self.tried:
                    raise  # what is wrong with the first is wrong with all
                self._pause(piece, refusal)
                return piece is not chosen[0]
        return bool(chosen)

    def _pause(self, piece: Piece, refusal: SubmissionError) -> None:
        """Leave the piece waiting and the queue alone for a while, and say so once."""
        self.resumes = time.monotonic() + self.refused_s
        self.refused.add(piece.key)
        if str(refusal) not in self.refusals:
            self.refusals.add(str(refusal))
            logger.warning(
                "%s: %s It waits and is tried again every %g s; what runs goes on.",
                piece.key, refusal, self.refused_s,
            )  # fmt: skip

    def _start(self, piece: Piece, share: int) -> None:
        settings = self.settings
        if self.launcher.is_one_machine and isinstance(piece, DatasetPiece):
            settings = replace(settings, workers=settings.workers * share)
        if self.launcher.is_one_machine and piece.is_exclusive:
            settings = replace(settings, threads=settings.threads * self.jobs)
        if piece.key not in self.refused:
            logger.info("%s: started", piece.key)
        began = time.monotonic()
        work = Work(str(self.store.root.resolve()), piece.key, settings)
        job = self.launcher.start(work, is_exclusive=piece.is_exclusive)
        if piece.key in self.refused:
            self.refused.remove(piece.key)
            logger.info("%s: queued after all", piece.key)
        self.waiting.remove(piece)
        self.tried[piece.key] += 1
        self.running.append(_Running(piece, job, began))

    def look(self) -> int:
        """Take in what has ended; returns the number of pieces that it finished."""
        count = 0
        for running in list(self.running):
            outcome = running.job.poll()
            if outcome is None:
                continue
            self.running.remove(running)
            count += self._ended(running, outcome)
        return count

    def _ended(self, running: _Running, outcome: Outcome) -> bool:
        piece = running.piece
        took = duration(time.monotonic() - running.began)
        # The piece's own record decides: a job may have been lost after its work was done.
        if self.store.is_done(piece):
            self.finished.add(piece.key)
            logger.info("%s: finished in %s (%d of %d)", piece.key, took, len(self.finished), self.total)
            return True
        if self.is_stopping:
            logger.info("%s: stopped after %s", piece.key, took)
            return False
        reason = outcome.reason or "its job ended and left it unfinished"
        log = self.store.log(piece)
        tried = self.tried[piece.key]
        if outcome.is_final or tried >= self.attempts:
            self.failed[piece.key] = Failure(piece, reason, log, tried)
            logger.error("%s: failed after %s: %s (log: %s)", piece.key, took, reason, log)
        else:
            self.waiting.insert(0, piece)
            logger.warning(
                "%s: %s after %s; starting it again, attempt %d of %d (log: %s)",
                piece.key, reason, took, tried + 1, self.attempts, log,
            )  # fmt: skip
        return False

    def _skip(self) -> None:
        """Give up what needs something that failed; the plan's order has needs first."""
        for piece in list(self.waiting):
            for needed in piece.needs:
                if needed.key in self.failed or needed.key in self.skipped:
                    self.waiting.remove(piece)
                    self.skipped[piece.key] = Failure(piece, f"needs {needed.key}")
                    break

    def stop(self, wait_s: float = math.inf) -> None:
        """Stop all jobs, at their next checkpoints or, asked again, at once, and wait for them."""
        self.is_stopping = True
        for running in self.running:
            running.job.stop()
        deadline = time.monotonic() + wait_s
        while self.running and time.monotonic() < deadline:
            self.look()
            time.sleep(POLL_S)


@contextlib.contextmanager
def _hangup_as_termination() -> Iterator[None]:
    """Stop jobs when the terminal goes away, unless the caller (nohup) has asked to live on."""
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGHUP) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGHUP, lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
