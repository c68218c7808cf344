"""How networks compute: number format, memory layout, device."""

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
from crptpro.values import Switch, check_switch

Precision = Literal["auto", "fp32", "bf16"]

CPUINFO = Path("/proc/cpuinfo")
"""Where Linux tells the processor's vendor and instructions."""

_Module = TypeVar("_Module", bound=nn.Module)


def resolve_precision(precision: Precision, device: torch.device | str) -> torch.dtype:
    """Turn a precision name into the compute dtype for a device.

    PyTorch lets cuDNN convolutions round float32 factors to TF32's eleven significant bits by default. When
    float32 is what comes out for a CUDA device, this switches TF32 off for convolutions and matrix products,
    for the whole process, so that fp32 means the same on every device.

    Args:
        precision: ``"fp32"`` (the reference), ``"bf16"``, or ``"auto"``: bf16 where the hardware is faster in it (CUDA
            compute capability 8 or newer; a CPU with AMX, or with AVX512-BF16 unless it is an Intel one whose AMX a
            virtual machine hides: what is left there multiplies at half the rate of float32), otherwise fp32.
        device: the device that will compute.

    Returns:
        ``torch.float32`` or ``torch.bfloat16``.

    Raises:
        ValueError: unknown precision name.

    Examples:
        >>> resolve_precision("fp32", "cpu")
        torch.float32
    """
    if precision not in ("auto", "fp32", "bf16"):
        raise ValueError(f"precision must be 'auto', 'fp32' or 'bf16', got {precision!r}.")
    device = torch.device(device)
    if precision == "bf16" or (precision == "auto" and _is_faster_in_bf16(device)):
        return torch.bfloat16
    if device.type == "cuda":
        # The older switches: every supported PyTorch has them, and reading them fails after the newer ones
        # (fp32_precision) were set for one operation only.
        torch.backends.cudnn.allow_tf32 = False
        torch.backends.cuda.matmul.allow_tf32 = False
    return torch.float32


def set_compute_dtype(module: _Module, dtype: torch.dtype) -> _Module:
    """Set ``compute_dtype`` on every network inside ``module`` that has one.

    Parameters keep their dtype (fp32 master weights); only the convolutions and the large matrix products
    change. Networks that a TorchRL ``LossModule`` keeps outside its registered children are reached too.

    Args:
        module: a network, or a loss that owns networks.
        dtype: ``torch.float32`` or ``torch.bfloat16``. Float32 means "the dtype of the parameters".

    Returns:
        ``module``.

    Raises:
        ValueError: any other dtype.
    """
    if dtype not in (torch.float32, torch.bfloat16):
        raise ValueError(f"compute dtype must be torch.float32 or torch.bfloat16, got {dtype}.")
    return _set_everywhere(module, "compute_dtype", dtype)


def resolve_channels_last(channels_last: Switch) -> bool:
    """Whether images lie in memory with the channels of a pixel beside each other; ``"auto"`` says yes.

    Forward and backward pass of a batch of 512 in bfloat16 were 3 and 15 % faster than in PyTorch's usual layout on two
    CPUs with AVX512-BF16, and a third faster on one with AMX (benchmarks/README.md).

    Args:
        channels_last: ``"auto"``, ``"on"`` or ``"off"``.

    Raises:
        ValueError: any other value.
    """
    check_switch("channels_last", channels_last)
    return channels_last != "off"


def set_channels_last(module: _Module, channels_last: bool) -> _Module:
    """Set the memory layout of every :class:`~crptpro.modules.PixelEncoder` inside ``module``; returns ``module``.

    Args:
        module: a network, or a loss that owns networks.
        channels_last: changes rounding only.
    """
    return _set_everywhere(module, "channels_last", channels_last)


def is_channels_last(module: nn.Module) -> bool:
    """Whether every :class:`~crptpro.modules.PixelEncoder` inside ``module`` computes with channels last."""
    return all(getattr(network, "channels_last", True) for network in networks_within(module))


