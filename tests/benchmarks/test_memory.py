from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from benchmarks.memory import Settings, main
from benchmarks.resident import watch
from benchmarks.synthetic import write_dataset
from stage_here import run_here
from toy_world import FIXED

from benchmarks import stages
from crptpro import domains
from crptpro.domains import register_domain
from crptpro.errors import CRPTproError, DiskSpaceError

MB = 10**6
TAKE = "import time; block = b'x' * 80_000_000; time.sleep({}); print('{{\"done\": true}}')"


def python(code: str, *arguments: str) -> list[str]:
    return [sys.executable, "-c", code, *arguments]


def test_the_peak_of_a_program_is_seen_and_its_answer_read():
    taken = watch(python(TAKE.format(1.0)))
    assert 80 * MB < taken.peak_bytes < 110 * MB
    assert taken.answer == {"done": True}


def test_memory_of_children_counts():
    code = "import subprocess, sys; subprocess.run([sys.executable, '-c', sys.argv[1]], check=True)"
    taken = watch(python(code, TAKE.format(2.0)))
    assert 80 * MB < taken.peak_bytes < 120 * MB


def test_pages_of_a_mapped_file_are_not_beyond_the_page_cache(tmp_path):
    (tmp_path / "frames").write_bytes(bytes(range(250)) * 240_000)
    code = (
        "import mmap, sys, time; file = open(sys.argv[1], 'rb'); "
        "mapped = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ); sum(mapped[::4096]); time.sleep(1.0)"
    )
    taken = watch(python(code, str(tmp_path / "frames")))
    assert taken.peak_file_bytes > 60 * MB
    assert taken.peak_bytes < 30 * MB
    assert taken.answer == {}


def test_a_program_that_fails_is_an_error():
    with pytest.raises(CRPTproError, match="status 3"):
        watch(python("raise SystemExit(3)"))


def test_the_script_writes_its_results_and_prints_its_tables(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(domains, "_registered", {})
    register_domain(FIXED)

    def collect(task, root, *, transitions, **_):
        return write_dataset(Path(root) / task, transitions=transitions)

    monkeypatch.setattr(stages, "collect_random", collect)
    settings = Settings(
        task="toy-fixed", collect_transitions=12, datasets=2, dataset_transitions=12, batch_size=4, updates=1,
        replay_transitions=12, scratch=tmp_path, out=tmp_path / "results",
    )  # fmt: skip
    results = main(settings, run_stage=run_here)
    written = json.loads((tmp_path / "results" / "memory.json").read_text())["results"]
    found = written["stages"]
    assert list(found) == [
        "collection",
        "downstream, dense",
        "downstream, reencode",
        "imports",
        "pretraining",
    ]
    assert found["pretraining"]["answer"]["updates"] == 1
    for mode in ("dense", "reencode"):
        answer = found[f"downstream, {mode}"]["answer"]
        assert (answer["mode"], answer["transitions"]) == (mode, 12)
        assert answer["replay_bytes_on_disk"] >= answer["frame_slots"] * 3 * 84 * 84
    disk = {row["name"]: row for row in results["disk"]}
    assert 2.117 < disk["dataset of 100,000"]["value"] < 2.2, "21,168 bytes a frame, and little else"
    assert disk["dataset of 100,000"]["target"] == 2.2
    printed = capsys.readouterr().out
    assert "| downstream, dense | 0.300 | 20 | 0.01 |" in printed
    assert [file.name for file in tmp_path.iterdir()] == ["results"], "the frames are gone"


def test_more_than_the_disk_holds_is_refused(tmp_path):
    with pytest.raises(DiskSpaceError):
        main(Settings(replay_transitions=10**9, scratch=tmp_path), run_stage=run_here)
    assert not list(tmp_path.iterdir())


def test_dense_features_that_do_not_fit_the_memory_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("crptpro.transforms.shift_cache.free_bytes", lambda device: 10**9)
    with pytest.raises(CRPTproError, match="too little memory"):
        main(Settings(scratch=tmp_path), run_stage=run_here)
    assert not list(tmp_path.iterdir())
