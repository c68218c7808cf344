from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from toy_world import collection_request, random_episode

from crptpro import pretrained
from crptpro.cards import read_json, write_json
from crptpro.data.collection import DomainCollection
from crptpro.directory_lock import DirectoryLock
from crptpro.downstream_config import DownstreamConfig
from crptpro.errors import RecordError
from crptpro.experiments import building
from crptpro.experiments.building import JobSettings, build, new_loss
from crptpro.experiments.pieces import (
    KINDS,
    DatasetPiece,
    ExploredPiece,
    FinetunedPiece,
    Piece,
    PretrainedPiece,
    RunPiece,
    UntrainedPiece,
    settings,
)
from crptpro.experiments.row_files import read_rows
from crptpro.experiments.store import CLOCK, DESCRIPTION, DONE, Store
from crptpro.pretrained import load_pretrained

LOSS = settings(num_prototypes=8, latent_dim=4, hidden_dim=8)
JOB = JobSettings()


@dataclass(frozen=True)
class Number(Piece):
    """A piece that takes no time: its own number and those of its parts."""

    own: int
    parts: tuple[Number, ...] = ()

    @property
    def title(self) -> str:
        return f"number {self.own}"


@pytest.fixture(autouse=True)
def numbers(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers can be made here; returns those that were, in order."""
    made: list[int] = []
    monkeypatch.setattr(Number, "kind", "number", raising=False)
    monkeypatch.setitem(KINDS, "number", Number)

    def make_number(piece: Number, store: Store, job: JobSettings) -> None:
        made.append(piece.own)
        if piece.own < 0:
            raise ValueError("a negative number")
        below = [int((store.path(part) / "number").read_text()) for part in piece.parts]
        (store.path(piece) / "number").write_text(str(piece.own + sum(below)))

    building.register(Number)(make_number)
    return made


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def quiet_again() -> Iterator[None]:
    """The library's log lines go where they went before, once a program's main has redirected them."""
    library = logging.getLogger("crptpro")
    before = library.handlers[:], library.level, library.propagate
    yield
    library.handlers[:], library.propagate = before[0], before[2]
    library.setLevel(before[1])


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "root")


def toy_dataset(store: Store, domain: str = "pendulum") -> DatasetPiece:
    """A finished dataset, of random bytes, under the name of a real domain."""
    piece = DatasetPiece(domain, 40, 0)
    request = collection_request(domain=domain, transitions=40, image_size=84)
    collection = DomainCollection(store.dataset(piece), request)
    for index in range(4):
        collection.next_job()
        collection.accept(index, random_episode(10, size=84, seed=index))
    collection.close()
    write_json(store.path(piece) / DONE, {"seconds": 2.0})
    return piece


def test_a_finished_piece_keeps_nothing_that_only_continues_it(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def leave_all(piece: Piece, store: Store, job: JobSettings) -> None:
        for name in ("checkpoints", "replay", "agent"):
            (store.path(piece) / name).mkdir()

    monkeypatch.setattr(building, "make", leave_all)
    run = RunPiece("pendulum_swingup", None, 0)
    explored = ExploredPiece("apt-s", 0, ("pendulum",))
    for piece, kept in ((run, {"agent"}), (explored, {"agent", "replay"})):
        build(piece, store, JOB)
        assert {path.name for path in store.path(piece).iterdir() if path.is_dir()} == kept


def test_a_piece_is_made_described_and_marked_as_done(store: Store, numbers: list[int]) -> None:
    piece = Number(3)
    assert not store.is_done(piece)
    build(piece, store, JobSettings(threads=2))
    assert store.is_done(piece)
    assert store.described(piece.key) == piece
    done = read_json(store.path(piece) / DONE)
    assert done["seconds"] == store.seconds(piece) >= 0
    assert done["job"] == {"device": "cpu", "threads": 2, "workers": 1, "plugins": []}
    assert {"versions", "hardware", "git_revision"} <= set(done)
    assert torch.get_num_threads() == 2


def test_a_finished_piece_is_not_made_again(store: Store, numbers: list[int]) -> None:
    build(Number(3), store, JOB)
    before = (store.path(Number(3)) / DONE).read_bytes()
    build(Number(3), store, JOB)
    assert numbers == [3]
    assert (store.path(Number(3)) / DONE).read_bytes() == before


def test_a_piece_whose_needs_are_missing_is_refused(store: Store, numbers: list[int]) -> None:
    part = Number(1)
    with pytest.raises(RecordError, match=f"needs {part.key}, which is not finished"):
        build(Number(2, (part,)), store, JOB)
    assert numbers == []
    assert not store.path(Number(2, (part,))).exists()
    build(part, store, JOB)
    build(Number(2, (part,)), store, JOB)
    assert (store.path(Number(2, (part,))) / "number").read_text() == "3"


def test_a_finished_piece_needs_nothing_any_more(store: Store, numbers: list[int]) -> None:
    part = Number(1)
    whole = Number(2, (part,))
    build(part, store, JOB)
    build(whole, store, JOB)
    (store.path(part) / DONE).unlink()
    build(whole, store, JOB)
    assert numbers == [1, 2]


def test_a_piece_that_fails_is_not_done_and_keeps_its_description(store: Store, numbers: list[int]) -> None:
    for _ in range(2):
        with pytest.raises(ValueError, match="negative"):
            build(Number(-1), store, JOB)
    assert numbers == [-1, -1]
    assert not store.is_done(Number(-1))
    assert (store.path(Number(-1)) / DESCRIPTION).is_file()


@pytest.mark.parametrize("own", [1, -1])
def test_what_only_an_unfinished_piece_needs_goes_with_its_end(
    store: Store, numbers: list[int], own: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Number, "leftovers", ("checkpoints", "never made"))
    piece = Number(own)
    checkpoint = store.path(piece) / "checkpoints" / "1.pt"
    checkpoint.parent.mkdir(parents=True)
    checkpoint.touch()
    with contextlib.suppress(ValueError):
        build(piece, store, JOB)
    assert checkpoint.exists() == (own < 0)
    assert store.is_done(piece) == (own > 0)


def test_a_directory_in_use_is_refused(store: Store, numbers: list[int]) -> None:
    foreign = DirectoryLock(store.path(Number(5)))  # not re-entrant: like another process's
    with foreign, pytest.raises(RecordError, match="Another process"):
        build(Number(5), store, JOB)
    assert numbers == []


def test_a_kind_that_nothing_makes_is_refused(store: Store) -> None:
    class Riddle(Piece):
        kind = ""
        title = "riddle"
        needs = ()
        key = "riddle"

        def to_json(self) -> dict:
            return {}

    with pytest.raises(RecordError, match="Nothing makes"):
        build(Riddle(), store, JOB)


def test_an_untrained_encoder_depends_on_its_seed(store: Store) -> None:
    weights = []
    for seed in (0, 1):
        build(UntrainedPiece("random-encoder", seed), store, JOB)
        artifact = load_pretrained(store.encoder(UntrainedPiece("random-encoder", seed)))
        assert artifact.method == "random-encoder"
        weights.append(next(artifact.encoder.parameters()))
    assert not torch.equal(*weights)


def test_a_fresh_loss_depends_on_the_seed_and_has_the_pieces_options(store: Store) -> None:
    piece = PretrainedPiece("crptpro", 0, (), updates=1, loss=LOSS)
    one, again, other = (new_loss(each) for each in (piece, piece, replace(piece, seed=1)))
    assert one.prototypes.weight.shape == (8, 4)
    assert torch.equal(one.prototypes.weight, again.prototypes.weight)
    assert not torch.equal(one.prototypes.weight, other.prototypes.weight)


def test_an_encoder_is_trained_recorded_and_goes_on_where_it_was_interrupted(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    piece = PretrainedPiece(
        "crptpro",
        0,
        datasets=(toy_dataset(store), toy_dataset(store, "cartpole")),
        updates=4,
        training=settings(batch_size=4, log_interval=2),
        loss=LOSS,
    )
    monkeypatch.setattr(pretrained, "save_pretrained", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        build(piece, store, JOB)
    monkeypatch.undo()
    record = store.path(piece) / "pretrain.csv"
    before = read_rows(record)
    assert [row["updates"] for row in before] == ["2", "4"]
    assert not store.is_done(piece)
    first = read_json(store.path(piece) / CLOCK)
    build(piece, store, JOB)
    assert read_rows(record) == before
    done = read_json(store.path(piece) / DONE)
    assert (first["attempts"], done["attempts"]) == (1, 2)
    assert done["seconds"] == store.seconds(piece) > first["seconds"] > 0
    assert not (store.path(piece) / CLOCK).exists()
    artifact = load_pretrained(store.encoder(piece))
    assert artifact.card["training"]["updates"] == 4
    assert read_json(store.path(piece) / "config.json")["config"]["piece"] == piece.to_json()

    finetuned = FinetunedPiece(
        "crptpro-finetune", 0, piece, piece.datasets[0], updates=2, training=settings(batch_size=4)
    )
    build(finetuned, store, JOB)
    on = load_pretrained(store.encoder(finetuned))
    assert on.label == "crptpro-finetune"
    assert on.card["training"]["started_from"] == artifact.identity()


def test_an_encoder_of_which_only_the_records_were_kept_is_made_again_with_the_same_numbers(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    piece = PretrainedPiece("crptpro", 0, (toy_dataset(store),), updates=4, loss=LOSS,
                            training=settings(batch_size=4, log_interval=2))  # fmt: skip
    build(piece, store, JOB)
    directory = store.path(piece)
    rows, identity = read_rows(directory / "pretrain.csv"), load_pretrained(store.encoder(piece)).identity()
    (store.encoder(piece) / "weights.safetensors").unlink()
    assert not store.is_done(piece)
    with monkeypatch.context() as patch:
        patch.setattr(pretrained, "save_pretrained", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            build(piece, store, JOB)
    assert not store.is_recorded(piece)  # the old record is not taken for the new encoder's
    build(piece, store, JOB)
    assert load_pretrained(store.encoder(piece)).identity() == identity
    ignored = {"unix_time_s", "updates_per_s", "resident_bytes"}
    again = read_rows(directory / "pretrain.csv")
    assert [{k: v for k, v in row.items() if k not in ignored} for row in again] == [
        {k: v for k, v in row.items() if k not in ignored} for row in rows
    ]


def test_a_dataset_of_which_only_the_records_were_kept_is_collected_again(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    piece = toy_dataset(store)
    assert store.is_done(piece)
    for path in store.dataset(piece).rglob("*.memmap"):
        path.unlink()
    found: list[bool] = []
    monkeypatch.setattr(
        building, "make", lambda piece, store, job: found.append(store.dataset(piece).exists())
    )
    build(piece, store, JOB)
    assert found == [False]  # nothing that a collection could take for its own


def test_a_stage_that_refuses_leaves_the_piece_open(store: Store) -> None:
    piece = PretrainedPiece("crptpro", 0, (toy_dataset(store),), updates=2, loss=settings(sparkle=1))
    with pytest.raises(ValueError, match="sparkle"):
        build(piece, store, JOB)
    assert not store.is_done(piece)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_job_of_one_core_neither_evaluates_nor_draws_in_others(
    store: Store, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[DownstreamConfig] = []
    monkeypatch.setattr("crptpro.training.train_downstream", lambda *_, config, **__: seen.append(config))
    encoder = UntrainedPiece("random-encoder", 0)
    build(encoder, store, JOB)
    build(RunPiece("pendulum_swingup", encoder, 0), store, JobSettings(threads=threads))
    (config,) = seen
    assert (config.eval_workers, config.render_ahead) == ((0, False) if threads == 1 else (None, None))
