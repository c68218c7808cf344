"""Keys, plans, and what a reproduction has on its disk."""

from __future__ import annotations

import functools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from crptpro import domains
from crptpro.artifact import write_json
from crptpro.domains import Domain, register_domain
from crptpro.errors import CRPTproError, RecordError
from crptpro.experiments.jobs import (
    Job,
    bytes_of,
    collect_job,
    describe,
    downstream_job,
    is_finished,
    load_results,
    make_plan,
    options,
    pretrain_job,
    probe_job,
    write_cells,
)
from crptpro.objectives import get_method


def encoder(**changed: Any) -> Job:
    usual: dict[str, Any] = {"updates": 100, "training": {"batch_size": 64}, "loss": {"num_prototypes": 16}}
    data = [collect_job(domain, 50, 0) for domain in ("walker", "cheetah")]
    return pretrain_job(get_method("crptpro"), data, 0, **{**usual, **changed})


def run() -> Job:
    return downstream_job("walker_run", encoder(), 1, config={"env_steps": 100})


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
        if job.kind == "dataset":
            write_json(directory / job.facts["domain"] / "card.json", {})
            (directory / job.facts["domain"] / "frames").mkdir()
            (directory / job.facts["domain"] / "frames" / "pixels.memmap").touch()


# --- keys -----------------------------------------------------------------------------------------------------------


def test_a_job_is_a_command_whose_key_names_its_directory() -> None:
    job = encoder()
    walker, cheetah = (needed.key for needed in job.needs)
    assert job.command == (
        "pretrain", f"{{{walker}}}/walker", f"{{{cheetah}}}/cheetah", "--method", "crptpro", "--out", "{out}",
        "--batch-size", "64", "--loss", "num_prototypes=16", "--seed", "0", "--updates", "100",
    )  # fmt: skip
    assert job.key == encoder().key
    assert job.key.startswith("encoder-crptpro-walker-cheetah-seed-0-")
    assert run().command[:4] == ("downstream", "walker_run", "--pretrained", f"{{{job.key}}}/encoder")


@pytest.mark.parametrize("changed", [
    {"updates": 101}, {"training": {"batch_size": 65}}, {"loss": {"num_prototypes": 17}}, {"loss": {}},
    {"encoder": {"pixel_offset": 0.5}}, {"snapshots": (50,)},
])  # fmt: skip
def test_another_command_is_another_job_and_so_is_what_needs_it(changed: dict[str, Any]) -> None:
    other = encoder(**changed)
    assert other.key != encoder().key
    data = collect_job("walker", 50, 0)
    assert probe_job(other, data).key != probe_job(encoder(), data).key


def test_options_are_written_as_the_command_reads_them() -> None:
    assert options(learning_rate=1e-3, seeds=(1, 2), off=None, empty=()) == [
        "--learning-rate", "0.001", "--seeds", "1", "2",
    ]  # fmt: skip


def test_an_edited_domain_of_the_users_makes_other_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(domains, "_registered", {})
    keys = []
    for repeat in (1, 2, 2):
        domain = Domain(
            "mine", "mine_go", make=functools.partial(make_mine, size=repeat), action_repeat=repeat
        )
        monkeypatch.setattr(domains, "_registered", {})
        register_domain(domain)
        keys.append(collect_job("mine", 50, 0).key)
    assert keys[1] == keys[2] != keys[0]
    monkeypatch.setattr(domains, "_registered", {})
    register_domain(replace(domain, make=functools.partial(make_mine, size=object())))
    with pytest.raises(CRPTproError, match="differs in every process"):
        collect_job("mine", 50, 0)


def make_mine(size: object = 1) -> None:
    """Stands for a world of the user's own."""


# --- plans ----------------------------------------------------------------------------------------------------------


def test_a_plan_has_what_is_needed_first_and_nothing_twice(tmp_path: Path) -> None:
    plan = make_plan([run(), run(), encoder()], tmp_path)
    assert [job.kind for job in plan.jobs] == ["dataset", "dataset", "encoder", "run"]
    assert plan.missing == plan.jobs


