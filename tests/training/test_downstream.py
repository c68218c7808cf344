from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import pytest
import torch
from torchrl.envs import CatFrames, EnvBase, TransformedEnv
from toy_world import ToyEnv

from crptpro.errors import CheckpointError, NonFiniteError, PretrainedError
from crptpro.loggers import RunLogger, WandbOptions
from crptpro.modules import PixelEncoder, Projector, Prototypes, set_compute_dtype
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import (
    Pretrained,
    load_pretrained,
    random_pretrained,
    save_pretrained,
    trim_pretrained,
)
from crptpro.training import DownstreamConfig, load_agent, train_downstream
from crptpro.training.downstream import _replay_capacity
from crptpro.training.downstream_run import DownstreamRun
from crptpro.training.rad_sac_learner import RADSACLearner

EPISODE = 10
SMALL = DownstreamConfig(
    env_steps=120,
    batch_size=8,
    replay_capacity=40,
    random_agent_steps=12,
    queue_size=16,
    eval_interval_env_steps=40,
    eval_episodes=2,
    checkpoint_interval_env_steps=20,
    log_interval_env_steps=20,
    precision="fp32",
    eval_workers=0,
)


def small_pretrained() -> Pretrained:
    torch.manual_seed(0)
    encoder = PixelEncoder(channels=(4, 4), strides=(2, 1), image_size=16)
    return Pretrained(encoder, projector=Projector(encoder.feature_dim, 4), prototypes=Prototypes(8, 4))


def toy_env(task: str, *, seed: int, image_size: int, frame_stack: int, **settings: object) -> EnvBase:
    env = ToyEnv(lambda _: EPISODE, seed=seed, image_size=image_size)
    return TransformedEnv(env, CatFrames(N=frame_stack, dim=-3, in_keys=["pixels"], padding="same"))


def world_of_16(task: str, *, image_size: int, **settings: object) -> EnvBase:
    """A world that draws at a size of its own."""
    return toy_env(task, image_size=16, **settings)  # type: ignore[arg-type]


def train(run_dir: Path | None, pretrained: Pretrained | None = None, **overrides: object):
    return train_downstream(
        "toy",
        small_pretrained() if pretrained is None else pretrained,
        run_dir=run_dir,
        progress=False,
        **{"config": SMALL, "env_factory": toy_env, **overrides},
    )


def rows_without_time(rows: list[dict]) -> list[dict]:
    return [{k: v for k, v in row.items() if "time" not in k} for row in rows]


def test_a_run_evaluates_at_every_interval_and_at_both_ends(tmp_path: Path) -> None:
    result = train(tmp_path)
    assert result.env_steps == 120
    assert [row["env_steps"] for row in result.evaluations] == [0, 0, 40, 40, 80, 80, 120, 120]
    assert {row["episode"] for row in result.evaluations} == {0, 1}
    assert result.evaluations[-1]["updates"] == 60 - 12
    agent, card = load_agent(tmp_path / "agent")
    pixels = torch.randint(0, 256, (9, 16, 16), dtype=torch.uint8)
    torch.testing.assert_close(agent(pixels), result.policy(pixels), rtol=0, atol=0)
    assert card["task"] == "toy"


@pytest.mark.parametrize("channels_last", ["on", "off"])
def test_a_saved_agent_acts_in_the_arithmetic_of_its_run(tmp_path: Path, channels_last: str) -> None:
    result = train(tmp_path, env_steps=40, precision="bf16", channels_last=channels_last)
    agent, card = load_agent(tmp_path / "agent")
    assert card["config"]["precision"] == "bf16"
    pixels = torch.randint(0, 256, (9, 16, 16), dtype=torch.uint8)
    assert agent.encoder.channels_last is (channels_last == "on")
    torch.testing.assert_close(agent(pixels), result.policy(pixels), rtol=0, atol=0)
    set_compute_dtype(agent.actor, torch.float32)
    set_compute_dtype(agent.encoder, torch.float32)
    assert not torch.equal(agent(pixels), result.policy(pixels))


def test_training_changes_the_actor_and_leaves_the_encoder_projector_and_prototypes_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs: list[DownstreamRun] = []

    def noted(*args: object, **options: object) -> DownstreamRun:
        runs.append(DownstreamRun(*args, **options))  # type: ignore[arg-type]
        return runs[-1]

    monkeypatch.setattr("crptpro.training.downstream.DownstreamRun", noted)
    train(tmp_path / "a", env_steps=20)  # 10 decisions: no update yet
    train(tmp_path / "b")
    first, later = runs
    assert (first.updates, later.updates) == (0, 60 - 12)
    before, after = (run.parts.agent().actor.state_dict() for run in runs)
    assert any(not torch.equal(before[k], after[k]) for k in before)
    untouched, parts = small_pretrained(), later.parts
    for trained, reference in (
        (parts.encoder, untouched.encoder),
        (parts.bonus.projector, untouched.projector),
        (parts.bonus.prototypes, untouched.prototypes),
    ):
        for key, value in reference.state_dict().items():
            torch.testing.assert_close(trained.state_dict()[key], value, rtol=0, atol=0)


