from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
import torch
from test_downstream import small_pretrained, toy_env
from torchrl.envs import CatFrames, EnvBase, TransformedEnv
from toy_world import ToyEnv, make_dying, make_hanging

from crptpro.errors import CRPTproError, RenderingError, WorkerLostError
from crptpro.modules import SquashedGaussianActor
from crptpro.training import PixelAgent, evaluate
from crptpro.training.evaluation_pool import EvaluationPool, can_be_sent

make_toy = functools.partial(toy_env, "toy", seed=0, image_size=16, frame_stack=3)


def small_agent(seed: int = 0) -> PixelAgent:
    encoder = small_pretrained().encoder
    torch.manual_seed(seed)
    return PixelAgent(encoder, SquashedGaussianActor(encoder.feature_dim, 2, hidden_dim=8))


def full_size_agent() -> PixelAgent:
    """Its snapshot is larger than what a connection holds without a reader."""
    encoder = small_pretrained().encoder
    return PixelAgent(encoder, SquashedGaussianActor(encoder.feature_dim, 2))


def start_program(program: str, **options: Any) -> subprocess.Popen[str]:
    here = Path(__file__).parent
    path = os.pathsep.join([str(here), str(here.parent / "data"), *filter(None, sys.path)])
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, env=environment, **options
    )


def make_refusing() -> EnvBase:
    raise RenderingError("no backend renders here")


def make_unreadable() -> EnvBase:
    raise EOFError("the save game ends early")


def make_unhurried(*, seed: int, image_size: int) -> EnvBase:
    return ToyEnv(lambda seed: 10, seed=seed, image_size=image_size, on_step=lambda count: time.sleep(0.15))


class Unpicklable:
    """Arrives, and cannot be rebuilt."""

    def __call__(self) -> EnvBase:
        raise AssertionError

    def __reduce__(self) -> object:
        return (_refuse, ())


def _refuse() -> None:
    raise ImportError("No module named 'her_laptop'")


def make_exploding() -> EnvBase:
    def explode(count: int) -> None:
        raise ValueError("the simulator exploded")

    env = ToyEnv(lambda seed: 10, image_size=16, on_step=explode)
    return TransformedEnv(env, CatFrames(N=3, dim=-3, in_keys=["pixels"], padding="same"))


def stacked(make: object) -> EnvBase:
    env = make(seed=0, image_size=16)  # type: ignore[operator]
    return TransformedEnv(env, CatFrames(N=3, dim=-3, in_keys=["pixels"], padding="same"))


@pytest.fixture(scope="module")
def pool() -> Iterator[EvaluationPool]:
    pool = EvaluationPool(make_toy, workers=2)
    yield pool
    pool.close()


def test_its_episodes_and_pictures_are_those_of_evaluate(pool: EvaluationPool) -> None:
    for seed in (1, 2):
        agent = small_agent(seed)
        pool.start(agent, episodes=5, seed=seed, record_episodes=2)
        episodes, videos = pool.result()
        expected, pictures = evaluate(
            agent, make_toy(), episodes=5, seed=seed, record_episodes=2, progress=False
        )
        assert episodes == expected
        assert len(videos) == 2
        for video, picture in zip(videos, pictures, strict=True):
            assert torch.equal(video, picture)


def test_it_evaluates_the_agent_of_the_moment_it_was_asked(pool: EvaluationPool) -> None:
    agent = small_agent()
    expected, _ = evaluate(agent, make_toy(), episodes=2, seed=0, progress=False)
    pool.start(agent, episodes=2, seed=0)
    with torch.no_grad():
        for parameter in agent.actor.parameters():
            parameter.add_(1.0)
    episodes, _ = pool.result()
    assert episodes == expected


def test_there_is_one_evaluation_at_a_time_and_its_result_is_taken_once(pool: EvaluationPool) -> None:
    pool.start(small_agent(), episodes=3, seed=0)
    with pytest.raises(RuntimeError, match="One evaluation at a time"):
        pool.start(small_agent(), episodes=3, seed=0)
    assert len(pool.result()[0]) == 3
    with pytest.raises(RuntimeError, match="No evaluation is under way"):
        pool.result()


def test_episodes_follow_each_other_while_nobody_asks() -> None:
    pool = EvaluationPool(functools.partial(stacked, make_unhurried), workers=1)
    pool.start(small_agent(), episodes=3, seed=0)  # 1.5 s each, with a sign of life in between
    assert pool._evaluation is not None
    pool._evaluation.result(timeout=60)
    began = time.monotonic()
    assert [episode.episode for episode in pool.result()[0]] == [0, 1, 2]
    assert time.monotonic() - began < 1  # an episode alone takes longer
    pool.close()


def test_a_process_that_died_between_two_evaluations_is_replaced(pool: EvaluationPool) -> None:
    pool.start(small_agent(), episodes=2, seed=0)
    first = pool.result()
    victim = pool._workers[0].process
    victim.kill()
    victim.wait()
    pool.start(small_agent(), episodes=2, seed=0)
    assert pool.result() == first


