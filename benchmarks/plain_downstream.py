"""SAC on a frozen encoder written straight from its equations: float32, eager, every observation encoded anew.

The yardstick of ``benchmarks.updates`` for downstream learning. It computes what the library's learner computes (a
test compares every loss and gradient): fresh random shifts of ``obs`` and ``next_obs`` at each update, the frozen
encoder on both, the prototype-kNN bonus from the features of ``next_obs``, and SAC whose twin critic shares one trunk.
The actor's loss runs backward through the whole critic, whose gradients are then dropped, as in the released agents of
CRPTpro and Proto-RL; unlike them, ``next_obs`` is encoded once, not again for the bonus.
"""

from __future__ import annotations

import copy
import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from benchmarks.plain_pretrain import (
    Batch,
    PlainEncoder,
    StackedStore,
    copy_parameters,
    move_towards,
    random_crop,
)
from crptpro.modules import SquashedGaussianActor, TwinCritic
from crptpro.pretrained import Pretrained

LEARNING_RATE = 1e-4
DISCOUNT = 0.99
INITIAL_TEMPERATURE = 0.1
CRITIC_TAU = 0.01
DELAY = 2  # updates between two of actor, temperature and target critic
BETA = 0.2
K = 3
QUEUE_SIZE = 2_048
LOG_STD_BOUNDS = (-10.0, 2.0)


def trunk(feature_dim: int, bottleneck_dim: int) -> nn.Sequential:
    """Features to the bottleneck."""
    return nn.Sequential(nn.Linear(feature_dim, bottleneck_dim), nn.LayerNorm(bottleneck_dim))


def mlp(in_dim: int, hidden_dim: int, out_dim: int) -> nn.Sequential:
    """Two hidden layers with ReLU."""
    return nn.Sequential(
        nn.Linear(in_dim, hidden_dim), nn.ReLU(),
        nn.Linear(hidden_dim, hidden_dim), nn.ReLU(),
        nn.Linear(hidden_dim, out_dim),
    )  # fmt: skip


