"""``crptpro import`` and ``crptpro export``: networks from and for the original repositories."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Import:
    """Turn a snapshot of Proto-RL, CRPTpro, URLB, BeCL or ATC into a pretrained encoder; runs nothing in it."""

    snapshot: Positional[Path]
    """file that the original code wrote, e.g. expl_agent_100000.pt, snapshot_2000000.pt, params.pkl"""
    out: Path
    """directory of the pretrained encoder to write"""
    layout: Literal["auto", "proto", "urlb", "atc"] = "auto"
    """whose snapshot it must be; auto takes anyone's"""

    def run(self) -> None:
        """Read, convert and write."""
        from crptpro.pretrained import import_snapshot

        logger.info("pretrained encoder: %s", import_snapshot(self.snapshot, self.out, layout=self.layout))


@dataclass(frozen=True)
class Export:
    """Write a pretrained encoder and its heads as plain state dicts under an original repository's names."""

    pretrained: Positional[Path]
    """directory of the pretrained encoder"""
    layout: Literal["proto", "urlb", "atc"]
    """whose names: Proto-RL's and CRPTpro's, URLB's and BeCL's, or ATC's"""
    out: Path
    """file to write, for torch.load"""

    def run(self) -> None:
        """Read, rename and write."""
        from crptpro.pretrained import export_state_dict, load_pretrained, write_state_dict

        state = export_state_dict(load_pretrained(self.pretrained), self.layout)
        logger.info("state dicts: %s", write_state_dict(state, self.out))
