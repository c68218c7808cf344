"""What every training loop gets from its run: resuming, checkpoints, signals, the record."""

from __future__ import annotations

import errno
import shutil
import signal
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.checkpoint import GlobalRNGState
from toy_env import record
from toy_runs import python

from crptpro import provenance
from crptpro.errors import CheckpointError, DiskSpaceError, NonFiniteError
from crptpro.logging import RunLogger
from crptpro.training import DownstreamConfig, PretrainConfig, Run
from crptpro.training.run import SIGNALS, _GlobalRNG

SETTINGS = {"batch_size": 8, "loss": {"class": "Proto", "sizes": [3, 4]}}


class Walk:
    """Something with a state: a random walk."""

    def __init__(self) -> None:
        self.place, self.generator = torch.zeros(()), torch.Generator().manual_seed(0)

    def step(self) -> torch.Tensor:
        self.place = self.place + torch.randn((), generator=self.generator) + torch.rand(())
        return self.place

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {"place": self.place, "generator": self.generator.get_state()}

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        self.place = state["place"]
        self.generator.set_state(state["generator"])


def begin(run_dir: Path | None, *streams: str) -> Run:
    return Run(run_dir, unit="updates", streams=streams or ("train",), progress=False)


def walk(
    run_dir: Path | None,
    total: int,
    *,
    settings: Mapping[str, Any] = SETTINGS,
    on_update: Callable[[int], object] = lambda update: None,
) -> Walk:
    """A training loop in small; ``on_update`` is called with every update's number."""
    with begin(run_dir) as run:
        run.require_same(settings)
        torch.manual_seed(7)
        walker = Walk()
        run.keep(walker=walker)
        for update in run.until(total, checkpoint_interval=5):
            on_update(update)
            run.log({"loss_place": walker.step()})
            run.advance(1)
            if run.every(4):
                run.write("train")
        run.finish()
        if run.means("train"):
            run.write("train")
    return walker


def first_update(run_dir: Path, total: int = 18) -> int:
    """Continue, and return where."""
    seen: list[int] = []
    walk(run_dir, total, on_update=seen.append)
    return seen[0]


def crash_at(number: int) -> Callable[[int], None]:
    def crash(update: int) -> None:
        if update == number:
            raise RuntimeError("power cut")

    return crash


def test_a_resumed_run_gives_the_numbers_and_the_record_of_an_uninterrupted_one(tmp_path: Path) -> None:
    whole = walk(tmp_path / "whole", 18)
    walk(tmp_path / "longer", 9)
    assert [row["updates"] for row in record(tmp_path / "longer" / "train.csv")] == ["4", "8", "9"]
    with pytest.raises(RuntimeError, match="power cut"):
        walk(tmp_path / "crashed", 18, on_update=crash_at(13))
    for name in ("longer", "crashed", "longer"):
        assert torch.equal(walk(tmp_path / name, 18).place, whole.place)
        assert record(tmp_path / name / "train.csv") == record(tmp_path / "whole" / "train.csv")


def test_ctrl_c_leaves_a_checkpoint_where_nobody_reads_the_log_any_more(tmp_path: Path) -> None:
    python(f"""
import os, pathlib, signal, test_run
from crptpro.console import run_main
unread, stderr = os.pipe()
os.close(unread)  # as `2>&1 | tee log` does, which gets the same Ctrl-C
os.dup2(stderr, 2)
stop = lambda update: update == 7 and os.kill(os.getpid(), signal.SIGINT)
run_main(lambda: test_run.walk(pathlib.Path({str(tmp_path)!r}), 18, on_update=stop))
""")
    assert first_update(tmp_path) == 8


def test_a_crash_costs_the_updates_since_the_last_checkpoint_and_what_precedes_all_is_removed(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError):
        walk(tmp_path / "late", 18, on_update=crash_at(13))
    assert first_update(tmp_path / "late") == 10
    with pytest.raises(RuntimeError):
        walk(tmp_path / "early", 18, on_update=crash_at(4))
    walk(tmp_path / "early", 8)
    assert [row["updates"] for row in record(tmp_path / "early" / "train.csv")] == ["4", "8"]


