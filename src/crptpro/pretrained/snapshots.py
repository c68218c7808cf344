"""The encoder at several points of one pre-training, to look at what it learns when."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from torchrl.objectives import LossModule

from crptpro.pretrained.bundle import Pretrained
from crptpro.pretrained.networks import unwrap
from crptpro.pretrained.saving import describe_loss, save_pretrained

IS_SNAPSHOT = "is_snapshot"


def encoder_snapshots(run_dir: str | Path, updates: Iterable[int]) -> dict[int, Callable[[LossModule], Any]]:
    """Return what keeps the encoder after given numbers of updates, as ``at_updates`` of ``pretrain`` takes it.

    Args:
        run_dir: where the artifacts go, see :func:`snapshot_path`.
        updates: when.

    Examples:
        >>> sorted(encoder_snapshots("runs/a", (500, 1_000)))
        [500, 1000]
    """
    return {done: partial(save_snapshot, path=snapshot_path(run_dir, done)) for done in updates}


def snapshot_path(run_dir: str | Path, updates: int) -> Path:
    """Directory of the artifact that was kept after so many updates."""
    return Path(run_dir) / f"encoder_at_{updates}"


def save_snapshot(loss: LossModule, path: str | Path) -> Path:
    """Write encoder, projector and prototypes: all that reads an artifact, half the size of what trains on from one.

    Args:
        loss: any loss with the pre-training contract.
        path: directory to write; replaced as a whole.

    Returns:
        ``path``.

    Raises:
        PretrainedError: as of :func:`save_pretrained`; fine-tuning from the artifact is refused, too.
    """
    networks: dict[str, Any] = {
        role: unwrap(getattr(loss, role, None)) for role in ("encoder", "projector", "prototypes")
    }
    kept = Pretrained(**networks, card=describe_loss(loss))
    return save_pretrained(kept, path, extra_card={IS_SNAPSHOT: True})
