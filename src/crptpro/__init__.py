"""CRPTpro: cross-domain random pre-training with prototypes for reinforcement learning from pixels."""

import os

__version__ = "0.1.0"

# PyTorch asks for huge pages for large CPU tensors if this is set when it makes its first. What an update makes and
# frees is mapped anew every time, and page by page that was a tenth of its processor time. Linux alone has it; it
# changes no number; THP_MEM_ALLOC_ENABLE=0 turns it off.
os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")

# How long a waiting thread of OpenMP spins before it sleeps, read when PyTorch is first imported. With GNU's default of
# 300,000 it keeps the core that the thread it waits for needs, once another process shares the cores: updates then took
# 2 to 7 times as long. Without other work this costs nothing (benchmarks/results/contention).
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "3000")

# TorchRL imports MuJoCo, whose import fails if it cannot load the backend that MUJOCO_GL names. Only rendering needs
# one: `select_backend` tests it, and says what is wrong.
if _named := os.environ.get("MUJOCO_GL"):
    try:
        import mujoco
    except Exception:
        os.environ["MUJOCO_GL"] = "off"
        import mujoco  # noqa: F401

        os.environ["MUJOCO_GL"] = _named