def test_the_record_of_a_run_whose_checkpoints_were_removed_is_set_aside(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    walk(tmp_path, 10)
    before = (tmp_path / "metrics.jsonl").read_text()
    shutil.rmtree(tmp_path / "checkpoints")
    with caplog.at_level("WARNING", logger="crptpro"):
        assert first_update(tmp_path) == 0
    assert "has no checkpoint: it begins again" in caplog.text
    assert (tmp_path / "metrics.before.jsonl").read_text() == before
    shutil.rmtree(tmp_path / "checkpoints")
    first_update(tmp_path)
    assert (tmp_path / "metrics.before.jsonl").read_text().startswith(before)


def test_what_a_process_that_was_killed_while_it_wrote_a_checkpoint_left_is_removed(tmp_path: Path) -> None:
    walk(tmp_path, 5)
    stale = tmp_path / "checkpoints" / ".checkpoint-000000000010.torchrl.stage-0"
    (stale / "walker").mkdir(parents=True)
    assert first_update(tmp_path) == 5
    assert not stale.exists()


def test_a_checkpoint_of_more_gpus_is_continued_with_fewer() -> None:
    state = {**GlobalRNGState().state_dict(), "torch_cuda": [torch.zeros(16, dtype=torch.uint8)] * 2}
    restored: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.cuda, "is_available", lambda: True)
        patch.setattr(torch.cuda, "device_count", lambda: 1)
        patch.setattr(torch.cuda, "set_rng_state_all", lambda states: restored.append(len(states)))
        _GlobalRNG().load_state_dict(state)
    assert restored == [1]