@contextlib.contextmanager
def computing(module: nn.Module, dtype: torch.dtype, *, channels_last: bool) -> Iterator[None]:
    """Have networks compute in a dtype and a layout, and afterwards as freshly built ones do.

    Args:
        module: a network, or a loss that owns networks.
        dtype: as for :func:`set_compute_dtype`; float32 afterwards.
        channels_last: as for :func:`set_channels_last`; on afterwards.
    """
    try:
        set_channels_last(set_compute_dtype(module, dtype), channels_last)
        yield
    finally:
        set_channels_last(set_compute_dtype(module, torch.float32), True)


def linear_in(inputs: Tensor, layer: nn.Linear, compute_dtype: torch.dtype) -> Tensor:
    """Apply a linear layer whose product runs in ``compute_dtype`` and whose result has the weight's dtype.

    In bf16 the factors are rounded, the sums are kept in fp32 by the kernel, the product is rounded once, and
    the bias is added in the weight's dtype.

    Args:
        inputs: ``[*, D_in]``, any floating dtype.
        layer: with or without bias.
        compute_dtype: ``torch.bfloat16``, or ``torch.float32`` for "the weight's dtype".
    """
    weight, bias = layer.weight, layer.bias
    if compute_dtype == torch.float32:
        return F.linear(inputs.to(weight.dtype), weight, bias)
    product = F.linear(inputs.to(compute_dtype), weight.to(compute_dtype)).to(weight.dtype)
    return product if bias is None else product + bias


def networks_within(module: nn.Module) -> Iterator[nn.Module]:
    """Yield a network and everything inside it, each once.

    ``LossModule.convert_to_functional`` hides networks in the instance dictionary, where ``modules()`` does not look;
    they are found too.
    """
    seen: set[int] = set()
    waiting = [module]
    while waiting:
        for child in waiting.pop().modules():
            if id(child) not in seen:
                seen.add(id(child))
                yield child
                waiting += [value for value in list(vars(child).values()) if isinstance(value, nn.Module)]


def device_of(module: nn.Module) -> torch.device | None:
    """Return the device of a network's first parameter or buffer; None if it has neither.

    Examples:
        >>> device_of(nn.Linear(2, 2)), device_of(nn.ReLU())
        (device(type='cpu'), None)
    """
    first = next(chain(module.parameters(), module.buffers()), None)
    return None if first is None else first.device


def usable_device(name: str | torch.device) -> torch.device:
    """Return a device, once a tensor could be put there.

    Raises:
        CRPTproError: with torch's reason, if this machine or this build of torch has no such device.
    """
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as reason:
        raise CRPTproError(
            f"Device {str(name)!r} cannot be used ({str(reason).splitlines()[0]}); 'cpu' always works."
        ) from None
    return device


def _set_everywhere(module: _Module, name: str, value: Any) -> _Module:
    for network in networks_within(module):
        if hasattr(network, name):
            setattr(cast(Any, network), name, value)
    return module


def _is_faster_in_bf16(device: torch.device) -> bool:
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device)[0] >= 8
    return device.type == "cpu" and _is_cpu_faster_in_bf16()


def _is_cpu_faster_in_bf16() -> bool:
    text = CPUINFO.read_text(errors="replace") if CPUINFO.exists() else ""
    probes = {"_is_amx_tile_supported": "amx_bf16", "_is_avx512_bf16_supported": "avx512_bf16"}
    has_amx, has_avx512_bf16 = (
        getattr(torch.cpu, probe)() if hasattr(torch.cpu, probe) else flag in text
        for probe, flag in probes.items()
    )
    # Intel's cores with AVX512-FP16 leave bf16 to AMX. Where a virtual machine hides it, AVX512-BF16 multiplied
    # matrices at 81 GFLOP/s and float32 at 154 (a core of 2023); AMD's cores are twice as fast in bf16.
    hides_amx = "GenuineIntel" in text and "avx512_fp16" in text
    return has_amx or (has_avx512_bf16 and not hides_amx)
