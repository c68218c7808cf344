"""``crptpro probe``: what a frozen encoder knows of the simulator's state, in minutes and without RL."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from crptpro.cli.request import image_format, require_writable

if TYPE_CHECKING:
    from crptpro.pretrained import Pretrained


@dataclass(frozen=True)
class Probe:
    """Predict positions and velocities from frozen features by ridge regression, on held-out episodes."""

    encoder: Positional[str]
    """directory of a pretrained encoder, or `random-encoder` for the untrained control"""
    datasets: Annotated[Positional[tuple[Path, ...]], arg(help_behavior_hint="(required)")]
    """datasets, e.g. data/walker data/finger; each is probed alone, seen in pre-training or not"""
    samples: int = 2_000
    """observations per dataset; time and memory grow with their square"""
    seed: int = 0
    """which observations, which episodes are held out, and the random encoder's initialisation"""
    csv: Path | None = None
    """write every number here, each coordinate's R2 among them"""
    device: str = "cpu"
    """where the encoder runs"""

    def run(self) -> None:
        """Print a table, and write what was asked for."""
        from crptpro.data import FrameDataset
        from crptpro.errors import CRPTproError
        from crptpro.experiments.measure import PROBE_COLUMNS, probe_rows, write_rows
        from crptpro.modules import usable_device

        if self.samples < 1:
            raise CRPTproError(f"--samples must be at least 1, got {self.samples}.")
        if self.csv is not None:
            require_writable(self.csv)  # before minutes of probing
        usable_device(self.device)
        image_size, frame_stack = image_format(self.datasets)
        pretrained = self._load(image_size, frame_stack)
        pretrained.encoder.to(self.device)
        if pretrained.projector is not None:
            pretrained.projector.to(self.device)
        datasets = [FrameDataset.open(path) for path in self.datasets]
        table, measures = [], []
        try:
            for dataset in datasets:
                rows, numbers = probe_rows(
                    pretrained, dataset, encoder=self.encoder, samples=self.samples, seed=self.seed
                )
                table += rows
                measures += numbers
                if self.csv is not None:
                    write_rows(self.csv, measures, PROBE_COLUMNS)
        finally:  # a later dataset may be refused, and writing may fail
            if table:
                lines = [list(table[0]), ["---"] * len(table[0]), *(list(row.values()) for row in table)]
                print("\n".join(f"| {' | '.join(line)} |" for line in lines))

    def _load(self, image_size: int, frame_stack: int) -> Pretrained:
        from crptpro.pretrained import load_pretrained, random_pretrained

        if self.encoder == "random-encoder":
            return random_pretrained(self.seed, image_size=image_size, in_channels=3 * frame_stack)
        return load_pretrained(self.encoder).require(image_size=image_size)
