"""The learner of skill-conditioned DDPG: critic, actor and target at every update."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import SoftUpdate

from crptpro.objectives import SkillDDPGLoss


class SkillDDPGLearner:
    """Update the critic, then the actor against it, then the target, every time.

    Each of the two networks has its own Adam (default betas), as in rll-research/url_benchmark ``agent/ddpg.py``.

    Args:
        loss: the DDPG losses; its parameters are trained in place.
        learning_rate: of both optimisers.
        critic_tau: share of the critic that enters the target at each update.
    """

    def __init__(self, loss: SkillDDPGLoss, *, learning_rate: float = 1e-4, critic_tau: float = 0.01) -> None:
        self.loss = loss
        self.target_updater = SoftUpdate(loss, tau=critic_tau)
        groups = {"critic": loss.critic.parameters(), "actor": loss.actor.parameters()}
        self.optimizers = {
            name: torch.optim.Adam(list(group), lr=learning_rate, fused=True)
            for name, group in groups.items()
        }

    def update(self, td: TensorDictBase, *, agent_step: int) -> dict[str, Tensor]:
        """Do one update on a batch.

        Args:
            td: batch with ``features`` ``[B, D]``, ``skill`` ``[B, K]``, ``action`` ``[B, A]``,
                ``("next", "features")``, ``("next", "reward")`` ``[B, 1]`` (n-step return) and
                ``("next", "discount")`` ``[B, 1]``.
            agent_step: not read; every update does the same.

        Returns:
            Detached scalars: losses and mean Q.
        """
        losses = self.loss.critic_loss(td)
        self._step("critic", losses["loss_qvalue"])
        losses.set("loss_actor", self.loss.actor_loss(td))
        self._step("actor", losses["loss_actor"])
        self.target_updater.step()
        return {key: value.detach() for key, value in losses.items()}

    def _step(self, name: str, loss: Tensor) -> None:
        optimizer = self.optimizers[name]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()

    def state_dict(self) -> dict[str, Any]:
        """Return networks, target, optimisers and the updater's counter."""
        return {
            "loss": self.loss.state_dict(),
            "target_updater": self.target_updater.state_dict(),
            **{f"optimizer_{name}": optimizer.state_dict() for name, optimizer in self.optimizers.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned, in place."""
        self.loss.load_state_dict(state["loss"])
        self.target_updater.load_state_dict(state["target_updater"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state[f"optimizer_{name}"])
