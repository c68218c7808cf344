"""One update of any pre-training loss: forward, checks, Adam, target networks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule, SoftUpdate

from crptpro.objectives import MethodDefaults
from crptpro.training.captured import CapturedCall, portable_state, prepare_optimizer
from crptpro.training.compiled import Compiled
from crptpro.training.finite import not_finite, require_finite_parameters
from crptpro.training.pretrain.moments import Moments, digest_of, load_moments


class Learner:
    """Loss, optimiser and target updater of a run.

    Args:
        loss: sums its ``loss*`` entries.
        defaults: Adam, schedule and clipping of the method.
        learning_rate: peak learning rate.
        encoder_tau: EMA rate of the targets, every update; ``None`` for none.
        updates: length of the run, for the schedule.
        compiled: whether, and how strictly, the loss is compiled; by default it is not.
        captures: on a GPU, record the whole update as a CUDA graph and replay it. The learning rate of a
            schedule and the number of the update are tensors then, written before each replay.
        inputs: batches that the caller writes always into this one tensordict, where it ``captures``.
        moments: of an earlier run's Adam, to go on with; by default it starts afresh.
    """

    def __init__(
        self,
        loss: LossModule,
        defaults: MethodDefaults,
        *,
        learning_rate: float,
        encoder_tau: float | None,
        updates: int,
        compiled: Compiled | None = None,
        captures: bool = False,
        inputs: TensorDictBase | None = None,
        moments: Moments | None = None,
    ) -> None:
        self.loss = loss
        self.defaults = defaults
        self.learning_rate = learning_rate
        self.encoder_tau = encoder_tau if has_targets(loss) else None
        self.updates = updates
        parameters = [p for p in loss.parameters() if p.requires_grad]
        if not parameters:
            raise ValueError(
                f"{type(loss).__name__} has no parameters that require a gradient; nothing to train."
            )
        self.parameters = parameters
        self.optimizer = torch.optim.Adam(
            parameters,
            lr=learning_rate,
            betas=defaults.betas,
            eps=defaults.eps,
            weight_decay=defaults.weight_decay,
            fused=True,
        )
        self.moments_digest = None if moments is None else digest_of(moments)
        if moments is not None:
            load_moments(self.optimizer, moments)
        self.updater = None if self.encoder_tau is None else _keep_targets(loss, self.encoder_tau)
        self.names: list[str] = []
        self._loss_count = 0
        # Reading a loss from a GPU would wait for it at every update; there, `check` looks at intervals.
        self.is_deferred = captures or parameters[0].device.type != "cpu"
        self._first_bad: Tensor | None = None
        self._index = torch.zeros((), dtype=torch.int64, device=parameters[0].device)
        self.compiled = compiled or Compiled(is_on=False)
        self._evaluate = self.compiled.wrap(loss)
        self._is_settled = False
        self.captured = CapturedCall(self._captured_update, inputs=inputs) if captures else None
        if captures:
            self._prepare_optimizer()

    def update(self, batch: TensorDictBase, *, index: int, domain: str) -> Tensor:
        """Do update number ``index`` (from 0) and return the scalars of ``names`` as float64, on the device.

        Raises:
            NonFiniteError: on the CPU, before the weights change; on other devices :meth:`check` raises
                later.
        """
        self._set_learning_rate(index)
        self._index.fill_(index)
        if self._is_settled:
            return self._step(batch, domain)
        # What fails to compile does so before the optimiser steps, so that no weight has changed yet.
        values = self.compiled.attempt(lambda: self._step(batch, domain))
        self._is_settled = True
        return values

    def _step(self, batch: TensorDictBase, domain: str) -> Tensor:
        return self._advance(batch, domain) if self.captured is None else self.captured(batch)["values"]

    def _captured_update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        return {"values": self._advance(batch, "any")}

    def _advance(self, batch: TensorDictBase, domain: str) -> Tensor:
        """Do the update; without reading anything back to the host, unless losses are checked on the CPU."""
        if callable(hook := getattr(self.loss, "before_update", None)):
            hook()
        out = self._evaluate(batch)
        if not self.names:
            self._name_outputs(out)
        self._require_same_outputs(out)
        terms = [out.get(name) for name in self.names]
        total = sum(terms[: self._loss_count])
        values = torch.stack([term.detach().reshape(()).float() for term in terms]).double()
        self._watch(values, domain)
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()
        if self.defaults.grad_clip is not None:
            torch.nn.utils.clip_grad_norm_(self.parameters, self.defaults.grad_clip)
        self.optimizer.step()
        if self.updater is not None:
            self.updater.step()
        return values

    def check(self, done: int) -> None:
        """Raise if any update so far had a non-finite loss, or a parameter is not finite now.

        Args:
            done: updates done, for the message.

        Raises:
            NonFiniteError: naming the first update and its term, or the parameter.
        """
        if self._first_bad is not None:
            bad = [(int(u), name) for u, name in zip(self._first_bad.tolist(), self.names) if u >= 0]
            if bad:
                index, name = min(bad)
                raise not_finite(f"Update {index + 1}: {name} is not finite")
        require_finite_parameters(self.loss, done)

    def state_dict(self) -> dict[str, Any]:
        """Return weights, targets and optimiser state."""
        optimizer = self.optimizer.state_dict() if self.captured is None else portable_state(self.optimizer)
        return {"loss": self.loss.state_dict(), "optimizer": optimizer, "names": self.names}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.names = list(state["names"])
        self._loss_count = sum(name.startswith("loss") for name in self.names)
        if self.captured is not None:
            self._prepare_optimizer()
            self.captured.forget()

    def _prepare_optimizer(self) -> None:
        prepare_optimizer(self.optimizer, self._index.device, rate_changes=self._rate_changes)

    @property
    def _rate_changes(self) -> bool:
        return self.defaults.schedule != "constant" or self.defaults.warmup_updates > 0

    def _name_outputs(self, out: TensorDictBase) -> None:
        """Loss terms first, then diagnostics; both must be scalars."""
        keys = [key for key in out.keys(include_nested=False) if isinstance(key, str)]
        terms = _terms(out)
        if not terms:
            raise ValueError(
                f"{type(self.loss).__name__} returned no `loss_*` entry, only {keys}; nothing to minimise."
            )
        for term in terms:
            if out.get(term).numel() != 1:
                shape = tuple(out.get(term).shape)
                raise ValueError(f"{term} has shape {shape}; build the loss with a reduction to a scalar.")
        rest = [key for key in keys if key not in terms and getattr(out.get(key), "numel", lambda: 0)() == 1]
        self.names, self._loss_count = [*terms, *rest], len(terms)

    def _require_same_outputs(self, out: TensorDictBase) -> None:
        """Refuse a term that would be left out of the sum, and an output that comes and goes."""
        held = list(out.keys())
        extra = [key for key in _terms(out) if key not in self.names]
        missing = [name for name in self.names if name not in held]
        if extra or missing:
            what = f"returned {', '.join(extra)}" if extra else f"did not return {', '.join(missing)}"
            raise ValueError(
                f"{type(self.loss).__name__} {what} at update {int(self._index) + 1}, unlike at its first one: every "
                "output must come at every update, a loss term as 0 and a diagnostic as NaN where it has nothing to "
                "say."
            )

    def _watch(self, values: Tensor, domain: str) -> None:
        finite = torch.isfinite(values)
        if not self.is_deferred:
            for name, value, is_finite in zip(
                self.names[: self._loss_count], values.tolist(), finite.tolist()
            ):
                if not is_finite:
                    raise not_finite(f"Update {int(self._index) + 1} on domain {domain!r}: {name} is {value}")
            return
        # No host synchronisation here: the first bad update of each term is remembered on the device.
        if self._first_bad is None:
            self._first_bad = torch.full((self._loss_count,), -1, device=values.device)
        is_first = ~finite[: self._loss_count] & (self._first_bad < 0)
        self._first_bad.copy_(torch.where(is_first, self._index, self._first_bad))

    def _set_learning_rate(self, index: int) -> None:
        if not self._rate_changes:
            return
        warmup_updates = self.defaults.warmup_updates
        if self.defaults.schedule == "constant":
            factor = warmup(index, warmup_updates)
        else:
            factor = warmup_cosine(index, warmup_updates, self.updates)
        rate = self.learning_rate * factor
        for group in self.optimizer.param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate


def warmup(index: int, updates: int) -> float:
    """Factor on the learning rate at update ``index`` (from 0): linear from 0 to 1 over ``updates``, then 1.

    Examples:
        >>> [warmup(i, 2) for i in range(4)]
        [0.0, 0.5, 1.0, 1.0]
    """
    return 1.0 if index >= updates else index / updates


def warmup_cosine(index: int, warmup_updates: int, updates: int) -> float:
    """Factor on the learning rate at update ``index`` (from 0): linear from 0, then half a cosine to 0 (ATC).

    Examples:
        >>> [round(warmup_cosine(i, 2, 6), 2) for i in range(6)]
        [0.0, 0.5, 1.0, 0.85, 0.5, 0.15]
    """
    if index < warmup_updates:
        return index / warmup_updates
    progress = (index - warmup_updates) / max(updates - warmup_updates, 1)
    return (1 + math.cos(math.pi * min(progress, 1.0))) / 2


def _terms(out: TensorDictBase) -> list[str]:
    keys = list(out.keys())
    return [key for key in keys if isinstance(key, str) and key.startswith("loss")]


def has_targets(loss: LossModule) -> bool:
    """Whether the loss has target networks for ``SoftUpdate``."""
    return any(name.startswith("target_") and name.endswith("_params") for name, _ in loss.named_children())


def _keep_targets(loss: LossModule, tau: float) -> SoftUpdate:
    """Build the updater without its side effect of overwriting the targets, which fine-tuning keeps."""
    names = [
        name for name, _ in loss.named_children() if name.startswith("target_") and name.endswith("_params")
    ]
    # Read past LossModule's attribute access, which warns about targets that have no updater yet.
    kept = {name: loss._modules[name].data.clone() for name in names}
    updater = SoftUpdate(loss, tau=tau)
    for name, target in kept.items():
        getattr(loss, name).data.update_(target)
    return updater
