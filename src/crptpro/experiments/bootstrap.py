"""Which runs each bootstrap replicate is made of: within every task, or from encoders down to runs.

**Runs.** A replicate redraws every task's runs, with replacement, as many as there are, and independently of the other
tasks (stratified bootstrap; Agarwal et al., 2021, arXiv 2108.13264, section 4.1). Right when runs are independent: each
has an encoder of its own that no other run uses, on whatever task (DrQ, the untrained control), or the statement is
about *these* encoders and not about the method that made them.

**Encoders.** Right when runs share pre-trained encoders and the statement is about the pre-training method: a lucky
encoder lifts all its runs, on all tasks of its group, so that three encoders with four runs on three tasks each are
three independent draws of the method and not thirty-six. A replicate redraws the encoders, once for all tasks that
share them, and then, for each of its places, a downstream run of the encoder drawn (Davison & Hinkley, Bootstrap
Methods and their Application, 1997, section 3.8, both stages with replacement). The intervals are wider wherever
encoders differ. With few of them even these are too narrow: three encoders have but ten different resamples.

**Runs in two rows.** A run that needs no group (DrQ, an encoder of the task's own domain) stands in the row of its task
in every group. It is one draw and not two: rows of the same runs are redrawn alike, on either level.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]

ENOUGH_DRAWS = 10
COVERAGE = {2: 0.50, 3: 0.75, 4: 0.79, 5: 0.84, 6: 0.86, 8: 0.89, 10: 0.90}
"""How often a 95 % percentile interval of the mean of so many draws of a normal law holds its mean: an interval of two
runs is their range, whatever it is called."""


def run_indices(counts: Sequence[int], *, replicates: int, rng: np.random.Generator) -> list[Indices]:
    """Draw runs with replacement within every task.

    Args:
        counts: runs per task.
        replicates: how many resamples, ``B``.
        rng: where chance comes from.

    Returns:
        One ``[B, R_t]`` of indices into its runs per task.
    """
    return [rng.integers(0, count, size=(replicates, count)) for count in counts]


def encoder_indices(
    encoders: Sequence[Sequence[str]],
    *,
    replicates: int,
    rng: np.random.Generator,
    runs: Sequence[Sequence[str]] | None = None,
) -> list[Indices]:
    """Draw encoders with replacement, jointly for the tasks that share them, and then runs of those drawn.

    A task keeps the places that it has: the first encoder's ``n`` runs become ``n`` runs of the first encoder drawn,
    redrawn with replacement, and so on. A task on which an encoder has no run is resampled from those it has, by the
    same random ranks.

    Args:
        encoders: per task, the encoder of each of its runs.
        replicates: how many resamples, ``B``.
        rng: where chance comes from.
        runs: per task, what each run is called; tasks with the same runs are redrawn alike. All different if ``None``.

    Returns:
        One ``[B, R_t]`` of indices into its runs per task.

    Examples:
        >>> rng = np.random.default_rng(0)
        >>> first, second = encoder_indices([["a", "b"], ["a", "b"]], replicates=100, rng=rng)
        >>> bool((first == second).all())  # one run of each encoder: drawing encoders draws both tasks' runs
        True
    """
    own = [sorted(set(labels)) for labels in encoders]
    strata = _strata(own)
    ranks = {}
    for stratum in dict.fromkeys(strata):
        most = max(len(names) for names, s in zip(own, strata) if s == stratum)
        ranks[stratum] = rng.random((replicates, most))
    drawn: list[Indices] = []
    earlier: dict[tuple, Indices] = {}
    for task, (labels, names, stratum) in enumerate(zip(encoders, own, strata)):
        same = (tuple(labels), tuple(runs[task]) if runs is not None else task)
        if same in earlier:
            drawn.append(earlier[same])
            continue
        places = np.array([names.index(label) for label in labels])  # (R,) position of a run's encoder
        counts = np.bincount(places, minlength=len(names))
        # of_encoder[e, i] is the i-th run of encoder e; what is beyond counts[e] is never drawn.
        of_encoder = np.zeros((len(names), counts.max()), dtype=np.int64)
        for encoder in range(len(names)):
            of_encoder[encoder, : counts[encoder]] = np.flatnonzero(places == encoder)
        chosen = (ranks[stratum][:, : len(names)] * len(names)).astype(np.int64)[:, places]  # (B, R)
        nth = (rng.random(chosen.shape) * counts[chosen]).astype(np.int64)
        drawn.append(of_encoder[chosen, nth])
        earlier[same] = drawn[-1]
    return drawn


def _strata(own: Sequence[Sequence[str]]) -> list[int]:
    """Number the sets of tasks that hang together by shared encoders."""
    strata = list(range(len(own)))
    first_seen: dict[str, int] = {}
    for task, names in enumerate(own):
        for name in names:
            other = first_seen.setdefault(name, task)
            if strata[other] != strata[task]:
                joined, gone = sorted((strata[other], strata[task]))
                strata = [joined if s == gone else s for s in strata]
    return strata
