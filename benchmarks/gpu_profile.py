"""Where the time of an update goes, beside the least that its arithmetic and its memory traffic can take."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from benchmarks.gpu_updates import DevicePretrainUpdates, pretraining_floor

TOP = 25


def profile_updates(updates: DevicePretrainUpdates, *, tiny: bool = False, count: int = 20) -> dict[str, Any]:
    """Print the kernels that take most of an update, and the floors.

    Args:
        updates: what to profile.
        tiny: small probes of the device's rates.
        count: updates that are profiled.
    """
    device = updates.batches.device
    is_cuda = device.type == "cuda"
    for _ in range(10):  # compiled, recorded, replayed
        updates()
    _wait(device)
    activities = [ProfilerActivity.CPU] + ([ProfilerActivity.CUDA] if is_cuda else [])
    with profile(activities=activities) as profiler:
        for _ in range(count):
            updates()
        _wait(device)
    attribute = "self_device_time_total" if is_cuda else "self_cpu_time_total"
    kernels = [
        (event.key, float(getattr(event, attribute)) / count, event.count / count)
        for event in profiler.key_averages()
        if float(getattr(event, attribute)) > 0
    ]
    kernels.sort(key=lambda kernel: -kernel[1])
    total_us = sum(kernel[1] for kernel in kernels)
    element_bytes = 2 if updates.loss.encoder.compute_dtype == torch.bfloat16 else 4
    floor = pretraining_floor(updates.loss, updates.batches.batch_size, element_bytes=element_bytes)
    rates = device_rates(device, size=256 if tiny else 8192)
    floor_ms = {
        "arithmetic_ms": 1e3 * floor["flop"] / rates["flop_per_s"],
        "traffic_ms": 1e3 * floor["bytes"] / rates["bytes_per_s"],
    }
    print("| kernel | us per update | share | calls per update |\n|---|---|---|---|")
    for name, us, calls in kernels[:TOP]:
        print(f"| `{name[:90]}` | {us:.1f} | {us / total_us:.1%} | {calls:.1f} |")
    print(
        f"\nAll kernels: {total_us / 1e3:.3f} ms per update. Least: {floor_ms['arithmetic_ms']:.3f} ms for "
        f"{floor['flop'] / 1e9:.1f} GFLOP at {rates['flop_per_s'] / 1e12:.1f} TFLOP/s, {floor_ms['traffic_ms']:.3f} ms "
        f"for {floor['bytes'] / 1e9:.2f} GB at {rates['bytes_per_s'] / 1e9:.0f} GB/s."
    )
    top = [{"kernel": name, "us": us, "calls": calls} for name, us, calls in kernels[:TOP]]
    return {"kernels_ms": total_us / 1e3, "top": top, "floor": {**floor, **floor_ms}, "rates": rates}


def device_rates(device: torch.device, *, size: int) -> dict[str, float]:
    """Measure one large bfloat16 product and one large copy.

    Args:
        device: to be measured.
        size: of the square factors; the copy is as large as sixteen of them.

    Returns:
        ``flop_per_s``, and ``bytes_per_s`` read and written together.
    """
    factor = torch.ones(size, size, dtype=torch.bfloat16, device=device)
    product = torch.empty_like(factor)
    source = torch.zeros(16 * size * size, dtype=torch.bfloat16, device=device)
    target = torch.empty_like(source)
    product_s = _best_seconds(lambda: torch.mm(factor, factor, out=product), device)
    copy_s = _best_seconds(lambda: target.copy_(source), device)
    return {"flop_per_s": 2.0 * size**3 / product_s, "bytes_per_s": 2.0 * source.numel() * 2 / copy_s}


def _best_seconds(call: Callable[[], Any], device: torch.device, *, rounds: int = 10) -> float:
    times = []
    for _ in range(rounds):
        _wait(device)
        start = time.perf_counter()
        call()
        _wait(device)
        times.append(time.perf_counter() - start)
    return min(times)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
