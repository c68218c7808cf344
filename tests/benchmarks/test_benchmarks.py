"""Every benchmark runs at a tiny size, prints its tables and writes its JSON."""

from __future__ import annotations

import contextlib
import functools
import importlib
import itertools
import json
import re
import time
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
import tyro
from benchmarks.loops import ITEMS
from benchmarks.measure import Loop, compare
from benchmarks.synthetic import drifting_dataset, make_drifting
from torch import nn
from torchrl.data import LazyMemmapStorage

from benchmarks import collection, gpu, loops, memory, sampling, synthetic, updates
from crptpro.data import FrameDataset
from crptpro.domains import Domain
from crptpro.envs import make_env
from crptpro.errors import CRPTproError

ROOT = Path(__file__).parents[2]
README = (ROOT / "benchmarks" / "README.md").read_text()
NAMES = sorted(set(re.findall(r"^\| `python -m benchmarks\.(\w+)", README, re.MULTILINE)))


class EnoughError(Exception):
    """Ends a loop."""


class LoopInThisProcess(Loop):
    """Does what a :class:`Loop` does, beforehand and without a process of its own, which takes seconds to start."""

    def __init__(self, item: str, *, of: Any = (), **settings: Any) -> None:
        self.of, self.found, self.process = of, list[dict[str, float]](), Mock()
        own = {name: value for name, value in settings.items() if name != "threads"}
        with contextlib.suppress(EnoughError):
            ITEMS[item](self._hold, **json.loads(json.dumps(own, default=str)))
        self.laps = self._read()

    def _hold(self, laps: dict[str, float]) -> None:
        self.found.append(laps)
        if len(self.found) >= 14:
            raise EnoughError

    def _read(self) -> dict[str, float]:
        return self.found.pop(0)


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (gpu, memory, updates):
        monkeypatch.setattr(module, "Loop", LoopInThisProcess)
    monkeypatch.setattr("benchmarks.measure.Loop", LoopInThisProcess)
    monkeypatch.setattr(synthetic, "LENGTH", 10)


def written(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())["results"]


def test_the_readme_lists_the_benchmarks_there_are() -> None:
    scripts = {p.stem for p in (ROOT / "benchmarks").glob("*.py") if "tyro.cli" in p.read_text()}
    assert set(NAMES) == scripts


