"""Every benchmark runs at a tiny size, prints its tables and writes its JSON."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
import tyro
from benchmarks.library import Downstream, PretrainUpdates, fresh_loss, fresh_pretrained, precisions
from benchmarks.measure import side_by_side
from benchmarks.synthetic import drifting_episode, make_drifting_env, write_dataset
from torch import nn

from benchmarks import collection, gpu, memory, revisions, sampling, updates
from crptpro.data import FrameDataset
from crptpro.errors import CRPTproError, DiskSpaceError
from crptpro.training import DownstreamConfig, pretrain, train_downstream

ROOT = Path(__file__).parents[2]
README = (ROOT / "benchmarks" / "README.md").read_text()
NAMES = sorted(set(re.findall(r"^\| `python -m benchmarks\.(\w+)", README, re.MULTILINE)))


def written(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())["results"]


def test_the_readme_lists_the_benchmarks_there_are() -> None:
    scripts = {p.stem for p in (ROOT / "benchmarks").glob("*.py") if "tyro.cli" in p.read_text()}
    assert set(NAMES) == scripts


@pytest.mark.parametrize("name", NAMES)
def test_every_benchmark_explains_its_options(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        tyro.cli(importlib.import_module(f"benchmarks.{name}").Settings, args=["--help"])
    assert "--rounds" in capsys.readouterr().out or name == "memory"


# --- what is timed is the library ------------------------------------------------------------------------------------


def test_the_timed_pretraining_updates_are_those_of_pretrain(tmp_path: Path) -> None:
    paths = [
        write_dataset(tmp_path / str(seed), transitions=20, seed=seed, image_size=16) for seed in range(2)
    ]
    timed, whole = (fresh_loss(image_size=16, prototypes=16) for _ in range(2))
    unit = PretrainUpdates(timed, paths, batch_size=8, precision="fp32")
    for _ in range(3):
        unit()
    pretrain(whole, paths, updates=3, batch_size=8, precision="fp32", progress=False)
    assert all(
        torch.equal(one, other) for one, other in zip(timed.parameters(), whole.parameters(), strict=True)
    )


@pytest.mark.parametrize("features", ["dense", "reencode"])
def test_the_timed_decisions_are_those_of_train_downstream(features: Any) -> None:
    config = DownstreamConfig(
        env_steps=60, batch_size=8, replay_capacity=40, random_agent_steps=12, queue_size=16, hidden_dim=16,
        eval_episodes=1, eval_workers=0, precision="fp32", features=features,
    )  # fmt: skip
    pretrained = fresh_pretrained(image_size=16, prototypes=8)
    env = functools.partial(make_drifting_env, length=10)
    run = Downstream(pretrained, config, task="drifting", env_factory=env)
    for _ in range(30):
        run.decide()
    assert run.seconds.keys() >= {"act", "learn", "store", "reset of the episode"}
    result = train_downstream("drifting", pretrained, config=config, env_factory=env, progress=False)
    theirs = result.agent.actor.state_dict()
    assert all(torch.equal(value, theirs[key]) for key, value in run.agent.actor.state_dict().items())


def test_frames_of_a_drifting_picture_all_differ_and_are_no_flat_colour() -> None:
    pixels = drifting_episode(200, seed=1)["pixels"]
    assert len({frame.numpy().tobytes() for frame in pixels}) == 200
    assert pixels.float().std() > 20
    assert (pixels[:, :, 1:].int() - pixels[:, :, :-1].int()).abs().float().mean() < 15


def test_candidates_take_turns_and_times_are_per_unit() -> None:
    order: list[str] = []
    calls = {name: functools.partial(order.append, name) for name in "ab"}
    timings = side_by_side(calls, rounds=2, warmup=1, per_call=4)
    assert order == ["a", "b", "a", "b", "a", "b"]
    assert all(t.rounds == 2 and t.best_s <= t.median_s <= t.worst_s for t in timings.values())
    with pytest.raises(ValueError, match="rounds"):
        side_by_side(calls, rounds=0)


# --- the scripts -----------------------------------------------------------------------------------------------------

TINY = updates.Settings(
    rounds=1, threads=torch.get_num_threads(), batch_size=8, prototypes=16, image_size=16, dataset_transitions=20,
    update_transitions=20, replay_transitions=20, decisions=6, sustained_updates=4, parity_updates=4,
)  # fmt: skip


def test_updates_beside_the_plain_implementation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    only: Any = ("pretrain", "downstream", "sustained", "parity")
    updates.main(dataclasses.replace(TINY, only=only, out=tmp_path))
    results, told = written(tmp_path / "updates.json"), capsys.readouterr().out
    assert set(results["pretrain"]["timings"]) == {"plain fp32", *(f"ours {p}" for p in precisions())}
    assert [name for name in results["downstream"]["timings"] if name.endswith("dense features")]
    for section in ("pretrain", "downstream"):
        assert all(one["median_s"] > 0 for one in results[section]["timings"].values())
        assert results[section]["times_slower"][results[section]["than"]] == 1
    sustained = results["sustained"]
    assert sustained["projected_hours"] == pytest.approx(50_000 / sustained["updates_per_s"] / 3600)
    assert results["parity"]["fp32"] != results["parity"]["other seed"]
    assert told.count("| plain fp32 |") == 2
    assert "| loss_comp |" in told


@pytest.mark.gl
def test_a_decision_on_the_simulator_by_stage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    updates.main(dataclasses.replace(TINY, only=("decision",), out=tmp_path))
    ways = written(tmp_path / "updates.json")["decision"]
    assert set(ways) == {"drawn after the update", "drawn during the update"}
    for way in ways.values():
        assert all(seconds > 0 for seconds in way["mean_s_by_stage"].values())
        assert way["projected_hours"] == pytest.approx(way["timing"]["median_s"] * 250_000 / 3600)
    assert "| **whole**, median |" in capsys.readouterr().out


def test_sampling_beside_torchrls_ways(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = sampling.Settings(
        transitions=30, batch_size=8, rounds=1, image_size=12, scratch=tmp_path, out=tmp_path / "results"
    )
    sampling.main(settings)
    results, told = written(tmp_path / "results" / "sampling.json"), capsys.readouterr().out
    assert all(told.count(f"| {what} |") == 2 for _, what, _ in sampling.WAYS.values())
    assert results["times_slower"][results["than"]] == 1
    assert [file.name for file in tmp_path.iterdir()] == ["results"], "the frames are gone"
    with pytest.raises(CRPTproError, match="stacked"):
        sampling.main(sampling.Settings(ways=("ours", "magic")))
    with pytest.raises(DiskSpaceError):
        sampling.main(sampling.Settings(transitions=10**10, scratch=tmp_path))


@pytest.mark.parametrize("name", sampling.WAYS)
def test_every_way_to_sample_returns_what_ours_has_for_the_same_transitions(
    name: str, tmp_path: Path
) -> None:
    path = write_dataset(tmp_path / "frames", transitions=40, image_size=12, length=9)
    dataset = FrameDataset.open(path)
    torch.manual_seed(0)
    batch = sampling.WAYS[name][0](dataset, 64, tmp_path / "scratch").sample()
    place = dataset.transitions["episode"] * 1000 + dataset.transitions["step"]
    expected = dataset[torch.searchsorted(place, batch["episode"] * 1000 + batch["step"])]
    for key in (
        "pixels",
        ("next", "pixels"),
        "action",
        ("next", "reward"),
        ("next", "done"),
        ("next", "truncated"),
    ):
        assert batch[key].dtype == expected[key].dtype
        assert torch.equal(batch[key], expected[key])


def test_memory_and_disk_of_every_stage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def drawn(task: str, root: str, *, transitions: int) -> Path:
        return write_dataset(Path(root) / task, transitions=transitions)

    def run_here(name: str, arguments: dict[str, Any]) -> memory.Resident:
        return memory.Resident(10**9, memory.STAGES[name](**json.loads(json.dumps(arguments))))

    monkeypatch.setattr(memory, "collect_random", drawn)
    settings = memory.Settings(
        collect_transitions=12, datasets=1, dataset_transitions=12, batch_size=4, updates=1, replay_transitions=12,
        scratch=tmp_path, out=tmp_path / "results",
    )  # fmt: skip
    memory.main(settings, run_here)
    results, told = written(tmp_path / "results" / "memory.json"), capsys.readouterr().out
    assert results["downstream, auto"]["features"] == "dense"
    assert results["collection"]["bytes_per_transition"] > 3 * 84**2
    assert all(f"| {name} | 1.00 |" in told for name in results)


def test_the_peak_of_a_program_and_of_its_children_is_seen_and_its_answer_read() -> None:
    take = "import time; block = b'x' * 80_000_000; time.sleep(1.5); print('{\"done\": true}')"
    parent = "import subprocess, sys; subprocess.run([sys.executable, '-c', sys.argv[1]], check=True)"
    taken = memory.watch([sys.executable, "-c", parent, take])
    assert 80e6 < taken.peak_bytes < 130e6
    assert taken.answer == {"done": True}
    with pytest.raises(CRPTproError, match="status 3"):
        memory.watch([sys.executable, "-c", "raise SystemExit(3)"])


@pytest.mark.gl
def test_collection_beside_torchrls(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    threads = torch.get_num_threads()
    settings = collection.Settings(
        domains=("cartpole",), block=2, rounds=1, image_size=84, workers=(1,), worker_transitions=4, scratch=tmp_path,
        out=tmp_path / "results",
    )  # fmt: skip
    collection.main(settings)
    results, told = written(tmp_path / "results" / "collection.json"), capsys.readouterr().out
    ours = {collection.TORCHRL, collection.EXACT, collection.FAST}
    assert set(results["environment alone"]["cartpole"]["timings"]) == ours
    assert set(results["collecting"]["cartpole"]["timings"]) == {*ours, collection.MIXED}
    assert told.count("| cartpole |") == 7
    assert "| workers |" in told
    assert [file.name for file in tmp_path.iterdir()] == ["results"], "the frames are gone"
    assert torch.get_num_threads() == threads


def test_a_domain_that_torchrl_does_not_know_is_refused() -> None:
    with pytest.raises(CRPTproError, match="manipulation"):
        collection.torchrl_env("manipulation", image_size=84)


def test_the_gpu_benchmark_runs_through_at_a_toy_size(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gpu.main(gpu.Settings(tiny=True, compile=False, out=tmp_path))
    results, told = written(tmp_path / "gpu.json"), capsys.readouterr().out
    assert set(results) == {"parity", "pretrain", "downstream", "sustained"}
    assert all(check["passed"] for check in results["parity"])
    assert {"fp32", "TF32", "bf16"} <= set(results["pretrain"]["timings"])
    assert "50,000 take" in told


def test_fast_updates_that_leave_other_weights_fail_their_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make(step: float) -> gpu.Updates:
        layer = nn.Linear(1, 1)
        nn.init.zeros_(layer.weight)
        nn.init.zeros_(layer.bias)
        return lambda: nn.init.constant_(layer.bias, layer.bias.item() + step), layer

    same = gpu.check_updates("same", lambda: make(1.0), lambda: make(1.0), 3, 1e-5)
    other = gpu.check_updates("other", lambda: make(1.0), lambda: make(1.1), 3, 1e-5)
    broken = gpu.check_updates("broken", lambda: make(1.0), lambda: make(float("nan")), 3, 1e-5)
    assert [check["passed"] for check in (same, other, broken)] == [True, False, False]
    monkeypatch.setattr(gpu, "check_parity", lambda *_: [same, other])
    with pytest.raises(CRPTproError, match="Parity does not hold: other"):
        gpu.main(gpu.Settings(tiny=True, only=("parity",), out=tmp_path))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(CRPTproError, match=r"No CUDA device here. `--tiny` runs"):
        gpu.main(gpu.Settings())


def test_another_revision_takes_turns_with_this_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    revisions.main(
        revisions.Settings(
            ROOT,
            only=("extend",),
            rounds=2,
            threads=1,
            image_size=16,
            transitions=40,
            out=tmp_path / "results",
        )
    )
    found = written(tmp_path / "results" / "revisions.json")
    head = subprocess.run(
        ["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True, text=True, check=True
    ).stdout
    assert found["revisions"]["old"].startswith(head[:7])
    extend = found["items"]["extend"]
    assert extend["new_over_old"] == extend["new"]["timing"]["median_s"] / extend["old"]["timing"]["median_s"]
    assert extend["old"]["facts"]["resident_bytes"] > 10**8
    assert "| extend | transition |" in capsys.readouterr().out
    for settings, message in (
        (revisions.Settings(ROOT, only=("magic",)), "No items magic; there are pretrain"),
        (revisions.Settings(tmp_path), "wants a checkout"),
    ):
        with pytest.raises(CRPTproError, match=message):
            revisions.main(settings)
