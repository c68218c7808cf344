"""CRPTpro: cross-domain random pre-training with prototypes for reinforcement learning from pixels."""

import os

__version__ = "0.1.0"

# PyTorch requests huge pages for large CPU tensors if this is set before its first allocation. An update's temporaries
# are mapped anew every time, and faulting them in page by page took a tenth of its CPU time. Linux only; results are
# unchanged; THP_MEM_ALLOC_ENABLE=0 turns it off.
os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")

# How long a waiting OpenMP thread spins before it sleeps, read when PyTorch is first imported. When another process
# shares the cores, GNU's default of 300,000 keeps busy the core that the awaited thread needs: updates then took 2 to 7
# times as long. On an otherwise idle machine the lower value costs nothing (benchmarks/results/contention).
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "3000")

# TorchRL imports MuJoCo, whose import fails if it cannot load the backend that MUJOCO_GL names. Only rendering needs
# a backend: `select_backend` tests it and reports what is wrong.
if _named := os.environ.get("MUJOCO_GL"):
    try:
        import mujoco
    except Exception:
        os.environ["MUJOCO_GL"] = "off"
        import mujoco  # noqa: F401

        os.environ["MUJOCO_GL"] = _named
