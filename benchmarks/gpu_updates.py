"""What ``benchmarks.gpu`` times and compares: the updates of both stages on one device, with every switch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.library_updates import ACTION_DIM, fresh_loss
from crptpro.data import FrameDataset
from crptpro.modules import (
    PixelEncoder,
    SquashedGaussianActor,
    TwinCritic,
    resolve_precision,
    set_channels_last,
    set_compute_dtype,
)
from crptpro.modules.precision import Precision
from crptpro.objectives import ProtoLoss, RADSACLoss, method_defaults
from crptpro.training.compiled import Compiled
from crptpro.training.pretrain.device_batches import DeviceBatches
from crptpro.training.pretrain.learner import Learner
from crptpro.training.pretrain.sources import keys_read
from crptpro.training.rad_sac_learner import RADSACLearner


class DevicePretrainUpdates:
    """One pre-training update per call, batches included, as ``pretrain(...)`` does it on a GPU.

    Args:
        datasets: by domain, their frames on the device.
        batch_size: transitions per update.
        prototypes: of the loss, at initialisation.
        precision: ``"fp32"`` or ``"bf16"``.
        compiles: whether loss and gathering are compiled.
        captures: whether both are recorded as CUDA graphs.
        channels_last: whether the convolutions compute with channels last.
        tf32: let float32 factors be rounded to TF32.
    """

    def __init__(
        self,
        datasets: Mapping[str, FrameDataset],
        *,
        batch_size: int,
        prototypes: int,
        precision: Precision = "bf16",
        compiles: bool = False,
        captures: bool = False,
        channels_last: bool = True,
        tf32: bool = False,
    ) -> None:
        first = next(iter(datasets.values()))
        frames = first.frames.get("pixels")
        dtype = resolve_precision(precision, frames.device)
        self.loss = fresh_loss(image_size=frames.shape[-1], prototypes=prototypes).to(frames.device).train()
        set_channels_last(set_compute_dtype(self.loss, dtype), channels_last)
        compiled = Compiled(is_on=compiles)
        self.batches = DeviceBatches(
            datasets,
            batch_size=batch_size,
            keys=keys_read(self.loss) or [],
            compiled=compiled,
            captures=captures,
        )
        defaults = method_defaults(self.loss)
        self.learner = Learner(
            self.loss, defaults, learning_rate=defaults.lr, encoder_tau=defaults.encoder_tau,
            updates=defaults.updates, compiled=compiled, captures=captures, inputs=self.batches.batch,
        )  # fmt: skip
        self.domains, self.done, self.tf32 = list(datasets), 0, tf32

    def __call__(self) -> Tensor:
        """Do one update and return its scalars."""
        domain = self.domains[self.done % len(self.domains)]
        with _tf32(self.tf32):
            values = self.learner.update(self.batches.sample(domain), index=self.done, domain=domain)
        self.done += 1
        return values


class DeviceSACUpdates:
    """One update of the downstream learner per call on given features; the actor takes part in every second.

    Args:
        feature_dim: of the encoder.
        batch_size: transitions per update.
        hidden_dim: of actor and critic.
        precision: ``"fp32"`` or ``"bf16"``, also of the features.
        device: where all of it lives.
        compiles: whether the losses are compiled.
        captures: whether the updates are recorded as CUDA graphs.
    """

    def __init__(
        self,
        *,
        feature_dim: int,
        batch_size: int,
        hidden_dim: int = 1024,
        precision: Precision = "bf16",
        device: torch.device | str = "cpu",
        compiles: bool = False,
        captures: bool = False,
    ) -> None:
        dtype = resolve_precision(precision, device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            actor = SquashedGaussianActor(feature_dim, ACTION_DIM, hidden_dim=hidden_dim).to(device)
            critic = TwinCritic(feature_dim, ACTION_DIM, hidden_dim=hidden_dim).to(device)
        # The learner would draw the noise on the GPU only where it records; here all do, to be comparable.
        noise = torch.Generator(device).manual_seed(1)
        self.loss = set_compute_dtype(RADSACLoss(actor, critic, generator=noise).to(device), dtype)
        self.learner = RADSACLearner(self.loss, compiled=Compiled(is_on=compiles), captures=captures)
        draws = torch.Generator().manual_seed(2)
        ends = torch.zeros(batch_size, 1, dtype=torch.bool)

        def features() -> Tensor:
            return torch.rand(batch_size, feature_dim, generator=draws).to(dtype)

        following = {
            "features": features(),
            "reward": torch.rand(batch_size, 1, generator=draws),
            "done": ends,
            "terminated": ends,
        }
        action = torch.rand(batch_size, ACTION_DIM, generator=draws) * 2 - 1
        batch = {"features": features(), "action": action, "next": following}
        self.batch = TensorDict(batch, [batch_size]).to(device)
        self.done = 0

    def __call__(self) -> dict[str, Tensor]:
        """Do one update and return its scalars."""
        metrics = self.learner.update(self.batch, agent_step=self.done)
        self.done += 1
        return metrics


def open_on(paths: Mapping[str, Path], device: torch.device) -> dict[str, FrameDataset]:
    """Open datasets with their frames on a device."""
    return {name: FrameDataset.open(path, device=device) for name, path in paths.items()}


def pretraining_floor(loss: ProtoLoss, batch_size: int, *, element_bytes: int) -> dict[str, float]:
    """Return the arithmetic and the memory traffic that one update cannot do without.

    Multiplications of both forward passes and the backward pass (no input gradient of the first convolution); every
    activation written once and read once forward, gradients read twice and the rectifier's mask once, weights and
    moments once each way. No fusion across layers is assumed.

    Args:
        loss: shapes.
        batch_size: transitions.
        element_bytes: of the activations.

    Returns:
        ``flop`` and ``bytes`` of one update.
    """
    encoder = cast(PixelEncoder, loss.encoder)
    size, convs, activations = encoder.image_size, [], 0
    for conv in encoder.conv_layers:
        size = (size - 3) // conv.stride[0] + 1
        convs.append(size * size * conv.out_channels * conv.in_channels * 9)
        activations += size * size * conv.out_channels
    projector = sum(p.numel() for p in loss.projector.parameters() if p.ndim == 2)
    predictor = sum(p.numel() for p in loss.predictor.parameters() if p.ndim == 2)
    prototypes = loss.prototypes.weight.numel()
    forward = 2 * (sum(convs) + projector + prototypes) + predictor
    backward = 2 * sum(convs) - convs[0] + 2 * (projector + predictor + prototypes)
    dispersion = 2 * loss.prototypes.weight.shape[0] * prototypes
    parameters = sum(p.numel() for p in loss.parameters() if p.requires_grad)
    pixels = 2 * batch_size * encoder.in_channels * encoder.image_size**2
    # Twice forward (write, read), then gradients: written, read twice, and the mask read.
    traffic = batch_size * activations * element_bytes
    return {
        "flop": 2.0 * (batch_size * (forward + backward) + dispersion),
        "bytes": float(pixels + 2 * 2 * traffic + 5 * traffic + 40 * parameters),
    }


@contextmanager
def _tf32(is_on: bool) -> Iterator[None]:
    before = torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32
    if is_on:
        torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = True
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32 = before
