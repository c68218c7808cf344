from __future__ import annotations

from typing import Any

import pytest

from crptpro.downstream_config import DownstreamConfig, SkillDDPGSettings, drq_settings, skill_ddpg_settings


@pytest.mark.parametrize(("make", "message"), [
    (lambda: DownstreamConfig(channels_last="last"), r"`channels_last` must be 'auto', 'on' or 'off', got 'last'"),
    (lambda: DownstreamConfig(cuda_graph="maybe"), r"`cuda_graph` must be 'auto', 'on' or 'off', got 'maybe'"),
    (lambda: DownstreamConfig(algorithm="drq"), r"`intrinsic_reward_coef` is 0\.2, but drq .* drq_settings\(\)"),
    (lambda: DownstreamConfig(skill_ddpg=SkillDDPGSettings(skill=3)), r"`skill_ddpg` has settings, which rad-sac does"),
    (lambda: SkillDDPGSettings(n_step=0), r"`skill_ddpg\.n_step` must be at least 1, got 0"),
    (lambda: SkillDDPGSettings(noise_clip=-1.0), r"`skill_ddpg\.noise_clip` must not be negative, got -1\.0"),
    (lambda: SkillDDPGSettings(skill=16), r"`skill_ddpg\.skill` must be in 0\.\.15 .*got 16"),
])  # fmt: skip
def test_settings_that_cannot_run_are_named_with_their_value(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_settings_are_those_of_the_comparison() -> None:
    drq, ddpg = drq_settings(), skill_ddpg_settings()
    assert (drq.env_steps, drq.replay_capacity, drq.learning_rate, drq.batch_size) == (
        1_000_000,
        100_000,
        1e-3,
        512,
    )
    assert (drq.eval_episodes, drq.eval_interval_env_steps, drq.random_agent_steps) == (10, 10_000, 1_000)
    assert (ddpg.env_steps, ddpg.random_agent_steps, ddpg.learning_rate, ddpg.critic_tau) == (
        500_000,
        2_000,
        1e-4,
        0.01,
    )
    own = ddpg.skill_ddpg
    assert (own.skill_dim, own.n_step, own.update_interval, own.noise_std, own.noise_clip) == (
        16,
        3,
        2,
        0.2,
        0.3,
    )
    assert drq.intrinsic_reward_coef == ddpg.intrinsic_reward_coef == 0
    assert drq_settings(seed=4, env_steps=5).env_steps == 5
