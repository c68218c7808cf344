"""A plugin with an experiment of the user's own."""

from __future__ import annotations

from fake_pieces import FakePiece

from crptpro.experiments.catalogue import EXPERIMENTS, Experiment
from crptpro.experiments.goals import Goal, Request

LONG_TICKS = 40


def goals(request: Request) -> list[Goal]:
    data = FakePiece("data")
    names = request.methods or ("crptpro", "atc")
    return [Goal(name, FakePiece(name, (data,), ticks=LONG_TICKS)) for name in names]


def broken(request: Request) -> list[Goal]:
    data = FakePiece("missing-data", ends="refusal")
    return [Goal("crptpro", FakePiece("on-missing-data", (data,)))]


EXPERIMENTS["fake"] = Experiment("fake", "Fake", "Counting.", goals)
EXPERIMENTS["broken"] = Experiment("broken", "Broken", "Not counting.", broken)
