from __future__ import annotations

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict

from crptpro.modules import Projector
from crptpro.transforms import ParticleReward

B, D = 24, 6


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def latents(seed=0, count=B):
    return torch.randn(count, D, generator=seeded(seed))


class Published:
    """PBE and RMS of url_benchmark ``utils.py``, typed again in float64."""

    def __init__(self, k=12, average=True, scale="running_mean", clip=1e-4):
        self.k, self.average, self.scale, self.clip = k, average, scale, clip
        self.mean, self.variance, self.count = 0.0, 1.0, 1e-4

    def __call__(self, z):
        z = z.double()
        distances = (z[:, None, :] - z[None, :, :]).norm(dim=-1).sort(dim=1).values[:, : self.k]
        if not self.average:
            distances = distances[:, -1:]
        new, delta = distances.numel(), distances.mean() - self.mean
        self.mean = self.mean + delta * new / (self.count + new)
        self.variance = (
            self.variance * self.count
            + distances.var(unbiased=True) * new
            + delta**2 * self.count * new / (self.count + new)
        ) / (self.count + new)
        self.count += new
        scale = {"running_mean": self.mean, "running_variance": self.variance, "none": 1.0}[self.scale]
        return torch.log((distances / scale - self.clip).clamp_min(0).mean(dim=1) + 1.0).float()


def test_the_golden_values():
    points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0], [3.0, 3.0]])
    plain = {"k": 3, "scale": "none", "clip": 0.0}
    average = ParticleReward(None, **plain).intrinsic_reward(points)
    kth = ParticleReward(None, average=False, **plain).intrinsic_reward(points)
    golden = torch.tensor(
        [[0.693147, 0.731738, 0.880466, 1.180482], [1.098612, 1.174359, 1.174359, 1.527262]]
    )
    torch.testing.assert_close(torch.stack([average, kth]), golden, rtol=0, atol=1e-6)


@pytest.mark.parametrize("scale", ["running_mean", "running_variance", "none"])
@pytest.mark.parametrize("average", [True, False])
@pytest.mark.parametrize(("k", "clip"), [(12, 1e-4), (3, 0.5)])
def test_rewards_over_several_calls_equal_the_published_code(scale, average, k, clip):
    options = {"k": k, "average": average, "scale": scale, "clip": clip}
    transform, published = ParticleReward(None, **options), Published(**options)
    for seed in range(4):
        z = latents(seed) * (1 + seed)
        torch.testing.assert_close(transform.intrinsic_reward(z), published(z), rtol=1e-5, atol=1e-6)


def test_the_defaults_are_the_published_ones():
    transform, published = ParticleReward(None), Published()
    torch.testing.assert_close(transform.intrinsic_reward(latents()), published(latents()))


def test_the_first_batch_is_scaled_by_its_own_mean():
    """The statistic is updated before it is used, and its starting point weighs next to nothing."""
    transform = ParticleReward(None, clip=0.0)
    relative = transform.intrinsic_reward(latents()).expm1()
    torch.testing.assert_close(relative.mean(), torch.tensor(1.0), rtol=1e-5, atol=0)


def test_the_scale_of_the_latent_space_does_not_matter():
    first, second = ParticleReward(None), ParticleReward(None)
    for seed in range(3):
        torch.testing.assert_close(
            first.intrinsic_reward(latents(seed)), second.intrinsic_reward(latents(seed) * 1e3), rtol=1e-4, atol=1e-5
        )  # fmt: skip


def test_the_projector_is_applied_and_nothing_is_normalised_or_carries_a_gradient():
    projector = Projector(10, D)
    features = torch.randn(B, 10, generator=seeded(), requires_grad=True)
    reward = ParticleReward(projector).intrinsic_reward(features)
    assert not reward.requires_grad
    torch.testing.assert_close(reward, Published()(projector(features).detach()), rtol=1e-5, atol=1e-6)


def test_low_precision_features_give_a_float32_reward():
    assert ParticleReward(None).intrinsic_reward(latents().bfloat16()).dtype == torch.float32


def test_a_particle_alone_earns_nothing_and_teaches_nothing():
    transform = ParticleReward(None)
    transform.intrinsic_reward(latents())
    before = copy.deepcopy(transform.state_dict())
    assert transform.intrinsic_reward(latents(1, count=1)).tolist() == [0.0]
    assert all(torch.equal(value, before[name]) for name, value in transform.state_dict().items())


def test_a_batch_smaller_than_k_has_all_of_it_as_neighbours():
    z = latents(count=4)
    small = ParticleReward(None, k=12).intrinsic_reward(z)
    assert torch.equal(small, ParticleReward(None, k=4).intrinsic_reward(z))


def test_particles_that_coincide_earn_nothing():
    same = torch.ones(B, D)
    transform = ParticleReward(None)
    assert transform.intrinsic_reward(same).tolist() == [0.0] * B
    assert bool(transform.intrinsic_reward(latents()).isfinite().all())


def test_the_statistic_survives_a_state_dict_round_trip():
    first, second = ParticleReward(None), ParticleReward(None)
    for seed in range(3):
        first.intrinsic_reward(latents(seed))
    assert set(first.state_dict()) == {"distance_mean", "distance_variance", "distance_count"}
    second.load_state_dict(first.state_dict())
    assert torch.equal(first.intrinsic_reward(latents(5) * 9), second.intrinsic_reward(latents(5) * 9))


def test_clones_copies_and_pickles_have_a_statistic_of_their_own():
    transform = ParticleReward(None)
    transform.intrinsic_reward(latents())
    before = transform.distance_mean.clone()
    for other in (transform.clone(), copy.deepcopy(transform), pickle.loads(pickle.dumps(transform))):
        assert torch.equal(other.distance_mean, before)
        other.intrinsic_reward(latents(1) * 50)
        assert not torch.equal(other.distance_mean, before)
    assert torch.equal(transform.distance_mean, before)


@pytest.mark.parametrize("reward_key", ["reward", None])
def test_a_replay_batch_gets_the_bonus_and_the_total(reward_key):
    external = torch.rand(B, 1, generator=seeded(3))
    td = TensorDict({"next": {"features": latents(), "reward": external.clone()}}, [B])
    transform = ParticleReward(None, intrinsic_reward_coef=0.5, reward_key=reward_key, out_keys="bonus")
    transform(td)
    torch.testing.assert_close(td["next", "bonus"].squeeze(-1), Published()(latents()))
    expected = external if reward_key is None else external + 0.5 * td["next", "bonus"]
    assert torch.equal(td["next", "reward"], expected)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"k": 1}, "k counts the particle itself.*got 1"),
        ({"clip": -1e-4}, "clip"),
        ({"scale": "rms"}, "running_mean.*'rms'"),
        ({"in_keys": ["a", "b"]}, "ParticleReward reads and writes one key"),
    ],
)
def test_bad_settings_are_refused_by_name(changes, named):
    with pytest.raises(ValueError, match=named):
        ParticleReward(None, **changes)
