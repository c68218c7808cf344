"""``python -m crptpro.cli.job WORK PARENT``: a job of ``crptpro reproduce`` in its own process."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time

from crptpro.cli import main
from crptpro.experiments.launch import Work, leave


def _stop_with(parent: int) -> None:
    """Stop at the next checkpoint when the command that started this job is gone."""
    while os.getppid() == parent:
        time.sleep(1)
    os.kill(os.getpid(), signal.SIGTERM)
    print("the command that started this job is gone: stopping at the next checkpoint", flush=True)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    signal.signal(signal.SIGTERM, leave)
    signal.signal(signal.SIGUSR2, signal.SIG_IGN)  # Slurm's notice of the time limit, which submitit handles
    threading.Thread(target=_stop_with, args=(int(sys.argv[2]),), daemon=True).start()
    raise SystemExit(bool(Work(**json.loads(sys.argv[1])).run(main)))
