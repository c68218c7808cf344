"""How the pieces that measure are made; importing this module registers them."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from crptpro.analysis.coverage import coverage
from crptpro.analysis.embeddings import embed_pixels, principal_components, sample_pixels
from crptpro.analysis.probe import probe_frame_rows
from crptpro.cards import write_json
from crptpro.data import FrameDataset, StoredReplay
from crptpro.data.drawn_frames import DrawnFrames
from crptpro.data.redraw import redraw
from crptpro.errors import RecordError
from crptpro.experiments import probing, timing
from crptpro.experiments.building import JobSettings, register
from crptpro.experiments.measurements import (
    CoveragePiece,
    EmbeddingsPiece,
    ProbePiece,
    PrototypesPiece,
    RedrawnPiece,
    TimingPiece,
)
from crptpro.experiments.pieces import EncoderPiece, ExploredPiece
from crptpro.experiments.row_files import read_rows, write_rows
from crptpro.experiments.store import Store
from crptpro.objectives.metrics import prototype_metrics
from crptpro.pretrained import Pretrained, load_pretrained
from crptpro.seeding import derive_seed
from crptpro.training.explore.replays import DIRECTORY as REPLAYS

PROTOTYPE_COLUMNS = ("method", "has_dispersion", "updates", "kne_3", "kne_half", "ane", "intr")
"""Of ``prototypes.csv``: a row per row of the training's record, and the last one of the finished encoder."""
COVERAGE_COLUMNS = ("source", "method", "domain", "env_steps", "coverage", "samples")
"""Of ``coverage.csv``: a row per source, domain and window of the training, which ends at ``env_steps``, counted over
all domains."""
EMBEDDINGS_COLUMNS = ("source", "pc1", "pc2", "pc3")
"""Of ``embeddings.csv``: a row per observation; a source is a domain and ``random`` or ``explorer``."""

_METRICS = {
    "kne_3": "prototype_kne_3",
    "kne_half": "prototype_kne_half",
    "ane": "prototype_ane",
    "intr": "prototype_dispersion",
}
_LATE = 0.75


@register
def _(piece: TimingPiece, store: Store, job: JobSettings) -> None:
    row = timing.timing_row(piece, store, job)
    write_rows(store.path(piece) / "timing.csv", timing.COLUMNS, [row])


@register
def _(piece: RedrawnPiece, store: Store, job: JobSettings) -> None:
    dataset = FrameDataset.open(store.dataset(piece.dataset))
    rows = probe_frame_rows(dataset, samples=piece.samples, seed=piece.seed, frame_stack=piece.frame_stack)
    frames = redraw(dataset, rows, colors=piece.colors)
    DrawnFrames(dataset.domain, piece.colors, rows, frames).save(store.redrawn(piece))


@register
def _(piece: ProbePiece, store: Store, job: JobSettings) -> None:
    found = probing.probe_rows(
        _load(piece.encoder, store, job, piece.at_updates),
        FrameDataset.open(store.dataset(piece.dataset)),
        encoder=piece.encoder.key,
        colors=piece.colors,
        samples=piece.samples,
        seed=piece.seed,
        drawn=None if piece.redrawn is None else DrawnFrames.load(store.redrawn(piece.redrawn)),
    )
    write_rows(store.path(piece) / "probe.csv", probing.COLUMNS, found.measures)


@register
def _(piece: PrototypesPiece, store: Store, job: JobSettings) -> None:
    pretrained = load_pretrained(store.encoder(piece.encoder))
    if pretrained.prototypes is None:
        raise RecordError(f"{piece.encoder.key} has no prototypes; its method is {piece.encoder.method}.")
    options = pretrained.card["loss"]["config"]
    about = {"method": piece.encoder.method, "has_dispersion": options["intr_loss_coef"] > 0}
    updates = pretrained.card["training"]["updates"]
    # The record's own last row, if it is of the last update, was taken from weights that had not been normalised yet.
    rows = [row for row in _recorded(piece.encoder, store) if row["updates"] < updates]
    measured = prototype_metrics(pretrained.prototypes.weight, offset=options["offset"])  # type: ignore[arg-type]
    rows.append({"updates": updates, **{name: float(measured[key]) for name, key in _METRICS.items()}})
    write_rows(store.path(piece) / "prototypes.csv", PROTOTYPE_COLUMNS, ({**about, **row} for row in rows))


def _recorded(encoder: EncoderPiece, store: Store) -> list[dict[str, Any]]:
    """Metrics along the training, from its record."""
    recorded = read_rows(store.path(encoder) / "pretrain.csv")
    return [
        {"updates": int(row["updates"]), **{name: float(row[key]) for name, key in _METRICS.items()}}
        for row in recorded
    ]


