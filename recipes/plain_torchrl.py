"""CRPTpro written with nothing but TorchRL's idioms and this library's parts: pre-train an encoder, then SAC on it.

python recipes/plain_torchrl.py walker_walk
"""

import sys

import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.modules import RandomPolicy
from torchrl.objectives import SoftUpdate

from crptpro.data import FrameReplay
from crptpro.envs import make_env
from crptpro.modules import PixelEncoder, SquashedGaussianActor, TwinCritic
from crptpro.objectives import ProtoLoss, RADSACLoss
from crptpro.transforms import DenseShiftFeatures, PrototypeReward, RandomShift


def main(
    task: str = "walker_walk",
    *,
    transitions=2_000,
    updates=200,
    batch_size=64,
    agent_steps=2_000,
    prototypes=64,
) -> RADSACLoss:
    """Collect at random, pre-train, freeze, learn the task; the numbers are small ones."""
    env = make_env(task, seed=0)
    action_dim = env.action_spec.shape[-1]

    # Random data, every frame stored once; a sample is stacked, then shifted.
    data = FrameReplay(
        transitions, action_dim=action_dim, transform=RandomShift(in_keys=["pixels", ("next", "pixels")])
    )
    for rollout in Collector(
        env, RandomPolicy(env.full_action_spec), frames_per_batch=100, total_frames=transitions
    ):
        data.extend(rollout)

    # Pre-training: a LossModule, an optimiser, an EMA of the targets.
    loss = ProtoLoss(PixelEncoder(), num_prototypes=prototypes)
    optimizer, targets = torch.optim.Adam(loss.parameters(), lr=3e-4), SoftUpdate(loss, tau=0.05)
    for _ in range(updates):
        losses = loss.before_update()(data.sample(batch_size))
        optimizer.zero_grad()
        (losses["loss_comp"] + losses["loss_intr"]).backward()
        optimizer.step()
        targets.step()

    # Downstream: features of random shifts and the exploration bonus come with every sample.
    encoder = loss.encoder.requires_grad_(False).eval()
    replay = FrameReplay(10_000, action_dim=action_dim, returns_pixels=False)
    replay.append_transform(DenseShiftFeatures(encoder, replay, projector=loss.projector))
    replay.append_transform(
        PrototypeReward(None, loss.prototypes, in_keys=("next", "embedding"), queue_size=32 * prototypes)
    )
    actor, critic = (
        SquashedGaussianActor(encoder.feature_dim, action_dim),
        TwinCritic(encoder.feature_dim, action_dim),
    )
    sac = RADSACLoss(actor, critic)
    optimizer, targets = torch.optim.Adam(sac.parameters(), lr=1e-3), SoftUpdate(sac, tau=0.01)
    policy = TensorDictModule(
        lambda pixels: actor.sample(encoder(pixels[None]))[0][0], ["pixels"], ["action"]
    )
    for rollout in Collector(
        env, policy, frames_per_batch=1, total_frames=agent_steps, init_random_frames=batch_size
    ):
        replay.extend(rollout)
        if len(replay) >= batch_size:
            losses = sac(replay.sample(batch_size))
            optimizer.zero_grad()
            sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
            optimizer.step()
            targets.step()
    return sac


if __name__ == "__main__":
    main(*sys.argv[1:])
