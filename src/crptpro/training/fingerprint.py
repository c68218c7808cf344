"""What must agree for a checkpoint to be continued, and the words for what does not."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor
from torchrl.objectives import LossModule

from crptpro.errors import CheckpointError
from crptpro.modules.precision import Precision


def describe_loss(loss: LossModule) -> dict[str, Any]:
    """Return a loss's class, plain options, coefficients and tensor shapes."""
    described: dict[str, Any] = {"class": f"{type(loss).__module__}.{type(loss).__qualname__}"}
    for name, value in sorted(vars(loss).items()):
        if not name.startswith("_") and name != "training" and isinstance(value, (bool, int, float, str)):
            described[name] = value
    for name in sorted(getattr(loss, "_schedulable_buffers", ())):
        value = getattr(loss, name, None)
        described[name] = value.item() if isinstance(value, Tensor) and value.numel() == 1 else value
    for name, value in loss.state_dict().items():
        if isinstance(value, Tensor):
            described[f"shape of {name}"] = f"{str(value.dtype).removeprefix('torch.')}{list(value.shape)}"
    return {name: value for name, value in described.items() if not isinstance(value, Tensor)}


def precision_to_continue(asked: Precision, state: Mapping[str, Any] | None) -> Precision:
    """Return the precision of a run: where it is left open, the one that it began with.

    What ``"auto"`` stands for depends on the hardware, and an interrupted run may find itself on another machine.

    Args:
        asked: by the user.
        state: of the checkpoint that is continued, if any.
    """
    if asked != "auto" or state is None:
        return asked
    return state["fingerprint"].get("precision", asked)


def require_same(saved: Mapping[str, Any], now: Mapping[str, Any], where: Any) -> None:
    """Refuse a checkpoint of other settings.

    Raises:
        CheckpointError: naming each setting that differs, with both values.
    """
    old, new = flatten(saved), flatten(now)
    missing = "absent"
    differing = [
        f"{name} was {old.get(name, missing)!r}, now {new.get(name, missing)!r}"
        for name in sorted({*old, *new})
        if old.get(name, missing) != new.get(name, missing)
    ]
    if differing:
        more = f" (and {len(differing) - 5} more)" if len(differing) > 5 else ""
        raise CheckpointError(
            f"{where} holds a run with other settings: {'; '.join(differing[:5])}{more}. "
            "Use the same settings to continue it, or another run directory."
        )


def flatten(value: Any, prefix: str = "") -> dict[str, Any]:
    """Return nested settings under dotted names, entries of lists by their index."""
    if isinstance(value, Mapping):
        items = [(str(key), item) for key, item in value.items()]
    elif isinstance(value, (list, tuple)):
        items = [(f"[{index}]", item) for index, item in enumerate(value)]
    else:
        return {prefix: value}
    flat: dict[str, Any] = {}
    for key, item in items:
        joiner = "" if key.startswith("[") or not prefix else "."
        flat.update(flatten(item, f"{prefix}{joiner}{key}"))
    return flat
