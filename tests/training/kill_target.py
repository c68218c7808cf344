"""Run as a program: pre-train or fine-tune in child processes that are killed at random moments until one completes.

python kill_target.py STAGE RUN_DIR UPDATES SEED  ->  RUN_DIR/encoder; prints the number of kills
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from pathlib import Path

import torch
from pretrain_world import SETTINGS, make_dataset, make_datasets, make_loss

from crptpro.pretrained import finetune, save_pretrained
from crptpro.training import pretrain

torch.set_num_threads(1)


def child(stage: str, run_dir: Path, updates: int) -> None:
    """Train to the end and keep the encoder; every moment of it may be the last."""
    if stage == "pretrain":
        loss = make_loss()
        pretrain(loss, make_datasets(), updates=updates, run_dir=run_dir, **SETTINGS)
    else:
        start = run_dir.with_name(f"{run_dir.name}_start")
        if not start.exists():
            save_pretrained(make_loss(), start)
        loss, _ = finetune(start, make_dataset(1), updates=updates, run_dir=run_dir, **SETTINGS)
    save_pretrained(loss, run_dir / "encoder")


def main(stage: str, run_dir: Path, updates: int, seed: int) -> None:
    rng, kills = random.Random(seed), 0
    while True:
        pid = os.fork()
        if pid == 0:
            status = 1
            try:
                child(stage, run_dir, updates)
                status = 0
            finally:
                os._exit(status)
        # Longer lives with every kill: on a busy machine the first ones may be too short for a single checkpoint.
        deadline, status = time.monotonic() + rng.uniform(0.05, 0.4) * 1.05**kills, None
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
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
