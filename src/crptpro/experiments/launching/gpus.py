"""Which GPUs of this machine its processes may use."""

from __future__ import annotations

import os


def visible_gpus() -> tuple[str, ...]:
    """Return numbers or names as ``CUDA_VISIBLE_DEVICES`` lists them; without that variable, every GPU's number."""
    listed = os.environ.get("CUDA_VISIBLE_DEVICES")
    if listed is not None:
        return tuple(part.strip() for part in listed.split(",") if part.strip())
    import torch

    return tuple(map(str, range(torch.cuda.device_count())))
