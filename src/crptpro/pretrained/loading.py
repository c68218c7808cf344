"""Reading an artifact: verified, rebuilt from its card, refused by name where it does not fit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from crptpro.artifact import CARD_FILE, read_artifact
from crptpro.cards import read_json
from crptpro.errors import PretrainedError
from crptpro.modules import (
    DeterministicActor,
    PixelEncoder,
    Predictor,
    Projector,
    Prototypes,
    SkillHead,
    SquashedGaussianActor,
)
from crptpro.pretrained.bundle import ACTOR, FORMAT, QUEUE, REST, ROLES, TARGET_ROLES, VERSION, Pretrained

_KNOWN_CLASSES: dict[str, type[nn.Module]] = {
    cls.__name__: cls
    for cls in (
        PixelEncoder,
        Projector,
        Predictor,
        Prototypes,
        SkillHead,
        SquashedGaussianActor,
        DeterministicActor,
    )
}


def load_pretrained(
    path: str | Path,
    *,
    expect: Mapping[str, Any] | None = None,
    classes: Mapping[str, type[nn.Module]] | None = None,
) -> Pretrained:
    """Read and verify an artifact; needs nothing but its directory.

    Args:
        path: directory written by :func:`save_pretrained`.
        expect: keyword arguments of :meth:`Pretrained.require`, checked at once.
        classes: class name to class, for networks that are not this library's.

    Returns:
        The networks, bit-equal to those saved, frozen, on the CPU.

    Raises:
        PretrainedError: naming what is missing, truncated, tampered with, of another kind, or does not fit.
    """
    path = Path(path)
    _explain_foreign(path)
    card, tensors = read_artifact(path, format_name=FORMAT, version=VERSION, error=PretrainedError)
    described = card.get("modules")
    if not isinstance(described, dict) or "encoder" not in described:
        held = sorted({name.split(".", 1)[0] for name in tensors})
        raise PretrainedError(f"{path} holds {', '.join(held) or 'no weights'}, but no encoder.")
    known = {**_KNOWN_CLASSES, **(classes or {})}
    modules: dict[str, Any] = {}
    for role, description in described.items():
        state = _take(tensors, role)
        modules[role] = _rebuild(path, role, description, state, known)
    queue = _take(tensors, QUEUE).get("latents")
    rest = _take(tensors, REST)
    if tensors:
        raise PretrainedError(
            f"{path} holds weights its card does not describe: {', '.join(sorted(tensors)[:3])}."
        )
    pretrained = Pretrained(**modules, queue=queue, card=card, rest=rest)
    return pretrained.require(**expect) if expect else pretrained


def _take(tensors: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """Remove and return the tensors of one network."""
    prefix = f"{name}."
    return {key.removeprefix(prefix): tensors.pop(key) for key in list(tensors) if key.startswith(prefix)}


def _rebuild(
    path: Path, role: str, description: Any, state: dict[str, Tensor], known: Mapping[str, type[nn.Module]]
) -> nn.Module:
    if role not in (*ROLES, *TARGET_ROLES, ACTOR) or not isinstance(description, dict):
        raise PretrainedError(
            f"The card of {path} describes an unknown part {role!r}; it is damaged or too new."
        )
    name = str(description.get("class"))
    if name not in known:
        raise PretrainedError(
            f"The {role} in {path} is a {name!r}, which this library does not have. "
            f"Pass load_pretrained(..., classes={{{name!r}: ...}})."
        )
    try:
        module = known[name](**description.get("config", {}))
    except (TypeError, ValueError) as reason:
        raise PretrainedError(f"The card of {path} does not describe a {name}: {reason}") from None
    expected = module.state_dict()
    for key in (*expected, *state):
        if key not in state:
            raise PretrainedError(f"{path} lacks the tensor {role}.{key}.")
        if key not in expected:
            raise PretrainedError(f"{path} holds {role}.{key}, which a {name} does not have.")
        if state[key].shape != expected[key].shape:
            raise PretrainedError(
                f"{path}: {role}.{key} has shape {tuple(state[key].shape)}, "
                f"its card says {tuple(expected[key].shape)}."
            )
    module.load_state_dict(state, assign=True)
    return module.requires_grad_(False).eval()


def _explain_foreign(path: Path) -> None:
    """Name what a directory is, where that says more than what it lacks."""
    if not path.is_dir() or not any(path.iterdir()):
        return
    if not (path / CARD_FILE).exists():
        inside = sorted(card.parent for card in path.glob(f"*/{CARD_FILE}") if _format_of(card) == FORMAT)
        hint = f" Did you mean {inside[0]}?" if inside else ""
        files = ", ".join(sorted(child.name for child in path.iterdir())[:5])
        raise PretrainedError(
            f"{path} is not a pretrained artifact: no {CARD_FILE} among its files ({files}).{hint}"
        )
    if "agent" in (kind := _format_of(path / CARD_FILE)):
        raise PretrainedError(
            f"{path} is a {kind!r}: the actor (and critic) of a downstream run, no pretrained encoder. "
            "Pass the directory that save_pretrained or `crptpro pretrain` wrote."
        )


def _format_of(card: Path) -> str:
    try:
        return str(read_json(card, error=PretrainedError).get("format", ""))
    except PretrainedError:
        return ""
