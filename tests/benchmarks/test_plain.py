"""The yardstick of the benchmarks computes what the library computes: same weights, same batch, same numbers."""

from __future__ import annotations

import copy

import pytest
import torch
from benchmarks.plain_downstream import PlainDownstream
from benchmarks.plain_pretrain import PlainPretraining, dispersion, sinkhorn
from benchmarks.plain_store import Batch, StackedStore, crop
from benchmarks.synthetic import write_dataset
from tensordict import TensorDict
from torch import Tensor, nn

from crptpro.data import FrameDataset
from crptpro.modules import PixelEncoder, Projector, Prototypes, SquashedGaussianActor, TwinCritic
from crptpro.objectives import ProtoLoss, RADSACLoss, method_defaults
from crptpro.objectives.functional import prototype_dispersion, sinkhorn_knopp
from crptpro.pretrained import Pretrained
from crptpro.training.pretrain.learner import Learner
from crptpro.training.rad_sac_learner import RADSACLearner
from crptpro.transforms import PrototypeReward, random_shift
from crptpro.transforms.prototype_reward import draw_candidates

B, SIZE, A = 24, 32, 3
ENCODER = {"channels": (8, 8, 8, 8), "image_size": SIZE}


def pixels(seed: int) -> Tensor:
    return torch.randint(
        0, 256, (B, 9, SIZE, SIZE), dtype=torch.uint8, generator=torch.Generator().manual_seed(seed)
    )


def proto_loss(dtype: torch.dtype) -> ProtoLoss:
    torch.manual_seed(0)
    loss = ProtoLoss(PixelEncoder(**ENCODER), num_prototypes=48, latent_dim=16, hidden_dim=32)
    return loss.to(dtype)


def pair() -> TensorDict:
    return TensorDict({"pixels": pixels(1), "next": {"pixels": pixels(2)}}, [B])


def parameters_of(loss: ProtoLoss) -> list[Tensor]:
    names = ("encoder", "projector", "predictor", "prototypes")
    return [p for name in names for p in getattr(loss, name).parameters()]


def assert_all_close(ours: list[Tensor], plain: list[Tensor], **tolerance: float) -> None:
    assert len(ours) == len(plain)
    for one, other in zip(ours, plain):
        torch.testing.assert_close(one, other, **tolerance)


def test_plain_pretraining_has_the_loss_and_gradients_of_proto_loss_in_float32() -> None:
    loss = proto_loss(torch.float32)
    plain = PlainPretraining.like(loss)
    plain_total = plain.loss(pixels(1), pixels(2))
    plain_total.backward()
    out = loss.before_update()(pair())
    total = out["loss_comp"] + out["loss_intr"]
    total.backward()
    torch.testing.assert_close(total, plain_total, rtol=1e-5, atol=0)
    ours, theirs = ([p.grad for p in found] for found in (parameters_of(loss), plain.parameters))
    scale = max(float(g.abs().max()) for g in theirs)
    assert scale > 1e-4
    assert_all_close(ours, theirs, rtol=1e-3, atol=1e-5 * scale)


def test_three_plain_pretraining_updates_leave_the_weights_and_targets_of_the_learner() -> None:
    # In float64: Adam turns the rounding of a vanishing gradient into a whole step.
    loss = proto_loss(torch.float64)
    plain = PlainPretraining.like(loss)
    defaults = method_defaults(loss)
    learner = Learner(
        loss, defaults, learning_rate=defaults.lr, encoder_tau=defaults.encoder_tau, updates=50_000
    )
    for index in range(3):
        plain.update(pixels(index), pixels(index + 9))
        batch = TensorDict({"pixels": pixels(index), "next": {"pixels": pixels(index + 9)}}, [B])
        learner.update(batch, index=index, domain="toy")
    assert_all_close(parameters_of(loss), plain.parameters, rtol=1e-7, atol=1e-9)
    targets = loss.target_state()
    for name, network in (("encoder", plain.target_encoder), ("projector", plain.target_projector)):
        assert_all_close(
            list(targets[name].values()), [p.data for p in network.parameters()], rtol=1e-7, atol=1e-9
        )


