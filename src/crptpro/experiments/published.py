"""Every number that the paper prints, and two public records beside it, to stand next to one's own.

Source, unless another is named: CRPTpro, arXiv 2302.05614, the tables of its section IV. Scores are returns of whole
episodes; "±" is printed without saying over what (results are "over at least 6 different evaluations (60 episodes)").
Figures of the paper carry no numbers and are missing here for that reason.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

METHODS = ("crptpro", "atc", "apt-c", "proto-rl-c", "becl")
"""The cross-domain methods of the paper's score tables, in its order of columns."""

ENV_STEPS = 500_000
"""Budget of every score below in env steps, except DrQ's."""
DRQ_ENV_STEPS = 1_000_000
"""Budget of the DrQ column in env steps."""


class Score(NamedTuple):
    """A printed ``mean±std`` of episode returns."""

    mean: float
    std: float


@dataclass(frozen=True)
class ScoreRow:
    """One task of a score table.

    Args:
        group: whose domains the encoders were pre-trained on, a letter of :data:`crptpro.domains.GROUPS`.
        task: what was learned downstream, a key of :data:`crptpro.domains.TASKS`.
        scores: method to score; ``drq`` stands in the table of seen domains only.
        has_reversed_colors: the background's RGB values were put in reverse order downstream.
    """

    group: str
    task: str
    scores: Mapping[str, Score]
    has_reversed_colors: bool = False


def _row(group: str, task: str, *cells: tuple[float, float], reversed_colors: bool = False) -> ScoreRow:
    methods = (*METHODS, "drq")[: len(cells)]
    return ScoreRow(group, task, {m: Score(*c) for m, c in zip(methods, cells)}, reversed_colors)


SEEN: tuple[ScoreRow, ...] = (
    _row("A", "cheetah_run", (611, 44), (300, 29), (284, 8), (421, 82), (287, 222), (807, 75)),
    _row("A", "walker_run", (513, 33), (271, 16), (312, 37), (431, 83), (130, 79), (485, 181)),
    _row("A", "quadruped_run", (242, 78), (145, 73), (201, 95), (191, 80), (343, 45), (139, 64)),
    _row("B", "cartpole_swingup_sparse", (722, 51), (0, 0), (20, 23), (693, 43), (529, 397), (315, 243)),
    _row("B", "pendulum_swingup", (865, 26), (524, 341), (182, 98), (868, 35), (21, 9), (635, 218)),
    _row("B", "reach_duplo", (163, 22), (7, 6), (5, 4), (47, 31), (80, 20), (27, 11)),
    _row("C", "reach_duplo", (146, 31), (8, 11), (10, 10), (37, 31), (93, 24), (27, 11)),
    _row("C", "hopper_hop", (206, 4), (2, 1), (4, 7), (160, 30), (3, 1), (283, 32)),
    _row("C", "finger_spin", (873, 157), (883, 125), (954, 23), (858, 182), (336, 425), (938, 103)),
    _row("D", "walker_run", (509, 60), (200, 16), (215, 5), (433, 73), (151, 96), (485, 181)),
    _row("D", "pendulum_swingup", (875, 25), (357, 249), (86, 115), (513, 294), (22, 8), (635, 218)),
    _row("D", "hopper_hop", (210, 12), (3, 3), (22, 25), (146, 32), (2, 1), (283, 32)),
)
"""Table "Performance comparison on cross-domain pre-training": tasks of the group the encoder was pre-trained on."""

SEEN_MEAN: Mapping[str, float] = {"crptpro": 495, "atc": 225, "apt-c": 191, "proto-rl-c": 400, "becl": 166}
"""The row "Mean Score" of :data:`SEEN`, as printed."""

SEEN_NORMALIZED_MEAN: Mapping[str, float] = {
    "crptpro": 1.956, "atc": 0.440, "apt-c": 0.412, "proto-rl-c": 1.096, "becl": 0.993,
}  # fmt: skip
"""The row "Mean Expert-Normalized Score" of :data:`SEEN`, as printed.

The table's own rounded cells give 1.957, 0.441, 0.420, 1.097 and 0.994: rounding explains a thousandth, but not the
0.412 of apt-c (see :func:`normalized_means`).
"""

