"""The experiments of the paper at each scale: the cells of its tables, and the job behind each cell."""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, NamedTuple

from crptpro.data.collect import dataset_path
from crptpro.domains import GROUPS, TASKS, get_domain
from crptpro.envs import resolve_action_repeat
from crptpro.errors import CRPTproError, UnknownNameError
from crptpro.experiments.jobs import OWN, Job, options, plugins_digest
from crptpro.experiments.published import COLORS, FINETUNE_UPDATES, UNSEEN, ScoreRow
from crptpro.objectives import Method, get_method
from crptpro.objectives.methods import DOWNSTREAM
from crptpro.seeding import derive_seed
from crptpro.training.explore import ExploreConfig, plan_exploration

Settings = Mapping[str, Any]
NONE: Settings = {}

FAST, NO_BONUS, FINETUNE, DRQ = "crptpro-fast", "crptpro-no-bonus", "crptpro-finetune", "drq"
RANDOM, STANDARDISED = "random-encoder", "random-encoder-standardised"
METHODS = (
    "crptpro", FAST, NO_BONUS, FINETUNE, "proto-rl-c", "proto-rl-s", "atc", "apt-c", "apt-s", "becl", DRQ,
    RANDOM, STANDARDISED,
)  # fmt: skip
"""Every system of the comparison, in the order of tables."""
PRETRAINED = ("crptpro", FAST, "proto-rl-c", "proto-rl-s", "atc", "apt-c", "apt-s", "becl")
"""Systems with a pre-training of their own."""
CROSS_DOMAIN = ("crptpro", FAST, "proto-rl-c", "atc", "apt-c", "becl", RANDOM)
"""Systems with one encoder for several domains, and the untrained control."""

DISPERSION, NO_DISPERSION = {"intr_loss_coef": 5e-3}, {"intr_loss_coef": 0.0}
VARIANTS: dict[str, tuple[tuple[str, Settings], ...]] = {
    "crptpro": (("crptpro", NONE), ("crptpro without dispersion", NO_DISPERSION)),
    FAST: ((FAST, NONE),),
    "proto-rl-c": (("proto-rl-c with dispersion", DISPERSION), ("proto-rl-c", NONE)),
    "proto-rl-s": (("proto-rl-s with dispersion", DISPERSION), ("proto-rl-s", NONE)),
}
"""Methods with prototypes, those of the paper with and without the dispersion loss: label and options of the loss."""
SINGLE_DISPERSION = {"cheetah": 1e-3, "hopper": 5e-4}
"""Proto-RL(S)'s weight of the dispersion loss in the paper's ablation, which has these two domains."""
SINGLE_DOMAIN = {"A": "walker", "B": "pendulum", "C": "finger", "D": "walker"}
"""The domain of a group on which an (S) method trains where one encoder is enough; B's and C's are the paper's."""
PROBED_UNSEEN = {
    "A": ("finger", "pendulum"), "B": ("finger", "walker"), "C": ("walker", "pendulum"), "D": ("cheetah", "finger"),
}  # fmt: skip
"""Domains outside a group on which its encoders are probed."""

SEEDS = 1_000  # bound on the seeds of each level, so that DrQ's seeds, which combine both levels, all differ


