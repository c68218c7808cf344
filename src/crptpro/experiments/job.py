"""One piece in a process of its own: ``python -m crptpro.experiments.job ROOT KEY``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tyro
from tyro.conf import Positional

from crptpro.console import run_main
from crptpro.experiments.building import JobSettings, Store, build
from crptpro.plugins import load_plugin


@dataclass(frozen=True)
class Job:
    """Make one piece that a reproduction has described, or continue it."""

    root: Positional[Path]
    """directory of the reproduction"""
    key: Positional[str]
    """name of the piece, a directory in ROOT/pieces"""
    settings: JobSettings = field(default_factory=JobSettings)
    """where and how"""

    def run(self) -> None:
        """Make it."""
        for plugin in self.settings.plugins:
            load_plugin(plugin)
        store = Store(self.root)
        build(store.described(self.key), store, self.settings)


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line and make the piece."""
    run_main(lambda: tyro.cli(Job, prog="crptpro.experiments.job", args=arguments).run())


if __name__ == "__main__":
    main()
