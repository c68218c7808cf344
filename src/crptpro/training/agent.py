"""The downstream agent: an encoder and the actor on it, acting on pixels and kept as an artifact."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from crptpro.artifact import read_artifact, write_artifact
from crptpro.cards import provenance
from crptpro.errors import CheckpointError
from crptpro.modules import (
    FixedSkillActor,
    PixelEncoder,
    SquashedGaussianActor,
    resolve_channels_last,
    resolve_precision,
    set_channels_last,
    set_compute_dtype,
)
from crptpro.modules.placement import device_of

AGENT_FORMAT = "crptpro-agent"
AGENT_VERSION = 1


FeatureActor = SquashedGaussianActor | FixedSkillActor
"""Acts on features: ``mode(features)``, ``action_dim``, ``config``."""

ACTORS: dict[str, Callable[..., FeatureActor]] = {
    "SquashedGaussianActor": SquashedGaussianActor,
    "FixedSkillActor": FixedSkillActor.from_config,
}
"""Builders by the class name that an agent's card holds."""


class PixelAgent:
    """Acts on one observation at a time; callable as a deterministic evaluation policy.

    Args:
        encoder: maps pixels to features.
        actor: maps features to actions.
        trains_encoder: whether the encoder changes while the agent learns; otherwise it is frozen, and snapshots
            share it.
    """

    def __init__(self, encoder: PixelEncoder, actor: FeatureActor, *, trains_encoder: bool = False) -> None:
        self.encoder = encoder
        self.actor = actor
        self.trains_encoder = trains_encoder

    @torch.no_grad()
    def __call__(self, pixels: Tensor) -> Tensor:
        """Return ``tanh`` of the mean, float32 ``[A]``, for uint8 ``[C, H, W]`` (no shift, no noise)."""
        features = self.encoder(pixels.unsqueeze(0).to(device_of(self.actor)))
        return self.actor.mode(features).squeeze(0).float().cpu()

    def snapshot(self) -> PixelAgent:
        """Return the agent as it is now; training changes nothing of it."""
        encoder = copy.deepcopy(self.encoder) if self.trains_encoder else self.encoder
        return PixelAgent(encoder, copy.deepcopy(self.actor), trains_encoder=self.trains_encoder)

    def state_dict(self) -> dict[str, dict[str, Tensor]]:
        """Return the weights that learning changes, by network."""
        state = {"actor": self.actor.state_dict()}
        return {**state, "encoder": self.encoder.state_dict()} if self.trains_encoder else state

    def load_state_dict(self, state: Mapping[str, Mapping[str, Tensor]]) -> None:
        """Restore what :meth:`state_dict` returned, in place."""
        self.actor.load_state_dict(state["actor"])
        if self.trains_encoder:
            self.encoder.load_state_dict(state["encoder"])


def save_agent(path: str | Path, agent: PixelAgent, *, card: dict[str, Any]) -> Path:
    """Write encoder and actor with a card; whole or not at all.

    Args:
        path: directory to write or replace.
        agent: what to keep.
        card: what else the reader should know: task, seed, env steps, where the encoder came from.

    Raises:
        DiskSpaceError: if the disk is full; an agent there is kept.
    """
    modules: dict[str, nn.Module] = {"encoder": agent.encoder, "actor": agent.actor}
    content = {
        "modules": {name: module.config for name, module in modules.items()},
        "classes": {"actor": type(agent.actor).__name__},
        **card,
        **provenance(),
    }
    return write_artifact(path, modules, card=content, format_name=AGENT_FORMAT, version=AGENT_VERSION)


def load_agent(path: str | Path) -> tuple[PixelAgent, dict[str, Any]]:
    """Rebuild an agent from its artifact alone.

    It acts in the arithmetic that its run learned and evaluated it in: what the card's ``precision`` and
    ``channels_last`` mean on this machine; in float32 if the card has none.

    Returns:
        The agent, ready to act, and its card.

    Raises:
        CheckpointError: if the directory is missing, damaged, or not an agent.
    """
    card, tensors = read_artifact(
        path, format_name=AGENT_FORMAT, version=AGENT_VERSION, error=CheckpointError
    )
    try:
        encoder = PixelEncoder(**card["modules"]["encoder"])
        actor_class = card.get("classes", {}).get("actor", "SquashedGaussianActor")  # older cards have none
        actor = ACTORS[actor_class](**card["modules"]["actor"])
        for name, module in (("encoder", encoder), ("actor", actor)):
            prefix = f"{name}."
            module.load_state_dict(
                {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
            )
            module.requires_grad_(False).eval()
        learned_with = card.get("config", {})
        dtype = resolve_precision(learned_with.get("precision", "fp32"), "cpu")
        for module in (encoder, actor):
            set_compute_dtype(module, dtype)
        set_channels_last(encoder, resolve_channels_last(learned_with.get("channels_last", "auto")))
    except (KeyError, TypeError, ValueError, RuntimeError) as reason:
        raise CheckpointError(f"{path} holds no agent that can be rebuilt: {reason!r}") from reason
    return PixelAgent(encoder, actor), card
