"""What a plan is said to cost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from crptpro.cards import hardware, write_json
from crptpro.experiments.catalogue import EXPERIMENTS
from crptpro.experiments.costs import corrections, estimate, wall_seconds
from crptpro.experiments.goals import Request
from crptpro.experiments.matrix import seen
from crptpro.experiments.measurements import ProbePiece
from crptpro.experiments.pace import network_pace
from crptpro.experiments.piece_costs import core_seconds, stored_bytes, working_bytes
from crptpro.experiments.pieces import (
    DatasetPiece,
    ExploredPiece,
    Piece,
    PretrainedPiece,
    RunPiece,
    UntrainedPiece,
    settings,
)
from crptpro.experiments.plan import Plan, make_plan
from crptpro.experiments.plan_text import plan_text
from crptpro.experiments.scales import SCALES
from crptpro.experiments.store import DONE, Store

WALKER = DatasetPiece("walker", 1_000, 0)
ENCODER = PretrainedPiece("crptpro", 0, (WALKER,), updates=100)
RUN = RunPiece("walker_run", ENCODER, 0, config=settings(env_steps=20_000, batch_size=128))


def finish(
    store: Store,
    piece: Piece,
    seconds: float,
    device: str = "cpu",
    made_on: dict[str, Any] | None = None,
    threads: int = 1,
) -> None:
    store.describe(piece)
    job = {"device": device, "threads": threads, "workers": threads}
    done = {"seconds": seconds, "job": job, "hardware": made_on or hardware()}
    write_json(store.path(piece) / DONE, done)
    for path in store.outputs(piece):
        path.parent.mkdir(parents=True)
        path.touch()


@pytest.mark.parametrize(("piece", "seconds"), [
    (WALKER, 10 + 30),
    (DatasetPiece("quadruped", 1_000, 0), 10 + 60),
    (ENCODER, 10 + 100 * 512 * 2.9e-3),
    # 10,000 decisions; evaluations at 0, 10,000 and 20,000 env steps, of 10 episodes with 500 decisions each
    (RUN, 10 + 10_000 * (0.05 + 128 * 0.5e-3) + 3 * 10 * 500 * 0.04),
    (RunPiece("reach_duplo", None, 0, config=settings(env_steps=10_000)),
     10 + 5_000 * (0.05 + 512 * 6.9e-3) + 2 * 10 * 125 * 0.04),
    (ExploredPiece("apt-s", 0, ("walker",), explore=settings(env_steps=2_000, random_agent_steps=100, batch_size=64)),
     10 + 1_000 * (0.05 + 64 * 3.5e-3) + 450 * 64 * 2.9e-3),
    (ExploredPiece("proto-rl-s", 0, ("walker",),
                   explore=settings(env_steps=2_000, random_agent_steps=100, batch_size=64)),
     10 + 1_000 * (0.05 + 64 * 1.25e-3) + 450 * 64 * 2.9e-3),
    # Features of every sample, and their products with those of every other.
    (ProbePiece(ENCODER, WALKER, samples=1_000), 10 + 1_000 * 4e-3 + 1_000**2 * 2.5e-6),
])  # fmt: skip
def test_seconds_follow_decisions_updates_and_batch(piece: Piece, seconds: float) -> None:
    assert core_seconds(piece) == pytest.approx(seconds)


def test_the_pace_of_networks_moves_their_part_of_a_piece_alone() -> None:
    assert core_seconds(WALKER, 5.0) == core_seconds(WALKER)
    assert core_seconds(ENCODER, 5.0) == pytest.approx(10 + 5 * 100 * 512 * 2.9e-3)
    acting, evaluating = 0.03 + 5 * (0.02 + 128 * 0.5e-3), 0.03 + 5 * 0.01
    assert core_seconds(RUN, 5.0) == pytest.approx(10 + 10_000 * acting + 3 * 10 * 500 * evaluating)
    explored = ExploredPiece(
        "apt-s", 0, ("walker",), explore=settings(env_steps=2_000, random_agent_steps=100, batch_size=64)
    )
    exploring = 0.03 + 5 * (0.02 + 64 * 3.5e-3)
    assert core_seconds(explored, 5.0) == pytest.approx(10 + 1_000 * exploring + 5 * 450 * 64 * 2.9e-3)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("name", sorted(EXPERIMENTS))
def test_no_piece_gets_cheaper_where_networks_are_slower(name: str, scale: str, tmp_path: Path) -> None:
    plan = make_plan(
        [goal.piece for goal in EXPERIMENTS[name].goals(Request(SCALES[scale]))], Store(tmp_path)
    )
    for piece in plan.pieces:
        without, usual, slow = (core_seconds(piece, pace) for pace in (0.0, 1.0, 3.0))
        assert without <= usual <= slow
        assert slow - usual == pytest.approx(2 * (usual - without))


def test_disk_follows_what_is_kept() -> None:
    assert stored_bytes(DatasetPiece("walker", 100_000, 0)) == pytest.approx(2.24e9, rel=0.01)
    few, many, more = (
        stored_bytes(ExploredPiece("apt-s", 0, ("walker",), explore=settings(env_steps=env_steps)))
        for env_steps in (100_000, 200_000, 400_000)
    )
    assert few < many == more  # the replay keeps 100,000 transitions
    # The artifact has what the loss has: 5.4 million numbers, of which nearly all have targets.
    assert stored_bytes(ENCODER) == pytest.approx(4 * 10.4e6 + 1e6, rel=0.01)


def test_a_run_needs_its_replay_and_two_checkpoints_while_it_is_made() -> None:
    # Actor 3.06 and critic 4.16 million numbers, with two moments each, and a target critic.
    checkpoints = 2 * 4 * (3 * (3.06e6 + 4.16e6) + 4.16e6)
    assert working_bytes(RUN) == pytest.approx((40_000 + 5_000 + 2_000) * 84 * 84 * 3 + checkpoints, rel=0.01)
    assert stored_bytes(RUN) == pytest.approx(4 * 3.06e6 + 1e6, rel=0.05)  # the actor


@pytest.mark.parametrize("scale", SCALES)
def test_every_piece_of_an_experiment_has_a_cost(scale: str, tmp_path: Path) -> None:
    plan = make_plan([goal.piece for goal in seen(Request(SCALES[scale]))], Store(tmp_path))
    cost = estimate(plan, Store(tmp_path), jobs=4)
    assert set(cost.seconds) == set(cost.bytes) == {piece.key for piece in plan.pieces}
    assert min(cost.seconds.values()) > 0
    assert cost.disk_bytes == sum(cost.bytes.values()) + cost.working_bytes
    assert sum(cost.seconds.values()) / 4 <= cost.wall_seconds < sum(cost.seconds.values())


def test_finished_pieces_correct_the_estimate_of_their_kind(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for seed, factor in enumerate((2.0, 3.0, 40.0)):
        piece = DatasetPiece("walker", 10_000, seed)
        finish(store, piece, factor * core_seconds(piece))
    finish(store, DatasetPiece("walker", 100, 0), 1e6)  # too short to say anything
    assert corrections(store) == {"dataset": pytest.approx(3.0)}
    assert corrections(store, "cuda") == {}
    cost = estimate(make_plan([ENCODER], store), store, jobs=1)
    assert cost.seconds[WALKER.key] == pytest.approx(3 * core_seconds(WALKER))
    assert cost.seconds[ENCODER.key] == pytest.approx(core_seconds(ENCODER))
    assert cost.corrected == {"dataset"}


def test_networks_are_timed_here_where_nothing_finished_tells_their_pace(tmp_path: Path) -> None:
    store, asked = Store(tmp_path), []

    def four_times(threads: int) -> float:
        asked.append(threads)
        return 4.0

    plan = make_plan([RUN], store)
    cost = estimate(plan, store, jobs=2, threads=3, time_networks=four_times)
    assert asked == [3]
    assert cost.seconds == {piece.key: core_seconds(piece, 4.0) for piece in (WALKER, ENCODER, RUN)}
    assert cost.wall_seconds == pytest.approx(sum(cost.seconds.values()))
    text = plan_text(plan, cost, jobs=2, device="cpu")
    assert "times 4 for networks, as just timed here" in text
    assert "though each job has" not in text

    finish(store, RUN, 2 * core_seconds(RUN))
    other = RunPiece("walker_run", ENCODER, 1, config=RUN.config)
    cost = estimate(make_plan([other], store), store, jobs=2, time_networks=four_times)
    assert cost.seconds[other.key] == pytest.approx(
        2 * core_seconds(other)
    )  # a finished run has the pace in it
    assert asked == [3]  # and the encoder's few updates are not worth seconds of timing
    assert cost.pace is None


def test_what_hardly_computes_networks_or_runs_elsewhere_is_not_timed(tmp_path: Path) -> None:
    store = Store(tmp_path)

    def refuse(threads: int) -> float:
        raise AssertionError("timed")

    data = make_plan([DatasetPiece("walker", 100_000, 0)], store)
    assert estimate(data, store, jobs=2, time_networks=refuse).pace is None
    assert estimate(make_plan([RUN], store), store, jobs=2).pace is None


def test_the_pace_of_networks_is_measured_without_a_trace() -> None:
    threads, state = torch.get_num_threads(), torch.get_rng_state()
    pace = network_pace(1)
    assert 0.01 < pace < 1_000
    assert torch.get_num_threads() == threads
    assert torch.equal(torch.get_rng_state(), state)


def test_pieces_of_another_machine_correct_nothing(tmp_path: Path) -> None:
    store, here = Store(tmp_path), hardware()
    piece = DatasetPiece("walker", 10_000, 0)
    finish(store, piece, 1e6, made_on={**here, "cpu": "another"})
    assert corrections(store) == {}
    # Two of one name, or a record from before that was written down.
    finish(store, DatasetPiece("walker", 10_000, 4), 1e6, made_on={**here, "cpu_instructions": "SSE"})
    assert corrections(store) == {}
    older = {name: here[name] for name in here if name != "cpu_instructions"}
    finish(store, DatasetPiece("walker", 10_000, 5), 1e6, made_on=older)
    assert corrections(store) == {}
    finish(
        store,
        DatasetPiece("walker", 10_000, 1),
        2 * core_seconds(piece),
        made_on={**here, "gpus": ["another"]},
    )
    assert corrections(store) == {"dataset": pytest.approx(2.0)}  # a job on the CPU does not care
    finish(
        store,
        DatasetPiece("walker", 10_000, 2),
        3 * core_seconds(piece),
        "cuda",
        {**here, "gpus": ["another"]},
    )
    assert corrections(store, "cuda") == {}
    finish(store, DatasetPiece("walker", 10_000, 3), 4 * core_seconds(piece), "cuda")
    assert corrections(store, "cuda:1") == {"dataset": pytest.approx(4.0)}


def test_a_job_that_had_one_of_several_equal_gpus_corrects_the_estimate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = {**hardware(), "gpus": ["H200", "H200"]}
    monkeypatch.setattr("crptpro.experiments.costs.hardware", lambda: here)
    piece = DatasetPiece("walker", 10_000, 0)
    finish(Store(tmp_path), piece, 2 * core_seconds(piece), "cuda", {**here, "gpus": ["H200"]})
    assert corrections(Store(tmp_path), "cuda") == {"dataset": pytest.approx(2.0)}


def test_jobs_with_other_threads_correct_nothing_and_collecting_processes_are_counted(tmp_path: Path) -> None:
    store = Store(tmp_path)
    encoder = PretrainedPiece("crptpro", 0, (WALKER,), updates=1_000)
    finish(store, encoder, core_seconds(encoder) / 3, threads=4)
    assert corrections(store) == {}
    assert corrections(store, threads=4) == {"encoder": pytest.approx(1 / 3)}
    data = DatasetPiece("walker", 10_000, 0)
    finish(store, data, core_seconds(data) / 2, threads=4)
    assert corrections(store) == {"dataset": pytest.approx(2.0)}

    plan = make_plan([RUN], store)
    text = plan_text(plan, estimate(plan, store, jobs=2, threads=4), jobs=2, device="cpu")
    assert "though each job has 4" in text


def test_a_record_that_cannot_be_read_corrects_nothing(tmp_path: Path) -> None:
    directory = tmp_path / "pieces" / "odd"
    directory.mkdir(parents=True)
    (directory / DONE).write_text("{}")
    (directory / "piece.json").write_text('{"kind": "of another time"}')
    assert corrections(Store(tmp_path)) == {}


def test_what_lies_on_the_disk_is_not_needed_again(tmp_path: Path) -> None:
    store = Store(tmp_path)
    plan = make_plan([WALKER], store)
    before = estimate(plan, store, jobs=1).bytes[WALKER.key]
    store.path(WALKER).mkdir(parents=True)
    (store.path(WALKER) / "pixels").write_bytes(bytes(5_000_000))
    assert estimate(plan, store, jobs=1).bytes[WALKER.key] == before - 5_000_000


def test_wall_clock_keeps_to_needs_and_to_the_number_of_jobs(tmp_path: Path) -> None:
    control = RunPiece("walker_run", UntrainedPiece("random-encoder", 0), 0)
    plan = make_plan([RUN, control], Store(tmp_path))
    seconds = {WALKER.key: 5.0, ENCODER.key: 10.0, RUN.key: 20.0, control.key: 7.0}
    seconds[UntrainedPiece("random-encoder", 0).key] = 1.0
    assert wall_seconds(plan, seconds, 1) == 43.0
    assert wall_seconds(plan, seconds, 2) == 35.0
    assert wall_seconds(plan, seconds, 9) == 35.0


def test_the_plan_says_how_many_of_each_kind_and_where_the_estimate_comes_from(tmp_path: Path) -> None:
    store = Store(tmp_path)
    plan = make_plan([RUN, ProbePiece(ENCODER, WALKER)], store)
    text = plan_text(plan, estimate(plan, store, jobs=2), jobs=2, device="cpu")
    row = next(line for line in text.splitlines() if line.startswith("downstream runs"))
    assert row.split()[2:5] == ["1", "0", "1"]
    assert "with 2 at a time" in text
    assert "reference machine" in text
    assert "GPU" not in text
    assert "GPU" in plan_text(plan, estimate(plan, store, jobs=2), jobs=2, device="cuda")

    finish(store, RUN, 1_000.0)
    finish(store, ENCODER, 100.0)
    other = RunPiece("walker_run", ENCODER, 1)
    text = plan_text(
        plan := make_plan([RUN, other], store), estimate(plan, store, jobs=2), jobs=2, device="cpu"
    )
    row = next(line for line in text.splitlines() if line.startswith("downstream runs"))
    assert row.split()[2:5] == ["2", "1", "1"]
    assert "what finished pieces took on this kind of machine" in text


def test_a_plan_without_anything_to_do_promises_nothing(tmp_path: Path) -> None:
    store = Store(tmp_path)
    finish(store, WALKER, 1.0)
    plan = make_plan([WALKER], store)
    assert isinstance(plan, Plan)
    text = plan_text(plan, estimate(plan, store, jobs=2), jobs=2, device="cpu")
    assert "About" not in text
