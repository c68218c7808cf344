"""What exploration is paid with, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.transforms import Transform
from torchrl.objectives import LossModule

from crptpro.active_config import ActiveConfig
from crptpro.errors import CRPTproError, UnknownNameError
from crptpro.transforms import ParticleReward, PrototypeReward, SkillContrastReward

IntrinsicRewardBuilder = Callable[[LossModule, ActiveConfig, torch.Generator], Transform]

_BUILDERS: dict[str, IntrinsicRewardBuilder] = {}


def register_intrinsic_reward(name: str, build: IntrinsicRewardBuilder) -> None:
    """Make an intrinsic reward available to :func:`~crptpro.training.pretrain_active` by name.

    Args:
        name: unique.
        build: called with the loss, the resolved settings and a generator. Returns a transform that reads the next
            observation's features (and what else is in the replay) and writes ``("next", "intrinsic_reward")``
            ``[B, 1]`` when it is called with a batch.

    Raises:
        ValueError: the name is taken by another builder.
    """
    if _BUILDERS.get(name, build) is not build:
        raise ValueError(f"The intrinsic reward {name!r} is already registered; choose another name.")
    _BUILDERS[name] = build


def build_reward(name: str, loss: LossModule, config: ActiveConfig, generator: torch.Generator) -> Transform:
    """Build an intrinsic reward by name.

    Raises:
        UnknownNameError: naming the known ones.
    """
    if name not in _BUILDERS:
        raise UnknownNameError(
            f"There is no intrinsic reward {name!r}; known: {', '.join(sorted(_BUILDERS))}."
        )
    return _BUILDERS[name](loss, config, generator)


class ExplorationReward:
    """Pays a batch with an intrinsic reward; the task's own plays no part in exploration.

    Args:
        name: registered name.
        loss: whose networks it reads.
        config: resolved settings.
        seed: of the draws it may make.
    """

    def __init__(self, name: str, loss: LossModule, config: ActiveConfig, *, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        self.transform = build_reward(name, loss, config, self.generator).to(config.device)
        # A transform registers the loss's networks as its own; they belong into the loss's state only.
        networks = {id(tensor) for tensor in (*loss.parameters(), *loss.buffers())}
        named = self.transform.state_dict(keep_vars=True).items()
        self._own = [key for key, value in named if id(value) not in networks]

    @property
    def keeps_candidates(self) -> bool:
        """Whether what it remembers are candidates, which all domains share, and not a statistic of one agent's."""
        return isinstance(getattr(self.transform, "queue", None), Tensor)

    def candidates(self) -> Tensor | None:
        """Return a copy of the candidates, the one that is overwritten next first."""
        if not self.keeps_candidates:
            return None
        queue, pointer = self.transform.queue, self.transform.queue_pointer
        return queue.roll(-int(pointer), 0).clone()

    def pay(self, batch: TensorDictBase) -> Tensor:
        """Replace ``("next", "reward")`` by the intrinsic reward, and return the mean of that."""
        self.transform(batch)
        intrinsic = batch["next", "intrinsic_reward"]
        batch["next", "reward"] = intrinsic
        return intrinsic.mean()

    def state_dict(self) -> dict[str, Any]:
        """Return what the reward remembers."""
        state = self.transform.state_dict()
        return {"memory": {key: state[key] for key in self._own}, "generator": self.generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.transform.load_state_dict(state["memory"], strict=False)
        self.generator.set_state(state["generator"])


def _prototype(loss: LossModule, config: ActiveConfig, generator: torch.Generator) -> Transform:
    projector, prototypes = _networks(loss, "prototype", "projector", "prototypes")
    return PrototypeReward(
        projector,
        prototypes,
        knn_k=config.knn_k or 3,
        queue_size=config.queue_size,
        reward_key=None,
        generator=generator,
    )


def _particle(loss: LossModule, config: ActiveConfig, generator: torch.Generator) -> Transform:
    (projector,) = _networks(loss, "particle", "projector")
    return ParticleReward(projector, k=config.knn_k or 12, reward_key=None)


def _skill_contrast(loss: LossModule, config: ActiveConfig, generator: torch.Generator) -> Transform:
    (head,) = _networks(loss, "skill-contrast", "projector")
    temperature = getattr(loss, "temperature", 0.5)
    return SkillContrastReward(head, temperature=float(temperature), reward_key=None)


def _networks(loss: LossModule, reward: str, *names: str) -> list:
    missing = [name for name in names if getattr(loss, name, None) is None]
    if missing:
        raise CRPTproError(
            f"The {reward} reward needs a loss with {' and '.join(names)}; {type(loss).__name__} has no "
            f"{' and no '.join(missing)}. Choose another reward."
        )
    return [getattr(loss, name) for name in names]


register_intrinsic_reward("prototype", _prototype)
register_intrinsic_reward("particle", _particle)
register_intrinsic_reward("skill-contrast", _skill_contrast)
