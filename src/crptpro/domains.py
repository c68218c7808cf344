"""Domains and tasks: the paper's domains and groups A-D, the rest of dm_control, Gymnasium, and your own."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from crptpro.errors import CRPTproError, UnknownNameError
from crptpro.values import as_int

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

GYMNASIUM_PREFIX = "gymnasium:"

LONGEST_EPISODE_AGENT_STEPS = 1000
"""Time limit of an episode in an environment without one (LQR), whose evaluation would never end."""


@dataclass(frozen=True)
class Domain:
    """An environment's appearance and dynamics, and the task for collecting its frames.

    The paper pre-trains on domains and evaluates on tasks; tasks of one domain share their pixels.

    ``make`` builds your own environment, an unbatched TorchRL one on the CPU. It gets, by keyword, those of ``seed``,
    ``image_size``, ``action_repeat``, ``camera``, ``quality`` and ``physics_state`` that its signature names. If
    it repeats actions itself, give the domain that ``action_repeat``. ``pixels`` is one RGB image ``[H, W, 3]`` or
    ``[3, H, W]`` with ``H = W = image_size``, uint8; ``action`` is a float vector in [-1, 1]; the reward has shape
    ``[1]``. Without ``truncated`` in its ``done_spec``, episodes end by termination alone. With ``physics_state`` it
    may emit ``qpos`` and ``qvel``; entries that its transforms read back (``step_count``) stay, others are dropped. Its
    ``set_seed`` must make the next ``reset`` reproducible. For worker processes ``make`` must be a function at a
    module's top level or a ``functools.partial`` of one. If MuJoCo renders, it calls
    :func:`crptpro.envs.select_backend` before it imports dm_control.
    """

    name: str  #: of the domain, and of its dataset directory
    task: str  #: used for collection, a name for :func:`crptpro.envs.make_env`
    action_repeat: int = 1  #: env steps per agent step; others can be requested if ``make`` takes it as an argument
    camera: int | str | None = 0  #: index or name of the camera; ``None`` leaves it to the environment
    make: Callable[..., EnvBase] | None = None
    episode_env_steps: int | None = None  #: after which an episode is truncated; if ``None``, after 1000 agent steps
    source: Literal["suite", "manipulation", "gymnasium", "own"] = "own"  #: library of ``task``

    def __post_init__(self) -> None:
        for name in ("action_repeat", "episode_env_steps"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, as_int(value, name, minimum=1))


def describe_domain(task: str | Domain) -> dict[str, Any]:
    """Return what identifies an environment in the settings of a run: its task, its domain and the camera."""
    domain = get_domain(task)
    return {"task": domain.task, "domain": domain.name, "camera": domain.camera}


_suite = functools.partial(Domain, action_repeat=2, episode_env_steps=1000, source="suite")

PAPER_DOMAINS: dict[str, Domain] = {
    domain.name: domain
    for domain in (
        _suite("cheetah", "cheetah_run"),
        _suite("walker", "walker_run"),
        # Camera 2 follows the torso from the side, as in the released code. The floor's size depends on the task (run
        # 100 m, walk 10 m), so data is collected from the evaluated task.
        _suite("quadruped", "quadruped_run", camera=2),
        _suite("cartpole", "cartpole_swingup_sparse"),
        _suite("pendulum", "pendulum_swingup"),
        _suite("manipulation", "reach_duplo", camera="front_close", episode_env_steps=250, source="manipulation"),
        _suite("hopper", "hopper_hop"),
        _suite("finger", "finger_spin"),
    )
}

#: The paper's pre-training groups, by domain name.
GROUPS: dict[str, tuple[str, ...]] = {
    "A": ("cheetah", "walker", "quadruped"),
    "B": ("cartpole", "pendulum", "manipulation"),
    "C": ("manipulation", "hopper", "finger"),
    "D": ("walker", "pendulum", "hopper"),
}

#: The paper's eight tasks, each with its domain.
TASKS: dict[str, str] = {domain.task: domain.name for domain in PAPER_DOMAINS.values()}

#: Every task of dm_control's suite as ``domain_task``, by domain: importing dm_control would fix the render backend.
SUITE_TASKS: dict[str, tuple[str, ...]] = {
    domain: tuple(f"{domain}_{task}" for task in tasks.split())
    for domain, tasks in {
        "acrobot": "swingup swingup_sparse",
        "ball_in_cup": "catch",
        "cartpole": "balance balance_sparse swingup swingup_sparse two_poles three_poles",
        "cheetah": "run",
        "dog": "stand walk trot run fetch",
        "finger": "spin turn_easy turn_hard",
        "fish": "upright swim",
        "hopper": "stand hop",
        "humanoid": "stand walk run run_pure_state",
        "humanoid_CMU": "stand walk run",
        "lqr": "2_1 6_2",
        "manipulator": "bring_ball bring_peg insert_ball insert_peg",
        "pendulum": "swingup",
        "point_mass": "easy hard",
        "quadruped": "walk run escape fetch",
        "reacher": "easy hard",
        "stacker": "stack_2 stack_4",
        "swimmer": "swimmer6 swimmer15",
        "walker": "stand walk run",
    }.items()
}

#: Manipulation tasks that have a camera observation.
MANIPULATION_TASKS = (
    "stack_2_bricks", "stack_2_bricks_moveable_base", "stack_3_bricks", "stack_2_of_3_bricks_random_order",
    "reassemble_3_bricks_fixed_order", "reassemble_5_bricks_random_order", "lift_brick", "lift_large_box",
    "place_brick", "place_cradle", "reach_duplo", "reach_site",
)  # fmt: skip

Named = TypeVar("Named", str, str | Domain)


def _built_in() -> dict[str, Domain]:
    found: dict[str, Domain] = {}
    for name, tasks in SUITE_TASKS.items():
        limit = None if name == "lqr" else 1000  # LQR alone has no time limit
        domain = PAPER_DOMAINS.get(name) or _suite(name, tasks[0], episode_env_steps=limit)
        found[name] = domain
        found |= {task: replace(domain, task=task) for task in tasks}
    found |= {task: replace(PAPER_DOMAINS["manipulation"], task=task) for task in MANIPULATION_TASKS}
    return found | PAPER_DOMAINS


_BUILT_IN = _built_in()
_registered: dict[str, Domain] = {}


def register_domain(domain: Domain) -> Domain:
    """Register a domain under its name and its task's name, in this process, and return it.

    A name that several domains share means the one registered last. A worker process starts without registered
    domains: pass the ``Domain`` itself, or call ``register_domain`` at the top level of the module that defines
    ``make``. A name of the paper's, or with the prefix ``gymnasium:``, raises a ``CRPTproError``.
    """
    for name in (domain.name, domain.task):
        if name in {*PAPER_DOMAINS, *TASKS, *GROUPS} or name.startswith(GYMNASIUM_PREFIX):
            raise CRPTproError(f"{name!r} is a name of the paper's or of Gymnasium; register the domain under another.")
    for key in (domain.task, domain.name):
        _registered[key] = domain
    return domain


def get_domain(name: str | Domain) -> Domain:
    """Return the domain of a domain or task name, built in or registered, or of ``gymnasium:<id>``.

    A task name gives its domain with that task; a ``Domain`` is returned unchanged. An unknown name
    raises an ``UnknownNameError`` with the nearest known ones.

    Examples:
        >>> get_domain("cheetah").task
        'cheetah_run'
        >>> get_domain("reach_duplo").name
        'manipulation'
    """
    if isinstance(name, Domain):
        return name
    if found := _registered.get(name) or _BUILT_IN.get(name):
        return found
    if name.startswith(GYMNASIUM_PREFIX):
        return _gymnasium_domain(name)
    known = sorted({*_BUILT_IN, *_registered})
    near = difflib.get_close_matches(name.lower().replace("-", "_"), known, n=5, cutoff=0.5)
    hint = f"Nearest: {', '.join(near)}." if near else f"Domains: {', '.join(PAPER_DOMAINS)}."
    raise UnknownNameError(
        f"There is no domain or task {name!r}. {hint} Gymnasium environments are written gymnasium:<id>; "
        "register_domain adds your own (on the command line: --plugin FILE.py)."
    )


def expand_groups(names: Named | Iterable[Named]) -> list[Named]:
    """Replace group letters by their domains, keeping order and dropping repeats.

    No name, or an unknown one, raises an ``UnknownNameError``; a :class:`Domain` is kept. A string is one name.

    Examples:
        >>> expand_groups(["D", "walker", "finger"])
        ['walker', 'pendulum', 'hopper', 'finger']
    """
    expanded: list[Named] = []
    for name in [names] if isinstance(names, (str, Domain)) else names:
        expanded += GROUPS.get(name, (name,)) if isinstance(name, str) else (name,)
    if not expanded:
        raise UnknownNameError(f"Name at least one domain, task or group ({', '.join(GROUPS)}).")
    for name in expanded:
        get_domain(name)
    return list(dict.fromkeys(expanded))


def _gymnasium_domain(name: str) -> Domain:
    import gymnasium

    env_id = name.removeprefix(GYMNASIUM_PREFIX)
    try:
        spec = gymnasium.spec(env_id)
    except gymnasium.error.Error:
        near = difflib.get_close_matches(env_id, gymnasium.registry, n=5, cutoff=0.5)
        hint = f" Nearest: {', '.join(GYMNASIUM_PREFIX + n for n in near)}." if near else ""
        raise UnknownNameError(f"Gymnasium has no environment {env_id!r}.{hint}") from None
    length = spec.max_episode_steps
    return Domain(name, name, action_repeat=2, camera=None, episode_env_steps=length, source="gymnasium")
