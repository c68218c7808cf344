from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from test_downstream import SMALL, rows_without_time, toy_env, train
from torchrl.envs import EnvBase

from crptpro.errors import CRPTproError, RenderingError
from crptpro.training import CheckpointDir, DownstreamConfig
from crptpro.training.downstream_evaluation import eval_workers


def sleepy_env(task: str, *, seed: int, **settings: object) -> EnvBase:
    """The toy world; in an evaluating process it takes its time."""
    env = toy_env(task, seed=seed, **settings)  # type: ignore[arg-type]
    if "evaluation_worker" in " ".join(sys.orig_argv) and os.environ.get("TOY_IS_SLEEPY"):
        env.base_env.on_step = lambda count: time.sleep(0.3)
    return env


def only_here(task: str, *, seed: int, **settings: object) -> EnvBase:
    """The toy world, which no other process can build."""
    if "evaluation_worker" in " ".join(sys.orig_argv):
        raise ValueError("not in this process")
    return toy_env(task, seed=seed, **settings)  # type: ignore[arg-type]


def make_toy() -> EnvBase:
    return toy_env("toy", seed=0, image_size=16, frame_stack=3)


def test_processes_of_its_own_change_no_number(tmp_path: Path) -> None:
    inline = train(tmp_path / "inline", eval_workers=0, render_ahead=False)
    beside = train(tmp_path / "beside", eval_workers=2, render_ahead=True)
    assert rows_without_time(beside.evaluations) == rows_without_time(inline.evaluations)
    for key, value in inline.policy.actor.state_dict().items():
        assert torch.equal(beside.policy.actor.state_dict()[key], value), key


def test_an_evaluation_under_way_when_the_run_is_killed_is_done_again(tmp_path: Path) -> None:
    program = """
import sys
from pathlib import Path
from test_downstream import SMALL, small_pretrained
from test_downstream_evaluation import sleepy_env
from crptpro.training import train_downstream
train_downstream("toy", small_pretrained(), run_dir=Path(sys.argv[1]), config=SMALL, env_factory=sleepy_env,
                 progress=False, eval_workers=1)
"""
    here = Path(__file__).parent
    path = os.pathsep.join([str(here), str(here.parent / "data"), *filter(None, sys.path)])
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", program, str(tmp_path / "killed")]
    run = subprocess.Popen(command, env={**environment, "TOY_IS_SLEEPY": "1"})
    deadline = time.monotonic() + 120
    # The evaluation at 40 env steps takes 6 s longer than the episode after it; a checkpoint is due in the meantime.
    while not (found := sorted((tmp_path / "killed").glob("checkpoints/checkpoint-*0020-*.pt"))):
        assert run.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    run.send_signal(signal.SIGKILL)
    run.wait()
    state = CheckpointDir(found[0].parent).load_latest()
    assert state["evaluation"]["pending"]["counters"]["env_steps"] == 40
    subprocess.run(command, env=environment, check=True, timeout=120)
    whole = train(tmp_path / "whole")
    killed = train(tmp_path / "killed")  # finished: only reads
    assert rows_without_time(killed.evaluations) == rows_without_time(whole.evaluations)


def test_processes_that_fail_are_replaced_by_this_one_where_nobody_asked_for_them(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("crptpro.training.downstream_evaluation.WORTH_PROCESSES", 1)
    monkeypatch.setattr("crptpro.training.downstream_evaluation.cpu_cores", lambda: 2)
    run = train(tmp_path / "auto", eval_workers=None, env_factory=only_here)
    assert caplog.text.count("not in this process. The run is kept") == 1
    assert caplog.text.count("Evaluating in the training process from here on.") == 1
    monkeypatch.undo()
    assert rows_without_time(run.evaluations) == rows_without_time(train(tmp_path / "inline").evaluations)
    with pytest.raises(CRPTproError, match="not in this process"):
        train(tmp_path / "asked", eval_workers=2, env_factory=only_here)


def test_the_record_does_not_depend_on_how_long_an_evaluation_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def order(run_dir: Path) -> list[tuple[str, int]]:
        lines = (run_dir / "metrics.jsonl").read_text().splitlines()
        return [(row["stream"], row["env_steps"]) for row in map(json.loads, lines)]

    train(tmp_path / "quick", eval_workers=2)
    monkeypatch.setenv("TOY_IS_SLEEPY", "1")
    train(tmp_path / "slow", eval_workers=2, env_factory=sleepy_env)
    assert order(tmp_path / "slow") == order(tmp_path / "quick")


@pytest.mark.parametrize(
    ("asked", "episodes", "cores", "threads", "expected"),
    [
        (None, 10, 2, 2, 2),
        (None, 10, 16, 16, 10),
        (None, 10, 64, 4, 4),  # one of several jobs of this machine
        (None, 10, 2, 1, 1),  # two hardware threads of one core
        (None, 10, 1, 1, 0),
        (None, 10, 1, 4, 0),
        (None, 1, 4, 4, 0),  # 14 episodes in all: starting a process would take longer
        (0, 10, 4, 4, 0),
        (3, 10, 1, 1, 3),
        (3, 10, 4, 2, 3),
        (3, 2, 4, 4, 2),
    ],
)
def test_there_are_as_many_processes_as_asked_or_as_pay(
    monkeypatch: pytest.MonkeyPatch, asked: int | None, episodes: int, cores: int, threads: int, expected: int
) -> None:
    monkeypatch.setattr("crptpro.training.downstream_evaluation.cpu_cores", lambda: cores)
    monkeypatch.setattr("torch.get_num_threads", lambda: threads)
    config = DownstreamConfig(env_steps=125_000, eval_workers=asked, eval_episodes=episodes)
    assert eval_workers("toy", make_toy, config) == expected


def test_a_factory_that_no_other_process_can_call_is_evaluated_here_or_refused() -> None:
    assert eval_workers("toy", lambda: make_toy(), DownstreamConfig()) == 0
    with pytest.raises(CRPTproError, match=r"eval_workers is 2, but .* toy .*set eval_workers=0"):
        eval_workers("toy", lambda: make_toy(), DownstreamConfig(eval_workers=2))


def test_a_gpu_that_does_not_render_in_many_processes_is_used_by_one(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    module = "crptpro.training.downstream_evaluation"
    asked: list[tuple[str, int]] = []

    def refuse(backend: str, *, processes: int) -> str:
        asked.append((backend, processes))
        raise RenderingError("The first frame did not arrive from each of 3 processes.")

    monkeypatch.setattr(f"{module}.cpu_cores", lambda: 2)
    monkeypatch.setattr("torch.get_num_threads", lambda: 2)
    monkeypatch.setattr(f"{module}.backend_card", lambda: {"backend": "egl", "gl_kind": "hardware"})
    monkeypatch.setattr(f"{module}.select_backend", refuse)
    assert eval_workers("walker_walk", make_toy, DownstreamConfig()) == 0
    assert "3 processes. Evaluating in the training process instead." in caplog.text
    assert asked == [("egl", 3)]
    with pytest.raises(RenderingError):
        eval_workers("walker_walk", make_toy, DownstreamConfig(eval_workers=2))


def test_a_negative_number_of_processes_is_refused() -> None:
    with pytest.raises(ValueError, match="`eval_workers` must not be negative, got -1"):
        dataclasses.replace(SMALL, eval_workers=-1)