def test_ctrl_c_reaches_the_caller_and_not_the_processes() -> None:
    program = """
import functools, signal, time
from test_evaluation_pool import EvaluationPool, make_toy, small_agent
asked = []
signal.signal(signal.SIGINT, lambda *_: asked.append(1))
pool = EvaluationPool(make_toy, workers=1)
pool.start(small_agent(), episodes=1, seed=0)
print("started", flush=True)
print(len(pool.result()[0]), len(asked), flush=True)
pool.close()
"""
    run = start_program(program, start_new_session=True)
    assert run.stdout.readline() == "started\n"  # type: ignore[union-attr]
    for _ in range(3):  # while the process imports, and when it does not
        time.sleep(0.7)
        os.killpg(run.pid, signal.SIGINT)
    assert run.communicate(timeout=60)[0] == "1 3\n"
    assert run.returncode == 0


def test_the_callers_directory_does_not_hide_the_standard_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "statistics.py").write_text("raise RuntimeError('not this one')")
    monkeypatch.chdir(tmp_path)
    pool = EvaluationPool(make_toy, workers=1)
    pool.start(small_agent(), episodes=1, seed=0)
    assert len(pool.result()[0]) == 1
    pool.close()


@pytest.mark.parametrize(
    ("make_env", "error", "message"),
    [
        (make_refusing, RenderingError, "^no backend renders here$"),
        (make_exploding, CRPTproError, "failed: the simulator exploded.*start it again"),
        (make_unreadable, CRPTproError, "failed: the save game ends early"),
        (Unpicklable(), CRPTproError, "failed: No module named 'her_laptop'"),
        (functools.partial(stacked, make_dying), WorkerLostError, "episode 0.* exited with status 7"),
        (
            functools.partial(stacked, make_hanging),
            RenderingError,
            "no sign of life for 20 s.*eval_workers=0",
        ),
    ],
)
def test_a_process_that_fails_dies_or_hangs_is_named(
    make_env: object, error: type[Exception], message: str
) -> None:
    pool = EvaluationPool(make_env, workers=1, stall_timeout_s=20)  # type: ignore[arg-type]
    try:
        pool.start(full_size_agent(), episodes=1, seed=0)
        with pytest.raises(error, match=message):
            pool.result()
    finally:
        pool.close()


def test_a_process_that_cannot_be_started_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object, **options: object) -> None:
        raise OSError(12, "Cannot allocate memory")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    pool = EvaluationPool(make_toy, workers=1)
    pool.start(small_agent(), episodes=1, seed=0)
    with pytest.raises(CRPTproError, match=r"could not be started: .*Cannot allocate memory"):
        pool.result()
    pool.close()


def test_a_killed_process_is_named_with_the_signal() -> None:
    pool = EvaluationPool(functools.partial(stacked, make_hanging), workers=1)
    busy_process(pool).kill()
    with pytest.raises(WorkerLostError, match=r"killed by signal 9\. Out of memory"):
        pool.result()
    pool.close()


def busy_process(pool: EvaluationPool) -> subprocess.Popen[bytes]:
    """Start an evaluation and wait until its process is in the episode."""
    pool.start(small_agent(), episodes=1, seed=0)
    deadline = time.monotonic() + 60
    while not pool._workers or pool._workers[0].episode is None:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process = pool._workers[0].process
    while psutil.Process(process.pid).cpu_times().user < 2:  # its imports
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return process


def test_closing_ends_busy_processes() -> None:
    pool = EvaluationPool(functools.partial(stacked, make_hanging), workers=1)
    process = busy_process(pool)
    pool.close()
    pool.close()
    assert process.poll() is not None


def test_processes_end_with_a_parent_that_was_killed() -> None:
    program = """
import functools, sys, time
from test_evaluation_pool import EvaluationPool, functools, make_hanging, small_agent, stacked
pool = EvaluationPool(functools.partial(stacked, make_hanging), workers=1)
pool.start(small_agent(), episodes=1, seed=0)
while not pool._workers:
    time.sleep(0.01)
print(pool._workers[0].process.pid, flush=True)
time.sleep(100)
"""
    parent = start_program(program)
    child = psutil.Process(int(parent.stdout.readline()))  # type: ignore[union-attr]
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 60
    while child.is_running() and child.status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_only_what_another_process_can_build_is_sent() -> None:
    assert can_be_sent(make_toy)
    assert not can_be_sent(lambda: make_toy())
    stranger = type("Stranger", (), {"__call__": lambda self: None})
    stranger.__module__ = "__main__"
    sys.modules["__main__"].Stranger = stranger  # type: ignore[attr-defined]
    try:
        stranger.__qualname__ = "Stranger"
        assert not can_be_sent(stranger())
    finally:
        del sys.modules["__main__"].Stranger  # type: ignore[attr-defined]
