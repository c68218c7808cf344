"""Frames of a dataset drawn again from their stored physical state, in other colours, and kept."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor
from torchrl.envs import TransformedEnv

from crptpro.artifact import read_artifact, write_artifact
from crptpro.data.dataset import FrameDataset
from crptpro.domains import get_domain
from crptpro.errors import DatasetError
from crptpro.seeding import derive_seed
from crptpro.transforms.color_swap import swap_colors
from crptpro.values import Colors, is_drawn

logger = logging.getLogger(__name__)

FORMAT, VERSION = "crptpro-drawn-frames", 1

PROOFS = 4
"""Episodes whose first and last wanted frames are drawn in the dataset's own colours and compared."""
TOLERANCE = 1.0
"""Mean difference, grey levels, that another GL renderer may cause (measured: none on the same machine)."""


@dataclass(frozen=True)
class DrawnFrames:
    """Some frames of one dataset in other colours, see :func:`~crptpro.data.redraw.redraw`.

    Args:
        domain: of the dataset.
        colors: that the frames have.
        rows: int64 ``[N]``, frame rows of the dataset, ascending, each once.
        frames: uint8 ``[N, C, H, W]``.
    """

    domain: str
    colors: Colors
    rows: Tensor
    frames: Tensor

    def __post_init__(self) -> None:
        """Refuse rows that :meth:`at` could not find."""
        if len(self.rows) != len(self.frames):
            raise ValueError(f"There are {len(self.rows)} rows for {len(self.frames)} frames.")
        if len(self.rows) > 1 and not (self.rows.diff() > 0).all():
            raise ValueError("The rows must ascend, each once.")

    def have(self, rows: Tensor) -> Tensor:
        """Return which rows ``[M]`` are among these, as bool ``[M]``."""
        return torch.isin(rows, self.rows)

    def at(self, rows: Tensor) -> Tensor:
        """Return the frames uint8 ``[M, C, H, W]`` of rows ``[M]``, all of which must be among these."""
        return self.frames[torch.searchsorted(self.rows, rows)]

    def save(self, path: str | Path) -> Path:
        """Write a directory, whole or not at all.

        Args:
            path: to write or replace.

        Raises:
            DiskSpaceError: if the disk is full; frames there are kept.
        """
        about = {"domain": self.domain, "colors": self.colors, "count": len(self.rows)}
        content = {"drawn": {"rows": self.rows, "frames": self.frames}}
        return write_artifact(path, content, card=about, format_name=FORMAT, version=VERSION)

    @classmethod
    def load(cls, path: str | Path) -> DrawnFrames:
        """Read what :meth:`save` wrote.

        Raises:
            DatasetError: naming what is missing, damaged, of another kind or too new.
        """
        card, tensors = read_artifact(path, format_name=FORMAT, version=VERSION, error=DatasetError)
        colors = cast(Colors, card["colors"])
        return cls(card["domain"], colors, tensors["drawn.rows"], tensors["drawn.frames"])


def redraw(
    dataset: FrameDataset, rows: Tensor, *, colors: Colors, drawn: DrawnFrames | None = None
) -> Tensor:
    """Return frames of a dataset as its world would have been drawn in other colours.

    Frames in the dataset's own colours are read. Whole images are reversed by reversing them. Everything else is drawn
    again: each episode is begun anew from its own seed, which brings back what the task draws at a reset, and its
    stored ``qpos`` and ``qvel`` are put into the simulator. On the machine and the versions that collected the dataset
    this gives its own frames bit by bit, which is checked for some of them.

    Args:
        dataset: Made by :func:`~crptpro.data.collect_random`.
        rows: int64 ``[N]``, frame rows.
        colors: As of :func:`crptpro.envs.make_env`.
        drawn: Frames of this dataset that were drawn before; only those that are not among them are drawn.

    Returns:
        uint8 ``[N, C, H, W]``.

    Raises:
        DatasetError: if the dataset has no physical state, is not of dm_control, or its own frames come out different;
            if frames that were drawn before are of another domain or of other colours.
    """
    stored = dataset.card.get("colors", "normal")
    if not is_drawn(stored, colors):
        frames = dataset.frames_at(rows)
        return frames if colors == stored else swap_colors(frames)
    wanted, where = rows.unique(return_inverse=True)
    if drawn is None:
        return _redrawn(dataset, wanted, stored, colors)[where]
    if (drawn.domain, drawn.colors) != (dataset.domain, colors):
        raise DatasetError(
            f"Frames of {drawn.domain} in {drawn.colors} were given for {dataset.domain} in {colors}."
        )
    known = drawn.have(wanted)
    frames = torch.empty(len(wanted), *drawn.frames.shape[1:], dtype=drawn.frames.dtype)
    frames[known] = drawn.at(wanted[known])
    if not known.all():
        frames[~known] = _redrawn(dataset, wanted[~known], stored, colors)
    return frames[where]


