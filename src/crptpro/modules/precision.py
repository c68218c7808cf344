"""The number format of the big convolutions and matrix products, and the switch that sets it everywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from crptpro.modules.networks_within import networks_within

Precision = Literal["auto", "fp32", "bf16"]

CPUINFO = Path("/proc/cpuinfo")
"""Where Linux tells the processor's vendor and instructions."""
COMPUTE_DTYPES: tuple[torch.dtype, ...] = (torch.float32, torch.bfloat16)

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
    if dtype not in COMPUTE_DTYPES:
        raise ValueError(f"compute dtype must be torch.float32 or torch.bfloat16, got {dtype}.")
    for network in networks_within(module):
        if hasattr(network, "compute_dtype"):
            cast(Any, network).compute_dtype = dtype
    return module


def linear_in(inputs: Tensor, weight: Tensor, bias: Tensor | None, compute_dtype: torch.dtype) -> Tensor:
    """Linear layer whose product runs in ``compute_dtype`` and whose result has the weight's dtype.

    In bf16 the factors are rounded, the sums are kept in fp32 by the kernel, the product is rounded once, and
    the bias is added in the weight's dtype.

    Args:
        inputs: ``[*, D_in]``, any floating dtype.
        weight: ``[D_out, D_in]``.
        bias: ``[D_out]`` or None.
        compute_dtype: ``torch.bfloat16``, or ``torch.float32`` for "the weight's dtype".

    Returns:
        ``[*, D_out]`` in the weight's dtype.
    """
    if compute_dtype == torch.float32:
        return F.linear(inputs.to(weight.dtype), weight, bias)
    product = F.linear(inputs.to(compute_dtype), weight.to(compute_dtype)).to(weight.dtype)
    return product if bias is None else product + bias


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
