"""What experiments measure of encoders and their data; ``crptpro measure`` writes it as CSV files for jobs."""

from __future__ import annotations

import itertools
import math
import shlex
import shutil
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
import torch.nn.functional as F
import tyro
from tyro.conf import Positional, UseAppendAction

from crptpro.artifact import read_json, write_json, write_whole
from crptpro.errors import RecordError

PROTOTYPE_METRICS = {
    "kne_3": "prototype_kne_3", "kne_half": "prototype_kne_half", "ane": "prototype_ane",
    "intr": "prototype_dispersion",
}  # fmt: skip
"""Columns of ``prototypes.csv`` to the names of the training's record."""
WINDOWS = 5
"""Parts of a timing whose median counts, so that one hiccup of the machine does not."""
RANDOM_AGENT_STEPS = 24
"""Random decisions per domain before a timed exploration, instead of the method's own."""
COVERAGE_WINDOWS = 10
"""Windows of the training, fewer where one would have less decisions of a domain than samples."""


def write_rows(
    path: str | Path, rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None
) -> None:
    """Write rows as a CSV file, whole or not at all; what was there before is replaced.

    Raises:
        DiskSpaceError: the disk is full.
    """
    import pandas as pd

    table = pd.DataFrame(list(rows), columns=columns, dtype=object)
    write_whole(path, table.to_csv(index=False, lineterminator="\n"))


def read_rows(path: str | Path) -> list[dict[str, str]]:
    """Read a CSV file with a header, every cell as text.

    Raises:
        RecordError: there is no such file.
    """
    import pandas as pd

    try:
        return pd.read_csv(path, dtype=str, keep_default_na=False).to_dict("records")
    except (OSError, ValueError) as reason:
        raise RecordError(f"{path} cannot be read: {reason}.") from None


# --- state probes ---------------------------------------------------------------------------------------------------

PROBE_COLUMNS = (
    "encoder", "method", "domain", "seen", "colors", "embedding", "measure", "coordinate", "value", "samples",
    "held_out_episodes", "seed",
)  # fmt: skip
"""Of ``probe.csv``: one row per measure, and per coordinate of each R2."""


def probe_rows(
    pretrained: Any, dataset: Any, *, encoder: str, samples: int = 2_000, seed: int = 0
) -> tuple[list[dict[str, str]], list[dict[str, Any]]]:
    """Probe an encoder on a dataset.

    Args:
        pretrained: a :class:`~crptpro.pretrained.Pretrained` whose features, and projections if it has a projector, are
            read. The untrained control is given an untrained projector, so that z has one too.
        dataset: a :class:`~crptpro.data.FrameDataset` with physical state.
        encoder: what the encoder is called in the rows.
        samples: drawn from the dataset.
        seed: of the draw.

    Returns:
        A row per embedding for people, and every number by :data:`PROBE_COLUMNS`.

    Raises:
        DatasetError: there is no physical state, or too little data to split.
    """
    from crptpro.analysis.coordinates import joints_of
    from crptpro.analysis.probe import probe, probe_samples

    joints, frame_stack = joints_of(dataset.card["task"]), pretrained.encoder.in_channels // 3
    observed = probe_samples(dataset, samples=samples, seed=seed, joints=joints, frame_stack=frame_stack)
    is_control = pretrained.method.startswith("random-encoder")
    projector = _untrained_projector(pretrained) if is_control else pretrained.projector
    about = {"method": pretrained.label, "domain": dataset.domain}
    about |= {"seen": "yes" if dataset.domain in domains_seen(pretrained.card) else "no"}
    about |= {"colors": dataset.card.get("colors", "normal")}
    counts = {"samples": len(observed.pixels), "held_out_episodes": observed.held_out_episodes, "seed": seed}
    table, measures = [], []
    for embedding, result in probe(observed, pretrained.encoder, projector).items():
        table.append({
            **about, "embedding": embedding, "R2 positions": f"{result.position_r2:.3f}",
            "R2 velocities": f"{result.velocity_r2:.3f}", "effective rank": f"{result.effective_rank:.1f}",
            "mean cosine": f"{result.mean_cosine:.4f}",
        })  # fmt: skip
        found: list[tuple[str, str, Any]] = [("r2_position", *each) for each in result.positions.items()]
        found += [("r2_velocity", *each) for each in result.velocities.items()]
        found += [(f"r2_{kind}", name, "") for kind, name in (each.split(" ", 1) for each in result.left_out)]
        found += [("r2_position", "", result.position_r2), ("r2_velocity", "", result.velocity_r2)]
        found += [(name, "", getattr(result, name)) for name in ("effective_rank", "mean_cosine")]
        named = {"encoder": encoder, **about, "embedding": embedding}
        measures += [{**named, "measure": m, "coordinate": c, "value": v, **counts} for m, c, v in found]
    return table, measures


