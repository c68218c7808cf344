"""Every task of dm_control's suite by its name: the ones that the paper does not use are worlds too."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import EnvBase, check_env_specs

from crptpro.domains import SUITE_TASKS
from crptpro.envs import make_env
from crptpro.envs.rendering import select_backend

pytestmark = [pytest.mark.gl, pytest.mark.slow]

TASKS = [task for tasks in SUITE_TASKS.values() for task in tasks]
#: Fluids, muscles, dozens of joints, a context made in the reset, actuators without bounds, no time limit.
UNUSUAL = (
    "dog_stand", "humanoid_CMU_stand", "swimmer_swimmer6", "stacker_stack_2", "fish_swim", "quadruped_escape",
    "lqr_2_1",
)  # fmt: skip


def make_task(task: str) -> EnvBase:
    """Long agent steps, so that every world moves visibly in one."""
    return make_env(task, seed=0, image_size=48, frame_stack=1, action_repeat=20, quality="fast")


def test_the_list_of_tasks_is_dm_controls() -> None:
    select_backend()  # dm_control keeps the backend that it is imported with
    from dm_control import suite

    known = {task if world == "lqr" else f"{world}_{task}" for world, task in suite.ALL_TASKS}
    assert set(TASKS) == known


@pytest.mark.parametrize("task", TASKS)
def test_every_suite_task_is_built_by_its_name_and_its_pixels_live(task: str) -> None:
    env = make_task(task)
    first = env.reset()
    action = first.clone().set("action", torch.ones(env.action_spec.shape))
    last = env.step(action)["next"]
    assert first["pixels"].unique().numel() > 10
    assert not torch.equal(first["pixels"], last["pixels"])
    assert last["reward"].isfinite().all()
    env.close()


@pytest.mark.parametrize("task", UNUSUAL)
def test_unusual_suite_tasks_keep_their_specs(task: str) -> None:
    env = make_task(task)
    check_env_specs(env)
    env.close()
