"""Every measurement on what the real simulator shows, in the smallest sensible form."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F

from crptpro.cards import read_json
from crptpro.data import FrameDataset, StoredReplay
from crptpro.errors import RecordError
from crptpro.experiments.budgets import budget
from crptpro.experiments.building import JobSettings, build
from crptpro.experiments.goals import dataset, encoder
from crptpro.experiments.measurements import (
    CoveragePiece,
    EmbeddingsPiece,
    ProbePiece,
    PrototypesPiece,
    TimingPiece,
)
from crptpro.experiments.pieces import (
    EncoderPiece,
    ExploredPiece,
    Piece,
    PretrainedPiece,
    UntrainedPiece,
    settings,
)
from crptpro.experiments.plan import make_plan
from crptpro.experiments.probing import COLUMNS as PROBE_COLUMNS
from crptpro.experiments.probing import probe_rows
from crptpro.experiments.row_files import read_rows
from crptpro.experiments.scales import TINY
from crptpro.experiments.store import Store
from crptpro.experiments.timing import COLUMNS as TIMING_COLUMNS
from crptpro.pretrained import load_pretrained

pytestmark = [pytest.mark.gl, pytest.mark.slow]

DOMAINS = ("pendulum", "cartpole")
DATA = (
    dataset(TINY, "pendulum", 0, transitions=TINY.probe_transitions),  # enough episodes to be probed
    dataset(TINY, "cartpole", 0),
)
JOB = JobSettings()


def trained() -> PretrainedPiece:
    piece = encoder(TINY, "crptpro", DOMAINS, 0)
    assert isinstance(piece, PretrainedPiece)
    return replace(piece, datasets=DATA, training=settings(batch_size=4, log_interval=2))


def explorer(method: str, *domains: str) -> ExploredPiece:
    piece = encoder(TINY, method, domains, 0)
    assert isinstance(piece, ExploredPiece)
    return piece


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    threads = torch.get_num_threads()
    yield Store(tmp_path_factory.mktemp("measuring"))
    torch.set_num_threads(threads)


def make(piece: Piece, store: Store) -> Path:
    """Make a piece with all that it needs, unless it is there; returns its directory."""
    for missing in make_plan([piece], store).missing:
        build(missing, store, JOB)
    return store.path(piece)


def timing_of(*encoders: EncoderPiece, paper_timed: int = 1) -> TimingPiece:
    """The timing of encoders whose paper has batches of six."""

    def at_paper(piece: EncoderPiece) -> EncoderPiece:
        if isinstance(piece, PretrainedPiece):
            return replace(piece, updates=7_200, training=settings(batch_size=6), datasets=())
        assert isinstance(piece, ExploredPiece)
        return replace(piece, explore=settings(**{**dict(piece.explore), "batch_size": 6, "env_steps": 240}))

    paper = tuple(at_paper(piece) for piece in encoders)
    return TimingPiece(encoders, paper, TINY.timing_updates, paper_timed=paper_timed)


def timed(store: Store, *encoders: EncoderPiece) -> dict[str, str]:
    piece = timing_of(*encoders)
    (row,) = read_rows(make(piece, store) / "timing.csv")
    assert tuple(row) == TIMING_COLUMNS
    assert row["method"] == encoders[0].method
    assert float(row["seconds"]) > 0
    at_paper = sum(budget(paper).updates for paper in piece.paper)
    assert int(row["paper_updates"]) == at_paper
    hours = float(row["paper_seconds_per_update"]) * at_paper / 3600
    assert float(row["paper_projected_hours"]) == pytest.approx(hours)
    updates, decisions = (sum(part) for part in zip(*map(budget, encoders)))
    assert (row["budget_updates"], row["budget_decisions"]) == (str(updates), str(decisions))
    assert (row["threads"], row["device"]) == ("1", "cpu")
    hours = float(row["seconds_per_update"]) * updates / 3600
    assert float(row["projected_hours"]) == pytest.approx(hours)
    return row


def test_training_on_datasets_is_timed_without_their_collection(store: Store) -> None:
    row = timed(store, trained())
    assert (row["domains"], row["encoder_updates"], row["decisions"]) == ("2", "10", "0")
    assert row["seconds_per_decision"] == ""
    collected = sum(store.seconds(data) for data in DATA)
    assert float(row["collection_seconds"]) == pytest.approx(collected)
    assert not store.path(
        trained()
    ).exists()  # nothing of the timing stays, and the encoder was not asked for


def test_the_papers_hours_are_left_open_unless_its_updates_are_timed(store: Store) -> None:
    (row,) = read_rows(make(timing_of(trained(), paper_timed=0), store) / "timing.csv")
    assert row["paper_projected_hours"] == row["paper_seconds_per_update"] == ""
    alike = TimingPiece((trained(),), (trained(),), TINY.timing_updates)
    (row,) = read_rows(make(alike, store) / "timing.csv")
    assert row["paper_projected_hours"] == row["projected_hours"]


def test_exploring_is_timed_with_its_decisions_past_the_random_ones(store: Store) -> None:
    row = timed(store, explorer("proto-rl-c", *DOMAINS))
    assert (row["domains"], row["encoder_updates"], row["decisions"]) == ("2", "10", "20")
    assert float(row["seconds_per_decision"]) == pytest.approx(float(row["seconds_per_update"]) / 2)
    assert row["collection_seconds"] == ""


def test_a_method_with_several_encoder_updates_each_time_is_timed(store: Store) -> None:
    row = timed(store, explorer("becl", "pendulum"))
    # Three updates every six decisions; five windows of them.
    assert (row["encoder_updates"], row["decisions"]) == ("15", "30")


def test_encoders_of_single_domains_are_timed_one_by_one(store: Store) -> None:
    encoders = tuple(explorer("apt-s", domain) for domain in DOMAINS)
    row = timed(store, *encoders)
    assert (row["domains"], row["encoder_updates"]) == ("2", "10")
    each = [timed_part(store, piece) for piece in timing_of(*encoders).parts]
    assert float(row["seconds"]) == pytest.approx(sum(each))


def timed_part(store: Store, piece: TimingPiece) -> float:
    assert store.is_done(piece)
    return float(read_rows(store.path(piece) / "timing.csv")[0]["seconds"])


def test_prototypes_are_measured_along_training_and_at_its_end(store: Store) -> None:
    rows = read_rows(make(PrototypesPiece(trained()), store) / "prototypes.csv")
    assert [row["updates"] for row in rows] == ["2", "4", "6"]
    assert {(row["method"], row["has_dispersion"]) for row in rows} == {("crptpro", "True")}
    prototypes = load_pretrained(store.encoder(trained())).prototypes
    assert prototypes is not None
    unit = F.normalize(prototypes.weight, dim=1).double()
    cosines = unit @ unit.T
    others = cosines[~torch.eye(16, dtype=torch.bool)].reshape(16, 15)
    nearest = others.sort(dim=1, descending=True).values
    expected = {
        "kne_3": nearest[:, 2].mean(),
        "kne_half": nearest[:, 7].mean(),
        "ane": others.sum() / 16**2,
        "intr": (others / (others + 1.5)).sum() / 16**2,
    }
    for name, value in expected.items():
        assert float(rows[-1][name]) == pytest.approx(float(value), abs=1e-6)
    recorded = read_rows(store.path(trained()) / "pretrain.csv")
    assert float(rows[0]["kne_3"]) == float(recorded[0]["prototype_kne_3"])


def test_prototypes_without_the_dispersion_loss_are_named_so(store: Store) -> None:
    rows = read_rows(make(PrototypesPiece(explorer("proto-rl-c", *DOMAINS)), store) / "prototypes.csv")
    assert {(row["method"], row["has_dispersion"]) for row in rows} == {("proto-rl-c", "False")}
    assert rows[-1]["updates"] == str(budget(explorer("proto-rl-c", *DOMAINS)).updates)


def test_an_encoder_without_prototypes_is_refused(store: Store) -> None:
    untrained = UntrainedPiece("random-encoder", 0)
    build(untrained, store, JOB)
    with pytest.raises(RecordError, match="no prototypes"):
        build(PrototypesPiece(untrained), store, JOB)


def test_coverage_of_random_data_and_of_an_explorers_along_its_training(store: Store) -> None:
    agent = explorer("proto-rl-c", *DOMAINS)
    build_all = make(CoveragePiece(agent, DATA, trained(), samples=14), store)
    rows = read_rows(build_all / "coverage.csv")
    # 30 decisions in each domain are two windows of 15.
    assert [(row["domain"], row["source"], row["env_steps"]) for row in rows] == [
        (domain, source, end)
        for domain in DOMAINS
        for end in ("60", "120")
        for source in ("random", "explorer")
    ]
    assert {(row["source"], row["method"]) for row in rows} == {("random", ""), ("explorer", "proto-rl-c")}
    assert {row["samples"] for row in rows} == {"14"}
    assert all(0 < float(row["coverage"]) < math.log(3) for row in rows)

    whole = CoveragePiece(agent, DATA, trained(), samples=64, windows=1)
    before = digests(store.path(agent) / "replay")
    one = [row for row in read_rows(make(whole, store) / "coverage.csv") if row["source"] == "explorer"]
    assert digests(store.path(agent) / "replay") == before
    assert [row["samples"] for row in one] == ["30", "30"]
    frozen = load_pretrained(store.encoder(trained()))
    assert frozen.projector is not None
    replay = StoredReplay(store.path(agent) / "replay" / "pendulum")
    z = F.normalize(frozen.projector(frozen.encoder(replay.observations(torch.arange(30)))), dim=1).double()
    distances = torch.cdist(z, z, compute_mode="donot_use_mm_for_euclid_dist").sort(dim=1).values[:, 1:13]
    expected = torch.log(1 + distances.mean(1)).mean()
    assert float(one[0]["coverage"]) == pytest.approx(float(expected), abs=1e-4)


def digests(path: Path) -> dict[str, str]:
    return {
        str(file): hashlib.sha256(file.read_bytes()).hexdigest() for file in path.rglob("*") if file.is_file()
    }


def test_principal_components_of_random_data_and_of_an_explorers_late_part(store: Store) -> None:
    agent = explorer("proto-rl-s", "cartpole")
    piece = EmbeddingsPiece(trained(), DATA, agent, samples=TINY.embedded_samples)
    directory = make(piece, store)
    rows = read_rows(directory / "embeddings.csv")
    sources = ("pendulum random", "cartpole random", "cartpole explorer")
    assert Counter(row["source"] for row in rows) == dict.fromkeys(sources, 8)
    points = torch.tensor([[float(row[name]) for name in ("pc1", "pc2", "pc3")] for row in rows])
    assert points.mean(0).abs().max() < 1e-3 * points.abs().max()
    ratio = read_json(directory / "explained.json")["explained_variance_ratio"]
    assert ratio == sorted(ratio, reverse=True)
    assert 0 < sum(ratio) <= 1.0001
    spread = points.var(0)
    assert float(spread[1] / spread[0]) == pytest.approx(ratio[1] / ratio[0], rel=1e-3)


@pytest.mark.parametrize("colors", ["normal", "reversed_background"])
def test_the_state_probe_of_an_encoder_in_both_colours(store: Store, colors: str) -> None:
    piece = ProbePiece(trained(), DATA[0], colors=colors, samples=TINY.probe_samples)  # type: ignore[arg-type]
    rows = read_rows(make(piece, store) / "probe.csv")
    assert tuple(rows[0]) == PROBE_COLUMNS
    about = {(row["encoder"], row["method"], row["domain"], row["seen"], row["colors"]) for row in rows}
    assert about == {(trained().key, "crptpro", "pendulum", "yes", colors)}
    assert {row["embedding"] for row in rows} == {"features", "z"}
    assert {"r2_position", "r2_velocity", "effective_rank", "mean_cosine"} == {row["measure"] for row in rows}
    assert {row["samples"] for row in rows} == {"60"}


def test_other_colours_are_drawn_once_for_all_encoders(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    first = ProbePiece(trained(), DATA[0], colors="reversed_background", samples=TINY.probe_samples)
    second = replace(first, encoder=UntrainedPiece("random-encoder", 0))
    drawn, dataset = first.redrawn, store.dataset(DATA[0])
    make(first, store)
    assert drawn is not None
    assert store.is_done(drawn)

    def refuse(*args: object, **kwargs: object) -> None:
        raise AssertionError("it was drawn again")

    monkeypatch.setattr("crptpro.data.redraw._draw", refuse)
    shared = read_rows(make(second, store) / "probe.csv")
    monkeypatch.undo()
    alone = probe_rows(
        load_pretrained(store.encoder(second.encoder)),
        FrameDataset.open(dataset),
        encoder=second.encoder.key,
        colors="reversed_background",
        samples=TINY.probe_samples,
    )
    assert [row["value"] for row in shared] == [str(row["value"]) for row in alone.measures]


def test_pictures_that_were_removed_are_drawn_again_for_a_new_probe(store: Store) -> None:
    piece = ProbePiece(trained(), DATA[0], colors="reversed_background", samples=40)
    make(piece, store)
    assert piece.redrawn is not None
    (store.redrawn(piece.redrawn) / "weights.safetensors").unlink()
    assert make_plan([piece], store).missing == ()  # its records are all that is asked for
    other = replace(piece, encoder=UntrainedPiece("random-encoder", 0))
    assert piece.redrawn in make_plan([other], store).missing
    make(other, store)
    assert store.is_done(piece.redrawn)


def test_a_domain_that_the_encoder_never_saw_is_probed_as_unseen(store: Store) -> None:
    agent = explorer("proto-rl-s", "cartpole")
    rows = read_rows(make(ProbePiece(agent, DATA[0], samples=60), store) / "probe.csv")
    assert {(row["method"], row["domain"], row["seen"]) for row in rows} == {("proto-rl-s", "pendulum", "no")}
