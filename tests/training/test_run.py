"""What every training loop gets from its run: resuming, checkpoints, signals, the record."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn
from worlds import record

from crptpro.errors import CheckpointError, DiskSpaceError, NonFiniteError
from crptpro.training import Run

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


def walk(run_dir: Path | None, total: int, *, settings: Mapping[str, Any] = SETTINGS, **options: Any) -> Walk:
    """A training loop in small; ``on_update`` is called with every update's number."""
    on_update = options.pop("on_update", lambda update: None)
    with Run(run_dir, unit="updates", streams=("train",), progress=False, **options) as run:
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
        if run.means["train"].counts:
            run.write("train")
    return walker


def test_a_resumed_run_gives_the_numbers_and_the_record_of_an_uninterrupted_one(tmp_path: Path) -> None:
    whole = walk(tmp_path / "whole", 18)
    walk(tmp_path / "parts", 9)
    assert [row["updates"] for row in record(tmp_path / "parts" / "train.csv")] == ["4", "8", "9"]
    resumed = walk(tmp_path / "parts", 18)
    assert torch.equal(resumed.place, whole.place)
    assert record(tmp_path / "parts" / "train.csv") == record(tmp_path / "whole" / "train.csv")
    again = walk(tmp_path / "parts", 18)
    assert torch.equal(again.place, whole.place)
    assert record(tmp_path / "parts" / "train.csv") == record(tmp_path / "whole" / "train.csv")


def test_a_crash_between_checkpoints_costs_only_the_updates_since(tmp_path: Path) -> None:
    def crash(update: int) -> None:
        if update == 13:
            raise RuntimeError("power cut")

    with pytest.raises(RuntimeError, match="power cut"):
        walk(tmp_path / "parts", 18, on_update=crash)
    seen: list[int] = []
    resumed = walk(tmp_path / "parts", 18, on_update=seen.append)
    assert seen[0] == 10
    assert torch.equal(resumed.place, walk(tmp_path / "whole", 18).place)
    assert record(tmp_path / "parts" / "train.csv") == record(tmp_path / "whole" / "train.csv")


def test_rows_of_an_attempt_without_a_checkpoint_are_removed(tmp_path: Path) -> None:
    def crash(update: int) -> None:
        if update == 4:
            raise RuntimeError

    with pytest.raises(RuntimeError):
        walk(tmp_path, 18, on_update=crash)
    walk(tmp_path, 8)
    assert [row["updates"] for row in record(tmp_path / "train.csv")] == ["4", "8"]


def test_the_global_generators_are_left_as_they_were(tmp_path: Path) -> None:
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    walk(tmp_path, 6)
    assert torch.equal(torch.rand(3), expected)


def test_a_run_of_other_settings_is_refused_by_name(tmp_path: Path) -> None:
    walk(tmp_path, 5)
    other = {"batch_size": 16, "loss": {"class": "Proto", "sizes": [3, 5]}}
    with pytest.raises(CheckpointError, match=r"batch_size was 8, now 16; loss\.sizes\[1\] was 4, now 5"):
        walk(tmp_path, 6, settings=other)


def test_fewer_updates_than_were_done_are_refused(tmp_path: Path) -> None:
    walk(tmp_path, 8)
    with pytest.raises(CheckpointError, match="has done 8 updates, 4 are asked"):
        walk(tmp_path, 4)


def test_a_directory_that_holds_a_run_is_refused_without_resume(tmp_path: Path) -> None:
    walk(tmp_path, 5)
    with pytest.raises(CheckpointError, match="already holds a run"):
        walk(tmp_path, 6, resume=False)


def test_a_damaged_checkpoint_costs_the_updates_since_the_one_before(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    walk(tmp_path, 13)
    newest = max((tmp_path / "checkpoints").glob("checkpoint-*"))
    content = bytearray(newest.read_bytes())
    content[len(content) // 3] ^= 0xFF
    newest.write_bytes(content)
    seen: list[int] = []
    with caplog.at_level("WARNING", logger="crptpro"):
        walk(tmp_path, 18, on_update=seen.append)
    assert "is damaged" in caplog.text
    assert seen[0] == 10


def test_only_damaged_checkpoints_are_an_error(tmp_path: Path) -> None:
    walk(tmp_path, 6)
    for path in (tmp_path / "checkpoints").glob("checkpoint-*"):
        path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(CheckpointError, match=r"checkpoints in .* are damaged. Remove that directory"):
        walk(tmp_path, 8)


def test_a_setting_left_open_keeps_what_it_meant_when_the_run_began(tmp_path: Path) -> None:
    with Run(tmp_path, unit="updates", streams=("train",), progress=False) as run:
        assert run.saved_setting("precision", "auto") == "auto"
        run.require_same({"precision": "bf16"})
        run.keep()
        run.finish()
    with Run(tmp_path, unit="updates", streams=("train",), progress=False) as run:
        assert run.saved_setting("precision", "auto") == "bf16"
        assert run.saved_setting("precision", "fp32") == "fp32"


def test_two_runs_of_one_directory_are_refused(tmp_path: Path) -> None:
    code = f"from pathlib import Path; from test_run import walk; walk(Path({str(tmp_path)!r}), 5)"

    def start_another(update: int) -> None:
        path = os.pathsep.join(
            [str(Path(__file__).parent), str(Path(__file__).parents[1] / "data"), *sys.path]
        )
        found = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "PYTHONPATH": path},
            capture_output=True,
            text=True,
        )
        assert found.returncode == 1
        assert "CheckpointError" in found.stderr

    walk(tmp_path, 1, on_update=start_another)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1])
