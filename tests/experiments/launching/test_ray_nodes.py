"""What a job asks of a Ray cluster, and what its nodes have."""

from __future__ import annotations

import re
from typing import Any

import pytest

from crptpro.errors import CRPTproError
from crptpro.experiments.launching.ray_cluster import NODE_GROUP, require_node


def node(cores: float, gpus: float = 0, *, is_alive: bool = True, group: str = "") -> dict[str, Any]:
    resources = {"CPU": cores, "memory": 1e9, **({"GPU": gpus} if gpus else {})}
    return {"Alive": is_alive, "Resources": resources, "Labels": {NODE_GROUP: group} if group else {}}


@pytest.mark.parametrize(("nodes", "cores", "gpus"), [
    ([node(4)], 4, 0),
    ([node(2), node(8, 1)], 8, 0.5),
    ([node(64), node(4, 2)], 4, 1),
])  # fmt: skip
def test_a_job_that_one_node_can_take_is_fine(
    nodes: list[dict[str, Any]], cores: int, gpus: float, caplog: pytest.LogCaptureFixture
) -> None:
    require_node(nodes, cores=cores, gpus=gpus)
    assert not caplog.records


@pytest.mark.parametrize(("nodes", "cores", "gpus", "message"), [
    ([node(4), node(2)], 5, 0, "asks for 5 cores and no GPU, .* has 4 cores and no GPU. Change --cores-per-job, or"),
    ([node(4)], 1, 1, "asks for 1 core and 1 GPU, .* has 4 cores and no GPU. Change .*--device cpu"),
    ([node(64), node(4, 1)], 8, 0.5, "asks for 8 cores and 0.5 GPU, .* has 4 cores and 1 GPU"),
    ([node(4), node(64, is_alive=False)], 8, 0, "has 4 cores and no GPU"),
])  # fmt: skip
def test_a_job_that_no_node_can_take_is_refused(
    nodes: list[dict[str, Any]], cores: int, gpus: float, message: str
) -> None:
    with pytest.raises(CRPTproError, match=message):
        require_node(nodes, cores=cores, gpus=gpus)


def test_where_nodes_are_started_as_they_are_needed_there_is_a_warning(
    caplog: pytest.LogCaptureFixture,
) -> None:
    require_node([node(4, group="headgroup")], cores=2, gpus=1)
    assert re.search(r"asks for 2 cores and 1 GPU.*Jobs wait until it starts one that has", caplog.text)
