"""What is to be made for an experiment, in which order, and what is there already."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from crptpro.experiments.building import Store
from crptpro.experiments.pieces import Piece


@dataclass(frozen=True)
class Plan:
    """Pieces without repeats, each after all that it needs.

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
    ordered: dict[str, Piece] = {}
    done: set[str] = set()

    def visit(piece: Piece, is_done: Callable[[Piece], bool]) -> None:
        if piece.key in ordered and (piece.key not in done or is_done(piece)):
            return
        ordered.pop(piece.key, None)  # a goal of which only records are there, and now somebody needs more
        if is_done(piece):
            done.add(piece.key)
        else:
            done.discard(piece.key)
            for needed in piece.needs:
                visit(needed, store.is_done)
        ordered[piece.key] = piece

    for goal in goals:
        visit(goal, store.is_recorded)
    return Plan(tuple(ordered.values()), frozenset(done))
