"""Every experiment with numbers made by hand, as large as a small reproduction."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from fake_reproduction import Reproduction, pictures, write_table

from crptpro.cards import write_json
from crptpro.experiments.goals import Goal, Request, encoder
from crptpro.experiments.matrix import ablation, colors, finetune, seen, sensitivity, unseen
from crptpro.experiments.measurements import ProbePiece
from crptpro.experiments.pieces import PretrainedPiece, RunPiece, settings
from crptpro.experiments.published import EFFICIENCY
from crptpro.experiments.scales import SMALL
from crptpro.training.video import write_video

LEVEL = {
    "crptpro": 400, "crptpro-fast": 410, "crptpro-finetune": 420, "proto-rl-c": 300, "proto-rl-s": 330, "atc": 200,
    "apt-c": 180, "apt-s": 210, "becl": 150, "drq": 350, "random-encoder": 120,
}  # fmt: skip


def make_whole(root: Path, *, is_brief: bool = True) -> Reproduction:
    """Fill a root; one method is missing on one task, and one experiment has nothing finished.

    Args:
        root: of the reproduction.
        is_brief: leave methods out, for tests; a look at the page wants all of them.
    """
    made = Reproduction(root)
    few = ("crptpro", "proto-rl-c", "becl", "drq", "random-encoder")
    two = Request(SMALL, methods=few if is_brief else (), groups=("A",), encoder_seeds=(0, 1))
    goals = seen(two)
    made.ask("seen", goals)
    _runs(made, [g for g in goals if not (g.label == "becl" and ("task", "quadruped_run") in g.place)])
    for name, experiment in (("unseen", unseen), ("finetune", finetune), ("ablation", ablation)):
        tasks = ("walker_run", "pendulum_swingup")
        some = experiment(Request(SMALL, groups=("A",), tasks=tasks, seeds=(0,) if is_brief else None))
        made.ask(name, some)
        _runs(made, some)
    some = colors(Request(SMALL, methods=("crptpro", "atc", "random-encoder")))
    made.ask("colors", some)
    _runs(made, some)
    some = sensitivity(Request(SMALL, tasks=("walker_run",), seeds=(0,) if is_brief else None))
    made.ask("sensitivity", some)
    _runs(made, some)
    made.ask("seen", seen(Request(SMALL, groups=("B",), methods=("crptpro",))), scale="tiny")
    _measurements(made)
    return made


def _runs(made: Reproduction, goals: Iterable[Goal]) -> None:
    for goal in goals:
        if made.store.is_done(goal.piece):
            continue
        rng = np.random.default_rng(zlib.crc32(goal.piece.key.encode()))
        level = LEVEL[max((m for m in LEVEL if goal.label.startswith(m)), key=len)]
        directory = made.run(goal, float(level + rng.normal(0, 30)), pause_s=40_000.0 * (rng.random() < 0.2))
        assert isinstance(goal.piece, RunPiece)
        if goal.label == "crptpro" and goal.piece.seed == 0 and goal.piece.task == "walker_run":
            write_video(pictures(), directory / "videos" / "env_steps_00020000_episode_0.mp4")


def _measurements(made: Reproduction) -> None:
    timings = []
    for entry in EFFICIENCY:
        for count in (1, 2, 3):
            row = {
                "method": entry.method, "domains": count, "encoder_updates": 100, "decisions": 200, "seconds": 80.0,
                "seconds_per_update": 0.6, "seconds_per_decision": 0.1, "budget_updates": 3_000,
                "budget_decisions": 20_000, "projected_hours": 1.0 + count / 10, "paper_updates": 50_000,
                "paper_decisions": 100_000, "paper_seconds_per_update": 2.4,
                "paper_projected_hours": entry.hours[count - 1] * 1.5,
            }  # fmt: skip
            piece = made.measure("timing", [row], name=f"{entry.method} {count}")
            timings.append(Goal(entry.method, piece, settings(domains=count)))
    made.ask("efficiency", timings)

    spread = []
    for method in ("crptpro", "proto-rl-c", "proto-rl-s"):
        for has in (True, False):
            rows = [
                {"method": method, "has_dispersion": has, "updates": updates, "kne_3": 2e-1 - updates * 1e-5,
                 "kne_half": 1e-4 - updates * 1e-8, "ane": 1e-3 - updates * 2e-7, "intr": -updates * 1e-6}
                for updates in range(0, 3001, 500)
            ]  # fmt: skip
            spread.append(Goal(method, made.measure("prototypes", rows, name=f"{method} {has}")))
    made.ask("prototypes", spread)

    covered = []
    for domain in ("walker", "cheetah", "quadruped"):
        for source, method in (("random", ""), ("explorer", "proto-rl-c"), ("explorer", "apt-c")):
            rows = [
                {"source": source, "method": method, "domain": domain, "env_steps": at,
                 "coverage": 2 + np.log1p(at) / (8 if source == "random" else 6), "samples": 1024}
                for at in range(2_000, 40_001, 2_000)
            ]  # fmt: skip
            covered.append(
                Goal(method or "random", made.measure("coverage", rows, name=f"{domain} {source} {method}"))
            )
    made.ask("coverage", covered)

    rng = np.random.default_rng(0)
    points = []
    for place, source in enumerate(
        ("walker random", "cheetah random", "quadruped random", "walker explorer")
    ):
        for point in rng.normal(place, 0.6, size=(125, 3)):
            points.append({"source": source, **{f"pc{i + 1}": value for i, value in enumerate(point)}})
    piece = made.measure("embeddings", points, name="crptpro")
    write_json(made.store.path(piece) / "explained.json", {"explained_variance_ratio": [0.5, 0.2, 0.1]})
    made.ask("visualize", [Goal("crptpro", piece, settings(group="A"))])

    random_data = encoder(SMALL, "crptpro", ("cheetah", "walker", "quadruped"), 0)
    active_data = encoder(SMALL, "proto-rl-c", ("cheetah", "walker", "quadruped"), 0)
    made.encoder(random_data, plateau=200)
    made.encoder(active_data, plateau=500)
    assert isinstance(random_data, PretrainedPiece)
    made.dataset(random_data)
    made.ask("stability", [Goal("crptpro", random_data), Goal("proto-rl-c", active_data)])

    probed = []
    for label, made_by in (("crptpro", random_data), ("proto-rl-c", active_data)):
        for data in random_data.datasets:
            probed.append(_probe(made, label, ProbePiece(made_by, data), has_z=True))
    probed.append(
        _probe(
            made, "crptpro", ProbePiece(random_data, random_data.datasets[0], colors="reversed_background")
        )
    )
    made.ask("probe", probed)

    tried = []
    for place, value in enumerate(("0.1", "0.05", "annealed")):
        for seed in (0, 1):
            variant = encoder(SMALL, "crptpro", ("walker", "finger"), seed, loss=settings(variant=value))
            made.encoder(variant, plateau=600 - 250 * place + 30 * seed)
            where = settings(factor="assignment temperature", value=value, usual="0.1", seed=seed)
            tried.append(Goal(f"crptpro, temperature {value}", variant, where))
            for updates in (500, 1000):
                piece = ProbePiece(variant, random_data.datasets[1], samples=updates)
                at = settings(**{**dict(where), "updates": updates})
                level = 0.1 * place + updates / 5000
                tried.append(_probe(made, f"crptpro, temperature {value}", piece, at, velocity=level))
    control = ProbePiece(encoder(SMALL, "random-encoder", (), 0), random_data.datasets[1])
    where = settings(factor="control", value="untrained", updates=0)
    made.ask("study", [*tried, _probe(made, "random-encoder", control, where, velocity=0.05)])


def _probe(
    made: Reproduction,
    label: str,
    piece: ProbePiece,
    place: tuple = (),
    *,
    has_z: bool = False,
    velocity: float = 0.4,
) -> Goal:
    rows = []
    for embedding in ("features", "z") if has_z else ("features",):
        base = {
            "encoder": "encoder", "method": label, "domain": piece.dataset.domain, "seen": "yes",
            "colors": piece.colors, "embedding": embedding, "samples": 2000, "held_out_episodes": 3, "seed": 0,
        }  # fmt: skip
        values = {"r2_position": 0.7, "r2_velocity": velocity, "effective_rank": 30.0, "mean_cosine": 0.9}
        rows += [
            {**base, "measure": measure, "coordinate": "", "value": value}
            for measure, value in values.items()
        ]
        rows.append({**base, "measure": "r2_position", "coordinate": "hinge", "value": 0.1})
    write_table(made.finish(piece) / "probe.csv", rows)
    return Goal(label, piece, place or settings(group="A"))
