from __future__ import annotations

import copy

import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import nn

from crptpro.modules import Projector, Prototypes
from crptpro.transforms import ContrastiveReward, ParticleReward, PrototypeReward
from crptpro.transforms.rewards import draw_candidates

B, D, M = 24, 6, 8


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def latents(seed=0, count=B, dim=D):
    return torch.randn(count, dim, generator=seeded(seed))


def batch(count=B, seed=0):
    skill = F.one_hot(torch.randint(0, 4, (count,), generator=seeded(seed + 9)), 4).float()
    following = {"features": latents(seed, count), "reward": torch.rand(count, 1, generator=seeded(seed + 1))}
    return TensorDict({"skill": skill, "next": following}, [count])


def prototypes_of(rows=M, dim=D, scale=1.0):
    module = Prototypes(rows, dim)
    with torch.no_grad():
        module.weight.copy_(scale * latents(2, rows, dim))
    return module


def on_latents(**options):
    """A prototype reward that takes the features as projections."""
    chosen = {"queue_size": 32, "generator": seeded(1), "prototypes": prototypes_of(), **options}
    return PrototypeReward(None, chosen.pop("prototypes"), **chosen)


def kth_distance(z, queue, k):
    rows = [sorted(float((row - entry).norm()) for entry in queue.double())[k - 1] for row in z.double()]
    return torch.tensor(rows)


def test_batches_too_small_for_the_prototypes_are_announced_once_and_a_single_row_is_no_candidate(caplog):
    transform = on_latents()
    for rows in (B, 3, 2, 1):
        found = transform(batch(rows))["next", "intrinsic_reward"]
    assert found.tolist() == [[0.0]]
    assert transform.queue_pointer == 3 * M
    assert caplog.text.count("The prototype reward will mostly be 0: 8 prototypes") == 1


def test_the_prototype_reward_equals_the_formula_typed_again():
    """kth smallest of ||z_i - Q_l||, l2-normalised z, after the candidates went in (CRPTpro proto.py)."""
    projector, prototypes = Projector(10, D), prototypes_of(scale=7.0)  # their length makes no difference
    transform = PrototypeReward(projector, prototypes, queue_size=32, generator=seeded(4))
    draws, queue, pointer = seeded(4), torch.zeros(32, D), 0
    for seed in range(6):
        td = batch(seed=seed)
        td["next", "features"] = latents(seed, B, 10)
        with torch.no_grad():
            z = F.normalize(projector(td["next", "features"]), dim=-1)
            probabilities = torch.softmax(F.normalize(prototypes.weight, dim=-1) @ z.T, dim=1)
        uniform = torch.rand(M, 1, generator=draws)
        for j in range(M):
            drawn = int((probabilities[j].cumsum(0) <= uniform[j]).sum().clamp_max(B - 1))
            queue[(pointer + j) % 32] = z[drawn]
        pointer = (pointer + M) % 32
        external = td["next", "reward"].clone()
        transform(td)
        torch.testing.assert_close(transform.queue, queue)
        expected = kth_distance(z, queue, 3).unsqueeze(-1)
        torch.testing.assert_close(td["next", "intrinsic_reward"], expected, rtol=1e-4, atol=1e-5)
        assert torch.equal(td["next", "reward"], external + 0.2 * td["next", "intrinsic_reward"])
        assert int(transform.queue_pointer) == pointer


@pytest.mark.parametrize("make", [
    lambda net: PrototypeReward(net, prototypes_of().to("meta"), queue_size=32), ParticleReward, ContrastiveReward,
])  # fmt: skip
def test_features_on_the_cpu_go_to_the_device_of_the_networks(make):
    transform = make(nn.Linear(D, D, device="meta"))
    assert transform(batch())["next", "intrinsic_reward"].device.type == "meta"


@pytest.mark.parametrize("kind", [ParticleReward, ContrastiveReward])
def test_a_reward_leaves_a_network_in_training_as_it_is(kind):
    projector = nn.Sequential(nn.Linear(D, D), nn.BatchNorm1d(D), nn.Dropout(0.5)).train()
    before = copy.deepcopy(projector.state_dict())
    first, second = (kind(projector)(batch())["next", "intrinsic_reward"] for _ in range(2))
    assert torch.equal(first, second)
    assert projector.training
    torch.testing.assert_close(projector.state_dict(), before, rtol=0, atol=0)


def test_candidates_follow_the_softmax_over_the_batch():
    logits = torch.tensor([[0.0, 1.0, -1.0, 0.5], [2.0, 0.0, 0.0, 0.0]]).repeat_interleave(20_000, 0)
    drawn = draw_candidates(logits, seeded()).view(2, -1)
    for row, logit in zip(drawn, logits[::20_000]):
        frequency = torch.bincount(row, minlength=4) / 20_000
        torch.testing.assert_close(frequency, logit.softmax(0), rtol=0, atol=0.015)


