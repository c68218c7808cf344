"""A downstream run that is continued or found finished: the same numbers, what it needs, what it refuses."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from test_downstream import rows_without_time, small_pretrained, train
from torchrl.envs import CatFrames, EnvBase, TransformedEnv
from toy_world import ToyEnv

from crptpro.errors import CheckpointError
from crptpro.training import downstream_parts
from crptpro.training.checkpoint import CheckpointDir
from crptpro.training.downstream_run import DownstreamRun
from crptpro.training.frozen_features import FrozenFeatures
from crptpro.transforms import dense_shift_geometry


@pytest.mark.parametrize("features", ["dense", "reencode"])
def test_stopping_and_resuming_gives_the_numbers_of_an_uninterrupted_run(
    tmp_path: Path, features: str
) -> None:
    whole = train(tmp_path / "whole", features=features)
    train(tmp_path / "parts", features=features, env_steps=60)
    resumed = train(tmp_path / "parts", features=features)
    assert resumed.env_steps == whole.env_steps
    for key, value in whole.policy.actor.state_dict().items():
        torch.testing.assert_close(resumed.policy.actor.state_dict()[key], value, rtol=0, atol=0)
    # The shorter budget made the first part end with an evaluation of its own, at 60 env steps.
    kept = [row for row in resumed.evaluations if row["env_steps"] != 60]
    assert rows_without_time(kept) == rows_without_time(whole.evaluations)


def test_a_finished_run_returns_its_result_without_doing_anything_again(tmp_path: Path) -> None:
    first = train(tmp_path)
    record = (tmp_path / "eval.csv").read_bytes()
    again = train(tmp_path)
    assert (tmp_path / "eval.csv").read_bytes() == record
    assert again.evaluations == first.evaluations


def test_other_settings_do_not_continue_a_run(tmp_path: Path) -> None:
    train(tmp_path, env_steps=40)
    with pytest.raises(CheckpointError, match="batch_size was 8, now 4"):
        train(tmp_path, batch_size=4)


def test_a_directory_with_a_run_is_not_overwritten_when_resuming_is_off(tmp_path: Path) -> None:
    train(tmp_path, env_steps=40)
    with pytest.raises(CheckpointError, match="already holds a run"):
        train(tmp_path, resume=False)


def test_a_smaller_budget_than_what_was_done_is_refused(tmp_path: Path) -> None:
    train(tmp_path)
    with pytest.raises(CheckpointError, match=r"has done 120 env steps, 40 are asked"):
        train(tmp_path, env_steps=40)


def test_what_auto_became_must_agree_when_a_run_is_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(tmp_path, env_steps=60, features="auto", precision="fp32")
    with pytest.raises(CheckpointError, match="precision was 'fp32', now 'bf16'"):
        train(tmp_path, precision="bf16")
    with pytest.raises(CheckpointError, match="features was 'dense', now 'reencode'"):
        train(tmp_path, features="reencode")
    with pytest.raises(CheckpointError, match="compile was 'absent', now 'on'"):
        train(tmp_path, features="dense", compile="on")
    with pytest.raises(CheckpointError, match="channels_last was 'absent', now 'off'"):
        train(tmp_path, features="dense", channels_last="off")
    assert train(tmp_path, features="dense", compile="off").env_steps == 120


@pytest.mark.parametrize("begun_in", ["fp32", "bf16"])
def test_a_run_goes_on_in_the_arithmetic_that_it_began_in_on_a_machine_with_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begun_in: str
) -> None:
    monkeypatch.setattr("crptpro.modules.precision._is_cpu_faster_in_bf16", lambda: begun_in == "bf16")
    train(tmp_path, env_steps=60, precision="auto")
    monkeypatch.setattr("crptpro.modules.precision._is_cpu_faster_in_bf16", lambda: begun_in != "bf16")
    assert train(tmp_path, precision="auto").env_steps == 120
    kept = CheckpointDir(tmp_path / "checkpoints").load_latest()
    assert kept is not None
    assert kept["fingerprint"]["precision"] == begun_in


def test_a_finished_run_encodes_nothing_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train(tmp_path)
    monkeypatch.setattr(FrozenFeatures, "rebuild", lambda *args, **options: pytest.fail("encoded again"))
    train(tmp_path)


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
