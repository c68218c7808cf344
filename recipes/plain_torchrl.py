"""CRPTpro in TorchRL's idioms (--task walker_walk). Deviation: every agent step updates actor and temperature, too."""

import torch
import tyro
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.modules import RandomPolicy
from torchrl.objectives import SoftUpdate

from crptpro.data import FrameReplay
from crptpro.envs import make_env
from crptpro.modules import PixelEncoder, SquashedGaussianActor, TwinCritic
from crptpro.objectives import ProtoLoss, RADSACLoss
from crptpro.transforms import DenseShiftFeatures, PrototypeReward, RandomShift


def main(task="walker_walk", *, transitions=2_000, updates=200, batch_size=64, agent_steps=2_000):
    """Collect at random, pre-train, freeze, learn the task, at small scale."""
    env = make_env(task, seed=0)
    action_dim, views = env.action_spec.shape[-1], ["pixels", ("next", "pixels")]

    # Random data, every frame stored once; a sample is stacked, then shifted.
    data = FrameReplay(transitions, action_dim=action_dim, transform=RandomShift(in_keys=views))
    policy = RandomPolicy(env.full_action_spec)
    for rollout in Collector(make_env(task, seed=1), policy, frames_per_batch=100, total_frames=transitions):
        data.extend(rollout)  # and the collector closes its environment at the end

    # Pre-training: a LossModule, an optimiser, an EMA of the targets.
    loss = ProtoLoss(PixelEncoder(), num_prototypes=64)
    optimizer, targets = torch.optim.Adam(loss.parameters(), lr=3e-4), SoftUpdate(loss, tau=0.05)
    for _ in range(updates):
        _update(loss.before_update(), data.sample(batch_size), optimizer, targets)

    # Downstream: features of random shifts and the exploration bonus come with every sample.
    encoder = loss.encoder.requires_grad_(False).eval()
    replay = FrameReplay(10_000, action_dim=action_dim, returns_pixels=False)
    replay.append_transform(DenseShiftFeatures(encoder, replay, projector=loss.projector))
    replay.append_transform(PrototypeReward(None, loss.prototypes, in_keys=("next", "embedding")))
    actor, critic = (net(encoder.feature_dim, action_dim) for net in (SquashedGaussianActor, TwinCritic))
    sac = RADSACLoss(actor, critic)
    optimizer, targets = torch.optim.Adam(sac.parameters(), lr=1e-3), SoftUpdate(sac, tau=0.01)
    policy = TensorDictModule(lambda x: actor.sample(encoder(x[None]))[0][0], ["pixels"], ["action"])
    for rollout in Collector(
        env, policy, frames_per_batch=1, total_frames=agent_steps, auto_register_policy_transforms=False
    ):
        replay.extend(rollout)
        if len(replay) >= batch_size:
            _update(sac, replay.sample(batch_size), optimizer, targets)
    return sac


def _update(loss, batch, optimizer, targets):
    optimizer.zero_grad()
    sum(value for name, value in loss(batch).items() if name.startswith("loss_")).backward()
    optimizer.step()
    targets.step()


if __name__ == "__main__":
    tyro.cli(main)
