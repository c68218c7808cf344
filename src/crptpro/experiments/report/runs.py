"""The downstream runs of an experiment, each with where it stands, and what the paper printed for that place."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

from crptpro.errors import RecordError
from crptpro.experiments.pieces import EncoderPiece, piece_from_json
from crptpro.experiments.published import COLORS, SEEN, UNSEEN, Score
from crptpro.experiments.records import Run, read_run
from crptpro.experiments.report.palette import in_order
from crptpro.experiments.report.reading import Asked
from crptpro.experiments.score_table import ScoreTable, score_tables
from crptpro.training.fingerprint import flatten

LAST = 10
"""Evaluations at the end that a steadier score averages over."""
NOT_TOLD_APART = frozenset({
    "seed", "task", "colors", "device", "precision", "channels_last", "compile", "cuda_graph", "eval_workers",
    "render_ahead", "features", "video_episodes", "checkpoint_interval_env_steps", "log_interval_env_steps",
    "eval_interval_env_steps", "eval_episodes",
})  # fmt: skip
"""Settings of a run that do not make it another method's: its seed, where it stands, how and where it computed, when
it wrote."""


class Spot(NamedTuple):
    """A row of a score table.

    Args:
        group: whose domains the encoder was pre-trained on; empty if it is not known.
        task: what was learned.
        colors: of its world; ``"normal"`` for the usual.
    """

    group: str
    task: str
    colors: str = "normal"

    def __str__(self) -> str:
        """Return e.g. ``A cheetah_run`` or ``C reach_duplo, reversed_background``."""
        colors = "" if self.colors == "normal" else f", {self.colors}"
        return f"{self.group} {self.task}{colors}".strip()


@dataclass(frozen=True)
class Placed:
    """A run, under the label that its row has.

    Args:
        label: the system or variant.
        spot: which row of the table.
        run: what was read.
        varied: what a sensitivity study varies, with its value; empty otherwise.
    """

    label: str
    spot: Spot
    run: Run
    varied: tuple[str, str] = ("", "")


def placed_runs(asked: Asked) -> tuple[list[Placed], list[str]]:
    """Read the finished runs of an experiment.

    Returns:
        The runs, and a sentence for each that is finished and cannot be read.
    """
    found, problems = [], []
    seen = set()
    for goal in asked.finished:
        if goal.piece.kind != "run":
            continue
        try:
            run = read_run(goal.piece.directory)
            if not run.is_finished:
                raise RecordError(f"{goal.piece.key} is called finished and has no evaluation at its end.")
            run = _on_base(run, goal.piece.description)
        except RecordError as reason:
            problems.append(f"Left out: {reason}")
            continue
        place = goal.place
        spot = Spot(str(place.get("group", "")), run.task, str(place.get("colors", "normal")))
        varied = (str(place.get("varied", "")), str(place.get("value", "")))
        same = (goal.label, spot, varied, goal.piece.key)
        if same not in seen:  # asked for twice, under other seeds
            seen.add(same)
            found.append(Placed(goal.label, spot, run, varied))
    return found, problems


def _on_base(run: Run, description: Mapping[str, Any]) -> Run:
    """Let runs on encoders that were fine-tuned from one base share it: it is their one draw of a pre-training."""
    encoder = description.get("encoder") or {}
    if encoder.get("kind") != "finetuned":
        return run
    piece = cast(EncoderPiece, piece_from_json(encoder))
    return dataclasses.replace(run, encoder=f"base:{piece.lineage[-1].key}")


def unplaced_runs(runs: Iterable[Run]) -> list[Placed]:
    """Give runs that no experiment asked for their own method as label; their group is not known.

    Runs of one method on one task are seeds of each other only if they agree in everything else: where they do not,
    the label of all of the method's runs names what differs, as in ``"crptpro, env_steps 20000"``.
    """
    runs = list(runs)
    settings = {id(run): _settings(run) for run in runs}
    alike: dict[tuple[str, Spot], list[Run]] = {}
    for run in runs:
        alike.setdefault((run.method, _spot(settings[id(run)], run)), []).append(run)
    differing: dict[str, dict[str, None]] = {}
    for (method, _), own in alike.items():
        told = [settings[id(run)] for run in own]
        for name in dict.fromkeys(name for one in told for name in one):
            # Records of earlier versions lack what was added since: that is no difference.
            if len({repr(one[name]) for one in told if name in one}) > 1:
                differing.setdefault(method, {})[name] = None
    placed = []
    for run in runs:
        own_settings = settings[id(run)]
        words = [f"{name} {own_settings.get(name, 'usual')}" for name in differing.get(run.method, ())]
        placed.append(Placed(", ".join([run.method, *words]), _spot(own_settings, run), run))
    return placed


def _spot(settings: Mapping[str, Any], run: Run) -> Spot:
    return Spot("", run.task, str(settings.get("colors", "normal")))


def _settings(run: Run) -> dict[str, Any]:
    """What a run was told, but for its seed and for how and where it ran; nested settings under dotted names."""
    return {name: value for name, value in flatten(run.settings).items() if name not in NOT_TOLD_APART}


def labels_of(placed: Iterable[Placed]) -> list[str]:
    """Return the labels in the order of tables."""
    return in_order(p.label for p in placed)


def spots_of(placed: Iterable[Placed]) -> list[Spot]:
    """Return the rows by group, and within a group as they were asked for."""
    return sorted(dict.fromkeys(p.spot for p in placed), key=lambda spot: spot.group)


def tables_of(
    placed: Iterable[Placed], *, score: Callable[[Run], float] = lambda run: run.final_score
) -> dict[str, ScoreTable]:
    """Sort runs into one table per label, keyed by :class:`Spot`."""
    placed = list(placed)
    labels: dict[int, Placed] = {}
    runs = []
    for p in placed:
        run = dataclasses.replace(p.run, method=p.label)
        labels[id(run)] = p
        runs.append(run)

    def key(run: Run) -> Hashable:
        return labels[id(run)].spot

    found = score_tables(runs, score=score, key=key)
    return {label: found[label] for label in labels_of(placed)}


def published(spot: Spot, label: str) -> Score | None:
    """Return what the paper printed for a system at a place; ``None`` where it printed nothing.

    Its tables have no control, no (S) methods, no fine-tuned encoder and no preset. DrQ trains its own encoder, so that
    its score belongs to a task whatever the group.
    """
    if label == "drq" and spot.colors == "normal":
        return next((row.scores["drq"] for row in SEEN if row.task == spot.task), None)
    rows = (*SEEN, *UNSEEN) if spot.colors == "normal" else COLORS
    if spot.colors not in ("normal", "reversed_background"):
        return None
    return next(
        (
            row.scores[label]
            for row in rows
            if (row.group, row.task) == (spot.group, spot.task) and label in row.scores
        ),
        None,
    )


def printed(score: Score | None) -> str:
    """Return a published score as the paper prints it; empty for none."""
    return "" if score is None else f"{score.mean:g} ± {score.std:g}"


def evaluations(run: Run) -> int:
    """Number of evaluations of a run."""
    return len({episode.env_steps for episode in run.episodes})
