"""Every number in the paper's tables (arXiv 2302.05614, section IV).

Scores are returns of whole episodes; the paper does not say what its "±" is taken over. Its figures have no numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

METHODS = ("crptpro", "atc", "apt-c", "proto-rl-c", "becl")
"""The cross-domain methods of the paper's score tables, in its order of columns."""
ENV_STEPS, DRQ_ENV_STEPS = 500_000, 1_000_000
"""Budget of every score below in env steps, and of the DrQ column."""


class Score(NamedTuple):
    """A printed ``mean±std`` of episode returns."""

    mean: float
    std: float

    def __str__(self) -> str:
        """Return the score as the paper prints it."""
        return f"{self.mean:g} ± {self.std:g}"


class ScoreRow(NamedTuple):
    """A task of a score table: the pre-training group of its encoders, the task, and scores by method."""

    group: str
    task: str
    scores: dict[str, Score]


def _rows(table: str, methods: tuple[str, ...] = METHODS) -> tuple[ScoreRow, ...]:
    rows = []
    for line in table.strip().splitlines():
        group, task, *cells = line.split()
        scores = (Score(*map(int, cell.split("±"))) for cell in cells)
        rows.append(ScoreRow(group, task, dict(zip(methods, scores, strict=True))))
    return tuple(rows)


SEEN = _rows(
    """
    A cheetah_run              611±44   300±29   284±8    421±82   287±222  807±75
    A walker_run               513±33   271±16   312±37   431±83   130±79   485±181
    A quadruped_run            242±78   145±73   201±95   191±80   343±45   139±64
    B cartpole_swingup_sparse  722±51   0±0      20±23    693±43   529±397  315±243
    B pendulum_swingup         865±26   524±341  182±98   868±35   21±9     635±218
    B reach_duplo              163±22   7±6      5±4      47±31    80±20    27±11
    C reach_duplo              146±31   8±11     10±10    37±31    93±24    27±11
    C hopper_hop               206±4    2±1      4±7      160±30   3±1      283±32
    C finger_spin              873±157  883±125  954±23   858±182  336±425  938±103
    D walker_run               509±60   200±16   215±5    433±73   151±96   485±181
    D pendulum_swingup         875±25   357±249  86±115   513±294  22±8     635±218
    D hopper_hop               210±12   3±3      22±25    146±32   2±1      283±32
    """,
    (*METHODS, "drq"),
)
"""Table "Performance comparison on cross-domain pre-training": tasks of the group the encoder was pre-trained on."""

SEEN_MEAN: Mapping[str, float] = dict(zip(METHODS, (495, 225, 191, 400, 166)))
"""The row "Mean Score" of :data:`SEEN`, as printed."""

SEEN_NORMALIZED_MEAN: Mapping[str, float] = dict(zip(METHODS, (1.956, 0.440, 0.412, 1.096, 0.993)))
"""The row "Mean Expert-Normalized Score" of :data:`SEEN`, as printed.

The table's own cells give 1.957, 0.441, 0.420, 1.097 and 0.994: rounding does not explain the 0.412 of apt-c.
"""

EXPERT_SCORES: Mapping[str, float] = {row.task: row.scores["drq"].mean for row in SEEN}
"""Task to DrQ's score after 1M env steps: the denominators of the paper's expert-normalised score."""

UNSEEN = _rows(
    """
    A pendulum_swingup         671±273  214±159  502±346  118±75   23±8
    A finger_spin              809±232  879±133  748±47   850±194  3±1
    A hopper_hop               187±19   23±27    36±31    138±47   2±1
    A reach_duplo              62±18    10±13    18±19    20±7     64±37
    A cartpole_swingup_sparse  93±17    20±12    15±12    39±24    0±0
    C cheetah_run              448±12   241±10   283±31   374±10   350±223
    C walker_run               570±26   268±8    231±33   497±75   139±67
    C quadruped_run            270±32   132±66   114±63   234±40   322±123
    C pendulum_swingup         872±27   135±102  778±106  524±370  23±10
    C cartpole_swingup_sparse  682±98   0±1      9±10     94±79    0±0
    """
)
"""Table "... generalizing to unseen domains and unseen colors without finetuning", parts (i) and (ii)."""

