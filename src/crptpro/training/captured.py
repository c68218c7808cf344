"""A function of tensors of fixed shapes, recorded once as a CUDA graph and then replayed."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from crptpro.errors import CompileError
from crptpro.switches import Switch, check_switch

Outputs = dict[str, Tensor]

#: Calls before the recording. cuDNN chooses its algorithms and Adam makes its state in the first; three is what
#: PyTorch's notes on CUDA graphs take.
WARMUP_CALLS = 3


def resolve_cuda_graph(cuda_graph: Switch, device: torch.device | str) -> bool:
    """Whether updates are recorded as a CUDA graph; ``"auto"`` does not.

    It becomes the default where it has been shown to give the numbers of plain updates, faster: nobody has run it on a
    GPU yet (``python -m benchmarks.gpu`` does both).

    Args:
        cuda_graph: ``"auto"``, ``"on"`` or ``"off"``.
        device: the device that computes.

    Raises:
        ValueError: any other value, or ``"on"`` without a GPU.
    """
    check_switch("cuda_graph", cuda_graph)
    if cuda_graph == "on" and torch.device(device).type != "cuda":
        raise ValueError(f"`cuda_graph` 'on' needs a CUDA device, got {str(device)!r}; 'auto' is off.")
    return cuda_graph == "on"


class CapturedCall:
    """Calls a function on static inputs; on a GPU as one CUDA graph, without a launch per kernel.

    The first calls run the function as it is, on a side stream; the next one records it and every call from then on
    replays the recording. All of them do the same work once, so a recorded update is an update like any other.

    The function must not read a value back to the host, must do the same operations at every call, and must keep what
    it changes (parameters, optimiser state) where it is: a recording knows addresses. Call :meth:`forget` after
    something was moved, such as an optimiser state by ``load_state_dict``.

    Where inputs are not on a GPU, nothing is recorded: the function runs on the static inputs every time.

    Args:
        function: maps a tensordict to named tensors.
        inputs: static inputs, written by the caller before each call with this very tensordict. By default the call
            copies what it is given into inputs of its own.
        generators: CUDA generators that the function draws from, besides torch's global one.
        warmup: calls before the recording, at least one.

    Examples:
        >>> from tensordict import TensorDict
        >>> double = CapturedCall(lambda td: {"twice": td["x"] * 2})
        >>> double(TensorDict({"x": torch.ones(2)}, [2]))["twice"]
        tensor([2., 2.])
    """

    def __init__(
        self,
        function: Callable[[TensorDictBase], Outputs],
        *,
        inputs: TensorDictBase | None = None,
        generators: Sequence[torch.Generator] = (),
        warmup: int = WARMUP_CALLS,
    ) -> None:
        if warmup < 1:
            raise ValueError(
                f"`warmup` must be at least 1, got {warmup}: the first call makes optimiser states."
            )
        self.function = function
        self.generators = generators
        self.warmup = warmup
        self._given = inputs
        self._inputs = inputs
        self._calls = 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._outputs: Outputs = {}

    @property
    def is_recorded(self) -> bool:
        """Whether calls replay a recording."""
        return self._graph is not None

    def forget(self) -> None:
        """Drop the recording; the next calls warm up and record again."""
        self._graph, self._outputs, self._calls, self._inputs = None, {}, 0, self._given

    def __call__(self, batch: TensorDictBase) -> Outputs:
        """Do the function's work on a batch once.

        Args:
            batch: entries and shapes as in the first call.

        Returns:
            What the function returned, copied: later calls leave it alone.

        Raises:
            ValueError: other entries, shapes or dtypes than in the first call.
            CompileError: if the function cannot be recorded.
        """
        inputs = self._take(batch)
        self._calls += 1
        device = inputs.device or next(iter(inputs.values(True, True))).device
        if not _is_gpu(device):
            outputs = self.function(inputs)
        elif self._graph is not None:
            self._graph.replay()
            outputs = self._outputs
        elif self._calls <= self.warmup:
            outputs = self._warm_up(inputs, device)
        else:
            self._record(inputs, device)
            outputs = self._outputs
        return {name: value.clone() for name, value in outputs.items()}

    def _take(self, batch: TensorDictBase) -> TensorDictBase:
        if self._inputs is None:
            self._inputs = batch.clone()
            return self._inputs
        if batch is self._inputs:
            return batch
        mine, theirs = _signature(self._inputs), _signature(batch)
        if mine != theirs:
            raise ValueError(f"A captured call takes entries {mine} as in its first call, got {theirs}.")
        for key, target in self._inputs.items(True, True):
            target.copy_(batch.get(key), non_blocking=True)
        return self._inputs

    def _warm_up(self, inputs: TensorDictBase, device: torch.device) -> Outputs:
        # As PyTorch's notes on CUDA graphs ask: not on the default stream, and each waits for the other.
        side, main = torch.cuda.Stream(device), torch.cuda.current_stream(device)
        side.wait_stream(main)
        with torch.cuda.stream(side), warnings.catch_warnings():
            # Adam, which is told that it will be recorded, is surprised to run without.
            warnings.filterwarnings("ignore", message=".*capturable=True.*")
            outputs = self.function(inputs)
        main.wait_stream(side)
        return outputs

    def _record(self, inputs: TensorDictBase, device: torch.device) -> None:
        graph = torch.cuda.CUDAGraph()
        for generator in self.generators:
            graph.register_generator_state(generator)
        try:
            # Only this thread's calls are restricted: others may be rendering or copying meanwhile.
            # A stream of this device: by default it would be one of the current device, on which nothing happens.
            stream = torch.cuda.Stream(device)
            with (
                torch.cuda.device(device),
                torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"),
            ):
                self._outputs = self.function(inputs)
        except RuntimeError as ended:
            reason = ended.__context__ or ended  # ending the recording fails too, and hides what made it fail
            # Not caught and gone on from: an interrupted recording leaves PyTorch's generators unusable.
            raise CompileError(
                f"The update cannot be recorded as a CUDA graph: {reason}. cuda_graph='off' works without."
            ) from ended
        self._graph = graph
        graph.replay()  # recording ran nothing


def prepare_optimizer(
    optimizer: torch.optim.Optimizer, device: torch.device, *, rate_changes: bool = False
) -> None:
    """Make an optimiser fit to be recorded, after it was built and whenever it has loaded a state.

    Args:
        optimizer: Adam, fused.
        device: of its parameters.
        rate_changes: whether the learning rate does; it is a tensor then, to be filled before each call.
    """
    for group in optimizer.param_groups:
        group["capturable"] = device.type == "cuda"
        if rate_changes:
            group["lr"] = torch.tensor(float(group["lr"]), device=device)


def portable_state(optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Return an optimiser's state as one that is not recorded has it, so that a run may be continued without."""
    state = optimizer.state_dict()
    for group in state["param_groups"]:
        group.update(lr=float(group["lr"]), capturable=False)
    return state


def _is_gpu(device: torch.device) -> bool:
    return device.type == "cuda"


def _signature(batch: TensorDictBase) -> dict[str, str]:
    leaves = sorted(batch.items(True, True), key=lambda item: str(item[0]))
    return {str(key): f"{value.dtype}{list(value.shape)}" for key, value in leaves}
