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
from tyro.conf import UseAppendAction

from crptpro.analysis.coverage import coverage as particle_estimate
from crptpro.analysis.embeddings import embed_pixels
from crptpro.analysis.probe import probe, probe_samples
from crptpro.artifact import read_json, write_json, write_whole
from crptpro.data import FrameDataset, StoredReplay
from crptpro.errors import RecordError
from crptpro.modules import Projector
from crptpro.modules.encoder import images_of
from crptpro.modules.precision import device_of
from crptpro.objectives import get_method
from crptpro.pretrained import Pretrained, domains_seen, load_pretrained
from crptpro.seeding import derive_seed
from crptpro.training.explore import plan_exploration

StageOf = Callable[[Sequence[str]], type]  # returns the dataclass of the stage that a command line names
WINDOWS = 5  # parts of a timing; their median is robust against one slow part
RANDOM_AGENT_STEPS = 24  # random ones per domain before a timed exploration, instead of the method's own
COVERAGE_WINDOWS = 10  # of the training; fewer if a window would have fewer agent steps of a domain than samples


def write_rows(path: Path, rows: pd.DataFrame | Sequence[Mapping[str, Any]]) -> None:
    """Write rows as a CSV file, whole or not at all, in place of an earlier one."""
    write_whole(path, pd.DataFrame(rows, dtype=object).to_csv(index=False, lineterminator="\n"))


def probe_rows(
    pretrained: Any, dataset: FrameDataset, *, encoder: str, samples: int, seed: int
) -> list[dict[str, Any]]:
    """Probe an encoder, called ``encoder`` in the rows, on a draw from a dataset with physical state.

    Its features are probed, and its projections if it has a projector. The untrained control gets an untrained
    projector, so that it has z, too. Returns the rows of ``probe.csv``: one per measure, and per coordinate of each R2.

    Raises:
        DatasetError: there is no physical state, or too little data to split.
    """
    frame_stack = images_of(pretrained.encoder)["frame_stack"]
    observed = probe_samples(dataset, samples=samples, seed=seed, frame_stack=frame_stack)
    is_control = pretrained.method.startswith("random-encoder")
    projector = _untrained_projector(pretrained) if is_control else pretrained.projector
    about = {
        "method": pretrained.label, "domain": dataset.domain,
        "seen": "yes" if dataset.domain in domains_seen(pretrained.card) else "no",
        "colors": dataset.card.get("colors", "normal"),
    }  # fmt: skip
    counts = {"samples": len(observed.pixels), "held_out_episodes": observed.held_out_episodes, "seed": seed}
    rows = []
    for embedding, result in probe(observed, pretrained.encoder, projector).items():
        found: list[tuple[str, str, Any]] = [
            *(("r2_position", *each) for each in result.positions.items()),
            *(("r2_velocity", *each) for each in result.velocities.items()),
            *((f"r2_{kind}", name, "") for kind, name in result.left_out),
            ("r2_position", "", result.position_r2), ("r2_velocity", "", result.velocity_r2),
            ("effective_rank", "", result.effective_rank), ("mean_cosine", "", result.mean_cosine),
        ]  # fmt: skip
        for measure, coordinate, value in found:
            row = {"embedding": embedding, "measure": measure, "coordinate": coordinate, "value": value}
            rows.append({"encoder": encoder, **about, **row, **counts})
    return rows


def _untrained_projector(pretrained: Pretrained) -> Projector:
    """Return a projector at its initialisation, from the encoder's seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(int(pretrained.card.get("seed", 0)), "untrained_projector"))
        projector = Projector(pretrained.encoder.feature_dim)
    return projector.requires_grad_(False).eval().to(device_of(pretrained.encoder) or "cpu")


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

    A window has the same agent steps of both sources; a source with too few of them has no row.
    """
    pretrained, explored = of.load(), load_pretrained(of.explorer)
    frame_stack = images_of(pretrained.encoder)["frame_stack"]
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
        lost = total - len(replay)  # the oldest agent steps, which the ring has overwritten
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
    write_rows(of.out / "coverage.csv", rows)