def _untrained_projector(pretrained: Any) -> Any:
    """A projector at its initialisation, which the encoder's seed decides."""
    from crptpro.modules import Projector
    from crptpro.modules.precision import device_of
    from crptpro.seeding import derive_seed

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(int(pretrained.card.get("seed", 0)), "untrained_projector"))
        projector = Projector(pretrained.encoder.feature_dim)
    return projector.requires_grad_(False).eval().to(device_of(pretrained.encoder) or "cpu")


def domains_seen(card: Mapping[str, Any]) -> set[str]:
    """Return the domains that an encoder was trained on, those of the encoder it started from included."""
    training: Any = card.get("training")
    seen: set[str] = set()
    while isinstance(training, Mapping):
        seen |= {str(dataset.get("domain")) for dataset in training.get("datasets") or ()}
        training = training.get("previous_training")
    return seen


# --- prototypes and data --------------------------------------------------------------------------------------------


def prototypes(encoder: Positional[Path], *, out: Path) -> None:
    """Write how far prototypes have spread, along their training and at its end: OUT/prototypes.csv.

    Args:
        encoder: in its run directory, whose record says how it came there.
        out: directory to write to.
    """
    from crptpro.objectives.functional import prototype_metrics
    from crptpro.pretrained import load_pretrained

    pretrained: Any = load_pretrained(encoder)
    if pretrained.prototypes is None:
        raise RecordError(f"{encoder} has no prototypes; its method is {pretrained.method}.")
    config, updates = pretrained.card["loss"]["config"], pretrained.card["training"]["updates"]
    about = {"method": pretrained.method, "has_dispersion": config["intr_loss_coef"] > 0}
    # The record's own last row, if it is of the last update, is of weights that had not been normalised yet.
    record = [row for row in read_rows(encoder.parent / "pretrain.csv") if int(row["updates"]) < updates]
    metrics = prototype_metrics(pretrained.prototypes.weight, offset=config["offset"])
    end = {"updates": updates, **{name: float(value) for name, value in metrics.items()}}
    rows = [
        {**about, "updates": row["updates"], **{name: row[key] for name, key in PROTOTYPE_METRICS.items()}}
        for row in [*record, end]
    ]
    write_rows(out / "prototypes.csv", rows)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Random data beside an explorer's, as an encoder sees both."""

    encoder: Path
    """which embeds all observations"""
    explorer: Path
    """its encoder, in its run directory"""
    replays: tuple[Path, ...]
    """what the explorer saw, a directory for each domain"""
    datasets: tuple[Path, ...]
    """random transitions of each domain"""
    out: Path
    """directory to write to"""
    samples: int = 1_024
    """observations of each source"""
    seed: int = 0
    """of the draw"""
    device: str = "cpu"
    """where the encoder runs"""

    def load(self) -> Any:
        """Return the artifact of the encoder, on its device."""
        from crptpro.pretrained import load_pretrained

        pretrained = load_pretrained(self.encoder)
        for network in (pretrained.encoder, pretrained.projector):
            if network is not None:
                network.to(self.device)
        return pretrained


