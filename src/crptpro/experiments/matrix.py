"""The paper's experiments in downstream scores: which encoders, which tasks (section IV of the paper)."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from crptpro.domains import GROUPS, get_domain
from crptpro.experiments.goals import (
    DRQ,
    FAST,
    FINETUNE,
    METHODS,
    RANDOM_ENCODER,
    Goal,
    Request,
    encoder,
    encoder_for_task,
    has_option,
    in_colors,
    is_single_domain,
    runs,
)
from crptpro.experiments.pieces import EncoderPiece, Settings, settings
from crptpro.experiments.published import COLORS, FINETUNE_UPDATES, UNSEEN

CROSS_DOMAIN = ("crptpro", FAST, "proto-rl-c", "atc", "apt-c", "becl", RANDOM_ENCODER)
"""Methods whose one encoder serves several domains, with the control."""

DISPERSION = settings(intr_loss_coef=5e-3)
"""CRPTpro's weight of the dispersion loss, for a method that has none of its own."""
NO_DISPERSION = settings(intr_loss_coef=0.0)
SINGLE_DISPERSION = {"cheetah": 1e-3, "hopper": 5e-4}
"""Proto-RL(S)'s weight of the dispersion loss in the paper's ablation, which has these two domains."""
VARIANTS: dict[str, tuple[tuple[str, Settings], ...]] = {
    "crptpro": (("crptpro", ()), ("crptpro without dispersion", NO_DISPERSION)),
    FAST: ((FAST, ()),),
    "proto-rl-c": (("proto-rl-c with dispersion", DISPERSION), ("proto-rl-c", ())),
    "proto-rl-s": (("proto-rl-s with dispersion", DISPERSION), ("proto-rl-s", ())),
}
"""Methods with prototypes, the paper's with and without the dispersion loss: label and options of the loss. Proto-RL(S)
has a weight of its own where the paper has: :data:`SINGLE_DISPERSION`."""


def seen(request: Request) -> list[Goal]:
    """Tasks of the domains that the encoder was pre-trained on (section IV.B)."""
    goals = []
    for group in request.groups or GROUPS:
        for task in _tasks(request, GROUPS[group]):
            for method in request.chosen(METHODS):
                goals += _cell(request, method, group, task)
    return goals


def unseen(request: Request) -> list[Goal]:
    """Tasks of domains that the encoder never saw (section IV.C).

    Methods that would be trained on the task's own domain have no place here: fine-tuned encoders, and those of one
    domain.
    """
    rows = [(row.group, row.task) for row in UNSEEN]
    return _elsewhere(request, rows, lambda method: method == FINETUNE or is_single_domain(method))


def colors(request: Request) -> list[Goal]:
    """Tasks whose background colours are reversed, or whole images if the request says so (section IV.C).

    Nothing is fine-tuned.
    """
    rows = [(row.group, row.task) for row in COLORS]
    return in_colors(_elsewhere(request, rows, lambda method: method == FINETUNE), request.colors)


def finetune(request: Request) -> list[Goal]:
    """The encoder of group A fine-tuned on one domain, beside single-domain methods and DrQ (section IV.D)."""
    goals = []
    for group in request.groups or ("A",):
        for task in _tasks(request, FINETUNE_UPDATES):
            for method in request.chosen(("crptpro", FAST, FINETUNE, "proto-rl-s", "apt-s", DRQ)):
                goals += _cell(request, method, group, task)
    return goals


def ablation(request: Request) -> list[Goal]:
    """With and without the dispersion loss, with and without random data (section IV.F).

    Proto-RL(C) with the dispersion loss is CRPTpro without its decoupled collection. Unless tasks are asked for,
    Proto-RL(S) has the two of the paper's.
    """
    goals = []
    for group in request.groups or ("A", "C"):
        for task in _tasks(request, GROUPS[group]):
            for method in request.chosen(VARIANTS):
                goals += _ablated(request, method, group, task)
    return goals


def _ablated(request: Request, method: str, group: str, task: str) -> list[Goal]:
    explore: Settings = ()
    weight: float | None = None
    if is_single_domain(method):
        explore, weight = request.scale.single_ablation, SINGLE_DISPERSION.get(get_domain(task).name)
        if weight is None and not request.tasks:
            return []
    goals = []
    for label, loss in VARIANTS.get(method, ((method, ()),)):
        if loss == DISPERSION and weight is not None:
            loss = settings(intr_loss_coef=weight)
        goals += _cell(request, method, group, task, label=label, loss=loss, explore=explore)
    return goals


def sensitivity(request: Request) -> list[Goal]:
    """The weight of the dispersion loss, and the capacity of the random datasets (section IV.F).

    Methods without a dispersion loss have nothing to vary.
    """
    goals = []
    for group in request.groups or ("A",):
        for task in _tasks(request, GROUPS[group]):
            for method in filter(_disperses, request.chosen(("crptpro", "proto-rl-c"))):
                weights = sorted({0.0, 5e-3, *request.scale.alphas})
                for weight in weights:
                    label = f"{method}, alpha {weight:g}"
                    loss = settings(intr_loss_coef=weight)
                    goals += _cell(
                        request,
                        method,
                        group,
                        task,
                        label=label,
                        loss=loss,
                        varied="alpha",
                        value=f"{weight:g}",
                    )
            if "crptpro" in request.chosen(("crptpro",)):
                for transitions in sorted({*request.scale.capacities, request.scale.transitions}):
                    goals += _cell(
                        request, "crptpro", group, task, label=f"crptpro, b {transitions:,}",
                        transitions=transitions, varied="b", value=str(transitions),
                    )  # fmt: skip
    return goals


def _tasks(request: Request, domains: Iterable[str]) -> list[str]:
    """The tasks asked for that are in these domains, or one of each domain."""
    domains = list(domains)
    if request.tasks:
        return [task for task in request.tasks if get_domain(task).name in domains]
    return [get_domain(domain).task for domain in domains]


def _disperses(method: str) -> bool:
    return has_option(method, "intr_loss_coef")


def _elsewhere(request: Request, rows: list[tuple[str, str]], left_out: Callable[[str], bool]) -> list[Goal]:
    wanted = [
        (group, task)
        for group, task in rows
        if (not request.groups or group in request.groups) and (not request.tasks or task in request.tasks)
    ]
    goals = []
    for group, task in wanted:
        for method in request.chosen(CROSS_DOMAIN):
            if not left_out(method):
                goals += _cell(request, method, group, task)
    return goals


def _cell(
    request: Request,
    method: str,
    group: str,
    task: str,
    *,
    label: str | None = None,
    loss: Settings = (),
    explore: Settings = (),
    transitions: int | None = None,
    **place: str,
) -> list[Goal]:
    encoders: dict[int, EncoderPiece | None] = {}
    for seed in request.encoder_seeds:
        if transitions is None:
            encoders[seed] = encoder_for_task(
                request.scale, method, GROUPS[group], task, seed, loss=loss, explore=explore
            )
        else:
            encoders[seed] = encoder(request.scale, method, GROUPS[group], seed, transitions=transitions)
    return runs(request, label or method, task, encoders, group=group, **place)
