from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import pytest

from crptpro.domains import Domain, register_domain
from crptpro.errors import CRPTproError, UnknownNameError
from crptpro.experiments.budgets import budget
from crptpro.experiments.goals import (
    DRQ,
    FINETUNE,
    METHODS,
    RANDOM_ENCODER,
    Goal,
    Request,
    dataset,
    encoder,
    encoder_for_task,
    explores,
    finetuned,
    is_single_domain,
    run,
    runs,
)
from crptpro.experiments.pieces import (
    ExploredPiece,
    FinetunedPiece,
    PretrainedPiece,
    RunPiece,
    UntrainedPiece,
    settings,
)
from crptpro.experiments.published import EFFICIENCY, EfficiencyRow
from crptpro.experiments.scales import PAPER, SMALL, TINY, get_scale
from crptpro.objectives import ATCLoss, ExplorationDefaults, MethodDefaults, register_method, registry

A = ("cheetah", "walker", "quadruped")


def test_a_method_on_datasets_has_one_of_each_domain_and_the_papers_budget() -> None:
    piece = encoder(PAPER, "crptpro", A, 3)
    assert isinstance(piece, PretrainedPiece)
    assert [(d.domain, d.transitions, d.seed) for d in piece.datasets] == [(name, 100_000, 3) for name in A]
    assert (piece.method, piece.seed, piece.updates) == ("crptpro", 3, 50_000)
    assert (piece.training, piece.loss) == ((), ())


def test_tasks_name_their_domains_and_transitions_may_be_given() -> None:
    piece = encoder(PAPER, "atc", ("walker_run",), 0, transitions=10_000)
    assert isinstance(piece, PretrainedPiece)
    assert piece.datasets == (dataset(PAPER, "walker", 0, transitions=10_000),)


def test_an_exploring_method_has_no_datasets() -> None:
    piece = encoder(TINY, "becl", A, 0)
    assert isinstance(piece, ExploredPiece)
    assert piece.domains == A
    explore = dict(piece.explore)
    assert (explore["env_steps"], explore["batch_size"], explore["quality"]) == (120, 4, "fast")
    assert encoder(PAPER, "becl", A, 0).to_json().get("explore") is None


def test_the_untrained_encoder_depends_on_its_seed_alone() -> None:
    assert encoder(PAPER, RANDOM_ENCODER, A, 1) == encoder(TINY, RANDOM_ENCODER, ("walker",), 1)
    assert isinstance(encoder(PAPER, RANDOM_ENCODER, A, 1), UntrainedPiece)


def test_an_option_that_the_method_has_anyway_does_not_make_another_encoder() -> None:
    plain = encoder(PAPER, "crptpro", A, 0)
    assert encoder(PAPER, "crptpro", A, 0, loss=settings(intr_loss_coef=5e-3)) == plain
    assert encoder(PAPER, "crptpro", A, 0, loss=settings(intr_loss_coef=0.0)) != plain
    exploring = encoder(PAPER, "proto-rl-c", A, 0)
    assert encoder(PAPER, "proto-rl-c", A, 0, loss=settings(intr_loss_coef=0.0)) == exploring
    assert encoder(PAPER, "proto-rl-c", A, 0, loss=settings(intr_loss_coef=5e-3)) != exploring
    small = encoder(SMALL, "crptpro", A, 0, loss=settings(temperature=0.2))
    assert dict(small.loss) == {"num_prototypes": 128, "temperature": 0.2}  # type: ignore[attr-defined]


def test_drq_has_no_encoder() -> None:
    assert encoder_for_task(PAPER, DRQ, A, "walker_run", 0) is None
    with pytest.raises(UnknownNameError, match="drq"):
        encoder(PAPER, DRQ, A, 0)


@pytest.mark.parametrize("method", ["proto-rl-s", "apt-s"])
def test_a_single_domain_method_has_the_tasks_domain_alone(method: str) -> None:
    piece = encoder_for_task(PAPER, method, A, "walker_run", 0)
    assert piece == encoder(PAPER, method, ("walker",), 0)
    assert piece == encoder_for_task(PAPER, method, ("walker", "pendulum"), "walker_stand", 0)


def test_which_systems_explore_and_which_do_so_in_one_domain() -> None:
    exploring = {"proto-rl-c", "proto-rl-s", "apt-c", "apt-s", "becl"}
    assert {method for method in METHODS if explores(method)} == exploring
    assert {method for method in METHODS if is_single_domain(method)} == {"proto-rl-s", "apt-s"}