def test_a_finished_job_is_used_again_and_what_only_it_needed_is_not_asked_for(tmp_path: Path) -> None:
    finish(tmp_path, encoder())
    plan = make_plan([run()], tmp_path)
    assert [job.kind for job in plan.jobs] == ["encoder", "run"]
    assert [job.kind for job in plan.missing] == ["run"]


def test_records_suffice_until_somebody_needs_the_weights_again(tmp_path: Path) -> None:
    finish(tmp_path, *encoder().needs, encoder(), run())
    directory = tmp_path / "jobs" / encoder().key
    (directory / "encoder" / "weights.safetensors").unlink()
    (directory / "pretrain.csv").write_text("old")
    assert make_plan([run(), encoder()], tmp_path).missing == ()
    further = downstream_job("walker_run", encoder(), 2)
    plan = make_plan([further], tmp_path)
    assert plan.missing == (encoder(), further)
    describe(tmp_path, plan)  # the encoder begins anew
    assert not is_finished(tmp_path, encoder())
    assert not (directory / "pretrain.csv").exists()
    assert json.loads((directory / "job.json").read_text())["kind"] == "encoder"


def test_what_a_job_takes_on_the_disk_follows_its_frames() -> None:
    small, large = (bytes_of(collect_job("walker", count, 0))[0] for count in (1_000, 2_000))
    assert large == 2 * small == 2_000 * 3 * 84 * 84
    after, during = bytes_of(downstream_job("walker_run", None, 0, config={"replay_capacity": 10_000}))
    assert during > 10_000 * 3 * 84 * 84 > after


# --- what there is --------------------------------------------------------------------------------------------------


def test_results_are_frames_of_cells_and_jobs(tmp_path: Path) -> None:
    finish(tmp_path, *encoder().needs, encoder())
    describe(tmp_path, make_plan([run()], tmp_path))
    place = {"group": "A", "task": "walker_run", "encoder_seed": 0, "seed": 1}
    write_cells(tmp_path, "seen", "tiny", {"groups": ["A"]}, [("crptpro", run().key, place)])
    results = load_results(tmp_path)
    [cell] = results.cells.to_dict("records")
    assert cell == {
        "experiment": "seen",
        "scale": "tiny",
        "label": "crptpro",
        "job": run().key,
        "done": False,
        **place,
    }
    assert len(results.jobs) == 4
    job = results.jobs.loc[encoder().key]
    assert (job.kind, job.done, job.seconds, job.attempts, job.threads) == ("encoder", True, 5.0, 2, 1)
    assert job.machine == "A, 2 cores, 16 GiB, no GPU"
    assert (job.facts["method"], job.facts["domains"], job.facts["updates"]) == (
        "crptpro",
        ["walker", "cheetah"],
        100,
    )
    assert job.needs == [needed.key for needed in encoder().needs]
    assert job.path == tmp_path / "jobs" / encoder().key
    assert load_results(tmp_path / "nothing").cells.empty


def test_a_later_request_adds_cells_and_replaces_those_of_the_same_place(tmp_path: Path) -> None:
    write_cells(tmp_path, "seen", "tiny", {}, [("a", "old", {"seed": 0}), ("b", "kept", {"seed": 0})])
    write_cells(tmp_path, "seen", "tiny", {}, [("a", "new", {"seed": 0}), ("a", "more", {"seed": 1})])
    cells = load_results(tmp_path).cells
    assert list(zip(cells.label, cells.job)) == [("a", "new"), ("a", "more"), ("b", "kept")]


def test_a_damaged_record_is_named(tmp_path: Path) -> None:
    write_cells(tmp_path, "seen", "tiny", {}, [("a", "x", {})])
    path = tmp_path / "experiments" / "seen-tiny.json"
    path.write_text(json.dumps({"experiment": "seen", "scale": "tiny", "cells": [{"label": "a"}]}))
    with pytest.raises(RecordError, match=r"seen-tiny\.json does not say what was asked for"):
        load_results(tmp_path)
