"""An artifact without what only training on it reads: small enough to keep, to send and to publish."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from crptpro.artifact import TRIMMED_FROM
from crptpro.errors import PretrainedError
from crptpro.pretrained.bundle import Pretrained
from crptpro.pretrained.saving import save_pretrained


def trim_pretrained(pretrained: Pretrained, path: str | Path) -> Path:
    """Write what learning a task reads of an artifact, and leave out what only training on it does.

    Kept are the encoder, the actor if there is one, and, of an artifact with prototypes, projector, prototypes and
    queue, which its bonus reads. Left out are predictor, slow copies and further heads, and the projector where there
    are no prototypes: an encoder of BeCL then takes 0.1 MB instead of 165. Learning a task from it gives the same
    numbers, and records name it as the artifact that it comes from; fine-tuning from it is refused, and the state probe
    of an artifact without projector has no rows of z.

    Args:
        pretrained: the artifact, as loaded.
        path: directory to write; an artifact there is replaced, as a whole.

    Returns:
        ``path``.

    Raises:
        PretrainedError: there is nothing on disk that it comes from, or ``path`` is another kind of directory.
        DiskSpaceError: if the disk is full; an artifact there is kept.
    """
    if "weights_sha256" not in pretrained.card:
        raise PretrainedError(
            "Only an artifact that was read from disk can be trimmed; save_pretrained it, load_pretrained it."
        )
    left_out: dict[str, Any] = {
        "predictor": None,
        "target_encoder": None,
        "target_projector": None,
        "rest": {},
    }
    if pretrained.prototypes is None or pretrained.projector is None:
        left_out |= {"projector": None, "prototypes": None, "queue": None}
    # Who made it, when and on what stays as it was: trimming makes nothing new.
    facts = {key: value for key, value in pretrained.card.items() if key != "modules"}
    return save_pretrained(
        replace(pretrained, **left_out), path, extra_card={**facts, TRIMMED_FROM: pretrained.identity()}
    )
