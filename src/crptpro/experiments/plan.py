"""What is to be made for an experiment, in which order, and what is there already."""

from __future__ import annotations

from collections.abc import Iterable
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

    What only a finished piece needed is left out: nobody asks for the data of an encoder that is there.

    Args:
        goals: pieces that are wanted.
        store: where finished ones are found.
    """
    ordered: dict[str, Piece] = {}
    done: set[str] = set()

    def visit(piece: Piece) -> None:
        if piece.key in ordered:
            return
        if store.is_done(piece):
            done.add(piece.key)
        else:
            for needed in piece.needs:
                visit(needed)
        ordered[piece.key] = piece

    for goal in goals:
        visit(goal)
    return Plan(tuple(ordered.values()), frozenset(done))
