"""DrQ and skill-conditioned DDPG through the same run as SAC on a frozen encoder."""

from __future__ import annotations

import copy
import csv
import dataclasses
import functools
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from test_downstream import SMALL, rows_without_time, small_pretrained, toy_env

from crptpro.data import FrameReplay
from crptpro.downstream_config import SkillDDPGSettings
from crptpro.errors import CheckpointError, PretrainedError
from crptpro.loggers import RunLogger
from crptpro.modules import FixedSkillActor, SquashedGaussianActor
from crptpro.pretrained import Pretrained
from crptpro.training import (
    CheckpointDir,
    DownstreamResult,
    PixelAgent,
    drq_settings,
    load_agent,
    skill_ddpg_settings,
    train_downstream,
)
from crptpro.training.downstream_evaluation import DownstreamEvaluation
from crptpro.training.skill_ddpg_learner import SkillDDPGLearner
from crptpro.training.trained_features import TrainedFeatures
from crptpro.transforms import draw_offsets, random_shift

NAMES = ("env_steps", "batch_size", "replay_capacity", "random_agent_steps", "eval_interval_env_steps",
         "eval_episodes", "checkpoint_interval_env_steps", "log_interval_env_steps", "precision",
         "eval_workers")  # fmt: skip
SHARED: dict[str, Any] = {name: getattr(SMALL, name) for name in NAMES} | {"hidden_dim": 32}
CONFIGS = {
    "drq": drq_settings(**SHARED),
    "skill-ddpg": skill_ddpg_settings(**SHARED, skill_ddpg=SkillDDPGSettings(skill_dim=4)),
}
ALGORITHMS = pytest.mark.parametrize("algorithm", CONFIGS)


def train(run_dir: Path | None, algorithm: str, **overrides: Any) -> DownstreamResult:
    return train_downstream(
        "toy",
        None if algorithm == "drq" else small_pretrained(),
        run_dir=run_dir,
        config=CONFIGS[algorithm],
        progress=False,
        **{"env_factory": toy_env, **overrides},
    )


@pytest.fixture(autouse=True)
def _small_encoder(monkeypatch: pytest.MonkeyPatch) -> None:
    """DrQ's fresh encoder, for the toy world's images."""

    def small(*, seed: int) -> Pretrained:
        return Pretrained(small_pretrained().encoder)

    monkeypatch.setattr("crptpro.training.downstream.random_pretrained", small)


def weights(result: DownstreamResult) -> dict[str, torch.Tensor]:
    networks = {"encoder": result.policy.encoder, "actor": result.policy.actor}
    return {
        f"{name}.{key}": value for name, net in networks.items() for key, value in net.state_dict().items()
    }


def assert_same_weights(one: DownstreamResult, other: DownstreamResult) -> None:
    expected = weights(other)
    for key, value in weights(one).items():
        assert torch.equal(value, expected[key]), key


