"""Measurements that one small table per piece holds: prototypes, coverage, embeddings."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from crptpro.cards import read_json
from crptpro.errors import RecordError
from crptpro.experiments.published import PROTOTYPE_METRICS
from crptpro.experiments.report import drawing
from crptpro.experiments.report.blocks import ABSENT, Block, Cell, Figure, Paragraph, Table, cells
from crptpro.experiments.report.palette import Style, in_order, styles
from crptpro.experiments.report.reading import Asked, Wanted, number
from crptpro.experiments.row_files import read_rows

SPREAD = {"kne_3": "KNE, k = 3", "kne_half": "KNE, k = M/2", "ane": "ANE", "intr": "L_intr"}
"""Column of ``prototypes.csv`` to what it is."""
RANDOM = "random policy"


@dataclass(frozen=True)
class Row:
    """A row of a measurement, with the goal that it belongs to."""

    goal: Wanted
    cells: Mapping[str, str]

    def number(self, column: str) -> float | None:
        """Return a cell as a number, if it is one."""
        return number(self.cells, column)

    def __getitem__(self, column: str) -> str:
        """Return a cell; empty if there is none."""
        return self.cells.get(column) or ""


def rows_of(asked: Asked, kind: str, *, once: bool = False) -> tuple[list[Row], list[Block]]:
    """Read ``<kind>.csv`` of every finished piece of a kind.

    Args:
        asked: the experiment.
        kind: of pieces.
        once: leave out the further goals of a piece that stands in several places, e.g. of an (S) method's in two
            groups.

    Returns:
        All rows, and a warning for what cannot be read.
    """
    rows, problems, read = [], [], set()
    for goal in asked.finished:
        if goal.piece.kind == kind and not (once and goal.piece.key in read):
            read.add(goal.piece.key)
            try:
                rows += [Row(goal, row) for row in read_rows(goal.piece.directory / f"{kind}.csv")]
            except RecordError as reason:
                problems.append(str(reason))
    return rows, [Paragraph(f"Left out: {problem}", "warning") for problem in problems]


def prototypes(asked: Asked) -> tuple[Block, ...]:
    """How far prototypes spread: at the end beside the paper's, and along training."""
    rows, blocks = rows_of(asked, "prototypes", once=True)
    runs: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        runs.setdefault(_variant(row), {}).setdefault(row.goal.piece.key, []).append(row)
    if not runs:
        return tuple(blocks)
    paper = {_name(m.method, m.has_intrinsic_loss): m for m in PROTOTYPE_METRICS}
    lines = []
    for label in in_order(runs):
        ends = [own[-1] for own in runs[label].values()]
        printed = paper.get(label)
        told = {} if printed is None else {"kne_3": printed.kne, "ane": printed.ane, "intr": printed.intr}
        updates = " or ".join(f"{at:,.0f}" for at in sorted({row.number("updates") or 0 for row in ends}))
        places = [goal.place for goal in asked.finished if goal.piece.key in runs[label]]
        groups = ", ".join(sorted({str(place.get("group", ABSENT)) for place in places}))
        numbers = [
            Cell(mean_of(ends, column), published=f"{told[column] * 1e4:.3f}" if column in told else "")
            for column in SPREAD
        ]
        lines.append(cells(label, groups, str(len(ends)), updates, *numbers))
    caption = (
        "Spread of the prototypes at the end of pre-training, in units of 1e-4, mean over encoders; lower is wider. "
        "The paper's KNE has an unpublished k: it stands beside k = 3, and is not the same quantity."
    )
    blocks.append(Table(caption, ("variant", "group", "encoders", "updates", *SPREAD.values()), tuple(lines)))
    look = styles(in_order(runs))
    panels = []
    for column, name in SPREAD.items():
        curves = [
            _line(own, "updates", column, f"{label} (n = {len(runs[label])})", look[label])
            for label in in_order(runs)
            for own in runs[label].values()
        ]
        drawn = [curve for curve in curves if np.size(curve.x)]
        panels.append(drawing.Panel("", "encoder updates", name, drawn, compresses=True))
    count = sum(len(pieces) for pieces in runs.values())
    caption = f"Spread of the prototypes along training, a line per encoder; {count} encoders."
    if any(drawing.linear_width([line.y for line in panel.lines]) for panel in panels):
        caption += (
            " Where some lie more than ten times as far from 0 as most, heights are to scale near 0 only."
        )
    blocks.append(Figure(f"{asked.name}-spread", caption, drawing.lines(panels, columns=2)))
    return tuple(blocks)


