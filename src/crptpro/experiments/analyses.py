"""The paper's experiments without downstream scores (sections IV.E, G and H), and the state probe."""

from __future__ import annotations

from collections.abc import Iterator

from crptpro.colors import Colors
from crptpro.domains import GROUPS, get_domain
from crptpro.experiments.goals import (
    DRQ,
    FAST,
    FINETUNE,
    METHODS,
    RANDOM_ENCODER,
    Goal,
    Request,
    dataset,
    encoder,
    encoder_for_task,
    explores,
    is_single_domain,
)
from crptpro.experiments.matrix import NO_DISPERSION, VARIANTS
from crptpro.experiments.measurements import (
    CoveragePiece,
    EmbeddingsPiece,
    ProbePiece,
    PrototypesPiece,
    TimingPiece,
)
from crptpro.experiments.pieces import EncoderPiece, ExploredPiece, settings
from crptpro.experiments.scales import PAPER, Scale

SINGLE_DOMAIN = {"A": "walker", "B": "pendulum", "C": "finger", "D": "walker"}
"""The domain of a group whose encoder stands for an (S) method where one is enough; B's and C's are the paper's."""
UNSEEN_DOMAINS = {
    "A": ("finger", "pendulum"),
    "B": ("finger", "walker"),
    "C": ("walker", "pendulum"),
    "D": ("cheetah", "finger"),
}
"""Domains outside a group on which its encoders are probed."""
PRETRAINED = tuple(method for method in METHODS if method not in (FINETUNE, DRQ, RANDOM_ENCODER))
"""Methods with a pre-training of their own."""


def efficiency(request: Request) -> list[Goal]:
    """Wall clock and encoder updates of pre-training for 1, 2 and 3 domains (section IV.E)."""
    goals = []
    for group, seed in _groups_and_seeds(request, "A"):
        for method in _methods(request, PRETRAINED):
            for count in range(1, len(GROUPS[group]) + 1):
                domains = GROUPS[group][:count]
                piece = TimingPiece(
                    encoders=_encoders(request.scale, method, domains, seed),
                    paper=_encoders(PAPER, method, domains, seed),
                    updates=request.scale.timing_updates,
                    paper_timed=request.scale.paper_timing_updates,
                    device=request.device,
                    threads=request.threads,
                )
                place = settings(
                    group=group,
                    domains=count,
                    encoder_seed=seed,
                    device=request.device,
                    threads=request.threads,
                )
                goals.append(Goal(method, piece, place))
    return goals


def prototypes(request: Request) -> list[Goal]:
    """How far prototypes spread, with and without the dispersion loss (section IV.G)."""
    goals = []
    for group, seed in _groups_and_seeds(request, "A"):
        for method in _methods(request, VARIANTS):
            for domains in _domain_sets(request, group, method):
                for label, loss in VARIANTS[method]:
                    trained = encoder(request.scale, method, domains, seed, loss=loss)
                    goals.append(_goal(label, PrototypesPiece(trained), group, seed, domains))
    return goals


def coverage(request: Request) -> list[Goal]:
    """Random data against an explorer's along its training, as CRPTpro's encoder sees them (section IV.H).

    The encoder is one that was trained on the random data; of the encoders at hand it is the one that tells
    observations of all domains apart, and it is the same for both sources.
    """
    goals = []
    for group, seed in _groups_and_seeds(request, "A"):
        for method in request.chosen(("proto-rl-c",)):
            if not explores(method):
                continue
            for domains in _domain_sets(request, group, method):
                explorer = encoder(request.scale, method, domains, seed)
                assert isinstance(explorer, ExploredPiece)
                piece = CoveragePiece(
                    explorer,
                    tuple(dataset(request.scale, domain, seed) for domain in domains),
                    encoder(request.scale, "crptpro", GROUPS[group], seed),
                    samples=request.scale.coverage_samples,
                    seed=seed,
                )
                goals.append(_goal(method, piece, group, seed, domains))
    return goals


