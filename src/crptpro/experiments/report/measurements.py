"""Measurements that one small table per piece holds: timings, prototypes, coverage, embeddings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from crptpro.cards import read_json
from crptpro.errors import RecordError
from crptpro.experiments.published import EFFICIENCY, PROTOTYPE_METRICS
from crptpro.experiments.report import drawing
from crptpro.experiments.report.blocks import ABSENT, Block, Cell, Figure, Paragraph, Table, cells
from crptpro.experiments.report.palette import Style, in_order, styles
from crptpro.experiments.report.reading import Asked, Wanted, number, read_table


class Row(NamedTuple):
    """A row of a measurement, with the goal that it belongs to."""

    goal: Wanted
    cells: Mapping[str, str]

    def number(self, column: str) -> float | None:
        """Return a cell as a number, if it is one."""
        return number(self.cells, column)

    def __getitem__(self, column: str) -> str:
        """Return a cell; empty if there is none."""
        return self.cells.get(column) or ""


def rows_of(asked: Asked, kind: str) -> tuple[list[Row], list[Block]]:
    """Read ``<kind>.csv`` of every finished piece of a kind.

    Returns:
        All rows, and a warning for what cannot be read.
    """
    rows, problems = [], []
    for goal in _once(asked.finished):
        if goal.piece.kind == kind:
            try:
                rows += [Row(goal, row) for row in read_table(goal.piece.directory / f"{kind}.csv")]
            except RecordError as reason:
                problems.append(str(reason))
    return rows, [Paragraph(f"Left out: {problem}", "warning") for problem in problems]


def efficiency(asked: Asked) -> tuple[Block, ...]:
    """Hours and encoder updates of pre-training, by number of domains, beside the paper's on a P100."""
    rows, blocks = rows_of(asked, "timing")
    if not rows:
        return tuple(blocks)
    here = {(row["method"], int(row.number("domains") or 0)): row for row in rows}
    methods, counts = in_order(method for method, _ in here), sorted({count for _, count in here})
    paper = {entry.method: entry for entry in EFFICIENCY}
    lines = []
    for method in methods:
        for count in counts:
            if (method, count) not in here:
                continue
            row = here[method, count]
            is_printed = method in paper and count in (1, 2, 3)
            hours = f"{paper[method].hours[count - 1]:g}" if is_printed else ""
            updates = f"{paper[method].encoder_updates[count - 1]:,}" if is_printed else ""
            lines.append(
                cells(
                    method, str(count), _plain(row, "seconds_per_update", ".3g"),
                    _plain(row, "seconds_per_decision", ".3g"),
                    _plain(row, "budget_updates", ",.0f"), _plain(row, "projected_hours", ".3g"),
                    Cell(_plain(row, "paper_updates", ",.0f"), published=updates),
                    Cell(_plain(row, "paper_projected_hours", ".3g"), published=hours),
                )
            )  # fmt: skip
    columns = (
        "method", "domains", "s per encoder update", "s per decision", "encoder updates at this scale",
        "hours at this scale", "encoder updates, paper's budget", "hours, paper's budget",
    )  # fmt: skip
    caption = (
        "Pre-training by number of domains: timed here over a few updates and decisions, projected to whole budgets; "
        "the paper's hours are those of an NVIDIA Tesla P100."
    )
    blocks.append(Table(caption, columns, tuple(lines), labels=2))
    most = max(counts)
    series = {f"here, {most} domain(s)": [_get(here, m, most, "paper_projected_hours") for m in methods]}
    if most in (1, 2, 3):
        series["paper, on a P100"] = [paper[m].hours[most - 1] if m in paper else None for m in methods]
    caption = f"Hours of pre-training with the paper's budget for {most} domain(s); {len(rows)} timings, one of each."
    blocks.append(
        Figure(f"{asked.name}-hours", caption, drawing.bars(methods, series, "hours of pre-training"))
    )
    series = {
        f"{count} domain(s)": [_get(here, m, count, "paper_updates") for m in methods] for count in counts
    }
    caption = "Encoder updates of the paper's budget, by number of domains."
    blocks.append(Figure(f"{asked.name}-updates", caption, drawing.bars(methods, series, "encoder updates")))
    return tuple(blocks)


def prototypes(asked: Asked) -> tuple[Block, ...]:
    """How far prototypes spread: at the end beside the paper's, and along training."""
    rows, blocks = rows_of(asked, "prototypes")
    runs: dict[str, list[list[Row]]] = {}
    by_piece: dict[str, list[Row]] = {}
    for row in rows:
        by_piece.setdefault(row.goal.piece.key, []).append(row)
    for own in by_piece.values():
        runs.setdefault(_variant(own[0]), []).append(own)
    if not runs:
        return tuple(blocks)
    paper = {_name(m.method, m.has_intrinsic_loss): m for m in PROTOTYPE_METRICS}
    lines = []
    for label in in_order(runs):
        ends = [own[-1] for own in runs[label]]
        printed = paper.get(label)
        values = [_mean_cell(ends, column) for column in ("kne_3", "kne_half", "ane", "intr")]
        beside = ("", "", "", "") if printed is None else (printed.kne, "", printed.ane, printed.intr)
        told = [Cell(v, published=f"{p * 1e4:.3f}" if p != "" else "") for v, p in zip(values, beside)]
        updates = " or ".join(f"{at:,.0f}" for at in sorted({row.number("updates") or 0 for row in ends}))
        lines.append(cells(label, str(len(ends)), updates, *told))
    caption = (
        "Spread of the prototypes at the end of pre-training, in units of 1e-4, mean over encoders; lower is wider. "
        "The paper's KNE has an unpublished k: it stands beside k = 3, and is not the same quantity."
    )
    columns = ("variant", "encoders", "updates", "KNE, k = 3", "KNE, k = M/2", "ANE", "L_intr")
    blocks.append(Table(caption, columns, tuple(lines)))
    look = styles(in_order(runs))
    names = {"kne_3": "KNE, k = 3", "kne_half": "KNE, k = M/2", "ane": "ANE", "intr": "L_intr"}
    panels = []
    for column, name in names.items():
        curves = []
        for label in in_order(runs):
            curves += [
                _line(own, "updates", column, f"{label} (n = {len(runs[label])})", look[label])
                for own in runs[label]
            ]
        panels.append(drawing.Panel(name, "encoder updates", name, [c for c in curves if np.size(c.x)]))
    caption = f"Spread of the prototypes along training, a line per encoder; {len(by_piece)} encoders."
    blocks.append(Figure(f"{asked.name}-spread", caption, drawing.lines(panels)))
    return tuple(blocks)


