"""Measurements of encoders and their data; ``crptpro measure`` writes them as CSV files for jobs."""

from __future__ import annotations

import math
import shlex
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import torch
import torch.nn.functional as F
import tyro
from tyro.conf import Positional, UseAppendAction

from crptpro.analysis.coverage import coverage as particle_estimate
from crptpro.analysis.embeddings import embed_pixels, principal_components, sample_pixels
from crptpro.analysis.probe import probe, probe_samples
from crptpro.artifact import read_json, write_json, write_whole
from crptpro.data import FrameDataset, StoredReplay
from crptpro.errors import RecordError
from crptpro.modules import Projector
from crptpro.modules.precision import device_of
from crptpro.objectives import get_method
from crptpro.objectives.functional import prototype_metrics
from crptpro.pretrained import Pretrained, load_pretrained
from crptpro.seeding import derive_seed
from crptpro.training.explore import plan_exploration

PROTOTYPE_METRICS = {
    "prototype_kne_3": "kne_3", "prototype_kne_half": "kne_half", "prototype_ane": "ane",
    "prototype_dispersion": "intr",
}  # fmt: skip
"""Names in the training's record to columns of ``prototypes.csv``."""
StageOf = Callable[[Sequence[str]], type]
"""Returns the dataclass of the stage that a command line names."""
WINDOWS = 5
"""Parts of a timing; their median is robust against one hiccup of the machine."""
RANDOM_AGENT_STEPS = 24
"""Random decisions per domain before a timed exploration, instead of the method's own."""
COVERAGE_WINDOWS = 10
"""Windows of the training; fewer if a window would have fewer decisions of a domain than samples."""


def write_rows(path: Path, rows: pd.DataFrame | Sequence[Mapping[str, Any]], columns: Any = None) -> None:
    """Write rows as a CSV file, whole or not at all, in place of an earlier one."""
    table = pd.DataFrame(rows, columns=columns, dtype=object)
    write_whole(path, table.to_csv(index=False, lineterminator="\n"))


# --- state probes ---------------------------------------------------------------------------------------------------

PROBE_COLUMNS = (
    "encoder", "method", "domain", "seen", "colors", "embedding", "measure", "coordinate", "value", "samples",
    "held_out_episodes", "seed",
)  # fmt: skip
"""Of ``probe.csv``: one row per measure, and per coordinate of each R2."""


def probe_rows(
    pretrained: Any, dataset: FrameDataset, *, encoder: str, samples: int = 2_000, seed: int = 0
) -> tuple[list[dict[str, str]], list[dict[str, Any]]]:
    """Probe an encoder, called ``encoder`` in the rows, on a draw from a dataset with physical state.

    Its features are probed, and its projections if it has a projector. The untrained control gets an untrained
    projector, so that it has z, too. Returns a formatted row per embedding, and every number by :data:`PROBE_COLUMNS`.

    Raises:
        DatasetError: there is no physical state, or too little data to split.
    """
    frame_stack = pretrained.encoder.in_channels // 3
    observed = probe_samples(dataset, samples=samples, seed=seed, frame_stack=frame_stack)
    is_control = pretrained.method.startswith("random-encoder")
    projector = _untrained_projector(pretrained) if is_control else pretrained.projector
    about = {
        "method": pretrained.label, "domain": dataset.domain,
        "seen": "yes" if dataset.domain in domains_seen(pretrained.card) else "no",
        "colors": dataset.card.get("colors", "normal"),
    }  # fmt: skip
    counts = {"samples": len(observed.pixels), "held_out_episodes": observed.held_out_episodes, "seed": seed}
    table, numbers = [], []
    for embedding, result in probe(observed, pretrained.encoder, projector).items():
        table.append({
            **about, "embedding": embedding, "R2 positions": f"{result.position_r2:.3f}",
            "R2 velocities": f"{result.velocity_r2:.3f}", "effective rank": f"{result.effective_rank:.1f}",
            "mean cosine": f"{result.mean_cosine:.4f}",
        })  # fmt: skip
        found: list[tuple[str, str, Any]] = [
            *(("r2_position", *each) for each in result.positions.items()),
            *(("r2_velocity", *each) for each in result.velocities.items()),
            *((f"r2_{kind}", name, "") for kind, name in result.left_out),
            ("r2_position", "", result.position_r2), ("r2_velocity", "", result.velocity_r2),
            ("effective_rank", "", result.effective_rank), ("mean_cosine", "", result.mean_cosine),
        ]  # fmt: skip
        for measure, coordinate, value in found:
            row = {"embedding": embedding, "measure": measure, "coordinate": coordinate, "value": value}
            numbers.append({"encoder": encoder, **about, **row, **counts})
    return table, numbers


