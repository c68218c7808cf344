"""Mirrors of a record: W&B and TensorBoard, and what happens where they are missing."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from crptpro.loggers import RunLogger, WandbOptions, mirrors
from test_loggers import table


class FakeRun:
    """Stands in for a W&B run."""

    def __init__(self, **options: Any) -> None:
        self.options, self.rows, self.axes, self.finished = options, [], {}, False

    def define_metric(self, name: str, step_metric: str | None = None) -> None:
        self.axes[name] = step_metric

    def log(self, row: dict[str, Any], **options: Any) -> None:
        self.rows.append((row, options))

    def log_artifact(self, artifact: Any) -> None:
        self.rows.append((artifact, {}))

    def finish(self) -> None:
        self.finished = True


@pytest.fixture
def fake_wandb(monkeypatch: pytest.MonkeyPatch) -> list[FakeRun]:
    import wandb

    runs: list[FakeRun] = []

    def init(**options: Any) -> FakeRun:
        runs.append(FakeRun(**options))
        return runs[-1]

    monkeypatch.setattr(wandb, "init", init)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    monkeypatch.setenv("NETRC", "/nowhere/netrc")
    return runs


def test_wandb_gets_metrics_against_their_counter_and_one_identity(
    tmp_path: Path, fake_wandb: list[FakeRun]
) -> None:
    options = WandbOptions(project="p", group="g", tags=("t",))
    for start in (0, 1):
        with RunLogger(tmp_path, wandb=options, config={"lr": 1}) as logger:
            logger.log({"loss": 1.0}, stream="pretrain", updates=start + 1)
            logger.log({"score": 2.0}, stream="eval", episodes=1, env_steps=10)
    first, second = fake_wandb
    assert first.options["id"] == second.options["id"]
    assert first.options["mode"] == "offline"
    assert (first.options["project"], first.options["group"], first.options["tags"]) == ("p", "g", ["t"])
    assert first.options["config"] == {"lr": 1}
    assert first.axes == {
        "updates": None, "pretrain/*": "updates", "env_steps": None, "eval/*": "env_steps",
    }  # fmt: skip
    assert first.rows[0] == ({"updates": 1, "pretrain/loss": 1.0}, {"step": 0})
    assert second.rows[0][1] == {"step": 2}
    assert first.finished


def test_repeated_rows_reach_wandb_under_the_same_step(tmp_path: Path, fake_wandb: list[FakeRun]) -> None:
    with RunLogger(tmp_path, wandb=WandbOptions()) as logger:
        logger.log({"loss": 1.0}, stream="train", updates=1)
        state = logger.state_dict()
        logger.log({"loss": 2.0}, stream="train", updates=2)
    with RunLogger(tmp_path, wandb=WandbOptions()) as logger:
        logger.load_state_dict(state)
        logger.log({"loss": 2.0}, stream="train", updates=2)
    assert fake_wandb[0].rows[1] == fake_wandb[1].rows[0]


@pytest.mark.parametrize("broken", ["init", "log"])
def test_a_failing_wandb_warns_once_and_the_record_is_complete(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    fake_wandb: list[FakeRun],
    caplog: pytest.LogCaptureFixture,
    broken: str,
) -> None:
    import wandb

    def fail(*arguments: Any, **options: Any) -> None:
        raise wandb.errors.CommError("no route to host")

    if broken == "init":
        monkeypatch.setattr(wandb, "init", fail)
    else:
        monkeypatch.setattr(FakeRun, "log", fail)
    with RunLogger(tmp_path, wandb=WandbOptions()) as logger:
        for updates in (1, 2, 3):
            logger.log({"loss": 1.0}, stream="train", updates=updates)
        logger.video("eval/video", tmp_path / "missing.mp4", env_steps=1)
    assert len(table(tmp_path, "train")) == 3
    assert len(caplog.records) == 1
    assert "no route to host" in caplog.text


def test_an_unreachable_server_means_offline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fake_wandb: list[FakeRun]
) -> None:
    import wandb

    working = wandb.init

    def init(**options: Any) -> FakeRun:
        if options["mode"] == "online":
            raise wandb.errors.CommError("timed out")
        return working(**options)

    monkeypatch.setattr(wandb, "init", init)
    RunLogger(tmp_path, wandb=WandbOptions(mode="online")).close()
    assert [run.options["mode"] for run in fake_wandb] == ["offline"]


@pytest.mark.parametrize(
    ("environment", "netrc", "asked", "expected"),
    [
        ({}, "", "auto", "offline"),
        ({"WANDB_API_KEY": "k"}, "", "auto", "online"),
        ({"WANDB_API_KEY": "k", "WANDB_MODE": "disabled"}, "", "auto", "disabled"),
        ({}, "machine api.wandb.ai login user password x\n", "auto", "online"),
        ({"WANDB_API_KEY": "k"}, "", "offline", "offline"),
    ],
)
def test_wandb_is_online_only_if_logged_in_or_asked(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    environment: dict[str, str],
    netrc: str,
    asked: str,
    expected: str,
) -> None:
    for name in ("WANDB_API_KEY", "WANDB_MODE", "WANDB_BASE_URL"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    (tmp_path / "netrc").write_text(netrc)
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    assert mirrors.wandb_mode(asked) == expected


def test_an_offline_wandb_run_is_really_written_and_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    (tmp_path / "note.txt").write_text("an artifact")
    for updates in (1, 2):
        with RunLogger(tmp_path, wandb=WandbOptions(group="tests")) as logger:
            logger.log({"loss": 1.0 / updates}, stream="train", updates=updates)
            logger.artifact(tmp_path / "note.txt", name="note", kind="text")
    identity = json.loads((tmp_path / "wandb_run.json").read_text())["id"]
    files = sorted(tmp_path.glob(f"wandb/offline-run-*-{identity}/run-{identity}.wandb"))
    assert len(files) >= 1
    assert all(file.stat().st_size > 0 for file in files)
    assert len(table(tmp_path, "train")) == 2


def test_a_missing_tensorboard_warns_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with RunLogger(tmp_path, tensorboard=True) as logger:
        logger.log({"a": 1}, stream="train", updates=1)
    assert len(caplog.records) == 1
    assert "TensorBoard is off" in caplog.text


def test_tensorboard_hides_rows_that_were_taken_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writers: list[Any] = []

    class Writer:
        def __init__(self, folder: str, purge_step: int | None = None) -> None:
            self.purge_step, self.scalars = purge_step, []
            writers.append(self)

        def add_scalar(self, name: str, value: float, step: int) -> None:
            self.scalars.append((name, value, step))

        def close(self) -> None:
            pass

    fake = type(sys)("torch.utils.tensorboard")
    fake.SummaryWriter = Writer
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", fake)
    with RunLogger(tmp_path, tensorboard=True) as logger:
        logger.log({"a": 1, "note": "text"}, stream="train", env_steps=10)
        state = logger.state_dict()
        logger.log({"a": 2}, stream="train", env_steps=20)
        logger.load_state_dict(state)
        logger.log({"a": 3}, stream="train", env_steps=20)
    assert writers[0].scalars == [("train/a", 1, 10), ("train/a", 2, 20)]
    assert writers[1].purge_step == 11
    assert writers[1].scalars == [("train/a", 3, 20)]
