"""Run as a program: downstream runs in child processes, one left alone and one killed until it completes.

python downstream_kill_target.py ROOT SEED  ->  ROOT/MODE/whole and ROOT/MODE/killed for both ways to frozen features
and for an encoder that is trained; prints the number of kills of each
"""

from __future__ import annotations

import dataclasses
import os
import random
import signal
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "data"))

import torch
from test_downstream import SMALL, small_pretrained, toy_env

from crptpro.training import downstream, train_downstream

torch.set_num_threads(1)

CONFIG = dataclasses.replace(
    SMALL,
    env_steps=240,
    eval_interval_env_steps=60,
    log_interval_env_steps=14,
    hidden_dim=32,  # small networks: the time goes into what a kill can disturb
)
TRAINED = "trained"
MODES = {
    "dense": {"features": "dense"},
    "reencode": {"features": "reencode"},
    TRAINED: {"algorithm": "drq", "intrinsic_reward_coef": 0.0},
}
downstream.random_pretrained = lambda *, seed: (
    small_pretrained()
)  # DrQ's first encoder, for the toy world's images


def start(run_dir: Path, mode: str) -> int:
    """Fork a child that trains; returns its process id."""
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        train_downstream(
            "toy",
            None if mode == TRAINED else small_pretrained(),
            run_dir=run_dir,
            config=CONFIG,
            env_factory=toy_env,
            progress=False,
            **MODES[mode],
        )
        status = 0
    finally:
        os._exit(status)


def wait(pid: int, seconds: float) -> int | None:
    """Return the exit status, or ``None`` if the child still runs after so many seconds."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        done, code = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(code)
        time.sleep(0.002)
    return None


def kill_until_complete(root: Path, mode: str, rng: random.Random) -> int:
    """Return how often it was killed."""
    began = time.monotonic()
    if wait(start(root / "whole", mode), 120) != 0:
        raise SystemExit("the undisturbed child failed")
    whole_s, kills = time.monotonic() - began, 0
    while True:
        pid = start(root / "killed", mode)
        # Longer with every kill, so that it ends on a machine of any speed.
        status = wait(pid, whole_s * rng.uniform(0.05, 0.5) * 1.1**kills)
        if status is None:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            kills += 1
        elif status == 0:
            return kills
        else:
            raise SystemExit(f"the child failed with {status}")


def main(root: Path, seed: int) -> None:
    rng = random.Random(seed)
    for mode in MODES:
        print(kill_until_complete(root / mode, mode, rng))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