def columns(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


@ALGORITHMS
def test_a_run_leaves_the_same_records_as_every_other_and_an_agent(tmp_path: Path, algorithm: str) -> None:
    result = train(tmp_path, algorithm)
    assert [row["env_steps"] for row in result.evaluations] == [0, 0, 40, 40, 80, 80, 120, 120]
    assert result.evaluations[-1]["updates"] == {"drq": 48, "skill-ddpg": 24}[algorithm]
    first = columns(tmp_path / "train.csv")[0]
    assert "loss_qvalue" in first
    assert ("entropy" in first) is (algorithm == "drq")
    agent, card = load_agent(tmp_path / "agent")
    pixels = torch.randint(0, 256, (9, 16, 16), dtype=torch.uint8)
    assert torch.equal(agent(pixels), result.policy(pixels))
    assert card["config"]["algorithm"] == algorithm
    assert type(agent.actor) is {"drq": SquashedGaussianActor, "skill-ddpg": FixedSkillActor}[algorithm]


@ALGORITHMS
def test_only_drq_trains_its_encoder(tmp_path: Path, algorithm: str) -> None:
    before = small_pretrained().encoder.state_dict()
    after = train(tmp_path, algorithm).policy.encoder.state_dict()
    assert {torch.equal(before[key], after[key]) for key in before} == {algorithm != "drq"}


@ALGORITHMS
def test_stopping_and_resuming_gives_the_numbers_of_an_uninterrupted_run(
    tmp_path: Path, algorithm: str
) -> None:
    whole = train(tmp_path / "whole", algorithm)
    train(tmp_path / "parts", algorithm, env_steps=60)
    resumed = train(tmp_path / "parts", algorithm)
    assert_same_weights(resumed, whole)
    kept = [row for row in resumed.evaluations if row["env_steps"] != 60]
    assert rows_without_time(kept) == rows_without_time(whole.evaluations)


def test_rendering_ahead_and_processes_of_its_own_change_no_number(tmp_path: Path) -> None:
    inline = train(tmp_path / "inline", "drq", eval_workers=0, render_ahead=False)
    beside = train(tmp_path / "beside", "drq", eval_workers=2, render_ahead=True)
    assert rows_without_time(beside.evaluations) == rows_without_time(inline.evaluations)
    assert_same_weights(beside, inline)


def test_the_same_seed_gives_the_same_run_and_another_seed_another(tmp_path: Path) -> None:
    first, second, other = (
        train(tmp_path / str(i), "drq", seed=seed, env_steps=60) for i, seed in enumerate((0, 0, 1))
    )
    assert_same_weights(first, second)
    assert any(not torch.equal(value, weights(other)[key]) for key, value in weights(first).items())


# --- what each algorithm is fed --------------------------------------------------------------------------------------


def test_skill_ddpg_learns_with_one_skill_and_returns_over_three_decisions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[int, TensorDictBase]] = []
    update = SkillDDPGLearner.update

    def spy(learner: SkillDDPGLearner, td: TensorDictBase, *, agent_step: int) -> dict[str, torch.Tensor]:
        seen.append((agent_step, td.clone()))
        return update(learner, td, agent_step=agent_step)

    monkeypatch.setattr(SkillDDPGLearner, "update", spy)
    result = train(tmp_path, "skill-ddpg", skill_ddpg=SkillDDPGSettings(skill_dim=4, skill=2), env_steps=60)
    assert [step for step, _ in seen] == list(range(12, 30, 2))
    for _, td in seen:
        assert torch.equal(td["skill"], torch.tensor([0.0, 0.0, 1.0, 0.0]).expand(8, 4))
        torch.testing.assert_close(td["next", "discount"], torch.full((8, 1), 0.99**3))
    assert result.policy.actor.skill == 2
    assert load_agent(tmp_path / "agent")[1]["modules"]["actor"]["skill"] == 2


def test_a_skill_that_nobody_gives_comes_from_the_seed(tmp_path: Path) -> None:
    many = SkillDDPGSettings(skill_dim=1000)
    skills = [
        train(None, "skill-ddpg", skill_ddpg=many, env_steps=20, seed=seed).policy.actor.skill
        for seed in (0, 0, 1)
    ]
    assert skills[0] == skills[1] != skills[2]


def test_drq_sees_every_observation_in_two_views_of_the_same_image() -> None:
    generator = torch.Generator().manual_seed(0)
    replay = FrameReplay(20, frame_shape=(3, 16, 16), action_dim=2)
    replay.set_rng(torch.Generator().manual_seed(0))
    frames = torch.randint(0, 256, (9, 3, 16, 16), dtype=torch.uint8, generator=generator)
    replay.begin_episode(frames[0])
    for frame in frames[1:]:
        replay.append(torch.zeros(2), 1.0, False, False, frame)
    encoder = small_pretrained().encoder
    features = TrainedFeatures(encoder, replay, pad=2, generator=torch.Generator().manual_seed(1))
    batch = features.sample(16)
    replay.set_rng(torch.Generator().manual_seed(0))
    plain = replay.sample(16)
    offsets = torch.Generator().manual_seed(1)
    for part, unshifted in ((batch, plain), (batch["next"], plain["next"])):
        for key in ("pixels", "pixels_view"):
            expected = random_shift(unshifted["pixels"], draw_offsets(16, 2, offsets), pad=2)
            assert torch.equal(part[key], expected)
        assert not torch.equal(part["pixels"], part["pixels_view"])
    stack = plain["pixels"][0]
    before = features.observe(stack, 0)
    assert torch.equal(before, encoder(stack.unsqueeze(0)))
    with torch.no_grad():
        encoder.convs[0].weight.mul_(2)
    assert not torch.equal(features.observe(stack, 0), before)  # as the encoder is now


