"""The head of a report: what was asked for and is there, on what machines, and what its scale cannot show."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping

from crptpro.experiments.published import DRQ_ENV_STEPS, ENV_STEPS
from crptpro.experiments.report.blocks import (
    ABSENT,
    Block,
    Bullets,
    Cell,
    Fold,
    Paragraph,
    Table,
    cells,
    counted,
)
from crptpro.experiments.report.cards import anchor_of
from crptpro.experiments.report.reading import Asked, Made, Source, machine
from crptpro.experiments.scales import PAPER, SCALES, Scale

SHORTCOMINGS = (
    "Which method is ahead after a small part of the budget does not say which is ahead after all of it: methods that "
    "learn late look worse here than they are.",
    "The prototype loss first stays near ln M, for over a thousand updates at batch 512; an encoder of few updates may "
    "not have left that plateau.",
    "Few runs: an interval over two or three of them is too narrow to be believed, and none can be had from one.",
    "A smaller batch, replay or dataset changes the method and not only its budget.",
)
"""What no run below the paper's scale shows."""


def contents(source: Source) -> tuple[Block, ...]:
    """Say what was asked for, and how much of it is there."""
    blocks: list[Block] = []
    rows = []
    for asked in source.asked:
        missing = Counter(goal.label for goal in asked.missing)
        lacking = ", ".join(f"{label}: {count}" for label, count in missing.items()) or "nothing"
        link = Cell(asked.experiment, anchor=asked.name)
        rows.append(cells(link, asked.scale, str(len(asked.goals)), str(len(asked.finished)), lacking))
    if rows:
        columns = ("experiment", "scale", "asked for", "finished", "missing")
        blocks.append(
            Table(
                "Experiments: numbers that were asked for, and those that are there.",
                columns,
                tuple(rows),
                labels=2,
            )
        )
    if source.pieces:
        kinds = Counter(piece.kind for piece in source.pieces.values())
        done = Counter(piece.kind for piece in source.pieces.values() if piece.done is not None)
        seconds = [piece.seconds or 0.0 for piece in source.pieces.values()]
        told = ", ".join(f"{done[kind]} of {count} {kind}" for kind, count in kinds.items())
        blocks.append(Paragraph(f"Pieces finished: {told}; {sum(seconds) / 3600:.1f} h of work in all."))
    if source.runs:
        tasks = sorted({run.task for run in source.runs})
        methods = sorted({run.method for run in source.runs})
        blocks.append(
            Paragraph(
                f"{len(source.runs)} finished downstream runs: {', '.join(methods)} on {', '.join(tasks)}. No "
                "experiment planned them: the group of their encoders is not recorded, and of the paper's numbers only "
                "DrQ's, which do not depend on it, stand beside."
            )
        )
    machines = dict.fromkeys(machine(record.get("hardware") or {}) for record in source.provenance)
    revisions = dict.fromkeys(str(record.get("git_revision", "unknown")) for record in source.provenance)
    if machines:
        text = f"Made on {'; '.join(machines)}, from source revision {', '.join(revisions)}; versions are at the end."
        blocks.append(Paragraph(text))
    if source.problems:
        blocks += [Paragraph("Left out:", "warning"), Bullets(source.problems)]
    return tuple(blocks)


def caveats(source: Source) -> tuple[Block, ...]:
    """Say what the scales of a report cannot show, their budgets beside the paper's; nothing at the paper's scale."""
    names = list(dict.fromkeys(asked.scale for asked in source.asked if asked.scale != PAPER.name))
    short = sorted({run.env_steps for run in source.runs if run.env_steps < ENV_STEPS})
    if not names and not short:
        return ()
    blocks: list[Block] = []
    known = [SCALES[name] for name in names if name in SCALES]
    if known:
        budgets = [_budgets(scale) for scale in (*known, PAPER)]
        rows = tuple(cells(name, *(b[name] for b in budgets)) for name in budgets[0])
        columns = ("budget", *(scale.name for scale in known), "the paper's")
        blocks.append(Table("Budgets beside the paper's.", columns, rows))
    unknown = [name for name in names if name not in SCALES]
    if unknown:
        blocks.append(
            Paragraph(f"The budgets of scale {' and '.join(unknown)} are not known here.", "warning")
        )
    if short:
        told = ", ".join(f"{budget:,}" for budget in short)
        blocks.append(
            Paragraph(f"Runs of {told} env steps; the paper's have {ENV_STEPS:,} (DrQ {DRQ_ENV_STEPS:,}).")
        )
    blocks.append(Paragraph("What this cannot show:", "warning"))
    blocks.append(Bullets(SHORTCOMINGS))
    return tuple(blocks)


