"""CRPTpro's pre-training update written straight from its equations: float32, eager, nothing done for speed.

The yardstick of ``benchmarks.updates``. It computes what :class:`crptpro.objectives.ProtoLoss` and its training loop
compute (a test compares losses, gradients and whole updates), with contiguous NCHW images, ``nn.Conv2d``, torch's
default Adam and a Python loop for the moving average. Source: CRPTpro (arXiv 2302.05614), Eq. 1-9.

Transitions are stored as in the released agents of CRPTpro and Proto-RL (``replay_buffer.py``): both stacks of nine
channels, 127 KB. The shift is an integer crop per sample, on uint8: interpolating in float32, as DrQ-v2 does, takes
several times as long and is not exact; comparing with it would flatter us.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchrl.data import ReplayBuffer

from crptpro.modules import PixelEncoder, Predictor
from crptpro.objectives import ProtoLoss

LEARNING_RATE = 1e-4
ENCODER_TAU = 0.05
ALPHA = 5e-3
OFFSET = 1.5
TEMPERATURE = 0.1
SINKHORN_ITERATIONS = 3
PAD = 4


class Batch(NamedTuple):
    """Transitions: images uint8 ``[B, 9, H, W]``, the rest float32; bootstrapping stops where not_terminated is 0."""

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    not_terminated: Tensor


class StackedStore:
    """All transitions in memory, stacks written out, sampled uniformly with replacement."""

    def __init__(self, content: Batch) -> None:
        self.content = content

    @classmethod
    def of(cls, buffer: ReplayBuffer, transitions: int) -> StackedStore:
        """Write out the first ``transitions`` of a buffer of ours, or all if it has fewer."""
        count = min(transitions, len(buffer))
        parts = [buffer[part] for part in torch.arange(count).split(1_000)]
        action = torch.cat([part["action"] for part in parts])
        reward = torch.cat([part["next", "reward"] for part in parts])
        not_terminated = 1 - torch.cat([part["next", "terminated"] for part in parts]).float()
        shape = (count, *parts[0]["pixels"].shape[1:])
        obs, next_obs = torch.empty(shape, dtype=torch.uint8), torch.empty(shape, dtype=torch.uint8)
        for index, part in enumerate(parts):
            rows = slice(index * 1_000, index * 1_000 + len(part))
            obs[rows], next_obs[rows] = part["pixels"], part["next", "pixels"]
        return cls(Batch(obs, action, reward, next_obs, not_terminated))

    def __len__(self) -> int:
        return len(self.content.obs)

    def sample(self, batch_size: int) -> Batch:
        """Draw a batch, not shifted."""
        index = torch.randint(len(self), (batch_size,))
        return Batch(*(column[index] for column in self.content))


class PlainEncoder(nn.Module):
    """3x3 convolutions with ReLU, flattened."""

    def __init__(
        self,
        in_channels: int = 9,
        channels: Sequence[int] = (32, 32, 32, 32),
        strides: Sequence[int] = (2, 1, 1, 1),
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for c_in, c_out, stride in zip([in_channels, *channels[:-1]], channels, strides):
            conv = nn.Conv2d(c_in, c_out, 3, stride)
            nn.init.orthogonal_(conv.weight, math.sqrt(2))
            nn.init.zeros_(cast(Tensor, conv.bias))
            layers += [conv, nn.ReLU()]
        self.convs = nn.Sequential(*layers)

    def forward(self, images: Tensor) -> Tensor:
        """Map uint8 ``[B, C, H, W]`` to features ``[B, D]``."""
        images = images.to(next(self.parameters()).dtype) / 255
        return self.convs(images).flatten(1)


class PlainPretraining:
    """Networks, targets, loss and optimiser of the pre-training stage; prototypes are ``[M, D]``."""

    def __init__(
        self, encoder: PlainEncoder, projector: nn.Linear, predictor: nn.Sequential, prototypes: nn.Parameter
    ) -> None:
        self.encoder, self.projector, self.predictor = encoder, projector, predictor
        self.prototypes = prototypes
        self.target_encoder = copy.deepcopy(encoder)
        self.target_projector = copy.deepcopy(projector)
        self.parameters = [
            *encoder.parameters(), *projector.parameters(), *predictor.parameters(), prototypes
        ]  # fmt: skip
        self.optimizer = torch.optim.Adam(self.parameters, lr=LEARNING_RATE)

    @classmethod
    def like(cls, loss: ProtoLoss) -> PlainPretraining:
        """Start from the weights of one of ours, in its dtype."""
        trained, config = cast(PixelEncoder, loss.encoder), cast(Predictor, loss.predictor).config
        encoder = PlainEncoder(trained.in_channels, trained.config["channels"], trained.strides)
        latent, hidden = config["latent_dim"], config["hidden_dim"]
        projector = nn.Linear(trained.feature_dim, latent)
        predictor = nn.Sequential(nn.Linear(latent, hidden), nn.ReLU(), nn.Linear(hidden, latent))
        for source, network in (
            (trained, encoder), (loss.projector, projector), (loss.predictor, predictor)
        ):  # fmt: skip
            copy_parameters(source, network)
        return cls(encoder, projector, predictor, nn.Parameter(loss.prototypes.weight.detach().clone()))

    def loss(self, obs: Tensor, next_obs: Tensor) -> Tensor:
        """Return the total loss of one batch of shifted images, uint8 ``[B, 9, H, W]`` each."""
        predictions = F.normalize(self.predictor(self.projector(self.encoder(obs))), dim=1)
        with torch.no_grad():
            targets = F.normalize(self.target_projector(self.target_encoder(next_obs)), dim=1)
            assignments = sinkhorn(targets @ self.prototypes.T)
        log_p = F.log_softmax(predictions @ self.prototypes.T / TEMPERATURE, dim=1)
        comparative = -(assignments * log_p).sum(dim=1).mean()
        return comparative + ALPHA * dispersion(self.prototypes)

    def update(self, obs: Tensor, next_obs: Tensor) -> Tensor:
        """Do one Adam step and move the targets; returns the loss."""
        with torch.no_grad():
            self.prototypes.copy_(F.normalize(self.prototypes, dim=1))
        loss = self.loss(obs, next_obs)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        move_towards(self.target_encoder, self.encoder, ENCODER_TAU)
        move_towards(self.target_projector, self.projector, ENCODER_TAU)
        return loss.detach()

    def sample_and_update(self, store: StackedStore, batch_size: int) -> Tensor:
        """Do what is timed: sample, shift both observations, update."""
        batch = store.sample(batch_size)
        return self.update(random_crop(batch.obs), random_crop(batch.next_obs))


@torch.no_grad()
def sinkhorn(scores: Tensor) -> Tensor:
    """Return assignments ``[B, M]`` of cosines ``[B, M]``, prototypes evenly loaded (Eq. 4-6)."""
    q = torch.exp((scores - scores.max()) / TEMPERATURE).T
    q = q / q.sum()
    for _ in range(SINKHORN_ITERATIONS):
        q = q / q.sum(dim=1, keepdim=True) / q.shape[0]
        q = q / q.sum(dim=0, keepdim=True) / q.shape[1]
    return (q / q.sum(dim=0, keepdim=True)).T


def dispersion(prototypes: Tensor) -> Tensor:
    """Return the intrinsic loss of unit prototypes ``[M, D]``, mean over all M x M entries (Eq. 9)."""
    cosines = prototypes.detach() @ prototypes.T
    ratio = cosines / (cosines.detach() + OFFSET)
    return (ratio * (1 - torch.eye(len(prototypes), dtype=ratio.dtype))).mean()


def move_towards(target: nn.Module, source: nn.Module, tau: float) -> None:
    """Move every parameter of ``target`` by the share ``tau`` towards ``source``."""
    for t, s in zip(target.parameters(), source.parameters()):
        t.data.copy_(tau * s.data + (1 - tau) * t.data)


def copy_parameters(source: nn.Module, target: nn.Module) -> None:
    """Give ``target`` the parameters of ``source``, which come in the same order, and their dtype."""
    for t, s in zip(target.parameters(), source.parameters(), strict=True):
        t.data = s.detach().clone()


def random_crop(images: Tensor, pad: int = PAD) -> Tensor:
    """Shift every image by its own random integer offset: :func:`crop` at uniform offsets."""
    return crop(images, torch.randint(0, 2 * pad + 1, (len(images), 2)), pad)


def crop(images: Tensor, offsets: Tensor, pad: int = PAD) -> Tensor:
    """Crop images ``[B, C, H, W]`` at offsets ``[B, 2]``, ``{0, ..., 2 * pad}``, from themselves, border replicated."""
    height, width = images.shape[-2:]
    padded = F.pad(images, (pad, pad, pad, pad), mode="replicate")
    windows = padded.unfold(2, height, 1).unfold(3, width, 1)  # (B, C, 9, 9, H, W), a view
    return windows[torch.arange(len(images)), :, offsets[:, 0], offsets[:, 1]]
