"""What a downstream run is made of, and what it leaves alone."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path

import pytest
import torch
from test_downstream import SMALL, small_pretrained, toy_env

from crptpro.errors import PretrainedError
from crptpro.pretrained import Pretrained
from crptpro.training import downstream_parts
from crptpro.training.downstream_parts import Parts, build_parts
from crptpro.transforms import dense_shift_geometry


def parts_of(pretrained: Pretrained, run_dir: Path, **settings: object) -> Parts:
    config = dataclasses.replace(SMALL, action_repeat=2, **settings)
    generators = {name: torch.Generator() for name in ("replay", "shift", "bonus", "policy")}
    env = toy_env("toy", seed=0, image_size=16, frame_stack=3)
    return build_parts(pretrained, "toy", env, config, generators, run_dir)


def test_the_callers_artifact_is_neither_frozen_nor_cast_nor_moved(tmp_path: Path) -> None:
    pretrained = small_pretrained()
    networks = (pretrained.encoder, pretrained.projector, pretrained.prototypes)
    before = [copy.deepcopy(network.state_dict()) for network in networks]
    parts = parts_of(pretrained, tmp_path, precision="bf16")
    assert parts.encoder.compute_dtype == parts.bonus.projector.compute_dtype == torch.bfloat16
    assert not any(
        p.requires_grad for p in [*parts.encoder.parameters(), *parts.bonus.projector.parameters()]
    )
    for network, state in zip(networks, before):
        assert network.training
        assert all(parameter.requires_grad for parameter in network.parameters())
        assert getattr(network, "compute_dtype", torch.float32) == torch.float32
        for key, value in network.state_dict().items():
            assert torch.equal(value, state[key])
    with torch.no_grad():
        pretrained.encoder.convs[0].weight.zero_()  # somebody trains on
    assert parts.encoder.convs[0].weight.any()


@pytest.mark.parametrize(("env_steps", "slots"), [(10, 2 * 5), (100_000, 59)])
def test_memory_is_measured_for_the_slots_that_are_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, env_steps: int, slots: int
) -> None:
    asked: list[int] = []
    choose = downstream_parts.choose_feature_mode

    def spy(mode: str, encoder: object, count: int, *rest: object, **options: object) -> tuple[str, str]:
        asked.append(count)
        return choose(mode, encoder, count, *rest, **options)

    monkeypatch.setattr(downstream_parts, "choose_feature_mode", spy)
    parts = parts_of(small_pretrained(), tmp_path, env_steps=env_steps, random_agent_steps=2)
    assert parts.replay.window == 59
    assert asked == [parts.features.cache.slots] == [slots]


@pytest.mark.parametrize(
    ("batch_size", "shift_pad", "is_kept"), [(512, 4, True), (162, 4, True), (161, 4, False), (18, 1, True)]
)
def test_embeddings_are_kept_where_a_batch_is_larger_than_all_shifts_of_two_observations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batch_size: int, shift_pad: int, is_kept: bool
) -> None:
    asked: list[object] = []
    choose = downstream_parts.choose_feature_mode

    def spy(*args: object, latent_dim: int | None = None, **options: object) -> tuple[str, str]:
        asked.append(latent_dim)
        return choose(*args, latent_dim=latent_dim, **options)

    monkeypatch.setattr(downstream_parts, "choose_feature_mode", spy)
    parts = parts_of(small_pretrained(), tmp_path, batch_size=batch_size, shift_pad=shift_pad)
    assert parts.features.cache.has_embeddings is is_kept
    assert (parts.bonus.projector is None) is is_kept
    assert asked == [4 if is_kept else None]
    without_bonus = parts_of(small_pretrained(), tmp_path / "none", batch_size=512, intrinsic_reward_coef=0.0)
    assert not without_bonus.features.cache.has_embeddings


def test_projections_give_way_before_dense_maps_do_and_others_needs_are_set_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps = 59 * dense_shift_geometry(small_pretrained().encoder, 4).values * 4
    projections = 59 * 81 * 4 * 4
    free, room_for_maps = int((maps + projections) / 0.8) + 2, int(maps / 0.8) + 2
    monkeypatch.setattr(downstream_parts, "free_bytes", lambda device: free)
    settings = {"batch_size": 512, "precision": "fp32", "env_steps": 10_000, "features": "auto"}
    config = dataclasses.replace(SMALL, action_repeat=2, **settings)
    generators = {name: torch.Generator() for name in ("replay", "shift", "bonus", "policy")}
    env = toy_env("toy", seed=0, image_size=16, frame_stack=3)
    found = {}
    for reserved in (0, free - room_for_maps, free - room_for_maps + 4):
        directory = tmp_path / str(reserved)
        parts = build_parts(
            small_pretrained(), "toy", env, config, generators, directory, reserved_bytes=reserved
        )
        found[reserved] = (parts.feature_mode, parts.features.keeps_projections)
        assert (parts.bonus.projector is None) is parts.features.keeps_projections
    assert list(found.values()) == [("dense", True), ("dense", False), ("reencode", False)]


def test_a_queue_of_another_length_is_refused_with_both_ways_out_before_a_replay_is_made(
    tmp_path: Path,
) -> None:
    pretrained = dataclasses.replace(small_pretrained(), queue=torch.randn(16, 4))
    message = r"queue of 16 candidates, `queue_size` is 32.*queue_size=16.*reset_queue=True"
    with pytest.raises(PretrainedError, match=message):
        parts_of(pretrained, tmp_path, queue_size=32)
    assert not any(tmp_path.iterdir())
    assert torch.equal(parts_of(pretrained, tmp_path, queue_size=16).bonus.queue, pretrained.queue)
    assert not parts_of(pretrained, tmp_path, queue_size=32, reset_queue=True).bonus.queue.any()
    assert parts_of(pretrained, tmp_path, queue_size=32, intrinsic_reward_coef=0.0).bonus is None


def test_the_switches_reach_the_learner_and_are_off_on_a_cpu_unless_asked_for(tmp_path: Path) -> None:
    learner = parts_of(small_pretrained(), tmp_path / "auto").learner
    assert not learner.compiled.is_on
    assert not learner.captures
    assert parts_of(small_pretrained(), tmp_path / "on", compile="on").learner.compiled.is_on
    with pytest.raises(ValueError, match="`cuda_graph` 'on' needs a CUDA device"):
        parts_of(small_pretrained(), tmp_path / "graph", cuda_graph="on")


@pytest.mark.parametrize(("channels_last", "found"), [("auto", True), ("off", False)])
def test_the_layout_is_the_runs_and_the_artifact_keeps_its_own(
    tmp_path: Path, channels_last: str, found: bool
) -> None:
    pretrained = small_pretrained()
    parts = parts_of(pretrained, tmp_path, channels_last=channels_last)
    assert parts.encoder.channels_last is found
    assert pretrained.encoder.channels_last