def test_the_same_seed_gives_the_same_run_and_another_seed_another(tmp_path: Path) -> None:
    first, second, other = train(tmp_path / "a"), train(tmp_path / "b"), train(tmp_path / "c", seed=1)
    assert rows_without_time(first.evaluations) == rows_without_time(second.evaluations)
    assert rows_without_time(first.evaluations) != rows_without_time(other.evaluations)


def test_dense_and_reencoded_features_train_the_same_agent(tmp_path: Path) -> None:
    first_rows = []
    for mode in ("dense", "reencode"):
        train(tmp_path / mode, features=mode)
        with open(tmp_path / mode / "train.csv", newline="") as file:
            first_rows.append(next(csv.DictReader(file)))
    dense, reencoded = first_rows
    assert dense.keys() == reencoded.keys()
    for key in ("loss_qvalue", "loss_actor", "q_mean", "entropy", "intrinsic_reward"):
        assert float(dense[key]) == pytest.approx(float(reencoded[key]), rel=1e-3), key


@pytest.mark.parametrize("features", ["dense", "reencode"])
def test_kept_and_computed_embeddings_give_the_same_bonus(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, features: str
) -> None:
    settings = {"batch_size": 20, "shift_pad": 1, "features": features, "env_steps": 60}
    kept = train(tmp_path / "kept", **settings)
    monkeypatch.setattr("crptpro.training.downstream_parts.worth_keeping_projections", lambda config: False)
    computed = train(tmp_path / "computed", **settings)
    rows = []
    for run in ("kept", "computed"):
        with open(tmp_path / run / "train.csv", newline="") as file:
            rows.append([float(row["intrinsic_reward"]) for row in csv.DictReader(file)])
    assert len(rows[0]) >= 2
    assert rows[0] == pytest.approx(rows[1], rel=1e-4)
    assert kept.env_steps == computed.env_steps


def test_an_artifact_without_prototypes_trains_without_bonus_and_says_so_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    encoder = {"channels": (4, 4), "strides": (2, 1), "image_size": 16}
    with caplog.at_level("INFO", logger="crptpro"):
        train(tmp_path, random_pretrained(seed=0, **encoder))
    assert caplog.text.count("no exploration bonus") == 1
    assert "intrinsic_reward" not in (tmp_path / "train.csv").read_text()


def test_the_bonus_is_logged_when_there_are_prototypes(tmp_path: Path) -> None:
    train(tmp_path)
    assert "intrinsic_reward" in (tmp_path / "train.csv").read_text().splitlines()[0]


def test_an_agent_is_refused_as_a_pretrained_encoder(tmp_path: Path) -> None:
    train(tmp_path, env_steps=40)
    with pytest.raises(PretrainedError, match="agent"):
        train(tmp_path / "next", tmp_path / "agent")


def test_a_run_that_is_refused_frees_its_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[EnvBase] = []
    monkeypatch.setattr(ToyEnv, "close", lambda env, **options: closed.append(env))
    with pytest.raises(PretrainedError, match="image"):
        train(
            None,
            random_pretrained(seed=0, channels=(4, 4), strides=(2, 1), image_size=20),
            env_factory=world_of_16,
        )
    assert len(closed) == 1


def test_without_a_directory_nothing_is_kept_but_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    result = train(None, env_steps=40)
    assert result.agent_path is None
    assert len(result.evaluations) == 4
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("batch_size", 0),
        ("discount", 1.5),
        ("learning_rate", 0.0),
        ("random_agent_steps", 50),
        ("random_agent_steps", 0),
    ],
)
def test_settings_that_cannot_run_are_named_with_their_value(setting: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"`?{setting}`?.*{value}|{value}.*`{setting}`"):
        dataclasses.replace(SMALL, **{setting: value})


def test_every_logged_mean_is_over_the_updates_that_reported_it(tmp_path: Path) -> None:
    # 7 updates a row, every third with an actor step: rows hold two or three of those.
    train(
        tmp_path,
        log_interval_env_steps=14,
        actor_update_interval=3,
        initial_temperature=0.25,
        learning_rate=1e-9,
    )
    with open(tmp_path / "train.csv", newline="") as file:
        alphas = [float(row["alpha"]) for row in csv.DictReader(file)]
    assert alphas == pytest.approx([0.25] * len(alphas))


