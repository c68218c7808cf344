"""What a downstream run needs to be continued, and what it says where that is missing."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from test_downstream import train

from crptpro.errors import CheckpointError


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
