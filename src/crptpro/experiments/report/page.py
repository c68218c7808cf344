"""From a directory to a report: read, draw, lay out, write."""

from __future__ import annotations

import dataclasses
import datetime
import logging
from collections.abc import Callable
from pathlib import Path

from crptpro.errors import RecordError
from crptpro.experiments.catalogue import EXPERIMENTS
from crptpro.experiments.intervals import Bootstrap
from crptpro.experiments.report.blocks import Block, Page, Paragraph, Section, figures_of
from crptpro.experiments.report.cards import piece_cards, run_cards
from crptpro.experiments.report.costs import efficiency
from crptpro.experiments.report.diagnostics import stability
from crptpro.experiments.report.figures import save
from crptpro.experiments.report.html import Saved, html_page
from crptpro.experiments.report.markdown import markdown_page
from crptpro.experiments.report.measurements import coverage, embeddings, prototypes
from crptpro.experiments.report.overview import caveats, contents, progress, provenance
from crptpro.experiments.report.pictures import observations, videos
from crptpro.experiments.report.probes import probes
from crptpro.experiments.report.reading import Asked, Source, read_source
from crptpro.experiments.report.runs import placed_runs, unplaced_runs
from crptpro.experiments.report.scores import blocks_of_runs, score_blocks
from crptpro.experiments.report.spending import spending
from crptpro.experiments.report.study import study
from crptpro.whole_file import write_whole

logger = logging.getLogger(__name__)

Measured = Callable[[Asked], tuple[Block, ...]]
MEASURED: dict[str, Measured] = {
    "efficiency": efficiency,
    "prototypes": prototypes,
    "coverage": coverage,
    "stability": stability,
    "visualize": embeddings,
    "probe": probes,
    "study": study,
}
"""Experiments with numbers that are no downstream scores."""


def build_report(
    root: str | Path, *, out: str | Path | None = None, bootstrap: Bootstrap | None = None
) -> Path:
    """Write a report on a reproduction, or on any directory with downstream runs.

    Leaves ``index.html`` (everything in one file), ``report.md`` and ``figures/*.png`` and ``*.svg``.

    Args:
        root: what to report on.
        out: directory of the report; ``root/report`` if not given.
        bootstrap: how intervals are made.

    Returns:
        The HTML page.

    Raises:
        RecordError: there is no such directory, or nothing in it to report on.
        OSError: the report cannot be written.
    """
    source = read_source(root)
    page = make_page(source, bootstrap or Bootstrap())
    folder = Path(out) if out is not None else source.root / "report"
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    figures: dict[str, Saved] = {}
    for section in page.sections:
        for figure in figures_of(section.blocks):
            figures[figure.name] = Saved(*save(figure.drawing, folder / "figures", figure.name))
    write_whole(folder / "report.md", markdown_page(page))
    return write_whole(folder / "index.html", html_page(page, figures))


def make_page(source: Source, bootstrap: Bootstrap) -> Page:
    """Say everything that is known of a directory.

    Args:
        source: as read.
        bootstrap: how intervals are made.
    """
    now = datetime.datetime.now(datetime.UTC)
    scales = list(dict.fromkeys(asked.scale for asked in source.asked))
    what = f"reproduction at scale {' and '.join(scales)}" if scales else "downstream runs"
    summary = (
        "Cross-domain random pre-training with prototypes (arXiv 2302.05614): what was measured here, beside the "
        f"numbers that the paper printed. Made on {now:%Y-%m-%d at %H:%M} UTC from {source.root.resolve().name}."
    )
    order = [*EXPERIMENTS, *(asked.experiment for asked in source.asked)]
    in_order = sorted(source.asked, key=lambda asked: (order.index(asked.experiment), asked.scale))
    source = dataclasses.replace(source, asked=tuple(in_order))
    placed = unplaced_runs(source.runs)
    sections = [Section("What is here", contents(source), "contents")]
    sections.append(Section("What this scale cannot show", caveats(source), "caveats"))
    sections += [_experiment(asked, source, bootstrap) for asked in source.asked]
    for asked in source.asked:
        placed += placed_runs(asked)[0]
    if source.runs:
        sections.append(Section("Scores", blocks_of_runs(placed, "runs", bootstrap), "scores"))
    sections += [
        Section("What the data looks like", observations(source.pieces.values()), "observations"),
        Section("Evaluation videos", videos(placed), "videos"),
        Section("Versions and hardware", provenance(source), "provenance"),
        Section("Cards", (*piece_cards(source.pieces), *run_cards(source.runs)), "cards"),
    ]
    title = f"CRPTpro: {what}"
    return Page(title, summary, tuple(section for section in sections if section.blocks))


def _experiment(asked: Asked, source: Source, bootstrap: Bootstrap) -> Section:
    known = EXPERIMENTS.get(asked.experiment)  # a plugin's own experiment may not be loaded here
    title = f"{asked.experiment if known is None else known.title} ({asked.scale})"
    summary = () if known is None else (Paragraph(known.summary),)
    if not asked.finished:
        text = f"Nothing is finished yet: {len(asked.goals)} pieces were asked for."
        return Section(title, (Paragraph(text),), asked.name)
    blocks: tuple[Block, ...] = summary + progress(asked, source.pieces)
    try:
        if asked.experiment in MEASURED:
            blocks += MEASURED[asked.experiment](asked)
        blocks += score_blocks(asked, bootstrap)
        blocks += spending(asked, source.pieces)
    except RecordError as reason:
        logger.warning("%s: %s", asked.name, reason)
        blocks += (Paragraph(f"The rest of this section cannot be made: {reason}", "warning"),)
    return Section(title, blocks, asked.name)
