"""A short report of one run as Markdown: what was run, what came out, what it does not show."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from crptpro.cards import git_revision, hardware, versions
from crptpro.whole_file import write_whole


def markdown_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Lay rows out as a Markdown table.

    Args:
        rows: column name to cell; columns are the keys of the first row, in order. A later row's missing cell
            stays empty, its further keys are left out.

    Returns:
        The table without a newline at its end; an empty string for no rows.

    Examples:
        >>> print(markdown_table([{"task": "walker_run", "return": 512}]))
        | task | return |
        | --- | --- |
        | walker_run | 512 |
    """
    if not rows:
        return ""
    columns = list(rows[0])
    lines = ["| " + " | ".join(columns) + " |", "|" + " --- |" * len(columns)]
    for row in rows:
        cells = (str(row.get(column, "")).replace("|", "\\|") for column in columns)
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def write_report(
    path: str | Path,
    *,
    title: str,
    command: str,
    summary: str,
    tables: Mapping[str, Sequence[Mapping[str, Any]]],
    figures: Mapping[str, str | Path],
    caveats: Sequence[str] = (),
) -> Path:
    """Write a Markdown report beside its figures, whole or not at all.

    Args:
        path: the ``.md`` file, figures are linked relative to it.
        title: heading.
        command: what reproduces the run.
        summary: the result in a sentence or two.
        tables: heading to rows.
        figures: caption to picture.
        caveats: what the result does not show.

    Returns:
        ``path``.

    Raises:
        OSError: the file cannot be written; what was there before is kept.
    """
    path = Path(path)
    machine = hardware()
    gpus = ", ".join(machine["gpus"]) or "no GPU"
    parts = [f"# {title}", summary, f"Made by `{command}`."]
    for heading, rows in tables.items():
        parts += [f"## {heading}", markdown_table(rows)]
    for caption, figure in figures.items():
        parts += [f"## {caption}", f"![{caption}]({os.path.relpath(figure, path.parent)})"]
    if caveats:
        parts += ["## What this does not show", "\n".join(f"- {caveat}" for caveat in caveats)]
    installed = ", ".join(f"{name} {version}" for name, version in versions().items())
    parts += [
        "## Made with",
        f"{machine['cpu']} ({machine['cpu_instructions']}), {machine['cpu_cores']} cores, "
        f"{machine['ram_bytes'] / 2**30:.0f} GiB RAM, {gpus}.\n\n"
        f"{installed}; source revision {git_revision()}.",
    ]
    return write_whole(path, "\n\n".join(parts) + "\n")
