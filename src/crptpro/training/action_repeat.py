"""Simulator steps per decision, also of worlds that only a caller's own factory knows."""

from __future__ import annotations

from crptpro.domains import Domain
from crptpro.envs import resolve_action_repeat
from crptpro.errors import UnknownNameError


def action_repeat_of(domain: str | Domain, asked: int | None) -> int:
    """Return the simulator steps per decision in a domain or task: as asked, else its own, else 2.

    Args:
        domain: name, which the library may not know where a caller makes the environments.
        asked: None to ask the domain.
    """
    try:
        return resolve_action_repeat(domain, asked)
    except UnknownNameError:
        return asked or 2
