from __future__ import annotations

import errno
import fcntl
import subprocess
import sys
from pathlib import Path

import pytest

from crptpro.directory_lock import DirectoryLock, locked
from crptpro.errors import CRPTproError, DatasetError
from crptpro.logging import RunLogger


def test_a_second_process_is_refused_and_a_dead_one_is_not_remembered(tmp_path: Path) -> None:
    script = (
        "import sys, time; from crptpro.directory_lock import DirectoryLock\n"
        "lock = DirectoryLock(sys.argv[1]); print('held', flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", script, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(DatasetError, match="Another process is writing to"):
            DirectoryLock(tmp_path, error=DatasetError)
        holder.kill()
    DirectoryLock(tmp_path).release()


def test_a_released_directory_may_be_taken_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    lock = DirectoryLock("~/new")
    with pytest.raises(CRPTproError, match="This process is already writing to"):
        DirectoryLock(tmp_path / "new")
    lock.release()
    lock.release()
    DirectoryLock(tmp_path / "new").release()


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS])
def test_a_file_system_without_locks_is_not_taken_for_another_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, number: int
) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(number, "no locks here")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with DirectoryLock(tmp_path), DirectoryLock(tmp_path):
        pass
    with locked(tmp_path / "a"), locked(tmp_path / "a"):
        pass
    assert caplog.text.count("cannot be locked") == 4


def test_a_directory_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DatasetError, match="file/data cannot be written"):
        DirectoryLock(tmp_path / "file" / "data", error=DatasetError)


def test_holders_in_one_process_share_a_reentrant_lock_until_the_last_lets_go(tmp_path: Path) -> None:
    with RunLogger(tmp_path):
        DirectoryLock(tmp_path, is_reentrant=True).release()
        with pytest.raises(CRPTproError, match="This process is already writing to"):
            DirectoryLock(tmp_path)
    DirectoryLock(tmp_path).release()
