"""Detection of plateaus and dead runs: a prototype loss of ln(M), or embeddings that all point one way."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Mapping
from statistics import fmean
from typing import Any

from torch import nn

logger = logging.getLogger(__name__)

LOSS_MARGIN = 0.005  # how near to ln(M) counts, as a fraction of it
MAX_COSINE = 0.99


class CollapseMonitor:
    """Watch a pre-training run for collapse and log what it finds.

    A comparative loss of ln(M) (6.238 for 512 prototypes) means that predictions or assignments are uniform; a mean
    pairwise cosine above 0.99 means that every observation has the same embedding. Small trials of the
    paper's loss stay there for about 1,200 updates and then leave. So being there is a ``plateau`` at first, and
    ``dead`` only when it lasts longer than ``patience_updates``. Two observations in a row outside end a plateau. A
    loss without prototypes (None) is watched by cosine only.
    """

    def __init__(self, num_prototypes: int | None = None, *, patience_updates: int = 5_000) -> None:
        self.floor = math.log(num_prototypes) if num_prototypes and num_prototypes > 1 else None
        self.patience_updates = patience_updates
        self.state = "learning"
        self.plateaus: list[dict[str, Any]] = []  # updates at which each was entered, and left
        self.outside_since: int | None = None
        self.cosines: dict[str, float] = {}

    @classmethod
    def of(cls, loss: nn.Module) -> CollapseMonitor:
        weight = getattr(getattr(loss, "prototypes", None), "weight", None)
        return cls(None if weight is None else len(weight))

    def observe(self, updates: int, *, comp: float | None, cosines: Mapping[str, float]) -> str:
        """Record a measurement after ``updates`` updates, and return the new state.

        ``comp`` is the comparative loss in nats, ``cosines`` the mean pairwise one of each domain (their mean decides).
        """
        self.cosines = dict(cosines)
        reasons = self._reasons(comp)
        entered = self.plateaus[-1]["entered"] if self.plateaus else updates
        if self.state == "learning":
            if reasons:
                self.state = "plateau"
                self.plateaus.append({"entered": updates, "left": None})
                logger.info(
                    "Update %d: plateau (%s). Expected to pass; declared dead after %d updates.",
                    updates, reasons, self.patience_updates,
                )  # fmt: skip
        elif not reasons and self.outside_since is not None:
            level, recovery = logging.INFO, ""
            if self.state == "dead":
                level, recovery = logging.WARNING, " (after it was declared dead)"
            length = self.outside_since - entered
            logger.log(level, "Update %d: left the plateau after %d updates%s.", self.outside_since, length, recovery)
            self.plateaus[-1]["left"] = self.outside_since
            self.state = "learning"
        elif reasons and self.state == "plateau" and updates - entered > self.patience_updates:
            self.state = "dead"
            logger.error(
                "Update %d: DEAD RUN: %s since update %d, longer than %d updates. The encoder is not learning; check "
                "the data and the temperatures.",
                updates, reasons, entered, self.patience_updates,
            )  # fmt: skip
        self.outside_since = None if reasons else updates
        return self.state

    def finish(self) -> dict[str, Any]:
        """Log how training ended and return the verdict as plain values."""
        collapsed = sorted(domain for domain, cosine in self.cosines.items() if cosine > MAX_COSINE)
        if self.state == "dead":
            logger.error("Training ended. DEAD RUN: do not use this encoder; check the data and the temperatures.")
        elif self.state == "plateau":
            logger.warning(
                "Training ended on the plateau entered at update %d: the encoder has not begun to learn. That may pass "
                "(small trials of the paper's loss took about 1,200 updates); train longer.",
                self.plateaus[-1]["entered"],
            )
        elif collapsed:
            logger.warning(
                "Embeddings of %s have collapsed (pairwise cosine above %g), not those of every domain.",
                ", ".join(collapsed), MAX_COSINE,
            )  # fmt: skip
        return {"verdict": self.state, "plateaus": copy.deepcopy(self.plateaus), "collapsed_domains": collapsed}

    def state_dict(self) -> dict[str, Any]:
        names = ("state", "plateaus", "outside_since", "cosines")
        return copy.deepcopy({name: getattr(self, name) for name in names})

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        vars(self).update(copy.deepcopy(dict(state)))

    def _reasons(self, comp: float | None) -> str:
        """Return what is wrong now; empty if nothing is."""
        found = []
        if self.floor is not None and comp is not None and abs(comp - self.floor) <= LOSS_MARGIN * self.floor:
            found.append(f"loss {comp:.4f} at ln(M) = {self.floor:.4f}")
        if self.cosines and (mean := fmean(self.cosines.values())) > MAX_COSINE:
            found.append(f"pairwise cosine {mean:.4f}")
        return ", ".join(found)
