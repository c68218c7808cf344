"""The prototype-kNN reward: its values, its draws, what it reads and writes, what it refuses."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from fake_pixel_env import FakePixelEnv, small_encoder, small_heads
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ListStorage, ReplayBuffer
from torchrl.envs import Compose, SerialEnv, TransformedEnv

from crptpro.modules import Projector, Prototypes
from crptpro.transforms import FrozenEncoder, PrototypeReward
from crptpro.transforms.prototype_reward import draw_candidates, warn_if_mostly_zero

B, D, M = 24, 6, 8


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def batch(count=B, dim=D, seed=0):
    draws = seeded(seed)
    return TensorDict(
        {
            "next": {
                "features": torch.randn(count, dim, generator=draws),
                "reward": torch.rand(count, 1, generator=draws),
            }
        },
        batch_size=[count],
    )


def on_latents(**changes):
    """A reward that takes the features as projections."""
    options = {"queue_size": 32, "generator": seeded(1), **changes}
    prototypes = options.pop("prototypes", torch.randn(M, D, generator=seeded(2)))
    return PrototypeReward(None, prototypes, **options)


def kth_distance(latents, queue, k):
    rows = []
    for z in latents.double():
        rows.append(sorted(float((z - entry).norm()) for entry in queue.double())[k - 1])
    return torch.tensor(rows, dtype=torch.float32)


def test_the_golden_values_of_the_reward():
    start = torch.tensor([[7.0, 7.0], [0.0, 1.0], [0.8, 0.6], [-1.0, 0.0]])
    # A cold draw for the prototype (1, 0) can only pick the first sample, which completes the queue.
    reward = PrototypeReward(
        None, torch.tensor([[1.0, 0.0]]), queue_size=4, candidate_temperature=1e-3, queue=start
    )
    values = reward.intrinsic_reward(torch.tensor([[1.0, 0.0], [0.6, 0.8]]))
    torch.testing.assert_close(values, torch.tensor([1.414214, 0.894427]), rtol=0, atol=1e-6)
    assert torch.equal(reward.queue, torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.8, 0.6], [-1.0, 0.0]]))


def test_the_reward_equals_the_formula_typed_again():
    """kth smallest of ||z_i - Q_l||, l2-normalised z, after the candidates went in (CRPTpro proto.py)."""
    projector, prototypes = Projector(10, D), Prototypes(M, D)
    transform = PrototypeReward(projector, prototypes, queue_size=32, generator=seeded(4))
    draws = seeded(4)
    queue, pointer = torch.zeros(32, D), 0
    for seed in range(6):
        td = batch(dim=10, seed=seed)
        with torch.no_grad():
            z = F.normalize(projector(td["next", "features"]), dim=-1)
            c = F.normalize(prototypes.weight, dim=-1)
        probabilities = torch.softmax(c @ z.T, dim=1)
        uniform = torch.rand(M, 1, generator=draws)
        for j in range(M):
            i = int((probabilities[j].cumsum(0) <= uniform[j]).sum().clamp_max(B - 1))
            queue[(pointer + j) % 32] = z[i]
        pointer = (pointer + M) % 32
        external = td["next", "reward"].clone()
        transform(td)
        expected = kth_distance(z, queue, 3).unsqueeze(-1)
        torch.testing.assert_close(transform.queue, queue)
        torch.testing.assert_close(td["next", "intrinsic_reward"], expected, rtol=1e-4, atol=1e-5)
        assert torch.equal(td["next", "reward"], external + 0.2 * td["next", "intrinsic_reward"])
        assert int(transform.queue_pointer) == pointer


def test_candidates_follow_the_softmax_over_the_batch():
    logits = torch.tensor([[0.0, 1.0, -1.0, 0.5], [2.0, 0.0, 0.0, 0.0]]).repeat_interleave(20_000, 0)
    drawn = draw_candidates(logits, seeded()).view(2, -1)
    for row, logit in zip(drawn, logits[::20_000]):
        frequency = torch.bincount(row, minlength=4) / 20_000
        torch.testing.assert_close(frequency, logit.softmax(0), rtol=0, atol=0.015)


def test_the_temperature_sharpens_the_draw():
    latents = F.normalize(torch.randn(B, D, generator=seeded(9)), dim=-1)
    transform = on_latents(candidate_temperature=1e-4)
    transform.intrinsic_reward(latents)
    nearest = latents[(F.normalize(transform.prototypes, dim=-1) @ latents.T).argmax(-1)]
    torch.testing.assert_close(transform.queue[:M], nearest)


def test_neither_the_length_of_prototypes_nor_of_latents_matters():
    weight = torch.randn(M, D, generator=seeded(2))
    plain, scaled = on_latents(prototypes=weight), on_latents(prototypes=weight * 7)
    latents = torch.randn(B, D, generator=seeded(3))
    torch.testing.assert_close(plain.intrinsic_reward(latents), scaled.intrinsic_reward(latents * 0.1))


def test_a_sample_drawn_k_times_gets_exactly_zero_and_that_happens_to_eight_percent():
    transform = PrototypeReward(None, Prototypes(512, 128), generator=seeded(6))
    features = torch.randn(512, 128, generator=seeded(7))
    reward = transform.intrinsic_reward(features)
    times_drawn = (F.normalize(features, dim=-1).unsqueeze(1) == transform.queue[:512]).all(-1).sum(1)
    assert torch.equal(reward == 0, times_drawn >= 3)
    assert 0.05 < float((reward == 0).float().mean()) < 0.115


def test_self_copies_can_be_excluded():
    features = torch.randn(B, D, generator=seeded(7))
    latents = F.normalize(features, dim=-1)
    counted, excluded = on_latents(), on_latents(knn_exclude_self=True)
    for _ in range(5):
        with_self, without = counted.intrinsic_reward(features), excluded.intrinsic_reward(features)
    assert torch.equal(counted.queue, excluded.queue)
    assert (without >= with_self - 1e-5).all()
    copies = (latents.unsqueeze(1) == excluded.queue).all(-1)
    newest = torch.zeros(32, dtype=torch.bool)
    newest[:M] = True  # the fifth call wrapped around
    assert copies[:, newest].any()
    for i in range(B):
        others = excluded.queue[~(copies[i] & newest)]
        torch.testing.assert_close(
            without[i : i + 1], kth_distance(latents[i : i + 1], others, 3), atol=1e-5, rtol=0
        )


def test_excluding_self_leaves_no_reward_where_nothing_else_is_known():
    transform = PrototypeReward(None, torch.randn(4, D), queue_size=4, knn_exclude_self=True)
    assert float(transform.intrinsic_reward(torch.randn(1, D))) == 0.0


def test_rms_normalisation_divides_by_the_running_root_mean_square():
    plain, normed = on_latents(), on_latents(reward_norm="rms")
    seen = []
    for seed in range(3):
        latents = torch.randn(B, D, generator=seeded(seed))
        raw = plain.intrinsic_reward(latents)
        seen.append(raw)
        expected = raw / torch.cat(seen).square().mean().sqrt()
        torch.testing.assert_close(normed.intrinsic_reward(latents), expected)


def test_the_total_may_go_to_its_own_key():
    td = batch()
    before = td["next", "reward"].clone()
    on_latents(out_reward_key="total_reward", intrinsic_reward_coef=0.5, out_keys="bonus")(td)
    assert torch.equal(td["next", "reward"], before)
    assert torch.equal(td["next", "total_reward"], before + 0.5 * td["next", "bonus"])


def test_without_a_reward_key_only_the_bonus_is_written():
    td = batch()
    before = td["next", "reward"].clone()
    on_latents(reward_key=None)(td)
    assert torch.equal(td["next", "reward"], before)
    assert td["next", "intrinsic_reward"].shape == (B, 1)


@pytest.mark.parametrize("lead", [(), (3,), (2, 4)])
def test_any_leading_batch_is_accepted(lead):
    td = TensorDict(
        {"next": {"features": torch.randn(*lead, D), "reward": torch.zeros(*lead, 1)}}, batch_size=lead
    )
    on_latents()(td)
    assert td["next", "intrinsic_reward"].shape == (*lead, 1)
    assert torch.equal(td["next", "reward"], 0.2 * td["next", "intrinsic_reward"])


def test_low_precision_features_give_a_float32_reward():
    td = batch()
    td["next", "features"] = td["next", "features"].bfloat16()
    on_latents()(td)
    assert td["next", "intrinsic_reward"].dtype == torch.float32


def test_nothing_carries_a_gradient():
    projector, prototypes = Projector(10, D), Prototypes(M, D)
    td = batch(dim=10)
    td["next", "features"].requires_grad_()
    PrototypeReward(projector, prototypes, queue_size=32)(td)
    assert not td["next", "reward"].requires_grad
    assert not td["next", "intrinsic_reward"].requires_grad


@pytest.mark.parametrize("storage", [LazyTensorStorage, ListStorage])
def test_a_replay_buffer_adds_beta_times_the_bonus_and_its_storage_stays(storage):
    buffer = ReplayBuffer(storage=storage(B), batch_size=16)
    td = batch()
    td["row"] = torch.arange(B)
    buffer.extend(td.clone())
    buffer.append_transform(on_latents())
    for _ in range(3):
        sample = buffer.sample()
        external = td["next", "reward"][sample["row"]]
        assert torch.equal(sample["next", "reward"], external + 0.2 * sample["next", "intrinsic_reward"])
        assert float(sample["next", "intrinsic_reward"].max()) > 0
        buffer[torch.arange(B)]
        buffer[: B - 1]
    for row in range(B):
        stored = buffer._storage.get(row)
        assert torch.equal(stored["next", "reward"], td["next", "reward"][row])
        assert stored["next"].get("intrinsic_reward", None) is None


def with_encoder(**changes):
    encoder = small_encoder()
    projector, prototypes = small_heads(encoder)
    reward = PrototypeReward(projector, prototypes, queue_size=32, generator=seeded(), **changes)
    return Compose(FrozenEncoder(encoder), reward)


def test_vectorised_environments_are_rewarded_as_one_batch():
    plain = TransformedEnv(SerialEnv(3, FakePixelEnv), FrozenEncoder(small_encoder()))
    env = TransformedEnv(SerialEnv(3, FakePixelEnv), with_encoder())
    for each in (plain, env):
        each.set_seed(0)
    torch.manual_seed(0)
    external = plain.rollout(3)["next", "reward"]
    torch.manual_seed(0)
    rollout = env.rollout(3)
    bonus = rollout["next", "intrinsic_reward"]
    assert bonus.shape == (3, 3, 1)
    assert float(bonus.max()) > 0
    torch.testing.assert_close(rollout["next", "reward"], external + 0.2 * bonus)
    assert int(env.transform[1].queue_pointer) == 3 * 8 % 32
    assert "intrinsic_reward" not in env.reset()


def test_a_single_environment_rewards_only_what_it_has_not_just_seen():
    """Its batch is one sample, which fills the queue with copies of itself."""
    counted = TransformedEnv(FakePixelEnv(), with_encoder()).rollout(4)
    excluded = TransformedEnv(FakePixelEnv(), with_encoder(knn_exclude_self=True)).rollout(4)
    assert not counted["next", "intrinsic_reward"].any()
    assert (excluded["next", "intrinsic_reward"] > 0).all()


def test_training_mode_makes_no_difference():
    train, evaluate = on_latents().train(), on_latents().eval()
    for seed in range(2):
        one, other = train(batch(seed=seed)), evaluate(batch(seed=seed))
        assert torch.equal(one["next", "reward"], other["next", "reward"])


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"knn_k": 0}, "knn_k"),
        ({"knn_k": 33}, "knn_k"),
        ({"candidate_temperature": 0.0}, "candidate_temperature"),
        ({"reward_norm": "std"}, "rms"),
        ({"queue": torch.zeros(3, D)}, "queue"),
        ({"in_keys": ["a", "b"]}, "one key"),
    ],
)
def test_bad_settings_are_refused_by_name(changes, named):
    with pytest.raises(ValueError, match=named):
        on_latents(**changes)


def test_projections_of_another_length_than_the_prototypes_are_refused():
    with pytest.raises(ValueError, match="length 5, the prototypes 4"):
        PrototypeReward(Projector(10, 5), Prototypes(8, 4), queue_size=32)
    with pytest.raises(ValueError, match=f"length {D + 1}, the prototypes {D}"):
        on_latents().intrinsic_reward(torch.randn(3, D + 1))
    mute = PrototypeReward(torch.nn.Linear(10, 5), Prototypes(8, 4), queue_size=32)
    with pytest.raises(ValueError, match="length 5, the prototypes 4"):
        mute.intrinsic_reward(torch.randn(3, 10))


def test_missing_entries_are_named():
    with pytest.raises(KeyError, match="features"):
        on_latents()(TensorDict({"next": {"reward": torch.zeros(2, 1)}}, batch_size=[2]))
    with pytest.raises(KeyError, match="reward"):
        on_latents()(TensorDict({"next": {"features": torch.zeros(2, D)}}, batch_size=[2]))
    with pytest.raises(KeyError, match="score"):
        TransformedEnv(FakePixelEnv(), with_encoder(reward_key="score")).reward_spec  # noqa: B018


def test_batches_too_small_for_the_prototypes_are_announced(caplog: pytest.LogCaptureFixture) -> None:
    warn_if_mostly_zero(512, 512, 3)
    assert not caplog.text
    warn_if_mostly_zero(512, 128, 3)
    assert "512 prototypes draw their candidates from batches of 128" in caplog.text
    assert "batches of more than 192" in caplog.text


def test_most_rows_earn_nothing_where_it_is_announced_and_few_at_the_papers_sizes() -> None:
    def share_of_zeros(batch_size: int) -> float:
        generator = torch.Generator().manual_seed(0)
        reward = PrototypeReward(
            None,
            torch.randn(512, 16, generator=generator),
            queue_size=2048,
            reward_key=None,
            generator=generator,
        )
        values = [reward.intrinsic_reward(torch.randn(batch_size, 16, generator=generator)) for _ in range(5)]
        return float((values[-1] == 0).float().mean())

    assert share_of_zeros(128) > 0.6
    assert share_of_zeros(512) < 0.2
