"""``crptpro measure``: what experiments measure of encoders and their data, each a CSV file in a directory."""

from __future__ import annotations

import dataclasses
import itertools
import math
import shlex
import shutil
import statistics
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from tyro.conf import OmitSubcommandPrefixes, Positional, UseAppendAction, arg, subcommand

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
_PRESENT = arg(help_behavior_hint="(required)")


def write_rows(
    path: str | Path, rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None
) -> None:
    """Write rows as a CSV file, whole or not at all; what was there before is replaced.

    Raises:
        DiskSpaceError: the disk is full.
    """
    import pandas as pd

    write_whole(
        path, pd.DataFrame(list(rows), columns=columns, dtype=object).to_csv(index=False, lineterminator="\n")
    )


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


PROBE_COLUMNS = (
    "encoder", "method", "domain", "seen", "colors", "embedding", "measure", "coordinate", "value", "samples",
    "held_out_episodes", "seed",
)  # fmt: skip
"""Of ``probe.csv``: one row per measure, and per coordinate of each R2."""


def probe_rows(
    pretrained: Any,
    dataset: Any,
    *,
    encoder: str,
    samples: int = 2_000,
    seed: int = 0,
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

    observed = probe_samples(
        dataset,
        samples=samples,
        seed=seed,
        joints=joints_of(dataset.card["task"]),
        frame_stack=pretrained.encoder.in_channels // 3,
    )
    seen = "yes" if dataset.domain in domains_seen(pretrained.card) else "no"
    about = {"method": pretrained.label, "domain": dataset.domain, "seen": seen}
    about["colors"] = dataset.card["colors"]
    counts = {"samples": len(observed.pixels), "held_out_episodes": observed.held_out_episodes, "seed": seed}
    projector = (
        _untrained_projector(pretrained) if pretrained.method == "random-encoder" else pretrained.projector
    )
    table, measures = [], []
    for embedding, result in probe(observed, pretrained.encoder, projector).items():
        means = {
            "r2_position": result.position_r2, "r2_velocity": result.velocity_r2,
            "effective_rank": result.effective_rank, "mean_cosine": result.mean_cosine,
        }  # fmt: skip
        shown = {"R2 positions": f"{result.position_r2:.3f}", "R2 velocities": f"{result.velocity_r2:.3f}"}
        shown |= {
            "effective rank": f"{result.effective_rank:.1f}",
            "mean cosine": f"{result.mean_cosine:.4f}",
        }
        table.append({**about, "embedding": embedding, **shown})
        found: list[tuple[str, str, Any]] = [("r2_position", *each) for each in result.positions.items()]
        found += [("r2_velocity", *each) for each in result.velocities.items()]
        found += [(f"r2_{kind}", name, "") for kind, name in (each.split(" ", 1) for each in result.left_out)]
        found += [(name, "", value) for name, value in means.items()]
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


@dataclass(frozen=True)
class PrototypeSpread:
    """How far prototypes have spread along a training and at its end: OUT/prototypes.csv."""

    encoder: Positional[Path]
    """directory of the pretrained encoder, in its run directory"""
    out: Path
    """directory to write to"""

    def run(self) -> None:
        """Read the record, and measure the weights."""
        from crptpro.objectives.functional import prototype_metrics
        from crptpro.pretrained import load_pretrained

        pretrained = load_pretrained(self.encoder)
        if pretrained.prototypes is None:
            raise RecordError(f"{self.encoder} has no prototypes; its method is {pretrained.method}.")
        options, updates = pretrained.card["loss"]["config"], pretrained.card["training"]["updates"]
        about = {"method": pretrained.method, "has_dispersion": options["intr_loss_coef"] > 0}
        # The record's own last row, if it is of the last update, is of weights that had not been normalised yet.
        rows = [
            {
                **about,
                "updates": row["updates"],
                **{name: row[key] for name, key in PROTOTYPE_METRICS.items()},
            }
            for row in read_rows(self.encoder.parent / "pretrain.csv")
            if int(row["updates"]) < updates
        ]
        found = prototype_metrics(pretrained.prototypes.weight, offset=options["offset"])  # type: ignore[arg-type]
        end = {name: float(found[key]) for name, key in PROTOTYPE_METRICS.items()}
        write_rows(self.out / "prototypes.csv", [*rows, {**about, "updates": updates, **end}])


@dataclass(frozen=True, kw_only=True)
class _Comparison:
    encoder: Path
    """which embeds all observations"""
    explorer: Path
    """encoder of the explorer, in its run directory"""
    replays: Annotated[tuple[Path, ...], _PRESENT]
    """what the explorer saw, a directory for each domain"""
    datasets: Annotated[tuple[Path, ...], _PRESENT]
    """random transitions, one for each domain"""
    out: Path
    """directory to write to"""
    samples: int = 1_024
    """observations of each source"""
    seed: int = 0
    """of the draw"""
    device: str = "cpu"
    """where the encoder runs"""

    def load(self) -> Any:
        from crptpro.pretrained import load_pretrained

        pretrained = load_pretrained(self.encoder)
        for network in (pretrained.encoder, pretrained.projector):
            if network is not None:
                network.to(self.device)
        return pretrained

    def replay(self, path: Path, frame_stack: int) -> Any:
        from crptpro.data import StoredReplay

        return StoredReplay(path, frame_stack=frame_stack)


@dataclass(frozen=True, kw_only=True)
class CoverageOfData(_Comparison):
    """How widely an explorer's observations are spread along its training, beside random data: OUT/coverage.csv.

    A window has the same decisions of both sources. Where one does not have enough of them, it has no row.
    """

    def run(self) -> None:
        """Estimate every window."""
        from crptpro.analysis.coverage import coverage
        from crptpro.analysis.embeddings import embed_pixels
        from crptpro.data import FrameDataset
        from crptpro.pretrained import load_pretrained
        from crptpro.seeding import derive_seed

        pretrained = self.load()
        explorer = load_pretrained(self.explorer)
        training: Any = explorer.card["training"]
        decisions = {entry["domain"]: int(entry["agent_steps"]) for entry in training["datasets"]}
        least = min(decisions.values())
        windows = max(1, min(COVERAGE_WINDOWS, least // self.samples))
        samples = min(self.samples, least // windows)
        rows = []
        for path, replay_path in zip(self.datasets, self.replays, strict=True):
            frame_stack = pretrained.encoder.in_channels // 3
            random = FrameDataset.open(path, frame_stack=frame_stack)
            replay = self.replay(replay_path, frame_stack)
            total = decisions[random.domain]
            lost = total - len(replay)  # the oldest decisions, of a ring that went round
            for window in range(windows):
                start, end = window * total // windows, (window + 1) * total // windows
                for source, first, last in (
                    ("random", start, min(end, len(random))),
                    ("explorer", max(start, lost), end),
                ):
                    if last - first < samples:
                        continue  # estimates of fewer observations cannot be compared
                    seed = derive_seed(self.seed, "coverage", source, random.domain, window)
                    order = torch.randperm(last - first, generator=torch.Generator().manual_seed(seed))
                    chosen = first + order[:samples].sort().values
                    is_random = source == "random"
                    pixels = random[chosen]["pixels"] if is_random else replay.observations(chosen - lost)
                    points = embed_pixels(pretrained.encoder, pixels, projector=pretrained.projector)
                    rows.append(
                        {
                            "source": source,
                            "method": explorer.method if source == "explorer" else "",
                            "domain": random.domain,
                            "env_steps": training["env_steps"] * end // total,
                            "coverage": coverage(F.normalize(points, dim=-1)),
                            "samples": samples,
                        }
                    )
        columns = ("source", "method", "domain", "env_steps", "coverage", "samples")
        write_rows(self.out / "coverage.csv", rows, columns)


@dataclass(frozen=True, kw_only=True)
class PrincipalComponents(_Comparison):
    """Principal components of random data of several domains and of an explorer's last quarter: OUT/embeddings.csv."""

    def run(self) -> None:
        """Embed all observations together."""
        from crptpro.analysis.embeddings import embed_pixels, principal_components, sample_pixels
        from crptpro.data import FrameDataset
        from crptpro.seeding import derive_seed

        pretrained = self.load()
        frame_stack, pixels = pretrained.encoder.in_channels // 3, {}
        for path in self.datasets:
            random = FrameDataset.open(path, frame_stack=frame_stack)
            pixels[f"{random.domain} random"] = sample_pixels(random, self.samples, seed=self.seed)
        for path in self.replays:
            replay = self.replay(path, frame_stack)
            late = len(replay) - int(0.75 * len(replay))
            seed = derive_seed(self.seed, "embeddings", path.name)
            chosen = torch.randperm(late, generator=torch.Generator().manual_seed(seed))[: self.samples]
            pixels[f"{path.name} explorer"] = replay.observations(len(replay) - late + chosen.sort().values)
        points = torch.cat([embed_pixels(pretrained.encoder, images) for images in pixels.values()]).cpu()
        coordinates, explained = principal_components(points)
        sources = [source for source, images in pixels.items() for _ in images]
        ratios = {"explained_variance_ratio": [float(part) for part in explained]}
        write_json(self.out / "explained.json", ratios)
        write_rows(
            self.out / "embeddings.csv",
            (
                {"source": source, **{f"pc{number}": value for number, value in enumerate(point, 1)}}
                for source, point in zip(sources, coordinates.tolist())
            ),
        )


@dataclass(frozen=True)
class Timing:
    """What training encoders takes, from a timed part of it: OUT/timing.csv."""

    out: Path
    """directory to write to"""
    training: Annotated[UseAppendAction[tuple[str, ...]], _PRESENT] = ()
    """a `pretrain ...` command without --out and --device; of several the costs add up"""
    paper_training: UseAppendAction[tuple[str, ...]] = ()
    """the same as the paper trains"""
    updates: int = 100
    """encoder updates that are timed, after as many to warm up"""
    paper_updates: int = 0
    """likewise of the paper's trainings; 0 leaves their hours open unless both are the same"""
    device: str = "cpu"
    """of networks"""
    threads: int = 1
    """of torch"""

    def run(self) -> None:
        """Time every training, and add up."""
        rows = [self._row(*pair) for pair in zip(self.training, self.paper_training, strict=True)]
        write_rows(self.out / "timing.csv", [{**_sum(rows), "threads": self.threads, "device": self.device}])

    def _row(self, training: str, paper: str) -> dict[str, Any]:
        usual, whole = Training(training), Training(paper)
        updates, decisions, seconds, each = self._time(usual, self.updates)
        paper_each: float | None = each if training == paper else None
        if training != paper and self.paper_updates:
            paper_each = self._time(whole, self.paper_updates)[-1]
        collected = [
            read_json(path, error=RecordError)["seconds"]
            for source in usual.sources
            if (path := Path(source).parent / "done.json").exists()
        ]
        return {
            "method": usual.method, "domains": len(usual.sources), "encoder_updates": updates, "decisions": decisions,
            "seconds": seconds, "budget_updates": usual.updates, "budget_decisions": usual.decisions,
            "projected_hours": each * usual.updates / 3600, "paper_updates": whole.updates,
            "paper_decisions": whole.decisions,
            "paper_projected_hours": None if paper_each is None else paper_each * whole.updates / 3600,
            "collection_seconds": sum(collected) if collected else None,
        }  # fmt: skip

    def _time(self, training: Training, updates: int) -> tuple[int, int, float, float]:
        """Return timed updates, their decisions, their seconds, and seconds per update by the median over windows."""
        from crptpro.cli import main

        window = training.period * math.ceil(updates / (WINDOWS * training.period))
        words = [*training.words, *training.shortened(2 * WINDOWS * window), "--log-interval", str(window)]
        directory = self.out / "timed"
        shutil.rmtree(directory, ignore_errors=True)
        torch.set_num_threads(self.threads)
        before = sys.argv
        try:
            sys.argv = ["crptpro", *words, "--out", str(directory), "--device", self.device]
            main()
            rows = read_rows(directory / "pretrain.csv")
        finally:
            sys.argv = before
            shutil.rmtree(directory, ignore_errors=True)
        at = {int(row["updates"]): float(row["unix_time_s"]) for row in rows}
        times = [at[count * window] for count in range(WINDOWS, 2 * WINDOWS + 1)]
        each = statistics.median(after - before for before, after in itertools.pairwise(times)) / window
        timed = WINDOWS * window
        return timed, timed * training.interval // training.updates_each, times[-1] - times[0], each


@dataclass
class Training:
    """A ``pretrain`` command, and what it amounts to."""

    text: str
    words: list[str] = field(init=False)
    sources: list[str] = field(init=False)
    method: str = field(init=False)
    updates: int = field(init=False)
    """of the encoder"""
    decisions: int = field(default=0, init=False)
    """of exploring agents"""
    interval: int = field(default=0, init=False)
    """decisions of a domain from one encoder update on it to the next"""
    updates_each: int = field(default=1, init=False)

    def __post_init__(self) -> None:
        """Read the command."""
        from crptpro.experiments.jobs import exploration_plan
        from crptpro.objectives import get_method
        from crptpro.training import ExploreConfig

        self.words = shlex.split(self.text)
        self.sources = list(itertools.takewhile(lambda word: not word.startswith("--"), self.words[1:]))
        given = dict(itertools.pairwise(self.words))
        self.method = given["--method"]
        method = get_method(self.method)
        self._plan = None
        if method.exploration is None:
            self.updates = int(given["--updates"])
            return
        known = {f"--{each.name.replace('_', '-')}": each.name for each in dataclasses.fields(ExploreConfig)}
        explore = {
            known[name]: int(value) if value.isdecimal() else value
            for name, value in given.items()
            if name in known and name != "--learning-rate"
        }
        self._plan = exploration_plan(method, self.sources, explore)
        self.updates, self.decisions = self._plan.encoder_updates, self._plan.decisions
        self.interval, self.updates_each = self._plan.encoder_update_interval, self._plan.encoder_updates_each

    @property
    def period(self) -> int:
        """Updates after which all domains have had their turn."""
        return len(self.sources) * self.updates_each

    def shortened(self, updates: int) -> list[str]:
        """Return options for so many updates."""
        if self._plan is None:
            return ["--updates", str(updates)]
        first = min(self._plan.first_update, RANDOM_AGENT_STEPS)
        # The first update comes with the first multiple of the interval that is not random.
        rounds = self.interval * (math.ceil(first / self.interval) + math.ceil(updates / self.period) - 1) + 1
        env_steps = rounds * sum(self._plan.repeats)
        options = {
            "env-steps": env_steps,
            "random-agent-steps": first,
            "checkpoint-interval-env-steps": env_steps,
        }
        return [word for name, value in options.items() for word in (f"--{name}", str(value))]


def _sum(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Add the costs of several encoders up; per update, what the whole takes."""
    total: dict[str, Any] = {"method": rows[0]["method"]}
    for name in rows[0]:
        if name != "method":
            values = [row[name] for row in rows]
            total[name] = None if None in values else sum(values)
    hours, paper_hours = total["projected_hours"], total["paper_projected_hours"]
    total["seconds_per_update"] = 3600 * hours / total["budget_updates"]
    per_decision = total["seconds_per_update"] * total["encoder_updates"]
    total["seconds_per_decision"] = per_decision / total["decisions"] if total["decisions"] else None
    total["paper_seconds_per_update"] = (
        None if paper_hours is None else 3600 * paper_hours / total["paper_updates"]
    )
    return total


@dataclass(frozen=True)
class Measure:
    """Measure encoders and their data, as `crptpro reproduce` does in its experiments."""

    what: OmitSubcommandPrefixes[
        Annotated[PrototypeSpread, subcommand("prototypes")]
        | Annotated[CoverageOfData, subcommand("coverage")]
        | Annotated[PrincipalComponents, subcommand("embeddings")]
        | Annotated[Timing, subcommand("timing")]
    ]

    def run(self) -> None:
        """Measure."""
        self.what.run()
