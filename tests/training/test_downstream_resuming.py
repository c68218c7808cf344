"""What a downstream run needs to be continued, and what it says where that is missing."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from test_downstream import small_pretrained, train
from torchrl.envs import CatFrames, EnvBase, TransformedEnv
from toy_world import ToyEnv

from crptpro.errors import CheckpointError
from crptpro.training import downstream_parts
from crptpro.training.downstream_run import DownstreamRun
from crptpro.transforms import dense_shift_geometry


@pytest.mark.parametrize(
    ("setting", "then", "now"),
    [("action_repeat", 2, 1), ("checkpoint_interval_env_steps", 20, 40), ("replay_capacity", 40, 50)],
)
def test_a_setting_that_sizes_the_replay_is_named_when_it_has_changed(
    tmp_path: Path, setting: str, then: int, now: int
) -> None:
    train(tmp_path, env_steps=40)
    with pytest.raises(CheckpointError, match=f"{setting} was {then}, now {now}"):
        train(tmp_path, **{setting: now})


def test_the_replay_of_an_attempt_without_a_checkpoint_is_replaced(tmp_path: Path) -> None:
    train(tmp_path, env_steps=40)
    shutil.rmtree(tmp_path / "checkpoints")
    assert train(tmp_path, env_steps=40, replay_capacity=50).env_steps == 40


def test_a_finished_run_is_found_again_without_its_replay(tmp_path: Path) -> None:
    first = train(tmp_path)
    shutil.rmtree(tmp_path / "replay")
    again = train(tmp_path)
    assert not (tmp_path / "replay").exists()
    assert again.evaluations == first.evaluations
    for key, value in first.policy.actor.state_dict().items():
        assert torch.equal(again.policy.actor.state_dict()[key], value)
    with pytest.raises(CheckpointError, match=r"120 of 160 env steps.* needs its frames.*replay is gone"):
        train(tmp_path, env_steps=160)
    assert not (tmp_path / "replay").exists()


def test_finding_a_finished_run_leaves_what_it_takes_to_extend_it(tmp_path: Path) -> None:
    whole = train(tmp_path / "whole", env_steps=160)
    for env_steps in (120, 120, 160):
        extended = train(tmp_path / "parts", env_steps=env_steps)
    for key, value in whole.policy.actor.state_dict().items():
        assert torch.equal(extended.policy.actor.state_dict()[key], value)


KEPT = {"batch_size": 20, "shift_pad": 1, "features": "auto"}
MAPS = 59 * dense_shift_geometry(small_pretrained().encoder, 1).values * 4
PROJECTIONS = 59 * 9 * 4 * 4
ROOMS = {"kept": 2 * (MAPS + PROJECTIONS), "computed": int(MAPS / 0.8) + 2, "reencode": 0}


@pytest.mark.parametrize(
    ("then", "now"), [("computed", "kept"), ("reencode", "kept"), ("reencode", "computed")]
)
def test_features_are_had_as_the_run_began_where_there_is_more_memory_now(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, then: str, now: str
) -> None:
    monkeypatch.setattr(downstream_parts, "free_bytes", lambda device: ROOMS[then])
    whole = train(tmp_path / "whole", **KEPT)
    train(tmp_path / "parts", env_steps=60, **KEPT)
    monkeypatch.setattr(downstream_parts, "free_bytes", lambda device: ROOMS[now])
    resumed = train(tmp_path / "parts", **KEPT)
    for key, value in whole.policy.actor.state_dict().items():
        assert torch.equal(resumed.policy.actor.state_dict()[key], value)


def test_dense_maps_that_fit_no_more_are_refused_with_both_sizes_and_can_be_tried_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = MAPS + PROJECTIONS
    monkeypatch.setattr(downstream_parts, "free_bytes", lambda device: 2 * room)
    whole = train(tmp_path / "whole", **KEPT)
    train(tmp_path / "parts", env_steps=60, **KEPT)
    monkeypatch.setattr(downstream_parts, "free_bytes", lambda device: room - 1)
    message = r"dense maps and projections.* GiB for 59 observations, and 0.0 GiB are free.*features='dense'"
    with pytest.raises(CheckpointError, match=message):
        train(tmp_path / "parts", **KEPT)
    resumed = train(tmp_path / "parts", **{**KEPT, "features": "dense"})
    for key, value in whole.policy.actor.state_dict().items():
        assert torch.equal(resumed.policy.actor.state_dict()[key], value)


def test_a_margin_that_a_fresh_run_leaves_is_no_reason_to_refuse_one_that_began(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(downstream_parts, "free_bytes", lambda device: 2 * (MAPS + PROJECTIONS))
    train(tmp_path, env_steps=60, **KEPT)
    monkeypatch.setattr(downstream_parts, "free_bytes", lambda device: MAPS + PROJECTIONS)
    assert train(tmp_path, **KEPT).env_steps == 120


def test_a_finished_run_is_found_again_without_memory_for_its_maps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(downstream_parts, "free_bytes", lambda device: 2 * (MAPS + PROJECTIONS))
    first = train(tmp_path, **KEPT)
    monkeypatch.setattr(downstream_parts, "free_bytes", lambda device: 0)
    assert train(tmp_path, **KEPT).evaluations == first.evaluations


def test_an_episode_that_outgrows_the_slack_is_announced_once_and_the_setting_is_named_when_it_is_too_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("crptpro.training.downstream_replay.SPARE_FRAMES", 0)  # leaves 2 * 20 / 2 frames
    kill_at = [60 + 15]

    def long_episodes(
        task: str, *, seed: int, image_size: int, frame_stack: int, **settings: object
    ) -> EnvBase:
        env = ToyEnv(lambda _: 60, seed=seed, image_size=image_size)
        return TransformedEnv(env, CatFrames(N=frame_stack, dim=-3, in_keys=["pixels"], padding="same"))

    def act(run: DownstreamRun, features: torch.Tensor) -> torch.Tensor:
        if run.agent_steps == kill_at[0]:
            raise KeyboardInterrupt
        return run.acts(features)

    monkeypatch.setattr(DownstreamRun, "acts", DownstreamRun.act, raising=False)
    monkeypatch.setattr(DownstreamRun, "act", act)
    settings = {"env_factory": long_episodes, "env_steps": 360, "eval_interval_env_steps": 1_000}
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, **settings)
    assert "since the last checkpoint" not in caplog.text
    kill_at[0] = 2 * 60 + 50
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, **settings)
    assert caplog.text.count("frames since the last checkpoint, the replay can spare 20") == 1
    with pytest.raises(CheckpointError, match=r"slack of 20.*`checkpoint_interval_env_steps`"):
        train(tmp_path, **settings)
