"""What a command checks before it starts, so that a refused request leaves nothing behind, and its records."""

from __future__ import annotations

import ast
import os
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from crptpro.domains import GROUPS, GYMNASIUM_PREFIX, PAPER_DOMAINS, TASKS, expand_groups, known_names
from crptpro.errors import CRPTproError, DatasetError
from crptpro.logging import RunLogger, WandbOptions


@dataclass(frozen=True)
class Logging:
    """Where metrics go besides the local CSV and JSONL records, which are always written."""

    wandb: Literal["off", "auto", "offline", "online"] = "off"
    """mirror to Weights & Biases; auto is online when logged in, else offline"""
    wandb_project: str | None = None
    """W&B project (default: $WANDB_PROJECT, or crptpro)"""
    wandb_group: str | None = None
    """W&B group (default: $WANDB_RUN_GROUP, or none)"""
    wandb_tags: Annotated[tuple[str, ...], arg(help_behavior_hint="(default: none)")] = ()
    """W&B tags"""
    tensorboard: bool = False
    """also write TensorBoard event files"""

    def open(self, run_dir: Path, config: Any) -> AbstractContextManager[RunLogger | None]:
        """Open the record of a run and its mirrors; without mirrors the run opens its record itself, when it starts."""
        if self.wandb == "off" and not self.tensorboard:
            return nullcontext()
        options = None
        if self.wandb != "off":
            options = WandbOptions(
                project=self.wandb_project, group=self.wandb_group, tags=self.wandb_tags, mode=self.wandb
            )
        return RunLogger(run_dir, config=config, wandb=options, tensorboard=self.tensorboard)


def named_values(option: str, words: Sequence[str]) -> dict[str, Any]:
    """Read settings given as ``NAME=VALUE``.

    Raises:
        CRPTproError: naming what is none.

    Examples:
        >>> named_values("--loss", ["num_prototypes=16", "intr_loss_coef=5e-3", "kind=mean"])
        {'num_prototypes': 16, 'intr_loss_coef': 0.005, 'kind': 'mean'}
    """
    found = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not name.isidentifier() or not equals:
            raise CRPTproError(f"{option} {word}: write NAME=VALUE, e.g. num_prototypes=128.")
        try:
            found[name] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            found[name] = value
    return found


def explored_domains(names: Sequence[str], method: str) -> list[str]:
    """Expand the domains that a method is to explore.

    Raises:
        CRPTproError: if one is a path: such a method collects its own data.
        UnknownNameError: if no name is given, or one that nobody knows.
    """
    for name in names:
        is_path = Path(name).is_dir() or ("/" in name and not name.startswith(GYMNASIUM_PREFIX))
        if is_path and name not in (*GROUPS, *known_names()):  # a folder may be called walker
            raise CRPTproError(
                f"{method} explores and collects its own data; {name} is a path. Name domains, tasks or groups "
                f"({', '.join(GROUPS)}), or choose a method that learns from datasets."
            )
    return expand_groups(names)


def image_format(datasets: Sequence[Path]) -> tuple[int, int]:
    """Open every dataset and check that all show images of one form.

    Returns:
        Image size in pixels and frames per stack.

    Raises:
        DatasetError: if there is none, one cannot be read, or they differ.
    """
    from crptpro.data import FrameDataset

    if not datasets:
        raise DatasetError(
            "Name at least one dataset directory, e.g. data/walker (made by `crptpro collect`)."
        )
    for path in datasets:
        if not path.exists() and str(path) in (*GROUPS, *PAPER_DOMAINS, *TASKS):
            raise DatasetError(
                f"{path} is no directory. This method learns from datasets: `crptpro collect {path}` makes them, "
                "data/... by default."
            )
    opened = {path: FrameDataset.open(path) for path in datasets}
    sizes = {path: (dataset.image_size, dataset.frame_stack) for path, dataset in opened.items()}
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{path} has {size} px, {stack} frames" for path, (size, stack) in sizes.items())
        raise DatasetError(f"One encoder needs images of one size and stack: {listed}.")
    return next(iter(sizes.values()))


def require_writable(path: Path, option: str = "--csv") -> None:
    """Refuse what no file can become, and make nothing yet.

    Args:
        path: of the file to be.
        option: by which it was asked for.

    Raises:
        CRPTproError: it is a directory or a device, or lies below a file or in a directory that may not be written to.
    """
    if path.is_dir():
        raise CRPTproError(f"{option} {path} is a directory; name a file in it.")
    if path.exists() and not path.is_file():  # a finished file takes its place: /dev/stdout would be gone
        raise CRPTproError(f"{option} {path} is no ordinary file; name one.")
    there = next(parent for parent in path.absolute().parents if parent.exists())
    if not there.is_dir():
        raise CRPTproError(f"{option} {path} cannot be written: {there} is a file.")
    if not os.access(there, os.W_OK | os.X_OK):
        raise CRPTproError(f"{option} {path} cannot be written: you may not write to {there}.")
