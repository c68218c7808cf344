"""Telling a plateau from a dead run: the prototype loss at ln(M), or embeddings that all point one way."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Mapping
from statistics import fmean
from typing import Any

from torch import nn

logger = logging.getLogger(__name__)

LOSS_MARGIN = 0.005
"""How near to ln(M) counts, as a fraction of it."""
EXIT_OBSERVATIONS = 2
"""Consecutive observations outside that end a plateau, so that noise does not."""


class CollapseMonitor:
    """Watch a pre-training run for collapse and announce what it sees.

    A comparative loss of ln(M) (6.238 for 512 prototypes) means that predictions or assignments are uniform; a mean
    pairwise cosine near 1 means that every observation has the same embedding. Small trials of the paper's loss stay
    there for about 1,200 updates and then leave. So being there is a ``plateau`` at first, and ``dead`` only when it
    lasts longer than ``patience_updates``.

    Args:
        num_prototypes: M; ``None`` for a loss without prototypes, which is watched by cosine only.
        patience_updates: length of a plateau, in updates, beyond which the run is called dead.
        cosine_threshold: mean pairwise cosine above which embeddings count as collapsed.

    Examples:
        >>> monitor = CollapseMonitor(512, patience_updates=1_000)
        >>> [monitor.observe(u, comp=c, cosine=0.5) for u, c in [(100, 6.63), (200, 6.24), (1300, 6.24)]]
        ['learning', 'plateau', 'dead']
        >>> monitor.verdict(1300)["plateau_updates"]
        1100
    """

    def __init__(
        self, num_prototypes: int | None = None, *, patience_updates: int = 5_000, cosine_threshold: float = 0.99
    ) -> None:
        self.floor = math.log(num_prototypes) if num_prototypes and num_prototypes > 1 else None
        self.patience_updates, self.cosine_threshold = patience_updates, cosine_threshold
        self.state = "learning"
        self.plateaus: list[list[int | None]] = []  # [entry update, exit update or None]
        self.outside: list[int] = []  # observations outside the plateau that is not over yet
        self.comp: float | None = None
        self.cosines: dict[str, float] = {}

    @classmethod
    def of(cls, loss: nn.Module) -> CollapseMonitor:
        """Return the monitor of a loss.

        Raw convolutional features are non-negative and share the background, so that healthy ones come close to a
        cosine of 1; those of a projector do not.
        """
        weight = getattr(getattr(loss, "prototypes", None), "weight", None)
        has_projector = isinstance(getattr(loss, "projector", None), nn.Module)
        threshold = 0.99 if has_projector else 0.9999
        return cls(None if weight is None else len(weight), cosine_threshold=threshold)

    def observe(
        self, updates: int, *, comp: float | None = None, cosine: float | Mapping[str, float] | None = None
    ) -> str:
        """Take the measurement after so many updates, and return the state after it.

        ``comp`` is the comparative loss in nats, for a loss that has one; ``cosine`` the mean pairwise cosine of
        embeddings, one number or one per domain (their mean decides).
        """
        self.comp = comp
        if cosine is not None:
            self.cosines = dict(cosine) if isinstance(cosine, Mapping) else {"all": cosine}
        reasons = self._reasons()
        if self.state == "learning":
            if reasons:
                self.state, self.outside = "plateau", []
                self.plateaus.append([updates, None])
                logger.info(
                    "Update %d: plateau (%s). Expected to pass; called dead after %d updates of it.",
                    updates, reasons, self.patience_updates,
                )  # fmt: skip
            return self.state
        entered: Any = self.plateaus[-1][0]
        self.outside = [] if reasons else [*self.outside, updates]
        if len(self.outside) >= EXIT_OBSERVATIONS:
            self.plateaus[-1][1] = left = self.outside[0]
            was_dead, self.state, self.outside = self.state == "dead", "learning", []
            logger.log(
                logging.WARNING if was_dead else logging.INFO, "Update %s: left the plateau after %d updates%s.",
                left, left - entered, " (it had been called dead)" if was_dead else "",
            )  # fmt: skip
        elif reasons and self.state == "plateau" and updates - entered > self.patience_updates:
            self.state = "dead"
            logger.error(
                "Update %d: DEAD RUN: %s since update %d, longer than %d updates. "
                "The encoder is not learning; check the data and the temperatures.",
                updates, reasons, entered, self.patience_updates,
            )  # fmt: skip
        return self.state

    def verdict(self, updates: int) -> dict[str, Any]:
        """Return the judgement after so many updates as plain values; changes nothing.

        ``verdict`` is ``"learning"``, ``"plateau"`` or ``"dead"``, ``plateau_updates`` the total length of the
        ``plateaus``, ``collapsed_domains`` are those whose cosine is above the threshold.
        """
        length = sum((updates if leave is None else leave) - (enter or 0) for enter, leave in self.plateaus)
        return {
            "verdict": self.state,
            "plateaus": [{"entered": enter, "left": leave} for enter, leave in self.plateaus],
            "plateau_updates": length,
            "ln_num_prototypes": self.floor,
            "comp": self.comp,
            "cosine": dict(self.cosines),
            "collapsed_domains": sorted(k for k, v in self.cosines.items() if v > self.cosine_threshold),
        }

    def finish(self, updates: int) -> dict[str, Any]:
        """Announce how training ended and return :meth:`verdict`."""
        verdict = self.verdict(updates)
        if self.state != "learning":
            advice = (
                "DEAD RUN: do not use this encoder; check the data and the temperatures."
                if self.state == "dead"
                else "The encoder has not begun to learn. That may pass (small trials of the paper's loss took about "
                "1,200 updates); train longer."
            )
            logger.log(
                logging.ERROR if self.state == "dead" else logging.WARNING,
                "Training ended at update %d on a plateau entered at update %s (%s). %s",
                updates, self.plateaus[-1][0], self._reasons() or "not left yet", advice,
            )  # fmt: skip
        elif verdict["collapsed_domains"]:
            logger.warning(
                "Embeddings of %s have collapsed (pairwise cosine above %g), not those of every domain.",
                ", ".join(verdict["collapsed_domains"]), self.cosine_threshold,
            )  # fmt: skip
        return verdict

    def state_dict(self) -> dict[str, Any]:
        """Return what a resumed run needs to judge as if never interrupted."""
        names = ("state", "plateaus", "outside", "comp", "cosines")
        return copy.deepcopy({name: getattr(self, name) for name in names})

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        vars(self).update(copy.deepcopy(dict(state)))

    def _reasons(self) -> str:
        """Say what is wrong now; empty if nothing is."""
        found = []
        floor, comp = self.floor, self.comp
        if floor is not None and comp is not None and abs(comp - floor) <= LOSS_MARGIN * floor:
            found.append(f"loss {comp:.4f} at ln(M) = {floor:.4f}")
        if self.cosines and (mean := fmean(self.cosines.values())) > self.cosine_threshold:
            found.append(f"pairwise cosine {mean:.4f}")
        return ", ".join(found)
