"""Notices whatever would make the host wait for a GPU, on tensors of the CPU."""

from __future__ import annotations

from typing import Any

from torch.utils._python_dispatch import TorchDispatchMode

_READS = {
    "aten::_local_scalar_dense", "aten::equal", "aten::is_nonzero", "aten::nonzero", "aten::masked_select",
    "aten::_unique2", "aten::unique_dim",
}  # fmt: skip


class NoHostReads(TorchDispatchMode):
    """Raises where a value of a tensor, or a shape that depends on one, is read; ``tolist`` and ``cpu`` escape it."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func._schema.name in _READS:
            raise AssertionError(f"{func} reads a value back to the host")
        return func(*args, **(kwargs or {}))
