"""A captured call: static inputs, copied outputs, and when it warms up, records and replays."""

from __future__ import annotations

import contextlib
from typing import Any

import pytest
import torch
from host_reads import NoHostReads
from tensordict import TensorDict

from crptpro.errors import CompileError
from crptpro.training import captured
from crptpro.training.captured import CapturedCall, resolve_cuda_graph


def td(value: float, rows: int = 2) -> TensorDict:
    return TensorDict({"x": torch.full((rows,), value), "next": {"x": torch.full((rows,), -value)}}, [rows])


def test_every_call_reads_the_same_tensors_and_hands_out_copies() -> None:
    places: set[int] = set()
    total = torch.zeros(2)

    def add(batch: TensorDict) -> dict[str, torch.Tensor]:
        places.add(batch["x"].data_ptr())
        return {"total": total.add_(batch["x"] - batch["next", "x"])}

    call = CapturedCall(add)
    mine = td(1.0)
    outputs = [call(batch)["total"] for batch in (mine, td(2.0), td(3.0))]
    assert len(places) == 1
    assert mine["x"].tolist() == [1.0, 1.0]
    assert [output.tolist() for output in outputs] == [[2.0, 2.0], [6.0, 6.0], [12.0, 12.0]]


def test_inputs_that_the_caller_writes_are_read_in_place() -> None:
    inputs = td(1.0)
    call = CapturedCall(lambda batch: {"same": torch.tensor(batch is inputs)}, inputs=inputs)
    assert call(inputs)["same"]
    assert call(td(5.0))["same"]
    assert inputs["next", "x"].tolist() == [-5.0, -5.0]


@pytest.mark.parametrize("other", [td(1.0, rows=3), td(1.0).select("x"), td(1.0).to(torch.float64)])
def test_another_shape_is_refused(other: TensorDict) -> None:
    call = CapturedCall(lambda batch: {})
    call(td(1.0))
    with pytest.raises(ValueError, match="as in its first call"):
        call(other)


class FakeGraph:
    """Replays by calling what was run while it was open."""

    recorded: Any = None
    log: list[str]

    def __init__(self) -> None:
        self.log = []
        FakeGraph.latest = self

    def register_generator_state(self, generator: torch.Generator) -> None:
        self.log.append("generator")

    def replay(self) -> None:
        self.log.append("replay")


@pytest.fixture
def _pretended_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    class Stream:
        def __init__(self, device: Any = None) -> None: ...

        def wait_stream(self, other: Any) -> None: ...

    @contextlib.contextmanager
    def record(graph: FakeGraph, stream: object, capture_error_mode: str) -> Any:
        graph.log.append("record")
        yield

    monkeypatch.setattr(captured, "_is_gpu", lambda device: True)
    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "current_stream", Stream)
    for name in ("stream", "device"):
        monkeypatch.setattr(torch.cuda, name, lambda what: contextlib.nullcontext())
    monkeypatch.setattr(torch.cuda, "CUDAGraph", FakeGraph)
    monkeypatch.setattr(torch.cuda, "graph", record)


@pytest.mark.usefixtures("_pretended_gpu")
def test_it_warms_up_then_records_once_and_replays_until_told_to_forget() -> None:
    runs: list[float] = []
    call = CapturedCall(
        lambda batch: {"seen": runs.append(batch["x"][0].item()) or batch["x"].sum()},
        warmup=2,
        generators=[torch.Generator()],
    )
    for number in range(5):
        assert not call.is_recorded or number > 2
        call(td(float(number)))
    assert runs == [0.0, 1.0, 2.0]  # the third is the recording, which computes nothing on a GPU
    assert FakeGraph.latest.log == ["generator", "record", "replay", "replay", "replay"]
    call.forget()
    assert not call.is_recorded
    call(td(9.0, rows=4))
    assert runs == [0.0, 1.0, 2.0, 9.0]


@pytest.mark.usefixtures("_pretended_gpu")
def test_what_cannot_be_recorded_is_an_error_with_the_remedy() -> None:
    calls = 0

    def fail(batch: TensorDict) -> dict[str, torch.Tensor]:
        nonlocal calls
        calls += 1
        if calls > 1:
            raise RuntimeError("operation not permitted when stream is capturing")
        return {}

    call = CapturedCall(fail, warmup=1)
    call(td(1.0))
    with pytest.raises(CompileError, match="cuda_graph='off' works without"):
        call(td(1.0))


def test_auto_records_only_what_is_fit_for_it_on_a_gpu() -> None:
    assert not resolve_cuda_graph("auto", "cpu")
    assert not resolve_cuda_graph("off", "cuda")
    assert not resolve_cuda_graph("auto", "cuda:1")
    assert resolve_cuda_graph("on", "cuda")
    with pytest.raises(ValueError, match="needs a CUDA device, got 'cpu'"):
        resolve_cuda_graph("on", "cpu")
    with pytest.raises(ValueError, match="`cuda_graph` must be 'auto', 'on' or 'off', got 'yes'"):
        resolve_cuda_graph("yes", "cuda")  # type: ignore[arg-type]


def test_at_least_one_call_warms_up() -> None:
    with pytest.raises(ValueError, match="at least 1, got 0"):
        CapturedCall(lambda batch: {}, warmup=0)


@pytest.mark.parametrize("read", [torch.Tensor.item, torch.nonzero, bool])
def test_what_watches_for_host_reads_notices_them(read: Any) -> None:
    with NoHostReads():
        value = torch.ones(2).sum()
        with pytest.raises(AssertionError, match="reads a value back"):
            read(value)