class PlainActor(nn.Module):
    """Squashed Gaussian policy on features."""

    def __init__(self, feature_dim: int, action_dim: int, bottleneck_dim: int, hidden_dim: int) -> None:
        super().__init__()
        self.trunk = trunk(feature_dim, bottleneck_dim)
        self.mlp = mlp(bottleneck_dim, hidden_dim, 2 * action_dim)

    def forward(self, features: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """Draw actions ``[B, A]`` and their log-probabilities ``[B, 1]``."""
        mean, raw = self.mlp(self.trunk(features)).chunk(2, dim=-1)
        low, high = LOG_STD_BOUNDS
        log_std = low + 0.5 * (high - low) * (torch.tanh(raw) + 1)
        noise = torch.randn(mean.shape, generator=generator, dtype=mean.dtype)
        u = mean + log_std.exp() * noise
        log_normal = -0.5 * noise**2 - log_std - 0.5 * math.log(2 * math.pi)
        log_prob = log_normal - 2 * (math.log(2) - u - F.softplus(-2 * u))
        return torch.tanh(u), log_prob.sum(dim=-1, keepdim=True)


class PlainCritic(nn.Module):
    """Two Q-functions on one trunk."""

    def __init__(self, feature_dim: int, action_dim: int, bottleneck_dim: int, hidden_dim: int) -> None:
        super().__init__()
        self.trunk = trunk(feature_dim, bottleneck_dim)
        self.q1 = mlp(bottleneck_dim + action_dim, hidden_dim, 1)
        self.q2 = mlp(bottleneck_dim + action_dim, hidden_dim, 1)

    def forward(self, features: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return both values, ``[B, 1]`` each."""
        inputs = torch.cat([self.trunk(features), action], dim=-1)
        return self.q1(inputs), self.q2(inputs)


class PlainDownstream:
    """Frozen encoder, projector and prototypes, SAC with its three optimisers, and the bonus's queue."""

    def __init__(
        self,
        encoder: PlainEncoder,
        projector: nn.Linear,
        prototypes: Tensor,
        actor: PlainActor,
        critic: PlainCritic,
        *,
        target_entropy: float,
        generator: torch.Generator | None = None,
    ) -> None:
        self.encoder, self.projector, self.prototypes = encoder, projector, prototypes
        self.actor, self.critic, self.target_critic = actor, critic, copy.deepcopy(critic)
        self.log_alpha = torch.tensor(math.log(INITIAL_TEMPERATURE), requires_grad=True)
        self.target_entropy, self.generator = target_entropy, generator
        self.queue, self.pointer = torch.zeros(QUEUE_SIZE, prototypes.shape[1]), 0
        self.actor_optimizer = torch.optim.Adam(actor.parameters(), lr=LEARNING_RATE)
        self.critic_optimizer = torch.optim.Adam(critic.parameters(), lr=LEARNING_RATE)
        self.alpha_optimizer = torch.optim.Adam([self.log_alpha], lr=LEARNING_RATE)

    @classmethod
    def like(
        cls,
        pretrained: Pretrained,
        actor: SquashedGaussianActor,
        critic: TwinCritic,
        generator: torch.Generator | None = None,
    ) -> PlainDownstream:
        """Start from the weights of networks of ours."""
        assert isinstance(pretrained.projector, nn.Module)
        assert isinstance(pretrained.prototypes, nn.Module)
        trained = pretrained.encoder
        encoder = PlainEncoder(trained.in_channels, trained.config["channels"], trained.strides)
        prototypes = pretrained.prototypes.get_parameter("weight").detach().clone()
        projector = nn.Linear(trained.feature_dim, prototypes.shape[1])
        plain_actor, plain_critic = PlainActor(**_sizes(actor)), PlainCritic(**_sizes(critic))
        for source, network in (
            (trained, encoder), (pretrained.projector, projector),
            (actor, plain_actor), (critic, plain_critic),
        ):  # fmt: skip
            copy_parameters(source, network)
        return cls(
            encoder, projector, prototypes, plain_actor, plain_critic,
            target_entropy=-float(actor.action_dim), generator=generator,
        )  # fmt: skip

    @property
    def alpha(self) -> Tensor:
        """The temperature."""
        return self.log_alpha.exp()

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

    def critic_loss(
        self, h: Tensor, action: Tensor, reward: Tensor, next_h: Tensor, not_terminated: Tensor
    ) -> Tensor:
        """Sum of both heads' mean squared errors; ``h`` and ``next_h`` are features ``[B, D]``."""
        with torch.no_grad():
            next_action, log_prob = self.actor(next_h, self.generator)
            value = torch.min(*self.target_critic(next_h, next_action)) - self.alpha * log_prob
            target = reward + DISCOUNT * not_terminated * value
        q1, q2 = self.critic(h, action)
        return F.mse_loss(q1, target) + F.mse_loss(q2, target)

    def actor_loss(self, h: Tensor) -> tuple[Tensor, Tensor]:
        """Return the actor's loss and the log-probabilities ``[B, 1]`` of its draw."""
        action, log_prob = self.actor(h, self.generator)
        return (self.alpha.detach() * log_prob - torch.min(*self.critic(h, action))).mean(), log_prob

    def alpha_loss(self, log_prob: Tensor) -> Tensor:
        """Return the temperature's loss."""
        return (self.alpha * (-log_prob - self.target_entropy).detach()).mean()

    def update(self, batch: Batch, agent_step: int) -> None:
        """Do one update on shifted images."""
        with torch.no_grad():
            h, next_h = self.encoder(batch.obs), self.encoder(batch.next_obs)
        reward = batch.reward + BETA * self.bonus(next_h)
        loss = self.critic_loss(h, batch.action, reward, next_h, batch.not_terminated)
        _step(self.critic_optimizer, loss)
        if agent_step % DELAY == 0:
            loss, log_prob = self.actor_loss(h)
            _step(self.actor_optimizer, loss)
            _step(self.alpha_optimizer, self.alpha_loss(log_prob))
            move_towards(self.target_critic, self.critic, CRITIC_TAU)

    def sample_and_update(self, store: StackedStore, batch_size: int, agent_step: int) -> None:
        """Do what is timed: sample, shift both observations, update."""
        batch = store.sample(batch_size)
        shifted = batch._replace(obs=random_crop(batch.obs), next_obs=random_crop(batch.next_obs))
        self.update(shifted, agent_step)


def _step(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def _sizes(network: SquashedGaussianActor | TwinCritic) -> dict[str, int]:
    names = ("feature_dim", "action_dim", "bottleneck_dim", "hidden_dim")
    return {name: network.config[name] for name in names}
