"""The record of a run, what a kill or a full disk leaves of it, and its mirrors."""

from __future__ import annotations

import errno
import io
import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
import wandb

from crptpro.errors import DiskSpaceError
from crptpro.logging import RunLogger
from crptpro.training import Run


def table(run_dir: Path, stream: str) -> list[dict[str, str]]:
    rows = pd.read_csv(run_dir / f"{stream}.csv", dtype=str, keep_default_na=False)
    return rows.drop(columns="unix_time_s").to_dict("records")


def lines(run_dir: Path) -> list[dict[str, Any]]:
    rows = [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if k != "unix_time_s"} for row in rows]


# --- the record -------------------------------------------------------------------------------------------------------


def test_each_stream_has_its_csv_in_which_a_later_column_shifts_no_other_and_the_jsonl_has_all(tmp_path: Path) -> None:
    with RunLogger(tmp_path) as logger:
        logger.log({"a": torch.tensor(1.5), "b": 2}, stream="train", env_steps=np.int64(1000), episodes=2)
        logger.log({"episode_return": 7}, stream="eval", env_steps=1e3)
        logger.log({"b": 1 / 3, "late": 4, "none": None}, stream="train", env_steps=2000, episodes=3)
        logger.log({"a": math.nan, "b": -math.inf}, stream="train", env_steps=3000, episodes=4)
    assert table(tmp_path, "train") == [
        {"env_steps": "1000", "episodes": "2", "a": "1.5", "b": "2", "late": ""},
        {"env_steps": "2000", "episodes": "3", "a": "", "b": str(1 / 3), "late": "4"},
        {"env_steps": "3000", "episodes": "4", "a": "nan", "b": "-inf", "late": ""},
    ]
    assert table(tmp_path, "eval") == [{"env_steps": "1000", "episode_return": "7"}]
    assert [row["stream"] for row in lines(tmp_path)] == ["train", "eval", "train", "train"]
    assert lines(tmp_path)[-1]["a"] == "nan"


def test_a_row_is_written_without_reading_those_before_wherever_the_process_has_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with RunLogger("run") as logger:
        logger.log({"a": 1}, stream="train", updates=1)
        (tmp_path / "elsewhere").mkdir()
        monkeypatch.chdir("elsewhere")
        monkeypatch.setattr(RunLogger, "rows", lambda *_: pytest.fail("the rows so far were read"))
        logger.log({"a": 2}, stream="train", updates=2)
    assert table(tmp_path / "run", "train") == [{"updates": "1", "a": "1"}, {"updates": "2", "a": "2"}]


@pytest.mark.parametrize(("metrics", "stream", "counters", "message"), [
    ({"a": 1}, "train", {}, "needs a counter"),
    ({"a": 1}, "train", {"updates": 1.5}, "whole number"),
    ({"stream": 1}, "train", {"updates": 1}, "cannot name a metric"),
    ({"updates": 1}, "train", {"updates": 1}, "cannot name a metric"),
    ({"": 1}, "train", {"updates": 1}, "cannot name a metric"),
    ({"a": torch.zeros(2)}, "train", {"updates": 1}, "not a scalar"),
    ({"a": 1}, "../x", {"updates": 1}, "stream is named"),
])  # fmt: skip
def test_what_cannot_be_a_row_is_refused(
    tmp_path: Path, metrics: dict[str, Any], stream: str, counters: dict[str, Any], message: str
) -> None:
    with RunLogger(tmp_path) as logger, pytest.raises(ValueError, match=message):
        logger.log(metrics, stream=stream, **counters)


TEXTS = ("a\rb", "a\nb", "a\r\nb", "a\u2028b", "a\x1cb", "a,b", 'a"b', "a\udc80b", "caf\xe9", "")


@pytest.mark.parametrize("text", TEXTS, ids=ascii)
def test_no_text_in_a_name_or_a_value_breaks_the_record_or_its_reopening(tmp_path: Path, text: str) -> None:
    with RunLogger(tmp_path) as logger:
        logger.log({"loss": 1, "note": text}, stream="train", updates=1)
        try:
            logger.log({text: 2}, stream="train", updates=2)
        except ValueError:
            logger.log({"loss": 2}, stream="train", updates=2)
    with RunLogger(tmp_path) as logger:
        logger.log({"loss": 3, "late": 1}, stream="train", updates=3)
    rows = table(tmp_path, "train")
    assert [row["updates"] for row in rows] == ["1", "2", "3"]
    assert rows[2]["late"] == "1"
    assert len((tmp_path / "train.csv").read_text(encoding="utf-8").splitlines()) == 4
    if text in ("a,b", 'a"b', "caf\xe9"):
        assert rows[0]["note"] == text