def test_every_signal_that_asks_a_run_to_stop_leaves_a_checkpoint_first(
    tmp_path: Path, number: signal.Signals
) -> None:
    def ask(update: int) -> None:
        if update == 2:
            signal.raise_signal(number)

    ending = KeyboardInterrupt if number == signal.SIGINT else SystemExit
    before = signal.getsignal(number)
    with pytest.raises(ending) as left:
        walk(tmp_path, 18, on_update=ask)
    if ending is SystemExit:
        assert left.value.code == 128 + number
    assert signal.getsignal(number) == before
    seen: list[int] = []
    walk(tmp_path, 18, on_update=seen.append)
    assert seen[0] == 3


def test_a_second_interrupt_stops_at_once(tmp_path: Path) -> None:
    def ask_twice(update: int) -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        walk(tmp_path, 18, on_update=ask_twice)
    assert not list(tmp_path.glob("checkpoints/*"))


def test_a_run_works_outside_the_main_thread(tmp_path: Path) -> None:
    thread = threading.Thread(target=walk, args=(tmp_path, 5))
    thread.start()
    thread.join()
    assert [row["updates"] for row in record(tmp_path / "train.csv")] == ["4", "5"]


def test_nothing_is_written_without_a_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    walk(None, 7)
    assert not list(tmp_path.iterdir())


def test_a_home_directory_is_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    walk(Path("~/runs/x"), 5)
    assert (tmp_path / "runs" / "x" / "train.csv").exists()
    with pytest.raises(ValueError, match="`run_dir` is empty"):
        Run("", unit="updates", streams=("train",))


def test_a_loss_that_is_not_finite_ends_the_run_and_keeps_the_last_checkpoint(tmp_path: Path) -> None:
    with Run(tmp_path, unit="updates", streams=("train",), progress=False) as run:
        run.keep()
        for update in run.until(20, checkpoint_interval=2):
            value = torch.tensor(float("nan") if update == 5 else 1.0)
            if update == 5:
                with pytest.raises(NonFiniteError, match="After 5 updates, loss_x is nan"):
                    run.log({"loss_x": value})
                break
            run.log({"loss_x": value, "a_diagnostic": torch.tensor(float("nan"))})
            run.advance(1)
    assert (tmp_path / "checkpoints" / "checkpoint-000000000004.torchrl").exists()


def test_a_parameter_that_is_not_finite_enters_no_checkpoint(tmp_path: Path) -> None:
    layer = nn.Linear(2, 2)
    with Run(tmp_path, unit="updates", streams=("train",), progress=False) as run:
        run.keep(layer=layer)
        layer.weight.data[0, 0] = float("inf")
        with pytest.raises(NonFiniteError, match="the parameter weight is not finite"):
            run.save()
    assert not list(tmp_path.glob("checkpoints/*"))


def test_a_full_disk_is_one_clear_error_and_keeps_earlier_checkpoints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walk(tmp_path, 5)

    def full(*arguments: Any, **options: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("torchrl.checkpoint.Checkpoint.save", full)
    with pytest.raises(DiskSpaceError, match=r"The disk is full: no checkpoint .* Earlier ones are kept"):
        walk(tmp_path, 12)
    monkeypatch.undo()
    seen: list[int] = []
    walk(tmp_path, 12, on_update=seen.append)
    assert seen[0] == 5


def test_two_checkpoints_are_kept(tmp_path: Path) -> None:
    walk(tmp_path, 18)
    names = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert names == ["checkpoint-000000000015.torchrl", "checkpoint-000000000018.torchrl"]


def test_means_count_each_name_by_its_own_rate() -> None:
    with Run(None, unit="updates", streams=("train", "other"), progress=False) as run:
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
        assert run.history["train"][0]["updates"] == 4
        assert run.history["train"][0]["episodes"] == 3
        assert run.last_row("other") == {}
