"""What becomes of a job that ends badly, is stopped, or is not taken by the queue."""

from __future__ import annotations

import signal
import time
from dataclasses import dataclass

import pytest
from fake_launcher import LOST, REFUSED, FakeJob, FakeLauncher, run
from fake_pieces import FakePiece, plan_of

from crptpro.cards import write_json
from crptpro.errors import SubmissionError
from crptpro.experiments.building import JobSettings
from crptpro.experiments.launching import Failure, Outcome, Work, run_pieces
from crptpro.experiments.store import DONE, Store


def test_a_lost_job_is_started_again(store: Store, caplog: pytest.LogCaptureFixture) -> None:
    launcher = FakeLauncher({"p": [LOST, LOST]})
    assert run(store, launcher, FakePiece("p")) == []
    assert launcher.events.count("p starts") == 3
    assert "attempt 2 of 3" in caplog.text


def test_a_job_is_not_started_again_for_ever(store: Store) -> None:
    launcher = FakeLauncher({"p": [LOST] * 9})
    piece = FakePiece("p")
    [failure] = run(store, launcher, piece, attempts=2)
    assert launcher.events.count("p starts") == 2
    assert failure == Failure(piece, LOST.reason, store.log(piece), 2)


def test_an_error_of_the_library_is_final_and_what_needs_the_piece_is_skipped(store: Store) -> None:
    bad = FakePiece("bad")
    encoder = FakePiece("encoder", (bad,))
    launcher = FakeLauncher({"bad": [REFUSED]})
    failures = run(store, launcher, FakePiece("run", (encoder,)), FakePiece("good"))
    assert [(f.piece, f.is_skipped) for f in failures] == [
        (bad, False), (encoder, True), (FakePiece("run", (encoder,)), True),
    ]  # fmt: skip
    assert launcher.events.count("bad starts") == 1
    assert store.is_done(FakePiece("good"))


def test_a_job_that_was_lost_after_its_piece_was_finished_is_none_the_worse(store: Store) -> None:
    piece = FakePiece("p")
    launcher = FakeLauncher({"p": [LOST]})
    launcher._ended = lambda job: write_json(job.work.log.parent / DONE, {"seconds": 1.0})  # type: ignore[method-assign]
    assert run(store, launcher, piece) == []
    assert launcher.events == ["p starts"]


def test_a_job_that_ends_well_and_leaves_its_piece_unfinished_has_failed(store: Store) -> None:
    launcher = FakeLauncher()
    launcher._ended = lambda job: None  # type: ignore[method-assign]
    [failure] = run(store, launcher, FakePiece("p"))
    assert "unfinished" in failure.reason


@pytest.mark.parametrize(
    ("number", "error"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)]
)
def test_a_signal_stops_every_job_once_and_starts_none(
    store: Store, number: int, error: type[BaseException]
) -> None:
    class Interrupted(FakeLauncher):
        def start(self, work: Work, *, is_exclusive: bool) -> FakeJob:
            job = super().start(work, is_exclusive=is_exclusive)
            if len(self.jobs) == 2:
                signal.raise_signal(number)
            return job

    launcher = Interrupted(polls=1_000)
    with pytest.raises(error):
        run(store, launcher, *(FakePiece(f"p{index}") for index in range(4)))
    assert [job.stops for job in launcher.jobs] == [1, 1]
    assert launcher.running == 0


def test_a_second_signal_stops_them_at_once(store: Store) -> None:
    @dataclass
    class Slow(FakeJob):
        def stop(self) -> None:
            self.stops += 1
            if self.stops == 1:
                signal.raise_signal(signal.SIGINT)  # the user does not want to wait
            else:
                self.polls = 1

    class Interrupted(FakeLauncher):
        def start(self, work: Work, *, is_exclusive: bool) -> FakeJob:
            self.jobs.append(Slow(work, 10_000, Outcome(), self._ended))
            signal.raise_signal(signal.SIGINT)
            return self.jobs[-1]

    launcher = Interrupted()
    with pytest.raises(KeyboardInterrupt):
        run(store, launcher, FakePiece("p"))
    assert launcher.jobs[0].stops == 2


class Full(FakeLauncher):
    """Fails at the second job."""

    def start(self, work: Work, *, is_exclusive: bool) -> FakeJob:
        if self.jobs:
            raise OSError("no space left")
        return super().start(work, is_exclusive=is_exclusive)


def test_jobs_are_stopped_when_the_scheduler_itself_fails(store: Store) -> None:
    launcher = Full(polls=1_000)
    with pytest.raises(OSError, match="no space"):
        run(store, launcher, FakePiece("a"), FakePiece("b"))
    assert launcher.jobs[0].stops == 1


def test_what_has_failed_is_known_also_where_an_error_ends_the_rest(store: Store) -> None:
    bad = FakePiece("bad")
    failures: list[Failure] = []
    plan = plan_of(store, bad, FakePiece("encoder", (bad,)), FakePiece("good"))
    with pytest.raises(OSError, match="no space"):
        run_pieces(plan, store, JobSettings(), Full({"bad": [REFUSED]}), poll_s=0.0, failures=failures)
    assert [(f.piece.title, f.is_skipped) for f in failures] == [("bad", False), ("encoder", True)]


@dataclass
class Queue(FakeLauncher):
    """Refuses the jobs that it is told to, by their number."""

    refuses: tuple[int, ...] = ()
    asked: int = 0

    def start(self, work: Work, *, is_exclusive: bool) -> FakeJob:
        self.asked += 1
        if self.asked in self.refuses:
            raise SubmissionError("sbatch refused a job: the queue is full.")
        return super().start(work, is_exclusive=is_exclusive)


def test_a_piece_that_the_queue_refuses_for_a_while_waits_and_no_attempt_is_counted(
    store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    queue = Queue({"b": [LOST]}, refuses=(2, 3, 5))
    pieces = [FakePiece("a"), FakePiece("b"), FakePiece("c")]
    assert run(store, queue, *pieces, attempts=2, refused_s=0) == []
    assert all(store.is_done(piece) for piece in pieces)
    assert caplog.text.count("the queue is full") == 1


def test_a_queue_that_refused_a_job_is_left_alone_for_a_while(store: Store) -> None:
    queue = Queue(refuses=(2,))
    began = time.monotonic()
    assert run(store, queue, FakePiece("a"), FakePiece("b"), refused_s=0.3) == []
    assert time.monotonic() - began >= 0.3
    assert queue.asked == 3


def test_a_queue_that_refuses_the_first_job_ends_it(store: Store) -> None:
    queue = Queue(refuses=(1,))
    with pytest.raises(SubmissionError, match="the queue is full"):
        run(store, queue, FakePiece("a"), FakePiece("b"))
    assert queue.asked == 1