def test_a_sample_drawn_k_times_gets_exactly_zero_and_that_happens_to_eight_percent():
    transform = PrototypeReward(None, Prototypes(512, 128), generator=seeded(6))
    features = torch.randn(512, 128, generator=seeded(7))
    reward = transform.intrinsic_reward(features)
    times_drawn = (F.normalize(features, dim=-1).unsqueeze(1) == transform.queue[:512]).all(-1).sum(1)
    assert torch.equal(reward == 0, times_drawn >= 3)
    assert 0.05 < float((reward == 0).float().mean()) < 0.115
    assert float(on_latents(queue_size=64).intrinsic_reward(latents(5)).max()) <= 1.0 + 1e-6  # unfilled rows


def test_the_queue_is_first_in_first_out_and_can_be_handed_over():
    handed = F.normalize(latents(8, 32), dim=-1)
    transform = on_latents(queue=handed)
    assert transform.queue.data_ptr() != handed.data_ptr()
    transform(batch())
    assert torch.equal(transform.queue[M:], handed[M:])
    assert not torch.equal(transform.queue[:M], handed[:M])


def test_a_row_that_is_not_finite_never_enters_the_queue():
    transform = on_latents()
    for seed in range(8):
        features = latents(seed)
        features[[0, 5, B - 1]] = float("nan")
        reward = transform.intrinsic_reward(features)
        assert transform.queue.isfinite().all()
        assert reward.isnan().nonzero().flatten().tolist() == [0, 5, B - 1]


class Published:
    """PBE and RMS of url_benchmark ``utils.py``, typed again in float64."""

    def __init__(self, k=12):
        self.k, self.mean, self.count = k, 0.0, 1e-4

    def __call__(self, z):
        z = z.double()
        distances = (z[:, None, :] - z[None, :, :]).norm(dim=-1).sort(dim=1).values[:, : self.k]
        new, delta = distances.numel(), distances.mean() - self.mean
        self.mean = self.mean + delta * new / (self.count + new)
        self.count += new
        return torch.log((distances / self.mean - 1e-4).clamp_min(0).mean(dim=1) + 1.0).float()


@pytest.mark.parametrize("k", [12, 3])
def test_particle_rewards_over_several_calls_equal_the_published_code(k):
    projector = Projector(10, D)
    transform, published = ParticleReward(projector, k=k), Published(k)
    for seed in range(4):
        features = torch.randn(B, 10, generator=seeded(seed)) * (1 + seed)
        expected = published(projector(features).detach())
        torch.testing.assert_close(transform.intrinsic_reward(features), expected, rtol=1e-4, atol=1e-5)


def test_particles_alone_few_or_coinciding_earn_what_is_left_to_compare():
    transform = ParticleReward(None)
    assert transform.intrinsic_reward(torch.ones(B, D)).tolist() == [0.0] * B
    before = copy.deepcopy(transform.state_dict())
    assert transform.intrinsic_reward(latents(1, count=1)).tolist() == [0.0]
    assert all(torch.equal(value, before[name]) for name, value in transform.state_dict().items())
    few = ParticleReward(None, k=12).intrinsic_reward(latents(count=4))
    assert torch.equal(few, ParticleReward(None, k=4).intrinsic_reward(latents(count=4)))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_row_that_is_not_finite_never_enters_a_running_statistic(bad):
    transform, clean = ParticleReward(None, k=3), ParticleReward(None, k=3)
    for each in (transform, clean):
        each.intrinsic_reward(latents())
    spoilt = latents(1)
    spoilt[4] = bad
    reward = transform.intrinsic_reward(spoilt)
    assert reward.isfinite().logical_not().nonzero().flatten().tolist() == [4]  # seen where it arises
    assert all(value.isfinite() for value in transform.state_dict().values())
    after, usual = transform.intrinsic_reward(latents(2)), clean.intrinsic_reward(latents(2))
    torch.testing.assert_close(after, usual, rtol=0.1, atol=0)


def published_contrast(embeddings, skills, temperature=0.5):
    """exp(-loss) of BeCL ``agent/becl.py``, element by element."""
    rewards, unit = [], F.normalize(embeddings.double(), dim=-1)
    for i in range(len(unit)):
        others = [j for j in range(len(unit)) if j != i]
        similarity = torch.stack([unit[i] @ unit[j] / temperature for j in others])
        weights = (similarity - similarity.max()).exp()
        same = [n for n, j in enumerate(others) if skills[j] == skills[i]]
        rewards.append(weights[same[0] if same else 0] / (weights.sum() + 1e-6) + 1e-6)
    return torch.stack(rewards).float()


