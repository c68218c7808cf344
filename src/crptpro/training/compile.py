"""Compilation and CUDA graphs, which make an update faster without changing what it computes."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.nn import CudaGraphModule

from crptpro.errors import CompileError

Update = Callable[[TensorDictBase], TensorDictBase]


def accelerate(
    update: Update, *, compile: bool = False, cuda_graph: bool = False, device: torch.device | str = "cpu"
) -> Update:
    """Return an update that is compiled, recorded as a CUDA graph, or unchanged.

    The update maps a batch of fixed shapes to detached scalars and must not read a value back to the host. On a CPU
    nearly all of it is convolutions and matrix products, which the compiler leaves to the same library calls: it takes
    half a minute and gains nothing beyond noise. On a GPU recording was checked for parity, pre-training in bf16 too;
    neither switch was timed beside the plain update.

    Raises:
        ValueError: ``cuda_graph`` on a ``device`` that is not a GPU.
        CompileError: a call of the update fails in PyTorch, most likely while it is compiled or recorded.
    """
    if cuda_graph and torch.device(device).type != "cuda":
        raise ValueError(
            f"`cuda_graph` needs a GPU, but `device` is {str(device)!r}; set device='cuda' or leave it off."
        )
    if not (compile or cuda_graph):
        return update
    fast: Update = torch.compile(update, dynamic=False) if compile else update
    if cuda_graph:
        logging.getLogger("tensordict").setLevel(logging.WARNING)  # it announces every recording
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Tensordict is registered in PyTree")  # it takes care of that itself
            fast = CudaGraphModule(fast, warmup=3, device=torch.device(device))

    def call(batch: TensorDictBase) -> TensorDictBase:
        try:
            out = fast(batch)
            return out.clone() if cuda_graph else out
        except torch.OutOfMemoryError:
            raise
        except RuntimeError as reason:  # the compiler's own errors are RuntimeErrors
            what = (str(reason).strip().splitlines() or [type(reason).__name__])[0]
            raise CompileError(
                f"The update cannot be compiled or recorded: {what.rstrip('.')}. `compile` needs a C++ compiler "
                "(CXX=...), on a GPU Triton too. Try it without `compile` and `cuda_graph`."
            ) from reason

    return call
