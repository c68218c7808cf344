"""What the data and the agents look like: sampled observations of datasets, strips of evaluation videos."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from crptpro.data.incoming import dataset_path
from crptpro.errors import CRPTproError
from crptpro.experiments.plots import draw_stacks
from crptpro.experiments.report import drawing
from crptpro.experiments.report.blocks import Block, Bullets, Figure, Paragraph, counted
from crptpro.experiments.report.canvas import theme
from crptpro.experiments.report.reading import Made
from crptpro.experiments.report.runs import Placed

STACKS, STILLS = 4, 8
"""Observations per dataset, and stills per video."""


def observations(pieces: Iterable[Made]) -> tuple[Block, ...]:
    """Show sampled observations of the first finished dataset of every domain and colours.

    Args:
        pieces: all; those that are no datasets are passed over.
    """
    from crptpro.data import FrameDataset

    opened: dict[str, Any] = {}
    problems = []
    for piece in pieces:
        if piece.kind != "dataset" or piece.done is None:
            continue
        domain, colors = str(piece.description.get("domain")), str(piece.description.get("colors", "normal"))
        name = domain if colors == "normal" else f"{domain}, {colors}"
        if name in opened:
            continue
        try:
            opened[name] = FrameDataset.open(dataset_path(piece.directory, domain))
        except CRPTproError as reason:
            problems.append(f"{name}: {reason}")
    blocks: list[Block] = []
    if opened:
        with theme():
            picture = draw_stacks(opened, stacks=STACKS)
            for axis in picture.axes:
                axis.grid(visible=False)
        caption = (
            f"{STACKS} observations of each domain as a random policy collected them, each of several pictures, oldest "
            "to newest."
        )
        blocks.append(Figure("observations", caption, picture, is_photo=True))
    if problems:
        blocks += [Paragraph("Datasets whose pictures are not shown:", "note"), Bullets(tuple(problems))]
    return tuple(blocks)


def videos(placed: Iterable[Placed]) -> tuple[Block, ...]:
    """Show stills of the last evaluation video of one run per label and row.

    Args:
        placed: runs, which may have a directory ``videos``.
    """
    newest: dict[str, Path] = {}
    for p in placed:
        found = sorted((p.run.directory / "videos").glob("*.mp4"))
        if found and found[-1] not in newest.values():  # two variants may be one run
            newest.setdefault(f"{p.label} on {p.spot}", found[-1])
    if not newest:
        return ()
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        shown = counted(len(newest), "evaluation video")
        text = f"{shown} not shown: install the extra with `pip install 'crptpro[video]'`."
        return (Paragraph(text, "note"),)
    strips: dict[str, list[np.ndarray]] = {}
    problems = []
    for name, path in newest.items():
        try:
            strips[f"{name}: {path.stem.replace('_', ' ')}"] = stills(path)
        except (OSError, RuntimeError, ValueError) as reason:
            problems.append(f"{path} cannot be read as a video ({_first_line(reason)}).")
    blocks: list[Block] = []
    if strips:
        caption = (
            "Evaluation videos, from the beginning of the episode to its end: the last video of one run each."
        )
        blocks.append(Figure("videos", caption, _draw(strips), is_photo=True))
    return (*blocks, *(Paragraph(problem, "note") for problem in problems))


def stills(path: Path, count: int = STILLS) -> list[np.ndarray]:
    """Read pictures from a video, evenly spread from the first to the last.

    Args:
        path: of the video.
        count: how many, at most.

    Returns:
        RGB pictures, uint8 ``[H, W, 3]``.

    Raises:
        OSError: it cannot be read.
        RuntimeError: likewise.
        ValueError: likewise.
    """
    import imageio.v2 as imageio

    opened: Any = imageio.get_reader(path, format="FFMPEG")
    with opened as reader:
        length = int(reader.count_frames())
        wanted = set(np.linspace(0, max(length - 1, 0), min(count, max(length, 1))).astype(int).tolist())
        pictures = [np.asarray(picture) for at, picture in enumerate(reader) if at in wanted]
    if not pictures:
        raise ValueError("it has no pictures")
    return [_small(picture) for picture in pictures]


def _small(picture: np.ndarray) -> np.ndarray:
    """Undo the enlargement with which videos are written, as far as a page needs."""
    step = max(picture.shape[0] // 120, 1)
    return picture[step // 2 :: step, step // 2 :: step]


def _draw(strips: Mapping[str, list[np.ndarray]]) -> Any:
    return drawing.strips(strips, size=1.15)


def _first_line(reason: Exception) -> str:
    return (str(reason).strip().splitlines() or [type(reason).__name__])[0]
