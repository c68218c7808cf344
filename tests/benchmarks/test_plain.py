"""The yardstick of the benchmarks computes what the library computes: same weights, same batch, same numbers."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from benchmarks.plain import Batch, PlainDownstream, PlainPretraining, crop
from benchmarks.synthetic import drifting_dataset
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import SoftUpdate

from crptpro.data import FrameDataset
from crptpro.modules import PixelEncoder, Projector, Prototypes, SquashedGaussianActor, TwinCritic
from crptpro.objectives import ProtoLoss, RADSACLoss
from crptpro.pretrained import Pretrained
from crptpro.training import SACLearner
from crptpro.transforms import PrototypeReward, random_shift
from crptpro.transforms.rewards import draw_candidates

B, SIZE, A = 24, 32, 3
ENCODER = {"channels": (8, 8, 8, 8), "image_size": SIZE}


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def pixels(seed: int) -> Tensor:
    return torch.randint(0, 256, (B, 9, SIZE, SIZE), dtype=torch.uint8, generator=seeded(seed))


def assert_all_close(ours: list[Tensor], plain: list[Tensor], **tolerance: float) -> None:
    for one, other in zip(ours, plain, strict=True):
        torch.testing.assert_close(one, other, **tolerance)


def test_plain_pretraining_has_the_losses_gradients_and_updates_of_proto_loss() -> None:
    # In float64: Adam turns the rounding of a vanishing gradient into a whole step.
    torch.manual_seed(0)
    loss = ProtoLoss(PixelEncoder(**ENCODER), num_prototypes=48, latent_dim=16, hidden_dim=32).double()
    plain = PlainPretraining(loss)
    trained = [p for p in loss.parameters() if p.requires_grad]
    optimizer, targets = torch.optim.Adam(trained, lr=1e-4), SoftUpdate(loss, tau=0.05)
    losses = []
    for seed in range(4):
        obs, next_obs, unread = pixels(seed), pixels(seed + 9), torch.zeros(B, 1)
        theirs = plain.update(Batch(obs, unread, unread, next_obs, unread))
        loss.before_update()
        out = loss(TensorDict({"pixels": obs, "next": {"pixels": next_obs}}, [B]))
        optimizer.zero_grad()
        ours = out["loss_comp"] + out["loss_intr"]
        ours.backward()
        losses.append(ours.item())
        assert losses[-1] == pytest.approx(theirs.item(), rel=1e-9)
        names = ("encoder", "projector", "predictor", "prototypes")
        gradients = [p.grad for name in names for p in getattr(loss, name).parameters()]
        assert max(float(g.abs().max()) for g in gradients) > 1e-4
        assert_all_close(gradients, [p.grad for p in plain.parameters], rtol=1e-5, atol=1e-9)
        optimizer.step()
        targets.step()
    assert len(set(losses)) == 4


class Agents:
    """Our downstream learner and the plain one, with the same weights and the same streams of noise."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        encoder = PixelEncoder(**ENCODER).requires_grad_(False)
        heads = Projector(encoder.feature_dim, 16), Prototypes(64, 16)
        sizes = {"bottleneck_dim": 10, "hidden_dim": 32}
        actor = SquashedGaussianActor(encoder.feature_dim, A, **sizes)
        critic = TwinCritic(encoder.feature_dim, A, **sizes)
        self.plain = PlainDownstream(Pretrained(encoder, heads[0], prototypes=heads[1]), actor, critic, seeded(7))
        self.loss = RADSACLoss(actor, critic, generator=seeded(7))
        self.bonus = PrototypeReward(*heads, coef=0.2, generator=seeded(8))
        same_stream = seeded(8)
        self.plain.draw_candidates = lambda scores: draw_candidates(scores, same_stream)
        self.batch = Batch(pixels(1), torch.rand(B, A) * 2 - 1, torch.rand(B, 1), pixels(2), torch.ones(B, 1))
        self.batch.not_terminated[::3] = 0
        end = self.batch.not_terminated == 0
        following = {"features": encoder(self.batch.next_obs), "reward": self.batch.reward}
        following |= {"done": end, "terminated": end}
        features = {"features": encoder(self.batch.obs), "action": self.batch.action}
        self.td = TensorDict({**features, "next": following}, [B])

    def critic_losses(self) -> tuple[Tensor, Tensor]:
        batch, h, next_h = self.batch, self.td["features"], self.td["next", "features"]
        theirs = self.plain.critic_loss(h, batch.action, batch.reward, next_h, batch.not_terminated)
        return self.loss.critic_loss(self.td)["loss_qvalue"], theirs


def test_plain_downstream_updates_have_the_losses_of_the_learner_and_its_queue_that_wraps_around() -> None:
    agents = Agents()
    agents.plain.queue, agents.bonus.queue = torch.zeros(2, 128, 16)
    learner = SACLearner(agents.loss)
    for agent_step in range(3):
        agents.plain.update(agents.batch, agent_step)
        learner.update(agents.bonus(agents.td.clone()), agent_update=agent_step)
    agents.plain.generator.set_state(agents.loss.generator.get_state())
    torch.testing.assert_close(agents.bonus.queue, agents.plain.queue)
    torch.testing.assert_close(*agents.critic_losses(), rtol=1e-3, atol=0)
    torch.testing.assert_close(agents.loss.log_alpha.detach(), agents.plain.log_alpha.detach())


def test_the_plain_crop_and_store_are_the_librarys_shift_and_dataset(tmp_path: Path) -> None:
    offsets = torch.randint(0, 9, (B, 2), generator=seeded(0))
    padded = F.pad(pixels(0), (4, 4, 4, 4), mode="replicate")
    assert torch.equal(crop(padded, (SIZE, SIZE), offsets), random_shift(pixels(0), offsets))
    dataset = FrameDataset.open(drifting_dataset(tmp_path, transitions=25, image_size=16))
    store, rows = Batch.of(dataset, 20), dataset[torch.arange(20)]
    for name, key in (("obs", "pixels"), ("next_obs", ("next", "pixels")), ("action", "action")):
        assert torch.equal(getattr(store, name), rows[key])
    assert len(Batch.of(dataset, 1_000).obs) == 25
    assert store.sample(7).obs.shape == (7, 9, 16, 16)
