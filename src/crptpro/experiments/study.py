"""Can CRPTpro's pre-training be bettered? The temperature of its targets, one factor at a time, then the best of both.

Every encoder is judged by the state probe, along its training and at its end, and those of full length (of the
temperatures and of the finalists) by reinforcement learning as well. This is a study of pre-training: at ``small`` it
has the paper's 512 prototypes, whose plateau lies at ln M = 6.238, where the other experiments of that scale have as
many prototypes as rows. Its downstream runs compare its encoders with each other, not with other experiments.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from crptpro.domains import GROUPS, get_domain
from crptpro.experiments import goals
from crptpro.experiments.analyses import SINGLE_DOMAIN, UNSEEN_DOMAINS
from crptpro.experiments.goals import RANDOM_ENCODER, Goal, Request, dataset, runs
from crptpro.experiments.measurements import ProbePiece
from crptpro.experiments.pieces import (
    EncoderPiece,
    PretrainedPiece,
    UntrainedPiece,
    settings,
)
from crptpro.experiments.scales import Scale
from crptpro.objectives import get_method

METHOD = "crptpro"
PROTOTYPES = {"small": 512}
"""By scale, where it differs from the scale's."""
FULL_UPDATES = {"small": 10_000}
"""Encoder updates of full-length trials by scale, where they differ from the scale's."""
SNAPSHOTS = (500, 1_000, 2_000, 3_000, 5_000, 10_000, 20_000)
"""Updates after which the encoders of full-length trials are probed, besides at their end."""
FACTOR_SNAPSHOTS = (1_000,)
"""Likewise those of the factors."""
SHARP = {"assignment_temperature": 0.05}
FAST = {"learning_rate": 3e-4}


@dataclass(frozen=True)
class Factor:
    """A number that is varied while all others stay.

    Args:
        name: of the option.
        where: field of :class:`~crptpro.experiments.pieces.PretrainedPiece` that holds it.
        usual: the baseline's value.
        values: with the usual one.
    """

    name: str
    where: Literal["training", "loss", "encoder"]
    usual: float
    values: tuple[float, ...]


def study(request: Request) -> list[Goal]:
    """Temperatures of the targets on two groups and two seeds, one-factor trials on one of each, then the finalists."""
    if METHOD not in request.chosen((METHOD,)):
        return []
    # They share encoders and the control.
    return list(dict.fromkeys([*temperatures(request), *factors(request), *finalists(request)]))


def temperatures(request: Request) -> list[Goal]:
    """The targets' temperature: the paper's 0.1, half of it, and moving from the half to the paper's over the run."""
    annealed = {**SHARP, "annealing_updates": _full_updates(request.scale)}
    variants = {"0.1": {}, "0.05": {"loss": SHARP}, "annealed": {"loss": annealed}}
    return _full_length(request, "assignment_temperature", "0.1", variants)


def finalists(request: Request) -> list[Goal]:
    """The learning rate that one-factor trials favour, at either temperature, beside the usual one."""
    variants = {
        "1e-4 and 0.1": {},
        "1e-4 and 0.05": {"loss": SHARP},
        "3e-4 and 0.05": {"training": FAST, "loss": SHARP},
        "3e-4 and 0.1": {"training": FAST},
    }
    return _full_length(request, "learning_rate_and_temperature", "1e-4 and 0.1", variants)


def _full_length(
    request: Request, factor: str, usual: str, variants: Mapping[str, Mapping[str, Any]]
) -> list[Goal]:
    """Variants on two groups and two encoder seeds, with a run of each.

    Where the request has one encoder seed, the next one is taken too: one run tells nothing of a difference.
    """
    first, *more = request.encoder_seeds
    updates = _full_updates(request.scale)
    found: list[Goal] = []
    for group in request.groups or ("A", "C"):
        for seed in (first, *(more or (first + 1,))):
            for value, changed in variants.items():
                label = f"{METHOD}, {factor} {value}"
                place = {"factor": factor, "value": value, "usual": usual, "group": group}
                piece = _trial(request.scale, group, seed, updates, SNAPSHOTS, **changed)
                found += _judged(request.scale, label, piece, place)
                found += _learned(request, label, piece, place)
            found += _control(request, group, seed)
    return found


def _full_updates(scale: Scale) -> int:
    return FULL_UPDATES.get(scale.name, scale.updates)


def factors(request: Request) -> list[Goal]:
    """One-factor trials on the request's first group and first encoder seed; all share the baseline."""
    scale, seed = request.scale, request.encoder_seeds[0]
    group = (request.groups or ("A",))[0]
    found: list[Goal] = []
    for factor in factors_of(scale):
        for value in factor.values:
            changed = {} if value == factor.usual else {factor.where: {factor.name: value}}
            place = {
                "factor": factor.name,
                "value": f"{value:g}",
                "usual": f"{factor.usual:g}",
                "group": group,
            }
            piece = _trial(scale, group, seed, scale.updates, FACTOR_SNAPSHOTS, **changed)
            found += _judged(scale, f"{METHOD}, {factor.name} {value:g}", piece, place)
    return [*found, *_control(request, group, seed)]


