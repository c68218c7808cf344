"""A plan, and what became of it, in words."""

from __future__ import annotations

from collections.abc import Sequence

from crptpro.experiments.costs import Cost
from crptpro.experiments.durations import duration
from crptpro.experiments.launching.scheduler import Failure
from crptpro.experiments.pieces import Piece
from crptpro.experiments.plan import Plan

KIND_NAMES = {
    "dataset": "datasets of random transitions",
    "untrained": "untrained encoders",
    "encoder": "encoders trained on datasets",
    "explored": "encoders trained by exploring",
    "finetuned": "encoders fine-tuned",
    "run": "downstream runs",
    "redrawn": "observations in other colours",
    "probe": "state probes",
    "timing": "timings, alone on the machine",
    "prototypes": "prototype measurements",
    "coverage": "coverage measurements",
    "embeddings": "embeddings",
}


def plan_text(plan: Plan, cost: Cost, *, jobs: int, device: str) -> str:
    """Say what is needed, what is there, and what the rest will cost.

    Args:
        plan: of the experiments.
        cost: of its missing pieces.
        jobs: at a time.
        device: of networks.
    """
    kinds: dict[str, list[Piece]] = {}
    for piece in plan.pieces:
        kinds.setdefault(piece.kind, []).append(piece)
    order = [kind for kind in KIND_NAMES if kind in kinds]
    order += [kind for kind in kinds if kind not in KIND_NAMES]
    rows = [_row(KIND_NAMES.get(kind, kind), kinds[kind], plan, cost) for kind in order]
    table = _table([("pieces", "needed", "done", "to do", "hours", "disk"), *rows])
    if not plan.missing:
        return table
    lines = [
        table,
        "",
        f"About {duration(cost.wall_seconds)} with {jobs} at a time, and {_gigabytes(cost.disk_bytes)} of disk.",
        _basis(plan, cost, device),
    ]
    return "\n".join(lines)


def failures_text(failures: Sequence[Failure]) -> str:
    """List what was not made, and where to look."""
    failed = [failure for failure in failures if not failure.is_skipped]
    skipped = [failure for failure in failures if failure.is_skipped]
    lines = [f"{len(failed)} failed:"]
    for failure in failed:
        times = "once" if failure.attempts == 1 else f"{failure.attempts} times"
        lines += [
            f"  {failure.piece.key} (tried {times})",
            f"    {failure.reason}",
            f"    log: {failure.log}",
        ]
    if skipped:
        lines.append(f"{len(skipped)} skipped, because they need one that failed:")
        lines += [f"  {failure.piece.key}" for failure in skipped]
    lines.append("The same command tries them again; everything else is kept.")
    return "\n".join(lines)


def _row(name: str, pieces: Sequence[Piece], plan: Plan, cost: Cost) -> tuple[str, ...]:
    missing = [piece.key for piece in pieces if piece.key not in plan.done]
    if not missing:
        return name, str(len(pieces)), str(len(pieces)), "0", "", ""
    hours = sum(cost.seconds[key] for key in missing) / 3_600
    size = sum(cost.bytes[key] for key in missing)
    return (
        name,
        f"{len(pieces):,}",
        f"{len(pieces) - len(missing):,}",
        f"{len(missing):,}",
        f"{hours:,.2f}" if hours < 10 else f"{hours:,.0f}",
        _gigabytes(size),
    )


def _basis(plan: Plan, cost: Cost, device: str) -> str:
    kinds = list(dict.fromkeys(piece.kind for piece in plan.missing))
    measured = [kind for kind in kinds if kind in cost.corrected]
    if measured and len(measured) == len(kinds):
        return "Estimated from what finished pieces took on this kind of machine."
    reference = "estimated from one core of the reference machine (AMD EPYC, Zen 4)"
    if cost.pace is not None:
        reference += f", times {cost.pace:.2g} for networks, as just timed here"
    elif device != "cpu":
        reference += ", which a GPU will beat by far"
    if cost.threads > 1 and cost.pace is None:
        reference += f", though each job has {cost.threads}"
    if not measured:
        return f"Hours are {reference}; they follow this machine once pieces of a kind are finished."
    others = ", ".join(kind for kind in kinds if kind not in measured)
    return f"Hours follow finished pieces of this kind of machine; those of {others} are {reference}."


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:,.1f} GB" if size >= 5e7 else f"{size / 1e6:,.0f} MB"


def _table(rows: Sequence[Sequence[str]]) -> str:
    """Align columns: the first to the left, numbers to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:]))]
        lines.append("  ".join(cells).rstrip())
    lines.insert(1, "-" * len(lines[0]))
    return "\n".join(lines)
