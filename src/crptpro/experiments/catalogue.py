"""Every experiment that can be reproduced, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from crptpro.experiments import matrix
from crptpro.experiments.goals import Goal, Request


@dataclass(frozen=True)
class Experiment:
    """An experiment of the paper.

    Args:
        name: as on the command line.
        title: heading in a report.
        summary: what it shows, in a sentence.
        goals: what it is made of, for a request.
    """

    name: str
    title: str
    summary: str
    goals: Callable[[Request], list[Goal]]


EXPERIMENTS: dict[str, Experiment] = {
    experiment.name: experiment
    for experiment in (
        Experiment("seen", "Seen domains", "Tasks of the pre-training domains (section IV.B).", matrix.seen),
        Experiment("unseen", "Unseen domains", "Tasks of other domains (section IV.C).", matrix.unseen),
        Experiment("colors", "Reversed colours", "Tasks in other colours (section IV.C).", matrix.colors),
        Experiment("finetune", "Fine-tuning", "One domain more closely (section IV.D).", matrix.finetune),
        Experiment("ablation", "Ablation", "Without parts of the method (section IV.F).", matrix.ablation),
        Experiment(
            "sensitivity", "Sensitivity", "Weights and capacities (section IV.F).", matrix.sensitivity
        ),
    )
}
