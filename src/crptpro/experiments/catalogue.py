"""Every experiment by name: what it asks for, and the words that introduce it."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass

from crptpro.errors import UnknownNameError
from crptpro.experiments import analyses, matrix
from crptpro.experiments.goals import Goal, Request
from crptpro.experiments.study import study


@dataclass(frozen=True)
class Experiment:
    """One of the commands ``crptpro reproduce NAME``.

    Args:
        name: on the command line, in file names and in the report.
        title: heading.
        summary: what it asks, in a sentence or two, and where the paper has it.
        goals: what a request makes of it.
    """

    name: str
    title: str
    summary: str
    goals: Callable[[Request], list[Goal]]


EXPERIMENTS: dict[str, Experiment] = {
    experiment.name: experiment
    for experiment in (
        Experiment(
            "seen",
            "Tasks of seen domains",
            "Tasks of the domains that the encoder was pre-trained on, for every method (section IV.B).",
            matrix.seen,
        ),
        Experiment(
            "unseen",
            "Tasks of unseen domains",
            "Tasks of domains that the encoder never saw, without fine-tuning (section IV.C).",
            matrix.unseen,
        ),
        Experiment(
            "colors",
            "Reversed background colours",
            "Tasks with the colours of the background reversed, without fine-tuning (section IV.C). The paper does not "
            "say how it reverses them; whole images are the option.",
            matrix.colors,
        ),
        Experiment(
            "finetune",
            "Fine-tuning on one domain",
            "The encoder of group A trained on for a while on one domain, beside single-domain methods and DrQ "
            "(section IV.D).",
            matrix.finetune,
        ),
        Experiment(
            "ablation",
            "Ablation: dispersion loss, decoupled collection",
            "With and without the dispersion loss, with and without decoupled collection (section IV.F).",
            matrix.ablation,
        ),
        Experiment(
            "sensitivity",
            "Sensitivity: weight of the dispersion loss, amount of data",
            "The weight alpha of the dispersion loss, and the capacity b of the random datasets (section IV.F).",
            matrix.sensitivity,
        ),
        Experiment(
            "efficiency",
            "Cost of pre-training",
            "Wall clock and encoder updates of pre-training for one, two and three domains (section IV.E), projected "
            "from a timed part.",
            analyses.efficiency,
        ),
        Experiment(
            "prototypes",
            "Spread of the prototypes",
            "How far prototypes spread, along pre-training and at its end, with and without the dispersion loss "
            "(section IV.G).",
            analyses.prototypes,
        ),
        Experiment(
            "coverage",
            "Coverage of the data",
            "How widely random data and an explorer's are spread along pre-training (section IV.H).",
            analyses.coverage,
        ),
        Experiment(
            "stability",
            "Stability of pre-training",
            "The comparative loss along pre-training on random data and on an explorer's (section IV.H).",
            analyses.stability,
        ),
        Experiment(
            "visualize",
            "Embeddings of random data and of an explorer's",
            "Principal components of random data of three domains and of an explorer's in one of them (section IV.H).",
            analyses.visualize,
        ),
        Experiment(
            "probe",
            "State probe",
            "What a linear model reads of the simulator's state from frozen features: seen and unseen domains, normal "
            "and other colours. Not in the paper.",
            analyses.probe,
        ),
        Experiment(
            "study",
            "One-factor study of pre-training",
            "The temperature of the targets, and one factor at a time, judged by the state probe along pre-training "
            "and by reinforcement learning. At scale small its encoders have the paper's 512 prototypes, and those of "
            "the temperatures 10,000 updates, more than that scale's other encoders. Not in the paper.",
            study,
        ),
    )
}
"""In the order of the paper; what it does not have comes last."""


def get_experiment(name: str) -> Experiment:
    """Look an experiment up.

    Raises:
        UnknownNameError: if there is none of this name.
    """
    if name in EXPERIMENTS:
        return EXPERIMENTS[name]
    near = difflib.get_close_matches(name, EXPERIMENTS, n=1, cutoff=0.5)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    raise UnknownNameError(f"There is no experiment {name!r}.{hint} There are {', '.join(EXPERIMENTS)}.")