@dataclass(frozen=True)
class Scale:
    """Every budget of every experiment; the defaults are the paper's."""

    name: str
    transitions: int = 100_000  # random transitions per domain
    quality: str | None = None  # render quality of datasets; ``None`` for the exact one
    updates: int = 50_000  # encoder updates on datasets, over all domains
    training: Settings = field(default_factory=dict)  # settings of every encoder's training
    loss: Mapping[str, Settings] = field(default_factory=dict)  # options of losses, by name of their class
    # settings of exploring, with the encoder update interval of a method that makes one update each time
    explore: Settings = field(default_factory=dict)
    explore_single: Settings = field(default_factory=dict)  # further ones of the (S) methods
    # further ones of the (S) methods in ``ablation`` and ``prototypes``
    single_ablation: Settings = field(default_factory=dict)
    run: Settings = field(default_factory=dict)  # settings of every downstream run
    seeds: int = 3  # downstream runs on each encoder by default
    alphas: tuple[float, ...] = (5e-4, 5e-2, 5e-1)  # of ``sensitivity``, besides none and the method's own
    capacities: tuple[int, ...] = (10_000, 50_000, 100_000)  # of ``sensitivity``, random transitions per domain
    probe_samples: int = 4_000  # observations of a state probe
    probe_transitions: int | None = None  # of a dataset that is probed, if not ``transitions``
    timing_updates: int = 100  # encoder updates that ``efficiency`` times, after as many to warm up
    paper_timing_updates: int = 0  # the same with the paper's batches and intervals; 0 for none
    coverage_samples: int = 1_024  # observations of a coverage estimate
    embedded_samples: int = 125  # observations of each source in ``visualize``


PAPER = Scale("paper", single_ablation={"env_steps": 200_000})
SMALL = Scale(
    "small",
    transitions=20_000,
    updates=3_000,
    training={"batch_size": 128},
    # As many prototypes as rows, as in the paper (512 of both): with more, most rows are their own nearest candidates
    # and the prototype reward is 0.
    loss={"ProtoLoss": {"num_prototypes": 128}},
    # 20,000 agent steps and, after the random ones, as many encoder updates as the methods on random data have.
    explore={
        "env_steps": 40_000, "checkpoint_interval_env_steps": 2_000, "encoder_update_interval": 6,
        "random_agent_steps": 667,
    },
    explore_single={"random_agent_steps": 2_000},
    run={
        "env_steps": 20_000, "batch_size": 128, "learning_rate": 1e-3, "replay_capacity": 12_000,
        "checkpoint_interval_env_steps": 2_000,
    },
    seeds=2,
    capacities=(5_000, 20_000),
    probe_samples=2_000,
    timing_updates=25,
    paper_timing_updates=7,  # about as many transitions
    coverage_samples=512,
)  # fmt: skip
"""A fifth of the data, 6 % of the updates, 4 % of the env steps, a quarter of the batch."""
TINY = Scale(
    "tiny",
    transitions=130,  # an episode of manipulation has 125
    quality="fast",
    updates=6,
    training={"batch_size": 4},
    loss={
        "ProtoLoss": {"num_prototypes": 16, "latent_dim": 8, "hidden_dim": 16}, "ATCLoss": {"latent_dim": 8},
        "SimCLRLoss": {"latent_dim": 8}, "BeCLLoss": {"hidden_dim": 16},
    },
    explore={
        "env_steps": 120, "random_agent_steps": 8, "hidden_dim": 16, "queue_size": 32,
        "checkpoint_interval_env_steps": 60, "encoder_update_interval": 2, "quality": "fast",
    },
    run={
        "env_steps": 60, "random_agent_steps": 12, "batch_size": 4, "replay_capacity": 40, "hidden_dim": 16,
        "queue_size": 32, "eval_interval_env_steps": 60, "eval_episodes": 1, "checkpoint_interval_env_steps": 30,
        "log_interval_env_steps": 10, "quality": "fast",
    },
    seeds=1,
    alphas=(5e-2,),
    capacities=(130,),  # equal to ``transitions``: no further data
    probe_samples=60,
    probe_transitions=1_100,  # three episodes; one has 500 agent steps
    timing_updates=2,
    coverage_samples=32,
    embedded_samples=8,
)  # fmt: skip
"""Takes minutes and only shows that everything runs."""
SCALES: dict[str, Scale] = {scale.name: scale for scale in (TINY, SMALL, PAPER)}


class Cell(NamedTuple):
    """One number of an experiment."""

    label: str  # the system or variant, a row of the tables: "crptpro", "proto-rl-c with dispersion"
    job: Job  # that produces it
    place: Settings  # such as {"group": "A", "task": "walker_run", "encoder_seed": 0, "seed": 0}


