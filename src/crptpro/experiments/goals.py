"""What an experiment asks for: pieces, and where each stands in its tables."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from crptpro.colors import Colors
from crptpro.domains import GROUPS, get_domain
from crptpro.errors import CRPTproError, UnknownNameError
from crptpro.experiments.definitions import domain_definition, method_definition
from crptpro.experiments.pieces import (
    DatasetPiece,
    EncoderPiece,
    ExploredPiece,
    FinetunedPiece,
    Piece,
    PretrainedPiece,
    RunPiece,
    Settings,
    UntrainedPiece,
    settings,
)
from crptpro.experiments.scales import Scale
from crptpro.objectives import Method, get_method

FAST, FINETUNE, DRQ, RANDOM_ENCODER = "crptpro-fast", "crptpro-finetune", "drq", "random-encoder"
METHODS = (
    "crptpro", FAST, FINETUNE, "proto-rl-c", "proto-rl-s", "atc", "apt-c", "apt-s", "becl", DRQ, RANDOM_ENCODER,
)  # fmt: skip
"""Every system of the comparison, in the order of tables."""

SEEDS = 1_000
"""Seeds of a level lie below this number, so that DrQ's runs, which have both levels in one, are all different."""


@dataclass(frozen=True)
class Goal:
    """One cell's worth of an experiment.

    Args:
        label: the system or variant, a row of the tables: ``"crptpro"``, ``"proto-rl-c with dispersion"``.
        piece: what gives its number.
        place: where it stands otherwise, e.g. ``(("group", "A"), ("task", "walker_run"))``.
    """

    label: str
    piece: Piece
    place: Settings = ()


@dataclass(frozen=True)
class Request:
    """What part of an experiment is wanted, at which scale.

    Args:
        scale: every budget.
        methods: systems, by name; the experiment's own if empty.
        groups: letters of :data:`crptpro.domains.GROUPS`; the experiment's own if empty.
        tasks: by name, or a domain's, which stands for its task; the experiment's own if empty.
        encoder_seeds: the first seed level: collection, exploration and pre-training.
        seeds: the second: downstream runs on each encoder; ``None`` for as many as the scale has.
        colors: what "other colours" are, where an experiment has them (decision A22).
        device: of networks; only what measures time depends on it, and on ``threads``.
        threads: of torch, in a job that is alone on its machine.
    """

    scale: Scale
    methods: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    tasks: tuple[str, ...] = ()
    encoder_seeds: tuple[int, ...] = (0,)
    seeds: tuple[int, ...] | None = None
    colors: Colors = "reversed_background"
    device: str = "cpu"
    threads: int = 1

    def __post_init__(self) -> None:
        """Refuse names that nobody knows.

        Raises:
            UnknownNameError: for a method, a group or a task.
            CRPTproError: for a repeated or missing seed, or one outside [0, :data:`SEEDS`).
        """
        for method in self.methods:
            if method not in (FINETUNE, DRQ, RANDOM_ENCODER):
                get_method(method, besides=METHODS)
        for group in self.groups:
            if group not in GROUPS:
                raise UnknownNameError(f"There is no group {group!r}; choose from {', '.join(GROUPS)}.")
        # A domain's name stands for its task: a run called "walker" would be another piece than "walker_run".
        # So would one that is spelled otherwise, as dm_control's manipulation tasks may be.
        named = [(task, get_domain(task)) for task in self.tasks]
        tasks = (
            domain.task if task == domain.name or domain.source == "manipulation" else task
            for task, domain in named
        )
        object.__setattr__(self, "tasks", tuple(dict.fromkeys(tasks)))
        for name, given in (("encoder_seeds", self.encoder_seeds), ("seeds", self.downstream_seeds)):
            if not given or len(set(given)) != len(given):
                raise CRPTproError(f"`{name}` must be one or several different numbers, got {given}.")
            if not all(0 <= seed < SEEDS for seed in given):
                raise CRPTproError(f"`{name}` must be numbers from 0 to {SEEDS - 1}, got {given}.")

    @property
    def downstream_seeds(self) -> tuple[int, ...]:
        """Seeds of the second level."""
        return tuple(range(self.scale.seeds)) if self.seeds is None else self.seeds

    def chosen(self, usual: Iterable[str]) -> tuple[str, ...]:
        """Return the methods asked for, or the experiment's usual ones."""
        return self.methods or tuple(usual)


def explores(method: str) -> bool:
    """Whether a system's encoder is trained on what its own agents see."""
    return method not in (DRQ, FINETUNE, RANDOM_ENCODER) and get_method(method).exploration is not None


def is_single_domain(method: str) -> bool:
    """Whether a system has an encoder per domain because it cannot be trained on several: the (S) methods."""
    exploration = get_method(method).exploration if explores(method) else None
    return exploration is not None and exploration.is_single_domain


def has_option(method: str, option: str) -> bool:
    """Whether the loss that a system's encoder is pre-trained with has an option, ``"intr_loss_coef"`` say."""
    if method in (DRQ, RANDOM_ENCODER):
        return False
    loss_class = get_method("crptpro" if method == FINETUNE else method).loss_class
    return option in inspect.signature(loss_class.__init__).parameters