def _untrained_projector(pretrained: Pretrained) -> Projector:
    """Return a projector at its initialisation, from the encoder's seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(int(pretrained.card.get("seed", 0)), "untrained_projector"))
        projector = Projector(pretrained.encoder.feature_dim)
    return projector.requires_grad_(False).eval().to(device_of(pretrained.encoder) or "cpu")


def domains_seen(card: Mapping[str, Any]) -> set[str]:
    """Return the domains that an encoder, and the encoder it started from, were trained on."""
    training: Any = card.get("training")
    seen: set[str] = set()
    while isinstance(training, Mapping):
        seen |= {str(dataset.get("domain")) for dataset in training.get("datasets") or ()}
        training = training.get("previous_training")
    return seen


# --- prototypes and data --------------------------------------------------------------------------------------------


def prototypes(encoder: Positional[Path], *, out: Path) -> None:
    """Write how far prototypes have spread, along their training and at its end: OUT/prototypes.csv."""
    pretrained: Any = load_pretrained(encoder)
    if pretrained.prototypes is None:
        raise RecordError(f"{encoder} has no prototypes; its method is {pretrained.method}.")
    config, updates = pretrained.card["loss"]["config"], pretrained.card["training"]["updates"]
    # The record's row of the last update is of weights before their normalisation: it is computed anew.
    record = pd.read_csv(encoder.parent / "pretrain.csv", dtype=str, keep_default_na=False)
    rows = record.loc[record["updates"].astype(int) < updates, ["updates", *PROTOTYPE_METRICS]]
    metrics = prototype_metrics(pretrained.prototypes.weight, offset=config["offset"])
    end = {"updates": updates, **{name: float(value) for name, value in metrics.items()}}
    rows = pd.concat([rows, pd.DataFrame([end], columns=rows.columns, dtype=object)])
    rows = rows.rename(columns=PROTOTYPE_METRICS)
    rows.insert(0, "method", pretrained.method)
    rows.insert(1, "has_dispersion", config["intr_loss_coef"] > 0)
    write_rows(out / "prototypes.csv", rows)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Random data beside an explorer's, as an encoder sees both."""

    encoder: Path  # embeds all observations
    explorer: Path  # the explorer's own encoder, in its run directory
    replays: tuple[Path, ...]  # the explorer's observations, a directory for each domain
    datasets: tuple[Path, ...]  # random transitions of each domain
    out: Path
    samples: int = 1_024  # observations of each source
    seed: int = 0  # of the draw
    device: str = "cpu"

    def load(self) -> Pretrained:
        """Return the artifact of the encoder, on its device."""
        pretrained = load_pretrained(self.encoder)
        for network in filter(None, (pretrained.encoder, pretrained.projector)):
            network.to(self.device)
        return pretrained

    def draw(self, start: int, end: int, count: int, *stream: str | int) -> torch.Tensor:
        """Draw ``count`` of the observations from ``start`` to before ``end``; returns their sorted numbers."""
        generator = torch.Generator().manual_seed(derive_seed(self.seed, *stream))
        return start + torch.randperm(end - start, generator=generator)[:count].sort().values