@register
def _(piece: CoveragePiece, store: Store, job: JobSettings) -> None:
    pretrained = _load(piece.encoder, store, job)
    training = _training(piece.explorer, store)
    decisions = {entry["domain"]: int(entry["agent_steps"]) for entry in training["datasets"]}
    least = min(decisions.values())
    windows = max(1, min(piece.windows, least // piece.samples))
    samples = min(piece.samples, least // windows)
    rows = []
    for dataset in piece.datasets:
        total = decisions[dataset.domain]
        random = FrameDataset.open(store.dataset(dataset))
        replay = _replay(piece.explorer, dataset.domain, store, pretrained)
        # A ring that went round has lost its oldest decisions.
        lost = total - len(replay)
        for window in range(windows):
            start, end = window * total // windows, (window + 1) * total // windows
            sources = {"random": (start, min(end, len(random))), "explorer": (max(start, lost), end)}
            for source, (first, last) in sources.items():
                if last - first < samples:
                    continue  # estimates of fewer observations cannot be compared
                seed = derive_seed(piece.seed, "coverage", source, dataset.domain, window)
                order = torch.randperm(last - first, generator=torch.Generator().manual_seed(seed))
                chosen = first + order[:samples].sort().values
                if source == "random":
                    pixels = _observations(random, chosen, pretrained)
                else:
                    pixels = replay.observations(chosen - lost)
                rows.append(
                    {
                        "source": source,
                        "method": piece.explorer.method if source == "explorer" else "",
                        "domain": dataset.domain,
                        "env_steps": training["env_steps"] * end // total,
                        "coverage": coverage(_unit_embeddings(pretrained, pixels)),
                        "samples": samples,
                    }
                )
    write_rows(store.path(piece) / "coverage.csv", COVERAGE_COLUMNS, rows)


@register
def _(piece: EmbeddingsPiece, store: Store, job: JobSettings) -> None:
    pretrained = _load(piece.encoder, store, job)
    pixels = {}
    for dataset in piece.datasets:
        random = FrameDataset.open(store.dataset(dataset), frame_stack=_frame_stack(pretrained))
        pixels[f"{dataset.domain} random"] = sample_pixels(random, piece.samples, seed=piece.seed)
    for domain in piece.explorer.domains:
        replay = _replay(piece.explorer, domain, store, pretrained)
        late = len(replay) - int(_LATE * len(replay))
        seed = derive_seed(piece.seed, "embeddings", domain)
        chosen = torch.randperm(late, generator=torch.Generator().manual_seed(seed))[: piece.samples]
        pixels[f"{domain} explorer"] = replay.observations(len(replay) - late + chosen.sort().values)
    points = torch.cat([embed_pixels(pretrained.encoder, images) for images in pixels.values()]).cpu()
    coordinates, explained = principal_components(points)
    sources = [source for source, images in pixels.items() for _ in images]
    rows = [
        {"source": source, **dict(zip(EMBEDDINGS_COLUMNS[1:], point))}
        for source, point in zip(sources, coordinates.tolist())
    ]
    write_json(
        store.path(piece) / "explained.json",
        {"explained_variance_ratio": [float(part) for part in explained]},
    )
    write_rows(store.path(piece) / "embeddings.csv", EMBEDDINGS_COLUMNS, rows)


def _load(encoder: EncoderPiece, store: Store, job: JobSettings, at_updates: int | None = None) -> Pretrained:
    pretrained = load_pretrained(store.encoder(encoder, at_updates))
    pretrained.encoder.to(job.device)
    if pretrained.projector is not None:
        pretrained.projector.to(job.device)
    return pretrained


def _training(encoder: EncoderPiece, store: Store) -> dict[str, Any]:
    return load_pretrained(store.encoder(encoder)).card["training"]


def _replay(explorer: ExploredPiece, domain: str, store: Store, pretrained: Pretrained) -> StoredReplay:
    return StoredReplay(store.path(explorer) / REPLAYS / domain, frame_stack=_frame_stack(pretrained))


def _frame_stack(pretrained: Pretrained) -> int:
    return pretrained.encoder.in_channels // 3


def _observations(dataset: FrameDataset, index: Tensor, pretrained: Pretrained) -> Tensor:
    """Observations before transitions of a dataset."""
    from crptpro.data.frame_stacks import stack_rows

    row, step = (dataset.transitions.get(name)[index] for name in ("row", "step"))
    frames = dataset.frames_at(stack_rows(row, step, _frame_stack(pretrained)))
    return frames.flatten(1, 2)


def _unit_embeddings(pretrained: Pretrained, pixels: Tensor) -> Tensor:
    """Projections if there is a projector, else features, of unit length: where prototypes and rewards live."""
    embeddings = embed_pixels(pretrained.encoder, pixels, projector=pretrained.projector)
    return F.normalize(embeddings, dim=-1)
