"""Which piece starts when, and what becomes of a job that ends badly: with jobs that exist only in this test."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from fake_pieces import ExclusivePiece, FakePiece, plan_of

from crptpro.cards import write_json
from crptpro.errors import SubmissionError
from crptpro.experiments.building import JobSettings
from crptpro.experiments.launching import Failure, Outcome, Work, run_pieces
from crptpro.experiments.measurements import CoveragePiece
from crptpro.experiments.pieces import DatasetPiece, ExploredPiece, PretrainedPiece
from crptpro.experiments.store import DONE, Store

LOST = Outcome("the job was lost (killed)")
REFUSED = Outcome("it will never do", is_final=True)


@dataclass
class FakeJob:
    work: Work
    polls: int
    outcome: Outcome
    on_end: Callable[[FakeJob], None]
    stops: int = 0

    def poll(self) -> Outcome | None:
        self.polls -= 1
        if self.polls > 0:
            return None
        self.on_end(self)
        return self.outcome

    def stop(self) -> None:
        self.stops += 1
        self.polls = min(self.polls, 1)


@dataclass
class FakeLauncher:
    """Its jobs last some polls and end as told, by the name in their keys: well, if nothing is said."""

    outcomes: dict[str, list[Outcome]] = field(default_factory=dict)
    polls: int = 2
    is_one_machine: bool = True
    events: list[str] = field(default_factory=list)
    running: int = 0
    most: int = 0
    jobs: list[FakeJob] = field(default_factory=list)

    def start(self, work: Work, *, is_exclusive: bool) -> FakeJob:
        name = work.key.split("-")[-2]
        ends = self.outcomes.get(name, [])
        self.running += 1
        self.most = max(self.most, self.running)
        self.events.append(f"{name} starts")
        self.jobs.append(FakeJob(work, self.polls, ends.pop(0) if ends else Outcome(), self._ended))
        return self.jobs[-1]

    def _ended(self, job: FakeJob) -> None:
        self.running -= 1
        self.events.append(f"{job.work.key.split('-')[-2]} ends")
        if not job.outcome.reason and not job.stops:
            write_json(job.work.log.parent / DONE, {"seconds": 1.0})
            store = Store(Path(job.work.root))
            for path in store.outputs(store.described(job.work.key)):
                path.parent.mkdir(parents=True)
                path.touch()

    def close(self) -> None:
        pass


def run(
    store: Store, launcher: FakeLauncher, *pieces: FakePiece, jobs: int = 2, **options: Any
) -> list[Failure]:
    plan = plan_of(store, *pieces)
    return run_pieces(plan, store, JobSettings(), launcher, jobs=jobs, poll_s=0.0, **options)


def test_a_piece_starts_when_all_it_needs_is_finished(store: Store) -> None:
    left, right = FakePiece("left"), FakePiece("right")
    launcher = FakeLauncher()
    assert run(store, launcher, FakePiece("both", (left, right)), jobs=3) == []
    assert launcher.events == [
        "left starts", "right starts", "left ends", "right ends", "both starts", "both ends",
    ]  # fmt: skip


@pytest.mark.parametrize("jobs", [1, 2, 3])
def test_no_more_jobs_run_at_a_time_than_allowed(store: Store, jobs: int) -> None:
    launcher = FakeLauncher()
    run(store, launcher, *(FakePiece(f"p{index}") for index in range(5)), jobs=jobs)
    assert launcher.most == jobs


def test_an_exclusive_piece_runs_alone_when_nothing_else_can_start(store: Store) -> None:
    first, second = ExclusivePiece("first"), ExclusivePiece("second")
    launcher = FakeLauncher()
    run(store, launcher, first, FakePiece("a"), FakePiece("b", (second,)), second, FakePiece("c"))
    alone = launcher.events.index("first starts")
    assert launcher.events[:alone] == ["a starts", "c starts", "a ends", "c ends"]
    assert launcher.events[alone:] == [
        "first starts", "first ends", "second starts", "second ends", "b starts", "b ends",
    ]  # fmt: skip


def test_a_finished_piece_and_what_only_it_needed_are_left_alone(store: Store) -> None:
    data = FakePiece("data")
    encoder = FakePiece("encoder", (data,))
    store.describe(encoder)
    write_json(store.path(encoder) / DONE, {"seconds": 1.0})
    launcher = FakeLauncher()
    run(store, launcher, FakePiece("run", (encoder,)))
    assert launcher.events == ["run starts", "run ends"]


def test_an_explorer_without_its_replays_is_no_finished_piece_to_the_job_that_explores_again(
    store: Store,
) -> None:
    data = (DatasetPiece("walker", 10, 0),)
    explorer, judge = (
        ExploredPiece("proto-rl-c", 0, ("walker",)),
        PretrainedPiece("crptpro", 0, data, updates=1),
    )
    for piece in (*data, explorer, judge):
        store.describe(piece)
        write_json(store.path(piece) / DONE, {"seconds": 1.0})
        for path in store.outputs(piece):
            path.parent.mkdir(parents=True)
            path.touch()

    done_at_start = []

    class Watching(FakeLauncher):
        def start(self, work: Work, *, is_exclusive: bool) -> FakeJob:
            done_at_start.append(store.is_done(explorer))
            return super().start(work, is_exclusive=is_exclusive)

    run(store, Watching(), CoveragePiece(explorer, data, judge))
    assert done_at_start == [False, True]  # the explorer is made again, then what reads it


def test_what_another_command_has_finished_since_the_plan_was_made_stays(store: Store) -> None:
    data = DatasetPiece("walker", 10, 0)
    encoder = PretrainedPiece("crptpro", 0, (data,), updates=1)
    plan = plan_of(store, encoder)
    for piece in (data, encoder):
        store.describe(piece)
        write_json(store.path(piece) / DONE, {"seconds": 7.0})
        for path in store.outputs(piece):
            path.parent.mkdir(parents=True)
            path.write_text("made by another")

    class Idle(FakeLauncher):
        def start(self, work: Work, *, is_exclusive: bool) -> FakeJob:
            assert store.is_done(store.described(work.key))  # its job finds nothing to do
            job = super().start(work, is_exclusive=is_exclusive)
            job.stops = 1  # which the fake takes for: leaves nothing
            return job

    assert run_pieces(plan, store, JobSettings(), Idle(), jobs=2, poll_s=0.0) == []
    for piece in (data, encoder):
        assert store.seconds(piece) == 7.0
        assert [path.read_text() for path in store.outputs(piece)] == ["made by another"]


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


def test_every_piece_is_described_before_the_first_starts(store: Store) -> None:
    later = FakePiece("later", (FakePiece("sooner"),))

    class Looking(FakeLauncher):
        def start(self, work: Work, *, is_exclusive: bool) -> FakeJob:
            assert store.described(later.key) == later
            return super().start(work, is_exclusive=is_exclusive)

    run(store, Looking(), later)


def test_a_job_is_told_no_more_than_directory_key_and_settings(store: Store) -> None:
    launcher = FakeLauncher()
    piece = FakePiece("p")
    run(store, launcher, piece)
    assert launcher.jobs[0].work == Work(str(store.root.resolve()), piece.key, JobSettings())
    assert Path(launcher.jobs[0].work.root).is_absolute()


def test_datasets_share_the_cores_that_nobody_else_wants(store: Store) -> None:
    pieces = [DatasetPiece("walker", 10, seed) for seed in (0, 1)]
    launcher = FakeLauncher()
    plan = plan_of(store, *pieces)
    run_pieces(plan, store, JobSettings(workers=2), launcher, jobs=8, poll_s=0.0)
    assert [job.work.settings.workers for job in launcher.jobs] == [8, 8]
    elsewhere = FakeLauncher(is_one_machine=False)
    other = Store(store.root / "other")
    run_pieces(plan, other, JobSettings(workers=2), elsewhere, jobs=8, poll_s=0.0)
    assert [job.work.settings.workers for job in elsewhere.jobs] == [2, 2]


def test_a_piece_that_is_alone_has_the_cores_of_all(store: Store) -> None:
    launcher = FakeLauncher()
    plan = plan_of(store, ExclusivePiece("timing"), FakePiece("p"))
    run_pieces(plan, store, JobSettings(threads=2), launcher, jobs=3, poll_s=0.0)
    assert [job.work.settings.threads for job in launcher.jobs] == [2, 6]


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


def test_jobs_are_stopped_when_the_scheduler_itself_fails(store: Store) -> None:
    class Full(FakeLauncher):
        def start(self, work: Work, *, is_exclusive: bool) -> FakeJob:
            if self.jobs:
                raise OSError("no space left")
            return super().start(work, is_exclusive=is_exclusive)

    launcher = Full(polls=1_000)
    with pytest.raises(OSError, match="no space"):
        run(store, launcher, FakePiece("a"), FakePiece("b"))
    assert launcher.jobs[0].stops == 1


def test_what_has_failed_is_known_also_where_an_error_ends_the_rest(store: Store) -> None:
    class Full(FakeLauncher):
        def start(self, work: Work, *, is_exclusive: bool) -> FakeJob:
            if self.jobs:
                raise OSError("no space left")
            return super().start(work, is_exclusive=is_exclusive)

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
