"""``crptpro trim``: an artifact without what only training on it reads."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Trim:
    """Write a pretrained encoder without the networks that only training on it reads: small enough to publish."""

    pretrained: Positional[Path]
    """directory of the pretrained encoder"""
    out: Path
    """directory to write; the same one trims it where it is"""

    def run(self) -> None:
        """Read, leave out and write."""
        from crptpro.artifact import WEIGHTS_FILE
        from crptpro.pretrained import load_pretrained, trim_pretrained

        artifact = load_pretrained(self.pretrained)
        before = (self.pretrained / WEIGHTS_FILE).stat().st_size
        after = (trim_pretrained(artifact, self.out) / WEIGHTS_FILE).stat().st_size
        logger.info("pretrained encoder: %s, %.1f MB of %.1f", self.out, after / 1e6, before / 1e6)
