"""Collection with the real renderer: the pixels of a dataset are those of the live environment."""

from __future__ import annotations

import pytest
import torch
from torchrl.modules import RandomPolicy
from toy_world import data_bytes

from crptpro.data import FrameDataset, collect_random
from crptpro.data.collect_pool import WorkerPool
from crptpro.envs import make_env
from crptpro.seeding import derive_seed

pytestmark = [pytest.mark.gl, pytest.mark.slow]

#: Four episodes of five transitions, the last one cut.
SETTINGS = {"transitions": 18, "seed": 7, "quality": "fast", "action_repeat": 200, "progress": False}


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    return collect_random("cartpole", tmp_path_factory.mktemp("one"), workers=1, **SETTINGS)


def test_pixels_are_the_same_whatever_the_number_of_workers(collected, tmp_path, monkeypatch):
    rendered_by = {}
    submit = WorkerPool.submit

    def recording_submit(pool, worker, job):
        rendered_by[job.episode] = worker.index
        submit(pool, worker, job)

    monkeypatch.setattr(WorkerPool, "submit", recording_submit)
    two = collect_random("cartpole", tmp_path, workers=2, **SETTINGS)
    assert set(rendered_by) == {0, 1, 2, 3}
    assert set(rendered_by.values()) == {0, 1}
    assert data_bytes(two) == data_bytes(collected)


@pytest.mark.parametrize("episode", [0, 2])
def test_an_episode_equals_the_live_stacks_of_its_seeds(collected, episode):
    dataset = FrameDataset.open(collected)
    env = make_env("cartpole_swingup_sparse", seed=0, quality="fast", action_repeat=200)
    env.set_seed(derive_seed(7, "collect", "cartpole", episode))
    start = env.reset()
    torch.manual_seed(derive_seed(7, "collect-actions", "cartpole", episode))
    live = env.rollout(10, RandomPolicy(env.full_action_spec), auto_reset=False, tensordict=start)
    env.close()
    stored = dataset[dataset.transitions["episode"] == episode]
    for key in ("pixels", ("next", "pixels"), "action", ("next", "reward"), ("next", "truncated")):
        assert torch.equal(stored[key], live[key]), key
    assert dataset.physics_at(torch.arange(3))["qpos"].shape == (3, 2)


def test_the_card_says_what_rendered_the_frames(collected):
    card = FrameDataset.open(collected).card
    assert card["render"]["backend"] in ("egl", "osmesa", "glfw")
    assert card["render"]["gl_renderer"] not in ("", "unknown")
    assert card["render"]["quality"] == card["quality"] == "fast"
    assert card["pixels"] == "uint8 0..255"
    assert (card["action_repeat"], card["episodes"], card["last_episode_cut"]) == (200, 4, True)
    assert {"torch", "torchrl", "dm-control", "mujoco"} <= set(card["versions"])
