"""What each experiment of the paper asks for, at which scale: cells of its tables, and the job behind each."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from crptpro.domains import GROUPS, get_domain
from crptpro.errors import CRPTproError, UnknownNameError
from crptpro.experiments.jobs import (
    Job,
    collect_job,
    comparison_job,
    downstream_job,
    explore_job,
    finetune_job,
    pretrain_job,
    probe_job,
    prototypes_job,
    timing_job,
    untrained_job,
)
from crptpro.objectives import Method, get_method
from crptpro.values import as_int

Settings = Mapping[str, Any]
NONE: Settings = {}

FAST, NO_BONUS, FINETUNE, DRQ = "crptpro-fast", "crptpro-no-bonus", "crptpro-finetune", "drq"
RANDOM_ENCODER = "random-encoder"
METHODS = (
    "crptpro", FAST, NO_BONUS, FINETUNE, "proto-rl-c", "proto-rl-s", "atc", "apt-c", "apt-s", "becl", DRQ,
    RANDOM_ENCODER,
)  # fmt: skip
"""Every system of the comparison, in the order of tables."""
PRETRAINED = tuple(name for name in METHODS if name not in (NO_BONUS, FINETUNE, DRQ, RANDOM_ENCODER))
"""Those with a pre-training of their own."""
CROSS_DOMAIN = ("crptpro", FAST, "proto-rl-c", "atc", "apt-c", "becl", RANDOM_ENCODER)
"""Those whose one encoder serves several domains, with the control."""

UNSEEN_TASKS = {
    "A": ("pendulum_swingup", "finger_spin", "hopper_hop", "reach_duplo", "cartpole_swingup_sparse"),
    "C": ("cheetah_run", "walker_run", "quadruped_run", "pendulum_swingup", "cartpole_swingup_sparse"),
}
"""Tasks of domains that a group's encoder never saw, in the paper's table."""
COLORS_TASKS = {"C": ("reach_duplo", "pendulum_swingup", "cheetah_run")}
"""Tasks with a reversed background, likewise."""
FINETUNE_UPDATES = {
    "pendulum": 2_000,
    "manipulation": 2_000,
    "cartpole": 3_000,
    "cheetah": 1_000,
    "walker": 500,
}
"""Domain to encoder updates of fine-tuning the group A encoder (section IV.D)."""

DISPERSION, NO_DISPERSION = {"intr_loss_coef": 5e-3}, {"intr_loss_coef": 0.0}
VARIANTS: dict[str, tuple[tuple[str, Settings], ...]] = {
    "crptpro": (("crptpro", NONE), ("crptpro without dispersion", NO_DISPERSION)),
    FAST: ((FAST, NONE),),
    "proto-rl-c": (("proto-rl-c with dispersion", DISPERSION), ("proto-rl-c", NONE)),
    "proto-rl-s": (("proto-rl-s with dispersion", DISPERSION), ("proto-rl-s", NONE)),
}
"""Methods with prototypes, the paper's with and without the dispersion loss: label and options of the loss."""
SINGLE_DISPERSION = {"cheetah": 1e-3, "hopper": 5e-4}
"""Proto-RL(S)'s weight of the dispersion loss in the paper's ablation, which has these two domains."""
SINGLE_DOMAIN = {"A": "walker", "B": "pendulum", "C": "finger", "D": "walker"}
"""The domain of a group whose encoder stands for an (S) method where one is enough; B's and C's are the paper's."""
PROBED_UNSEEN = {
    "A": ("finger", "pendulum"), "B": ("finger", "walker"), "C": ("walker", "pendulum"), "D": ("cheetah", "finger"),
}  # fmt: skip
"""Domains outside a group on which its encoders are probed."""

SEEDS = 1_000
"""Seeds of a level lie below this number, so that DrQ's runs, which have both levels in one, are all different."""


