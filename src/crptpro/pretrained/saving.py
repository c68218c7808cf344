"""Writing an artifact from whatever loss has trained it."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor, nn
from torchrl.objectives import LossModule

from crptpro.artifact import CARD_FILE, write_artifact
from crptpro.cards import provenance, read_json
from crptpro.errors import PretrainedError
from crptpro.objectives import method_name_of
from crptpro.pretrained.bundle import ACTOR, FORMAT, QUEUE, REST, ROLES, TARGET_ROLES, VERSION, Pretrained
from crptpro.pretrained.networks import target_state, unwrap

_LOG = logging.getLogger(__name__)


def save_pretrained(
    loss: LossModule | Pretrained,
    path: str | Path,
    *,
    actor: nn.Module | None = None,
    extra_card: Mapping[str, Any] | None = None,
) -> Path:
    """Write what a loss has trained as a directory: ``weights.safetensors`` and ``card.json``.

    Args:
        loss: any loss with the pre-training contract (``.encoder``, and ``.projector``, ``.predictor``,
            ``.prototypes`` where it has them), or a loaded artifact.
        path: directory to write; an artifact there is replaced, as a whole.
        actor: policy that explored meanwhile, for a downstream run in the same domain to start from; a loaded
            artifact's own by default.
        extra_card: further JSON-able facts for the card.

    Returns:
        ``path``.

    Raises:
        PretrainedError: if the loss has no encoder that can be rebuilt, or ``path`` is another kind of
            directory.
        DiskSpaceError: if the disk is full; an artifact there is kept.
    """
    path = Path(path)
    refuse_foreign(path)
    states: dict[str, Mapping[str, Tensor]] = {}
    described: dict[str, dict[str, Any]] = {}
    for role in ROLES:
        module = unwrap(getattr(loss, role, None))
        if module is None:
            continue
        if not isinstance(getattr(module, "config", None), dict):
            if role == "encoder":
                raise PretrainedError(
                    f"The encoder is a {type(module).__name__} without a `.config` of its arguments; "
                    "use crptpro.modules.PixelEncoder or give yours one."
                )
            _LOG.warning("The %s (%s) has no `.config` and is not saved.", role, type(module).__name__)
            continue
        states[role] = module.state_dict()
        described[role] = {"class": type(module).__name__, "config": module.config}
    if "encoder" not in states:
        raise PretrainedError(f"{type(loss).__name__} has no `.encoder`; a pre-training loss exposes it.")
    for target in TARGET_ROLES:
        role = target.removeprefix("target_")
        state = target_state(loss, role)
        if state and role in described:
            states[target], described[target] = state, described[role]
    if actor is None and isinstance(loss, Pretrained):
        actor = loss.actor
    if actor is not None:
        states[ACTOR] = actor.state_dict()
        described[ACTOR] = {"class": type(actor).__name__, "config": actor.config}
    if isinstance(queue := getattr(loss, QUEUE, None), Tensor):
        states[QUEUE] = {"latents": queue}
    if rest := rest_state(loss):
        states[REST] = rest
    encoder = described["encoder"]["config"]
    card = {
        **(loss.card if isinstance(loss, Pretrained) else describe_loss(loss)),
        "modules": described,
        "pixels": {
            "image_size": encoder.get("image_size"),
            "in_channels": encoder.get("in_channels"),
            "frame_stack": encoder.get("in_channels", 0) // 3,
            "pixel_scale": encoder.get("pixel_scale"),
            "pixel_offset": encoder.get("pixel_offset"),
        },
        **provenance(),
        **(extra_card or {}),
    }
    return write_artifact(path, states, card=card, format_name=FORMAT, version=VERSION)


def describe_loss(loss: LossModule) -> dict[str, Any]:
    """Return what the card says of a loss: method, class, options, training."""
    return {
        "method": method_name_of(loss),
        "loss": {
            "class": f"{type(loss).__module__}.{type(loss).__qualname__}",
            "config": _loss_options(loss),
        },
        "training": getattr(loss, "training_record", None),
    }


def _loss_options(loss: LossModule) -> dict[str, Any]:
    """The constructor's plain options, read back from the attributes of the same names."""
    if isinstance(config := getattr(loss, "config", None), dict):
        return config
    options = {}
    for name in inspect.signature(type(loss).__init__).parameters:
        value = getattr(loss, name, inspect.Parameter.empty)
        if isinstance(value, Tensor) and value.ndim == 0:
            value = value.item()
        if value is None and name in ROLES:
            continue
        if value is None or isinstance(value, (bool, int, float, str)):
            options[name] = value
    return options


def rest_state(loss: LossModule | Pretrained) -> dict[str, Tensor]:
    """Return the state of a loss that is not in the networks an artifact names: further heads, coefficients."""
    if isinstance(loss, Pretrained):
        return loss.rest
    covered = [f"{role}{suffix}" for role in (*ROLES, *TARGET_ROLES) for suffix in (".", "_params.")]
    state = loss.state_dict()
    return {
        key: value
        for key, value in state.items()
        if isinstance(value, Tensor) and key != QUEUE and not key.startswith(tuple(covered))
    }


def refuse_foreign(path: Path) -> None:
    """Never replace a directory that is not an artifact.

    Raises:
        PretrainedError: there is one at ``path``.
    """
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    is_artifact = (path / CARD_FILE).exists() and read_json(path / CARD_FILE).get("format") == FORMAT
    if not is_artifact:
        raise PretrainedError(
            f"{path} exists and is not a pretrained artifact; it is not replaced. Choose another directory, "
            f"such as {path / 'encoder'}."
        )
