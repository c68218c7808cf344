from __future__ import annotations

import json
import logging
import os
import random
import re
import signal
import subprocess
import sys
import textwrap
import time
import zlib
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import torch
import toy_env
from torchrl.modules import RandomPolicy
from toy_env import DYING, FAILING, FIXED, SEEDLESS, SLOW, VARIABLE, ToyEnv, data_bytes, make_toy, variable_length

from crptpro.data import FrameDataset, collect, collect_group, collect_random
from crptpro.data.collect import dataset_path
from crptpro.domains import Domain
from crptpro.envs import factory, make_env
from crptpro.errors import CRPTproError, DatasetError, DiskSpaceError, EnvCrashedError, RenderingError, WorkerLostError
from crptpro.seeding import derive_seed

SMALL: dict[str, Any] = {"image_size": 8, "progress": False}
ASKED: dict[str, Any] = {"transitions": 65, "seed": 3, **SMALL}
FIRST_REVISION = {"toy-fixed": 3622606928, "toy-variable": 3227218096}
"""Checksums of all data files, in the order of their names, as the first revision wrote them."""


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Two domains, one with episodes of unknown length, in this process."""
    return collect_group([FIXED, VARIABLE], tmp_path_factory.mktemp("one"), **ASKED)


def test_the_same_seed_gives_the_data_that_earlier_revisions_collected(collected: dict[str, Path]) -> None:
    found = {name: zlib.crc32(b"".join(data_bytes(path).values())) for name, path in collected.items()}
    assert found == FIRST_REVISION


def test_other_colours_are_remembered_and_show_the_same_episodes(collected: dict[str, Path], tmp_path: Path) -> None:
    normal = FrameDataset.open(collected["toy-fixed"])
    swapped = FrameDataset.open(collect_random(FIXED, tmp_path, colors="reversed_image", **ASKED))
    assert (normal.card["colors"], swapped.card["colors"]) == ("normal", "reversed_image")
    assert swapped.frames["pixels"].equal(normal.frames["pixels"].flip(-3))


def test_the_global_generators_are_left_as_they_were(tmp_path: Path) -> None:
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    collect_random(FIXED, tmp_path, transitions=12, **SMALL)
    assert torch.equal(torch.rand(3), expected)


def test_the_last_episode_is_cut_to_the_transitions_asked_for(collected: dict[str, Path]) -> None:
    dataset = FrameDataset.open(collected["toy-fixed"])
    last, following = dataset[-1], dataset[-1]["next"]
    assert (len(dataset), dataset.card["episodes"]) == (65, 7)
    flags = (following["truncated"].item(), following["terminated"].item())
    assert (last["step"].item(), *flags) == (4, True, False)


def test_actions_are_uniform_and_physics_is_stored_beside_each_frame(collected: dict[str, Path]) -> None:
    dataset = FrameDataset.open(collected["toy-fixed"])
    actions = dataset.transitions["action"]
    assert actions.abs().max() <= 1
    assert actions.mean().abs() < 0.2
    assert ((actions**2).mean() - 1 / 3).abs() < 0.1
    assert dataset.frames["qpos"][:11, 0].tolist() == list(range(11))
    assert dataset.frames["qvel"][:11].unique().item() == derive_seed(3, "collect", "toy-fixed", 0)


def test_an_endless_episode_is_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(factory, "LONGEST_EPISODE_AGENT_STEPS", 12)
    domain = Domain("endless", "endless_go", make=partial(make_toy, lambda seed: 10**9))
    dataset = FrameDataset.open(collect_random(domain, tmp_path, transitions=27, **SMALL))
    assert dataset.transitions["next", "truncated"].squeeze(-1).nonzero().flatten().tolist() == [11, 23, 26]
    assert not dataset.transitions["next", "terminated"].any()


def test_warnings_of_the_simulator_do_not_cross_the_progress_bar(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    collect_random(toy_env.WARNING, tmp_path, transitions=20, workers=2, **SMALL)
    assert "Failed to converge" not in capfd.readouterr().err


def test_processes_that_hang_are_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collect.WorkerPool, "submit", lambda *_: Future())
    monkeypatch.setattr(collect, "STALL_S", 0.1)
    with pytest.raises(RenderingError, match=r"episode 0 of toy-fixed.*have made no step.*MUJOCO_GL"):
        collect_random(FIXED, tmp_path, transitions=50, workers=2, **SMALL)


def test_a_complete_dataset_is_returned_as_it_is(collected: dict[str, Path], caplog: pytest.LogCaptureFixture) -> None:
    path = collected["toy-fixed"]
    written = {file: file.stat().st_mtime_ns for file in path.rglob("*")}
    with caplog.at_level(logging.INFO, "crptpro"):
        assert collect_group([FIXED], path.parent, **ASKED) == {"toy-fixed": path}
    assert {file: file.stat().st_mtime_ns for file in path.rglob("*")} == written
    assert "is complete" in caplog.text


def test_numbers_are_taken_as_they_are_meant_and_the_dataset_can_be_read(tmp_path: Path) -> None:
    meant = {"transitions": 1e1, "seed": np.int64(3), "action_repeat": torch.tensor(1), "image_size": np.float32(8)}
    path = collect_random(FIXED, tmp_path, workers=np.int32(1), progress=False, **meant)
    card = FrameDataset.open(path).card
    assert [card[name] for name in meant] == [10, 3, 1, 8]


@pytest.mark.parametrize(("asked", "message"), [
    ({"transitions": 0}, "`transitions` must be at least 1, got 0"),
    ({"transitions": 1.5}, "`transitions` must be a whole number, got 1.5"),
    ({"workers": 0}, "`workers` must be at least 1, got 0"),
    ({"image_size": 0}, "`image_size` must be at least 1, got 0"),
    ({"seed": -1}, "`seed` must be at least 0, got -1"),
    ({"root": ""}, "`root` is empty"),
    ({"root": "bad\udcff"}, "`root` is not UTF-8"),
])  # fmt: skip
def test_what_cannot_be_meant_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: dict[str, Any], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    request = {"root": "data", "transitions": 5} | asked
    with pytest.raises((ValueError, CRPTproError), match=message):
        collect_random(FIXED, request.pop("root"), **request)
    assert not list(tmp_path.iterdir())


def test_what_the_disk_cannot_hold_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(DiskSpaceError, match=r"Collecting toy-fixed, toy-variable needs .* GB"):
        collect_group([FIXED, VARIABLE], tmp_path / "data", transitions=10**9)
    assert not list(tmp_path.iterdir())
    assert len(FrameDataset.open(collect_random(FIXED, tmp_path, transitions=5, **SMALL))) == 5


def test_domains_are_collected_once_each_into_safe_directories(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DatasetError, match="Two of the domains"):
        collect_group([FIXED, replace(FIXED, task="toy_other")], tmp_path, transitions=5, **SMALL)
    monkeypatch.setattr("crptpro.domains.GROUPS", {"X": (FIXED,), "Y": (FIXED, VARIABLE)})
    assert list(collect_group(["X", "Y"], tmp_path, transitions=5, **SMALL)) == [FIXED.name, VARIABLE.name]
    assert dataset_path(tmp_path, "gymnasium:Half/Cheetah-v5") == tmp_path / "gymnasium-Half-Cheetah-v5"


def test_the_card_says_with_what_was_collected_without_gl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collect, "select_backend", lambda **_: pytest.fail("a GL backend was proven"))
    card = FrameDataset.open(collect_random(FIXED, tmp_path, transitions=5, quality="fast", **SMALL)).card
    assert (card["quality"], card["image_size"], card["render"]) == ("fast", 8, {})
    assert {"torch", "torchrl", "mujoco", "python"} <= set(card["versions"])


def test_progress_is_logged_where_the_output_is_no_terminal(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "crptpro"):
        collect_random(FIXED, tmp_path, transitions=100, image_size=8)
    lines = [record.message for record in caplog.records if "transitions/s" in record.message]
    assert len(lines) == 10
    assert lines[-1].startswith("toy-fixed: 100 of 100 transitions (100 %), ")
    assert all(re.search(r", \d\d:\d\d left$", line) for line in lines)


def test_an_environment_that_fails_is_named_with_its_cause_and_does_not_block_the_repaired_one(tmp_path: Path) -> None:
    with pytest.raises(EnvCrashedError, match="the simulator exploded") as failure:
        collect_random(FAILING, tmp_path, transitions=50, **SMALL)
    assert isinstance(failure.value.__cause__, ValueError)
    (note,) = failure.value.__notes__
    assert note.startswith("Collecting episode 0 of toy-failing failed. What was collected is kept")
    repaired = Domain(FAILING.name, FAILING.task, make=FIXED.make)
    assert len(FrameDataset.open(collect_random(repaired, tmp_path, transitions=5, **SMALL))) == 5


def test_a_domain_that_cannot_be_built_is_refused_before_the_others_are_collected(tmp_path: Path) -> None:
    def no_camera(*, seed: int, image_size: int) -> ToyEnv:
        raise ValueError("there is no camera")

    with pytest.raises(EnvCrashedError, match="there is no camera"):
        collect_group([FIXED, Domain("blind", "blind_go", make=no_camera)], tmp_path, transitions=5, **SMALL)
    with pytest.raises(CRPTproError, match="colors must be"):
        collect_group([FIXED], tmp_path, transitions=5, colors="blue", **SMALL)
    assert not list(tmp_path.rglob("*.memmap"))


def test_a_process_that_dies_gives_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(WorkerLostError, match=r"episode 0 of toy-dying has died.*use fewer workers.*run the same"):
        collect_random(DYING, tmp_path, transitions=50, workers=2, **SMALL)


def test_an_exception_that_cannot_leave_its_process_is_reported_by_what_it_says(tmp_path: Path) -> None:
    with pytest.raises(EnvCrashedError, match=r"no seed \d+ in the catalogue \(UncopiableError in "):
        collect_random(SEEDLESS, tmp_path, transitions=50, workers=2, **SMALL)


def test_an_environment_that_no_other_process_can_import_is_collected_in_this_one_which_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def of_a_cell(*, seed: int, image_size: int) -> ToyEnv:
        return ToyEnv(variable_length, seed=seed, image_size=image_size)

    main = sys.modules["__main__"]
    monkeypatch.delattr(main, "__file__", raising=False)  # as in a notebook
    monkeypatch.setattr(main, "make_of_a_notebook", of_a_cell, raising=False)
    for name, make in {"closure": of_a_cell, "notebook": of_a_cell}.items():
        if name == "notebook":
            make.__module__, make.__qualname__ = "__main__", "make_of_a_notebook"
        domain = Domain(name, f"{name}_go", make=make)
        path = collect_random(domain, tmp_path, transitions=20, workers=2, **SMALL)
        assert len(FrameDataset.open(path)) == 20
        assert f"{name} is collected in this process: no other one can import its `make`" in caplog.text
    assert len([record for record in caplog.records if record.levelname == "WARNING"]) == 2


def program(root: Path, *, workers: int = 2, limit: str = "pass", more: str = "pass") -> str:
    return textwrap.dedent(f"""
        import sys
        sys.path.insert(0, {str(Path(toy_env.__file__).parent)!r})
        from toy_env import SLOW
        from crptpro.data import collect_random
        {more}
        if __name__ == "__main__":
            {limit}
            collect_random(SLOW, {str(root)!r}, transitions=300, seed=1, workers={workers}, image_size=8)
    """)


QUICK = replace(SLOW, make=partial(make_toy, variable_length))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The data of the program, collected without pauses in this process."""
    return data_bytes(collect_random(QUICK, tmp_path_factory.mktemp("whole"), transitions=300, seed=1, **SMALL))