@pytest.mark.parametrize(
    ("task", "updates"),
    [
        ("pendulum_swingup", 2_000),
        ("reach_duplo", 2_000),
        ("cartpole_swingup_sparse", 3_000),
        ("cheetah_run", 1_000),
        ("walker_run", 500),
        ("finger_spin", 3_000),  # the paper has none: the largest
    ],
)
def test_fine_tuning_takes_the_papers_updates_of_the_domain(task: str, updates: int) -> None:
    piece = encoder_for_task(PAPER, FINETUNE, A, task, 0)
    assert isinstance(piece, FinetunedPiece)
    assert piece.base == encoder(PAPER, "crptpro", A, 0)
    assert piece.updates == updates
    assert piece == finetuned(PAPER, piece.base, task, 0)


def test_a_run_takes_the_scales_settings_and_drqs_its_own_besides() -> None:
    on = encoder(TINY, "crptpro", A, 0)
    assert dict(run(TINY, "walker_run", on, 5).config) == {**dict(TINY.run), "quality": "fast"}
    assert run(PAPER, "walker_run", None, 5) == RunPiece("walker_run", None, 5)


def test_every_encoder_has_every_downstream_seed() -> None:
    request = Request(PAPER, encoder_seeds=(0, 7), seeds=(0, 1, 2))
    encoders = {seed: encoder(PAPER, "atc", A, seed) for seed in request.encoder_seeds}
    goals = runs(request, "atc", "walker_run", encoders, group="A")
    assert [goal.piece for goal in goals] == [
        run(PAPER, "walker_run", encoders[first], second) for first in (0, 7) for second in (0, 1, 2)
    ]
    assert dict(goals[-1].place) == {"task": "walker_run", "group": "A", "encoder_seed": 7, "seed": 2}


def test_a_system_without_encoder_has_as_many_different_runs() -> None:
    request = Request(PAPER, encoder_seeds=(0, 7), seeds=(0, 3))
    goals = runs(request, DRQ, "walker_run", {0: None, 7: None})
    assert [goal.piece.seed for goal in goals] == [0, 3, 7_000, 7_003]  # type: ignore[attr-defined]


def test_a_run_without_encoder_does_not_depend_on_what_else_is_asked_for() -> None:
    def asked(encoder_seeds: tuple[int, ...], seeds: tuple[int, ...]) -> set[Goal]:
        request = Request(PAPER, encoder_seeds=encoder_seeds, seeds=seeds)
        return set(runs(request, DRQ, "walker_run", dict.fromkeys(encoder_seeds)))

    whole = asked((0, 1), (0, 1))
    assert len(whole) == len({goal.piece for goal in whole}) == 4
    assert asked((0,), (0, 1)) | asked((1,), (0, 1)) == whole
    assert asked((0, 1), (0,)) < whole


def test_a_domains_name_stands_for_its_task() -> None:
    assert Request(PAPER, tasks=("walker", "walker_run", "quadruped_walk", "hopper")).tasks == (
        "walker_run", "quadruped_walk", "hopper_hop",
    )  # fmt: skip
    spelled = ("manip_reach_duplo", "manipulation_reach_duplo", "reach_duplo", "manip_lift_brick_vision")
    assert Request(PAPER, tasks=spelled).tasks == ("reach_duplo", "lift_brick")


def test_a_users_method_is_another_piece_when_it_is_registered_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))

    def key(**options: Any) -> str:
        register_method("mine", ATCLoss, MethodDefaults(lr=options.pop("lr", 1e-3)), **options)
        return encoder(SMALL, "mine", A, 0).key

    first = key()
    assert key() == first
    changed = [key(lr=3e-2), key(loss_options={"latent_dim": 64}), key(encoder_options={"pixel_offset": 0.5})]
    assert len({first, *changed}) == 4
    piece = encoder(SMALL, "atc", A, 0)
    assert isinstance(piece, PretrainedPiece)
    assert piece.definition == ""


def stands_for(option: object) -> object:
    return option


def test_a_function_among_a_users_options_is_called_by_its_name_and_never_by_its_address(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))
    register_method("mine", ATCLoss, loss_options={"latent_dim": stands_for})
    assert f"{__name__}.stands_for" in encoder(SMALL, "mine", A, 0).definition  # type: ignore[attr-defined]
    register_method("mine", ATCLoss, loss_options={"latent_dim": object()})
    with pytest.raises(CRPTproError, match="called otherwise in every process"):
        encoder(SMALL, "mine", A, 0)


def test_a_users_domain_is_another_piece_when_it_is_registered_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("crptpro.domains._registered", {})

    def keys(**options: Any) -> tuple[str, ...]:
        register_domain(Domain("mine", "mine_task", **{"make": stands_for, **options}))
        explorer = encoder(SMALL, "proto-rl-s", ("mine",), 0)
        return dataset(SMALL, "mine", 0).key, explorer.key, run(SMALL, "mine_task", None, 0).key

    first = keys()
    assert keys() == first
    bound = {"make": functools.partial(stands_for, option=1)}
    for changed in (keys(camera=1), keys(action_repeat=4), keys(make=keys), keys(**bound)):
        assert not set(changed) & set(first)
    assert keys(**bound) == keys(make=functools.partial(stands_for, option=1))
    assert dataset(SMALL, "walker", 0).definition == run(SMALL, "walker_run", None, 0).definition == ""


