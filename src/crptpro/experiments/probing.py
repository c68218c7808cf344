"""The state probe of one encoder on one dataset, as rows of ``probe.csv`` and of a table for people."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch

from crptpro.analysis.coordinates import joints_of
from crptpro.analysis.probe import ProbeResult, probe, probe_samples
from crptpro.colors import Colors
from crptpro.data import FrameDataset
from crptpro.data.drawn_frames import DrawnFrames
from crptpro.experiments.goals import RANDOM_ENCODER
from crptpro.modules import Projector
from crptpro.modules.placement import device_of
from crptpro.pretrained import Pretrained
from crptpro.seeding import derive_seed

logger = logging.getLogger(__name__)

COLUMNS = (
    "encoder", "method", "domain", "seen", "colors", "embedding", "measure", "coordinate", "value", "samples",
    "held_out_episodes", "seed",
)  # fmt: skip
"""Of ``probe.csv``: one row per measure, and per coordinate of each R2."""


class ProbeRows(NamedTuple):
    """What a probe found.

    Args:
        table: a row per embedding, rounded, with names for people.
        measures: every number, by :data:`COLUMNS`.
    """

    table: list[dict[str, str]]
    measures: list[dict[str, Any]]


def probe_rows(
    pretrained: Pretrained,
    dataset: FrameDataset,
    *,
    encoder: str,
    colors: Colors = "normal",
    samples: int = 2_000,
    seed: int = 0,
    drawn: DrawnFrames | None = None,
) -> ProbeRows:
    """Probe an encoder on a dataset in some colours.

    Args:
        pretrained: whose features, and projections if it has a projector, are read, where it lives. The untrained
            control is given an untrained projector, so that z has one too.
        dataset: with physical state.
        encoder: what the encoder is called in the rows.
        colors: in which the observations are drawn, whatever the dataset's own.
        samples: drawn from the dataset.
        seed: of the draw.
        drawn: frames of the dataset in these colours that were drawn before.

    Raises:
        DatasetError: if there is no physical state, or too little data to split.
    """
    observed = probe_samples(
        dataset,
        samples=samples,
        seed=seed,
        colors=colors,
        joints=joints_of(dataset.card["task"]),
        frame_stack=pretrained.encoder.in_channels // 3,
        drawn=drawn,
    )
    logger.info("%s, %s: %s samples", dataset.domain, colors, f"{len(observed.pixels):,}")
    about = {
        "encoder": encoder,
        "method": pretrained.label,
        "domain": dataset.domain,
        "seen": "yes" if dataset.domain in domains_seen(pretrained) else "no",
        "colors": colors,
    }
    counts = {"samples": len(observed.pixels), "held_out_episodes": observed.held_out_episodes, "seed": seed}
    found = ProbeRows([], [])
    projector = pretrained.projector
    if pretrained.method == RANDOM_ENCODER:
        projector = _untrained_projector(pretrained)
    for embedding, result in probe(observed, pretrained.encoder, projector).items():
        named = {**about, "embedding": embedding}
        found.table.append(_table_row(named, result))
        found.measures.extend({**named, **measure, **counts} for measure in _measures(result))
        if result.left_out:
            logger.info("%s: left out as constant: %s", dataset.domain, ", ".join(result.left_out))
    return found


def _untrained_projector(pretrained: Pretrained) -> Projector:
    """A projector at its initialisation, which the encoder's seed decides."""
    seed = derive_seed(int(pretrained.card.get("seed", 0)), "untrained_projector")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        projector = Projector(pretrained.encoder.feature_dim)
    return projector.requires_grad_(False).eval().to(device_of(pretrained.encoder) or "cpu")


def domains_seen(pretrained: Pretrained) -> set[str]:
    """Return the domains that an encoder was trained on, those of the encoder it started from included."""
    training: Any = pretrained.card.get("training")
    seen: set[str] = set()
    while isinstance(training, Mapping):
        seen |= {str(dataset.get("domain")) for dataset in training.get("datasets") or ()}
        training = training.get("previous_training")
    return seen


def _table_row(named: dict[str, Any], result: ProbeResult) -> dict[str, str]:
    return {
        "method": named["method"],
        "domain": named["domain"],
        "seen": named["seen"],
        "colours": named["colors"],
        "embedding": named["embedding"],
        "R2 positions": f"{result.position_r2:.3f}",
        "R2 velocities": f"{result.velocity_r2:.3f}",
        "effective rank": f"{result.effective_rank:.1f}",
        "mean cosine": f"{result.mean_cosine:.4f}",
    }


def _measures(result: ProbeResult) -> list[dict[str, Any]]:
    """Lay a result out as measures; coordinates that were left out have no value."""
    rows = [
        {"measure": f"r2_{kind}", "coordinate": name, "value": value}
        for kind, scores in (("position", result.positions), ("velocity", result.velocities))
        for name, value in scores.items()
    ]
    for name in result.left_out:
        kind, coordinate = name.split(" ", 1)
        rows.append({"measure": f"r2_{kind}", "coordinate": coordinate, "value": ""})
    means = {
        "r2_position": result.position_r2,
        "r2_velocity": result.velocity_r2,
        "effective_rank": result.effective_rank,
        "mean_cosine": result.mean_cosine,
    }
    return [*rows, *({"measure": name, "coordinate": "", "value": value} for name, value in means.items())]