EXPERT_SCORES: Mapping[str, float] = {row.task: row.scores["drq"].mean for row in SEEN}
"""Task to DrQ's score after 1M env steps: the denominators of the paper's expert-normalised score."""

UNSEEN: tuple[ScoreRow, ...] = (
    _row("A", "pendulum_swingup", (671, 273), (214, 159), (502, 346), (118, 75), (23, 8)),
    _row("A", "finger_spin", (809, 232), (879, 133), (748, 47), (850, 194), (3, 1)),
    _row("A", "hopper_hop", (187, 19), (23, 27), (36, 31), (138, 47), (2, 1)),
    _row("A", "reach_duplo", (62, 18), (10, 13), (18, 19), (20, 7), (64, 37)),
    _row("A", "cartpole_swingup_sparse", (93, 17), (20, 12), (15, 12), (39, 24), (0, 0)),
    _row("C", "cheetah_run", (448, 12), (241, 10), (283, 31), (374, 10), (350, 223)),
    _row("C", "walker_run", (570, 26), (268, 8), (231, 33), (497, 75), (139, 67)),
    _row("C", "quadruped_run", (270, 32), (132, 66), (114, 63), (234, 40), (322, 123)),
    _row("C", "pendulum_swingup", (872, 27), (135, 102), (778, 106), (524, 370), (23, 10)),
    _row("C", "cartpole_swingup_sparse", (682, 98), (0, 1), (9, 10), (94, 79), (0, 0)),
)
"""Table "... generalizing to unseen domains and unseen colors without finetuning", parts (i) and (ii)."""

COLORS: tuple[ScoreRow, ...] = (
    _row("C", "reach_duplo", (163, 16), (34, 20), (15, 9), (55, 52), (5, 6), reversed_colors=True),
    _row("C", "pendulum_swingup", (567, 317), (136, 101), (556, 104), (126, 37), (21, 9),
         reversed_colors=True),
    _row("C", "cheetah_run", (485, 26), (184, 18), (174, 21), (337, 36), (1, 1), reversed_colors=True),
)  # fmt: skip
"""Part (iii) of the same table: the background's RGB values in reverse order."""


@dataclass(frozen=True)
class EfficiencyRow:
    """Cost of pre-training for a number of domains, on an NVIDIA Tesla P100.

    Args:
        method: registered name.
        hours: wall clock for 1, 2 and 3 domains.
        encoder_updates: optimiser steps of the encoder for 1, 2 and 3 domains.
    """

    method: str
    hours: tuple[float, float, float]
    encoder_updates: tuple[int, int, int]


_ONE_BUDGET, _PER_DOMAIN = (50_000, 50_000, 50_000), (125_000, 250_000, 375_000)
EFFICIENCY: tuple[EfficiencyRow, ...] = (
    EfficiencyRow("crptpro", (4.8, 4.8, 4.8), _ONE_BUDGET),
    EfficiencyRow("proto-rl-c", (8.8, 8.8, 8.8), _ONE_BUDGET),
    EfficiencyRow("becl", (9.4, 9.4, 9.4), _ONE_BUDGET),
    EfficiencyRow("apt-c", (12.2, 12.2, 12.2), _ONE_BUDGET),
    EfficiencyRow("proto-rl-s", (18.8, 37.6, 56.4), _PER_DOMAIN),
    EfficiencyRow("apt-s", (20.6, 41.2, 61.8), _PER_DOMAIN),
)
"""Table "Comparison ... on pre-training efficiency"."""

FINETUNE_UPDATES: Mapping[str, int] = {
    "pendulum": 2_000, "manipulation": 2_000, "cartpole": 3_000, "cheetah": 1_000, "walker": 500,
}  # fmt: skip
"""Domain to encoder updates of fine-tuning the group A encoder, section IV.D."""
FINETUNE_TOTAL_UPDATES = 58_500
"""Those of pre-training (50,000) and of all five domains together, as printed."""


@dataclass(frozen=True)
class PrototypeMetrics:
    """How far prototypes spread after pre-training; lower is wider.

    Args:
        method: registered name.
        has_intrinsic_loss: trained with L_intr (the loss named ``intr`` here).
        kne: K-neighbour estimation. Its k and scale are not published; a 3-nearest-neighbour cosine of 512 unit
            vectors in 128 dimensions is about +0.2, so these negative values are none.
        ane: all-neighbour estimation, the sum of the pairwise cosines of different prototypes over M^2.
        intr: value of L_intr, the mean over all M^2 entries.
    """

    method: str
    has_intrinsic_loss: bool
    kne: float
    ane: float
    intr: float