def _redrawn(dataset: FrameDataset, rows: Tensor, stored: Colors, colors: Colors) -> Tensor:
    """Draw sorted rows, after a proof that the stored state draws the dataset's own frames."""
    groups = _by_episode(dataset, rows)
    proofs = {episode: own[[0, -1]].unique() for episode, own in list(groups.items())[:PROOFS]}
    _compare(dataset, torch.cat(list(proofs.values())), _draw(dataset, proofs, stored))
    return _draw(dataset, groups, colors)


def _by_episode(dataset: FrameDataset, rows: Tensor) -> dict[int, Tensor]:
    """Return sorted frame rows by the episode that they belong to, in order."""
    first = dataset.transitions.get("step") == 0
    starts = dataset.transitions.get("row")[first]
    episodes = dataset.transitions.get("episode")[first]
    of_row = episodes[torch.searchsorted(starts, rows, right=True) - 1]
    return {int(episode): rows[of_row == episode] for episode in of_row.unique()}


def _draw(dataset: FrameDataset, rows: dict[int, Tensor], colors: Colors) -> Tensor:
    # Imported late: nothing that reads datasets needs the simulators.
    from crptpro.envs import make_env

    card = dataset.card
    settings: dict[str, Any] = {
        name: card[name] for name in ("image_size", "action_repeat", "camera", "quality")
    }
    is_swapped = colors == "reversed_image"
    settings["colors"] = "normal" if is_swapped else colors
    env = make_env(get_domain(card["task"]), seed=0, frame_stack=1, **settings)
    base: Any = env.base_env if isinstance(env, TransformedEnv) else env
    images = []
    try:
        if not hasattr(base, "draw_state"):
            raise DatasetError(
                f"The frames of {card['domain']!r} cannot be drawn again from their physical state: that is known for "
                "dm_control's worlds alone. The colours 'reversed_image' need no drawing."
            )
        for episode, own in rows.items():
            env.set_seed(derive_seed(card["seed"], "collect", card["domain"], episode))
            env.reset()
            states = dataset.physics_at(own)
            for qpos, qvel in zip(states["qpos"].numpy(), states["qvel"].numpy()):
                images.append(base.draw_state(qpos, qvel)[None])
    finally:
        env.close()
    return swap_colors(torch.cat(images)) if is_swapped else torch.cat(images)


def _compare(dataset: FrameDataset, rows: Tensor, drawn: Tensor) -> None:
    difference = (dataset.frames_at(rows).float() - drawn.float()).abs()
    if (mean := float(difference.mean())) > TOLERANCE:
        raise DatasetError(
            f"The frames of {dataset.path or dataset.domain} cannot be drawn again from their physical state: they "
            f"come out {mean:.1f} grey levels off. Collect the domain anew in these colours."
        )
    if mean:
        logger.warning(
            "%s was drawn by another renderer than this one: its frames come out %.3g grey levels off.",
            dataset.path or dataset.domain, mean,
        )  # fmt: skip
