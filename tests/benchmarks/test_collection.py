from __future__ import annotations

import json

import pytest
import torch
from benchmarks.collecting_ways import OwnCollection, StockCollection, stock_env
from benchmarks.collecting_workers import worker_rates, worker_table
from benchmarks.collection import DOCUMENTED, EXACT, FAST, STOCK, Settings, main, one_core
from toy_world import FIXED

from crptpro.data import EpisodeWriter
from crptpro.envs import make_env
from crptpro.errors import CRPTproError


@pytest.fixture(autouse=True)
def _keep_environment(monkeypatch):
    monkeypatch.setenv("LP_NUM_THREADS", "1")


@pytest.mark.gl
def test_our_exact_pixels_and_rewards_are_those_of_torchrl():
    stock = stock_env("cartpole", image_size=84, action_repeat=2)
    own = make_env("cartpole", seed=0, frame_stack=1, action_repeat=2)
    stock.set_seed(3)  # resets once
    own.set_seed(3)
    own.reset()
    theirs, ours = stock.reset(), own.reset()
    torch.manual_seed(0)
    for _ in range(3):
        assert torch.equal(theirs["pixels"].permute(2, 0, 1), ours["pixels"])
        action = own.action_spec.rand()
        theirs = stock.step(theirs.set("action", action.double()))["next"]
        ours = own.step(ours.set("action", action))["next"]
        assert torch.equal(theirs["reward"].float(), ours["reward"])
    stock.close()
    own.close()


@pytest.mark.gl
def test_both_collections_store_as_many_frames_as_they_are_asked_for(tmp_path):
    stock = StockCollection(
        stock_env("cartpole", image_size=20, action_repeat=2), transitions=3, scratch=tmp_path / "stock", capacity=6
    )  # fmt: skip
    own = OwnCollection(
        lambda: make_env("cartpole", seed=0, frame_stack=1, image_size=20, physics_state=True),
        transitions=3,
        root=tmp_path / "own",
    )
    for _ in range(2):
        stock.collect()
        own.collect()
    assert stock.buffer[:]["pixels"].shape == (6, 20, 20, 3)
    assert ("next", "pixels") not in stock.buffer[:].keys(True)
    layout = own._writer.layout
    stock.close()
    own.close()
    with EpisodeWriter(tmp_path / "own", layout) as written:
        assert (written.transitions, written.frames, written.episodes) == (6, 8, 2)


@pytest.mark.gl
def test_the_script_writes_its_results_and_prints_its_table(tmp_path, capsys):
    settings = Settings(
        domains=("cartpole",),
        block=2,
        rounds=1,
        warmup=0,
        workers=(),
        scratch=tmp_path,
        out=tmp_path / "results",
    )
    results = main(settings)
    written = json.loads((tmp_path / "results" / "collection.json").read_text())["results"]
    assert set(written["environment alone"]["cartpole"]) == {STOCK, DOCUMENTED, EXACT, FAST}
    assert set(written["collecting"]["cartpole"]) == {STOCK, EXACT, FAST}
    stock = results["environment alone"]["cartpole"][STOCK]
    assert stock["times_stock"] == 1
    assert stock["per_s"] == pytest.approx(2 / stock["block"]["median_s"])
    assert written["render"]["gl_renderer"]
    printed = capsys.readouterr().out
    assert printed.count("| cartpole | environment alone |") == 4
    assert printed.count("| cartpole | collecting |") == 3
    assert [file.name for file in tmp_path.iterdir()] == ["results"], "the frames are gone"


def test_the_rate_of_each_number_of_workers_is_measured_with_and_without_the_start(tmp_path):
    rates = worker_rates(FIXED, tmp_path, workers=(2,), transitions=60, rounds=1, quality="exact")
    assert list(rates) == [2]
    assert rates[2]["steady"] > rates[2]["whole"] > 0, (
        "processes take longer to start than such worlds to run"
    )
    assert not list(tmp_path.iterdir())


def test_a_rate_that_could_not_be_measured_stays_blank():
    text = worker_table({1: {"whole": 10.0, "steady": 20.0}, 2: {"whole": 15.0, "steady": None}})
    assert text.splitlines()[2:] == ["| 1 | 20.0 | 1.00 | 10.0 | 1.00 |", "| 2 |  |  | 15.0 | 1.50 |"]


def test_a_domain_that_torchrl_does_not_know_is_refused():
    with pytest.raises(CRPTproError, match="manipulation"):
        stock_env("manipulation", image_size=84, action_repeat=2)


def test_one_core_is_given_back():
    threads = torch.get_num_threads()
    with one_core():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == threads