@pytest.mark.parametrize("temperature", [0.5, 0.1])
def test_the_contrastive_reward_equals_the_published_code(temperature):
    head, td = nn.Linear(D, 3), batch()
    misled = td.clone()
    misled["next", "skill"] = misled["skill"].roll(1, 0)  # what came after is not looked at
    expected = published_contrast(head(td["next", "features"]).detach(), td["skill"].argmax(-1), temperature)
    for each in (td, misled, td.reshape(4, 6)):
        found = ContrastiveReward(head, temperature=temperature)(each.clone())["next", "intrinsic_reward"]
        torch.testing.assert_close(found.flatten(), expected)
    assert ContrastiveReward(None).intrinsic_reward(latents(count=1), torch.eye(1)).tolist() == [0.0]


def prototype(projector, prototypes, **options):
    return PrototypeReward(projector, prototypes, queue_size=32, generator=seeded(), **options)


def particle(projector, prototypes, **options):
    return ParticleReward(projector, **{} if projector is None else {"k": 3}, **options)


def contrastive(projector, prototypes, **options):
    return ContrastiveReward(projector, **options)


each = pytest.mark.parametrize("kind", [prototype, particle, contrastive])


@each
def test_the_reward_is_added_with_its_coefficient_or_left_alone(kind):
    td = batch()
    external = td["next", "reward"].clone()
    kind(None, prototypes_of(), coef=0.5, out_keys="bonus")(td)
    assert torch.equal(td["next", "reward"], external + 0.5 * td["bonus"])
    td = kind(None, prototypes_of(), coef=None)(batch())
    assert torch.equal(td["next", "reward"], external)
    assert td["next", "intrinsic_reward"].shape == (B, 1)
    half = batch()
    half["next", "features"] = half["next", "features"].bfloat16().requires_grad_()
    kind(None, prototypes_of())(half)
    assert half["next", "intrinsic_reward"].dtype == torch.float32
    assert not half["next", "intrinsic_reward"].requires_grad


@pytest.mark.parametrize("kind", [prototype, particle])
def test_features_on_another_device_are_not_waited_for(kind):
    td = batch()
    external = td["next", "reward"]
    td["next", "features"] = latents().to("meta")  # it has no values: reading one is an error
    kind(None, prototypes_of().to("meta"), coef=0.5).to("meta")(td)
    assert external.device.type == "cpu"
    assert td["next", "reward"].device.type == "meta"


@each
def test_keys_can_be_renamed_and_nested_and_what_is_missing_is_named(kind):
    td, renamed = batch(), batch()
    names = {"in_keys": ("features", "z"), "reward_key": ("reward", "score")}
    keys = {"out_keys": ("next", "agent", "bonus")}
    for option, (old, new) in names.items():
        renamed.rename_key_(("next", old), ("next", "agent", new))
        keys[option] = ("next", "agent", new)
    kind(None, prototypes_of(), coef=0.2)(td)
    kind(None, prototypes_of(), coef=0.2, **keys)(renamed)
    assert torch.equal(renamed["next", "agent", "score"], td["next", "reward"])
    assert torch.equal(renamed["next", "agent", "bonus"], td["next", "intrinsic_reward"])
    for missing in ("features", "reward"):
        with pytest.raises(KeyError, match=f"'{missing}'"):
            kind(None, prototypes_of(), coef=1.0)(batch().exclude(("next", missing)))
    with pytest.raises(ValueError, match="reads and writes one key each"):
        kind(None, prototypes_of(), in_keys=["a", "b"], out_keys=["c", "d"])


@each
def test_a_state_dict_holds_what_a_reward_remembers_and_no_networks(kind):
    networks, td = (Projector(D, 5), Prototypes(M, 5)), batch()
    transform, fresh = kind(*networks), kind(*networks)
    transform(td.clone())
    names = {prototype: {"queue", "queue_pointer"}, particle: {"distance_mean", "distance_count"}}
    assert set(transform.state_dict()) == names.get(kind, set())
    fresh.load_state_dict(transform.state_dict())
    if kind is prototype:
        transform.generator, fresh.generator = seeded(11), seeded(11)
    found = [each(td.clone())["next", "intrinsic_reward"] for each in (transform, fresh)]
    assert torch.equal(*found)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: on_latents(knn_k=33), "`knn_k` must be at most 32"),
        (lambda: on_latents(queue=torch.zeros(3, D)), "expected a queue"),
        (lambda: PrototypeReward(None, Prototypes(512, 4), queue_size=2000), r"got 2000 and 512"),
        (lambda: on_latents().intrinsic_reward(torch.randn(3, D + 1)), f"length {D + 1}, the prototypes {D}"),
        (lambda: ParticleReward(None, k=1), "`k` must be at least 2, got 1"),
        (lambda: ContrastiveReward(None, temperature=0), "`temperature` must be positive, got 0"),
        (
            lambda: ContrastiveReward(None)(batch().set("skill", torch.arange(B) % 4)),
            r"Skills must be one-hot, \[24, K\] with K of at least 2, got \[24, 1\]; torch.nn.functional.one_hot makes",
        ),
    ],
)
def test_bad_settings_are_refused_by_name(make, named):
    with pytest.raises(ValueError, match=named):
        make()
