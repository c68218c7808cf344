from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from fake_pixel_env import EPISODE, SKILLS, FakePixelEnv, small_encoder
from tensordict import TensorDict
from torch import nn
from torchrl.envs import Compose, SerialEnv, TransformedEnv

from crptpro.data import FrameReplay
from crptpro.transforms import FrozenEncoder, SkillContrastReward

B, D, K = 12, 5, 4


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def batch(count=B):
    skills = torch.randint(0, K, (count,), generator=seeded(1))
    after = {"features": torch.randn(count, D, generator=seeded()), "reward": torch.ones(count, 1)}
    return TensorDict({"skill": F.one_hot(skills, K).float(), "next": after}, [count])


def published(embeddings, skills, temperature=0.5):
    """exp(-loss) of BeCL ``agent/becl.py``, element by element."""
    rewards = []
    unit = F.normalize(embeddings.double(), dim=-1)
    for i in range(len(unit)):
        others = [j for j in range(len(unit)) if j != i]
        similarity = torch.stack([unit[i] @ unit[j] / temperature for j in others])
        weights = (similarity - similarity.max()).exp()
        same = [n for n, j in enumerate(others) if skills[j] == skills[i]]
        loss = -torch.log(weights[same[0] if same else 0] / (weights.sum() + 1e-6) + 1e-6)
        rewards.append(torch.exp(-loss))
    return torch.stack(rewards).float()


def test_the_golden_values():
    embeddings = torch.tensor([[1.0, 0.0], [0.6, 0.8], [0.0, 1.0], [-1.0, 0.0]])
    skills = torch.eye(2)[[0, 0, 1, 1]]
    rewards = SkillContrastReward(None).intrinsic_reward(embeddings, skills)
    golden = torch.tensor([0.745181, 0.387216, 0.143823, 0.696123])
    torch.testing.assert_close(rewards, golden, rtol=0, atol=1e-6)


@pytest.mark.parametrize("temperature", [0.5, 0.1])
def test_a_replay_batch_earns_the_published_reward(temperature):
    head, td = nn.Linear(D, 3), batch()
    SkillContrastReward(head, temperature=temperature)(td)
    expected = published(head(td["next", "features"]).detach(), td["skill"].argmax(-1), temperature)
    torch.testing.assert_close(td["next", "intrinsic_reward"].squeeze(-1), expected)
    torch.testing.assert_close(td["next", "reward"], 1.0 + 0.2 * td["next", "intrinsic_reward"])
    assert not td["next", "reward"].requires_grad
    assert float(expected.max()) <= 1.0
    assert float(expected.min()) > 0.0


def test_skills_of_next_observations_are_not_looked_at():
    td, misled = batch(), batch()
    misled["next", "skill"] = misled["skill"].roll(1, 0)
    transform = SkillContrastReward(None)
    assert torch.equal(transform(td)["next", "reward"], transform(misled)["next", "reward"])


def test_leading_dimensions_are_one_batch():
    flat, td = batch(), batch().reshape(3, 4)
    transform = SkillContrastReward(None)
    assert torch.equal(
        transform(td)["next", "intrinsic_reward"].flatten(), transform(flat)["next", "intrinsic_reward"].flatten()
    )  # fmt: skip


def test_one_sample_has_no_contrast_and_earns_nothing():
    td = SkillContrastReward(None)(batch(1))
    assert td["next", "intrinsic_reward"].tolist() == [[0.0]]
    assert td["next", "reward"].tolist() == [[1.0]]


def test_n_step_batches_of_a_replay_are_rewarded_for_the_skill_at_their_root():
    replay = FrameReplay(
        60, frame_shape=(1, 2, 2), action_dim=1, extra_columns={"skill": ((K,), torch.float32)}, generator=seeded()
    )  # fmt: skip
    frame = torch.zeros(1, 2, 2, dtype=torch.uint8)
    for _ in range(3):
        replay.begin_episode(frame)
        for i in range(20):
            replay.append(torch.zeros(1), 0.0, False, i == 19, frame + i, skill=torch.eye(K)[i // 5])
    td = replay.sample(16, n_step=3)
    td["next", "features"] = td["next", "pixels"].float().flatten(1)[:, ::4] + torch.arange(1, 4)
    SkillContrastReward(None, reward_key=None)(td)
    expected = published(td["next", "features"], td["skill"].argmax(-1))
    torch.testing.assert_close(td["next", "intrinsic_reward"].squeeze(-1), expected)


def head():
    torch.manual_seed(0)
    return nn.Linear(small_encoder().feature_dim, D)


def test_an_environment_is_rewarded_for_the_skill_that_acted():
    """At an odd agent step the skill changes: the step is rewarded by the one before the change."""
    torch.manual_seed(0)
    encoder, embed = small_encoder(), head()
    env = TransformedEnv(
        SerialEnv(4, FakePixelEnv), Compose(FrozenEncoder(encoder), SkillContrastReward(embed))
    )
    env.set_seed(0)
    td = env.reset()
    assert "intrinsic_reward" not in td
    # The skill of a step is the policy's to choose.
    td["skill"] = torch.eye(SKILLS)[[0, 1, 1, 0]]
    td = env.rand_step(td)
    assert not torch.equal(td["next", "skill"], td["skill"])
    expected = published(embed(td["next", "features"]).detach(), torch.tensor([0, 1, 1, 0]))
    torch.testing.assert_close(td["next", "intrinsic_reward"].squeeze(-1), expected)
    assert expected.unique().numel() > 1


def test_workers_of_a_vectorised_environment_receive_the_skill():
    def worker():
        return TransformedEnv(
            FakePixelEnv(), Compose(FrozenEncoder(small_encoder()), SkillContrastReward(head()))
        )

    env = SerialEnv(2, worker)
    assert env.full_state_spec["skill"].shape == (2, SKILLS)
    # Each worker is a single environment: rewarded, with nothing.
    assert not env.rollout(EPISODE)["next", "intrinsic_reward"].any()


def test_what_is_missing_or_wrong_is_named():
    with pytest.raises(KeyError, match="'skill'"):
        SkillContrastReward(None)(batch().exclude("skill"))
    with pytest.raises(KeyError, match=r"SkillContrastReward found no .*features"):
        SkillContrastReward(None)(batch().exclude(("next", "features")))
    with pytest.raises(ValueError, match="temperature must be positive, got 0"):
        SkillContrastReward(None, temperature=0)
    renamed = batch().rename_key_("skill", "option")
    SkillContrastReward(None, skill_key="option")(renamed)
    assert torch.equal(renamed["next", "reward"], SkillContrastReward(None)(batch())["next", "reward"])