@dataclass(frozen=True)
class Request:
    """The requested part of an experiment, and its scale; an empty field is the experiment's own choice.

    Encoder seeds are the first level (collection, exploration, pre-training), seeds the second: downstream runs on each
    encoder. Device and threads matter only to timings, whose jobs are alone on their machine. An unknown name raises
    an ``UnknownNameError``; a repeated or missing seed, or one outside [0, :data:`SEEDS`), a ``CRPTproError``.
    """

    scale: Scale
    methods: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    tasks: tuple[str, ...] = ()
    encoder_seeds: tuple[int, ...] = (0,)
    seeds: tuple[int, ...] = ()
    device: str = "cpu"
    threads: int = 1

    def __post_init__(self) -> None:
        """Refuse unknown names; a domain's name becomes that of its task."""
        for method in self.methods:
            get_method(method)
        for group in self.groups:
            if group not in GROUPS:
                raise UnknownNameError(f"There is no group {group!r}; choose from {', '.join(GROUPS)}.")
        tasks = [get_domain(task).task for task in self.tasks]
        for name, values in {"methods": self.methods, "groups": self.groups, "tasks": tasks}.items():
            object.__setattr__(self, name, tuple(dict.fromkeys(values)))
        object.__setattr__(self, "seeds", self.seeds or tuple(range(self.scale.seeds)))
        for name in ("encoder_seeds", "seeds"):
            seeds = getattr(self, name)
            if not seeds or len(set(seeds)) != len(seeds) or not all(0 <= seed < SEEDS for seed in seeds):
                raise CRPTproError(f"`{name}` must be different numbers from 0 to {SEEDS - 1}, got {seeds}.")

    def tasks_in(self, domains: Collection[str]) -> list[str]:
        """Return the requested tasks of these domains; without requested tasks, one task of each domain."""
        tasks = self.tasks or [get_domain(domain).task for domain in domains]
        return [task for task in tasks if get_domain(task).name in domains]

    def seen_tasks(self, groups: Iterable[str]) -> list[tuple[str, str]]:
        """Return group and task for each requested group, or each of these, and each of its tasks."""
        return [(group, task) for group in self.groups or groups for task in self.tasks_in(GROUPS[group])]

    def encoders(
        self, systems: Iterable[str], groups: Iterable[str] = "A"
    ) -> Iterator[tuple[str, tuple[str, ...], dict[str, Any]]]:
        """Yield system, domains and place of each encoder.

        An (S) method has one encoder per requested domain of the group, or that of :data:`SINGLE_DOMAIN`.
        """
        requested = dict.fromkeys(get_domain(task).name for task in self.tasks)
        for group, seed, system in product(self.groups or groups, self.encoder_seeds, self.methods or systems):
            sets = [GROUPS[group]]
            if is_single_domain(system):
                sets = [(domain,) for domain in requested if domain in GROUPS[group]] or [(SINGLE_DOMAIN[group],)]
            for domains in sets:
                yield system, domains, {"group": group, "domains": "+".join(domains), "encoder_seed": seed}


# --- jobs at a scale ------------------------------------------------------------------------------------------------


def pretraining_of(system: str) -> Method:
    """Return the method that trains a system's encoder, or whose encoder it starts from."""
    method = get_method(system)
    return method if method.starts_from is None else get_method(method.starts_from)


def is_single_domain(system: str) -> bool:
    """Whether a system needs an encoder per domain: the (S) methods."""
    exploration = pretraining_of(system).exploration
    return exploration is not None and exploration.is_single_domain


def _loss_defaults(method: Method) -> dict[str, Any]:
    if method.loss_class is None:
        return {}
    return {name: each.default for name, each in inspect.signature(method.loss_class).parameters.items()}