@pytest.mark.parametrize(
    ("network", "message"),
    [
        ("critic", r"After update \d+ the parameter .*trunk.* is not finite"),
        ("actor", r"the policy of toy acts \[nan"),
    ],
)
def test_a_spoilt_weight_reaches_neither_a_checkpoint_nor_the_simulator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, network: str, message: str
) -> None:
    train(tmp_path, env_steps=40)
    kept = sorted((tmp_path / "checkpoints").iterdir())

    def spoil(learner: RADSACLearner, *args: object, **options: object) -> dict[str, torch.Tensor]:
        with torch.no_grad():
            getattr(learner.loss, network).trunk.linear.weight.fill_(float("nan"))
        return {}

    monkeypatch.setattr(RADSACLearner, "update", spoil)
    with pytest.raises(NonFiniteError, match=message):
        train(tmp_path, env_steps=60)
    assert sorted((tmp_path / "checkpoints").iterdir()) == kept


def test_videos_and_mirrors_receive_the_run(tmp_path: Path) -> None:
    with RunLogger(tmp_path, tensorboard=True, wandb=WandbOptions(mode="offline")) as logger:
        train(tmp_path, logger=logger, env_steps=40, video_episodes=1)
    videos = sorted(path.name for path in (tmp_path / "videos").iterdir())
    assert videos == ["env_steps_00000000_episode_0.mp4", "env_steps_00000040_episode_0.mp4"]
    assert {path.name for path in (tmp_path / "tensorboard").iterdir()} == {"train", "episodes", "eval"}
    assert list((tmp_path / "wandb").glob("offline-run-*/*.wandb"))


@pytest.mark.parametrize(("method", "capacity"), [("proto-rl-c", 100_000), ("atc", 40_000), ("own", 40_000)])
def test_a_run_keeps_as_many_transitions_as_the_method_of_its_encoder(method: str, capacity: int) -> None:
    pretrained = small_pretrained()
    pretrained.card["method"] = method
    assert _replay_capacity(pretrained, dataclasses.replace(SMALL, replay_capacity=None)) == capacity
    assert _replay_capacity(pretrained, SMALL) == SMALL.replay_capacity


def test_other_colours_reach_every_environment_the_card_and_what_must_agree(tmp_path: Path) -> None:
    asked = []

    def colored(task: str, **settings: object) -> EnvBase:
        asked.append(settings.get("colors"))
        return toy_env(task, **settings)  # type: ignore[arg-type]

    train(tmp_path / "normal", env_factory=colored)
    assert set(asked) == {None}  # a factory need not know of colours
    asked.clear()
    config = dataclasses.replace(SMALL, colors="reversed_image")
    train(tmp_path / "reversed", env_factory=colored, config=config)
    assert len(asked) > 1
    assert set(asked) == {"reversed_image"}
    _, card = load_agent(tmp_path / "reversed" / "agent")
    assert card["config"]["colors"] == "reversed_image"
    with pytest.raises(CheckpointError, match="colors was 'normal', now 'reversed_image'"):
        train(tmp_path / "normal", env_factory=toy_env, config=config)


def test_a_trimmed_artifact_gives_the_numbers_of_the_one_it_comes_from(tmp_path: Path) -> None:
    torch.manual_seed(0)
    encoder = PixelEncoder(channels=(4, 4), strides=(2, 1), image_size=16)
    loss = ProtoLoss(encoder, num_prototypes=8, latent_dim=4, hidden_dim=8)
    whole = load_pretrained(save_pretrained(loss, tmp_path / "whole"))
    trimmed = load_pretrained(trim_pretrained(whole, tmp_path / "trimmed"))
    results = {name: train(tmp_path / f"run_{name}", kind) for name, kind in (("a", whole), ("b", trimmed))}
    one, two = (rows_without_time(result.evaluations) for result in results.values())
    assert one == two
    tables = []
    for name in results:
        with open(tmp_path / f"run_{name}" / "train.csv", newline="") as file:
            rows = list(csv.DictReader(file))
        unmeasured = ("time", "_per_s", "bytes", "seconds")
        tables.append([{k: v for k, v in row.items() if not any(u in k for u in unmeasured)} for row in rows])
        assert float(rows[-1]["intrinsic_reward"]) > 0
    assert tables[0] == tables[1]
    cards = [load_agent(tmp_path / f"run_{name}" / "agent")[1]["pretrained"] for name in results]
    assert cards == [whole.identity()] * 2
