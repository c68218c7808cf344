"""Number format and device of the networks' computations."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from crptpro.errors import CRPTproError

Precision = Literal["auto", "fp32", "bf16"]
PRECISION_NAMES = {torch.float32: "fp32", torch.bfloat16: "bf16"}
CPUINFO = Path("/proc/cpuinfo")

_Module = TypeVar("_Module", bound=nn.Module)


def resolve_precision(precision: Precision, device: torch.device | str, *modules: nn.Module | None) -> torch.dtype:
    """Return the compute dtype of a precision for a device; an unknown name raises a ``ValueError``.

    ``"auto"`` is bf16 where that is faster: CUDA of compute capability 8 or newer, AMX, or AMD's AVX512-BF16. It is
    fp32 if one of the ``modules`` is not of this library's classes: their layers may not take bfloat16.
    float32 on a CUDA device disables TF32 for the whole process, so that fp32 means the same on every device.
    """
    if precision not in ("auto", "fp32", "bf16"):
        raise ValueError(f"precision must be 'auto', 'fp32' or 'bf16', got {precision!r}.")
    device = torch.device(device)
    own = [each for each in modules if each is not None and not type(each).__module__.startswith("crptpro.")]
    if precision == "auto" and own:
        precision = "fp32"
    if precision == "bf16" or (precision == "auto" and _is_faster_in_bf16(device)):
        return torch.bfloat16
    if device.type == "cuda":
        # Reading these older switches fails if the newer ones (fp32_precision) are set for one operation only.
        torch.backends.cudnn.allow_tf32 = False
        torch.backends.cuda.matmul.allow_tf32 = False
    return torch.float32


def _is_faster_in_bf16(device: torch.device) -> bool:
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device)[0] >= 8
    if device.type != "cpu" or not CPUINFO.exists():
        return False
    text = CPUINFO.read_text(errors="replace")
    # Intel's cores with AVX512-FP16 leave bf16 to AMX. On a virtual machine that hides AMX, AVX512-BF16 multiplied
    # matrices at 81 GFLOP/s and float32 at 154 (a core of 2023); AMD's cores are twice as fast in bf16.
    hides_amx = "GenuineIntel" in text and "avx512_fp16" in text
    return "amx_bf16" in text or ("avx512_bf16" in text and not hides_amx)


def set_compute_dtype(module: _Module, dtype: torch.dtype) -> _Module:
    """Set ``compute_dtype``, float32 or bfloat16, on every network inside ``module``, a network or loss; return it."""
    if dtype not in (torch.float32, torch.bfloat16):
        raise ValueError(f"compute dtype must be torch.float32 or torch.bfloat16, got {dtype}.")
    for network in _networks_within(module):
        if hasattr(network, "compute_dtype"):
            cast(Any, network).compute_dtype = dtype
    return module


@contextlib.contextmanager
def computing(module: nn.Module, dtype: torch.dtype) -> Iterator[None]:
    """Let networks compute in a dtype (see :func:`set_compute_dtype`) in the block, and in float32 after it."""
    try:
        set_compute_dtype(module, dtype)
        yield
    finally:
        set_compute_dtype(module, torch.float32)


def _networks_within(module: nn.Module) -> Iterator[nn.Module]:
    # LossModule.convert_to_functional hides networks in the instance dictionary, which modules() ignores.
    seen: set[int] = set()
    waiting = [module]
    while waiting:
        for child in waiting.pop().modules():
            if id(child) not in seen:
                seen.add(id(child))
                yield child
                waiting += [value for value in list(vars(child).values()) if isinstance(value, nn.Module)]


def linear_in(inputs: Tensor, layer: nn.Linear, compute_dtype: torch.dtype) -> Tensor:
    """Apply a linear layer with the product in ``compute_dtype``; result and bias have the weight's dtype."""
    weight, bias = layer.weight, layer.bias
    if compute_dtype == torch.float32:
        return F.linear(inputs.to(weight.dtype), weight, bias)
    product = F.linear(inputs.to(compute_dtype), weight.to(compute_dtype)).to(weight.dtype)
    return product if bias is None else product + bias


@contextlib.contextmanager
def evaluating(module: nn.Module) -> Iterator[None]:
    """Put a network in evaluation mode for the block: in training mode it may use batch statistics or dropout."""
    training = [each for each in module.modules() if each.training]
    for each in training:
        each.training = False
    try:
        yield
    finally:
        for each in training:
            each.training = True


def device_of(module: nn.Module) -> torch.device | None:
    """Return the device of a network's first parameter or buffer, or None."""
    return next((tensor.device for tensor in chain(module.parameters(), module.buffers())), None)


def usable_device(name: str | torch.device) -> torch.device:
    """Return a device on which a tensor can be created; otherwise a :class:`CRPTproError` gives torch's reason."""
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as reason:
        raise CRPTproError(
            f"Device {str(name)!r} cannot be used ({str(reason).splitlines()[0]}); 'cpu' always works."
        ) from None
    return device