def _definition(*domains: str, method: Method | None = None) -> str:
    is_own = method is not None and not method.is_builtin
    return plugins_digest() if is_own or any(get_domain(each).source == "own" for each in domains) else ""


def _encoder_of(job: Job) -> str:
    return f"{{{job.key}}}/encoder"


def _dataset_of(job: Job) -> str:
    return str(dataset_path(f"{{{job.key}}}", job.facts["domain"]))


def dataset(scale: Scale, domain: str, seed: int, transitions: int | None = None) -> Job:
    """Return the job that collects a domain's random transitions, in ``<job>/<domain>``."""
    name, transitions = get_domain(domain).name, transitions or scale.transitions
    command = ["collect", name, "--out", OWN, *options(transitions=transitions, seed=seed, quality=scale.quality)]
    facts = {"domain": name, "transitions": transitions, "seed": seed, "quality": scale.quality or "exact"}
    facts["env_steps"] = transitions * resolve_action_repeat(name, None)
    return Job("dataset", f"{name} seed {seed}", tuple(command), facts, definition=_definition(name))


def encoder(scale: Scale, system: str, domains: Iterable[str], seed: int, *, loss: Settings = NONE) -> Job:
    """Return the job of a system's encoder for domains, ``<job>/encoder``; ``loss`` replaces options of the scale."""
    method = pretraining_of(system)
    names = [get_domain(domain).name for domain in domains]
    title = f"{method.name} {'+'.join(names)} seed {seed}"
    where = ["--method", method.name, "--out", OWN]
    facts: dict[str, Any] = {"method": method.name, "seed": seed}
    needs_data = method.exploration is None if method.loss_class else system == STANDARDISED
    data = tuple(dataset(scale, name, seed) for name in names if needs_data)
    if method.loss_class is None:
        command = ["pretrain", *map(_dataset_of, data), *where, *options(seed=seed)]
        return Job("untrained", title if data else f"seed {seed}", tuple(command), facts, data)
    # A default of the method's loss is left out: as an option it would make another job of the same encoder.
    defaults = {**_loss_defaults(method), **method.loss_options}
    chosen = {**scale.loss.get(method.loss_class.__name__, {}), **loss}
    settings = {"loss": {k: v for k, v in chosen.items() if k not in defaults or defaults[k] != v}, **scale.training}
    facts |= {"domains": names, **settings}
    if method.exploration is None:
        # At the paper's scale a method has its own budget.
        updates = method.updates if scale.updates == PAPER.updates else scale.updates
        facts |= {"updates": updates, "transitions": scale.transitions}
        command = ["pretrain", *map(_dataset_of, data), *where]
        command += options(seed=seed, updates=updates, **settings)
        return Job("encoder", title, tuple(command), facts, data, _definition(method=method))
    exploring = {**scale.explore, **(scale.explore_single if method.exploration.is_single_domain else {})}
    if "encoder_update_interval" in exploring:
        exploring["encoder_update_interval"] *= method.exploration.encoder_updates_each
    config = ExploreConfig(**exploring)
    plan = plan_exploration(method, names, config)
    facts |= {"explore": exploring, "env_steps": plan.env_steps, "decisions": plan.decisions}
    facts |= {"updates": plan.encoder_updates, "replay_capacity": config.resolved(method).replay_capacity}
    command = ["pretrain", *names, *where, *options(seed=seed, **settings, **exploring)]
    return Job("explored", title, tuple(command), facts, (), _definition(*names, method=method))


