"""``crptpro probe``: what a frozen encoder knows of the simulator's state, in minutes and without RL."""

from __future__ import annotations

import csv
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from crptpro.cli.downstream import RANDOM_ENCODER
from crptpro.cli.request import image_format
from crptpro.colors import Colors

if TYPE_CHECKING:
    from crptpro.analysis.probe import ProbeResult
    from crptpro.pretrained import Pretrained

logger = logging.getLogger(__name__)

COLUMNS = (
    "encoder", "method", "domain", "seen", "colors", "embedding", "measure", "coordinate", "value", "samples",
    "held_out_episodes", "seed",
)  # fmt: skip


@dataclass(frozen=True)
class Probe:
    """Predict positions and velocities from frozen features by ridge regression, on held-out episodes."""

    encoder: Positional[str]
    """directory of a pretrained encoder, or `random-encoder` for the untrained control"""
    datasets: Positional[tuple[Path, ...]]
    """datasets, e.g. data/walker data/finger; each is probed alone, seen in pre-training or not"""
    samples: int = 2_000
    """observations per dataset; time and memory grow with their square"""
    colors: tuple[Colors, ...] = ("normal",)
    """colours; what a dataset was not collected in is drawn again from its physical state"""
    seed: int = 0
    """which observations, which episodes are held out, and the random encoder's initialisation"""
    csv: Path | None = None
    """write every number here, each coordinate's R2 among them"""
    device: str = "cpu"
    """where the encoder runs"""

    def run(self) -> None:
        """Print a table, and write what was asked for."""
        from crptpro.analysis.coordinates import joints_of
        from crptpro.analysis.probe import probe, probe_samples
        from crptpro.data import FrameDataset
        from crptpro.errors import CRPTproError
        from crptpro.experiments.markdown import markdown_table
        from crptpro.modules import usable_device

        if self.samples < 1:
            raise CRPTproError(f"--samples must be at least 1, got {self.samples}.")
        usable_device(self.device)
        image_size, frame_stack = image_format(self.datasets)
        pretrained = self._load(image_size, frame_stack)
        encoder, projector = pretrained.encoder.to(self.device), pretrained.projector
        projector = None if projector is None else projector.to(self.device)
        seen = _domains_seen(pretrained)
        table, rows = [], []
        for path in self.datasets:
            dataset = FrameDataset.open(path)
            joints = joints_of(dataset.card["task"])
            for colors in dict.fromkeys(self.colors):
                logger.info("%s, %s: %s samples", dataset.domain, colors, f"{self.samples:,}")
                samples = probe_samples(
                    dataset, samples=self.samples, seed=self.seed, colors=colors, joints=joints,
                    frame_stack=encoder.in_channels // 3,
                )  # fmt: skip
                about = {
                    "encoder": self.encoder,
                    "method": pretrained.label,
                    "domain": dataset.domain,
                    "seen": "yes" if dataset.domain in seen else "no",
                    "colors": colors,
                }
                counts = {
                    "samples": len(samples.pixels),
                    "held_out_episodes": samples.held_out_episodes,
                    "seed": self.seed,
                }
                for embedding, result in probe(samples, encoder, projector).items():
                    named = {**about, "embedding": embedding}
                    table.append(_table_row(named, result))
                    rows += [{**named, **measure, **counts} for measure in _measures(result)]
                    if result.left_out:
                        logger.info(
                            "%s: left out as constant: %s", dataset.domain, ", ".join(result.left_out)
                        )
        if self.csv is not None:
            _write(self.csv, rows)
        print(markdown_table(table))

    def _load(self, image_size: int, frame_stack: int) -> Pretrained:
        from crptpro.pretrained import load_pretrained, random_pretrained

        if self.encoder == RANDOM_ENCODER:
            return random_pretrained(self.seed, image_size=image_size, in_channels=3 * frame_stack)
        return load_pretrained(self.encoder, expect={"image_size": image_size})


def _domains_seen(pretrained: Pretrained) -> set[str]:
    training = pretrained.card.get("training") or {}
    return {str(dataset.get("domain")) for dataset in training.get("datasets") or ()}


def _table_row(named: dict[str, Any], result: ProbeResult) -> dict[str, str]:
    return {
        "method": named["method"],
        "domain": named["domain"],
        "seen": named["seen"],
        "colours": named["colors"],
        "embedding": named["embedding"],
        "R2 positions": f"{result.position_r2:.3f}",
        "R2 velocities": f"{result.velocity_r2:.3f}",
        "effective rank": f"{result.effective_rank:.1f}",
        "mean cosine": f"{result.mean_cosine:.4f}",
    }


def _measures(result: ProbeResult) -> list[dict[str, Any]]:
    """Lay a result out as measures; coordinates that were left out have no value."""
    rows = [
        {"measure": f"r2_{kind}", "coordinate": name, "value": value}
        for kind, scores in (("position", result.positions), ("velocity", result.velocities))
        for name, value in scores.items()
    ]
    for name in result.left_out:
        kind, coordinate = name.split(" ", 1)
        rows.append({"measure": f"r2_{kind}", "coordinate": coordinate, "value": ""})
    means = {
        "r2_position": result.position_r2,
        "r2_velocity": result.velocity_r2,
        "effective_rank": result.effective_rank,
        "mean_cosine": result.mean_cosine,
    }
    return [*rows, *({"measure": name, "coordinate": "", "value": value} for name, value in means.items())]


def _write(path: Path, rows: list[dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    with open(partial, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    partial.replace(path)
