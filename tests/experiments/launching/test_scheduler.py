"""Which piece starts when, beside which others, and on how many cores."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_launcher import FakeJob, FakeLauncher, run
from fake_pieces import ExclusivePiece, FakePiece, plan_of

from crptpro.cards import write_json
from crptpro.experiments.building import JobSettings
from crptpro.experiments.launching import Work, run_pieces
from crptpro.experiments.measurements import CoveragePiece
from crptpro.experiments.pieces import DatasetPiece, ExploredPiece, PretrainedPiece
from crptpro.experiments.store import DONE, Store


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
