"""The method as its equations state it: float32, eager, nothing optimised for speed.

The reference of ``benchmarks.updates``. Tests compare its losses and gradients with the library's. The encoder is
``nn.Conv2d`` on contiguous NCHW images, Adam is torch's default, and every observation is encoded anew at every update.
The small networks are float32 copies of ours, and the terms of the pre-training loss are our pure functions.

Sources: CRPTpro (arXiv 2302.05614), Eq. 1-9, and SAC whose twin critic shares one trunk. As in the released agents of
CRPTpro and Proto-RL, the actor's loss runs backward through the whole critic. Unlike there, ``next_obs`` is encoded
once, not again for the bonus.

Transitions are stored as in the released agents (``replay_buffer.py``): both stacks of nine channels, 127 KB. The shift
is an integer crop per sample, on uint8. To interpolate in float32, as DrQ-v2 does, takes several times as long and is
not exact; comparing with it would flatter us.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchrl.data import ReplayBuffer

from crptpro.modules import SquashedGaussianActor, TwinCritic
from crptpro.objectives import ProtoLoss
from crptpro.objectives.functional import comparative_loss, prototype_dispersion, sinkhorn_knopp
from crptpro.pretrained import Pretrained

LEARNING_RATE = 1e-4
PAD = 4
# Pre-training.
ENCODER_TAU = 0.05
ALPHA = 5e-3
# Downstream.
DISCOUNT = 0.99
INITIAL_TEMPERATURE = 0.1
CRITIC_TAU = 0.01
DELAY = 2  # updates between two of actor, temperature and target critic
BETA = 0.2
K = 3
QUEUE_SIZE = 2_048


class Batch(NamedTuple):
    """Transitions: images uint8 ``[B, 9, H, W]``, the rest float32; bootstrapping stops where not_terminated is 0."""

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    not_terminated: Tensor

    @classmethod
    def of(cls, buffer: ReplayBuffer, transitions: int) -> Batch:
        """Write out the first ``transitions`` of a buffer of ours, or all if it has fewer."""
        rows = torch.arange(min(transitions, len(buffer))).split(1_000)
        keys = ("pixels", "action", ("next", "reward"), ("next", "pixels"), ("next", "terminated"))
        columns = zip(*([part[key] for key in keys] for part in (buffer[some] for some in rows)))
        obs, action, reward, next_obs, terminated = map(torch.cat, columns)
        return cls(obs, action, reward, next_obs, 1 - terminated.float())

    def sample(self, batch_size: int) -> Batch:
        """Draw transitions uniformly with replacement, and shift both observations of each."""
        index = torch.randint(len(self.obs), (batch_size,))
        drawn = Batch(*(column[index] for column in self))
        return drawn._replace(obs=random_crop(drawn.obs), next_obs=random_crop(drawn.next_obs))


class PlainEncoder(nn.Module):
    """3x3 convolutions with ReLU, flattened: the weights of one of ours."""

    def __init__(self, ours: Any) -> None:
        super().__init__()
        layers = [layer for conv in copy.deepcopy(ours.convs) for layer in (conv, nn.ReLU())]
        self.convs = nn.Sequential(*layers)
        for parameter in self.parameters():
            parameter.data = parameter.data.contiguous()

    def forward(self, images: Tensor) -> Tensor:
        """Map uint8 ``[B, C, H, W]`` to features ``[B, D]``."""
        return self.convs(images.to(next(self.parameters()).dtype) / 255).flatten(1)


class PlainPretraining:
    """Networks, targets, loss and optimiser of the pre-training stage, from the weights of one of ours."""

    def __init__(self, ours: ProtoLoss) -> None:
        self.encoder = PlainEncoder(ours.encoder)
        heads = (ours.projector, ours.predictor, ours.prototypes.weight)
        self.projector, self.predictor, self.prototypes = copy.deepcopy(heads)
        self.target_encoder, self.target_projector = copy.deepcopy((self.encoder, self.projector))
        trained = (self.encoder, self.projector, self.predictor)
        self.parameters = [*(p for network in trained for p in network.parameters()), self.prototypes]
        self.optimizer = torch.optim.Adam(self.parameters, lr=LEARNING_RATE)

    def loss(self, obs: Tensor, next_obs: Tensor) -> Tensor:
        """Return the total loss of one batch of shifted images, uint8 ``[B, 9, H, W]`` each."""
        predictions = F.normalize(self.predictor(self.projector(self.encoder(obs))), dim=1)
        with torch.no_grad():
            targets = F.normalize(self.target_projector(self.target_encoder(next_obs)), dim=1)
            assignments = sinkhorn_knopp(targets @ self.prototypes.T)
        comparative = comparative_loss(predictions @ self.prototypes.T, assignments)
        return comparative + ALPHA * prototype_dispersion(self.prototypes)

    def update(self, batch: Batch) -> Tensor:
        """Do one Adam step and move the targets; returns the loss."""
        with torch.no_grad():
            self.prototypes.copy_(F.normalize(self.prototypes, dim=1))
        loss = self.loss(batch.obs, batch.next_obs)
        step(self.optimizer, loss)
        move_towards(self.target_encoder, self.encoder, ENCODER_TAU)
        move_towards(self.target_projector, self.projector, ENCODER_TAU)
        return loss.detach()


class PlainDownstream:
    """Frozen encoder, projector and prototypes, the bonus's queue, and SAC; from the weights of networks of ours."""

    def __init__(
        self,
        pretrained: Pretrained,
        actor: SquashedGaussianActor,
        critic: TwinCritic,
        generator: torch.Generator | None = None,
    ) -> None:
        self.encoder = PlainEncoder(pretrained.encoder)
        heads: Any = (pretrained.projector, pretrained.prototypes)
        self.projector, prototypes = copy.deepcopy(heads)
        self.prototypes = prototypes.weight.detach()  # [M, D]
        self.actor, self.critic = copy.deepcopy(actor), copy.deepcopy(critic)
        self.target_critic = copy.deepcopy(critic)
        self.log_alpha = torch.tensor(math.log(INITIAL_TEMPERATURE), requires_grad=True)
        self.target_entropy, self.generator = -float(actor.action_dim), generator
        self.queue, self.pointer = torch.zeros(QUEUE_SIZE, self.prototypes.shape[1]), 0
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=LEARNING_RATE)
        self.critic_optimizer = torch.optim.Adam(self.critic.parameters(), lr=LEARNING_RATE)
        self.alpha_optimizer = torch.optim.Adam([self.log_alpha], lr=LEARNING_RATE)

    @torch.no_grad()
    def bonus(self, features: Tensor) -> Tensor:
        """Put one candidate per prototype into the queue; return distances to the k-th neighbour, ``[B, 1]``."""
        z = F.normalize(self.projector(features), dim=1)
        candidates = self.draw_candidates(F.normalize(self.prototypes, dim=1) @ z.T)
        self.queue[self.pointer : self.pointer + len(candidates)] = z[candidates]
        self.pointer = (self.pointer + len(candidates)) % len(self.queue)
        return torch.cdist(z, self.queue).topk(K, dim=1, largest=False).values[:, -1:]

    def draw_candidates(self, scores: Tensor) -> Tensor:
        """Draw a row of the batch for every prototype, from scores ``[M, B]``."""
        return torch.multinomial(F.softmax(scores, dim=1), 1).squeeze(1)

    def critic_loss(self, h: Tensor, action: Tensor, reward: Tensor, next_h: Tensor, not_terminated: Tensor) -> Tensor:
        """Sum of both heads' mean squared errors; ``h`` and ``next_h`` are features ``[B, D]``."""
        with torch.no_grad():
            next_action, log_prob = self.actor.sample(next_h, generator=self.generator)
            q = self.target_critic(next_h, next_action).min(dim=1).values
            value = (q - self.log_alpha.exp() * log_prob).unsqueeze(1)
            target = reward + DISCOUNT * not_terminated * value
        q1, q2 = self.critic(h, action).split(1, dim=1)
        return F.mse_loss(q1, target) + F.mse_loss(q2, target)

    def actor_loss(self, h: Tensor) -> tuple[Tensor, Tensor]:
        """Return the actor's loss and the temperature's."""
        action, log_prob = self.actor.sample(h, generator=self.generator)
        alpha = self.log_alpha.exp()
        actor_loss = (alpha.detach() * log_prob - self.critic(h, action).min(dim=1).values).mean()
        return actor_loss, (alpha * (-log_prob - self.target_entropy).detach()).mean()

    def update(self, batch: Batch, agent_step: int) -> None:
        """Do one update on shifted images."""
        with torch.no_grad():
            h, next_h = self.encoder(batch.obs), self.encoder(batch.next_obs)
        reward = batch.reward + BETA * self.bonus(next_h)
        step(self.critic_optimizer, self.critic_loss(h, batch.action, reward, next_h, batch.not_terminated))
        if agent_step % DELAY == 0:
            actor_loss, alpha_loss = self.actor_loss(h)
            step(self.actor_optimizer, actor_loss)
            step(self.alpha_optimizer, alpha_loss)
            move_towards(self.target_critic, self.critic, CRITIC_TAU)


def step(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def move_towards(target: nn.Module, source: nn.Module, tau: float) -> None:
    for t, s in zip(target.parameters(), source.parameters()):
        t.data.copy_(tau * s.data + (1 - tau) * t.data)


def random_crop(images: Tensor) -> Tensor:
    """Shift every image by its own random integer offset, border replicated."""
    return crop(F.pad(images, (PAD, PAD, PAD, PAD), mode="replicate"), images.shape[-2:])


def crop(images: Tensor, size: Sequence[int], offsets: Tensor | None = None) -> Tensor:
    """Crop images ``[B, C, H, W]`` to ``size`` at integer offsets ``[B, 2]``, random ones by default."""
    windows = images.unfold(2, size[0], 1).unfold(3, size[1], 1)  # (B, C, rows, columns, *size), a view
    if offsets is None:
        offsets = torch.stack([torch.randint(count, (len(images),)) for count in windows.shape[2:4]], dim=1)
    return windows[torch.arange(len(images)), :, offsets[:, 0], offsets[:, 1]]
