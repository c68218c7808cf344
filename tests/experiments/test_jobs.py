"""Keys, plans, and what a reproduction has on its disk."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from crptpro.artifact import write_json
from crptpro.errors import RecordError
from crptpro.experiments.jobs import Job, bytes_of, describe, is_finished, load_results, make_plan, write_cells
from crptpro.experiments.matrix import SMALL, dataset, encoder, probe, run

SCALE = replace(SMALL, transitions=50, updates=100, training={"batch_size": 64})


def trained(scale=SCALE, **changed) -> Job:
    return encoder(scale, "crptpro", ("walker", "cheetah"), 0, **changed)


def learned(seed: int = 1) -> Job:
    return run(SCALE, "crptpro", "walker_run", trained(), seed)


def finish(root: Path, *jobs: Job) -> None:
    """Leave what finished jobs leave, as far as plans look at it."""
    describe(root, make_plan(jobs, root))
    for job in jobs:
        directory = root / "jobs" / job.key
        done = {"seconds": 5.0, "attempts": 2, "device": "cpu", "threads": 1, "versions": {"torch": "2"}}
        hardware = {"cpu": "A", "cpu_cores": 2, "ram_bytes": 2**34, "gpus": []}
        write_json(directory / "done.json", {**done, "hardware": hardware, "git_revision": "abc"})
        if job.kind == "encoder":
            write_json(directory / "encoder" / "card.json", {})
            (directory / "encoder" / "weights.safetensors").touch()


def test_a_job_is_a_command_whose_key_names_its_directory() -> None:
    job = trained()
    walker, cheetah = (needed.key for needed in job.needs)
    assert job.command == (
        "pretrain", f"{{{walker}}}/walker", f"{{{cheetah}}}/cheetah", "--method", "crptpro", "--out", "{out}",
        "--batch-size", "64", "--loss", "num_prototypes=128", "--seed", "0", "--updates", "100",
    )  # fmt: skip
    assert job.key == trained().key
    assert job.key.startswith("encoder-crptpro-walker-cheetah-seed-0-")
    assert learned().command[:4] == ("downstream", "walker_run", "--pretrained", f"{{{job.key}}}/encoder")


def test_a_changed_command_makes_another_job_and_so_do_its_dependents() -> None:
    others = [
        trained(replace(SCALE, updates=101)), trained(replace(SCALE, training={"batch_size": 65})),
        trained(replace(SCALE, transitions=51)), trained(loss={"num_prototypes": 17}),
        encoder(SCALE, "crptpro", ("walker", "cheetah"), 1), trained(),
    ]  # fmt: skip
    assert len({job.key for job in others}) == 6
    assert len({probe(SCALE, job, dataset(SCALE, "walker", 0)).key for job in others}) == 6


def test_a_job_whose_weights_were_removed_runs_again_only_if_another_job_needs_them(tmp_path: Path) -> None:
    finish(tmp_path, trained())
    plan = make_plan([learned()], tmp_path)  # what only the encoder needed is not asked for
    assert [job.kind for job in plan.jobs] == ["encoder", "run"]
    assert [job.kind for job in plan.missing] == ["run"]
    finish(tmp_path, learned())
    directory = tmp_path / "jobs" / trained().key
    (directory / "encoder" / "weights.safetensors").unlink()
    (directory / "pretrain.csv").write_text("old")
    assert make_plan([learned(), trained()], tmp_path).missing == ()
    plan = make_plan([learned(seed=2)], tmp_path)
    assert [job.kind for job in plan.missing] == ["dataset", "dataset", "encoder", "run"]
    describe(tmp_path, plan)  # the encoder begins anew
    assert not is_finished(tmp_path, trained())
    assert not (directory / "pretrain.csv").exists()
    assert json.loads((directory / "job.json").read_text())["kind"] == "encoder"


def test_a_job_that_another_command_finished_or_began_after_it_was_planned_is_left_alone(tmp_path: Path) -> None:
    plan = make_plan([trained()], tmp_path)
    finish(tmp_path, trained())
    describe(tmp_path, plan)
    assert is_finished(tmp_path, trained())
    directory = tmp_path / "jobs" / trained().key
    (directory / "encoder" / "weights.safetensors").unlink()
    first, second = (make_plan([learned()], tmp_path) for _ in range(2))
    describe(tmp_path, first)
    (directory / "pretrain.csv").touch()
    describe(tmp_path, second)
    assert (directory / "pretrain.csv").exists()


def test_the_disk_space_of_a_job_follows_its_frames() -> None:
    assert bytes_of(dataset(SCALE, "walker", 0, 2_000))[0] == 2_000 * 3 * 84 * 84
    after, during = bytes_of(learned())
    assert during > 12_000 * 3 * 84 * 84 > after


def test_results_are_frames_of_cells_and_jobs(tmp_path: Path) -> None:
    finish(tmp_path, *trained().needs, trained())
    describe(tmp_path, make_plan([learned()], tmp_path))
    place = {"group": "A", "task": "walker_run", "encoder_seed": 0, "seed": 1}
    write_cells(tmp_path, "seen", "tiny", [("crptpro", learned().key, place)])
    results = load_results(tmp_path)
    [cell] = results.cells.to_dict("records")
    about = {"experiment": "seen", "scale": "tiny", "label": "crptpro", "job": learned().key, "done": False}
    assert cell == {**about, **place}
    assert len(results.jobs) == 4
    job = results.jobs.loc[trained().key]
    assert (job.kind, job.done, job.seconds, job.attempts, job.threads) == ("encoder", True, 5.0, 2, 1)
    assert job.machine == "A, 2 cores, 16 GiB, no GPU"
    assert {"method": "crptpro", "domains": ["walker", "cheetah"], "updates": 100}.items() <= job.facts.items()
    assert job.needs == [needed.key for needed in trained().needs]
    assert job.path == tmp_path / "jobs" / trained().key
    assert load_results(tmp_path / "nothing").cells.empty


def test_a_later_request_adds_cells_and_replaces_those_of_the_same_place(tmp_path: Path) -> None:
    write_cells(tmp_path, "seen", "tiny", [("a", "old", {"seed": 0}), ("b", "kept", {"seed": 0})])
    write_cells(tmp_path, "seen", "tiny", [("a", "new", {"seed": 0}), ("a", "more", {"seed": 1})])
    cells = load_results(tmp_path).cells
    assert list(zip(cells.label, cells.job)) == [("a", "new"), ("a", "more"), ("b", "kept")]


def test_a_damaged_record_is_named(tmp_path: Path) -> None:
    write_cells(tmp_path, "seen", "tiny", [("a", "run-a", {"seed": 0})])
    path = tmp_path / "experiments" / "seen-tiny.json"
    path.write_text(path.read_text()[:-9])
    with pytest.raises(RecordError, match=r"seen-tiny\.json"):
        load_results(tmp_path)
    path.write_text('{"experiment": "seen"}')
    with pytest.raises(RecordError, match=r"seen-tiny\.json has no scale, cells; it is damaged"):
        load_results(tmp_path)
    path.unlink()
    describe(tmp_path, make_plan([trained()], tmp_path))
    (tmp_path / "jobs" / trained().key / "job.json").write_text('{"kind": "encoder"}')
    with pytest.raises(RecordError, match=r"job\.json has no command, facts, needs"):
        load_results(tmp_path)
