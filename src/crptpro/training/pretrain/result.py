"""What a pre-training run returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchrl.objectives import LossModule


@dataclass(frozen=True)
class PretrainResult:
    """How a pre-training run ended.

    Attributes:
        updates: encoder updates done in total, over all domains and all resumptions.
        resumed_from: update at which this call continued; 0 for a fresh run.
        seconds: training time in total, all resumptions included.
        precision: ``"fp32"`` or ``"bf16"``, as resolved.
        metrics: the last row of the record: means since the row before it.
        collapse: verdict of :class:`~crptpro.training.collapse.CollapseMonitor`.
        history: the rows logged by this call, oldest first.
        run_dir: where record and checkpoints are; ``None`` if nothing was written.
    """

    updates: int
    resumed_from: int
    seconds: float
    precision: str
    metrics: dict[str, float]
    collapse: dict[str, Any]
    history: list[dict[str, Any]] = field(default_factory=list, repr=False)
    run_dir: Path | None = None

    @property
    def is_dead(self) -> bool:
        """Whether training ended on a plateau longer than its patience."""
        return self.collapse["verdict"] == "dead"


def metrics_of(row: Mapping[str, Any]) -> dict[str, float]:
    """Return what a row of the record measures."""
    return {name: value for name, value in row.items() if name != "updates"}


def training_record(
    loss: LossModule, *, updates: int, seconds: float, collapse: dict[str, Any], **facts: Any
) -> dict[str, Any]:
    """Return what the card of an artifact says about how it was trained.

    Args:
        loss: what was trained; a fine-tuned one knows what it started from.
        updates: encoder updates.
        seconds: training time.
        collapse: verdict of the monitor.
        **facts: settings, data, last metrics, versions.
    """
    return {
        "updates": updates,
        "seconds": round(seconds, 1),
        **facts,
        "collapse": collapse,
        "started_from": getattr(loss, "started_from", None),
        "previous_training": getattr(loss, "previous_training", None),
    }