def dataset(scale: Scale, domain: str, seed: int, *, transitions: int | None = None) -> DatasetPiece:
    """Return a domain's random dataset."""
    return DatasetPiece(
        get_domain(domain).name,
        transitions or scale.transitions,
        seed,
        quality=scale.quality,
        definition=domain_definition(domain),
    )


def encoder(
    scale: Scale,
    method: str,
    domains: Iterable[str],
    seed: int,
    *,
    transitions: int | None = None,
    loss: Settings = (),
    explore: Settings = (),
) -> EncoderPiece:
    """Return the encoder that a method trains on domains.

    Args:
        scale: its budgets.
        method: a registered name, or ``random-encoder``.
        domains: a single one for the (S) methods.
        seed: of data and training.
        transitions: of each domain, instead of the scale's.
        loss: options of the loss, instead of or besides the scale's.
        explore: settings of exploring, likewise.

    Raises:
        UnknownNameError: if there is no such method.
    """
    names = tuple(get_domain(domain).name for domain in domains)
    if method == RANDOM_ENCODER:
        return UntrainedPiece(method, seed)
    registered = get_method(method)
    options = _departures(registered, {**dict(scale.loss_options(registered)), **dict(loss)})
    definition = method_definition(registered)
    batch = {} if scale.batch_size is None else {"batch_size": scale.batch_size}
    if registered.exploration is None:
        datasets = tuple(dataset(scale, name, seed, transitions=transitions) for name in names)
        return PretrainedPiece(
            method,
            seed,
            datasets=datasets,
            updates=scale.updates,
            training=settings(**batch),
            loss=options,
            definition=definition,
        )
    exploring = {**dict(scale.exploration(registered)), **batch, **dict(explore)}
    if scale.quality != "exact":
        exploring["quality"] = scale.quality
    of_domains = tuple(domain_definition(name) for name in names)
    return ExploredPiece(
        method,
        seed,
        domains=names,
        explore=settings(**exploring),
        loss=options,
        definition=definition,
        domain_definitions=of_domains if any(of_domains) else (),
    )


def _departures(method: Method, options: dict[str, Any]) -> Settings:
    """Options of a loss without those that its method has anyway: they would make the same encoder another piece."""
    signature = inspect.signature(method.loss_class.__init__).parameters
    usual = {name: parameter.default for name, parameter in signature.items()} | method.loss_options
    return settings(
        **{name: value for name, value in options.items() if name not in usual or usual[name] != value}
    )


def finetuned(scale: Scale, base: EncoderPiece, domain: str, seed: int) -> FinetunedPiece:
    """Return an encoder trained on, on one domain."""
    name = get_domain(domain).name
    batch = {} if scale.batch_size is None else {"batch_size": scale.batch_size}
    return FinetunedPiece(
        FINETUNE,
        seed,
        base=base,
        dataset=dataset(scale, name, seed),
        updates=scale.finetuning_updates(name),
        training=settings(**batch),
    )


def encoder_for_task(
    scale: Scale,
    method: str,
    domains: Iterable[str],
    task: str,
    seed: int,
    *,
    loss: Settings = (),
    explore: Settings = (),
) -> EncoderPiece | None:
    """Return the encoder that a task of a group is learned on; ``None`` for DrQ, which trains its own.

    The (S) methods have one per domain, and fine-tuning goes on from the group's on the task's domain.
    """
    if method == DRQ:
        return None
    if method == FINETUNE:
        return finetuned(scale, encoder(scale, "crptpro", domains, seed, loss=loss), task, seed)
    if is_single_domain(method):
        domains = (get_domain(task).name,)
    return encoder(scale, method, domains, seed, loss=loss, explore=explore)


def run(scale: Scale, task: str, on: EncoderPiece | None, seed: int) -> RunPiece:
    """Return a downstream run."""
    config = {**dict(scale.run), **(dict(scale.drq) if on is None else {})}
    if scale.quality != "exact":
        config["quality"] = scale.quality
    return RunPiece(task, on, seed, config=settings(**config), definition=domain_definition(task))


def runs(
    request: Request, label: str, task: str, encoders: dict[int, EncoderPiece | None], **place: str
) -> list[Goal]:
    """Return the runs of one cell: every downstream seed on the encoder of every encoder seed.

    Where there is no encoder to share (DrQ), the encoder seeds count as further seeds of the run, so that every
    system has as many runs. Which run a place has depends on its two seeds alone, and not on what else is asked for.
    """
    where = settings(task=task, **place)
    goals = []
    for seed, piece in encoders.items():
        for own in request.downstream_seeds:
            shift = 0 if piece is not None else seed * SEEDS
            goal = run(request.scale, task, piece, own + shift)
            goals.append(Goal(label, goal, settings(encoder_seed=seed, seed=own, **dict(where))))
    return goals


def in_colors(goals: Iterable[Goal], colors: Colors) -> list[Goal]:
    """Return the same runs in a world of other colours."""
    changed = []
    for goal in goals:
        assert isinstance(goal.piece, RunPiece)
        piece = replace(goal.piece, colors=colors)
        changed.append(Goal(goal.label, piece, settings(colors=colors, **dict(goal.place))))
    return changed
