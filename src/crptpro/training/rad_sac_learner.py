"""The SAC learner: which loss steps which optimiser, and when."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import SoftUpdate

from crptpro.objectives import RADSACLoss


class RADSACLearner:
    """Update actor, critic, temperature and target critic on the reference schedule.

    Every update steps the critic; every ``actor_update_interval``-th also the actor and then the
    temperature; every ``target_update_interval``-th then moves the target critic. Each of the three has
    its own Adam (default betas), as in Proto-RL's and CRPTpro's released agents. DrQ learns on the same schedule;
    its critic includes the convolutions.

    Args:
        loss: the SAC losses, one view or two, on features or pixels; its parameters are trained in place.
        learning_rate: of all three optimisers.
        critic_tau: share of the critic that enters the target at each target update.
        actor_update_interval: updates between two actor and temperature steps.
        target_update_interval: updates between two target updates.
    """

    def __init__(
        self,
        loss: RADSACLoss,
        *,
        learning_rate: float = 1e-4,
        critic_tau: float = 0.01,
        actor_update_interval: int = 2,
        target_update_interval: int = 2,
    ) -> None:
        self.loss = loss
        self.actor_update_interval = actor_update_interval
        self.target_update_interval = target_update_interval
        self.target_updater = SoftUpdate(loss, tau=critic_tau)
        groups = {
            "critic": list(loss.critic.parameters()),
            "actor": list(loss.actor.parameters()),
            "temperature": [loss.log_alpha],
        }
        self.optimizers = {
            name: torch.optim.Adam(group, lr=learning_rate, fused=True) for name, group in groups.items()
        }

    def update(self, td: TensorDictBase, *, agent_step: int) -> dict[str, Tensor]:
        """Do one update on a batch.

        Args:
            td: batch with ``features`` ``[B, D]``, ``action`` ``[B, A]``, ``("next", "features")``,
                ``("next", "reward")`` ``[B, 1]`` (bonus included) and ``("next", "terminated")``; with other or
                further views where the loss names them.
            agent_step: the decision about to be taken; the delayed updates run on its multiples.

        Returns:
            Detached scalars: losses, mean Q, entropy, temperature.
        """
        losses = self.loss.critic_loss(td)
        self._step("critic", losses["loss_qvalue"])
        if agent_step % self.actor_update_interval == 0:
            losses.update(self.loss.actor_and_temperature_loss(td))
            self._step("actor", losses["loss_actor"])
            self._step("temperature", losses["loss_alpha"])
        if agent_step % self.target_update_interval == 0:
            self.target_updater.step()
        return {key: value.detach() for key, value in losses.items()}

    def _step(self, name: str, loss: Tensor) -> None:
        optimizer = self.optimizers[name]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()

    def state_dict(self) -> dict[str, Any]:
        """Return networks, targets, temperature, optimisers and the updater's counter."""
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