# --- evaluations under way -------------------------------------------------------------------------------------------


def test_a_pending_evaluation_keeps_the_weights_of_its_moment_encoder_included(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = dataclasses.replace(CONFIGS["drq"], action_repeat=2, eval_workers=2)
    agent = PixelAgent(small_pretrained().encoder, actor_for_toy(), trains_encoder=True)
    with RunLogger(tmp_path) as records:
        make_env = functools.partial(toy_env, "toy", seed=0, image_size=16, frame_stack=3)
        evaluation = DownstreamEvaluation(
            "toy", make_env, config, records, tmp_path, method="toy", progress=False
        )
        started: list[PixelAgent] = []
        monkeypatch.setattr(evaluation._pool, "start", lambda agent, **how: started.append(agent))
        evaluation.start(agent, {"env_steps": 40})
        then = copy.deepcopy(agent.encoder.state_dict())
        with torch.no_grad():  # training goes on
            for parameter in [*agent.encoder.parameters(), *agent.actor.parameters()]:
                parameter.add_(1.0)
        state = copy.deepcopy(evaluation.state_dict())
        evaluation._pending = None
        evaluation.load_state_dict(state, agent)
        evaluation._pending = None
        evaluation.close()
    assert len(started) == 2
    for snapshot in started:
        for key, value in then.items():
            assert torch.equal(snapshot.encoder.state_dict()[key], value), key
    assert not torch.equal(agent.encoder.state_dict()[key], then[key])  # the run's own is left as it is


def actor_for_toy() -> SquashedGaussianActor:
    return SquashedGaussianActor(small_pretrained().encoder.feature_dim, 2, hidden_dim=8)


# --- what is refused, and what is not --------------------------------------------------------------------------------


def test_checkpoints_of_before_there_was_a_choice_are_continued_as_sac(tmp_path: Path) -> None:
    def sac(**overrides: Any) -> DownstreamResult:
        return train_downstream(
            "toy",
            small_pretrained(),
            run_dir=tmp_path,
            config=SMALL,
            progress=False,
            env_factory=toy_env,
            **overrides,
        )

    sac(env_steps=40)
    checkpoints = CheckpointDir(tmp_path / "checkpoints")
    state = checkpoints.load_latest()
    for name in ("algorithm", "skill_ddpg"):
        del state["fingerprint"][name]
    checkpoints.save(state, counter=20)
    assert sac().env_steps == 120


def test_another_algorithm_does_not_continue_a_run(tmp_path: Path) -> None:
    train(tmp_path, "skill-ddpg", env_steps=40)
    with pytest.raises(CheckpointError, match=r"skill_ddpg\.n_step was 3, now 2"):
        train(tmp_path, "skill-ddpg", skill_ddpg=SkillDDPGSettings(skill_dim=4, n_step=2))
    with pytest.raises(CheckpointError, match="algorithm was 'skill-ddpg', now 'drq'"):
        train(tmp_path, "drq")


def test_an_encoder_where_none_is_wanted_and_none_where_one_is_are_refused() -> None:
    with pytest.raises(PretrainedError, match="DrQ trains its encoder from scratch"):
        train_downstream("toy", small_pretrained(), config=CONFIGS["drq"], env_factory=toy_env)
    for config in (SMALL, CONFIGS["skill-ddpg"]):
        with pytest.raises(PretrainedError, match=f"{config.algorithm} learns on a frozen encoder"):
            train_downstream("toy", None, config=config, env_factory=toy_env)
