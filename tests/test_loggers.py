"""The record of a run: what its rows are, and what a kill or a full disk leaves of them."""

from __future__ import annotations

import csv
import errno
import json
import logging
import math
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from crptpro.errors import DiskSpaceError
from crptpro.loggers import RunLogger
from crptpro.loggers.record import MetricRecord


def table(run_dir: Path, stream: str) -> list[dict[str, str]]:
    with open(run_dir / f"{stream}.csv") as file:
        return [{k: v for k, v in row.items() if k != "unix_time_s"} for row in csv.DictReader(file)]


def lines(run_dir: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]


def test_each_stream_has_its_csv_and_the_jsonl_has_all(tmp_path: Path) -> None:
    with RunLogger(tmp_path) as logger:
        logger.log({"loss": torch.tensor(1.5)}, stream="train", env_steps=1000, episodes=2)
        logger.log({"episode_return": 7}, stream="eval", env_steps=1000)
    assert table(tmp_path, "train") == [{"env_steps": "1000", "episodes": "2", "loss": "1.5"}]
    assert table(tmp_path, "eval") == [{"env_steps": "1000", "episode_return": "7"}]
    assert [row["stream"] for row in lines(tmp_path)] == ["train", "eval"]


def test_a_column_that_appears_later_does_not_shift_the_others(tmp_path: Path) -> None:
    with RunLogger(tmp_path) as logger:
        logger.log({"a": 1, "b": 2}, stream="train", updates=1)
        logger.log({"b": 3, "late": 4}, stream="train", updates=2)
        logger.log({"a": 5}, stream="train", updates=3)
    assert table(tmp_path, "train") == [
        {"updates": "1", "a": "1", "b": "2", "late": ""},
        {"updates": "2", "a": "", "b": "3", "late": "4"},
        {"updates": "3", "a": "5", "b": "", "late": ""},
    ]


def test_floats_keep_every_digit_and_nan_is_a_word(tmp_path: Path) -> None:
    with RunLogger(tmp_path) as logger:
        logger.log({"third": 1 / 3, "bad": math.nan, "huge": -math.inf, "none": None}, stream="x", updates=1)
    row = table(tmp_path, "x")[0]
    assert float(row["third"]) == 1 / 3
    assert (row["bad"], row["huge"]) == ("nan", "-inf")
    assert "none" not in row
    assert lines(tmp_path)[0]["bad"] == "nan"


@pytest.mark.parametrize(
    ("metrics", "stream", "counters", "message"),
    [
        ({"a": 1}, "train", {}, "needs a counter"),
        ({"stream": 1}, "train", {"updates": 1}, "cannot name a metric"),
        ({"updates": 1}, "train", {"updates": 1}, "cannot name a metric"),
        ({"a": torch.zeros(2)}, "train", {"updates": 1}, "no scalar"),
        ({"a": 1}, "../x", {"updates": 1}, "stream is named"),
    ],
)
def test_what_cannot_be_a_row_is_refused(
    tmp_path: Path, metrics: dict[str, Any], stream: str, counters: dict[str, int], message: str
) -> None:
    with RunLogger(tmp_path) as logger, pytest.raises(ValueError, match=message):
        logger.log(metrics, stream=stream, **counters)


def test_a_resumed_run_writes_each_row_once(tmp_path: Path) -> None:
    def write(logger: RunLogger, start: int, stop: int) -> None:
        for updates in range(start, stop):
            logger.log({"loss": updates / 7}, stream="train", updates=updates)
            if updates % 3 == 0:
                logger.log({"score": updates}, stream="eval", updates=updates)

    with RunLogger(tmp_path / "whole") as whole:
        write(whole, 0, 12)
    with RunLogger(tmp_path / "parts") as first:
        write(first, 0, 5)
        state = first.state_dict()
        write(first, 5, 8)
        first.log({"new_column": 1, "loss": 0}, stream="train", updates=8)
        first.log({"x": 1}, stream="late", updates=8)
    with RunLogger(tmp_path / "parts") as second:
        second.load_state_dict(state)
        assert not (tmp_path / "parts" / "late.csv").exists()
        write(second, 5, 12)
    for stream in ("train", "eval"):
        assert table(tmp_path / "parts", stream) == table(tmp_path / "whole", stream)
    strip = [{k: v for k, v in row.items() if k != "unix_time_s"} for row in lines(tmp_path / "parts")]
    assert strip == [
        {k: v for k, v in row.items() if k != "unix_time_s"} for row in lines(tmp_path / "whole")
    ]


def test_the_state_of_one_stream_leaves_the_others_alone(tmp_path: Path) -> None:
    with RunLogger(tmp_path) as logger:
        logger.log({"a": 1}, stream="pretrain", updates=1)
        state = logger.state_dict(["pretrain"])
        logger.log({"a": 2}, stream="pretrain", updates=2)
        logger.log({"a": 3}, stream="eval", env_steps=5)
        logger.load_state_dict(state)
        assert [row["updates"] for row in logger.rows("pretrain")] == [1]
        assert [row["env_steps"] for row in logger.rows("eval")] == [5]