@dataclass(frozen=True)
class Scale:
    """Every budget of every experiment; the values here are the paper's.

    Args:
        name: as on the command line.
        transitions: random transitions per domain.
        quality: render quality of everything.
        updates: encoder updates on datasets, over all domains.
        batch_size: transitions per pre-training update; ``None`` for the method's own.
        loss: options of losses, by name of their class.
        explore: settings of exploring, with the encoder update interval of a method that makes one update each time.
        explore_single: the same of the (S) methods.
        single_ablation: settings of exploring that an (S) method has in ``ablation`` besides.
        finetune_updates: encoder updates of fine-tuning, by domain; others take the largest.
        run: settings of every downstream run.
        seeds: number of downstream runs on each encoder unless the caller says otherwise.
        alphas: weights of the dispersion loss in ``sensitivity``, besides none and the method's own.
        capacities: random transitions per domain in ``sensitivity``.
        probe_samples: observations of a state probe.
        probe_transitions: of a dataset that is probed, which needs several episodes, if not ``transitions``.
        timing_updates: encoder updates that ``efficiency`` times, after as many to warm up.
        paper_timing_updates: the same with the paper's batches and intervals; 0 for none.
        coverage_samples: observations of a coverage estimate.
        embedded_samples: observations of each source in ``visualize``.
        study_prototypes: prototypes of the study's encoders, if not those of ``loss``.
        study_updates: encoder updates of the study's full-length trials, if not ``updates``.
    """

    name: str
    transitions: int = 100_000
    quality: str = "exact"
    updates: int = 50_000
    batch_size: int | None = None
    loss: Mapping[str, Settings] = field(default_factory=dict)
    explore: Settings = field(default_factory=dict)
    explore_single: Settings = field(default_factory=dict)
    single_ablation: Settings = field(default_factory=dict)
    finetune_updates: Mapping[str, int] = field(default_factory=lambda: FINETUNE_UPDATES)
    run: Settings = field(default_factory=dict)
    seeds: int = 3
    alphas: tuple[float, ...] = (5e-4, 5e-2, 5e-1)
    capacities: tuple[int, ...] = (10_000, 50_000, 100_000)
    probe_samples: int = 4_000
    probe_transitions: int | None = None
    timing_updates: int = 100
    paper_timing_updates: int = 0
    coverage_samples: int = 1_024
    embedded_samples: int = 125
    study_prototypes: int | None = None
    study_updates: int | None = None

    def training(self) -> dict[str, Any]:
        """Return the settings of every encoder's training."""
        return {} if self.batch_size is None else {"batch_size": self.batch_size}

    def exploration(self, method: Method) -> dict[str, Any]:
        """Return the settings of a method's exploring."""
        assert method.exploration is not None
        chosen = dict(self.explore_single if method.exploration.is_single_domain else self.explore)
        if "encoder_update_interval" in chosen:
            chosen["encoder_update_interval"] *= method.exploration.encoder_updates_each
        return chosen | ({} if self.quality == "exact" else {"quality": self.quality})


# 20,000 decisions and, after the random ones, as many encoder updates as the methods on random data have.
_SMALL_EXPLORER = {"env_steps": 40_000, "checkpoint_interval_env_steps": 2_000, "encoder_update_interval": 6}
_TINY_EXPLORER = {
    "env_steps": 120, "random_agent_steps": 8, "hidden_dim": 16, "queue_size": 32,
    "checkpoint_interval_env_steps": 60, "encoder_update_interval": 2,
}  # fmt: skip

