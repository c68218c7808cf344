"""Evaluation videos: useful, optional, and never a reason for a run to fail."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
from functools import cache
from pathlib import Path

from torch import Tensor

logger = logging.getLogger(__name__)


def can_encode() -> bool:
    """Whether the ``video`` extra is installed."""
    return importlib.util.find_spec("imageio_ffmpeg") is not None


def write_video(pictures: Tensor, path: str | Path, *, pictures_per_s: int = 25) -> Path | None:
    """Write an MP4, or say once why not.

    Args:
        pictures: RGB, uint8 ``[T, 3, H, W]``.
        path: file to write; written aside and renamed.
        pictures_per_s: playback rate.

    Returns:
        The file, or ``None`` if the ``video`` extra is missing or encoding failed (a warning says which).
    """
    if not can_encode():
        _warn_once("no video is written: install the extra with `pip install 'crptpro[video]'`.")
        return None
    path = Path(path)
    temporary = path.with_name(f".{path.name}")
    try:
        import imageio.v2 as imageio

        path.parent.mkdir(parents=True, exist_ok=True)
        # Nearest-neighbour enlargement keeps 84 pixels visible on a screen; the codec wants even sizes.
        large = pictures.repeat_interleave(4, -1).repeat_interleave(4, -2).permute(0, 2, 3, 1).numpy()
        imageio.mimwrite(temporary, list(large), format="FFMPEG", fps=pictures_per_s, macro_block_size=4)
        temporary.replace(path)
    except (OSError, RuntimeError, ValueError, ImportError) as reason:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        _warn_once(f"no video is written: {reason}")
        return None
    return path


@cache
def _warn_once(message: str) -> None:
    logger.warning(message)