def coverage(asked: Asked) -> tuple[Block, ...]:
    """How much of a domain the data covers along pre-training: random policy against explorers."""
    rows, blocks = rows_of(asked, "coverage", once=True)
    by_piece: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        label = RANDOM if row["source"] == "random" else f"{row['method']} explorer"
        by_piece.setdefault((row["domain"], label, row.goal.piece.key), []).append(row)
    # Several explorers stand beside the same random data: what is equal is one curve, and windows of another length
    # are another curve of the same data.
    curves: dict[tuple[str, str], dict[tuple, list[Row]]] = {}
    for (domain, label, _), own in by_piece.items():
        numbers = tuple((row["env_steps"], row["coverage"]) for row in own)
        curves.setdefault((domain, label), {})[numbers] = own
    if not curves:
        return tuple(blocks)
    labels = in_order(sorted({label for _, label in curves}))
    look = styles(labels)
    panels, lines = [], []
    for domain in dict.fromkeys(domain for domain, _ in curves):
        drawn = []
        for label in labels:
            found = list(curves.get((domain, label), {}).values())
            if not found:
                continue
            count = len({_data(own[0], label) for own in found})
            name = f"{label} (n = {count} per domain)"
            drawn += [_line(own, "env_steps", "coverage", name, look[label]) for own in found]
            ends = [own[-1] for own in found]
            samples = " or ".join(sorted({row["samples"] for row in ends}))
            steps = " or ".join(f"{at:,.0f}" for at in sorted({row.number("env_steps") or 0 for row in ends}))
            end = mean_of(ends, "coverage", 1, ".4f")
            lines.append(cells(domain, label, str(count), steps, samples, end))
        panels.append(
            drawing.Panel(domain, "env steps of the explorer, all domains", "particle estimate", drawn)
        )
    caption = (
        "Coverage at the end: particle estimate over observations sampled from the last window of the training, which "
        "is cut into up to ten of equal length, and from as many decisions of the random policy; mean over runs; "
        "higher is wider."
    )
    columns = ("domain", "data", "runs", "explorer's env steps, all domains", "samples", "coverage")
    blocks.append(Table(caption, columns, tuple(lines), labels=2))
    caption = (
        "Coverage along pre-training, a line per run; estimates of other numbers of samples do not compare."
    )
    blocks.append(Figure(f"{asked.name}-curves", caption, drawing.lines(panels)))
    return tuple(blocks)


def embeddings(asked: Asked) -> tuple[Block, ...]:
    """Embeddings of several sources in their first three principal components."""
    rows, blocks = rows_of(asked, "embeddings", once=True)
    by_piece: dict[str, list[Row]] = {}
    for row in rows:
        by_piece.setdefault(row.goal.piece.key, []).append(row)
    for place, own in enumerate(by_piece.values()):
        goal = own[0].goal
        clouds: dict[str, list[list[float]]] = {}
        for row in own:
            point = [row.number(f"pc{i}") for i in (1, 2, 3)]
            clouds.setdefault(row["source"], []).append([np.nan if p is None else p for p in point])
        look = styles(clouds)
        drawn = {source: (look[source], np.array(points)) for source, points in clouds.items()}
        where = f" ({goal.where})" if goal.where else ""
        caption = f"{goal.label}{where}: first three principal components of {len(own)} embeddings."
        picture = drawing.scatter(drawn, _components(goal), ((0, 1), (0, 2), (1, 2)))
        blocks.append(Figure(f"{asked.name}-{place + 1}", caption, picture))
    return tuple(blocks)


def _components(goal: Wanted) -> list[str]:
    try:
        content = read_json(goal.piece.directory / "explained.json", error=RecordError)
        ratios = [float(ratio) for ratio in content["explained_variance_ratio"]]
        return [f"component {i + 1} ({ratio:.0%} of variance)" for i, ratio in enumerate(ratios[:3])]
    except (RecordError, KeyError, TypeError, ValueError):
        return [f"component {i}" for i in (1, 2, 3)]


def _data(row: Row, label: str) -> str:
    """What a curve of coverage stands on: an explorer, or a dataset, beside which several explorers may stand."""
    description = row.goal.piece.description
    if label == RANDOM:
        found = [data for data in description.get("datasets") or () if data.get("domain") == row["domain"]]
        return json.dumps(found, sort_keys=True)
    return json.dumps(description.get("explorer"), sort_keys=True)


def _variant(row: Row) -> str:
    return _name(row["method"], row["has_dispersion"].lower() in ("true", "1", "yes"))


def _name(method: str, has_dispersion: bool) -> str:
    return f"{method} {'with' if has_dispersion else 'without'} L_intr"


def _line(rows: list[Row], x: str, y: str, label: str, style: Style) -> drawing.Line:
    points = [(row.number(x), row.number(y)) for row in rows]
    known = [(a, b) for a, b in points if a is not None and b is not None]
    return drawing.Line(label, style, [a for a, _ in known], [b for _, b in known])


def mean_of(rows: Sequence[Row], column: str, scale: float = 1e4, spec: str = ".3f") -> str:
    """Return the mean of a column, printed; nothing is known of an empty one."""
    values = [value for row in rows if (value := row.number(column)) is not None]
    return f"{np.mean(values) * scale:{spec}}" if values else ABSENT