PAPER = Scale("paper", single_ablation={"env_steps": 200_000})
SMALL = Scale(
    "small",
    transitions=20_000,
    updates=3_000,
    batch_size=128,
    # As many prototypes as rows, as in the paper (512 of both): with more, most rows are their own nearest candidates
    # and the prototype reward is 0.
    loss={"ProtoLoss": {"num_prototypes": 128}},
    explore={**_SMALL_EXPLORER, "random_agent_steps": 667},
    explore_single={**_SMALL_EXPLORER, "random_agent_steps": 2_000},
    finetune_updates={domain: updates * 3_000 // 50_000 for domain, updates in FINETUNE_UPDATES.items()},
    run={
        "env_steps": 20_000, "batch_size": 128, "learning_rate": 1e-3, "replay_capacity": 12_000,
        "checkpoint_interval_env_steps": 2_000,
    },
    seeds=2,
    capacities=(5_000, 20_000),
    probe_samples=2_000,
    timing_updates=25,
    paper_timing_updates=7,  # as many rows
    coverage_samples=512,
    study_prototypes=512,
    study_updates=10_000,
)  # fmt: skip
"""A fifth of the data, 6 % of the updates, 4 % of the env steps, a quarter of the batch: a day on two CPU cores."""
TINY = Scale(
    "tiny",
    transitions=130,  # an episode of manipulation has 125
    quality="fast",
    updates=6,
    batch_size=4,
    loss={
        "ProtoLoss": {"num_prototypes": 16, "latent_dim": 8, "hidden_dim": 16}, "ATCLoss": {"latent_dim": 8},
        "SimCLRLoss": {"latent_dim": 8}, "BeCLLoss": {"hidden_dim": 16},
    },
    explore=_TINY_EXPLORER,
    explore_single=_TINY_EXPLORER,
    finetune_updates=dict.fromkeys(FINETUNE_UPDATES, 2),
    run={
        "env_steps": 60, "random_agent_steps": 12, "batch_size": 4, "replay_capacity": 40, "hidden_dim": 16,
        "queue_size": 32, "eval_interval_env_steps": 60, "eval_episodes": 1, "checkpoint_interval_env_steps": 30,
        "log_interval_env_steps": 10,
    },
    seeds=1,
    alphas=(5e-2,),
    capacities=(130,),  # the data is there
    probe_samples=60,
    probe_transitions=1_100,  # three episodes; one has 500 decisions
    timing_updates=2,
    coverage_samples=32,
    embedded_samples=8,
)  # fmt: skip
"""Minutes; shows that everything runs, and nothing else."""
SCALES: dict[str, Scale] = {scale.name: scale for scale in (TINY, SMALL, PAPER)}


@dataclass(frozen=True)
class Cell:
    """One number that an experiment asks for.

    Args:
        label: the system or variant, a row of the tables: ``"crptpro"``, ``"proto-rl-c with dispersion"``.
        job: what gives the number.
        place: where it stands otherwise: ``{"group": "A", "task": "walker_run"}``.
    """

    label: str
    job: Job
    place: Settings


@dataclass(frozen=True)
class Request:
    """What part of an experiment is wanted, at which scale.

    Args:
        scale: every budget.
        methods: systems, by name; the experiment's own if empty.
        groups: letters of :data:`crptpro.domains.GROUPS`; the experiment's own if empty.
        tasks: by name, or a domain's, which stands for its task; the experiment's own if empty.
        encoder_seeds: the first seed level: collection, exploration and pre-training.
        seeds: the second: downstream runs on each encoder; as many as the scale has if empty.
        colors: what "other colours" are, where an experiment has them.
        device: of networks; only timings depend on it, and on ``threads``.
        threads: of a job that is alone on its machine.

    Raises:
        UnknownNameError: for a method, a group or a task.
        CRPTproError: for a repeated or missing seed, or one outside [0, :data:`SEEDS`).
    """

    scale: Scale
    methods: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    tasks: tuple[str, ...] = ()
    encoder_seeds: tuple[int, ...] = (0,)
    seeds: tuple[int, ...] = ()
    colors: str = "reversed_background"
    device: str = "cpu"
    threads: int = 1

    def __post_init__(self) -> None:
        """Refuse names that nobody knows; a domain's name becomes that of its task."""
        for method in self.methods:
            if method not in METHODS:
                get_method(method, besides=METHODS)
        for group in self.groups:
            if group not in GROUPS:
                raise UnknownNameError(f"There is no group {group!r}; choose from {', '.join(GROUPS)}.")
        # dm_control's manipulation tasks may be spelled in several ways; a run is named by one of them.
        named = [(task, get_domain(task)) for task in self.tasks]
        tasks = (d.task if task == d.name or d.source == "manipulation" else task for task, d in named)
        object.__setattr__(self, "tasks", tuple(dict.fromkeys(tasks)))
        for name in ("encoder_seeds", "seeds"):
            object.__setattr__(self, name, tuple(as_int(seed, name) for seed in getattr(self, name)))
        for name, given in (("encoder_seeds", self.encoder_seeds), ("seeds", self.downstream_seeds)):
            if not given or len(set(given)) != len(given) or not all(0 <= seed < SEEDS for seed in given):
                raise CRPTproError(f"`{name}` must be different numbers from 0 to {SEEDS - 1}, got {given}.")

    @property
    def downstream_seeds(self) -> tuple[int, ...]:
        """Seeds of the second level."""
        return self.seeds or tuple(range(self.scale.seeds))

    def chosen(self, usual: Iterable[str]) -> tuple[str, ...]:
        """Return the methods asked for, or the experiment's usual ones."""
        return self.methods or tuple(usual)

    def tasks_of(self, domains: Iterable[str]) -> list[str]:
        """Return the tasks asked for that are in these domains, or one of each domain."""
        domains = list(domains)
        if self.tasks:
            return [task for task in self.tasks if get_domain(task).name in domains]
        return [get_domain(domain).task for domain in domains]

    def groups_and_seeds(self, *usual: str) -> Iterator[tuple[str, int]]:
        """Yield every encoder seed of every group."""
        for group in self.groups or usual:
            for seed in self.encoder_seeds:
                yield group, seed


# --- jobs at a scale ------------------------------------------------------------------------------------------------


def method_of(system: str) -> Method | None:
    """Return the method that trains a system's encoder; ``None`` where none is pre-trained."""
    if system in (DRQ, RANDOM_ENCODER):
        return None
    return get_method("crptpro" if system in (NO_BONUS, FINETUNE) else system)


def explores(system: str) -> bool:
    """Whether a system's encoder is trained on what its own agents see."""
    method = method_of(system)
    return method is not None and method.exploration is not None


def is_single_domain(system: str) -> bool:
    """Whether a system has an encoder per domain because it cannot be trained on several: the (S) methods."""
    method = method_of(system)
    return method is not None and method.exploration is not None and method.exploration.is_single_domain


def disperses(system: str) -> bool:
    """Whether a system's loss has a dispersion term."""
    method = method_of(system)
    return method is not None and "intr_loss_coef" in _loss_defaults(method)


def dataset(scale: Scale, domain: str, seed: int, transitions: int | None = None) -> Job:
    """Return a domain's random dataset."""
    return collect_job(domain, transitions or scale.transitions, seed, quality=scale.quality)


def encoder(
    scale: Scale,
    method: str,
    domains: Iterable[str],
    seed: int,
    *,
    transitions: int | None = None,
    loss: Settings = NONE,
    explore: Settings = NONE,
    **settings: Any,
) -> Job:
    """Return the encoder that a method trains on domains.

    Args:
        scale: its budgets.
        method: a registered name, or a system's that has the encoder of one.
        domains: a single one for the (S) methods.
        seed: of data and training.
        transitions: of each domain, instead of the scale's.
        loss: options of the loss, instead of or besides the scale's.
        explore: settings of exploring, likewise.
        **settings: further ones of :func:`~crptpro.experiments.jobs.pretrain_job`.
    """
    registered = method_of(method)
    if registered is None or registered.loss_class is None:
        return untrained_job(seed)
    options = _departures(registered, {**scale.loss.get(registered.loss_class.__name__, {}), **loss})
    if registered.exploration is not None:
        exploring = {**scale.exploration(registered), **explore}
        return explore_job(
            registered, list(domains), seed, explore=exploring, training=scale.training(), loss=options
        )
    data = [dataset(scale, domain, seed, transitions) for domain in domains]
    training = {**scale.training(), **settings.pop("training", {})}
    usual = {"updates": scale.updates, "training": training, "loss": options}
    return pretrain_job(registered, data, seed, **{**usual, **settings})


def _loss_defaults(method: Method) -> dict[str, Any]:
    if method.loss_class is None:
        return {}
    return {name: each.default for name, each in inspect.signature(method.loss_class).parameters.items()}


def _departures(method: Method, options: Settings) -> dict[str, Any]:
    """Options of a loss without those that its method has anyway: they would make the same encoder another job."""
    usual = {**_loss_defaults(method), **method.loss_options}
    return {name: value for name, value in options.items() if name not in usual or usual[name] != value}


def encoder_for_task(
    scale: Scale, method: str, domains: Iterable[str], task: str, seed: int, **settings: Any
) -> Job | None:
    """Return the encoder that a task of a group is learned on; ``None`` for DrQ, which trains its own.

    The (S) methods have one per domain, and fine-tuning continues the group's on the task's domain.
    """
    if method == DRQ:
        return None
    domain = get_domain(task).name
    if method == FINETUNE:
        updates = scale.finetune_updates.get(domain, max(scale.finetune_updates.values()))
        base, data = encoder(scale, method, domains, seed, **settings), dataset(scale, domain, seed)
        return finetune_job(base, data, seed, updates=updates, training=scale.training())
    return encoder(scale, method, (domain,) if is_single_domain(method) else domains, seed, **settings)


def runs(
    request: Request,
    method: str,
    task: str,
    encoders: Mapping[int, Job | None],
    *,
    label: str = "",
    colors: str = "normal",
    **place: Any,
) -> list[Cell]:
    """Return the runs of a system on a task: every downstream seed on the encoder of every encoder seed.

    Where there is no encoder to share (DrQ), the encoder seeds count as further seeds of the run, so that every
    system has as many runs.
    """
    config = dict(request.scale.run)
    config |= {} if request.scale.quality == "exact" else {"quality": request.scale.quality}
    config |= {"intrinsic_reward_coef": 0} if method == NO_BONUS else {}
    if method == DRQ:
        config.pop("queue_size", None)  # it has no bonus
    if colors != "normal":
        config["colors"] = place["colors"] = colors
    found = []
    for encoder_seed, on in encoders.items():
        for seed in request.downstream_seeds:
            own = seed if on is not None else seed + SEEDS * encoder_seed
            job = downstream_job(task, on, own, config=config, name=NO_BONUS if method == NO_BONUS else "")
            where = {"task": task, "encoder_seed": encoder_seed, "seed": seed, **place}
            found.append(Cell(label or method, job, where))
    return found


def _of_group(
    request: Request, method: str, group: str, task: str, *, place: Settings = NONE, **settings: Any
) -> list[Cell]:
    """The runs of a system on a task of, or after, a group."""
    how = {name: settings.pop(name) for name in ("loss", "explore", "transitions") if name in settings}
    encoders = {
        seed: encoder_for_task(request.scale, method, GROUPS[group], task, seed, **how)
        for seed in request.encoder_seeds
    }
    return runs(request, method, task, encoders, group=group, **settings, **place)


def _domain_sets(request: Request, group: str, method: str) -> list[tuple[str, ...]]:
    """The domains of each encoder of a method: the group's, or, of an (S) method, one for each of those asked for."""
    if not is_single_domain(method):
        return [GROUPS[group]]
    asked = dict.fromkeys(get_domain(task).name for task in request.tasks)
    return [(domain,) for domain in asked if domain in GROUPS[group]] or [(SINGLE_DOMAIN[group],)]


def _measured(label: str, job: Job, group: str, seed: int, domains: Sequence[str]) -> Cell:
    return Cell(label, job, {"group": group, "domains": "+".join(domains), "encoder_seed": seed})


# --- experiments in downstream scores -------------------------------------------------------------------------------


def _seen(request: Request) -> list[Cell]:
    return [
        cell
        for group in request.groups or GROUPS
        for task in request.tasks_of(GROUPS[group])
        for method in request.chosen(METHODS)
        for cell in _of_group(request, method, group, task)
    ]


def _elsewhere(
    request: Request, rows: Mapping[str, Sequence[str]], colors: str = "normal", *, has_single: bool = False
) -> list[Cell]:
    """Encoders of groups on further tasks. Nothing is fine-tuned, and no encoder has seen a task's own domain."""
    return [
        cell
        for group, tasks in rows.items()
        if group in (request.groups or rows)
        for task in tasks
        if task in (request.tasks or tasks)
        for method in request.chosen(CROSS_DOMAIN)
        if method != FINETUNE and (has_single or not is_single_domain(method))
        for cell in _of_group(request, method, group, task, colors=colors)
    ]


def _unseen(request: Request) -> list[Cell]:
    return _elsewhere(request, UNSEEN_TASKS)


def _colors(request: Request) -> list[Cell]:
    return _elsewhere(request, COLORS_TASKS, request.colors, has_single=True)


def _finetune(request: Request) -> list[Cell]:
    return [
        cell
        for group in request.groups or ("A",)
        for task in request.tasks_of(FINETUNE_UPDATES)
        for method in request.chosen(("crptpro", FAST, FINETUNE, "proto-rl-s", "apt-s", DRQ))
        for cell in _of_group(request, method, group, task)
    ]


def _ablation(request: Request) -> list[Cell]:
    """Proto-RL(C) with the dispersion loss is CRPTpro without its decoupled collection."""
    found: list[Cell] = []
    for group in request.groups or ("A", "C"):
        for task in request.tasks_of(GROUPS[group]):
            for method in request.chosen(VARIANTS):
                explore, weight = NONE, DISPERSION["intr_loss_coef"]
                if is_single_domain(method):
                    domain = get_domain(task).name
                    if domain not in SINGLE_DISPERSION and not request.tasks:
                        continue  # the paper has two domains
                    explore, weight = request.scale.single_ablation, SINGLE_DISPERSION.get(domain, weight)
                for label, loss in VARIANTS.get(method, ((method, NONE),)):
                    own = {"intr_loss_coef": weight} if loss == DISPERSION else loss
                    found += _of_group(request, method, group, task, label=label, loss=own, explore=explore)
    return found


def _sensitivity(request: Request) -> list[Cell]:
    """The weight of the dispersion loss; methods without one have nothing to vary. Then the size of the datasets."""
    scale, found = request.scale, list[Cell]()
    for group in request.groups or ("A",):
        for task in request.tasks_of(GROUPS[group]):
            for method in request.chosen(("crptpro", "proto-rl-c")):
                for weight in sorted({0.0, 5e-3, *scale.alphas}) if disperses(method) else ():
                    found += _of_group(
                        request, method, group, task, label=f"{method}, alpha {weight:g}",
                        loss={"intr_loss_coef": weight}, place={"varied": "alpha", "value": f"{weight:g}"},
                    )  # fmt: skip
            for size in (
                sorted({*scale.capacities, scale.transitions}) if "crptpro" in request.chosen(METHODS) else ()
            ):
                found += _of_group(
                    request, "crptpro", group, task, label=f"crptpro, b {size:,}", transitions=size,
                    place={"varied": "b", "value": str(size)},
                )  # fmt: skip
    return found


# --- experiments that measure encoders ------------------------------------------------------------------------------


def _efficiency(request: Request) -> list[Cell]:
    scale, found = request.scale, []
    for group, seed in request.groups_and_seeds("A"):
        for method in (name for name in request.chosen(PRETRAINED) if name in PRETRAINED):
            for count in range(1, len(GROUPS[group]) + 1):
                domains = GROUPS[group][:count]
                sets = [(domain,) for domain in domains] if is_single_domain(method) else [domains]
                job = timing_job(
                    [encoder(scale, method, each, seed) for each in sets],
                    [encoder(PAPER, method, each, seed) for each in sets],
                    updates=scale.timing_updates,
                    paper_updates=scale.paper_timing_updates,
                    device=request.device,
                    threads=request.threads,
                )
                place = {"group": group, "domains": count, "encoder_seed": seed}
                found.append(
                    Cell(method, job, {**place, "device": request.device, "threads": request.threads})
                )
    return found


def _trained(
    request: Request, variants: Mapping[str, Sequence[tuple[str, Settings]]], measure: Callable[[Job], Job]
) -> list[Cell]:
    """Encoders of methods with prototypes, or what is measured of them."""
    return [
        _measured(
            label, measure(encoder(request.scale, method, domains, seed, loss=loss)), group, seed, domains
        )
        for group, seed in request.groups_and_seeds("A")
        for method in request.chosen(variants)
        if method in VARIANTS
        for domains in _domain_sets(request, group, method)
        for label, loss in variants.get(method, ((method, NONE),))
    ]


def _prototypes(request: Request) -> list[Cell]:
    return _trained(request, VARIANTS, prototypes_job)


def _stability(request: Request) -> list[Cell]:
    """Without the dispersion loss CRPTpro differs from Proto-RL(C) in its data alone."""
    variants = {"crptpro": VARIANTS["crptpro"], FAST: VARIANTS[FAST], "proto-rl-c": (("proto-rl-c", NONE),)}
    return _trained(request, variants, lambda trained: trained)


def _compared(request: Request, kind: str, groups: tuple[str, ...], method: str, samples: int) -> list[Cell]:
    """Random data beside an explorer's, as CRPTpro's encoder sees both: it was trained on all domains."""
    scale, found = request.scale, []
    for group, seed in request.groups_and_seeds(*groups):
        for explorer in filter(explores, request.chosen((method,))):
            for domains in _domain_sets(request, group, explorer):
                job = comparison_job(
                    kind,
                    encoder(scale, "crptpro", GROUPS[group], seed),
                    encoder(scale, explorer, domains, seed),
                    [
                        dataset(scale, name, seed)
                        for name in (domains if kind == "coverage" else GROUPS[group])
                    ],
                    samples=samples,
                    seed=seed,
                )
                found.append(_measured(explorer, job, group, seed, domains))
    return found


def _coverage(request: Request) -> list[Cell]:
    return _compared(request, "coverage", ("A",), "proto-rl-c", request.scale.coverage_samples)


def _visualize(request: Request) -> list[Cell]:
    return _compared(request, "embeddings", ("B", "C"), "proto-rl-s", request.scale.embedded_samples)


def _probe(request: Request) -> list[Cell]:
    """Tasks of the request choose the domains; an (S) method's one encoder is probed on all of them, too."""
    scale, found = request.scale, []
    for group, seed in request.groups_and_seeds("A"):
        asked = tuple(dict.fromkeys(get_domain(task).name for task in request.tasks))
        for method in request.chosen((*PRETRAINED, RANDOM_ENCODER)):
            for domain in asked or (*GROUPS[group], *PROBED_UNSEEN[group]):
                home = domain if method == FINETUNE else SINGLE_DOMAIN[group]
                trained = encoder_for_task(scale, method, GROUPS[group], get_domain(home).task, seed)
                if trained is None or method == NO_BONUS:
                    continue  # no encoder of its own
                data = dataset(scale, domain, seed, scale.probe_transitions)
                job = probe_job(trained, data, samples=scale.probe_samples)
                place = {"group": group, "domain": domain, "colors": "normal", "encoder_seed": seed}
                found.append(Cell(method, job, place))
    return found


# --- the study of CRPTpro's pre-training ----------------------------------------------------------------------------

SNAPSHOTS, FACTOR_SNAPSHOTS = (500, 1_000, 2_000, 3_000, 5_000, 10_000, 20_000), (1_000,)
"""Updates after which the encoders of full-length trials, and those of the factors, are probed besides at their end."""
_SHARP, _LARGE_RATE = {"loss": {"assignment_temperature": 0.05}}, {"training": {"learning_rate": 3e-4}}
TRIALS: dict[str, dict[str, dict[str, Any]]] = {
    "assignment_temperature": {"0.1": {}, "0.05": _SHARP},
    "learning_rate_and_temperature": {
        "1e-4 and 0.1": {},
        "1e-4 and 0.05": _SHARP,
        "3e-4 and 0.05": {**_LARGE_RATE, **_SHARP},
        "3e-4 and 0.1": _LARGE_RATE,
    },
}
"""Trials of full length, on two groups and two encoder seeds, the usual setting first."""


def factors_of(scale: Scale) -> list[tuple[str, str, float, tuple[float, ...]]]:
    """Return what is varied alone: name, the setting of an encoder that holds it, the usual value, and all values."""
    loss, usual = _study_loss(scale), get_method("crptpro")
    prototypes, width = loss.get("num_prototypes", 512), loss.get("hidden_dim", 1_024)
    batch = scale.batch_size or usual.batch_size
    return [
        (
            "num_prototypes",
            "loss",
            prototypes,
            (prototypes // 4, prototypes // 2, prototypes, 2 * prototypes),
        ),
        ("batch_size", "training", batch, (batch // 2, batch, 2 * batch)),
        ("hidden_dim", "loss", width, (width // 2, width, 2 * width)),
        ("pixel_offset", "encoder", 0.0, (0.0, 0.5)),
        ("encoder_tau", "training", 0.05, (0.01, 0.05, 0.2)),
        ("learning_rate", "training", usual.learning_rate, (5e-5, 1e-4, 3e-4)),
        ("warmup_updates", "training", 0, (0, min(500, max(1, scale.updates // 6)))),
        # The largest makes up for the mean over all pairs, whose gradient is about 10,000 times weaker than the
        # comparison's.
        ("intr_loss_coef", "loss", 5e-3, (0.0, 5e-3, 0.5, 50.0)),
    ]


def _study_loss(scale: Scale) -> dict[str, Any]:
    own = {} if scale.study_prototypes is None else {"num_prototypes": scale.study_prototypes}
    return {**scale.loss.get("ProtoLoss", {}), **own}


def _study(request: Request) -> list[Cell]:
    """Every encoder is judged by the state probe, along its training and at its end; full-length ones by a run, too."""
    if "crptpro" not in request.chosen(("crptpro",)):
        return []
    scale, (first, *more), found = request.scale, request.encoder_seeds, list[Cell]()
    full = scale.study_updates or scale.updates
    seeds = (first, *(more or (first + 1,)))  # one run tells nothing of a difference
    for factor, variants in TRIALS.items():
        for group in request.groups or ("A", "C"):
            for seed in seeds:
                for value, changed in variants.items():
                    place: dict[str, Any] = {
                        "factor": factor,
                        "value": value,
                        "usual": next(iter(variants)),
                        "group": group,
                    }
                    found += _trial(request, place, seed, full, SNAPSHOTS, changed, has_run=True)
                found += _control(request, group, seed)
    group = (request.groups or ("A",))[0]
    for name, where, usual, values in factors_of(scale):
        for number in values:
            changed = {} if number == usual else {where: {name: number}}
            place = {"factor": name, "value": f"{number:g}", "usual": f"{usual:g}", "group": group}
            found += _trial(request, place, first, scale.updates, FACTOR_SNAPSHOTS, changed)
    found += _control(request, group, first)
    return list({(cell.label, cell.job, tuple(cell.place.items())): cell for cell in found}.values())


def _trial(
    request: Request,
    place: dict[str, Any],
    seed: int,
    updates: int,
    snapshots: tuple[int, ...],
    changed: Mapping[str, Any],
    *,
    has_run: bool = False,
) -> list[Cell]:
    scale, group = request.scale, place["group"]
    # At least one snapshot, half-way, where the scale has fewer updates than the first.
    kept = tuple(done for done in snapshots if done < updates) or (max(1, updates // 2),)
    loss = {**_study_loss(scale), **changed.get("loss", {})}
    settings = {name: changed[name] for name in ("training", "encoder") if name in changed}
    trained = encoder(
        scale, "crptpro", GROUPS[group], seed, loss=loss, updates=updates, snapshots=kept, **settings
    )
    label, where = f"crptpro, {place['factor']} {place['value']}", {**place, "encoder_seed": seed}
    found = [Cell(label, trained, where)]
    for at_updates in (*kept, None):
        found += _probes(scale, label, trained, {**where, "updates": at_updates or updates}, at_updates)
    task = get_domain(SINGLE_DOMAIN[group]).task
    if has_run and task in (request.tasks or (task,)):
        found += runs(
            replace(request, seeds=request.seeds or (0,)),
            "crptpro",
            task,
            {seed: trained},
            label=label,
            **place,
        )
    return found


def _control(request: Request, group: str, seed: int) -> list[Cell]:
    if RANDOM_ENCODER not in request.chosen(("crptpro", RANDOM_ENCODER)):
        return []
    where = {"factor": "control", "value": "untrained", "group": group, "encoder_seed": seed, "updates": 0}
    return _probes(request.scale, RANDOM_ENCODER, untrained_job(seed), where)


def _probes(
    scale: Scale, label: str, trained: Job, where: dict[str, Any], at_updates: int | None = None
) -> list[Cell]:
    """Probes on the group's domains and one more, on the data of the encoder's seed."""
    found = []
    for domain in (*GROUPS[where["group"]], PROBED_UNSEEN[where["group"]][0]):
        data = dataset(scale, domain, where["encoder_seed"], scale.probe_transitions)
        job = probe_job(trained, data, samples=scale.probe_samples, at_updates=at_updates)
        found.append(Cell(label, job, {**where, "domain": get_domain(domain).name}))
    return found


@dataclass(frozen=True)
class Experiment:
    """One of the commands ``crptpro reproduce NAME``.

    Args:
        title: heading.
        summary: what it asks, and where the paper has it.
        cells: what a request makes of it.
    """

    title: str
    summary: str
    cells: Callable[[Request], list[Cell]]


EXPERIMENTS: dict[str, Experiment] = {
    "seen": Experiment(
        "Tasks of seen domains",
        "Tasks of the domains that the encoder was pre-trained on, for every method (section IV.B).",
        _seen,
    ),
    "unseen": Experiment(
        "Tasks of unseen domains",
        "Tasks of domains that the encoder never saw, without fine-tuning (section IV.C).",
        _unseen,
    ),
    "colors": Experiment(
        "Reversed background colours",
        "Tasks with the colours of the background reversed, without fine-tuning (section IV.C). The paper does not say "
        "how it reverses them; whole images are the option.",
        _colors,
    ),
    "finetune": Experiment(
        "Fine-tuning on one domain",
        "The encoder of group A trained further on one domain, beside single-domain methods and DrQ (section IV.D).",
        _finetune,
    ),
    "ablation": Experiment(
        "Ablation: dispersion loss, decoupled collection",
        "With and without the dispersion loss, with and without decoupled collection (section IV.F).",
        _ablation,
    ),
    "sensitivity": Experiment(
        "Sensitivity: weight of the dispersion loss, amount of data",
        "The weight alpha of the dispersion loss, and the capacity b of the random datasets (section IV.F).",
        _sensitivity,
    ),
    "efficiency": Experiment(
        "Cost of pre-training",
        "Wall clock and encoder updates of pre-training for one, two and three domains (section IV.E), projected from "
        "a timed part.",
        _efficiency,
    ),
    "prototypes": Experiment(
        "Spread of the prototypes",
        "How far prototypes spread, along pre-training and at its end, with and without the dispersion loss (section "
        "IV.G).",
        _prototypes,
    ),
    "coverage": Experiment(
        "Coverage of the data",
        "How widely random data and an explorer's are spread along pre-training (section IV.H).",
        _coverage,
    ),
    "stability": Experiment(
        "Stability of pre-training",
        "The comparative loss along pre-training on random data and on an explorer's (section IV.H).",
        _stability,
    ),
    "visualize": Experiment(
        "Embeddings of random data and of an explorer's",
        "Principal components of random data of three domains and of an explorer's in one of them (section IV.H).",
        _visualize,
    ),
    "probe": Experiment(
        "State probe",
        "What a linear model reads of the simulator's state from frozen features: seen and unseen domains, normal and "
        "other colours. Not in the paper.",
        _probe,
    ),
    "study": Experiment(
        "One-factor study of pre-training",
        "The temperature of the targets, and one factor at a time, judged by the state probe along pre-training and by "
        "reinforcement learning. At scale small its encoders have the paper's 512 prototypes, and those of full length "
        "10,000 updates. Not in the paper.",
        _study,
    ),
}
"""In the order of the paper; what it does not have comes last."""