def test_a_program_from_standard_input_collects_with_several_processes(tmp_path: Path, whole: dict[str, bytes]) -> None:
    run = subprocess.run([sys.executable], input=program(tmp_path), capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert data_bytes(tmp_path / "toy-slow") == whole
    assert "in this process" not in run.stderr


def start(root: Path, **changes: Any) -> subprocess.Popen:
    file = root.with_suffix(".py")
    file.write_text(program(root, **changes))
    # A group of its own, so that one kill ends the program and all its processes; and Ctrl-C heeded, although a
    # test suite that a script started in the background inherits that it is ignored.
    return subprocess.Popen(
        [sys.executable, str(file)],
        start_new_session=True,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def episodes_in(path: Path) -> int:
    file = path / "card.json"
    return json.loads(file.read_text())["episodes"] if file.exists() else 0


def stop_while_collecting(process: subprocess.Popen, path: Path, how: int, *, whole_group: bool) -> bytes:
    """Send a signal some time after a further episode was finished; afterwards no process is left."""
    before, deadline = episodes_in(path), time.monotonic() + 300
    while episodes_in(path) <= before:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    time.sleep(random.uniform(0, 0.1))
    family = psutil.Process(process.pid).children(recursive=True)
    os.killpg(process.pid, how) if whole_group else os.kill(process.pid, how)
    errors = process.communicate(timeout=60)[1]
    assert not psutil.wait_procs(family, timeout=20)[1]
    return errors


def test_interrupted_or_killed_and_started_again_gives_the_same_bytes(tmp_path: Path, whole: dict[str, bytes]) -> None:
    interrupted, killed = tmp_path / "interrupted", tmp_path / "killed"
    with ThreadPoolExecutor(2) as threads:
        stops = [
            threads.submit(stop_while_collecting, start(root), root / "toy-slow", how, whole_group=is_group)
            for root, how, is_group in ((interrupted, signal.SIGINT, True), (killed, signal.SIGKILL, False))
        ]
    errors = stops[0].result()
    assert errors.count(b"Traceback") == 1  # as Ctrl-C does: the program's own, none of its processes'
    assert b"KeyboardInterrupt" in errors
    stops[1].result()
    for root in (interrupted, killed):
        with pytest.raises(DatasetError, match="is unfinished"):
            FrameDataset.open(root / "toy-slow")
        path = collect_random(QUICK, root, transitions=300, seed=1, **SMALL)
        assert data_bytes(path) == whole


def test_processes_that_cannot_be_started_are_an_error_that_says_why(tmp_path: Path) -> None:
    few = "import resource; resource.setrlimit(resource.RLIMIT_NOFILE, (20, 20))"
    unguarded = 'collect_random(SLOW, sys.argv[0] + "data", transitions=400, workers=2, image_size=8)'
    programs = [start(tmp_path / "few", workers=4, limit=few), start(tmp_path / "unguarded", more=unguarded)]
    limited, unguarded_said = (program.communicate(timeout=300)[1] for program in programs)
    assert b"Use fewer workers, or raise the limit of open files (`ulimit -n 4096`)" in limited
    assert b'lacks `if __name__ == "__main__":` around its main program' in unguarded_said


@pytest.mark.gl
def test_pixels_are_those_of_the_live_environment_whatever_the_number_of_workers(tmp_path: Path) -> None:
    settings = {"transitions": 18, "seed": 7, "quality": "fast", "action_repeat": 200, "progress": False}
    path = collect_random("cartpole", tmp_path / "one", **settings)  # four episodes of five, the last one cut
    two = collect_random("cartpole", tmp_path / "two", workers=2, **settings)
    assert data_bytes(two) == data_bytes(path)
    dataset = FrameDataset.open(path)
    env = make_env("cartpole_swingup_sparse", seed=0, quality="fast", action_repeat=200)
    env.set_seed(derive_seed(7, "collect", "cartpole", 2))
    first = env.reset()
    torch.manual_seed(derive_seed(7, "collect-actions", "cartpole", 2))
    live = env.rollout(10, RandomPolicy(env.full_action_spec), auto_reset=False, tensordict=first)
    env.close()
    stored = dataset[dataset.transitions["episode"] == 2]
    for key in ("pixels", ("next", "pixels"), "action", ("next", "reward"), ("next", "truncated")):
        assert torch.equal(stored[key], live[key]), key
    assert dataset.frames["qpos"].shape == (len(dataset) + dataset.card["episodes"], 2)
    render = dataset.card["render"]
    assert render["backend"] in ("egl", "osmesa", "glfw")
    assert render["gl_renderer"] not in ("", "unknown")
