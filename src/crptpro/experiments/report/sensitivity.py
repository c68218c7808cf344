"""What a setting does to the score: one point per value, with its interval."""

from __future__ import annotations

from collections.abc import Sequence

from crptpro.experiments.estimates import estimate
from crptpro.experiments.intervals import Bootstrap, Estimate
from crptpro.experiments.published import EXPERT_SCORES
from crptpro.experiments.report import drawing
from crptpro.experiments.report.blocks import Block, Figure
from crptpro.experiments.report.palette import styles
from crptpro.experiments.report.runs import Placed, tables_of
from crptpro.experiments.statistics import expert_normalized, mean

NAMES = {"alpha": "weight of the dispersion loss (alpha)", "b": "random transitions per domain (b)"}


def sensitivity(placed: Sequence[Placed], name: str, bootstrap: Bootstrap) -> list[Block]:
    """Draw the normalised mean score against what was varied; nothing where nothing was.

    Args:
        placed: finished runs.
        name: for the names of figures.
        bootstrap: how intervals are made.
    """
    blocks: list[Block] = []
    for varied in dict.fromkeys(p.varied[0] for p in placed if p.varied[0]):
        part = [p for p in placed if p.varied[0] == varied and p.spot.task in EXPERT_SCORES]
        if not part:
            continue
        methods = list(dict.fromkeys(_method(p) for p in part))
        look, curves = styles(methods), []
        values = sorted({p.varied[1] for p in part}, key=_size)
        for method in methods:
            points = []
            own = [p for p in part if _method(p) == method]
            for value in values:
                here = [p for p in own if p.varied[1] == value]
                if here:
                    points.append((values.index(value), _estimate(here, bootstrap)))
            ends = [found.interval or (found.value, found.value) for _, found in points]
            curves.append(
                drawing.Line(
                    f"{method} (n = {len(own)})", look[method], [at for at, _ in points],
                    [found.value for _, found in points], [low for low, _ in ends], [high for _, high in ends],
                )
            )  # fmt: skip
        panel = drawing.Panel(
            "", NAMES.get(varied, varied), "mean score / the paper's DrQ", curves, ticks=values
        )
        caption = (
            f"Mean expert-normalised score against {NAMES.get(varied, varied)}, {bootstrap.confidence:.0%} intervals, "
            "over encoders where a value has several that its runs share, else over runs; n counts runs of all values "
            "and tasks. Values with different tasks finished do not compare."
        )
        blocks.append(Figure(f"{name}-{varied}", caption, drawing.lines([panel])))
    return blocks


def _method(placed: Placed) -> str:
    """What is before the value in a label, as ``"crptpro, alpha 0.05"``."""
    return placed.label.split(f", {placed.varied[0]} ")[0]


def _estimate(placed: Sequence[Placed], bootstrap: Bootstrap) -> Estimate:
    (table,) = tables_of(placed).values()
    experts = {spot: EXPERT_SCORES[spot.task] for spot in table.scores}
    return estimate(
        expert_normalized(table.scores, experts),
        mean,
        encoders=table.shared_encoders,
        runs=table.runs,
        bootstrap=bootstrap,
    )


def _size(value: str) -> tuple[float, str]:
    try:
        return float(value), value
    except ValueError:
        return float("inf"), value
