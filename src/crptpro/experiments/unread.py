"""Which parts of a request change nothing of what the experiments ask for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from crptpro.domains import GROUPS, get_domain
from crptpro.experiments.goals import SEEDS, Goal, Request


def unread(request: Request, goals_of: Callable[[Request], list[Goal]]) -> list[str]:
    """Name what was asked for and makes no difference: a method that nothing measures, seeds where nothing runs.

    Args:
        request: what was asked for.
        goals_of: the goals of all experiments that were named.

    Returns:
        Options with their values as they are typed: ``["--tasks hopper_hop"]``.
    """
    found = goals_of(request)

    def changes_nothing(**other: object) -> bool:
        return goals_of(replace(request, **other)) == found  # type: ignore[arg-type]

    said = []
    every_task = dict.fromkeys(get_domain(domain).task for domains in GROUPS.values() for domain in domains)
    for name, known in (("methods", ()), ("groups", GROUPS), ("tasks", every_task)):
        given = getattr(request, name)
        for value in given:
            rest = tuple(kept for kept in given if kept != value)
            # A value alone is read if another one in its place would have led elsewhere.
            others = [rest] if rest else [(other,) for other in known if other != value]
            if others and all(changes_nothing(**{name: other}) for other in others):
                said.append(f"--{name} {value}")
    if request.seeds is not None:
        unused = next(seed for seed in range(SEEDS) if seed not in request.seeds)
        if changes_nothing(seeds=(unused,)):
            said.append(f"--seeds {' '.join(map(str, request.seeds))}")
    if request.colors != Request.colors and changes_nothing(colors=Request.colors):
        said.append("--colors-by image")
    return said
