"""Downstream scores: tables beside the paper's, aggregates with intervals, learning curves."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from crptpro.experiments.intervals import Bootstrap
from crptpro.experiments.published import DRQ_ENV_STEPS, ENV_STEPS
from crptpro.experiments.records import Run
from crptpro.experiments.report.aggregates import aggregates
from crptpro.experiments.report.blocks import ABSENT, Block, Bullets, Cell, Paragraph, Table, cells
from crptpro.experiments.report.learning import learning_curves
from crptpro.experiments.report.reading import Asked
from crptpro.experiments.report.runs import (
    LAST,
    Placed,
    Spot,
    evaluations,
    labels_of,
    placed_runs,
    printed,
    published,
    spots_of,
)
from crptpro.experiments.report.sensitivity import sensitivity

FEW = 3
"""Tasks at most whose scores stand in columns, with a row per method; more have rows, as in the paper."""


def score_blocks(asked: Asked, bootstrap: Bootstrap) -> tuple[Block, ...]:
    """Report an experiment whose numbers are downstream scores."""
    placed, problems = placed_runs(asked)
    return (*_unreadable(problems), *blocks_of_runs(placed, asked.name, bootstrap))


def blocks_of_runs(placed: Sequence[Placed], name: str, bootstrap: Bootstrap) -> tuple[Block, ...]:
    """Report downstream runs.

    Args:
        placed: finished runs.
        name: for the names of figures.
        bootstrap: how intervals are made.
    """
    if not placed:
        return ()
    blocks: list[Block] = [_budgets(placed), *_score_tables(placed)]
    blocks += sensitivity(placed, name, bootstrap)
    blocks += aggregates(placed, name, bootstrap)
    blocks += learning_curves(placed, name, bootstrap)
    return tuple(blocks)


def _score_tables(placed: Sequence[Placed]) -> list[Block]:
    blocks: list[Block] = []
    for varied, part in _parts(placed):
        of = f" {varied} varied." if varied else ""
        blocks.append(
            _score_table(
                part,
                lambda run: run.final_score,
                f"Episode return at the final evaluation, mean ± standard deviation over runs (n).{of}",
            )
        )
        long = [p for p in part if evaluations(p.run) >= LAST]
        if long:
            blocks.append(
                _score_table(
                    long,
                    lambda run: run.last_score(LAST),
                    f"Episode return over the last {LAST} evaluations, mean ± standard deviation over runs (n).{of}",
                )
            )
    return blocks


def _parts(placed: Sequence[Placed]) -> list[tuple[str, list[Placed]]]:
    """One table for what a study varies at a time; one for all where nothing is varied."""
    varied = list(dict.fromkeys(p.varied[0] for p in placed))
    return [(name, [p for p in placed if p.varied[0] == name]) for name in varied]


def _score_table(placed: Sequence[Placed], score: Callable[[Run], float], caption: str) -> Table:
    labels, spots = labels_of(placed), spots_of(placed)
    if len(spots) <= FEW < len(labels):  # a page has no room for a column per method
        lines = (
            cells(label, *(_score_cell(placed, spot, label, score) for spot in spots)) for label in labels
        )
        return Table(caption, ("method", *map(str, spots)), tuple(lines))
    has_groups, has_colors = any(s.group for s in spots), any(s.colors != "normal" for s in spots)
    rows = []
    for spot in spots:
        names = [spot.group] * has_groups + [spot.task] + [spot.colors] * has_colors
        rows.append(cells(*names, *(_score_cell(placed, spot, label, score) for label in labels)))
    columns = ["group"] * has_groups + ["task"] + ["colours"] * has_colors
    return Table(caption, (*columns, *labels), tuple(rows), labels=len(columns))


def _score_cell(placed: Sequence[Placed], spot: Spot, label: str, score: Callable[[Run], float]) -> Cell:
    scores = np.array([score(p.run) for p in placed if (p.spot, p.label) == (spot, label)])
    beside = published(spot, label)
    if not len(scores):
        return Cell(ABSENT, published=printed(beside))
    spread = f" ± {scores.std(ddof=1):.0f}" if len(scores) > 1 else ""
    digits = 0 if abs(scores.mean()) >= 10 else 1
    return Cell(f"{scores.mean():.{digits}f}{spread}", f"n = {len(scores)}", printed(beside))


def _budgets(placed: Sequence[Placed]) -> Paragraph:
    budgets = sorted({p.run.env_steps for p in placed})
    here = " or ".join(f"{budget:,}" for budget in budgets)
    text = (
        f"Runs of {here} env steps here. A second line says how many runs a number stands on; “paper” is what it "
        f"printed, after {ENV_STEPS:,} env steps (DrQ: {DRQ_ENV_STEPS:,})."
    )
    if any(p.spot.group for p in placed):
        text += " It has numbers for CRPTpro, ATC, APT(C), Proto-RL(C), BeCL and, on seen domains, DrQ in these tables."
    if any(budget < ENV_STEPS for budget in budgets):
        text += " Scores of a smaller budget do not compare with the paper's."
    return Paragraph(text, "note")


def _unreadable(problems: Sequence[str]) -> list[Block]:
    if not problems:
        return []
    return [Paragraph("Finished, but not readable:", "warning"), Bullets(tuple(problems))]
