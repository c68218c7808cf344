"""Pieces that take a moment, end badly, or die, made by a stage that counts and can be interrupted."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from crptpro.errors import RecordError
from crptpro.experiments.building import JobSettings, register
from crptpro.experiments.pieces import Piece
from crptpro.experiments.plan import Plan, make_plan
from crptpro.experiments.store import Store
from crptpro.training.stop_request import StopRequest

PLUGIN = str(Path(__file__).resolve())
TICK_S = 0.1


@dataclass(frozen=True)
class FakePiece(Piece):
    """Counts to `ticks`, with a checkpoint after each.

    Args:
        name: of the piece.
        after: what it needs.
        ticks: to count to.
        ends: `well`, with a `refusal`, with a `defect`, or `killed` once, in the middle.
    """

    kind = "fake"
    name: str
    after: tuple[Piece, ...] = ()
    ticks: int = 1
    ends: str = "well"

    @property
    def title(self) -> str:
        return self.name


@dataclass(frozen=True)
class ExclusivePiece(FakePiece):
    kind = "fake-exclusive"
    is_exclusive = True
    unused: int = field(default=0)


def plan_of(store: Store, *pieces: Piece) -> Plan:
    return make_plan(pieces, store)


def counted(store: Store, piece: Piece) -> int:
    path = store.path(piece) / "count.txt"
    return int(path.read_text()) if path.exists() else 0


def attempts(store: Store, piece: Piece) -> list[dict[str, str]]:
    """What every attempt began with: from, pid, node, threads."""
    path = store.path(piece) / "attempts.txt"
    if not path.exists():
        return []
    return [dict(word.split("=") for word in line.split()) for line in path.read_text().splitlines()]


@register
def _(piece: FakePiece, store: Store, job: JobSettings) -> None:
    began = counted(store, piece)
    words = {"from": began, "pid": os.getpid(), "node": _node(), "threads": os.environ.get("OMP_NUM_THREADS")}
    with open(store.path(piece) / "attempts.txt", "a") as file:
        file.write(" ".join(f"{name}={value}" for name, value in words.items()) + "\n")
    print(f"{piece.name} counts on from {began}")
    if piece.ends == "refusal":
        raise RecordError(f"{piece.name} will never do.")
    if piece.ends == "defect":
        raise RuntimeError(f"{piece.name} is broken")
    with StopRequest() as stop:
        for count in range(began + 1, piece.ticks + 1):
            time.sleep(TICK_S)
            _checkpoint(store, piece, count)
            if piece.ends == "killed" and began == 0 and count == piece.ticks // 2:
                os.kill(os.getpid(), signal.SIGKILL)
            if stop.signal is not None and count < piece.ticks:
                stop.leave()


def _checkpoint(store: Store, piece: Piece, count: int) -> None:
    partial = store.path(piece) / "count.partial"
    partial.write_text(str(count))
    partial.replace(store.path(piece) / "count.txt")


def _node() -> str:
    ray = sys.modules.get("ray")
    return ray.get_runtime_context().get_node_id() if ray is not None and ray.is_initialized() else "here"