def encoder_for_task(
    scale: Scale, system: str, domains: Iterable[str], task: str, seed: int, **settings: Any
) -> Job | None:
    """Return a system's encoder for a task of a group; ``None`` for DrQ, which trains its own.

    The (S) methods have one per domain; fine-tuning trains the group's encoder further on the task's domain.
    """
    domain = get_domain(task).name
    if system == DRQ:
        return None
    base = encoder(scale, system, (domain,) if is_single_domain(system) else domains, seed, **settings)
    if system != FINETUNE:
        return base
    data = dataset(scale, domain, seed)
    updates = max(2, FINETUNE_UPDATES.get(domain, 3_000) * scale.updates // PAPER.updates)  # in proportion
    command = ["finetune", _encoder_of(base), _dataset_of(data), "--out", OWN]
    command += options(seed=seed, updates=updates, **scale.training)
    facts = {"method": FINETUNE, "domains": [domain], "seed": seed, "updates": updates, **scale.training}
    return Job("finetuned", f"{FINETUNE} on {domain} seed {seed}", tuple(command), facts, (base, data))


def run(scale: Scale, system: str, task: str, base: Job | None, seed: int, *, colors: str = "normal") -> Job:
    """Return a system's downstream run on a task; the job's directory is the run directory.

    ``base`` is the frozen encoder, or ``None`` for DrQ. Runs of several tasks with one seed share nothing else.
    """
    config = dict(scale.run)
    if system == NO_BONUS:
        config["intrinsic_reward_coef"] = 0
    if colors != "normal":
        config["colors"] = colors
    if base is None:
        config.pop("queue_size", None)  # DrQ has no bonus
    method = system if base is None or system == NO_BONUS else base.facts["method"]
    facts: dict[str, Any] = {"method": method, **DOWNSTREAM, **get_method(method).downstream, **config}
    facts |= {"task": task, "domain": get_domain(task).name, "seed": seed, "colors": colors}
    by = ""
    if base is not None:
        facts["encoder_seed"] = base.facts["seed"]
        by = f" encoder {base.facts['seed']}"
    command = ["downstream", task, "--pretrained", DRQ if base is None else _encoder_of(base), "--out", OWN]
    command += options(seed=derive_seed(seed, "task", task), **config)
    title = f"{task}{'' if colors == 'normal' else f' {colors}'} {method}{by} seed {seed}"
    needs = () if base is None else (base,)
    return Job("run", title, tuple(command), facts, needs, _definition(task))


def probe(scale: Scale, base: Job, data: Job) -> Job:
    """Return the state probe of an encoder on a domain, ``<job>/probe.csv``."""
    command = ["probe", _encoder_of(base), _dataset_of(data), "--csv", f"{OWN}/probe.csv"]
    command += options(samples=scale.probe_samples, seed=0)
    facts = {"method": base.facts["method"], "encoder_seed": base.facts["seed"], "domain": data.facts["domain"]}
    title = "{method} seed {encoder_seed} on {domain}".format(**facts)
    return Job("probe", title, tuple(command), facts, (base, data))


def comparison(kind: str, base: Job, explorer: Job, datasets: Sequence[Job], *, samples: int, seed: int) -> Job:
    """Return a comparison of an explorer's data with random data: ``coverage`` or ``embeddings``."""
    replays = [str(dataset_path(f"{{{explorer.key}}}/replay", domain)) for domain in explorer.facts["domains"]]
    command = ["measure", kind, "--encoder", _encoder_of(base), "--explorer", _encoder_of(explorer)]
    command += ["--replays", *replays, "--datasets", *map(_dataset_of, datasets), "--out", OWN]
    command += options(samples=samples, seed=seed)
    facts = {name: explorer.facts[name] for name in ("method", "domains", "seed")}
    title = f"{facts['method']} {'+'.join(facts['domains'])} seed {facts['seed']}"
    needs = tuple(dict.fromkeys([base, explorer, *datasets]))
    return Job(kind, title, tuple(command), {**facts, "samples": samples}, needs)


def timing(request: Request, system: str, domain_sets: Sequence[Sequence[str]], seed: int) -> Job:
    """Return the timing of encoders' training, ``<job>/timing.csv``: of one, or of several whose costs add up."""
    scale = request.scale
    where = {"device": request.device, "threads": request.threads}
    command = ["measure", "timing", "--out", OWN]
    command += options(updates=scale.timing_updates, paper_updates=scale.paper_timing_updates, **where)
    # The content of the data does not change the time: the paper's training is timed on this scale's.
    paper = replace(PAPER, transitions=scale.transitions, quality=scale.quality)
    trainings = [encoder(scale, system, domains, seed) for domains in domain_sets]
    for training, domains in zip(trainings, domain_sets):
        for option, job in {"--training": training, "--paper-training": encoder(paper, system, domains, seed)}.items():
            at = job.command.index("--out")
            command += [option, shlex.join(job.command[:at] + job.command[at + 2 :])]
    names = [domain for domains in domain_sets for domain in domains]
    facts = {"method": trainings[0].facts["method"], "domains": names, "seed": seed, **where}
    needs = tuple(dict.fromkeys(needed for training in trainings for needed in training.needs))
    title = f"{facts['method']} {'+'.join(names)} {request.device} {request.threads}"
    return Job("timing", title, tuple(command), facts, needs)


# --- experiments ----------------------------------------------------------------------------------------------------


class Experiment(NamedTuple):
    """One of the commands ``crptpro reproduce NAME``: heading, question, and the cells of a request."""

    title: str
    summary: str
    cells: Callable[[Request], list[Cell]]


EXPERIMENTS: dict[str, Experiment] = {}  # in the order of the paper; further ones come last


def _experiment(title: str) -> Callable[[Callable[[Request], Iterator[Cell]]], None]:
    """Register a function as the experiment of its name; its docstring is the summary."""

    def register(cells: Callable[[Request], Iterator[Cell]]) -> None:
        summary = " ".join((cells.__doc__ or "").split())
        EXPERIMENTS[cells.__name__.strip("_")] = Experiment(title, summary, lambda request: list(cells(request)))

    return register


def _scores(
    request: Request, group: str, task: str, system: str, *, label: str = "", place: Settings = NONE, **how: Any
) -> Iterator[Cell]:
    """Yield the runs of a system on a task with a group's encoders: every downstream seed on every encoder.

    Where there is no encoder to share (DrQ), the encoder seeds count as further seeds of the run, so that every
    system has as many runs.
    """
    for encoder_seed in request.encoder_seeds:
        base = encoder_for_task(request.scale, system, GROUPS[group], task, encoder_seed, **how)
        for seed in request.seeds:
            own = seed if base is not None else seed + SEEDS * encoder_seed
            job = run(request.scale, system, task, base, own, colors=place.get("colors", "normal"))
            where = {"group": group, "task": task, **place, "encoder_seed": encoder_seed, "seed": seed}
            yield Cell(label or system, job, where)


def _table(request: Request, tasks: Iterable[tuple[str, str]], systems: Iterable[str], **how: Any) -> Iterator[Cell]:
    """Yield the runs of all systems on tasks, each with its group."""
    for (group, task), system in product(tasks, systems):
        yield from _scores(request, group, task, system, **how)


def _paper_rows(request: Request, rows: Iterable[ScoreRow], systems: Iterable[str], **how: Any) -> Iterator[Cell]:
    """Yield the runs on the requested rows of a table of the paper; no encoder is fine-tuned on them."""
    groups, tasks = request.groups or GROUPS, request.tasks or TASKS
    wanted = [(row.group, row.task) for row in rows if row.group in groups and row.task in tasks]
    return _table(request, wanted, [system for system in systems if system != FINETUNE], **how)


@_experiment("Tasks of seen domains")
def _seen(request: Request) -> Iterator[Cell]:
    """Tasks of the domains that the encoder was pre-trained on, for every method (section IV.B)."""
    return _table(request, request.seen_tasks(GROUPS), request.methods or METHODS)


@_experiment("Tasks of unseen domains")
def _unseen(request: Request) -> Iterator[Cell]:
    """Tasks of domains that the encoder never saw, without fine-tuning (section IV.C)."""
    systems = [system for system in request.methods or CROSS_DOMAIN if not is_single_domain(system)]
    return _paper_rows(request, UNSEEN, systems)


@_experiment("Reversed background colours")
def _colors(request: Request) -> Iterator[Cell]:
    """Tasks with the colours of the background reversed, without fine-tuning (section IV.C).

    The paper exchanges their RGB values and does not say what the background is.
    """
    return _paper_rows(request, COLORS, request.methods or CROSS_DOMAIN, place={"colors": "reversed_background"})


@_experiment("Fine-tuning on one domain")
def _finetune(request: Request) -> Iterator[Cell]:
    """The encoder of group A trained further on one domain, beside single-domain methods and DrQ (section IV.D)."""
    tasks = product(request.groups or "A", request.tasks_in(FINETUNE_UPDATES))
    return _table(request, tasks, request.methods or ("crptpro", FAST, FINETUNE, "proto-rl-s", "apt-s", DRQ))


def _ablated(request: Request) -> Request:
    """Return the request with the budgets that the (S) methods have in the paper's ablation."""
    scale = request.scale
    return replace(request, scale=replace(scale, explore_single={**scale.explore_single, **scale.single_ablation}))


def _variants(system: str, domain: str) -> Iterator[tuple[str, Settings]]:
    """Yield label and options of a system's variants; the dispersion loss of an (S) method is weighted by domain."""
    for label, loss in VARIANTS.get(system, ((system, NONE),)):
        if loss == DISPERSION and is_single_domain(system):
            loss = {"intr_loss_coef": SINGLE_DISPERSION.get(domain, DISPERSION["intr_loss_coef"])}
        yield label, loss


@_experiment("Ablation: dispersion loss, decoupled collection")
def _ablation(request: Request) -> Iterator[Cell]:
    """With and without the dispersion loss, with and without decoupled collection (section IV.F)."""
    # Proto-RL(C) with the dispersion loss is CRPTpro without its decoupled collection.
    for (group, task), system in product(request.seen_tasks("AC"), request.methods or VARIANTS):
        domain = get_domain(task).name
        if is_single_domain(system) and domain not in SINGLE_DISPERSION and not request.tasks:
            continue  # the paper has two domains
        for label, loss in _variants(system, domain):
            yield from _scores(_ablated(request), group, task, system, label=label, loss=loss)


@_experiment("Sensitivity: weight of the dispersion loss, amount of data")
def _sensitivity(request: Request) -> Iterator[Cell]:
    """The weight alpha of the dispersion loss, and the capacity b of the random datasets (section IV.F)."""
    scale = request.scale
    methods = request.methods or ("crptpro", "proto-rl-c")
    for group, task in request.seen_tasks("A"):
        for system in methods:
            if "intr_loss_coef" not in _loss_defaults(pretraining_of(system)):
                continue
            for alpha in sorted({0.0, 5e-3, *scale.alphas}):
                loss, place = {"intr_loss_coef": alpha}, {"varied": "alpha", "value": f"{alpha:g}"}
                label = f"{system}, alpha {alpha:g}"
                yield from _scores(request, group, task, system, label=label, loss=loss, place=place)
        for size in sorted({*scale.capacities, scale.transitions}) if "crptpro" in methods else ():
            other, place = replace(request, scale=replace(scale, transitions=size)), {"varied": "b", "value": str(size)}
            yield from _scores(other, group, task, "crptpro", label=f"crptpro, b {size:,}", place=place)


@_experiment("Cost of pre-training")
def _efficiency(request: Request) -> Iterator[Cell]:
    """Time and encoder updates of pre-training for one, two and three domains (section IV.E), from a timed part."""
    for group, seed in product(request.groups or "A", request.encoder_seeds):
        for system in (name for name in request.methods or PRETRAINED if name in PRETRAINED):
            for count in range(1, len(GROUPS[group]) + 1):
                domains = GROUPS[group][:count]
                sets = [(domain,) for domain in domains] if is_single_domain(system) else [domains]
                place = {"group": group, "domains": count, "encoder_seed": seed}
                place |= {"device": request.device, "threads": request.threads}
                yield Cell(system, timing(request, system, sets, seed), place)


@_experiment("Spread of the prototypes")
def _prototypes(request: Request) -> Iterator[Cell]:
    """How far prototypes spread, along pre-training and at its end, with and without the dispersion loss (IV.G)."""
    # The encoders of the ablation: those of an (S) method are trained on its domains.
    tasks = request.tasks or tuple(get_domain(domain).task for domain in SINGLE_DISPERSION)
    scale = _ablated(request).scale
    for system, domains, place in replace(request, tasks=tasks).encoders(VARIANTS):
        for label, loss in _variants(system, domains[0]) if system in VARIANTS else ():
            yield Cell(label, encoder(scale, system, domains, place["encoder_seed"], loss=loss), place)


def _compared(request: Request, kind: str, groups: str, system: str, samples: int) -> Iterator[Cell]:
    """Yield comparisons of random data with an explorer's, as CRPTpro's encoder of all domains sees both."""
    scale = request.scale
    for explorer, domains, place in request.encoders([system], groups):
        if pretraining_of(explorer).exploration is None:
            continue
        together, seed = GROUPS[place["group"]], place["encoder_seed"]
        base, exploring = encoder(scale, "crptpro", together, seed), encoder(scale, explorer, domains, seed)
        data = [dataset(scale, domain, seed) for domain in (domains if kind == "coverage" else together)]
        yield Cell(explorer, comparison(kind, base, exploring, data, samples=samples, seed=seed), place)


@_experiment("Coverage of the data")
def _coverage(request: Request) -> Iterator[Cell]:
    """How widely random data and an explorer's are spread along pre-training (section IV.H)."""
    return _compared(request, "coverage", "A", "proto-rl-c", request.scale.coverage_samples)


@_experiment("Stability of pre-training")
def _stability(request: Request) -> Iterator[Cell]:
    """The comparative loss along pre-training on random data and on an explorer's (section IV.H)."""
    # Without the dispersion loss CRPTpro differs from Proto-RL(C) in its data alone.
    variants = {"crptpro": VARIANTS["crptpro"], FAST: VARIANTS[FAST], "proto-rl-c": (("proto-rl-c", NONE),)}
    for system, domains, place in request.encoders(variants):
        for label, loss in variants.get(system, ()):
            yield Cell(label, encoder(request.scale, system, domains, place["encoder_seed"], loss=loss), place)


@_experiment("Embeddings of random data and of an explorer's")
def _visualize(request: Request) -> Iterator[Cell]:
    """Principal components of random data of three domains and of an explorer's in one of them (section IV.H)."""
    return _compared(request, "embeddings", "BC", "proto-rl-s", request.scale.embedded_samples)


@_experiment("State probe")
def _probe(request: Request) -> Iterator[Cell]:
    """What a linear model reads of the simulator's state from frozen features. Not in the paper."""
    # Requested tasks choose the domains; an (S) method's one encoder is probed on all of them, too.
    scale = request.scale
    requested = dict.fromkeys(get_domain(task).name for task in request.tasks)
    for group, seed in product(request.groups or "A", request.encoder_seeds):
        for system in request.methods or (*PRETRAINED, RANDOM):
            for domain in requested or (*GROUPS[group], *PROBED_UNSEEN[group]):
                base_domain = domain if system == FINETUNE else SINGLE_DOMAIN[group]
                trained = encoder_for_task(scale, system, GROUPS[group], get_domain(base_domain).task, seed)
                if trained is None or system == NO_BONUS:
                    continue  # no encoder of its own
                job = probe(scale, trained, dataset(scale, domain, seed, scale.probe_transitions))
                place = {"group": group, "domain": domain, "colors": "normal", "encoder_seed": seed}
                yield Cell(system, job, place)