def coverage(of: Annotated[Comparison, tyro.conf.arg(name="")]) -> None:
    """Write how widely an explorer's observations are spread along its training, beside random data: OUT/coverage.csv.

    A window has the same decisions of both sources; a source with too few of them has no row.
    """
    pretrained, explored = of.load(), load_pretrained(of.explorer)
    frame_stack = pretrained.encoder.in_channels // 3
    training = explored.card["training"]
    decisions = {entry["domain"]: int(entry["agent_steps"]) for entry in training["datasets"]}
    fewest = min(decisions.values())
    windows = max(1, min(COVERAGE_WINDOWS, fewest // of.samples))
    samples = min(of.samples, fewest // windows)
    rows = []
    for path, replay_path in zip(of.datasets, of.replays, strict=True):
        random = FrameDataset.open(path, frame_stack=frame_stack)
        replay = StoredReplay(replay_path, frame_stack=frame_stack)
        domain = random.domain
        total = decisions[domain]
        lost = total - len(replay)  # the oldest decisions, which the ring has overwritten
        for window, source in product(range(windows), ("random", "explorer")):
            start, end = window * total // windows, (window + 1) * total // windows
            is_random = source == "random"
            first, last = (start, min(end, len(random))) if is_random else (max(start, lost), end)
            if last - first < samples:
                continue  # estimates of fewer observations are not comparable
            chosen = of.draw(first, last, samples, "coverage", source, domain, window)
            pixels = random[chosen]["pixels"] if is_random else replay.observations(chosen - lost)
            points = embed_pixels(pretrained.encoder, pixels, projector=pretrained.projector)
            rows.append({
                "source": source, "method": "" if is_random else explored.method, "domain": domain,
                "env_steps": training["env_steps"] * end // total,
                "coverage": particle_estimate(F.normalize(points, dim=-1)), "samples": samples,
            })  # fmt: skip
    columns = ("source", "method", "domain", "env_steps", "coverage", "samples")
    write_rows(of.out / "coverage.csv", rows, columns)


def embeddings(of: Annotated[Comparison, tyro.conf.arg(name="")]) -> None:
    """Write principal components of random data and of an explorer's last quarter: OUT/embeddings.csv."""
    pretrained = of.load()
    frame_stack = pretrained.encoder.in_channels // 3
    pixels = {}
    for path in of.datasets:
        random = FrameDataset.open(path, frame_stack=frame_stack)
        pixels[f"{random.domain} random"] = sample_pixels(random, of.samples, seed=of.seed)
    for path in of.replays:
        replay = StoredReplay(path, frame_stack=frame_stack)
        chosen = of.draw(int(0.75 * len(replay)), len(replay), of.samples, "embeddings", path.name)
        pixels[f"{path.name} explorer"] = replay.observations(chosen)
    points = torch.cat([embed_pixels(pretrained.encoder, images) for images in pixels.values()]).cpu()
    coordinates, explained = principal_components(points)
    write_json(of.out / "explained.json", {"explained_variance_ratio": explained.tolist()})
    table = pd.DataFrame(coordinates.numpy(), columns=["pc1", "pc2", "pc3"])
    table.insert(0, "source", [source for source, images in pixels.items() for _ in images])
    write_rows(of.out / "embeddings.csv", table)


# --- cost of pre-training -------------------------------------------------------------------------------------------


def timing(
    stage_of: StageOf,
    *,
    out: Path,
    training: UseAppendAction[tuple[str, ...]] = (),
    paper_training: UseAppendAction[tuple[str, ...]] = (),
    updates: int = 100,
    paper_updates: int = 0,
    device: str = "cpu",
    threads: int = 1,
) -> None:
    """Write the cost of training encoders, from a timed part of it: OUT/timing.csv.

    A training is a `pretrain ...` command without --out and --device, once with the settings of this scale and once
    with the paper's; the costs of several add up. As many updates are timed as warm up before. Without `paper_updates`
    the paper's hours stay open, unless both commands are the same.
    """
    torch.set_num_threads(threads)
    rows = []
    for command, paper_command in zip(training, paper_training, strict=True):
        here = _Timed(stage_of, command, out / "timed", device)
        paper = _Timed(stage_of, paper_command, out / "timed", device)
        timed, seconds, each = here.time(updates)
        paper_each = each if command == paper_command else math.nan
        if command != paper_command and paper_updates:
            paper_each = paper.time(paper_updates)[-1]
        sources = [Path(source).parent / "done.json" for source in here.stage.sources]
        collected = [read_json(path, error=RecordError)["seconds"] for path in sources if path.exists()]
        plan = here.plan
        rows.append({
            "domains": len(sources), "encoder_updates": timed,
            "decisions": timed * plan.encoder_update_interval // plan.encoder_updates_each if plan else 0,
            "seconds": seconds, "budget_updates": here.updates, "budget_decisions": here.decisions,
            "projected_hours": each * here.updates / 3600, "paper_updates": paper.updates,
            "paper_decisions": paper.decisions, "paper_projected_hours": paper_each * paper.updates / 3600,
            "collection_seconds": sum(collected) if collected else math.nan,
        })  # fmt: skip
    total: dict[str, Any] = {"method": here.stage.method, **pd.DataFrame(rows, dtype=object).sum(skipna=False)}
    total["seconds_per_update"] = 3600 * total["projected_hours"] / total["budget_updates"]
    total["paper_seconds_per_update"] = 3600 * total["paper_projected_hours"] / total["paper_updates"]
    per_decision = total["seconds_per_update"] * total["encoder_updates"]
    total["seconds_per_decision"] = per_decision / total["decisions"] if total["decisions"] else math.nan
    write_rows(out / "timing.csv", [{**total, "threads": threads, "device": device}])


class _Timed:
    """A training's command, read as the command line does, with the plan of an exploring method."""

    def __init__(self, stage_of: StageOf, text: str, out: Path, device: str) -> None:
        words = shlex.split(text)
        arguments = [*words[1:], "--out", str(out), "--device", device]
        self.stage: Any = tyro.cli(stage_of(words), args=arguments)
        method = get_method(self.stage.method)
        config: Any = self.stage.config
        self.plan = plan_exploration(method, self.stage.sources, config) if method.exploration else None
        self.updates: int = self.plan.encoder_updates if self.plan else config.updates
        self.decisions = self.plan.decisions if self.plan else 0

    def time(self, updates: int) -> tuple[int, float, float]:
        """Return timed updates, their seconds, and seconds per update by the median over windows."""
        stage, plan = self.stage, self.plan
        # Updates of one round over all domains.
        period = len(stage.sources) * (plan.encoder_updates_each if plan else 1)
        window = period * math.ceil(updates / (WINDOWS * period))
        needed = 2 * WINDOWS * window
        settings = {"updates": needed, "log_interval": window}
        if plan is not None:
            first, interval = min(plan.first_update, RANDOM_AGENT_STEPS), plan.encoder_update_interval
            # The first update comes with the first multiple of the interval that is not random.
            rounds = interval * (math.ceil(first / interval) + math.ceil(needed / period) - 1) + 1
            env_steps = rounds * sum(plan.repeats)
            settings = {"env_steps": env_steps, "random_agent_steps": first, "log_interval": window}
            settings |= {"checkpoint_interval_env_steps": env_steps}
        shutil.rmtree(stage.out, ignore_errors=True)
        try:
            replace(stage, config=replace(stage.config, **settings)).run()
            record = pd.read_csv(stage.out / "pretrain.csv").set_index("updates")["unix_time_s"]
        finally:
            shutil.rmtree(stage.out, ignore_errors=True)
        times = record[[count * window for count in range(WINDOWS, 2 * WINDOWS + 1)]].to_numpy()
        each = float(np.median(np.diff(times))) / window
        return WINDOWS * window, float(times[-1] - times[0]), each


def main(arguments: Sequence[str], stage_of: StageOf) -> None:
    """Run ``crptpro measure``; ``stage_of`` returns the class that the command line reads a training with."""
    commands: dict[str, Any] = {each.__name__: each for each in (prototypes, coverage, embeddings)}
    commands["timing"] = partial(timing, stage_of)
    tyro.extras.subcommand_cli_from_dict(commands, prog="crptpro measure", args=arguments)
