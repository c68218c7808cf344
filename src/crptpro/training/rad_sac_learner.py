"""The SAC learner: which loss steps which optimiser, and when."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import SoftUpdate

from crptpro.objectives import RADSACLoss
from crptpro.objectives.base import mask_keys
from crptpro.training.captured import CapturedCall, portable_state, prepare_optimizer
from crptpro.training.compiled import Compiled


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
        compiled: whether, and how strictly, the losses are compiled; by default they are not.
        captures: on a GPU, record the updates as CUDA graphs, one per combination of what they step, and replay
            them. The action noise is then drawn on the GPU, by a generator seeded as the loss's.
    """

    def __init__(
        self,
        loss: RADSACLoss,
        *,
        learning_rate: float = 1e-4,
        critic_tau: float = 0.01,
        actor_update_interval: int = 2,
        target_update_interval: int = 2,
        compiled: Compiled | None = None,
        captures: bool = False,
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
        self.compiled = compiled or Compiled(is_on=False)
        self._critic_loss = self.compiled.wrap(loss.critic_loss)
        self._actor_loss = self.compiled.wrap(loss.actor_and_temperature_loss)
        self.captures = captures
        self.device = loss.log_alpha.device
        self.generator: torch.Generator | None = None
        self._captured: dict[tuple[bool, bool], CapturedCall] = {}
        if captures:
            self._prepare_to_capture()

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
        kind = (
            agent_step % self.actor_update_interval == 0,
            agent_step % self.target_update_interval == 0,
        )
        if not self.captures:
            return self._advance(td, *kind)
        if kind not in self._captured:
            generators = [] if self.generator is None else [self.generator]
            self._captured[kind] = CapturedCall(
                lambda batch: self._advance(batch, *kind), generators=generators
            )
        steps_ahead = self.loss.value_estimator.tensor_keys.steps_to_next_obs
        optional = (self.loss.tensor_keys.priority_weight, steps_ahead, *mask_keys(self.loss))
        present = [key for key in optional if key in td.keys(True)]
        return self._captured[kind](td.select(*self.loss.in_keys, *present))

    def _advance(self, td: TensorDictBase, with_actor: bool, with_target: bool) -> dict[str, Tensor]:
        losses = self._learn(self._critic_loss, td, {"critic": "loss_qvalue"})
        if with_actor:
            terms = {"actor": "loss_actor", "temperature": "loss_alpha"}
            losses.update(self._learn(self._actor_loss, td, terms))
        if with_target:
            self.target_updater.step()
        return {key: value.detach() for key, value in losses.items()}

    def _learn(
        self,
        evaluate: Callable[[TensorDictBase], TensorDictBase],
        td: TensorDictBase,
        terms: Mapping[str, str],
    ) -> TensorDictBase:
        """Step the optimisers that ``terms`` names, each by its own loss; they share no parameters."""

        def differentiate() -> TensorDictBase:
            for name in terms:
                self.optimizers[name].zero_grad(set_to_none=True)
            losses = evaluate(td)
            # In one pass: what was compiled together can be differentiated once.
            functools.reduce(operator.add, [losses[key] for key in terms.values()]).backward()
            return losses

        losses = self.compiled.attempt(differentiate)
        for name in terms:
            self.optimizers[name].step()
        return losses

    def _prepare_to_capture(self) -> None:
        self._captured = {}
        for optimizer in self.optimizers.values():
            prepare_optimizer(optimizer, self.device)
        if self.device.type == "cuda" and self.generator is None:
            given = self.loss.generator
            self.generator = torch.Generator(self.device)
            self.generator.manual_seed(torch.initial_seed() if given is None else given.initial_seed())
            self.loss.generator = self.generator

    def state_dict(self) -> dict[str, Any]:
        """Return networks, targets, temperature, optimisers and the updater's counter."""
        return {
            "loss": self.loss.state_dict(),
            "target_updater": self.target_updater.state_dict(),
            **{f"optimizer_{name}": self._state_of(optimizer) for name, optimizer in self.optimizers.items()},
            **({} if self.generator is None else {"generator": self.generator.get_state()}),
        }

    def _state_of(self, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
        return portable_state(optimizer) if self.captures else optimizer.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned, in place."""
        self.loss.load_state_dict(state["loss"])
        self.target_updater.load_state_dict(state["target_updater"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state[f"optimizer_{name}"])
        if self.captures:
            self._prepare_to_capture()
        if self.generator is not None and "generator" in state:
            self.generator.set_state(state["generator"])