def test_rows_beyond_a_counter_can_be_taken_back(tmp_path: Path) -> None:
    with RunLogger(tmp_path) as logger:
        for steps in (10, 20, 30):
            logger.log({"a": steps}, stream="train", env_steps=steps)
        logger.truncate_to("train", "env_steps", 20)
        assert [row["env_steps"] for row in logger.rows("train")] == [10, 20]
        logger.truncate_to("train", "env_steps", -1)
        assert logger.rows("train") == []


def test_a_record_shorter_than_its_checkpoint_is_announced(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with RunLogger(tmp_path) as logger:
        logger.log({"a": 1}, stream="train", updates=1)
        logger.load_state_dict({"rows": {"train": 5}, "streams": None})
    assert "1 rows of 'train', the checkpoint counted 5" in caplog.text


def test_a_torn_last_line_is_dropped_and_the_csv_repaired(tmp_path: Path) -> None:
    with RunLogger(tmp_path) as logger:
        logger.log({"a": 1}, stream="train", updates=1)
        logger.log({"a": 2}, stream="train", updates=2)
    text = (tmp_path / "metrics.jsonl").read_text()
    (tmp_path / "metrics.jsonl").write_text(text[:-5])
    with RunLogger(tmp_path) as logger:
        logger.log({"a": 3}, stream="train", updates=3)
    assert [row["updates"] for row in table(tmp_path, "train")] == ["1", "3"]
    assert [row["updates"] for row in lines(tmp_path)] == [1, 3]


def test_a_process_killed_while_logging_leaves_whole_rows(tmp_path: Path) -> None:
    script = (
        "import sys\nfrom crptpro.loggers import RunLogger\nlogger = RunLogger(sys.argv[1])\n"
        "for i in range(10**6):\n    logger.log({'a': i, 'b': 'x' * 200}, stream='train', updates=i)\n"
        "    if i == 20: print('ready', flush=True)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        process.send_signal(signal.SIGKILL)
    with RunLogger(tmp_path) as logger:
        count = len(logger.rows("train"))
        logger.log({"a": count, "b": "y"}, stream="train", updates=count)
    assert count > 20
    assert [int(row["updates"]) for row in table(tmp_path, "train")] == list(range(count + 1))


def test_a_full_disk_is_one_clear_error_without_half_a_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = MetricRecord(tmp_path)
    record.append("train", {"updates": 1}, {"a": 1})
    before = (tmp_path / "metrics.jsonl").read_bytes()
    real_open = open

    class HalfFile:
        def __init__(self, *arguments: Any, **options: Any) -> None:
            self.file = real_open(*arguments, **options)

        def __enter__(self) -> HalfFile:
            return self

        def __exit__(self, *exception: object) -> None:
            self.file.close()

        def write(self, text: str) -> None:
            self.file.write(text[: len(text) // 2])
            self.file.flush()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setitem(MetricRecord._append_line.__globals__, "open", HalfFile)
    with pytest.raises(DiskSpaceError, match="disk is full"):
        record.append("train", {"updates": 2}, {"a": 2})
    assert (tmp_path / "metrics.jsonl").read_bytes() == before


def test_a_disk_that_is_full_from_the_first_row_on_is_named_and_the_config_written_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(file: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with RunLogger(tmp_path, config={"task": "walker_run"}) as logger:
        with monkeypatch.context() as patched:
            patched.setattr(os, "fsync", full)
            with pytest.raises(DiskSpaceError, match=r"disk is full: .*/config\.json"):
                logger.log({"loss": 1.0}, stream="train", updates=1)
        logger.log({"loss": 1.0}, stream="train", updates=1)
    assert json.loads((tmp_path / "config.json").read_text())["config"] == {"task": "walker_run"}


def test_the_config_is_kept_with_versions(tmp_path: Path) -> None:
    @dataclass
    class Config:
        task: str = "walker_run"
        out: Path = Path("runs")

    with RunLogger(tmp_path, config=Config()) as logger:
        # Not before the first row: a request that is refused must not replace the settings of the run it found.
        assert not (tmp_path / "config.json").exists()
        logger.log({"loss": 1.0}, stream="train", updates=1)
    written = json.loads((tmp_path / "config.json").read_text())
    assert written["config"] == {"task": "walker_run", "out": "runs"}
    assert "torch" in written["versions"]


def test_an_event_is_one_log_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="crptpro"):
        RunLogger(tmp_path).event("episode 3: return 12.5, 100 % of 250 env steps")
    assert [r.message for r in caplog.records] == ["episode 3: return 12.5, 100 % of 250 env steps"]
