"""How many pieces every experiment has, counted by hand, and which of them experiments share."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from crptpro.errors import UnknownNameError
from crptpro.experiments.analyses import PRETRAINED
from crptpro.experiments.budgets import budget
from crptpro.experiments.catalogue import EXPERIMENTS, get_experiment
from crptpro.experiments.goals import Goal, Request, encoder
from crptpro.experiments.measurements import CoveragePiece, EmbeddingsPiece, ProbePiece, TimingPiece
from crptpro.experiments.pieces import EncoderPiece, ExploredPiece, PretrainedPiece, RunPiece
from crptpro.experiments.plan import make_plan
from crptpro.experiments.scales import PAPER, SMALL, TINY
from crptpro.experiments.store import Store

ENCODERS = ("encoder", "explored", "finetuned", "untrained")


def counted(goals: list[Goal], root: Path) -> tuple[int, int, int, int]:
    """Distinct runs, measurements, encoders and datasets of a plan."""
    kinds = Counter(piece.kind for piece in make_plan((goal.piece for goal in goals), Store(root)).pieces)
    encoders = sum(kinds.pop(kind, 0) for kind in ENCODERS)
    runs, datasets = kinds.pop("run", 0), kinds.pop("dataset", 0)
    return runs, sum(kinds.values()), encoders, datasets


# name: goals, and then different runs, measurements, encoders, datasets.
AT_PAPER_SCALE = {
    # 12 rows x 11 methods x 3 seeds; DrQ, the random encoder and the two (S) methods know no groups, and of the 8
    # tasks 4 stand in two. 6 cross-domain methods in 4 groups, 12 fine-tuned encoders, 2 x 8 (S) ones, a random one.
    "seen": (396, 7 * 36 + 4 * 24, 0, 24 + 12 + 16 + 1, 8),
    # 10 rows x 7 methods x 3 seeds; the random encoder has 8 tasks, 2 of them twice. 6 methods on 2 groups.
    "unseen": (210, 6 * 30 + 24, 0, 13, 6),
    "colors": (63, 63, 0, 7, 3),
    # 5 domains x 6 methods x 3 seeds; of the group's domains, quadruped is not among the five.
    "finetune": (90, 90, 0, 2 + 5 + 5 + 5, 6),
    # 6 tasks x 5 variants and 2 tasks x 2, x 3 seeds; two variants of two methods and the preset for two groups, two
    # variants of one method for two domains.
    "ablation": (102, 102, 0, 10 + 4, 6),
    # 3 tasks x 3 seeds x (2 methods x 5 weights + 3 capacities), of which one is the default both times.
    "sensitivity": (117, 108, 0, 5 + 5 + 2, 9),
    # 8 methods x 3 numbers of domains; each (S) method has three encoders timed, and two sums. No encoder is made.
    "efficiency": (24, 0, 6 * 3 + 2 * 5, 0, 3),
    "prototypes": (7, 0, 7, 7, 3),
    "coverage": (1, 0, 1, 2, 3),
    "stability": (4, 0, 0, 4, 3),
    # Groups B and C share manipulation.
    "visualize": (2, 0, 2, 4, 5),
    # 9 encoders x 5 domains x 2 colours; the reversed ones of each domain are drawn once.
    "probe": (90, 0, 90 + 5, 9, 5),
}


@pytest.mark.parametrize("name", AT_PAPER_SCALE)
def test_an_experiment_has_as_many_pieces_as_counted_by_hand(name: str, tmp_path: Path) -> None:
    goals = EXPERIMENTS[name].goals(Request(PAPER))
    assert (len(goals), *counted(goals, tmp_path)) == AT_PAPER_SCALE[name]


def test_the_ablation_of_a_single_domain_method_has_the_papers_weights_and_env_steps() -> None:
    def weights_and_env_steps(request: Request) -> dict[str, set[tuple[object, ...]]]:
        found: dict[str, set[tuple[object, ...]]] = {}
        for goal in EXPERIMENTS["ablation"].goals(request):
            encoder = goal.piece.encoder  # type: ignore[attr-defined]
            weight, env_steps = (
                dict(given).get(name, "usual")
                for given, name in ((encoder.loss, "intr_loss_coef"), (encoder.explore, "env_steps"))
            )
            found.setdefault(goal.label, set()).add((*encoder.domains, weight, env_steps))
        return found

    with_dispersion, without = "proto-rl-s with dispersion", "proto-rl-s"
    assert weights_and_env_steps(Request(PAPER, methods=("proto-rl-s",))) == {
        with_dispersion: {("cheetah", 1e-3, 200_000), ("hopper", 5e-4, 200_000)},
        without: {("cheetah", "usual", 200_000), ("hopper", "usual", 200_000)},
    }
    asked = weights_and_env_steps(Request(PAPER, methods=("proto-rl-s",), tasks=("walker_run",)))
    assert asked[with_dispersion] == {("walker", 5e-3, 200_000)}
    assert weights_and_env_steps(Request(SMALL, methods=("proto-rl-s",), tasks=("walker_run",)))[without] == {
        ("walker", "usual", 40_000)
    }


def test_what_has_seen_the_task_s_domain_is_not_called_unseen() -> None:
    methods = ("crptpro", "crptpro-finetune", "proto-rl-s")
    labels = {
        name: {goal.label for goal in EXPERIMENTS[name].goals(Request(SMALL, methods=methods))}
        for name in ("unseen", "colors")
    }
    assert labels == {"unseen": {"crptpro"}, "colors": {"crptpro", "proto-rl-s"}}


def test_two_levels_of_seeds_multiply(tmp_path: Path) -> None:
    request = Request(SMALL, methods=("crptpro", "drq"), groups=("A",), encoder_seeds=(0, 1), seeds=(0, 1))
    goals = EXPERIMENTS["seen"].goals(request)
    assert counted(goals, tmp_path) == (3 * 2 * 4, 0, 2, 6)
    for label in ("crptpro", "drq"):
        seeds = Counter(
            (dict(goal.place)["encoder_seed"], dict(goal.place)["seed"])
            for goal in goals
            if goal.label == label
        )
        assert seeds == dict.fromkeys([(0, 0), (0, 1), (1, 0), (1, 1)], 3)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_goal_says_where_it_stands_and_no_place_is_taken_twice(name: str) -> None:
    assert EXPERIMENTS[name].name == name
    goals = EXPERIMENTS[name].goals(Request(PAPER, encoder_seeds=(0, 1)))
    places = Counter((goal.label, goal.place) for goal in goals)
    assert max(places.values()) == 1
    for goal in goals:
        place = dict(goal.place)
        assert {"group", "encoder_seed"} <= set(place)
        assert ("seed" in place and "task" in place) == isinstance(goal.piece, RunPiece)


def test_experiments_share_what_they_have_in_common() -> None:
    seen = {goal.piece.encoder for goal in EXPERIMENTS["seen"].goals(Request(PAPER))}  # type: ignore[attr-defined]
    for name in ("probe", "prototypes", "coverage", "visualize"):
        for goal in EXPERIMENTS[name].goals(Request(PAPER)):
            piece = goal.piece
            own = [needed for needed in piece.needs if isinstance(needed, EncoderPiece)]
            assert own
            if "with" not in goal.label:  # with or without dispersion, where the method itself is not
                assert set(own) <= seen, goal
    default = encoder(PAPER, "crptpro", ("cheetah", "walker", "quadruped"), 0)
    sensitive = [
        goal.piece.encoder  # type: ignore[attr-defined]
        for goal in EXPERIMENTS["sensitivity"].goals(Request(PAPER))
        if goal.label in ("crptpro, alpha 0.005", "crptpro, b 100,000")
    ]
    assert len(sensitive) == 18
    assert set(sensitive) == {default}


def test_methods_groups_and_tasks_of_a_request_narrow_every_experiment() -> None:
    request = Request(PAPER, methods=("crptpro", "proto-rl-s"), groups=("C",), tasks=("finger_spin",))
    for name, experiment in EXPERIMENTS.items():
        for goal in experiment.goals(request):
            assert dict(goal.place)["group"] == "C", name
            assert goal.label.startswith(("crptpro", "proto-rl-s")), name
            assert dict(goal.place).get("task", "finger_spin") == "finger_spin", name


def test_methods_without_the_thing_measured_are_passed_over() -> None:
    request = Request(PAPER, methods=("drq", "random-encoder", "crptpro-finetune"))
    for name in ("efficiency", "prototypes", "coverage", "stability", "visualize"):
        assert EXPERIMENTS[name].goals(request) == []
    labels = {goal.label for goal in EXPERIMENTS["sensitivity"].goals(request)}
    assert labels == {f"crptpro-finetune, alpha {alpha:g}" for alpha in {0.0, 5e-3, *PAPER.alphas}}
    assert EXPERIMENTS["sensitivity"].goals(Request(PAPER, methods=("atc",))) == []
    labels = {goal.label for goal in EXPERIMENTS["probe"].goals(request)}
    assert labels == {"random-encoder", "crptpro-finetune"}


def test_fine_tuning_starts_from_an_encoder_with_the_weight_that_its_row_names() -> None:
    request = Request(PAPER, methods=("crptpro-finetune",), tasks=("walker_run",), seeds=(0,))
    bases = {goal.label: goal.piece.encoder.base for goal in EXPERIMENTS["sensitivity"].goals(request)}  # type: ignore[attr-defined]
    assert len(set(bases.values())) == len(bases) > 2
    assert dict(bases["crptpro-finetune, alpha 0.5"].loss) == {"intr_loss_coef": 0.5}


def test_colours_are_reversed_in_the_way_that_the_request_says() -> None:
    for colors in ("reversed_background", "reversed_image"):
        request = Request(PAPER, colors=colors)
        runs = [goal.piece for goal in EXPERIMENTS["colors"].goals(request)]
        assert {run.colors for run in runs if isinstance(run, RunPiece)} == {colors}
        probes = [goal.piece for goal in EXPERIMENTS["probe"].goals(request)]
        assert {piece.colors for piece in probes if isinstance(piece, ProbePiece)} == {"normal", colors}
    assert len(EXPERIMENTS["probe"].goals(Request(PAPER, colors="normal"))) == 45


def test_efficiency_adds_the_encoders_of_single_domain_methods_up() -> None:
    goals = EXPERIMENTS["efficiency"].goals(Request(PAPER))
    assert [goal.label for goal in goals[::3]] == list(PRETRAINED)
    found = {(goal.label, dict(goal.place)["domains"]): goal.piece for goal in goals}
    three = found["proto-rl-s", 3]
    assert isinstance(three, TimingPiece)
    assert [piece.domain_names for piece in three.encoders] == [("cheetah",), ("walker",), ("quadruped",)]
    assert found["proto-rl-s", 1] == three.parts[0]
    shared = found["proto-rl-c", 3]
    assert isinstance(shared, TimingPiece)
    assert [piece.domain_names for piece in shared.encoders] == [("cheetah", "walker", "quadruped")]
    assert budget(shared.paper[0]).decisions == 3 * 33_334
    assert shared.paper == shared.encoders
    crptpro = found["crptpro", 2]
    assert isinstance(crptpro, TimingPiece)
    assert budget(crptpro.paper[0]) == (50_000, 0)


def test_a_timing_of_a_small_scale_knows_the_papers_budget() -> None:
    request = Request(SMALL, methods=("crptpro",))
    for goal in EXPERIMENTS["efficiency"].goals(request):
        assert isinstance(goal.piece, TimingPiece)
        assert budget(goal.piece.paper[0]).updates == 50_000
        assert goal.piece.paper_timed == 7
        assert goal.piece.encoders[0].updates == 3_000  # type: ignore[attr-defined]


def test_stability_differs_in_its_data_alone() -> None:
    goals = {goal.label: goal.piece for goal in EXPERIMENTS["stability"].goals(Request(PAPER))}
    assert list(goals) == ["crptpro", "crptpro without dispersion", "crptpro-fast", "proto-rl-c"]
    random, active = goals["crptpro without dispersion"], goals["proto-rl-c"]
    assert isinstance(random, PretrainedPiece)
    assert isinstance(active, ExploredPiece)
    assert random.domain_names == active.domains
    assert dict(random.loss) == {"intr_loss_coef": 0.0}
    assert active.loss == ()  # which is without dispersion


def test_coverage_compares_the_explorer_with_random_data_of_its_domains_in_crptpros_eyes() -> None:
    (goal,) = EXPERIMENTS["coverage"].goals(Request(TINY))
    piece = goal.piece
    assert isinstance(piece, CoveragePiece)
    assert piece.explorer.method == "proto-rl-c"
    assert tuple(dataset.domain for dataset in piece.datasets) == piece.explorer.domains
    assert piece.encoder == encoder(TINY, "crptpro", piece.explorer.domains, 0)
    assert piece.samples == TINY.coverage_samples


def test_the_figure_of_embeddings_has_the_papers_explorers() -> None:
    goals = EXPERIMENTS["visualize"].goals(Request(PAPER))
    pieces = [goal.piece for goal in goals]
    assert all(isinstance(piece, EmbeddingsPiece) and piece.samples == 125 for piece in pieces)
    assert [piece.explorer.domains for piece in pieces] == [("pendulum",), ("finger",)]  # type: ignore[attr-defined]
    (walker,) = EXPERIMENTS["visualize"].goals(Request(PAPER, groups=("A",)))
    assert dict(walker.place)["domains"] == "walker"


def test_the_probe_covers_every_encoder_seen_and_unseen_domains() -> None:
    goals = EXPERIMENTS["probe"].goals(Request(TINY))
    for label in (*PRETRAINED, "random-encoder"):
        own = [dict(goal.place) for goal in goals if goal.label == label]
        domains = {place["domain"] for place in own}
        assert {"cheetah", "walker", "quadruped"} < domains
        assert len(domains) >= 5
    assert {goal.piece.dataset.transitions for goal in goals} == {TINY.probe_transitions}  # type: ignore[attr-defined]
    assert EXPERIMENTS["probe"].goals(Request(PAPER))[0].piece.dataset.transitions == 100_000  # type: ignore[attr-defined]


def test_an_unknown_experiment_is_refused_with_the_nearest_name() -> None:
    assert get_experiment("seen").title == "Tasks of seen domains"
    with pytest.raises(UnknownNameError, match=r"'sean'.*'seen'.*probe"):
        get_experiment("sean")