def coverage(asked: Asked) -> tuple[Block, ...]:
    """How much of a domain the data covers along pre-training: random policy against explorers."""
    rows, blocks = rows_of(asked, "coverage")
    curves: dict[tuple[str, str], dict[str, list[Row]]] = {}
    for row in rows:
        label = "random policy" if row["source"] == "random" else f"{row['method']} explorer"
        curves.setdefault((row["domain"], label), {}).setdefault(row.goal.piece.key, []).append(row)
    if not curves:
        return tuple(blocks)
    labels = list(dict.fromkeys(label for _, label in sorted(curves)))
    look = styles(in_order(labels))
    panels, lines = [], []
    for domain in dict.fromkeys(domain for domain, _ in curves):
        drawn = []
        for label in in_order(labels):
            pieces = curves.get((domain, label), {})
            count = len(pieces)
            drawn += [
                _line(own, "env_steps", "coverage", f"{label} (n = {count} per domain)", look[label])
                for own in pieces.values()
            ]
            ends = [own[-1] for own in pieces.values()]
            if ends:
                samples = " or ".join(sorted({row["samples"] for row in ends}))
                steps = " or ".join(
                    f"{at:,.0f}" for at in sorted({row.number("env_steps") or 0 for row in ends})
                )
                lines.append(
                    cells(domain, label, str(count), steps, samples, _mean_cell(ends, "coverage", 1, ".4g"))
                )
        panels.append(drawing.Panel(domain, "env steps", "particle estimate", drawn))
    caption = (
        "Coverage at the end: particle estimate over sampled observations, mean over runs; higher is wider."
    )
    columns = ("domain", "data", "runs", "env steps", "samples", "coverage")
    blocks.append(Table(caption, columns, tuple(lines), labels=2))
    caption = "Coverage along pre-training, a line per run. Curves of different samples do not compare."
    blocks.append(Figure(f"{asked.name}-curves", f"{caption} {len(rows)} estimates.", drawing.lines(panels)))
    return tuple(blocks)


def embeddings(asked: Asked) -> tuple[Block, ...]:
    """Embeddings of several sources in their first three principal components."""
    rows, blocks = rows_of(asked, "embeddings")
    for place, key in enumerate(dict.fromkeys(row.goal.piece.key for row in rows)):
        own = [row for row in rows if row.goal.piece.key == key]
        goal = own[0].goal
        clouds: dict[str, list[list[float]]] = {}
        for row in own:
            point = [row.number(f"pc{i}") for i in (1, 2, 3)]
            clouds.setdefault(row["source"], []).append([np.nan if p is None else p for p in point])
        names = _components(goal)
        look = styles(clouds)
        drawn = {source: (look[source], np.array(points)) for source, points in clouds.items()}
        caption = (
            f"Embeddings of {goal.label}{', ' if goal.where else ''}{goal.where}: {len(own)} observations."
        )
        picture = drawing.scatter(drawn, names, ((0, 1), (0, 2), (1, 2)))
        blocks.append(Figure(f"{asked.name}-{place + 1}", caption, picture))
    return tuple(blocks)


def _components(goal: Wanted) -> list[str]:
    try:
        content = read_json(goal.piece.directory / "explained.json", error=RecordError)
        ratios = [float(ratio) for ratio in content["explained_variance_ratio"]]
        return [f"component {i + 1} ({ratio:.0%} of variance)" for i, ratio in enumerate(ratios[:3])]
    except (RecordError, KeyError, TypeError, ValueError):
        return [f"component {i}" for i in (1, 2, 3)]


def _once(goals: Iterable[Wanted]) -> list[Wanted]:
    return list({goal.piece.key: goal for goal in goals}.values())


def _variant(row: Row) -> str:
    return _name(row["method"], row["has_dispersion"].lower() in ("true", "1", "yes"))


def _name(method: str, has_dispersion: bool) -> str:
    return f"{method} {'with' if has_dispersion else 'without'} L_intr"


def _line(rows: list[Row], x: str, y: str, label: str, style: Style) -> drawing.Line:
    points = [(row.number(x), row.number(y)) for row in rows]
    known = [(a, b) for a, b in points if a is not None and b is not None]
    return drawing.Line(label, style, [a for a, _ in known], [b for _, b in known])


def _mean_cell(rows: list[Row], column: str, scale: float = 1e4, spec: str = ".3f") -> str:
    values = [value for row in rows if (value := row.number(column)) is not None]
    return f"{np.mean(values) * scale:{spec}}" if values else ABSENT


def _plain(row: Row, column: str, spec: str) -> str:
    value = row.number(column)
    return ABSENT if value is None else f"{value:{spec}}"


def _get(here: Mapping[tuple[str, int], Row], method: str, count: int, column: str) -> float | None:
    return here[method, count].number(column) if (method, count) in here else None
