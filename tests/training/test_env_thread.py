from __future__ import annotations

import dataclasses
import threading
import time

import pytest
import torch
from tensordict import TensorDict
from toy_world import ToyEnv

from crptpro.training import DownstreamConfig
from crptpro.training.env_thread import EnvThread, runs_ahead


def make_toy() -> ToyEnv:
    return ToyEnv(lambda seed: 10)


def action(value: float) -> torch.Tensor:
    return torch.full((2,), value)


def rollout(env: EnvThread) -> list[TensorDict]:
    observation = env.reset(3)
    found = [observation]
    for value in (0.1, 0.2, 0.3):
        env.begin_step(TensorDict({**observation, "action": action(value)}, []))
        observation = env.end_step()["next"]
        found.append(observation)
    env.close()
    return found


def test_running_ahead_changes_nothing_that_the_environment_returns() -> None:
    for first, second in zip(
        rollout(EnvThread(make_toy, is_ahead=True)), rollout(EnvThread(make_toy, is_ahead=False)), strict=True
    ):
        assert (first == second).all()


def test_the_environment_is_made_stepped_and_closed_in_one_thread_that_is_not_the_callers() -> None:
    threads: list[int] = []

    class Watched(ToyEnv):
        def __init__(self) -> None:
            super().__init__(lambda seed: 10, on_step=lambda count: threads.append(threading.get_ident()))
            threads.append(threading.get_ident())

        def close(self, **options: object) -> None:
            threads.append(threading.get_ident())
            super().close(**options)

    rollout(EnvThread(Watched, is_ahead=True))
    assert len(threads) == 5
    assert set(threads) != {threading.get_ident()}
    assert len(set(threads)) == 1


def test_the_caller_goes_on_while_the_environment_works() -> None:
    env = EnvThread(lambda: ToyEnv(lambda seed: 10, on_step=lambda count: time.sleep(2)), is_ahead=True)
    observation = env.reset(0)
    began = time.monotonic()
    env.begin_step(observation.set("action", action(0.0)))
    assert time.monotonic() - began < 1
    env.end_step()
    assert time.monotonic() - began >= 2
    env.close()


@pytest.mark.parametrize("is_ahead", [True, False])
def test_an_error_of_the_environment_reaches_the_caller_and_closing_still_works(is_ahead: bool) -> None:
    def explode(count: int) -> None:
        raise ValueError("the simulator exploded")

    env = EnvThread(lambda: ToyEnv(lambda seed: 10, on_step=explode), is_ahead=is_ahead)
    env.begin_step(env.reset(0).set("action", action(0.0)))
    with pytest.raises(ValueError, match="exploded"):
        env.end_step()
    env.begin_step(env.reset(0).set("action", action(0.0)))
    env.close()


def test_an_environment_that_cannot_be_made_leaves_no_thread_behind() -> None:
    before = threading.active_count()
    with pytest.raises(ZeroDivisionError):
        EnvThread(lambda: 1 / 0, is_ahead=True)  # type: ignore[arg-type, return-value]
    assert threading.active_count() == before


def test_a_step_that_never_began_has_no_end() -> None:
    env = EnvThread(make_toy, is_ahead=False)
    with pytest.raises(RuntimeError, match="begin_step"):
        env.end_step()


def test_steps_do_not_overtake_each_other_and_closing_again_is_harmless() -> None:
    env = EnvThread(make_toy, is_ahead=True)
    env.begin_step(env.reset(0).set("action", action(0.0)))
    with pytest.raises(RuntimeError, match=r"begin_step\(\) twice"):
        env.begin_step(env.reset(0).set("action", action(0.0)))
    env.close()
    env.close()


def test_the_thread_computes_with_one_core_and_the_caller_with_its_own_number() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        numbers: list[int] = []
        env = EnvThread(
            lambda: ToyEnv(lambda seed: 10, on_step=lambda count: numbers.append(torch.get_num_threads())),
            is_ahead=True,
        )
        env.begin_step(env.reset(0).set("action", action(0.0)))
        env.end_step()
        env.close()
        assert numbers == [1]
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("task", "device", "cores", "backend", "expected"),
    [
        ("walker_walk", "cpu", 2, "egl", True),
        ("walker_walk", "cpu", 1, "egl", False),
        ("walker_walk", "cuda", 2, "egl", False),
        ("walker_walk", "cpu", 2, "glfw", False),
        ("a caller's own", "cpu", 2, "glfw", True),
    ],
)
def test_running_ahead_is_chosen_where_it_pays_and_can_be_asked_for(
    monkeypatch: pytest.MonkeyPatch, task: str, device: str, cores: int, backend: str, expected: bool
) -> None:
    monkeypatch.setattr("crptpro.training.env_thread.cpu_cores", lambda: cores)
    monkeypatch.setattr("crptpro.training.env_thread.select_backend", lambda: backend)
    config = DownstreamConfig(device=device)
    assert runs_ahead(task, config) is expected
    assert runs_ahead(task, dataclasses.replace(config, render_ahead=not expected)) is not expected