def embeddings(of: Annotated[Comparison, tyro.conf.arg(name="")]) -> None:
    """Write principal components of random data and of an explorer's last quarter: OUT/embeddings.csv.

    Deviation: the paper collects the explorer's data after its training.
    """
    from sklearn.decomposition import PCA

    pretrained = of.load()
    frame_stack = images_of(pretrained.encoder)["frame_stack"]
    pixels = {}
    for path in of.datasets:
        generator = torch.Generator().manual_seed(of.seed)
        random = FrameDataset.open(path, frame_stack=frame_stack, generator=generator)
        pixels[f"{random.domain} random"] = random.sample(of.samples)["pixels"]
    for path in of.replays:
        replay = StoredReplay(path, frame_stack=frame_stack)
        chosen = of.draw(int(0.75 * len(replay)), len(replay), of.samples, "embeddings", path.name)
        pixels[f"{path.name} explorer"] = replay.observations(chosen)
    points = torch.cat([embed_pixels(pretrained.encoder, images) for images in pixels.values()]).cpu()
    pca = PCA(3, svd_solver="full")
    table = pd.DataFrame(pca.fit_transform(points.double().numpy()), columns=["pc1", "pc2", "pc3"])
    write_json(of.out / "explained.json", {"explained_variance_ratio": pca.explained_variance_ratio_.tolist()})
    table.insert(0, "source", [source for source, images in pixels.items() for _ in images])
    write_rows(of.out / "embeddings.csv", table)


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
    with the paper's; the costs of several add up. As many updates are timed as were run to warm up. Without
    `paper_updates` the paper's hours are NaN, unless both commands are the same.
    """
    torch.set_num_threads(threads)
    rows = []
    for command, papers in zip(training, paper_training, strict=True):
        cost = _cost(stage_of, command, updates, out / "timed", device)
        paper = cost if command == papers else _cost(stage_of, papers, paper_updates, out / "timed", device)
        rows.append({
            **cost, "paper_updates": paper["budget_updates"], "paper_decisions": paper["budget_decisions"],
            "paper_projected_hours": paper["projected_hours"],
        })  # fmt: skip
    costs = pd.DataFrame(rows, dtype=object).set_index("method")
    total: dict[str, Any] = {"method": costs.index[0], **costs.sum(skipna=False)}
    total["seconds_per_update"] = 3600 * total["projected_hours"] / total["budget_updates"]
    total["paper_seconds_per_update"] = 3600 * total["paper_projected_hours"] / total["paper_updates"]
    per_decision = total["seconds_per_update"] * total["encoder_updates"]
    total["seconds_per_decision"] = per_decision / total["decisions"] if total["decisions"] else math.nan
    write_rows(out / "timing.csv", [{**total, "threads": threads, "device": device}])


def _cost(stage_of: StageOf, command: str, updates: int, out: Path, device: str) -> dict[str, Any]:
    """Return a training's budget, and its hours projected from some timed updates; NaN without any."""
    words = shlex.split(command)
    stage: Any = tyro.cli(stage_of(words), args=[*words[1:], "--out", str(out), "--device", device])
    method, sources = get_method(stage.method), stage.sources
    plan = plan_exploration(method, sources, stage.config) if method.exploration else None
    budget = plan.encoder_updates if plan else stage.config.updates
    period = len(sources) * (plan.encoder_updates_each if plan else 1)  # updates of one round over all domains
    window = period * math.ceil(updates / (WINDOWS * period))
    timed = WINDOWS * window
    settings = {"updates": 2 * timed, "log_interval": window}
    if plan:
        first, interval = min(plan.first_update, RANDOM_AGENT_STEPS), plan.encoder_update_interval
        # The first update comes with the first multiple of the interval that is not random.
        env_steps = interval * (math.ceil(first / interval) + 2 * timed // period) * sum(plan.repeats)
        settings = {"env_steps": env_steps, "random_agent_steps": first, "log_interval": window}
        settings["checkpoint_interval_env_steps"] = env_steps
    times = np.full(WINDOWS + 1, np.nan)
    if updates:
        shutil.rmtree(out, ignore_errors=True)
        try:
            replace(stage, config=replace(stage.config, **settings)).run()
            record = pd.read_csv(out / "pretrain.csv").set_index("updates")["unix_time_s"]
            times = record[[count * window for count in range(WINDOWS, 2 * WINDOWS + 1)]].to_numpy()
        finally:
            shutil.rmtree(out, ignore_errors=True)
    done = [] if plan else [Path(source).parent / "done.json" for source in sources]
    collected = [read_json(path, error=RecordError)["seconds"] for path in done if path.exists()]
    return {
        "method": method.name, "domains": len(sources), "encoder_updates": timed,
        "decisions": timed * plan.encoder_update_interval // plan.encoder_updates_each if plan else 0,
        "seconds": float(times[-1] - times[0]), "budget_updates": budget,
        "budget_decisions": plan.decisions if plan else 0,
        "projected_hours": float(np.median(np.diff(times))) / max(window, 1) * budget / 3600,
        "collection_seconds": sum(collected) if collected else math.nan,
    }  # fmt: skip


def main(arguments: Sequence[str], stage_of: StageOf) -> None:
    """Run ``crptpro measure``; ``stage_of`` returns the class that the command line reads a training with."""
    commands: dict[str, Any] = {each.__name__: each for each in (coverage, embeddings)}
    commands["timing"] = partial(timing, stage_of)
    tyro.extras.subcommand_cli_from_dict(commands, prog="crptpro measure", args=arguments)