def test_a_resumed_run_writes_each_row_once_and_leaves_the_streams_of_other_stages(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def write(logger: RunLogger, start: int, stop: int) -> None:
        for updates in range(start, stop):
            logger.log({"loss": updates / 7}, stream="train", updates=updates)
            if updates % 3 == 0:
                logger.log({"score": updates}, stream="eval", updates=updates)

    whole, parts = tmp_path / "whole", tmp_path / "parts"
    with RunLogger(whole) as logger:
        write(logger, 0, 5)
        logger.log({"x": 1}, stream="other", updates=8)
        write(logger, 5, 12)
    with RunLogger(parts) as logger:
        write(logger, 0, 5)
        state = logger.state_dict(["train", "eval", "late"])
        logger.log({"x": 1}, stream="other", updates=8)
        write(logger, 5, 8)
        logger.log({"new_column": 1, "loss": 0}, stream="train", updates=8)
        logger.log({"x": 1}, stream="late", updates=8)
    with RunLogger(parts) as logger:
        logger.load_state_dict(state)
        assert not (parts / "late.csv").exists()
        write(logger, 5, 12)
    for stream in ("train", "eval", "other"):
        assert table(parts, stream) == table(whole, stream)
    assert lines(parts) == lines(whole)
    assert not caplog.records


def test_rows_that_a_state_counted_and_are_missing_are_announced(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with RunLogger(tmp_path) as logger:
        logger.log({"a": 1}, stream="train", updates=1)
        logger.load_state_dict({"train": 5})
    assert "4 rows of 'train' are missing" in caplog.text


def test_a_process_killed_while_logging_leaves_whole_rows_and_a_torn_last_one_is_dropped(tmp_path: Path) -> None:
    script = (
        "import sys\nfrom crptpro.logging import RunLogger\nlogger = RunLogger(sys.argv[1])\n"
        "for i in range(10**6):\n    logger.log({'a': i, 'b': 'x' * 200}, stream='train', updates=i)\n"
        "    if i == 20: print('ready', flush=True)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(signal.SIGKILL)
    record = tmp_path / "metrics.jsonl"
    written = len(record.read_bytes().splitlines())
    os.truncate(record, record.stat().st_size - 5)  # as a kill within a write would leave it
    with RunLogger(tmp_path) as logger:
        assert len(logger.rows("train")) == written - 1 >= 20
        logger.log({"a": 1, "b": "y"}, stream="train", updates=written - 1)
    for rows in (table(tmp_path, "train"), lines(tmp_path)):
        assert [int(row["updates"]) for row in rows] == list(range(written))


def test_a_full_disk_is_one_clear_error_without_half_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class HalfFile(io.FileIO):
        def __init__(self, path: Path, mode: str, encoding: str = "") -> None:
            super().__init__(path, mode)

        def write(self, text: Any) -> int:
            super().write(text[: len(text) // 2].encode())
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with RunLogger(tmp_path) as logger:
        logger.log({"a": 1}, stream="train", updates=1)
        before = (tmp_path / "metrics.jsonl").read_bytes()
        monkeypatch.setitem(RunLogger.log.__globals__, "open", HalfFile)
        with pytest.raises(DiskSpaceError, match="disk is full"):
            logger.log({"a": 2}, stream="train", updates=2)
    assert (tmp_path / "metrics.jsonl").read_bytes() == before


def test_the_config_is_kept_with_versions_from_the_first_row_that_the_disk_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    @dataclass
    class Config:
        task: str = "walker_run"
        out: Path = Path("runs")

    def full(file: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with RunLogger(tmp_path) as logger:
        logger.describe(Config())
        # Not before: a request that is refused must not replace the settings of the run it found.
        assert not (tmp_path / "config.json").exists()
        with monkeypatch.context() as patched:
            patched.setattr(os, "fsync", full)
            with pytest.raises(DiskSpaceError, match=r"disk is full: .*/config\.json"):
                logger.log({"loss": 1.0}, stream="train", updates=1)
        logger.log({"loss": 1.0}, stream="train", updates=1)
    written = json.loads((tmp_path / "config.json").read_text())
    assert written["config"] == {"task": "walker_run", "out": "runs"}
    assert "torch" in written["versions"]


# --- mirrors ----------------------------------------------------------------------------------------------------------


class FakeRun:
    """Stands in for a W&B run."""

    def __init__(self, **options: Any) -> None:
        self.options, self.finished, self.axes = options, False, dict[str, str | None]()
        self.rows: list[tuple[Any, dict[str, Any]]] = []
        self.artifacts: list[str] = []

    def define_metric(self, name: str, step_metric: str | None = None) -> None:
        self.axes[name] = step_metric

    def log(self, row: dict[str, Any], **options: Any) -> None:
        self.rows.append((row, options))

    def log_artifact(self, artifact: Any) -> None:
        self.artifacts.append(artifact.name)

    def finish(self) -> None:
        self.finished = True


@pytest.fixture
def no_account(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("API_KEY", "MODE", "BASE_URL", "PROJECT", "NAME", "RUN_GROUP"):
        monkeypatch.delenv(f"WANDB_{name}", raising=False)
    monkeypatch.setenv("NETRC", "/nowhere/netrc")


@pytest.fixture
def fake_wandb(monkeypatch: pytest.MonkeyPatch, no_account: None) -> Iterator[list[FakeRun]]:
    runs: list[FakeRun] = []

    def init(**options: Any) -> FakeRun:
        runs.append(FakeRun(**options))
        return runs[-1]

    monkeypatch.setattr(wandb, "init", init)
    yield runs
    assert not [name for name in os.environ if name.startswith("WANDB_")]  # nothing is changed for the next


def log_once(run_dir: Path, options: dict[str, Any]) -> None:
    with RunLogger(run_dir, wandb=options) as logger:
        logger.log({"loss": 1.0}, stream="train", updates=1)


def test_wandb_gets_metrics_against_their_counter_under_one_identity(tmp_path: Path, fake_wandb: list[FakeRun]) -> None:
    for start in (0, 1):
        with RunLogger(tmp_path, wandb={"tags": ["t"], "notes": "n"}) as logger:
            logger.describe({"lr": 1})
            assert len(fake_wandb) == start  # a request that is refused leaves nothing there
            logger.log({"loss": 1.0, "note": "x"}, stream="pretrain", updates=start + 1)
            state = logger.state_dict(["pretrain", "eval"])
            logger.log({"score": 2.0}, stream="eval", episodes=1, env_steps=10)
            logger.load_state_dict(state)
            logger.log({"score": 2.0}, stream="eval", episodes=1, env_steps=10)
    first, second = fake_wandb
    assert first.options["id"] == second.options["id"]
    assert (first.options["mode"], first.options["config"]) == ("offline", {"lr": 1})
    assert (first.options["tags"], first.options["notes"]) == (["t"], "n")
    assert first.axes == {"updates": None, "pretrain/*": "updates", "env_steps": None, "eval/*": "env_steps"}
    assert first.rows[0] == ({"updates": 1, "pretrain/loss": 1.0, "pretrain/note": "x"}, {"step": 0})
    assert first.rows[1] == first.rows[2]  # repeated rows come under the same step
    assert second.rows[0][1] == {"step": 2}
    assert first.finished


def test_wandb_gets_an_artifact_of_a_call_that_has_no_row_to_write(tmp_path: Path, fake_wandb: list[FakeRun]) -> None:
    (tmp_path / "weights").touch()  # of a run that was killed before the upload
    with RunLogger(tmp_path, wandb={}) as logger:
        logger.artifact(tmp_path / "weights", name="encoder", kind="model")
    assert [(run.artifacts, run.finished) for run in fake_wandb] == [(["encoder"], True)]


def test_a_run_that_begins_again_begins_another_wandb_run(tmp_path: Path, fake_wandb: list[FakeRun]) -> None:
    for _ in range(2):  # the first ends without a checkpoint
        with (
            RunLogger(tmp_path, wandb={}) as records,
            Run(tmp_path, unit="updates", streams=("train",), records=records, progress=False) as run,
        ):
            run.keep()
            run.advance(1)
            run.write("train", {"loss": 1.0})
    assert [each.rows[0][1] for each in fake_wandb] == [{"step": 0}, {"step": 0}]
    assert fake_wandb[0].options["id"] != fake_wandb[1].options["id"]


@pytest.mark.parametrize(("options", "environment", "netrc", "expected"), [
    ({}, {}, "", {"project": "crptpro", "name": "run", "mode": "offline"}),
    ({}, {"PROJECT": "mine", "NAME": "n"}, "", {"project": "mine", "name": "n"}),
    ({"project": "asked", "name": "a", "group": "h"}, {"PROJECT": "mine", "NAME": "n"}, "",
     {"project": "asked", "name": "a", "group": "h"}),
    # Online only if logged in or asked.
    ({}, {"API_KEY": "k"}, "", {"mode": "online"}),
    ({}, {"API_KEY": "k", "MODE": "disabled"}, "", {"mode": "disabled"}),
    ({}, {}, "machine api.wandb.ai login user password x\n", {"mode": "online"}),
    ({"mode": "offline"}, {"API_KEY": "k"}, "", {"mode": "offline"}),
])  # fmt: skip
def test_defaults_apply_only_where_the_user_has_said_nothing_to_wandb(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fake_wandb: list[FakeRun], options: dict[str, Any],
    environment: dict[str, str], netrc: str, expected: dict[str, str | None],
) -> None:  # fmt: skip
    (tmp_path / "netrc").write_text(netrc)
    with monkeypatch.context() as patched:
        patched.setenv("NETRC", str(tmp_path / "netrc"))
        for name, value in environment.items():
            patched.setenv(f"WANDB_{name}", value)
        log_once(tmp_path / "run", options)
    assert expected.items() <= fake_wandb[0].options.items()


@pytest.mark.parametrize("broken", ["init", "log", "finish"])
def test_a_failing_mirror_is_switched_off_with_one_warning_and_the_record_is_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fake_wandb: list[FakeRun], caplog: pytest.LogCaptureFixture,
    broken: str,
) -> None:  # fmt: skip
    def fail(*arguments: Any, **options: Any) -> None:
        raise wandb.errors.CommError("no route to host")

    monkeypatch.setattr(*((wandb, "init") if broken == "init" else (FakeRun, broken)), fail)
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with RunLogger(tmp_path, wandb={}, tensorboard=True) as logger:
        for updates in (1, 2, 3):
            logger.log({"loss": 1.0}, stream="train", updates=updates)
    assert len(table(tmp_path, "train")) == 3
    assert [sum(name in r.message for r in caplog.records) for name in ("no route", "TensorBoard is off")] == [1, 1]
    assert len(caplog.records) == 2


def test_an_unreachable_server_means_offline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fake_wandb: list[FakeRun]
) -> None:
    working = wandb.init

    def init(**options: Any) -> Any:
        if options["mode"] == "online":
            raise wandb.errors.CommError("timed out")
        return working(**options)

    monkeypatch.setattr(wandb, "init", init)
    log_once(tmp_path, {"mode": "online"})
    assert [run.options["mode"] for run in fake_wandb] == ["offline"]


def test_an_offline_wandb_run_and_event_files_are_really_written_and_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, no_account: None
) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for name in ("WANDB_DATA_DIR", "WANDB_CACHE_DIR"):
        monkeypatch.setenv(name, str(tmp_path / "elsewhere"))
    (tmp_path / "note.txt").write_text("an artifact")
    for updates in (1, 2):
        with RunLogger(tmp_path, wandb={}, tensorboard=True) as logger:
            logger.log({"loss": 1.0 / updates, "note": "text"}, stream="train", env_steps=10 * updates)
            logger.artifact(tmp_path / "note.txt", name="gymnasium:note", kind="text")
    identity = json.loads((tmp_path / "wandb_run.json").read_text())["id"]
    files = sorted(tmp_path.glob(f"wandb/offline-run-*-{identity}/run-{identity}.wandb"))
    assert len(files) >= 1
    assert all(file.stat().st_size > 0 for file in files)
    assert len(table(tmp_path, "train")) == 2
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [(e.step, e.value) for e in events.Scalars("train/loss")] == [(10, 1.0), (20, 0.5)]
    assert not [each for each in caplog.records if each.name.startswith("crptpro")]  # no mirror failed
