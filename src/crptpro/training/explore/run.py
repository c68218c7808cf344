"""One active pre-training: decisions in every domain in turn, updates between them, record and checkpoints."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.objectives import LossModule

from crptpro.active_config import ActiveConfig
from crptpro.cards import provenance
from crptpro.loggers import RunLogger
from crptpro.training.checkpoint import CheckpointDir
from crptpro.training.collapse import CollapseMonitor
from crptpro.training.explore import checkpoint
from crptpro.training.explore.batches import PIXELS, ReplayBatches, encode
from crptpro.training.explore.member import Member
from crptpro.training.explore.plan import Plan
from crptpro.training.explore.rewards import ExplorationReward
from crptpro.training.finite import not_finite, require_finite_parameters
from crptpro.training.pretrain.learner import Learner
from crptpro.training.pretrain.progress import PretrainProgress
from crptpro.training.pretrain.window import Window, cosine_threshold, memory_row, num_prototypes
from crptpro.training.stop_request import StopRequest, what_is_kept

logger = logging.getLogger(__name__)


class ActiveRun:
    """State of one call of :func:`~crptpro.training.pretrain_active`.

    Args:
        loss: on the device, in its compute dtype.
        learner: updates the encoder and everything else in the loss.
        members: the domains in the order of their turns.
        batches: of each member's replay.
        rewards: of each member; the same object for all where they share one.
        plan: how many decisions and updates there will be.
        encodes_before_update: whether an agent is trained on features from before the encoder's update of its turn.
        config: every number, resolved.
        fingerprint: what must agree for a checkpoint to be continued.
        precision: for the record.
        records: where rows go, if anywhere.
        checkpoints: where the run is kept, if anywhere.
        run_dir: for messages.
    """

    def __init__(
        self,
        loss: LossModule,
        learner: Learner,
        members: list[Member],
        batches: list[ReplayBatches],
        rewards: list[ExplorationReward],
        *,
        plan: Plan,
        encodes_before_update: bool,
        config: ActiveConfig,
        fingerprint: dict[str, Any],
        precision: str,
        records: RunLogger | None,
        checkpoints: CheckpointDir | None,
        run_dir: Path,
    ) -> None:
        self.loss, self.learner, self.members = loss, learner, members
        self.batches, self.rewards = batches, rewards
        self.encodes_before_update = encodes_before_update
        self.plan, self.config, self.fingerprint, self.precision = plan, config, fingerprint, precision
        self.records, self.checkpoints, self.run_dir = records, checkpoints, run_dir
        self.device = torch.device(config.device)
        self.domains = [member.name for member in members]
        self.window = Window(loss, self.domains)
        self.monitor = CollapseMonitor(
            num_prototypes(loss),
            patience_updates=config.patience_updates,
            cosine_threshold=cosine_threshold(loss),
        )
        self.decisions = self.updates = self.resumed_from = 0
        self.history: list[dict[str, Any]] = []
        self.sums: list[dict[str, Tensor]] = [{} for _ in members]
        self.counts: list[dict[str, int]] = [{} for _ in members]
        self.earlier_seconds = 0.0
        self.made_with = provenance()
        self.started = self.row_started = time.monotonic()
        self.row_updates = 0
        self.saved_at: int | None = None

    @property
    def seconds(self) -> float:
        """Training time so far, resumptions included."""
        return self.earlier_seconds + time.monotonic() - self.started

    @property
    def env_steps(self) -> int:
        """Simulator steps that were begun, over all domains."""
        return self.plan.env_steps_after(self.decisions)

    def train(self, *, progress: bool) -> None:
        """Decide in every domain in turn until the budget is spent."""
        total, count = self.plan.decisions, len(self.members)
        shown = PretrainProgress(self.plan.env_steps, self.env_steps, unit="env step", is_shown=progress)
        next_checkpoint = self._next_checkpoint()
        with StopRequest("Stopping after this round; press Ctrl-C again to stop at once.") as stop, shown:
            while self.decisions < total:
                before, rows = self.env_steps, len(self.history)
                self._turn(self.decisions % count)
                shown.update(self.env_steps - before)
                if len(self.history) > rows:
                    shown.row(self.env_steps, self.history[-1]["loss"])
                is_round = self.decisions % count == 0
                is_due = self.env_steps >= next_checkpoint or stop.signal is not None
                if self.decisions == total and any(self.window.counts):
                    self._log()  # part of a window
                if self.decisions == total or (is_round and is_due):
                    self.save()
                    next_checkpoint = self._next_checkpoint()
                    if stop.signal is not None and self.decisions < total:
                        logger.warning(
                            "Stopped at %s of %s env steps; %s.",
                            f"{self.env_steps:,}", f"{self.plan.env_steps:,}", what_is_kept(self.checkpoints),
                        )  # fmt: skip
                        stop.leave()

    def finish(self) -> tuple[dict[str, float], dict[str, Any]]:
        """Return the last row's metrics and the verdict on collapse; the loss gets the reward's candidates."""
        row = self.history[-1] if self.history else self._last_row()
        metrics = {name: value for name, value in row.items() if name not in ("updates", "env_steps")}
        if len(set(map(id, self.rewards))) == 1:  # downstream goes on with the candidates of all domains
            self.loss.queue = self.rewards[0].candidates()
        return metrics, self.monitor.finish(self.updates)

    def close(self) -> None:
        """Free every render context."""
        errors = []
        for member in self.members:
            try:
                member.close()
            except Exception as reason:
                errors.append(reason)
        if errors:
            raise errors[0]

    # --- one turn -----------------------------------------------------------------------------------------------

    def _turn(self, index: int) -> None:
        """One decision in one domain, and the updates that go with it while its environment moves."""
        member = self.members[index]
        member.decide(self.loss.encoder, self.device)
        self.decisions += 1
        self._update(index)
        self._log_episode(index)

    def _update(self, index: int) -> None:
        """Update encoder and agent, each in its own time.

        Modulo schedules count the domain's own decisions: counted over all domains, an interval that divides their
        number would leave some out for ever.
        """
        config, member, batches = self.config, self.members[index], self.batches[index]
        trains_encoder = self.plan.trains_encoder(member.agent_steps)
        trains_agent = self.plan.trains_agent(member.agent_steps)
        if not (trains_encoder or trains_agent):
            return
        keys = (*PIXELS, *member.agent.views)
        size = config.batch_size or 1
        batch = batches.sample(size)
        if trains_encoder:
            for again in range(self.plan.encoder_updates_each):
                batch = batches.sample(size) if again else batch
                is_last = again == self.plan.encoder_updates_each - 1
                if is_last and trains_agent and self.encodes_before_update:
                    encode(batch, self.loss.encoder, keys)
                values = self.learner.update(batch, index=self.updates, domain=member.name)
                self.window.add(values, index)
                self.updates += 1
                if "embedding_cosine" not in self.learner.names and self._closes_soon():
                    self.window.probe(batch, index)
                if self.updates % config.log_interval == 0:
                    self._log()
        if trains_agent:
            if not (trains_encoder and self.encodes_before_update):
                encode(batch, self.loss.encoder, keys)
            metrics = {"intrinsic_reward": self.rewards[index].pay(batch)}
            # Delays within an agent count its own updates.
            own = member.agent_steps // self.plan.agent_update_interval
            metrics |= member.agent.update(batch, agent_step=own)
            for key, value in metrics.items():
                self.sums[index][key] = self.sums[index].get(key, 0) + value.detach()
                self.counts[index][key] = self.counts[index].get(key, 0) + 1

    def _closes_soon(self) -> bool:
        """Whether a domain's next update may belong to another window: now its images are probed, or not at all."""
        left = -self.updates % self.config.log_interval
        return left < 2 * len(self.members) * self.plan.encoder_updates_each

    # --- records ------------------------------------------------------------------------------------------------

    def _log(self) -> None:
        self.learner.check(self.updates)
        now = time.monotonic()
        row = self.window.row(self.learner.names)
        if self.updates > max(self.row_updates, self.resumed_from) and now > self.row_started:
            row["updates_per_s"] = (self.updates - self.row_updates) / (now - self.row_started)
        row = {**row, **memory_row(self.device)}
        self.monitor.observe(
            self.updates, comp=row.get("comp", row.get("loss_comp")), cosine=self.window.cosines or None
        )
        self.row_started, self.row_updates = now, self.updates
        counters = {"updates": self.updates, "env_steps": self.env_steps}
        self.history.append({**counters, **row})
        if self.records is not None:
            self.records.log(row, stream="pretrain", **counters)
            if explored := self._explored():
                self.records.log(explored, stream="explore", **counters)
        self.window.close()

    def _explored(self) -> dict[str, float]:
        """Mean of every agent's metrics since the last row, by domain."""
        self._check_agents()
        row: dict[str, float] = {}
        for domain, sums, counts in zip(self.domains, self.sums, self.counts):
            # Each by its own count: the actor's metrics come from the delayed updates only.
            row |= {f"{key}/{domain}": float(total) / counts[key] for key, total in sums.items()}
        self.sums, self.counts = [{} for _ in self.members], [{} for _ in self.members]
        return row

    def _check_agents(self) -> None:
        for domain, sums in zip(self.domains, self.sums):
            for key, total in sums.items():
                if not torch.isfinite(total):
                    raise not_finite(
                        f"Update {self.updates} or before: {key} of {domain}'s explorer is {total}"
                    )

    def _log_episode(self, index: int) -> None:
        """Write the episode whose last step was just taken in, if one ended; at its own place, whenever that is."""
        member = self.members[index]
        row, member.finished = member.finished, None
        if self.records is not None and row is not None:
            decisions = (member.agent_steps - 1) * len(self.members) + index + 1
            counters = {"env_steps": self.plan.env_steps_after(decisions), "episodes": member.episodes}
            self.records.log({"domain": member.name, **row}, stream="episodes", **counters)

    def _last_row(self) -> dict[str, Any]:
        rows = [] if self.records is None else self.records.rows("pretrain")
        return {key: value for key, value in rows[-1].items() if key != "unix_time_s"} if rows else {}

    # --- checkpoints --------------------------------------------------------------------------------------------

    def _next_checkpoint(self) -> int:
        interval = self.config.checkpoint_interval_env_steps
        return (self.env_steps // interval + 1) * interval

    def save(self) -> None:
        """Take in every step that has begun, then write everything that a resumed run needs.

        Raises:
            NonFiniteError: if something has diverged; earlier checkpoints are kept.
        """
        for index, member in enumerate(self.members):
            member.settle()
            self._log_episode(index)
        self.learner.check(self.updates)
        self._check_agents()
        for member in self.members:
            require_finite_parameters(member.agent.actor, self.updates)
        if self.checkpoints is None or self.saved_at == self.decisions:
            return
        self.checkpoints.save(checkpoint.state_of(self), counter=self.decisions)
        self.saved_at = self.decisions

    def resume(self, state: Mapping[str, Any] | None) -> None:
        """Continue from a checkpoint; without one, clear the record for a fresh start."""
        if state is None:
            # Rows of an attempt that was killed before its first checkpoint; elsewhere they may be another run's.
            if self.records is not None and self.records.writes_into(self.run_dir):
                for stream in checkpoint.STREAMS:
                    self.records.truncate_to(stream, "env_steps", -1)
            return
        checkpoint.restore(self, state)
        is_finished = self.decisions == self.plan.decisions
        logger.info(
            "active pre-training: %s %s env steps.",
            "already at" if is_finished else "continues from", f"{self.env_steps:,}",
        )  # fmt: skip
