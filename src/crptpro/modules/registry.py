"""How saved networks are described and rebuilt: by the name of their class and the arguments in their ``config``."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from crptpro.errors import CRPTproError
from crptpro.modules.actor_critic import DeterministicActor, SquashedGaussianActor, TwinCritic
from crptpro.modules.encoder import PixelEncoder
from crptpro.modules.heads import AnchorHead, Predictor, Projector, Prototypes, SkillHead
from crptpro.values import as_plain

_Network = TypeVar("_Network", bound=type[nn.Module])

_OURS = (
    AnchorHead, DeterministicActor, PixelEncoder, Predictor, Projector, Prototypes, SkillHead, SquashedGaussianActor,
    TwinCritic,
)  # fmt: skip
_CLASSES: dict[str, type[nn.Module]] = {network.__name__: network for network in _OURS}


def register_network(network: _Network) -> _Network:
    """Register a network class of your own, so that artifacts that hold it can be loaded; also as a decorator.

    An object's attribute ``config`` must hold the keyword arguments that rebuild it. The last registration of a name
    counts; a name of this library's networks raises a ``ValueError``.
    """
    if _CLASSES.get(network.__name__, network) in _OURS and network not in _OURS:
        raise ValueError(f"{network.__name__} is a network of crptpro; give your class another name.")
    _CLASSES[network.__name__] = network
    return network


def describe_network(network: nn.Module) -> dict[str, Any] | None:
    """Return class and arguments of a network, for a card; ``None`` without ``config``. Its class is registered.

    A ``ValueError`` names an argument that JSON cannot hold.
    """
    if not isinstance(config := getattr(network, "config", None), dict):
        return None
    name = register_network(type(network)).__name__
    return {"class": name, "config": as_plain(config, f"{name}.config")}


def rebuild_networks(
    path: object,
    card: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    *,
    roles: Collection[str],
    error: type[CRPTproError],
) -> tuple[dict[str, Any], dict[str, dict[str, Tensor]]]:
    """Build the frozen networks that the card of an artifact describes around its tensors, ``role.key``.

    Returns the networks by role, and the other tensors. Nothing is drawn from the global generator. Raises ``error``,
    which says what is missing, unknown or does not fit.
    """
    parts: dict[str, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        role, key = name.split(".", 1)
        parts.setdefault(role, {})[key] = value.float() if value.dtype == torch.bfloat16 else value
    described = card.get("modules")
    if not isinstance(described, dict) or "encoder" not in described:
        raise error(f"{path} holds {', '.join(sorted(parts)) or 'no weights'}, but no encoder.")
    networks: dict[str, Any] = {}
    for role, description in described.items():
        if role not in roles or not isinstance(description, dict):
            raise error(f"The card of {path} describes an unknown {role!r}; it is damaged or too new.")
        name = str(description.get("class"))
        if (network_class := _CLASSES.get(name)) is None:
            raise error(
                f"The {role} in {path} is a {name!r}, which is not registered. Call "
                "crptpro.modules.register_network for its class first (on the command line: --plugin FILE.py)."
            )
        try:
            # On "meta" no weights are allocated or drawn; other classes may compute with theirs when they are built.
            with torch.random.fork_rng(devices=[]), torch.device("meta" if network_class in _OURS else "cpu"):
                network = network_class(**description.get("config", {}))
            network.load_state_dict(parts.pop(role, {}), assign=True)
        except (TypeError, ValueError) as reason:
            raise error(f"The card of {path} does not describe a {name}: {reason}") from reason
        except RuntimeError as reason:
            raise error(f"The {role} in {path} is not the {name} of its card: {reason}") from reason
        networks[role] = network.requires_grad_(False).eval()
    return networks, parts
