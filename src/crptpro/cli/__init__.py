"""The ``crptpro`` command: a thin, typed shell over the library's functions."""

from __future__ import annotations

import logging
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg, subcommand

from crptpro.cards import cpu_cores
from crptpro.cli.downstream import Downstream, DrQ
from crptpro.cli.evaluate import Evaluate
from crptpro.cli.originals import Export, Import
from crptpro.cli.plugins import load_plugins
from crptpro.cli.pretraining import Finetune, Pretrain
from crptpro.cli.probe import Probe
from crptpro.cli.report import Report
from crptpro.cli.reproduce import Reproduce
from crptpro.cli.trim import Trim
from crptpro.colors import Colors
from crptpro.console import run_main
from crptpro.domains import expand_groups
from crptpro.quality import Quality

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Doctor:
    """Check that this machine can run crptpro: render every domain, print versions, say what to fix."""

    domains: Annotated[tuple[str, ...], arg(help_behavior_hint="(default: the paper's eight)")] = ()
    """only these domains, tasks or groups"""

    def run(self) -> None:
        """Print the report; exit status 1 unless a run would work."""
        from crptpro.doctor import run_doctor

        report = run_doctor(domains=self.domains or None)
        print(report.text())
        if not report.ok:
            raise SystemExit(1)


@dataclass(frozen=True)
class Collect:
    """Let a uniform random policy fill one dataset per domain."""

    domains: Annotated[Positional[tuple[str, ...]], arg(help_behavior_hint="(required)")]
    """domains, tasks, or group letters, e.g. `walker cartpole`, `A`, `gymnasium:HalfCheetah-v5`"""
    out: Path = Path("data")
    """one directory per domain is made below this one"""
    transitions: int = 100_000
    """transitions per domain (21 KB each)"""
    seed: int = 0
    """the same seed gives the same data whatever the number of workers"""
    workers: Annotated[
        int, arg(help_behavior_hint=lambda cores: f"(default: one per core, {cores} here)")
    ] = field(default_factory=cpu_cores)
    """collecting processes, shared by all domains"""
    quality: Quality = "exact"
    """render quality; fast uses smaller shadow maps on software GL"""
    colors: Colors = "normal"
    """colours of the worlds; reversed_background are the paper's unseen ones"""
    action_repeat: int | None = None
    """simulator steps per decision (default: the domain's, 2)"""

    def run(self) -> None:
        """Collect, or continue collecting."""
        from crptpro.data import collect_group

        paths = collect_group(
            expand_groups(self.domains),
            self.out,
            transitions=self.transitions,
            seed=self.seed,
            workers=self.workers,
            quality=self.quality,
            colors=self.colors,
            action_repeat=self.action_repeat,
        )
        for name, path in paths.items():
            logger.info("%s: %s", name, path)


def main() -> None:
    """Entry point of the ``crptpro`` command."""
    commands = tyro.conf.OmitSubcommandPrefixes[
        Annotated[Doctor, subcommand("doctor")]
        | Annotated[Collect, subcommand("collect")]
        | Annotated[Pretrain, subcommand("pretrain")]
        | Annotated[Finetune, subcommand("finetune")]
        | Annotated[Downstream, subcommand("downstream")]
        | Annotated[DrQ, subcommand("drq")]
        | Annotated[Evaluate, subcommand("evaluate")]
        | Annotated[Probe, subcommand("probe")]
        | Annotated[Reproduce, subcommand("reproduce")]
        | Annotated[Report, subcommand("report")]
        | Annotated[Import, subcommand("import")]
        | Annotated[Export, subcommand("export")]
        | Annotated[Trim, subcommand("trim")]
    ]

    def run() -> None:
        arguments = load_plugins(sys.argv[1:])
        tyro.cli(commands, prog="crptpro", description=DESCRIPTION, args=arguments).run()

    run_main(run)


DESCRIPTION = """Cross-domain random pre-training with prototypes for reinforcement learning from pixels.
Start with `crptpro doctor`, then collect, pretrain and downstream; each stage continues where it was killed.
Or `crptpro reproduce` a whole experiment of the paper.
With `--plugin FILE.py` (or a module) any command runs a file of yours first: methods, rewards and domains that it
registers then have names here."""
