"""Run as a program: pre-train in child processes that are killed at random moments until one completes.

python kill_target.py RUN_DIR UPDATES SEED  ->  prints the number of kills
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time

import torch
from pretrain_world import SETTINGS, make_datasets, make_loss

from crptpro.training import pretrain

torch.set_num_threads(1)


def child(run_dir: str, updates: int) -> None:
    loss = make_loss()
    pretrain(loss, make_datasets(), updates=updates, run_dir=run_dir, **SETTINGS)
    torch.save(loss.state_dict(), os.path.join(run_dir, "final.pt"))


def main(run_dir: str, updates: int, seed: int) -> None:
    rng, kills = random.Random(seed), 0
    while True:
        pid = os.fork()
        if pid == 0:
            status = 1
            try:
                child(run_dir, updates)
                status = 0
            finally:
                os._exit(status)
        deadline, status = time.monotonic() + rng.uniform(0.05, 0.7), None
        while status is None and time.monotonic() < deadline:
            done, code = os.waitpid(pid, os.WNOHANG)
            status = os.waitstatus_to_exitcode(code) if done else None
            time.sleep(0.002)
        if status is None:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            kills += 1
        elif status == 0:
            print(kills)
            return
        else:
            raise SystemExit(f"the child failed with {status}")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
