"""An artifact without what only training on it reads: small enough to keep, to send and to publish."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from crptpro.artifact import TRIMMED_FROM
from crptpro.errors import PretrainedError
from crptpro.pretrained.bundle import ACTOR, QUEUE, Pretrained
from crptpro.pretrained.saving import refuse_foreign, write_pretrained


def trim_pretrained(pretrained: Pretrained, path: str | Path) -> Path:
    """Write what learning a task reads of an artifact, and leave out what only training on it does.

    Kept are the encoder, the actor if there is one, and, of an artifact with prototypes, projector, prototypes and
    queue, which its bonus reads. Left out are predictor, slow copies and further heads, and the projector where there
    are no prototypes: an encoder of BeCL then takes 0.1 MB instead of 165. Learning a task from it gives the same
    numbers, and records name it as the artifact that it comes from.

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
    path = Path(path)
    refuse_foreign(path)
    roles = ["encoder"]
    if pretrained.prototypes is not None and pretrained.projector is not None:
        roles += ["projector", "prototypes"]
    if pretrained.actor is not None:
        roles.append(ACTOR)
    states: dict[str, Mapping[str, Tensor]] = {role: getattr(pretrained, role).state_dict() for role in roles}
    described: dict[str, Any] = {role: pretrained.card["modules"][role] for role in roles}
    if pretrained.queue is not None and "prototypes" in roles:
        states[QUEUE] = {"latents": pretrained.queue}
    card = {**pretrained.card, "modules": described, TRIMMED_FROM: pretrained.identity()}
    return write_pretrained(path, states, card)
