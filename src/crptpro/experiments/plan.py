"""What is to be made for an experiment, in which order, and what is there already."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from crptpro.experiments.pieces import Piece
from crptpro.experiments.store import Store


@dataclass(frozen=True)
class Plan:
    """Pieces without repeats, finished ones first, each of the others after all that it needs.

    Args:
        pieces: all, finished or not.
        done: keys of the finished ones.
    """

    pieces: tuple[Piece, ...]
    done: frozenset[str]

    @property
    def missing(self) -> tuple[Piece, ...]:
        """What is still to be made, in order."""
        return tuple(piece for piece in self.pieces if piece.key not in self.done)


def make_plan(goals: Iterable[Piece], store: Store) -> Plan:
    """Collect pieces and, recursively, what they need.

    What only a finished piece needed is left out: nobody asks for the data of an encoder that is there. A goal is
    finished if its records are there; what an unfinished piece reads must be there itself, or it is made again.

    Args:
        goals: pieces that are wanted.
        store: where finished ones are found.
    """
    there: dict[str, Piece] = {}
    missing: dict[str, Piece] = {}

    def require(piece: Piece, reader: Piece | None = None) -> None:
        """Ask for a piece that somebody reads."""
        if store.is_done(piece, for_piece=reader):
            there[piece.key] = piece
        elif piece.key not in missing:
            for needed in piece.needs:
                require(needed, piece)
            missing[piece.key] = piece

    for goal in goals:
        if store.is_recorded(goal):
            there[goal.key] = goal
        else:
            require(goal)
    done = {key: piece for key, piece in there.items() if key not in missing}
    return Plan((*done.values(), *missing.values()), frozenset(done))
