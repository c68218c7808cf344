"""The method written straight from its equations: float32, eager, nothing done for speed.

The yardstick of ``benchmarks.updates``. Tests hold its losses and gradients against the library's. The encoder is
``nn.Conv2d`` on contiguous NCHW images, Adam is torch's default, and every observation is encoded anew at every update;
the small networks are float32 copies of ours. Sources: CRPTpro (arXiv 2302.05614), Eq. 1-9, and SAC whose twin critic
shares one trunk. As in the released agents of CRPTpro and Proto-RL, the actor's loss runs backward through the whole
critic; unlike there, ``next_obs`` is encoded once, not again for the bonus.

Transitions are stored as in the released agents (``replay_buffer.py``): both stacks of nine channels, 127 KB. The shift
is an integer crop per sample, on uint8: interpolating in float32, as DrQ-v2 does, takes several times as long and is
not exact; comparing with it would flatter us.
"""

from __future__ import annotations

import copy
import math
from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchrl.data import ReplayBuffer

from crptpro.modules import PixelEncoder, SquashedGaussianActor, TwinCritic
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import Pretrained

LEARNING_RATE = 1e-4
PAD = 4
# Pre-training.
ENCODER_TAU = 0.05
ALPHA = 5e-3
OFFSET = 1.5
TEMPERATURE = 0.1
SINKHORN_ITERATIONS = 3
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
    """3x3 convolutions with ReLU, flattened: the weights of one of ours, of the same strides."""

    def __init__(self, ours: PixelEncoder) -> None:
        super().__init__()
        c_in, layers = ours.in_channels, []
        for c_out, stride in zip(ours.config["channels"], ours.strides):
            layers += [nn.Conv2d(c_in, c_out, 3, stride), nn.ReLU()]
            c_in = c_out
        self.convs = nn.Sequential(*layers)
        for plain, parameter in zip(self.parameters(), ours.parameters(), strict=True):
            plain.data = parameter.detach().clone(memory_format=torch.contiguous_format)

    def forward(self, images: Tensor) -> Tensor:
        """Map uint8 ``[B, C, H, W]`` to features ``[B, D]``."""
        return self.convs(images.to(next(self.parameters()).dtype) / 255).flatten(1)


class PlainPretraining:
    """Networks, targets, loss and optimiser of the pre-training stage, from the weights of one of ours."""

    def __init__(self, ours: ProtoLoss) -> None:
        self.encoder = PlainEncoder(cast(PixelEncoder, ours.encoder))
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
            assignments = sinkhorn(targets @ self.prototypes.T)
        log_p = F.log_softmax(predictions @ self.prototypes.T / TEMPERATURE, dim=1)
        comparative = -(assignments * log_p).sum(dim=1).mean()
        return comparative + ALPHA * dispersion(self.prototypes)

    def update(self, batch: Batch) -> Tensor:
        """Do one Adam step and move the targets; returns the loss."""
        with torch.no_grad():
            self.prototypes.copy_(F.normalize(self.prototypes, dim=1))
        loss = self.loss(batch.obs, batch.next_obs)
        step(self.optimizer, loss)
        move_towards(self.target_encoder, self.encoder, ENCODER_TAU)
        move_towards(self.target_projector, self.projector, ENCODER_TAU)
        return loss.detach()


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
    """Shift every image by its own random integer offset."""
    return crop(images, torch.randint(0, 2 * PAD + 1, (len(images), 2)))


def crop(images: Tensor, offsets: Tensor) -> Tensor:
    """Crop images ``[B, C, H, W]`` at offsets ``[B, 2]``, ``{0, ..., 8}``, from themselves, border replicated."""
    height, width = images.shape[-2:]
    padded = F.pad(images, (PAD, PAD, PAD, PAD), mode="replicate")
    windows = padded.unfold(2, height, 1).unfold(3, width, 1)  # (B, C, 9, 9, H, W), a view
    return windows[torch.arange(len(images)), :, offsets[:, 0], offsets[:, 1]]
