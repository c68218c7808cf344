"""Choosing and setting the compute dtype."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from crptpro.modules import (
    PixelEncoder,
    SquashedGaussianActor,
    TwinCritic,
    computing,
    resolve_precision,
    set_compute_dtype,
)
from crptpro.modules import precision as precision_module
from crptpro.objectives import ProtoLoss, RADSACLoss


def test_named_precisions_are_taken_literally() -> None:
    assert resolve_precision("fp32", "cpu") == torch.float32
    assert resolve_precision("bf16", "cpu") == torch.bfloat16
    with pytest.raises(ValueError, match="'half'"):
        resolve_precision("half", "cpu")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("flags", "dtype"),
    [
        ("GenuineIntel avx512_bf16 avx512_fp16 amx_tile amx_bf16", torch.bfloat16),
        # A virtual machine that hides AMX: AVX512-BF16 has half the rate of float32 there.
        ("GenuineIntel avx512_bf16 avx512_fp16", torch.float32),
        ("GenuineIntel avx512_bf16", torch.bfloat16),
        ("AuthenticAMD avx512_bf16", torch.bfloat16),
        ("AuthenticAMD avx512_bf16 avx512_fp16", torch.bfloat16),
        ("AuthenticAMD avx2", torch.float32),
        (None, torch.float32),
    ],
)
def test_auto_is_bf16_on_processors_that_are_faster_in_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, flags: str | None, dtype: torch.dtype
) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    if flags is not None:
        vendor, *features = flags.split()
        cpuinfo.write_text(f"vendor_id\t: {vendor}\nflags\t\t: {' '.join(features)}\n")
    monkeypatch.setattr(precision_module, "CPUINFO", cpuinfo)
    assert resolve_precision("auto", "cpu") == dtype


@pytest.mark.parametrize(("capability", "dtype"), [((7, 5), torch.float32), ((9, 0), torch.bfloat16)])
def test_auto_follows_the_gpu(monkeypatch: pytest.MonkeyPatch, capability, dtype: torch.dtype) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)
    assert resolve_precision("auto", "cuda:0") == dtype


@pytest.mark.parametrize(
    ("precision", "device", "allowed"),
    [("fp32", "cuda:0", False), ("auto", "cuda:0", False), ("bf16", "cuda:0", True), ("fp32", "cpu", True)],
)
def test_float32_on_a_gpu_means_float32_and_not_tf32(
    monkeypatch: pytest.MonkeyPatch, precision, device: str, allowed: bool
) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (7, 5))
    backends: Any = (torch.backends.cudnn, torch.backends.cuda.matmul)
    before = [backend.allow_tf32 for backend in backends]
    for backend in backends:
        backend.allow_tf32 = True
    resolve_precision(precision, device)
    found = [backend.allow_tf32 for backend in backends]
    for backend, value in zip(backends, before):
        backend.allow_tf32 = value
    assert found == [allowed] * 2


def test_a_compute_dtype_reaches_the_networks_that_a_loss_hides_and_ends_with_its_block() -> None:
    encoder = PixelEncoder(3, channels=(4, 4), strides=(2, 1), image_size=12)
    actor, critic = SquashedGaussianActor(6, 2, hidden_dim=8), TwinCritic(6, 2, hidden_dim=8)
    pretraining = ProtoLoss(encoder, num_prototypes=8, latent_dim=4, hidden_dim=8)
    hidden = {pretraining: (encoder, pretraining.projector), RADSACLoss(actor, critic): (actor.trunk, critic.q2)}
    for loss, networks in hidden.items():
        with pytest.raises(RuntimeError, match="inside"), computing(loss, torch.bfloat16):  # noqa: PT012
            assert {network.compute_dtype for network in networks} == {torch.bfloat16}
            assert all(p.dtype == torch.float32 for p in loss.parameters())
            raise RuntimeError("inside")
        assert {network.compute_dtype for network in networks} == {torch.float32}
    with pytest.raises(ValueError, match="float16"):
        set_compute_dtype(encoder, torch.float16)