def provenance(source: Source) -> tuple[Block, ...]:
    """Versions, hardware and revisions of all that is shown; each that occurs is listed."""
    records = source.provenance
    blocks: list[Block] = []
    machines = Counter(machine(record.get("hardware") or {}) for record in records)
    blocks.append(_counted("Hardware", machines))
    revisions = Counter(str(record.get("git_revision", "unknown")) for record in records)
    blocks.append(_counted("Source revision", revisions))
    found = Counter(json.dumps(record.get("versions") or {}, sort_keys=True) for record in records)
    versions = [json.loads(text) for text, _ in found.most_common()]
    packages = list(dict.fromkeys(name for version in versions for name in version))
    columns = (
        ("package", "version")
        if len(versions) == 1
        else (
            "package",
            *(f"set {i + 1}: {counted(count, 'piece')}" for i, (_, count) in enumerate(found.most_common())),
        )
    )
    rows = tuple(cells(name, *(version.get(name, ABSENT) for version in versions)) for name in packages)
    blocks.append(Table("Versions", columns, rows))
    return tuple(blocks)


def progress(asked: Asked, pieces: Mapping[str, Made]) -> tuple[Block, ...]:
    """Say how much of an experiment is there, and name what is not."""
    missing = asked.missing
    if not missing:
        return (Paragraph(f"Complete: {len(asked.goals)} of {len(asked.goals)} pieces are there."),)
    counts = ", ".join(f"{label} {n}" for label, n in Counter(goal.label for goal in missing).items())
    rows = tuple(
        cells(
            goal.label,
            goal.where or ABSENT,
            goal.piece.state,
            Cell(goal.piece.key, anchor=anchor_of(goal.piece.key) if goal.piece.key in pieces else ""),
        )
        for goal in missing
    )
    table = Table("Not finished", ("system", "where", "state", "piece"), rows, labels=4)
    return (
        Paragraph(
            f"{len(asked.finished)} of {len(asked.goals)} pieces are there; missing: {counts}. Nothing stands in for "
            "what is missing.",
            "warning",
        ),
        Fold(f"The {len(missing)} that are missing", (table,)),
    )


def _budgets(scale: Scale) -> dict[str, str]:
    run, drq = dict(scale.run), {**dict(scale.run), **dict(scale.drq)}
    explore = dict(scale.explore.get("proto-rl-c", ()))
    is_paper = scale.name == PAPER.name
    return {
        "random transitions per domain": f"{scale.transitions:,}",
        "encoder updates on datasets": f"{scale.updates:,}",
        "pre-training batch": f"{scale.batch_size}" if scale.batch_size else "512, or the method's own",
        "prototypes": str(dict(scale.loss.get("crptpro", ())).get("num_prototypes", 512)),
        "env steps of exploration (C)": f"{explore.get('env_steps', 200_000):,}",
        "decisions per encoder update (C)": str(explore.get("encoder_update_interval", 2)),
        "downstream env steps": f"{run.get('env_steps', ENV_STEPS):,}",
        "DrQ's env steps": f"{drq.get('env_steps', DRQ_ENV_STEPS):,}",
        "downstream batch": f"{run.get('batch_size', 512)}",
        "downstream learning rate": f"{run.get('learning_rate', 1e-4):g}",
        "downstream replay": f"{run['replay_capacity']:,}"
        if "replay_capacity" in run
        else "40,000 (Proto-RL 100,000)",
        "downstream seeds per encoder": "not printed (at least 6 evaluations)"
        if is_paper
        else f"{scale.seeds}",
        "render quality": scale.quality,
    }


def _counted(caption: str, found: Counter[str]) -> Table:
    rows = tuple(cells(text, str(count)) for text, count in found.most_common())
    return Table(caption, (caption.lower(), "pieces or runs"), rows)
