"""Figures of one run, drawn from its records; every axis names its unit."""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor
from torchrl.data import ReplayBuffer

from crptpro.analysis.embeddings import principal_components, sample_pixels


def read_columns(path: str | Path, *columns: str) -> list[tuple[float, ...]]:
    """Return the rows of a CSV record in which every named column is filled.

    Args:
        path: the record, with a header.
        *columns: names; one that the record lacks leaves no row.

    Returns:
        A tuple of floats per row, in the order of ``columns``.

    Raises:
        FileNotFoundError: there is no such record.
        ValueError: a cell that is no number.
    """
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    return [tuple(float(row[c]) for c in columns) for row in rows if all(row.get(c) for c in columns)]


def make_figure(
    rows: int = 1, columns: int = 1, *, width: float = 6.0, height: float = 3.6
) -> tuple[Any, Any]:
    """Return a figure without a window, and its axes ``[rows, columns]``; sizes are a panel's, in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, height * rows), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def plot_pretraining(record: str | Path, out: str | Path, *, num_prototypes: int = 512) -> Path:
    """Draw the comparative loss against ``ln M``, assignment entropy, embedding cosine and prototypes in use.

    Args:
        record: the ``pretrain.csv`` of a run; a column that it lacks leaves its panel empty.
        out: picture to write (its suffix chooses the format).
        num_prototypes: ``M``.

    Returns:
        ``out``.

    Raises:
        FileNotFoundError: there is no such record, or no directory for the picture.
    """
    figure, axes = make_figure(2, 2)
    uniform = math.log(num_prototypes)
    panels: tuple[tuple[str, str, float | None], ...] = (
        ("comp", "comparative loss [nats]", uniform),
        ("assignment_entropy", "assignment entropy [nats]", uniform),
        ("embedding_cosine", "mean pairwise cosine of embeddings", 1.0),
        ("prototypes_in_use", "prototypes in use, mean over batches", None),  # at most one per row of a batch
    )
    for axis, (column, label, reference) in zip(axes.flat, panels):
        points = read_columns(record, "updates", column)
        if points:
            axis.plot(*zip(*points), color="tab:blue", linewidth=1.2)
        if reference is not None:
            axis.axhline(reference, color="0.6", linestyle="--", linewidth=0.8)
        axis.set(xlabel="updates", ylabel=label)
    axes[0, 0].set_title(f"dashed: ln {num_prototypes} = {uniform:.3f}, nothing learned", fontsize=9)
    figure.savefig(out)
    return Path(out)


def plot_learning_curves(
    records: Mapping[str, str | Path],
    out: str | Path,
    *,
    training: Mapping[str, str | Path] | None = None,
    baseline: tuple[float, float] | None = None,
    title: str = "",
) -> Path:
    """Draw mean episode return against env steps, with one standard deviation over episodes.

    Args:
        records: label to the ``eval.csv`` of a run (one row per episode, ``env_steps`` and ``episode_return``).
        out: picture to write (its suffix chooses the format).
        training: label to the ``episodes.csv`` of a run: a dot per training episode, at its end.
        baseline: mean and standard deviation of the uniform random policy's episode returns.
        title: what is learned.

    Returns:
        ``out``.

    Raises:
        FileNotFoundError: there is no such record, or no directory for the picture.
    """
    figure, axes = make_figure(width=7)
    axis = axes[0, 0]
    for label, record in records.items():
        returns = defaultdict(list)
        for env_steps, episode_return in read_columns(record, "env_steps", "episode_return"):
            returns[env_steps].append(episode_return)
        x = sorted(returns)
        mean = [sum(returns[s]) / len(returns[s]) for s in x]
        std = [
            math.sqrt(sum((r - m) ** 2 for r in returns[s]) / max(len(returns[s]) - 1, 1))
            for s, m in zip(x, mean)
        ]
        episodes = {len(returns[s]) for s in x}
        counts = "-".join(str(n) for n in sorted(episodes))
        (line,) = axis.plot(x, mean, marker="o", markersize=3, label=f"{label} ({counts} episodes per point)")
        low, high = [m - s for m, s in zip(mean, std)], [m + s for m, s in zip(mean, std)]
        axis.fill_between(x, low, high, alpha=0.2, color=line.get_color(), linewidth=0)
        if training is not None and label in training:
            dots = read_columns(training[label], "env_steps", "episode_return")
            name = f"{label}, training episodes (exploring)"
            axis.plot(*zip(*dots), ".", color=line.get_color(), alpha=0.5, markersize=5, label=name)
    if baseline is not None:
        center, spread = baseline
        axis.axhline(center, color="0.4", linestyle="--", linewidth=1, label="uniform random policy")
        axis.axhspan(center - spread, center + spread, color="0.4", alpha=0.15, linewidth=0)
    axis.set(xlabel="env steps", ylabel="episode return", title=title)
    axis.legend(fontsize=8)
    figure.savefig(out)
    return Path(out)


def draw_stacks(datasets: Mapping[str, ReplayBuffer], *, stacks: int = 4) -> Any:
    """Show sampled observations, one domain a row: the pictures of each stack, oldest to newest, side by side.

    Args:
        datasets: domain name to replay buffer whose samples hold ``pixels`` uint8 ``[B, 3k, H, W]``. Their
            generators are left as they were.
        stacks: observations per domain.

    Returns:
        Matplotlib's figure.
    """
    import torch

    figure, axes = make_figure(len(datasets), stacks, width=2.6, height=1.15)
    for row, (name, dataset) in zip(axes, datasets.items()):
        pixels = sample_pixels(dataset, stacks, seed=0).cpu()  # (B, C, H, W)
        for axis, stack in zip(row, pixels):
            strip = torch.cat(list(stack.unflatten(0, (-1, 3))), -1)  # (3, H, W * frame_stack)
            axis.imshow(strip.permute(1, 2, 0).numpy())
            axis.set(xticks=[], yticks=[])
        row[0].set_ylabel(name, fontsize=8)
    return figure


def plot_stacks(datasets: Mapping[str, ReplayBuffer], out: str | Path, *, stacks: int = 4) -> Path:
    """Write what :func:`draw_stacks` shows.

    Args:
        datasets: as of :func:`draw_stacks`.
        out: picture to write (its suffix chooses the format).
        stacks: observations per domain.

    Returns:
        ``out``.

    Raises:
        FileNotFoundError: there is no directory for the picture.
    """
    draw_stacks(datasets, stacks=stacks).savefig(out)
    return Path(out)


def plot_embeddings(embeddings: Mapping[str, Tensor], out: str | Path, *, title: str = "") -> Path:
    """Scatter the first two principal components of all domains' embeddings together, coloured by domain.

    Args:
        embeddings: domain name to ``[N, D]``, as of :func:`~crptpro.analysis.embeddings.embed_samples`; D and
            the number of all points at least 2.
        out: picture to write (its suffix chooses the format).
        title: what made them.

    Returns:
        ``out``.

    Raises:
        FileNotFoundError: there is no directory for the picture.
        ValueError: fewer than two points, or dimensions.
    """
    import torch

    points = torch.cat([part.cpu() for part in embeddings.values()])
    coordinates, explained = principal_components(points, components=2)
    figure, axes = make_figure(width=5, height=4.2)
    axis = axes[0, 0]
    for name, part in zip(embeddings, coordinates.split([len(e) for e in embeddings.values()])):
        axis.scatter(*part.T.numpy(), s=8, alpha=0.7, label=name)
    axis.set(
        xlabel=f"first component ({explained[0]:.0%} of variance)",
        ylabel=f"second component ({explained[1]:.0%})",
        title=title,
    )
    axis.legend(fontsize=8)
    figure.savefig(out)
    return Path(out)