@pytest.mark.parametrize("is_single", [False, True])
@pytest.mark.parametrize("each", [1, 3])
def test_an_explorer_that_a_scale_does_not_name_has_its_budget(
    monkeypatch: pytest.MonkeyPatch, is_single: bool, each: int
) -> None:
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))
    exploration = ExplorationDefaults(is_single_domain=is_single, encoder_updates_each=each)
    register_method("mine", ATCLoss, exploration=exploration)
    domains, known = (A[:1], "proto-rl-s") if is_single else (A, "proto-rl-c")
    mine, usual = budget(encoder(SMALL, "mine", domains, 0)), budget(encoder(SMALL, known, domains, 0))
    assert mine.decisions == usual.decisions == pytest.approx(20_000, rel=0.01)
    assert mine.updates == pytest.approx(usual.updates, rel=0.01)


def test_a_variant_of_a_method_takes_the_scales_options_of_its_loss() -> None:
    piece = encoder(SMALL, "released-code", A, 0)
    assert isinstance(piece, PretrainedPiece)
    assert dict(piece.loss) == {"num_prototypes": 128}
    assert encoder(PAPER, "released-code", A, 0).loss == ()  # type: ignore[attr-defined]


def test_downstream_seeds_are_the_scales_unless_given() -> None:
    assert Request(PAPER).downstream_seeds == (0, 1, 2)
    assert Request(SMALL, seeds=(5,)).downstream_seeds == (5,)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Request(PAPER, methods=("crtpro",)), UnknownNameError, "crptpro"),
        (lambda: Request(PAPER, methods=("crptpro-fine",)), UnknownNameError, "crptpro-finetune"),
        (
            lambda: Request(PAPER, methods=("foo",)),
            UnknownNameError,
            "becl, crptpro, crptpro-fast, crptpro-finetune, drq",
        ),
        (lambda: Request(PAPER, groups=("E",)), UnknownNameError, "'E'; choose from A, B, C, D"),
        (lambda: Request(PAPER, tasks=("walker_rum",)), UnknownNameError, "walker_run"),
        (lambda: get_scale("huge"), UnknownNameError, "'huge'; choose tiny, small, paper"),
        (lambda: Request(PAPER, encoder_seeds=()), CRPTproError, "`encoder_seeds`"),
        (lambda: Request(PAPER, seeds=(1, 1)), CRPTproError, r"`seeds`.*\(1, 1\)"),
        (lambda: Request(PAPER, seeds=(1_000,)), CRPTproError, "`seeds`.*from 0 to 999, got"),
        (lambda: Request(PAPER, encoder_seeds=(-1,)), CRPTproError, "`encoder_seeds`.*from 0 to 999, got"),
    ],
)
def test_a_request_that_nobody_can_meet_is_refused(
    make: Callable[[], object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize("row", EFFICIENCY, ids=lambda row: row.method)
def test_the_papers_scale_has_nearly_the_papers_encoder_updates(row: EfficiencyRow) -> None:
    # The random decisions come out of the published env steps; BeCL updates its encoder three times per agent update.
    each = 3 if row.method == "becl" else 1
    for domains, published in zip((A[:1], A[:2], A), row.encoder_updates):
        sets = [(name,) for name in domains] if is_single_domain(row.method) else [domains]
        updates = sum(budget(encoder(PAPER, row.method, names, 0)).updates for names in sets)
        assert 0.93 * published * each <= updates <= published * each


@pytest.mark.parametrize("method", ["proto-rl-c", "apt-c", "becl"])
def test_at_the_small_scale_exploring_methods_have_as_many_updates_as_the_others(method: str) -> None:
    assert budget(encoder(SMALL, method, A, 0)).updates == pytest.approx(SMALL.updates, rel=2e-3)


def test_the_budget_of_an_exploration_is_counted_over_all_domains() -> None:
    # 120 env steps are 20 decisions in each of three domains, 8 of them random; the encoder learns at 8, 10, ..., 18.
    assert budget(encoder(TINY, "proto-rl-c", A, 0)) == (18, 60)
    assert budget(encoder(TINY, "proto-rl-s", ("walker",), 0)) == (26, 60)
    assert budget(encoder(TINY, "crptpro", A, 0)) == (6, 0)
    assert budget(encoder(TINY, RANDOM_ENCODER, A, 0)) == (0, 0)
