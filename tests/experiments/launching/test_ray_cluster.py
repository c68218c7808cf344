"""A real Ray cluster of two nodes on this machine, one of which dies."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest
from fake_pieces import PLUGIN, FakePiece, attempts, counted, plan_of

from crptpro.errors import CRPTproError
from crptpro.experiments.building import JobSettings
from crptpro.experiments.launching import Resources, Work, make_launcher, run_pieces
from crptpro.experiments.launching.ray_cluster import RayLauncher
from crptpro.experiments.store import Store

pytestmark = pytest.mark.slow

SETTINGS = JobSettings(plugins=(PLUGIN,))


class TwoNodes:
    """A head and another node, each with one core."""

    def __init__(self) -> None:
        from ray.cluster_utils import Cluster

        self.cluster = Cluster(
            initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
        )
        self.other = self.cluster.add_node(num_cpus=1)
        self.address: str = self.cluster.address

    def kill_other(self) -> None:
        """End the node's processes without a word to anybody."""
        self.cluster.remove_node(self.other, allow_graceful=False)


@pytest.fixture
def nodes(source_path: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[TwoNodes]:
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    nodes = TwoNodes()
    yield nodes
    nodes.cluster.shutdown()


def test_a_piece_whose_node_died_is_finished_on_another_from_its_own_checkpoint(
    store: Store, nodes: TwoNodes
) -> None:
    pieces = [FakePiece(name, ticks=100) for name in ("one", "two")]
    refused = FakePiece("refused", ends="refusal")
    broken = FakePiece("broken", ends="defect")
    launcher = RayLauncher(nodes.address)
    counts: dict[str, int] = {}

    def kill_half_way() -> None:
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and min(counted(store, piece) for piece in pieces) < 20:
            time.sleep(0.05)
        nodes.kill_other()
        counts.update({piece.name: counted(store, piece) for piece in pieces})

    death = threading.Thread(target=kill_half_way)
    death.start()
    try:
        failures = run_pieces(
            plan_of(store, *pieces, refused, broken), store, SETTINGS, launcher, jobs=2, attempts=2
        )
    finally:
        death.join()
        launcher.close()

    assert all(store.is_done(piece) for piece in pieces)
    by_attempts = sorted(pieces, key=lambda piece: len(attempts(store, piece)))
    [stayed], [lost, again] = (attempts(store, piece) for piece in by_attempts)
    assert lost["node"] != stayed["node"]
    assert again["node"] == stayed["node"]
    assert int(again["from"]) >= 20
    assert int(again["from"]) <= counts[by_attempts[1].name] + 10
    assert lost["threads"] == "1"
    assert "counts on from" in store.log(by_attempts[1]).read_text()
    assert {f.piece.title: (f.attempts, f.reason) for f in failures} == {
        "refused": (1, "refused will never do."), "broken": (2, "RuntimeError: broken is broken"),
    }  # fmt: skip


def test_a_job_that_is_stopped_leaves_a_checkpoint(store: Store, nodes: TwoNodes) -> None:
    piece = FakePiece("stopped", ticks=300)
    store.describe(piece)
    launcher = RayLauncher(nodes.address)
    try:
        job = launcher.start(Work(str(store.root), piece.key, SETTINGS), is_exclusive=False)
        deadline = time.monotonic() + 60
        while counted(store, piece) < 3 and time.monotonic() < deadline:
            time.sleep(0.05)
        job.stop()
        while job.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        assert job.poll() is not None
        assert 3 <= counted(store, piece) < 300
        assert not store.is_done(piece)
        assert not list(store.path(piece).glob("*.partial"))
    finally:
        launcher.close()


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1"])
def test_a_cluster_that_is_not_there_is_said_in_a_line(address: str) -> None:
    with pytest.raises(CRPTproError, match=rf"{address} cannot be used: .*refused.*--ray-address"):
        RayLauncher(address)


def test_ray_can_be_started_here_for_one_command(
    store: Store, source_path: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(
        "RAY_ADDRESS", "local"
    )  # left to itself it would find the cluster of a test beside this one
    launcher = RayLauncher()
    try:
        assert run_pieces(plan_of(store, FakePiece("p")), store, SETTINGS, launcher) == []
    finally:
        launcher.close()


def test_a_job_that_no_node_can_take_is_refused_and_the_ray_that_was_started_for_it_ends(
    source_path: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    import ray

    monkeypatch.setenv("RAY_ADDRESS", "local")
    with pytest.raises(CRPTproError, match=r"asks for 10000 cores and no GPU.*--cores-per-job"):
        make_launcher("ray", Resources(1, cores_per_job=10_000))
    assert not ray.is_initialized()