def factors_of(scale: Scale) -> tuple[Factor, ...]:
    """What is varied, around a scale's own numbers."""
    loss, defaults = _loss(scale), get_method(METHOD).defaults
    prototypes, width = loss.get("num_prototypes", 512), loss.get("hidden_dim", 1_024)
    batch = scale.batch_size or defaults.batch_size
    warmup = min(500, max(1, scale.updates // 6))
    return (
        Factor(
            "num_prototypes",
            "loss",
            prototypes,
            (prototypes // 4, prototypes // 2, prototypes, 2 * prototypes),
        ),
        Factor("batch_size", "training", batch, (batch // 2, batch, 2 * batch)),
        Factor("hidden_dim", "loss", width, (width // 2, width, 2 * width)),
        Factor("pixel_offset", "encoder", 0.0, (0.0, 0.5)),
        Factor("encoder_tau", "training", 0.05, (0.01, 0.05, 0.2)),
        Factor("learning_rate", "training", defaults.lr, (5e-5, 1e-4, 3e-4)),
        Factor("warmup_updates", "training", 0, (0, warmup)),
        # The largest makes up for the mean over all pairs, whose gradient is about 10,000 times weaker than the
        # comparison's.
        Factor("intr_loss_coef", "loss", 5e-3, (0.0, 5e-3, 0.5, 50.0)),
    )


def _loss(scale: Scale) -> dict[str, Any]:
    own = {"num_prototypes": PROTOTYPES[scale.name]} if scale.name in PROTOTYPES else {}
    return {**dict(scale.loss.get(METHOD, ())), **own}


def _trial(
    scale: Scale,
    group: str,
    seed: int,
    updates: int,
    snapshots: tuple[int, ...],
    *,
    training: dict[str, Any] | None = None,
    loss: dict[str, Any] | None = None,
    encoder: dict[str, Any] | None = None,
) -> PretrainedPiece:
    """The scale's encoder of a group, with what is changed."""
    options = settings(**{**_loss(scale), **(loss or {})})
    usual = goals.encoder(scale, METHOD, GROUPS[group], seed, loss=options)
    assert isinstance(usual, PretrainedPiece)
    return replace(
        usual,
        updates=updates,
        training=settings(**{**dict(usual.training), **(training or {})}),
        encoder=settings(**(encoder or {})),
        # At least one, half-way, where the scale has fewer updates than the first.
        snapshots=tuple(done for done in snapshots if done < updates) or (max(1, updates // 2),),
    )


def _judged(scale: Scale, label: str, piece: PretrainedPiece, place: dict[str, Any]) -> list[Goal]:
    """The encoder, and its probes at each of its snapshots and at its end."""
    where = {**place, "encoder_seed": piece.seed}
    found = [Goal(label, piece, settings(**where))]
    for at_updates in (*piece.snapshots, None):
        done = piece.updates if at_updates is None else at_updates
        found += _probes(scale, label, piece, {**where, "updates": done}, at_updates)
    return found


def _control(request: Request, group: str, seed: int) -> list[Goal]:
    if RANDOM_ENCODER not in request.chosen((METHOD, RANDOM_ENCODER)):
        return []
    where = {"factor": "control", "value": "untrained", "group": group, "encoder_seed": seed, "updates": 0}
    return _probes(request.scale, RANDOM_ENCODER, UntrainedPiece(RANDOM_ENCODER, seed), where)


def _probes(
    scale: Scale, label: str, piece: EncoderPiece, place: dict[str, Any], at_updates: int | None = None
) -> list[Goal]:
    """Probes on the group's domains and one more.

    The data are those of the encoder's seed, on which it was trained if the domain is its own: what is held out are
    episodes for judging the regression.
    """
    group = place["group"]
    found: list[Goal] = []
    for domain in (*GROUPS[group], UNSEEN_DOMAINS[group][0]):
        data = dataset(scale, domain, piece.seed, transitions=scale.probe_transitions)
        probe = ProbePiece(piece, data, samples=scale.probe_samples, at_updates=at_updates)
        found.append(Goal(label, probe, settings(**place, domain=get_domain(domain).name)))
    return found


def _learned(request: Request, label: str, piece: PretrainedPiece, place: dict[str, Any]) -> list[Goal]:
    """One task of the group on the finished encoder, one run unless more seeds are asked for."""
    task = get_domain(SINGLE_DOMAIN[place["group"]]).task
    if request.tasks and task not in request.tasks:
        return []
    return runs(replace(request, seeds=request.seeds or (0,)), label, task, {piece.seed: piece}, **place)
