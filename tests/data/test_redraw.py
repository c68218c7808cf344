from __future__ import annotations

import functools
from pathlib import Path

import pytest
import torch
from toy_world import FIXED, collection_request, run_in_order

from crptpro.data import FrameDataset
from crptpro.data.collect_worker import EpisodeRoller
from crptpro.data.collection import DomainCollection
from crptpro.data.drawn_frames import DrawnFrames
from crptpro.data.redraw import redraw
from crptpro.domains import Domain, get_domain, register_domain
from crptpro.envs import make_env
from crptpro.errors import DatasetError


def collect_here(domain: str | Domain, path: Path, transitions: int, colors: str = "normal") -> FrameDataset:
    """What collect_random collects, without processes: they take ten seconds to start."""
    domain = get_domain(domain)
    settings = {
        "image_size": 32,
        "action_repeat": 200,
        "camera": domain.camera,
        "quality": "fast",
        "colors": colors,
    }
    request = {"domain": domain.name, "task": domain.task, "seed": 7, "transitions": transitions, **settings}
    collection = DomainCollection(path, request)
    roller = EpisodeRoller(
        functools.partial(make_env, domain, seed=0, frame_stack=1, physics_state=True, **settings)
    )
    while not collection.is_complete:
        job = collection.next_job()
        collection.accept(job.episode, roller.roll(job))
    roller.close()
    return FrameDataset.open(path)


def test_a_dataset_remembers_its_colours_and_reversed_images_are_the_same_episodes(tmp_path):
    normal = collect_here(FIXED, tmp_path / "a", 15)
    swapped = collect_here(FIXED, tmp_path / "b", 15, colors="reversed_image")
    assert (normal.card["colors"], swapped.card["colors"]) == ("normal", "reversed_image")
    rows = torch.tensor([0, 9, 3])
    assert not swapped.frames_at(rows).equal(normal.frames_at(rows))
    assert swapped.frames_at(rows).equal(normal.frames_at(rows).flip(-3))
    for dataset, other in ((normal, swapped), (swapped, normal)):
        for colors, expected in ((dataset.card["colors"], dataset), (other.card["colors"], other)):
            assert redraw(dataset, rows, colors=colors).equal(expected.frames_at(rows))


def test_a_collection_of_other_colours_is_not_taken_for_the_one_asked_for(tmp_path):
    older = {name: value for name, value in collection_request().items() if name != "colors"}
    run_in_order(DomainCollection(tmp_path, older), 0)  # a release that knew no colours
    assert DomainCollection(tmp_path, collection_request(colors="normal")).is_complete
    with pytest.raises(DatasetError, match="colors 'normal' there, 'reversed_image' asked for"):
        DomainCollection(tmp_path, collection_request(colors="reversed_image"))


@pytest.mark.gl
def test_frames_drawn_again_are_those_that_a_collection_in_these_colours_has(tmp_path):
    normal = collect_here("cartpole", tmp_path / "a", 12)
    colors = "reversed_background"
    reversed_ = collect_here("cartpole", tmp_path / "b", 12, colors)
    rows = torch.tensor([14, 0, 7, 5, 7])  # the last frame of an episode, first ones, one twice
    drawn = redraw(normal, rows, colors=colors)
    assert not drawn.equal(normal.frames_at(rows))
    assert drawn.equal(reversed_.frames_at(rows))
    assert redraw(reversed_, rows, colors="normal").equal(normal.frames_at(rows))
    assert redraw(reversed_, rows, colors="reversed_image").equal(normal.frames_at(rows).flip(-3))


@pytest.mark.gl
def test_what_the_task_draws_at_a_reset_comes_back(tmp_path):
    """The target of reacher is placed at random and is no part of qpos."""
    normal = collect_here("reacher", tmp_path, 12)
    drawn = redraw(normal, torch.arange(14), colors="reversed_background")
    assert drawn[:, 1].equal(normal.frames_at(torch.arange(14))[:, 1])  # green keeps its place


@pytest.mark.gl
def test_frames_that_their_state_does_not_explain_are_refused(tmp_path):
    dataset = collect_here("cartpole", tmp_path, 6)
    dataset.frames["qpos"].copy_(dataset.frames["qpos"] + 0.5)  # mapped privately: the file stays
    with pytest.raises(DatasetError, match=r"cannot be drawn again.*grey levels"):
        redraw(dataset, torch.arange(6), colors="reversed_background")


def test_worlds_without_a_known_background_say_so(tmp_path, monkeypatch):
    monkeypatch.setattr("crptpro.domains._registered", {})
    register_domain(FIXED)
    dataset = collect_here(FIXED, tmp_path, 5)
    with pytest.raises(DatasetError, match="dm_control"):
        redraw(dataset, torch.arange(3), colors="reversed_background")


@pytest.mark.gl
def test_frames_that_were_drawn_before_are_read_and_only_the_others_drawn(tmp_path):
    dataset, colors = collect_here("cartpole", tmp_path / "data", 12), "reversed_background"
    rows = torch.tensor([14, 0, 7, 5, 7])
    expected = redraw(dataset, rows, colors=colors)
    marked = torch.full_like(expected[:2], 9)  # no drawing looks like this
    drawn = DrawnFrames("cartpole", colors, torch.tensor([5, 7]), marked)
    found = redraw(dataset, rows, colors=colors, drawn=drawn)
    assert found[:2].equal(expected[:2])
    assert (found[2:] == 9).all()
    assert redraw(dataset, rows, colors="normal", drawn=drawn).equal(dataset.frames_at(rows))
    other = DrawnFrames("walker", colors, drawn.rows, drawn.frames)
    with pytest.raises(DatasetError, match="walker in reversed_background were given for cartpole"):
        redraw(dataset, rows, colors=colors, drawn=other)