def test_plain_dispersion_and_assignments_are_the_librarys() -> None:
    # Beside the comparative loss the dispersion is too small for the comparison of totals to notice it.
    unit = nn.functional.normalize(torch.randn(48, 16, generator=torch.Generator().manual_seed(0)), dim=1)
    ours, theirs = (unit.clone().requires_grad_() for _ in range(2))
    values = prototype_dispersion(ours), dispersion(theirs)
    for value in values:
        value.backward()
    torch.testing.assert_close(*values)
    assert abs(float(values[0].detach())) > 1e-3
    torch.testing.assert_close(ours.grad, theirs.grad)
    scores = unit @ unit[:20].T
    torch.testing.assert_close(sinkhorn_knopp(scores), sinkhorn(scores))


class Agents:
    """Our downstream learner and the plain one, with the same weights and the same streams of noise."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        encoder = PixelEncoder(**ENCODER)
        self.pretrained = Pretrained(
            encoder, Projector(encoder.feature_dim, 16), prototypes=Prototypes(64, 16)
        )
        sizes = {"bottleneck_dim": 10, "hidden_dim": 32}
        actor = SquashedGaussianActor(encoder.feature_dim, A, **sizes)
        critic = TwinCritic(encoder.feature_dim, A, **sizes)
        self.plain = PlainDownstream.like(self.pretrained, actor, critic, torch.Generator().manual_seed(7))
        self.loss = RADSACLoss(actor, critic, generator=torch.Generator().manual_seed(7))
        self.bonus = PrototypeReward(
            self.pretrained.projector, self.pretrained.prototypes, generator=torch.Generator().manual_seed(8)
        )
        same_stream = torch.Generator().manual_seed(8)
        self.plain.draw_candidates = lambda scores: draw_candidates(scores, same_stream)
        self.batch = Batch(pixels(1), torch.rand(B, A) * 2 - 1, torch.rand(B, 1), pixels(2), torch.ones(B, 1))
        self.batch.not_terminated[::3] = 0

    def td(self) -> TensorDict:
        with torch.no_grad():
            h, next_h = (self.pretrained.encoder(x) for x in (self.batch.obs, self.batch.next_obs))
        terminated = self.batch.not_terminated == 0
        following = {"features": next_h, "reward": self.batch.reward, "done": terminated}
        following["terminated"] = terminated
        return TensorDict({"features": h, "action": self.batch.action, "next": following}, [B])

    @torch.no_grad()
    def plain_features(self) -> tuple[Tensor, Tensor]:
        return self.plain.encoder(self.batch.obs), self.plain.encoder(self.batch.next_obs)


def gradients(network: nn.Module) -> list[Tensor]:
    return [p.grad for p in network.parameters()]


def test_plain_downstream_encodes_as_the_frozen_encoder_does() -> None:
    agents = Agents()
    td = agents.td()
    assert_all_close([td["features"], td["next", "features"]], list(agents.plain_features()))


def test_the_plain_critic_has_the_loss_and_gradients_of_ours() -> None:
    agents = Agents()
    h, next_h = agents.plain_features()
    batch = agents.batch
    theirs = agents.plain.critic_loss(h, batch.action, batch.reward, next_h, batch.not_terminated)
    theirs.backward()
    ours = agents.loss.critic_loss(agents.td())["loss_qvalue"]
    ours.backward()
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=0)
    assert_all_close(gradients(agents.loss.critic), gradients(agents.plain.critic), rtol=1e-3, atol=1e-5)


def test_the_plain_actor_and_temperature_have_the_losses_and_gradients_of_ours() -> None:
    agents = Agents()
    theirs, log_prob = agents.plain.actor_loss(agents.plain_features()[0])
    theirs.backward()
    their_alpha = agents.plain.alpha_loss(log_prob)
    their_alpha.backward()
    out = agents.loss.actor_and_temperature_loss(agents.td())
    out["loss_actor"].backward()
    out["loss_alpha"].backward()
    torch.testing.assert_close(out["loss_actor"], theirs, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(out["loss_alpha"], their_alpha, rtol=1e-5, atol=1e-6)
    assert_all_close(gradients(agents.loss.actor), gradients(agents.plain.actor), rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(agents.loss.log_alpha.grad, agents.plain.log_alpha.grad, rtol=1e-5, atol=1e-6)


def test_the_plain_bonus_is_ours_over_a_queue_that_wraps_around() -> None:
    agents = Agents()
    agents.plain.queue, agents.plain.pointer = torch.zeros(128, 16), 0
    agents.bonus.queue = torch.zeros(128, 16)
    for seed in range(3):
        with torch.no_grad():
            h = agents.pretrained.encoder(pixels(seed))
        ours, theirs = agents.bonus.intrinsic_reward(h), agents.plain.bonus(h).squeeze(1)
        # Matrix-product distances cannot resolve zero: the square root of float32's rounding is left.
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=2e-3)
        torch.testing.assert_close(agents.bonus.queue, agents.plain.queue)
    assert (ours > 0.1).any()


def distance(some: list[Tensor], others: list[Tensor]) -> float:
    return sum(float((one - other).detach().double().abs().sum()) for one, other in zip(some, others))


def test_two_plain_downstream_updates_leave_the_weights_of_the_learner() -> None:
    agents = Agents()
    learner = RADSACLearner(agents.loss)
    started = copy.deepcopy(list(agents.plain.critic.parameters()))
    target = list(agents.loss.target_qvalue_network_params.values(True, True))
    target_started = [value.detach().clone() for value in target]
    for agent_step in range(2):
        agents.plain.update(agents.batch, agent_step)
        td = agents.td()
        learner.update(agents.bonus(td), agent_step=agent_step)
    # A step of Adam is 1e-4 whatever the gradient; where that is mere rounding, the two may part by two of them.
    for ours, theirs in (
        (agents.loss.critic, agents.plain.critic), (agents.loss.actor, agents.plain.actor)
    ):  # fmt: skip
        for one, other in zip(ours.parameters(), theirs.parameters()):
            far = (one - other).abs() > 2e-5
            assert far.float().mean() < 0.01
            assert (one - other).abs().max() <= 4.1e-4
    moved = [(new - old).detach().abs().max() for new, old in zip(agents.plain.critic.parameters(), started)]
    assert float(min(moved)) > 5e-5
    assert distance(target, target_started) == pytest.approx(
        distance(list(agents.plain.target_critic.parameters()), started), rel=0.02
    )
    torch.testing.assert_close(agents.loss.log_alpha.detach(), agents.plain.log_alpha.detach())


def test_the_plain_crop_is_the_librarys_random_shift() -> None:
    offsets = torch.randint(0, 9, (B, 2), generator=torch.Generator().manual_seed(0))
    assert torch.equal(crop(pixels(0), offsets), random_shift(pixels(0), offsets))


def test_the_stacked_store_holds_the_transitions_of_a_dataset(tmp_path) -> None:
    dataset = FrameDataset.open(write_dataset(tmp_path / "toy", transitions=25, image_size=16))
    store = StackedStore.of(dataset, 20)
    assert len(store) == 20
    rows = dataset[torch.arange(20)]
    assert torch.equal(store.content.obs, rows["pixels"])
    assert torch.equal(store.content.next_obs, rows["next", "pixels"])
    assert torch.equal(store.content.action, rows["action"])
    assert torch.equal(store.content.reward, rows["next", "reward"])
    assert len(StackedStore.of(dataset, 1_000)) == 25
    batch = store.sample(7)
    assert batch.obs.shape == (7, 9, 16, 16)
    assert batch.obs.dtype == torch.uint8
