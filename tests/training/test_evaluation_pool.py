from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import torch
from test_downstream import small_pretrained, toy_env
from torchrl.envs import CatFrames, EnvBase, TransformedEnv
from toy_world import ToyEnv, make_dying, make_hanging

from crptpro.errors import CRPTproError, RenderingError
from crptpro.modules import SquashedGaussianActor
from crptpro.training import PixelAgent, evaluate
from crptpro.training.evaluation_pool import EvaluationPool, can_be_sent

make_toy = functools.partial(toy_env, "toy", seed=0, image_size=16, frame_stack=3)


def small_agent(seed: int = 0) -> PixelAgent:
    encoder = small_pretrained().encoder
    torch.manual_seed(seed)
    return PixelAgent(encoder, SquashedGaussianActor(encoder.feature_dim, 2, hidden_dim=8))


def make_refusing() -> EnvBase:
    raise RenderingError("no backend renders here")


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
        episodes, videos = pool.take(is_awaited=True)
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
    episodes, _ = pool.take(is_awaited=True)
    assert episodes == expected


def test_nothing_is_taken_before_it_is_complete_and_nothing_twice(pool: EvaluationPool) -> None:
    assert pool.take(is_awaited=True) is None
    pool.start(small_agent(), episodes=3, seed=0)
    with pytest.raises(RuntimeError, match="One evaluation at a time"):
        pool.start(small_agent(), episodes=3, seed=0)
    deadline = time.monotonic() + 60
    while (outcome := pool.take(is_awaited=False)) is None:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert len(outcome[0]) == 3
    assert pool.take(is_awaited=False) is None


@pytest.mark.parametrize(
    ("make_env", "error", "message"),
    [
        (make_refusing, RenderingError, "^no backend renders here$"),
        (make_exploding, CRPTproError, "failed: the simulator exploded.*start it again"),
        (functools.partial(stacked, make_dying), CRPTproError, "episode 0.* exited with status 7"),
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
        pool.start(small_agent(), episodes=1, seed=0)
        with pytest.raises(error, match=message):
            pool.take(is_awaited=True)
    finally:
        pool.close()


def test_a_killed_process_is_named_with_the_signal() -> None:
    pool = EvaluationPool(functools.partial(stacked, make_hanging), workers=1)
    pool.start(small_agent(), episodes=1, seed=0)
    os.kill(pool._workers[0].process.pid, signal.SIGKILL)
    with pytest.raises(CRPTproError, match=r"killed by signal 9\. Out of memory"):
        pool.take(is_awaited=True)
    pool.close()


def test_closing_ends_busy_processes() -> None:
    pool = EvaluationPool(functools.partial(stacked, make_hanging), workers=1)
    pool.start(small_agent(), episodes=1, seed=0)
    process = pool._workers[0].process
    pool.close()
    assert process.poll() is not None


def test_processes_end_with_a_parent_that_was_killed() -> None:
    program = """
import functools, sys, time
from test_evaluation_pool import EvaluationPool, functools, make_hanging, small_agent, stacked
pool = EvaluationPool(functools.partial(stacked, make_hanging), workers=1)
pool.start(small_agent(), episodes=1, seed=0)
print(pool._workers[0].process.pid, flush=True)
time.sleep(100)
"""
    here = Path(__file__).parent
    path = os.pathsep.join([str(here), str(here.parent / "data"), *filter(None, sys.path)])
    parent = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
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