COLORS = _rows(
    """
    C reach_duplo              163±16   34±20    15±9     55±52    5±6
    C pendulum_swingup         567±317  136±101  556±104  126±37   21±9
    C cheetah_run              485±26   184±18   174±21   337±36   1±1
    """
)
"""Part (iii) of the same table: the background's RGB values in reverse order."""


def published_score(method: str, group: str, task: str, colors: str = "normal") -> Score | None:
    """Return the score that the paper printed for a method, group, task and colours; ``None`` if it printed none.

    DrQ trains its own encoder, so that its score belongs to a task whatever the group.
    """
    rows = {"normal": (*SEEN, *UNSEEN), "reversed_background": COLORS}.get(colors, ())
    for row in rows:
        if method in row.scores and row.task == task and (row.group == group or method == "drq"):
            return row.scores[method]
    return None


class EfficiencyRow(NamedTuple):
    """Cost of pre-training for 1, 2 and 3 domains: hours on an NVIDIA Tesla P100, and encoder updates."""

    hours: tuple[float, float, float]
    encoder_updates: tuple[int, int, int]


_ONE_BUDGET, _PER_DOMAIN = (50_000, 50_000, 50_000), (125_000, 250_000, 375_000)
EFFICIENCY: Mapping[str, EfficiencyRow] = {
    "crptpro": EfficiencyRow((4.8, 4.8, 4.8), _ONE_BUDGET),
    "proto-rl-c": EfficiencyRow((8.8, 8.8, 8.8), _ONE_BUDGET),
    "becl": EfficiencyRow((9.4, 9.4, 9.4), _ONE_BUDGET),
    "apt-c": EfficiencyRow((12.2, 12.2, 12.2), _ONE_BUDGET),
    "proto-rl-s": EfficiencyRow((18.8, 37.6, 56.4), _PER_DOMAIN),
    "apt-s": EfficiencyRow((20.6, 41.2, 61.8), _PER_DOMAIN),
}
"""Table "Comparison ... on pre-training efficiency"."""

FINETUNE_UPDATES: Mapping[str, int] = {
    "pendulum": 2_000, "manipulation": 2_000, "cartpole": 3_000, "cheetah": 1_000, "walker": 500,
}  # fmt: skip
"""Domain to encoder updates of fine-tuning the group A encoder, section IV.D; in all 58,500 with pre-training."""


class PrototypeMetrics(NamedTuple):
    """How far prototypes spread after pre-training: K- and all-neighbour estimation, and L_intr; lower is wider.

    The names are those of the columns of ``pretrain.csv``. The k and the scale of the first are not published; a
    3-nearest-neighbour cosine of 512 unit vectors in 128 dimensions is about +0.2, so these negative values cannot be
    such cosines.
    ANE is the sum of the pairwise cosines of different prototypes over M^2, L_intr the mean over all M^2 entries.
    """

    prototype_kne_3: float
    prototype_ane: float
    prototype_dispersion: float


PROTOTYPE_METRICS: Mapping[str, PrototypeMetrics] = {
    "crptpro": PrototypeMetrics(-26.545, 7.996, -31.080),
    "crptpro without dispersion": PrototypeMetrics(-10.871, 23.778, -20.505),
    "proto-rl-c with dispersion": PrototypeMetrics(-38.602, 21.635, -50.294),
    "proto-rl-c": PrototypeMetrics(-7.701, 51.280, -26.860),
    "proto-rl-s with dispersion": PrototypeMetrics(-80.131, 20.587, -140.213),
    "proto-rl-s": PrototypeMetrics(-44.036, 48.774, -80.839),
}
"""Table "... facilitates the diffusion of prototypes ...", in units of 1e-4, by variant: with and without L_intr."""
