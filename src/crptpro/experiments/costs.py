"""What a plan will cost: hours on this machine and bytes on its disk, before anything is made."""

from __future__ import annotations

import contextlib
import heapq
import json
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from crptpro.cards import hardware
from crptpro.experiments.piece_costs import core_seconds, stored_bytes, working_bytes
from crptpro.experiments.pieces import DatasetPiece, Piece
from crptpro.experiments.plan import Plan
from crptpro.experiments.store import DONE, Store

SHORTEST_S = 60.0
"""Estimate up to which a finished piece says nothing about a longer one."""
WORTH_TIMING_S = 600.0
"""What networks would take on the reference machine from which a few seconds are spent on timing them here."""


def corrections(store: Store, device: str = "cpu", threads: int = 1) -> dict[str, float]:
    """Compare finished pieces with their estimates.

    Records that came from another kind of machine say nothing about this one: between two processors that both
    multiply bfloat16 the same exploration took one hour and three. Nor do those of jobs with other threads. A
    collection, whose processes have a core each, counts as what it would have taken with one.

    Args:
        store: all of its pieces are looked at.
        device: only of jobs on this kind of device.
        threads: only of jobs with as many.

    Returns:
        Kind of piece to the median of measured by estimated seconds; kinds of which none that took more than moments
        was finished on such a machine are missing.
    """
    found: dict[str, list[float]] = {}
    here = hardware()
    for path in sorted(store.root.glob(f"pieces/*/{DONE}")):
        try:
            done = json.loads(path.read_text())
            piece = store.described(path.parent.name)
            expected = core_seconds(piece)
            job, seconds = done["job"], float(done["seconds"])
            is_alike = all(_parts(done["hardware"][name]) == _parts(here[name]) for name in _deciding(device))
            is_alike &= _kind(str(job["device"])) == _kind(device)
            if isinstance(piece, DatasetPiece):
                seconds *= job["workers"]
            elif not piece.is_exclusive:  # that has the threads which are part of what it is
                is_alike &= job["threads"] == threads
            if expected > SHORTEST_S and is_alike:
                found.setdefault(piece.kind, []).append(seconds / expected)
        except Exception:  # of another version, or of a plugin that is not loaded: says nothing about costs
            continue
    return {kind: statistics.median(ratios) for kind, ratios in found.items()}


@dataclass(frozen=True)
class Cost:
    """What is still to be spent on a plan.

    Args:
        seconds: of each missing piece, by key.
        bytes: that are not on the disk yet and will stay there, likewise.
        working_bytes: besides, while the largest ``jobs`` of them are made at a time.
        wall_seconds: until all are made.
        corrected: kinds whose estimate follows what was measured here.
        threads: of each job, which other kinds count as one.
        pace: time that networks take here by what they take on the reference machine, as the estimate of other kinds
            has it; ``None`` if it was not measured.
    """

    seconds: Mapping[str, float]
    bytes: Mapping[str, int]
    working_bytes: int
    wall_seconds: float
    corrected: frozenset[str]
    threads: int = 1
    pace: float | None = None

    @property
    def disk_bytes(self) -> int:
        """All that has to be free."""
        return sum(self.bytes.values()) + self.working_bytes


def estimate(
    plan: Plan,
    store: Store,
    *,
    jobs: int,
    device: str = "cpu",
    threads: int = 1,
    time_networks: Callable[[int], float] | None = None,
) -> Cost:
    """Estimate what the missing pieces of a plan cost.

    Args:
        plan: what is wanted.
        store: whose finished pieces correct the estimate.
        jobs: at a time.
        device: of networks.
        threads: of each job. Until such a job has finished, a piece counts as if it had one.
        time_networks: measures how long networks take here by what they take on the reference machine, with so many
            threads (:func:`~crptpro.experiments.pace.network_pace`). Called if much of the plan is the work of
            networks and finished pieces do not tell it; ``None`` if jobs will run elsewhere.
    """
    ratios = corrections(store, device, threads)
    untold = [piece for piece in plan.missing if piece.kind not in ratios]
    networks_s = sum(core_seconds(piece, 1.0) - core_seconds(piece, 0.0) for piece in untold)
    pace = time_networks(threads) if time_networks is not None and networks_s > WORTH_TIMING_S else None
    seconds = {piece.key: _seconds(piece, ratios, pace or 1.0) for piece in plan.missing}
    sizes = {piece.key: max(0, stored_bytes(piece) - _size(store.path(piece))) for piece in plan.missing}
    working = sorted(map(working_bytes, plan.missing), reverse=True)[:jobs]
    wall_s = wall_seconds(plan, seconds, jobs)
    return Cost(seconds, sizes, sum(working), wall_s, frozenset(ratios), threads, pace)


def _seconds(piece: Piece, ratios: Mapping[str, float], pace: float) -> float:
    """A measured ratio has the machine's networks in it; elsewhere their pace is the next best."""
    ratio = ratios.get(piece.kind)
    return core_seconds(piece, pace) if ratio is None else ratio * core_seconds(piece)


def wall_seconds(plan: Plan, seconds: Mapping[str, float], jobs: int) -> float:
    """Play a plan through: each piece starts when its needs are there and one of ``jobs`` is free.

    Args:
        plan: what is wanted.
        seconds: of each missing piece, by key.
        jobs: at a time.
    """
    finished, waiting = set(plan.done), list(plan.missing)
    running: list[tuple[float, str]] = []
    now = 0.0
    while waiting or running:
        ready = [p for p in waiting if len(running) < jobs and all(n.key in finished for n in p.needs)]
        shared = [piece for piece in ready if not piece.is_exclusive]
        for piece in shared[: jobs - len(running)]:
            waiting.remove(piece)
            heapq.heappush(running, (now + seconds[piece.key], piece.key))
        if not running:  # only such as must be alone are left
            alone = ready[0]
            waiting.remove(alone)
            heapq.heappush(running, (now + seconds[alone.key], alone.key))
        now, key = heapq.heappop(running)
        finished.add(key)
    return now


def _size(directory: Path) -> int:
    size = 0
    with contextlib.suppress(FileNotFoundError):  # a job that is running may replace what was just listed
        for path in directory.rglob("*"):
            with contextlib.suppress(FileNotFoundError):
                size += path.stat().st_size if path.is_file() else 0
    return size


def _deciding(device: str) -> tuple[str, ...]:
    """What of the hardware decides how long a job takes, as :func:`~crptpro.cards.hardware` names it."""
    cpu = ("cpu", "cpu_instructions")
    return cpu if _kind(device) == "cpu" else (*cpu, "gpus")


def _parts(recorded: str | list[str]) -> str | set[str]:
    """A job is given some of a machine's GPUs: which models there are is compared, not how many."""
    return set(recorded) if isinstance(recorded, list) else recorded


def _kind(device: str) -> str:
    return device.split(":")[0]