def stability(request: Request) -> list[Goal]:
    """The comparative loss along pre-training, on random data and on an explorer's (section IV.H).

    Without the dispersion loss CRPTpro differs from Proto-RL(C) in its data alone. The goals are the encoders, whose
    records hold the curves.
    """
    variants = {
        "crptpro": (("crptpro", ()), ("crptpro without dispersion", NO_DISPERSION)),
        FAST: ((FAST, ()),),
        "proto-rl-c": (("proto-rl-c", ()),),
    }
    goals = []
    for group, seed in _groups_and_seeds(request, "A"):
        for method in request.chosen(variants):
            if method not in VARIANTS:
                continue  # without prototypes there is no comparative loss
            for domains in _domain_sets(request, group, method):
                for label, loss in variants.get(method, ((method, ()),)):
                    trained = encoder(request.scale, method, domains, seed, loss=loss)
                    goals.append(_goal(label, trained, group, seed, domains))
    return goals


def visualize(request: Request) -> list[Goal]:
    """Principal components of a group's random data and of Proto-RL(S)'s in one of its domains (section IV.H)."""
    scale, goals = request.scale, []
    for group, seed in _groups_and_seeds(request, "B", "C"):
        for method in request.chosen(("proto-rl-s",)):
            if not explores(method):
                continue
            for domains in _domain_sets(request, group, method):
                explorer = encoder(scale, method, domains, seed)
                assert isinstance(explorer, ExploredPiece)
                piece = EmbeddingsPiece(
                    encoder(scale, "crptpro", GROUPS[group], seed),
                    tuple(dataset(scale, domain, seed) for domain in GROUPS[group]),
                    explorer,
                    samples=scale.embedded_samples,
                    seed=seed,
                )
                goals.append(_goal(method, piece, group, seed, domains))
    return goals


def probe(request: Request) -> list[Goal]:
    """What encoders know of the simulator's state: their domains and others, in normal and in other colours.

    Tasks of the request choose the domains that are probed; an (S) method's one encoder is probed on all of them, too.
    """
    scale, goals = request.scale, []
    for group, seed in _groups_and_seeds(request, "A"):
        asked = dict.fromkeys(get_domain(task).name for task in request.tasks)
        probed = tuple(asked) or (*GROUPS[group], *UNSEEN_DOMAINS[group])
        for method in request.chosen((*PRETRAINED, RANDOM_ENCODER)):
            if method == DRQ:
                continue
            for domain in probed:
                # Fine-tuning has an encoder for each domain; an (S) method could, and is judged by one.
                home = domain if method == FINETUNE else SINGLE_DOMAIN[group]
                trained = encoder_for_task(scale, method, GROUPS[group], get_domain(home).task, seed)
                assert isinstance(trained, EncoderPiece)
                data = dataset(scale, domain, seed, transitions=scale.probe_transitions)
                other: tuple[Colors, ...] = ("normal", request.colors)
                for colors in dict.fromkeys(other):
                    piece = ProbePiece(trained, data, colors=colors, samples=scale.probe_samples)
                    place = settings(group=group, domain=domain, colors=colors, encoder_seed=seed)
                    goals.append(Goal(method, piece, place))
    return goals


def _groups_and_seeds(request: Request, *usual: str) -> Iterator[tuple[str, int]]:
    for group in request.groups or usual:
        for seed in request.encoder_seeds:
            yield group, seed


def _methods(request: Request, known: tuple[str, ...] | dict) -> list[str]:
    """The methods asked for that an experiment knows; others have nothing that it measures."""
    return [method for method in request.chosen(known) if method in known]


def _domain_sets(request: Request, group: str, method: str) -> list[tuple[str, ...]]:
    """The domains of each encoder of a method: the group's, or, of an (S) method, one for each of those asked for."""
    if not is_single_domain(method):
        return [GROUPS[group]]
    asked = dict.fromkeys(get_domain(task).name for task in request.tasks)
    return [(domain,) for domain in asked if domain in GROUPS[group]] or [(SINGLE_DOMAIN[group],)]


def _encoders(scale: Scale, method: str, domains: tuple[str, ...], seed: int) -> tuple[EncoderPiece, ...]:
    """One encoder of all domains, or one for each."""
    sets = [(domain,) for domain in domains] if is_single_domain(method) else [domains]
    return tuple(encoder(scale, method, each, seed) for each in sets)


def _goal(label: str, piece: object, group: str, seed: int, domains: tuple[str, ...]) -> Goal:
    place = settings(group=group, domains="+".join(domains), encoder_seed=seed)
    return Goal(label, piece, place)  # type: ignore[arg-type]