def _metrics(method: str, has_loss: bool, kne: float, ane: float, intr: float) -> PrototypeMetrics:
    # The table is printed in units of 1e-4; here the values are plain.
    return PrototypeMetrics(method, has_loss, kne * 1e-4, ane * 1e-4, intr * 1e-4)


PROTOTYPE_METRICS: tuple[PrototypeMetrics, ...] = (
    _metrics("crptpro", True, -26.545, 7.996, -31.080),
    _metrics("crptpro", False, -10.871, 23.778, -20.505),
    _metrics("proto-rl-c", True, -38.602, 21.635, -50.294),
    _metrics("proto-rl-c", False, -7.701, 51.280, -26.860),
    _metrics("proto-rl-s", True, -80.131, 20.587, -140.213),
    _metrics("proto-rl-s", False, -44.036, 48.774, -80.839),
)
"""Table "Employing efficient prototypical learning facilitates the diffusion of prototypes ..."."""


@dataclass(frozen=True)
class Curve:
    """A published learning curve.

    Args:
        env_steps: where evaluations were made.
        returns: mean episode return of each.
        episodes: per evaluation.
    """

    env_steps: tuple[int, ...]
    returns: tuple[float, ...]
    episodes: int


RELEASED_RUN = Curve(
    env_steps=tuple(range(0, 500_001, 10_000)),
    returns=(
        1, 0, 2, 163, 182, 286, 297, 230, 282, 259, 278, 364, 441, 418, 325, 366, 324, 357, 473, 430, 172, 317, 377,
        395, 378, 282, 382, 499, 441, 406, 540, 539, 504, 440, 573, 577, 587, 613, 596, 566, 626, 610, 637, 665, 606,
        587, 558, 613, 533, 522, 654,
    ),
    episodes=10,
)  # fmt: skip
"""The one run whose log the authors published: CRPTpro on group A, then cheetah_run, seed 1.

Source: liuxin0824/CRPTpro, revision c15caed. The table says 611±44; neighbouring evaluations differ by about 50.
"""


@dataclass(frozen=True)
class DrQBenchRow:
    """DrQ's own published scores on a task.

    Args:
        task: a key of :data:`crptpro.domains.TASKS`.
        at_500k: after 500,000 env steps; mean and population standard deviation over 7 to 10 seeds.
        at_1m: after 1,000,000 env steps.
    """

    task: str
    at_500k: Score
    at_1m: Score


DRQ_BENCH: tuple[DrQBenchRow, ...] = (
    DrQBenchRow("cheetah_run", Score(702, 66), Score(794, 194)),
    DrQBenchRow("walker_run", Score(465, 82), Score(565, 120)),
    DrQBenchRow("hopper_hop", Score(208, 35), Score(267, 40)),
    DrQBenchRow("finger_spin", Score(906, 129), Score(946, 103)),
    DrQBenchRow("pendulum_swingup", Score(584, 343), Score(619, 331)),
    DrQBenchRow("cartpole_swingup_sparse", Score(520, 342), Score(646, 324)),
)
"""What DrQ's authors measured, on the tasks both papers share.

Source: denisyarats/drq, revision dd040f1, ``data/dmc_dreamer_bench.csv``. Close to the paper's DrQ column, except on
cartpole_swingup_sparse.
"""


def normalized_means(rows: Sequence[ScoreRow] = SEEN) -> dict[str, float]:
    """Recompute the mean expert-normalised score of every method from printed cells.

    ``mean over rows of score / EXPERT_SCORES[task]``; the random policy's score is not subtracted, as in the paper.

    Args:
        rows: of one or several tables; a method missing from one of them is left out.

    Returns:
        Method to mean, without DrQ, whose own is 1.

    Examples:
        >>> round(normalized_means()["crptpro"], 3)
        1.957
    """
    shared = [m for m in METHODS if all(m in row.scores for row in rows)]
    return {m: sum(r.scores[m].mean / EXPERT_SCORES[r.task] for r in rows) / len(rows) for m in shared}
