"""What a study's encoders were read to know, and by how much that differs from the usual setting's."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from crptpro.experiments.report.measurements import Row
from crptpro.experiments.report.reading import Wanted

CONTROL = "control"
"""The factor of an untrained encoder, which stands beside those of every other."""


@dataclass(frozen=True)
class Trial:
    """A value of a factor, on a group; encoders of several seeds share it.

    Args:
        factor: what is varied; empty if nothing is.
        value: that it has.
        usual: the value that others are compared with; empty if there is none.
        group: of the data; empty if it is not known.
    """

    factor: str
    value: str
    usual: str
    group: str

    @property
    def is_usual(self) -> bool:
        """Whether the others are compared with this one."""
        return self.value == self.usual


@dataclass(frozen=True)
class Reading:
    """The probe of one encoder after one number of updates, mean over domains.

    Args:
        trial: what the encoder is one of.
        seed: of the encoder.
        updates: that it had made.
        values: measure and embedding to the mean, e.g. of ``("r2_velocity", "z")``.
    """

    trial: Trial
    seed: str
    updates: int
    values: dict[tuple[str, str], float]


def trial_of(goal: Wanted) -> Trial:
    """Return the trial that a goal belongs to."""
    place = {name: str(value) for name, value in goal.place.items()}
    value = place.get("value", goal.label)
    return Trial(place.get("factor", ""), value, place.get("usual", ""), place.get("group", ""))


def seed_of(goal: Wanted) -> str:
    """Return the seed of a goal's encoder, which probes along its training share."""
    return str(goal.place.get("encoder_seed", goal.place.get("seed", "")))


def updates_of(goal: Wanted) -> int:
    """Return after how many updates an encoder was probed; 0 where nothing says so."""
    return int(goal.place.get("updates", 0))


def last_updates(goals: Iterable[Wanted]) -> dict[tuple[Trial, str], int]:
    """Return how many updates each encoder will have made at its end, by trial and seed, finished or not."""
    last: dict[tuple[Trial, str], int] = {}
    for goal in goals:
        key = trial_of(goal), seed_of(goal)
        last[key] = max(updates_of(goal), last.get(key, 0))
    return last


def readings(rows: Iterable[Row]) -> list[Reading]:
    """Average probes over domains.

    Args:
        rows: means over coordinates. What has not been probed on all domains of its group yet is left out: a mean over
            others would not compare.
    """
    found: dict[tuple[Trial, str, int], dict[tuple[str, str], dict[tuple[str, str], float]]] = {}
    domains: dict[str, set[tuple[str, str]]] = {}
    for row in rows:
        value = row.number("value")
        trial, where = trial_of(row.goal), (row["domain"], row["colors"])
        domains.setdefault(trial.group, set()).add(where)
        if value is not None:
            encoder = found.setdefault((trial, seed_of(row.goal), updates_of(row.goal)), {})
            encoder.setdefault((row["measure"], row["embedding"]), {})[where] = value
    complete = []
    for (trial, seed, updates), measures in found.items():
        values = {
            name: float(np.mean(list(by_domain.values())))
            for name, by_domain in measures.items()
            if set(by_domain) == domains[trial.group]
        }
        if values:
            complete.append(Reading(trial, seed, updates, values))
    return complete


def at_end(found: Sequence[Reading]) -> list[Reading]:
    """Return the last reading of every encoder."""
    last: dict[tuple[Trial, str], Reading] = {}
    for reading in sorted(found, key=lambda reading: reading.updates):
        last[reading.trial, reading.seed] = reading
    return list(last.values())


def changes(
    found: Sequence[Reading], trials: Iterable[Trial], updates: int | None, measure: tuple[str, str]
) -> list[float]:
    """Return by how much a value's encoders read better than the usual value's.

    Args:
        found: everything that was read.
        trials: whose encoders; several for a mean over groups.
        updates: after which; ``None`` for the end, which must be the same.
        measure: and its embedding.

    Returns:
        A difference per encoder that has a usual one of the same group, seed and updates.
    """
    if updates is None:
        found = at_end(found)
    by_place = {(r.trial, r.seed, r.updates): r.values[measure] for r in found if measure in r.values}
    wanted = set(trials)
    differences = []
    for (trial, seed, at), value in by_place.items():
        usual = by_place.get((Trial(trial.factor, trial.usual, trial.usual, trial.group), seed, at))
        if trial in wanted and usual is not None and updates in (None, at):
            differences.append(value - usual)
    return differences
