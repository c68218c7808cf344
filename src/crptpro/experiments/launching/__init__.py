"""Run the pieces of a plan: in this process, in local processes, on Slurm or on a Ray cluster."""

from crptpro.experiments.launching.choice import (
    LauncherName,
    Resources,
    SlurmRequest,
    divide,
    make_launcher,
    threads_alone,
)
from crptpro.experiments.launching.launchers import InlineLauncher, Job, Launcher, Outcome
from crptpro.experiments.launching.scheduler import Failure, run_pieces
from crptpro.experiments.launching.work import Work

__all__ = [
    "Failure",
    "InlineLauncher",
    "Job",
    "Launcher",
    "LauncherName",
    "Outcome",
    "Resources",
    "SlurmRequest",
    "Work",
    "divide",
    "make_launcher",
    "run_pieces",
    "threads_alone",
]