def test_a_run_of_a_gpu_is_continued_without_one(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        cuda = [torch.zeros(16, dtype=torch.uint8)]
        saved = _GlobalRNG.state_dict
        patch.setattr(_GlobalRNG, "state_dict", lambda self: {**saved(self), "torch_cuda": cuda})
        walk(tmp_path, 5)
    assert first_update(tmp_path) == 5


def test_without_an_interval_checkpoints_are_written_by_the_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("crptpro.training.run.CHECKPOINT_SECONDS", 0.0)

    def go(crash: int) -> int:
        with begin(tmp_path) as run:
            run.require_same({})
            run.keep()
            for update in run.until(9):
                if update == crash:
                    raise RuntimeError("power cut")
                run.advance(1)
            return run.resumed_from

    with pytest.raises(RuntimeError):
        go(4)
    assert go(-1) == 4


def test_the_global_generators_are_left_as_they_were(tmp_path: Path) -> None:
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    walk(tmp_path, 6)
    assert torch.equal(torch.rand(3), expected)


def test_other_settings_or_fewer_updates_than_were_done_are_refused_by_name(tmp_path: Path) -> None:
    walk(tmp_path, 5)
    other = {"batch_size": 16, "loss": {"class": "Proto", "sizes": [3, 5]}}
    with pytest.raises(CheckpointError, match=r"batch_size was 8, now 16; loss\.sizes\[1\] was 4, now 5"):
        walk(tmp_path, 6, settings=other)
    with pytest.raises(CheckpointError, match="has done 5 updates, more than the 4 requested"):
        walk(tmp_path, 4)


@pytest.mark.parametrize(("config", "setting", "value", "message"), [
    (DownstreamConfig, "discount", 1.5, "`discount` must be at most 1"),
    (DownstreamConfig, "features", "sparse", "`features` must be auto, dense, dense-bf16 or reencode"),
    (DownstreamConfig, "replay_capacity", 5, "`replay_capacity` .5. must hold the 1000 transitions"),
])  # fmt: skip
def test_an_impossible_setting_is_refused_by_name(config: type, setting: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        config(**{setting: value})


def test_settings_are_compared_and_stored_as_plain_values_and_others_are_refused_before_the_work(
    tmp_path: Path,
) -> None:
    settings = {
        "data": Path("data"),
        "weights": torch.ones(2),
        "config": PretrainConfig(updates=3),
        "kind": torch.float32,
    }
    walk(tmp_path / "plain", 5, settings=settings)
    walk(tmp_path / "plain", 6, settings=settings)
    with pytest.raises(ValueError, match=r"`settings\.loss\.act` cannot be stored"):
        walk(tmp_path / "other", 5, settings={"loss": {"act": torch.nn.ReLU}})


def test_numbers_are_logged_like_tensors() -> None:
    with begin(None) as run:
        run.keep()
        for _ in run.until(2):
            run.log({"loss": 0.5, "count": 3})
            run.log(TensorDict({"loss": torch.tensor(1.5)}))
            run.advance(1)
        assert run.means("train") == {"loss": 1.0, "count": 3.0}
        with pytest.raises(NonFiniteError):
            run.log({"loss": float("nan")})


def test_networks_of_a_component_must_be_finite_too(tmp_path: Path) -> None:
    class Explorer(Walk):
        networks = (torch.nn.Linear(1, 1),)

    torch.nn.init.constant_(Explorer.networks[0].weight, float("nan"))
    with begin(tmp_path) as run:
        run.keep(explorer=Explorer())
        with pytest.raises(NonFiniteError, match="the parameter weight is not finite"):
            run.save()


def test_a_damaged_checkpoint_costs_the_updates_since_the_one_before(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    walk(tmp_path, 13)
    files = sorted((tmp_path / "checkpoints").iterdir())
    assert [file.name for file in files] == [f"checkpoint-{n:012}.torchrl" for n in (10, 13)]  # two are kept
    content = bytearray(files[-1].read_bytes())
    content[len(content) // 3] ^= 0xFF
    files[-1].write_bytes(content)
    with caplog.at_level("WARNING", logger="crptpro"):
        assert first_update(tmp_path) == 10
    assert "is damaged" in caplog.text
    for path in (tmp_path / "checkpoints").iterdir():
        path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(CheckpointError, match=r"checkpoints in .* are damaged. Remove that directory"):
        walk(tmp_path, 20)


def test_a_setting_left_open_keeps_what_it_meant_when_the_run_began(tmp_path: Path) -> None:
    with begin(tmp_path) as run:
        assert run.saved_setting("precision", "auto") == "auto"
        run.require_same({"precision": "bf16"})
        run.keep()
        run.finish()
    with begin(tmp_path) as run:
        assert run.saved_setting("precision", "auto") == "bf16"
        assert run.saved_setting("precision", "fp32") == "fp32"


def test_a_record_outside_the_run_directory_is_refused(tmp_path: Path) -> None:
    with (
        RunLogger(tmp_path / "shared") as records,
        pytest.raises(CheckpointError, match=r"not in the run directory .*mine: .* Use RunLogger\('.*mine'\)"),
        Run(tmp_path / "mine", unit="updates", streams=("train",), records=records),
    ):
        pass
    assert not (tmp_path / "mine").exists()


def test_runs_without_a_directory_share_a_record_and_each_returns_its_own_rows(tmp_path: Path) -> None:
    with RunLogger(tmp_path) as records:
        for loss in (1.0, 2.0):
            with Run(None, unit="updates", streams=("train",), records=records, progress=False) as run:
                run.keep()
                run.advance(1)
                run.write("train", {"loss": loss})
                assert [row["loss"] for row in run.rows("train")] == [loss]
        assert [row["loss"] for row in records.rows("train")] == [1.0, 2.0]


def test_a_finished_run_that_is_called_again_keeps_the_rate_of_its_last_row(tmp_path: Path) -> None:
    for _ in range(2):
        walk(tmp_path, 5)
        with RunLogger(tmp_path) as records:
            rows = records.rows("train")
        assert [(row["updates"], row["updates_per_s"] > 0) for row in rows] == [(4, True), (5, True)]


def test_other_versions_are_announced_where_a_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    walk(tmp_path, 5)
    now = {**provenance.versions(), "mujoco": "9.9"}
    monkeypatch.setattr(provenance, "versions", lambda: now)
    walk(tmp_path, 5)
    assert "9.9" not in caplog.text
    walk(tmp_path, 6)
    assert f"{tmp_path} is continued with other versions" in caplog.text
    assert "is now 9.9." in caplog.text


def test_two_processes_in_one_directory_are_refused(tmp_path: Path) -> None:
    with begin(tmp_path):
        found = python(f"import pathlib, test_run; test_run.walk(pathlib.Path({str(tmp_path)!r}), 5)")
    assert found.returncode == 1
    assert "CheckpointError: Another process is writing" in found.stderr


@pytest.mark.parametrize("number", SIGNALS)
def test_every_signal_that_asks_a_run_to_stop_leaves_a_checkpoint_first(tmp_path: Path, number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with pytest.raises((KeyboardInterrupt, SystemExit)) as left:
        walk(tmp_path, 18, on_update=lambda update: update == 2 and signal.raise_signal(number))
    assert isinstance(left.value, KeyboardInterrupt) == (number == signal.SIGINT)
    assert getattr(left.value, "code", 128 + number) == 128 + number
    assert signal.getsignal(number) == before
    assert first_update(tmp_path) == 3


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_in_the_last_update_ends_the_program_and_the_run_is_complete(
    tmp_path: Path, number: signal.Signals
) -> None:
    with pytest.raises((KeyboardInterrupt, SystemExit)) as left:
        walk(tmp_path, 6, on_update=lambda update: update == 5 and signal.raise_signal(number))
    assert getattr(left.value, "code", 128 + number) == 128 + number
    assert torch.equal(walk(tmp_path, 6).place, walk(None, 6).place)


def test_a_signal_that_is_ignored_as_under_nohup_stops_nothing(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        walk(tmp_path, 6, on_update=lambda _: signal.raise_signal(signal.SIGHUP))
    finally:
        signal.signal(signal.SIGHUP, before)
    assert [row["updates"] for row in record(tmp_path / "train.csv")] == ["4", "6"]


def test_a_second_interrupt_stops_at_once(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        walk(tmp_path, 18, on_update=lambda _: [signal.raise_signal(signal.SIGINT) for _ in range(2)])
    assert not list(tmp_path.glob("checkpoints/*"))


def test_a_run_works_outside_the_main_thread_and_without_a_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    walk(None, 7)
    assert not list(tmp_path.iterdir())
    thread = threading.Thread(target=walk, args=(tmp_path, 5))
    thread.start()
    thread.join()
    assert [row["updates"] for row in record(tmp_path / "train.csv")] == ["4", "5"]


def test_a_home_directory_is_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    walk(Path("~/runs/x"), 5)
    assert (tmp_path / "runs" / "x" / "train.csv").exists()
    with pytest.raises(ValueError, match="`run_dir` is empty"):
        Run("", unit="updates", streams=("train",))


def test_numbers_that_are_not_finite_end_the_run_and_enter_no_checkpoint(tmp_path: Path) -> None:
    layer, nan = nn.Linear(2, 2), torch.tensor(float("nan"))
    with begin(tmp_path) as run:
        run.keep(layer=layer)
        for update in run.until(6, checkpoint_interval=2):
            run.log({"loss_x": torch.tensor(1.0), "a_diagnostic": nan})
            run.advance(1)
            if update == 4:
                with pytest.raises(NonFiniteError, match="After 5 updates, loss_x is nan"):
                    run.log({"loss_x": nan})
                layer.weight.data[0, 0] = float("inf")
        with pytest.raises(NonFiniteError, match="the parameter weight is not finite"):
            run.finish()
    names = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert names == ["checkpoint-000000000002.torchrl", "checkpoint-000000000004.torchrl"]


def test_a_full_disk_is_one_clear_error_and_keeps_earlier_checkpoints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walk(tmp_path, 5)
    with monkeypatch.context() as patch:
        # As little as makes TorchRL's mapped files end the process by a bus error.
        patch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1_000))
        with pytest.raises(DiskSpaceError, match=r"A checkpoint needs .* Earlier ones are kept; free space"):
            walk(tmp_path, 12)
    text = "No space left on device"
    for reason in (OSError(errno.ENOSPC, text), RuntimeError(f"unable to write to file <a.memmap>: {text} (28)")):
        with monkeypatch.context() as patch:
            patch.setattr("torchrl.checkpoint.Checkpoint.save", Mock(side_effect=reason))
            with pytest.raises(DiskSpaceError, match=r"No checkpoint .* the disk is full. Earlier ones are kept"):
                walk(tmp_path, 12)
    with monkeypatch.context() as patch:
        patch.setattr("torchrl.checkpoint.Checkpoint.save", Mock(side_effect=RuntimeError("device-side assert (28)")))
        with pytest.raises(RuntimeError, match=r"^device-side assert"):
            walk(tmp_path, 12)
    assert first_update(tmp_path) == 5


def test_a_signal_that_c_code_handles_is_left_to_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    install = Mock()
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    monkeypatch.setattr(signal, "signal", install)
    walk(tmp_path, 3)
    install.assert_not_called()


def test_two_runs_of_one_process_do_not_share_a_directory(tmp_path: Path) -> None:
    with begin(tmp_path), pytest.raises(CheckpointError, match="Another run of this process is writing to"):
        begin(tmp_path).__enter__()
    walk(tmp_path, 3)


def test_a_refused_budget_leaves_the_record_as_it_was(tmp_path: Path) -> None:
    walk(tmp_path, 8)
    with RunLogger(tmp_path) as records:
        records.log({"late": 1.0}, stream="train", updates=8)  # after the last checkpoint
    before = (tmp_path / "train.csv").read_text()
    with pytest.raises(CheckpointError, match="more than the 6 requested"):
        walk(tmp_path, 6)
    assert (tmp_path / "train.csv").read_text() == before


def test_a_run_stays_in_its_directory_if_the_working_directory_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with begin(Path("run")) as run:
        monkeypatch.chdir("/")
        assert run.run_dir == tmp_path / "run"


def test_means_count_each_name_by_its_own_rate() -> None:
    with begin(None, "train", "other") as run:
        run.keep()
        for update in range(4):
            run.log({"loss_q": torch.tensor(float(update))})
            if update % 2:
                run.log({"actor": torch.tensor(10.0 * update)})
            run.log({"elsewhere": torch.tensor(1.0)}, stream="other")
            run.advance(1)
        row = run.write("train", episodes=3)
        assert (row["loss_q"], row["actor"]) == (1.5, 20.0)
        assert "elsewhere" not in row
        assert {"updates": 4, "episodes": 3}.items() <= run.rows("train")[0].items()
        assert run.rows("other") == []
