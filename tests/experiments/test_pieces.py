from __future__ import annotations

import json
from dataclasses import replace

import pytest

from crptpro.errors import RecordError
from crptpro.experiments.catalogue import EXPERIMENTS
from crptpro.experiments.goals import Request
from crptpro.experiments.measurements import ProbePiece, TimingPiece
from crptpro.experiments.pieces import (
    KINDS,
    DatasetPiece,
    FinetunedPiece,
    Piece,
    PretrainedPiece,
    RunPiece,
    UntrainedPiece,
    piece_from_json,
    settings,
)
from crptpro.experiments.scales import TINY

WALKER = DatasetPiece("walker", 100_000, 0)
ENCODER = PretrainedPiece(
    "crptpro", 0, datasets=(WALKER,), updates=50_000, loss=settings(num_prototypes=128, intr_loss_coef=0.0)
)


def all_pieces() -> dict[str, Piece]:
    """Every piece of every experiment, with what it needs."""
    found: dict[str, Piece] = {}

    def visit(piece: Piece) -> None:
        found[piece.key] = piece
        for needed in piece.needs:
            visit(needed)

    for experiment in EXPERIMENTS.values():
        for goal in experiment.goals(Request(TINY)):
            visit(goal.piece)
    return found


def test_keys_are_the_same_in_every_process_and_version() -> None:
    assert WALKER.key == "dataset-walker-seed-0-98ce5df271"
    assert ENCODER.key == "encoder-crptpro-walker-seed-0-f74f1a9078"


def test_equal_pieces_have_equal_keys_and_any_number_makes_another() -> None:
    assert replace(ENCODER).key == ENCODER.key
    others = [
        replace(ENCODER, updates=49_998),
        replace(ENCODER, seed=1),
        replace(ENCODER, method="proto-rl-c"),
        replace(ENCODER, loss=settings(num_prototypes=128)),
        replace(ENCODER, training=settings(batch_size=128)),
        replace(ENCODER, datasets=(replace(WALKER, seed=1),)),
        replace(ENCODER, datasets=(WALKER, replace(WALKER, domain="cheetah"))),
    ]
    assert len({ENCODER.key, *(piece.key for piece in others)}) == 1 + len(others)


def test_a_field_at_its_default_is_not_part_of_the_key() -> None:
    assert DatasetPiece("walker", 100_000, 0, quality="exact", colors="normal").key == WALKER.key
    assert set(WALKER.to_json()) == {"kind", "domain", "transitions", "seed"}
    assert replace(WALKER, colors="reversed_image").key != WALKER.key


def test_settings_do_not_depend_on_the_order_they_are_named_in() -> None:
    assert settings(b=1, a=(1, 2)) == settings(a=(1, 2), b=1) == (("a", (1, 2)), ("b", 1))


def test_every_kind_of_piece_comes_back_from_its_description() -> None:
    pieces = all_pieces()
    own = {kind for kind, piece in KINDS.items() if piece.__module__.startswith("crptpro.")}
    assert {piece.kind for piece in pieces.values()} == own
    for key, piece in pieces.items():
        back = piece_from_json(json.loads(json.dumps(piece.to_json())))
        assert back == piece
        assert back.key == key


def test_a_key_is_a_plain_file_name_that_tells_what_it_is() -> None:
    colored = replace(DatasetPiece("gymnasium:Reacher-v5", 10, 3), colors="reversed_image")
    assert colored.key.startswith("dataset-gymnasium-Reacher-v5-reversed_image-seed-3-")
    run = RunPiece("walker_run", None, 2)
    assert run.key.startswith("run-walker_run-drq-seed-2-")
    for key in all_pieces():
        assert not set(key) & set("/: +\\")


def test_a_piece_needs_the_pieces_in_its_fields() -> None:
    cheetah = replace(WALKER, domain="cheetah")
    finetuned = FinetunedPiece("crptpro-finetune", 0, base=ENCODER, dataset=cheetah, updates=500)
    assert finetuned.needs == (ENCODER, cheetah)
    assert ENCODER.needs == (WALKER,)
    assert RunPiece("walker_run", None, 0).needs == ()
    assert ProbePiece(UntrainedPiece("random-encoder", 0), WALKER).needs == (
        UntrainedPiece("random-encoder", 0),
        WALKER,
    )


def test_probes_in_other_colours_share_what_has_to_be_drawn() -> None:
    control = UntrainedPiece("random-encoder", 0)
    probes = [ProbePiece(piece, WALKER, colors="reversed_background") for piece in (control, ENCODER)]
    drawn = probes[0].redrawn
    assert drawn is not None
    assert probes[0].needs == (control, WALKER, drawn)
    assert probes[1].needs == (ENCODER, WALKER, drawn)
    assert drawn.needs == (WALKER,)
    assert "colors" in drawn.to_json()
    more = replace(probes[0], samples=4_000)
    assert more.redrawn != drawn
    # Whole images are reversed without a simulator.
    assert replace(probes[0], colors="reversed_image").redrawn is None
    assert replace(probes[0], dataset=replace(WALKER, colors="reversed_background")).redrawn is None


def test_an_encoder_knows_the_domains_of_its_last_training() -> None:
    cheetah = replace(WALKER, domain="cheetah")
    both = replace(ENCODER, datasets=(cheetah, WALKER))
    assert both.domain_names == ("cheetah", "walker")
    assert FinetunedPiece("crptpro-finetune", 0, both, WALKER, 1).domain_names == ("walker",)
    assert UntrainedPiece("random-encoder", 0).domain_names == ()


def test_a_timing_needs_the_data_of_its_encoder_and_not_the_encoder() -> None:
    timing = TimingPiece((ENCODER,), (ENCODER,), updates=10)
    assert timing.is_exclusive
    assert not ENCODER.is_exclusive
    assert timing.needs == (WALKER,)


def test_a_timing_of_several_encoders_needs_that_of_each() -> None:
    one, two = replace(ENCODER, method="apt-s"), replace(ENCODER, method="apt-s", seed=1)
    whole = [replace(piece, updates=100) for piece in (one, two)]
    both = TimingPiece((one, two), tuple(whole), updates=10, threads=2)
    assert list(both.needs) == [
        TimingPiece((piece,), (paper,), 10, threads=2) for piece, paper in zip((one, two), whole)
    ]


def test_a_timing_on_another_device_or_of_more_threads_is_another() -> None:
    timing = TimingPiece((ENCODER,), (ENCODER,), updates=10)
    assert len({timing.key, replace(timing, device="cuda").key, replace(timing, threads=2).key}) == 3


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"kind": "sonnet"}, "no kind of piece 'sonnet'; known are .*dataset"),
        ({}, "no kind of piece None"),
        (
            {"kind": "dataset", "domain": "walker", "transitions": 1, "seed": 0, "fur": 2},
            "kind dataset: .*fur",
        ),
        ({"kind": "dataset", "domain": "walker"}, "kind dataset: .*transitions"),
    ],
)
def test_a_description_that_is_none_is_refused(content: dict, message: str) -> None:
    with pytest.raises(RecordError, match=message):
        piece_from_json(content)