def coverage(of: Annotated[Comparison, tyro.conf.arg(name="")]) -> None:
    """Write how widely an explorer's observations are spread along its training, beside random data: OUT/coverage.csv.

    A window has the same decisions of both sources. Where one does not have enough of them, it has no row.
    """
    from crptpro.analysis import coverage as estimate
    from crptpro.analysis.embeddings import embed_pixels
    from crptpro.data import FrameDataset, StoredReplay
    from crptpro.pretrained import load_pretrained
    from crptpro.seeding import derive_seed

    pretrained, explored = of.load(), load_pretrained(of.explorer)
    frame_stack, training = pretrained.encoder.in_channels // 3, explored.card["training"]
    decisions = {entry["domain"]: int(entry["agent_steps"]) for entry in training["datasets"]}
    least = min(decisions.values())
    windows = max(1, min(COVERAGE_WINDOWS, least // of.samples))
    samples = min(of.samples, least // windows)
    rows = []
    for path, replay_path in zip(of.datasets, of.replays, strict=True):
        random = FrameDataset.open(path, frame_stack=frame_stack)
        replay = StoredReplay(replay_path, frame_stack=frame_stack)
        total = decisions[random.domain]
        lost = total - len(replay)  # the oldest decisions, of a ring that went round
        for window in range(windows):
            start, end = window * total // windows, (window + 1) * total // windows
            spans = {"random": (start, min(end, len(random))), "explorer": (max(start, lost), end)}
            for source, (first, last) in spans.items():
                if last - first < samples:
                    continue  # estimates of fewer observations cannot be compared
                draw = derive_seed(of.seed, "coverage", source, random.domain, window)
                order = torch.randperm(last - first, generator=torch.Generator().manual_seed(draw))
                chosen = first + order[:samples].sort().values
                is_random = source == "random"
                pixels = random[chosen]["pixels"] if is_random else replay.observations(chosen - lost)
                points = embed_pixels(pretrained.encoder, pixels, projector=pretrained.projector)
                rows.append({
                    "source": source, "method": "" if is_random else explored.method, "domain": random.domain,
                    "env_steps": training["env_steps"] * end // total,
                    "coverage": estimate.coverage(F.normalize(points, dim=-1)), "samples": samples,
                })  # fmt: skip
    columns = ("source", "method", "domain", "env_steps", "coverage", "samples")
    write_rows(of.out / "coverage.csv", rows, columns)


def embeddings(of: Annotated[Comparison, tyro.conf.arg(name="")]) -> None:
    """Write principal components of random data and of an explorer's last quarter: OUT/embeddings.csv."""
    from crptpro.analysis.embeddings import embed_pixels, principal_components, sample_pixels
    from crptpro.data import FrameDataset, StoredReplay
    from crptpro.seeding import derive_seed

    pretrained = of.load()
    frame_stack, pixels = pretrained.encoder.in_channels // 3, {}
    for path in of.datasets:
        random = FrameDataset.open(path, frame_stack=frame_stack)
        pixels[f"{random.domain} random"] = sample_pixels(random, of.samples, seed=of.seed)
    for path in of.replays:
        replay = StoredReplay(path, frame_stack=frame_stack)
        late = len(replay) - int(0.75 * len(replay))
        draw = torch.Generator().manual_seed(derive_seed(of.seed, "embeddings", path.name))
        chosen = torch.randperm(late, generator=draw)[: of.samples].sort().values
        pixels[f"{path.name} explorer"] = replay.observations(len(replay) - late + chosen)
    points = torch.cat([embed_pixels(pretrained.encoder, images) for images in pixels.values()]).cpu()
    coordinates, explained = principal_components(points)
    write_json(of.out / "explained.json", {"explained_variance_ratio": explained.tolist()})
    sources = [source for source, images in pixels.items() for _ in images]
    rows = [
        {"source": source, **{f"pc{number}": value for number, value in enumerate(point, 1)}}
        for source, point in zip(sources, coordinates.tolist())
    ]
    write_rows(of.out / "embeddings.csv", rows)


# --- cost of pre-training -------------------------------------------------------------------------------------------


def timing(
    *,
    out: Path,
    training: UseAppendAction[tuple[str, ...]] = (),
    paper_training: UseAppendAction[tuple[str, ...]] = (),
    updates: int = 100,
    paper_updates: int = 0,
    device: str = "cpu",
    threads: int = 1,
) -> None:
    """Write what training encoders takes, from a timed part of it: OUT/timing.csv.

    Args:
        out: directory to write to.
        training: a `pretrain ...` command without --out and --device; of several the costs add up.
        paper_training: the same as the paper trains.
        updates: encoder updates that are timed, after as many to warm up.
        paper_updates: likewise of the paper's trainings; 0 leaves their hours open unless both are the same.
        device: of networks.
        threads: of torch.
    """
    torch.set_num_threads(threads)
    rows = []
    for here, paper in zip(training, paper_training, strict=True):
        stage, whole = _stage(here, out / "timed", device), _stage(paper, out / "timed", device)
        timed, seconds, each = _time(stage, updates)
        paper_each: float | None = each if here == paper else None
        if here != paper and paper_updates:
            paper_each = _time(whole, paper_updates)[-1]
        plan, paper_plan = _plan(stage), _plan(whole)
        decisions = timed * plan.encoder_update_interval // plan.encoder_updates_each if plan else 0
        sources = [Path(source).parent / "done.json" for source in stage.sources]
        collected = [read_json(path, error=RecordError)["seconds"] for path in sources if path.exists()]
        budget, paper_budget = _updates(stage), _updates(whole)
        rows.append({
            "domains": len(stage.sources), "encoder_updates": timed, "decisions": decisions, "seconds": seconds,
            "budget_updates": budget, "budget_decisions": plan.decisions if plan else 0,
            "projected_hours": each * budget / 3600, "paper_updates": paper_budget,
            "paper_decisions": paper_plan.decisions if paper_plan else 0,
            "paper_projected_hours": None if paper_each is None else paper_each * paper_budget / 3600,
            "collection_seconds": sum(collected) if collected else None,
        })  # fmt: skip
    total: dict[str, Any] = {"method": stage.method}
    for name in rows[0]:
        values = [row[name] for row in rows]
        total[name] = None if None in values else sum(values)
    hours, paper_hours = total["projected_hours"], total["paper_projected_hours"]
    total["seconds_per_update"] = 3600 * hours / total["budget_updates"]
    per_decision = total["seconds_per_update"] * total["encoder_updates"]
    total["seconds_per_decision"] = per_decision / total["decisions"] if total["decisions"] else None
    total["paper_seconds_per_update"] = paper_hours and 3600 * paper_hours / total["paper_updates"]
    write_rows(out / "timing.csv", [{**total, "threads": threads, "device": device}])


def _stage(text: str, out: Path, device: str) -> Any:
    """Read a training's command as the command line does."""
    from crptpro.cli import pretrain_command

    words = shlex.split(text)
    return tyro.cli(pretrain_command(words), args=[*words[1:], "--out", str(out), "--device", device])


def _plan(stage: Any) -> Any | None:
    """Return how often an exploring method decides and updates; nothing of one that learns from datasets."""
    from crptpro.objectives import get_method
    from crptpro.training.explore import plan_exploration

    method = get_method(stage.method)
    return None if method.exploration is None else plan_exploration(method, stage.sources, stage.config)


def _updates(stage: Any) -> int:
    plan = _plan(stage)
    return stage.config.updates if plan is None else plan.encoder_updates


def _time(stage: Any, updates: int) -> tuple[int, float, float]:
    """Return timed updates, their seconds, and seconds per update by the median over windows."""
    plan = _plan(stage)
    # Updates after which all domains have had their turn.
    period = len(stage.sources) * (plan.encoder_updates_each if plan else 1)
    window = period * math.ceil(updates / (WINDOWS * period))
    needed = 2 * WINDOWS * window
    if plan is None:
        settings = {"updates": needed}
    else:
        first, interval = min(plan.first_update, RANDOM_AGENT_STEPS), plan.encoder_update_interval
        # The first update comes with the first multiple of the interval that is not random.
        rounds = interval * (math.ceil(first / interval) + math.ceil(needed / period) - 1) + 1
        env_steps = rounds * sum(plan.repeats)
        settings = {"env_steps": env_steps, "random_agent_steps": first}
        settings |= {"checkpoint_interval_env_steps": env_steps}
    shutil.rmtree(stage.out, ignore_errors=True)
    try:
        replace(stage, config=replace(stage.config, log_interval=window, **settings)).run()
        at = {int(row["updates"]): float(row["unix_time_s"]) for row in read_rows(stage.out / "pretrain.csv")}
    finally:
        shutil.rmtree(stage.out, ignore_errors=True)
    times = [at[count * window] for count in range(WINDOWS, 2 * WINDOWS + 1)]
    each = statistics.median(after - before for before, after in itertools.pairwise(times)) / window
    return WINDOWS * window, times[-1] - times[0], each


def main(arguments: Sequence[str]) -> None:
    """Run ``crptpro measure``."""
    commands = {each.__name__: each for each in (prototypes, coverage, embeddings, timing)}
    tyro.extras.subcommand_cli_from_dict(commands, prog="crptpro measure", args=arguments)