@pytest.mark.parametrize("name", NAMES)
def test_every_benchmark_explains_its_options(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        tyro.cli(importlib.import_module(f"benchmarks.{name}").Settings, args=["--help"])
    assert "--out" in capsys.readouterr().out


# --- the parts -------------------------------------------------------------------------------------------------------


def test_frames_of_a_drifting_picture_all_differ_and_are_no_flat_colour() -> None:
    pixels = make_drifting(seed=1).rollout(200)["pixels"]
    assert len({frame.numpy().tobytes() for frame in pixels}) == 200
    assert pixels.float().std() > 20
    assert (pixels[:, :, 1:].int() - pixels[:, :, :-1].int()).abs().float().mean() < 15


def test_candidates_take_turns_and_times_are_per_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = itertools.count(0, 8)
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    order: list[str] = []
    calls = {name: functools.partial(order.append, name) for name in "ab"}
    timings = compare(calls, unit="call", rounds=2, warmup=1, per_call=4)["timings"]
    assert order == ["a", "b", "a", "b", "a", "b"]
    assert all((t["rounds"], t["best_s"], t["median_s"], t["worst_s"]) == (2, 2, 2, 2) for t in timings.values())


def test_a_process_of_its_own_answers_and_is_watched() -> None:
    assert 80e6 < memory.peak_bytes("nothing") < 2e9
    with pytest.raises(RuntimeError, match="absent has failed"):
        Loop("absent")


# --- the scripts -----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("in_this_process")
def test_updates_beside_the_plain_implementation_and_a_decision_by_stage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    cheap = Domain("cheap", "cheap_run", make=functools.partial(make_drifting, 2))
    monkeypatch.setattr("crptpro.training.env_thread.make_env", lambda _, **options: make_env(cheap, **options))
    settings = updates.Settings(
        rounds=1, threads=torch.get_num_threads(), batch_size=8, prototypes=8, image_size=16, transitions=20,
        replay_transitions=20, decisions=6, sustained_updates=4, parity_updates=4, out=tmp_path,
        only=("pretrain", "downstream", "decision", "sustained", "parity"),
    )  # fmt: skip
    updates.main(settings)
    results, told = written(tmp_path / "updates.json"), capsys.readouterr().out
    assert set(results["pretrain"]["timings"]) == {"plain fp32", *(f"ours {p}" for p in updates.precisions())}
    assert [name for name in results["downstream"]["timings"] if name.endswith("dense features")]
    for section in ("pretrain", "downstream"):
        assert all(one["median_s"] > 0 for one in results[section]["timings"].values())
        assert results[section]["times_slower"][results[section]["than"]] == 1
    decision = results["decision"]
    assert set(decision["median_s_by_stage"]) == {"update", "store", "act"}
    assert decision["projected_hours"] == pytest.approx(decision["median_s"] * 250_000 / 3600)
    assert results["sustained"]["projected_hours"] > 0
    assert results["parity"]["fp32"] != results["parity"]["other seed"]
    assert told.count("| plain fp32 |") == 2
    assert "| loss_comp |" in told


def test_sampling_beside_torchrls_ways(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = sampling.Settings(transitions=30, batch_size=8, rounds=1, image_size=12, scratch=tmp_path, out=tmp_path)
    sampling.main(settings)
    results, told = written(tmp_path / "sampling.json"), capsys.readouterr().out
    assert all(told.count(f"| {name} |") == 2 for name in (sampling.OURS, *sampling.WAYS))
    assert results["times_slower"][results["than"]] == 1
    assert [file.name for file in tmp_path.iterdir()] == ["sampling.json"], "the frames are gone"


@pytest.mark.parametrize("name", sampling.WAYS)
def test_every_way_to_sample_returns_what_ours_does(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(synthetic, "LENGTH", 9)
    dataset = FrameDataset.open(drifting_dataset(tmp_path, transitions=40, image_size=12))
    torch.manual_seed(0)
    storage = LazyMemmapStorage(len(dataset.frames), scratch_dir=tmp_path / "scratch")
    batch = sampling.WAYS[name](dataset, 64, storage)()
    place = dataset.transitions["episode"] * 1000 + dataset.transitions["step"]
    expected = dataset[torch.searchsorted(place, batch["episode"] * 1000 + batch["step"])]
    for key in ("pixels", "action", *(("next", name) for name in ("pixels", "reward", "done", "truncated"))):
        assert batch[key].dtype == expected[key].dtype
        assert torch.equal(batch[key], expected[key])


@pytest.mark.usefixtures("in_this_process")
def test_memory_and_disk_of_every_stage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def collected(task: str, root: str, **sizes: Any) -> Path:
        return drifting_dataset(root, transitions=sizes["transitions"], image_size=sizes["image_size"])

    monkeypatch.setattr(loops, "collect_random", collected)
    memory.main(
        memory.Settings(
            collect_transitions=12, dataset_transitions=12, image_size=16, batch_size=4, updates=2,
            replay_transitions=12, scratch=tmp_path, out=tmp_path,
        )
    )  # fmt: skip
    results, told = written(tmp_path / "memory.json"), capsys.readouterr().out
    assert all(size > 3 * 16**2 for size in results["bytes_per_transition"].values())
    assert all(f"| {name} |" in told for group in results.values() for name in group)


@pytest.mark.gl
def test_collection_beside_torchrls(tmp_path: Path) -> None:
    threads = torch.get_num_threads()
    settings = collection.Settings(
        domains=("cartpole",), block=2, rounds=1, workers=(1,), worker_transitions=4, scratch=tmp_path, out=tmp_path
    )
    collection.main(settings)
    results = written(tmp_path / "collection.json")
    ways = results["cartpole"]["timings"]
    assert set(ways) == {"TorchRL", "crptpro, exact", "crptpro, fast"}
    assert all(way["median_s"] > 0 for way in ways.values())
    assert set(results["workers"]["timings"]) == {"1 workers"}
    assert [file.name for file in tmp_path.iterdir()] == ["collection.json"], "the frames are gone"
    assert torch.get_num_threads() == threads


@pytest.mark.usefixtures("in_this_process")
def test_the_gpu_benchmark_runs_through_at_a_toy_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gpu.main(gpu.Settings(tiny=True, compile=False, out=tmp_path))
    results, told = written(tmp_path / "gpu.json"), capsys.readouterr().out
    assert set(results) == {"parity", "pretrain", "downstream", "sustained"}
    assert all(check["passed"] for check in results["parity"])
    assert {"fp32", "bf16"} <= set(results["pretrain"]["timings"])
    assert "50,000 take" in told


def test_fast_updates_that_leave_other_weights_fail_their_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def check(value: float) -> dict[str, Any]:
        train = {False: nn.ParameterList([torch.ones(1)]), True: nn.ParameterList([torch.tensor([value])])}
        return gpu.check_weights(str(value), lambda **switches: train[bool(switches)], cuda_graph=True)

    assert [check(value)["passed"] for value in (1.0, 1.1, float("nan"))] == [True, False, False]
    monkeypatch.setattr(gpu, "check_parity", lambda *_: [check(1.0), check(1.1)])
    with pytest.raises(CRPTproError, match=r"Parity does not hold: 1\.1"):
        gpu.main(gpu.Settings(tiny=True, only=("parity",), out=tmp_path))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(CRPTproError, match=r"No CUDA device here. `--tiny` runs"):
        gpu.main(gpu.Settings())
