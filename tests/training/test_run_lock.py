"""The directory lock."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from crptpro.errors import CheckpointError
from crptpro.training.run_lock import exclusive


def test_a_second_process_is_refused_and_a_dead_one_is_not_remembered(tmp_path: Path) -> None:
    script = (
        "import fcntl, sys, time\n"
        "file = open(sys.argv[1], 'a')\n"
        "fcntl.flock(file, fcntl.LOCK_EX); print('held', flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", script, str(tmp_path / ".lock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(CheckpointError, match="Another process"), exclusive(tmp_path):
            pass
        holder.kill()
    with exclusive(tmp_path):
        pass
