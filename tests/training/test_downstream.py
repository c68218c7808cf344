"""Learning a task on a frozen encoder: evaluations, resuming, features, the bonus, refusals."""

from __future__ import annotations

import copy
import dataclasses
import functools
import gc
import itertools
import signal
import threading
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from toy_env import ToyEnv, record
from toy_runs import (
    EPISODE,
    SIZE,
    SmoothToyEnv,
    kill,
    make_dataset,
    make_encoder,
    make_pretrained,
    pretend_cpu,
    same_state,
    signalling,
    toy_domain,
)

from crptpro.domains import Domain
from crptpro.errors import CheckpointError, CRPTproError, EnvCrashedError, PretrainedError
from crptpro.modules import SquashedGaussianActor
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import Pretrained, load_pretrained, save_pretrained
from crptpro.training import (
    DownstreamConfig,
    DownstreamResult,
    PixelAgent,
    downstream,
    load_agent,
    pretrain,
    train_downstream,
)
from crptpro.training.agent import save_agent
from crptpro.training.downstream import most_observations

SMALL = DownstreamConfig(
    env_steps=120, batch_size=8, replay_capacity=40, random_agent_steps=12, queue_size=16, hidden_dim=16,
    eval_interval_env_steps=40, eval_episodes=2, checkpoint_interval_env_steps=20, log_interval_env_steps=20,
    precision="fp32", eval_workers=0,
)  # fmt: skip
TOY = toy_domain("toy")


def train(run_dir: Path | None, pretrained: Any = None, task: Any = TOY, **options: Any) -> DownstreamResult:
    artifact = pretrained or make_pretrained()
    return train_downstream(task, artifact, run_dir=run_dir, config=SMALL, progress=False, **options)


def train_until_killed(run_dir: Path, step: int) -> None:
    task = f"toy_runs.signalling('toy', {step}, signal.SIGKILL)"
    kill(f"import test_downstream\ntest_downstream.train(pathlib.Path({str(run_dir)!r}), task={task})")


def same_actor(one: DownstreamResult, two: DownstreamResult) -> bool:
    return same_state(one.agent.actor, two.agent.actor)


def loads(result: DownstreamResult) -> bool:
    """Whether the agent that was saved acts as the one that was trained."""
    agent, _ = load_agent(result.agent_path)
    pixels = torch.randint(0, 256, (9, SIZE, SIZE), dtype=torch.uint8)
    return torch.equal(agent(pixels), result.agent(pixels))


def losses(run_dir: Path) -> Tensor:
    return torch.tensor([float(row["loss_qvalue"]) for row in record(run_dir / "train.csv")])


def test_a_run_evaluates_at_every_interval_and_at_both_ends(tmp_path: Path) -> None:
    result = train(tmp_path)
    assert result.env_steps == 120
    assert [row["env_steps"] for row in result.evaluations] == [0, 0, 40, 40, 80, 80, 120, 120]
    assert {row["episode"] for row in result.evaluations} == {0, 1}
    assert {row["method"] for row in result.evaluations} == {"crptpro"}
    assert result.evaluations[-1]["updates"] == 60 - 12
    assert len(record(tmp_path / "eval.csv")) == 8
    assert [row["episode_agent_steps"] for row in record(tmp_path / "episodes.csv")] == [str(EPISODE)] * 6
    assert loads(result)
    _, card = load_agent(tmp_path / "agent")
    assert (card["task"], card["env_steps"], card["seed"]) == ("toy_go", 120, 0)


@pytest.mark.parametrize("method", ["crptpro", "drq"])
def test_only_drq_trains_the_encoder_and_the_one_given_stays_as_it_was(tmp_path: Path, method: str) -> None:
    pretrained = make_pretrained(method)
    before = copy.deepcopy(pretrained.encoder)
    result = train(tmp_path, pretrained, env_steps=40)
    assert same_state(pretrained.encoder, before)
    assert same_state(result.agent.encoder, before) == (method == "crptpro")
    assert loads(result)


@pytest.mark.parametrize("settings", [{}, {"features": "reencode"}, {"features": "dense-bf16"}, {"method": "drq"}])
def test_a_resumed_run_gives_the_numbers_of_an_uninterrupted_one(tmp_path: Path, settings: dict[str, Any]) -> None:
    options, parts = dict(settings), tmp_path / "parts"
    pretrained = make_pretrained(options.pop("method", "crptpro"))
    whole = train(tmp_path / "whole", pretrained, **options)
    train(parts, pretrained, **options, env_steps=60)
    for _ in range(2):  # the second finds it complete
        resumed = train(parts, pretrained, **options)
        assert same_actor(resumed, whole)
        rows = [row for row in record(parts / "eval.csv") if row["env_steps"] != "60"]
        assert rows == record(tmp_path / "whole" / "eval.csv")
        assert record(parts / "train.csv") == record(tmp_path / "whole" / "train.csv")


def test_a_killed_run_continues_with_the_same_command(tmp_path: Path) -> None:
    train_until_killed(tmp_path / "parts", 77)
    assert same_actor(train(tmp_path / "parts"), train(tmp_path / "whole"))
    for name in ("eval.csv", "train.csv", "episodes.csv"):
        assert record(tmp_path / "parts" / name) == record(tmp_path / "whole" / name)


def test_a_kill_during_the_last_evaluation_repeats_that_evaluation_alone(tmp_path: Path) -> None:
    # Two episodes of ten agent steps evaluate at 0, 40, 80 and 120 env steps; 60 agent steps train.
    train_until_killed(tmp_path, 125)
    steps: list[int] = []
    assert train(tmp_path, task=toy_domain("toy", on_step=steps.append)).evaluations[-1]["env_steps"] == 120
    assert len(steps) == 2 * EPISODE


@pytest.mark.parametrize("control", ["random-encoder", "drq"])
def test_a_control_continues_where_its_weights_are_drawn_with_another_rounding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, control: str
) -> None:
    def drawn(seed: int, *, method: str) -> Pretrained:
        pretrained = make_pretrained(method)
        with torch.no_grad():
            pretrained.encoder.convs[0].weight[0, 0, 0, 0] += 1e-7 * len(calls)
        calls.append(seed)
        return Pretrained(pretrained.encoder, card=pretrained.card)

    calls: list[int] = []
    monkeypatch.setattr(downstream, "random_pretrained", drawn)
    first, second = (train(tmp_path, control, env_steps=env_steps) for env_steps in (40, 60))
    assert (first.env_steps, second.env_steps) == (40, 60)
    assert same_state(first.agent.encoder, second.agent.encoder) == (control == "random-encoder")
    with pytest.raises(CheckpointError, match="seed was 0, now 1"):
        train(tmp_path, control, seed=1)


def test_what_the_last_line_would_refuse_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    train(tmp_path, env_steps=40)
    (tmp_path / "agent" / "episode.mp4").touch()
    with pytest.raises(CRPTproError, match=r"holds episode\.mp4 beside the 'crptpro-agent'"):
        train(tmp_path)
    assert {row["env_steps"] for row in record(tmp_path / "eval.csv")} == {"0", "40"}
    with pytest.raises(ValueError, match="PixelEncoder"):
        train(tmp_path / "new", Pretrained(OwnEncoder()), features="dense", intrinsic_reward_coef=0.0)
    assert not (tmp_path / "new").exists()


def test_both_checkpoints_can_be_restored_where_every_episode_has_one_transition(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(downstream, "SPARE_FRAMES", 20)
    monkeypatch.setattr(downstream, "LONGEST_EPISODE_AGENT_STEPS", 10)
    steps = itertools.count(1)
    make = functools.partial(make_short, lambda _: next(steps) == 396 and 1 / 0)
    domain = Domain("short", "short_go", make=make, action_repeat=1)
    settings = {
        "env_steps": 500, "checkpoint_interval_env_steps": 100, "eval_interval_env_steps": 1_000, "eval_episodes": 1,
    }  # fmt: skip
    with pytest.raises(EnvCrashedError):
        train(tmp_path, task=domain, **settings)
    *_, newest = sorted((tmp_path / "checkpoints").iterdir())
    newest.write_bytes(newest.read_bytes()[:-100])
    assert train(tmp_path, task=domain, **settings).env_steps == 500


def make_short(on_step: Any, *, seed: int, image_size: int) -> ToyEnv:
    return ToyEnv(lambda seed: 1, seed=seed, image_size=image_size, on_step=on_step)


def test_an_episode_that_the_budget_cuts_is_not_recorded_as_one(tmp_path: Path) -> None:
    train(tmp_path, env_steps=50)
    assert [row["episode_agent_steps"] for row in record(tmp_path / "episodes.csv")] == [str(EPISODE)] * 2


@pytest.mark.parametrize(("task", "most"), [
    ("walker_walk", 10_000 + 20 + 200), ("reach_duplo", 10_000 + 80 + 200), ("lqr_2_1", 20_000), (TOY, 20_000),
])  # fmt: skip
def test_dense_maps_are_for_as_many_observations_as_a_budget_can_store(task: Any, most: int) -> None:
    assert most_observations(task, 20_000, 2) == most


def test_a_run_that_ends_before_its_first_update_is_announced(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", logger="crptpro"):
        assert train(tmp_path, env_steps=20).evaluations[-1]["updates"] == 0
    assert "20 env steps end before the first update, which comes after 12 agent steps of 2 env" in caplog.text
    assert f"GB in {tmp_path / 'replay'}; it is kept" in caplog.text


def test_a_budget_that_the_action_repeat_does_not_divide_is_rounded_up_and_can_be_asked_for_again(
    tmp_path: Path,
) -> None:
    first = train(tmp_path, env_steps=41)
    assert first.env_steps == 42
    again = train(tmp_path, env_steps=41)
    assert (again.env_steps, again.evaluations) == (42, first.evaluations)


def test_a_run_that_has_ended_keeps_no_dense_maps() -> None:
    gc.collect()
    gc.disable()
    try:
        result = train(None, env_steps=40, features="dense")
        maps = [each for each in gc.get_objects() if type(each) is Tensor and each.ndim == 5]
    finally:
        gc.enable()
    assert result.env_steps == 40
    assert maps == []


def test_an_agent_acts_in_the_precision_that_auto_meant_where_it_was_trained(tmp_path: Path) -> None:
    agent = train(None, env_steps=20).agent
    save_agent(tmp_path / "agent", agent, card={"precision": "bf16", "config": {"precision": "auto"}})
    assert load_agent(tmp_path / "agent")[0].encoder.compute_dtype == torch.bfloat16


def test_dense_maps_and_encoding_anew_are_the_same_run_up_to_rounding(tmp_path: Path) -> None:
    short: dict[str, Any] = {"task": toy_domain("smooth", SmoothToyEnv), "env_steps": 80, "eval_episodes": 1}
    for features in ("dense", "reencode", "dense-bf16"):
        train(tmp_path / features, features=features, **short)
    train(tmp_path / "other", seed=1, **short)
    other = (losses(tmp_path / "other") - losses(tmp_path / "reencode")).abs().mean()
    for features, share in (("dense", 1e-3), ("dense-bf16", 0.1)):
        difference = (losses(tmp_path / features) - losses(tmp_path / "reencode")).abs().mean()
        assert difference < share * other, features


def test_the_environment_computes_on_one_core_beside_the_update(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("crptpro.training.env_thread.cpu_cores", lambda: 2)
    found = set()
    task = toy_domain("toy", on_step=lambda _: found.add((threading.current_thread().name, torch.get_num_threads())))
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        train(None, task=task, env_steps=20, eval_interval_env_steps=20)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert found == {("environment_0", 1), ("MainThread", 1)}  # the latter evaluates


def test_workers_of_their_own_evaluate_the_same_episodes(tmp_path: Path) -> None:
    here = train(tmp_path / "here", env_steps=60)
    beside = train(tmp_path / "beside", env_steps=60, eval_workers=2)
    assert record(tmp_path / "here" / "eval.csv") == record(tmp_path / "beside" / "eval.csv")
    assert same_actor(here, beside)


def test_the_bonus_is_added_where_there_are_prototypes_and_a_coefficient(caplog: pytest.LogCaptureFixture) -> None:
    bonus, none = train(None, env_steps=40), train(None, env_steps=40, intrinsic_reward_coef=0)
    assert not same_actor(bonus, none)
    encoder_only = dataclasses.replace(make_pretrained(), projector=None, prototypes=None)
    with caplog.at_level("INFO", logger="crptpro"):
        assert same_actor(train(None, encoder_only, env_steps=40), none)
    assert "no exploration bonus" in caplog.text


def test_an_actor_that_explored_the_task_is_where_learning_begins(tmp_path: Path) -> None:
    torch.manual_seed(1)
    actor = SquashedGaussianActor(make_encoder(9).feature_dim, 2, hidden_dim=16)
    with_actor = dataclasses.replace(make_pretrained(), actor=actor)
    begun = train(tmp_path / "explored", with_actor, env_steps=20)
    assert same_state(begun.agent.actor, actor)
    # It acts from the first decision on, where others act at random until the first update.
    train(tmp_path / "random", env_steps=20)
    explored, random = (record(tmp_path / name / "episodes.csv")[0] for name in ("explored", "random"))
    assert explored["episode_return"] != random["episode_return"]
    with_actor.card["training"] = {"datasets": [{"domain": "elsewhere"}]}
    assert not same_state(train(None, with_actor, env_steps=20).agent.actor, actor)
    with_actor.card["training"]["datasets"] += [{"domain": "toy"}]
    assert same_state(train(None, with_actor, env_steps=20).agent.actor, actor)


def test_an_agent_acts_in_evaluation_mode_and_leaves_the_training_of_its_encoder_alone() -> None:
    encoder = nn.Sequential(nn.BatchNorm2d(9), nn.Flatten())
    actor = SquashedGaussianActor(9 * SIZE * SIZE, 2, hidden_dim=16)
    PixelAgent(encoder, actor)(torch.randint(0, 256, (9, SIZE, SIZE)).float())
    assert encoder.training
    assert not encoder[0].running_mean.any()


class OwnEncoder(nn.Module):
    """Any module that maps pixels to features."""

    def __init__(self) -> None:
        super().__init__()
        self.feature_dim, self.image_size, self.in_channels = 12, SIZE, 9
        self.config: dict[str, Any] = {}
        self.layers = nn.Sequential(nn.Conv2d(9, 3, 8, 8), nn.Flatten())

    def forward(self, pixels: Tensor) -> Tensor:
        return self.layers(pixels.float() / 255)


def test_any_module_is_trained_saved_loaded_and_serves_as_a_frozen_encoder_that_is_encoded_anew(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    loss = ProtoLoss(OwnEncoder(), num_prototypes=8, latent_dim=4, hidden_dim=8)
    trained = pretrain(loss, make_dataset(0, channels=9), updates=2, batch_size=4, progress=False)
    path = save_pretrained(trained, tmp_path / "encoder")
    own = load_pretrained(path)
    with caplog.at_level("INFO", logger="crptpro"):
        result = train(tmp_path, own, env_steps=40)
    assert result.evaluations[-1]["updates"] == 8
    assert "re-encoding" in caplog.text
    assert loads(result)
    own.encoder.config = {"width": 3}
    with pytest.raises(PretrainedError, match=r"does not describe a OwnEncoder: .*unexpected keyword argument 'width'"):
        train(tmp_path / "other", own)
    del own.encoder.config
    with pytest.raises(PretrainedError, match=r"OwnEncoder without a `\.config`"):
        train(tmp_path / "other", own)
    assert not (tmp_path / "other").exists()
    assert train(None, own, env_steps=20).env_steps == 20


def test_what_does_not_fit_a_run_is_refused_by_name(tmp_path: Path) -> None:
    train(tmp_path, env_steps=40)
    with pytest.raises(CheckpointError, match="batch_size was 8, now 4"):
        train(tmp_path, batch_size=4)
    with pytest.raises(CheckpointError, match="cuda_graph was False, now True"):
        train(tmp_path, cuda_graph=True)
    with pytest.raises(ValueError, match="`cuda_graph` needs a GPU, but `device` is 'cpu'"):
        train(tmp_path / "new", cuda_graph=True)
    with pytest.raises(CheckpointError, match="camera was 0, now 1; domain was 'toy', now 'toy_back'"):
        train(tmp_path, task=dataclasses.replace(TOY, name="toy_back", camera=1))
    assert not (tmp_path / "new" / "episodes.csv").exists()
    with pytest.raises(CheckpointError, match="pretrained was"):
        train(tmp_path, make_pretrained("proto-rl-c"))
    with pytest.raises(PretrainedError, match=r"A Flatten is not a saved encoder: pass what save_pretrained"):
        train(None, nn.Flatten())
    with pytest.raises(PretrainedError, match="cannot be built in another process"):
        train(None, task=signalling("toy", -1, signal.SIGTERM), eval_workers=2)
    for name, value in (("intrinsic_reward_coef", 0.1), ("features", "dense")):
        with pytest.raises(ValueError, match="drq trains its encoder: it has no bonus"):
            train(None, make_pretrained("drq"), **{name: value})
    for options in ({"queue_size": 7}, {"knn_k": 100}):
        with pytest.raises(ValueError, match=next(iter(options))):
            train(tmp_path / "new", **options)
    assert not (tmp_path / "new" / "replay").exists()
    (tmp_path / "replay").rename(tmp_path / "elsewhere")
    with pytest.raises(CheckpointError, match=r"to continue it needs its frames, and .* is gone"):
        train(tmp_path)
    train(tmp_path, env_steps=40)  # complete: nothing is needed


@pytest.mark.parametrize(
    ("methods", "own"),
    [
        (["crptpro"], {"env_steps": 500_000, "replay_capacity": 40_000, "learning_rate": 1e-4, "action_repeat": 2}),
        (["crptpro", "proto-rl-c", "proto-rl-s"], {"intrinsic_reward_coef": 0.2}),
        (["proto-rl-c", "proto-rl-s"], {"replay_capacity": 100_000}),
        (["atc", "apt-c", "becl", "random-encoder", "crptpro-no-bonus"], {"intrinsic_reward_coef": 0.0}),
        (["drq"], {"env_steps": 1_000_000, "replay_capacity": 100_000, "learning_rate": 1e-3}),
    ],
)
def test_what_is_left_open_is_the_methods_own(methods: list[str], own: dict[str, Any]) -> None:
    for method in methods:
        resolved = dataclasses.asdict(DownstreamConfig().resolved("walker_run", make_pretrained(method)))
        assert resolved == {**resolved, **own}
    assert DownstreamConfig(env_steps=10).resolved("walker_run", make_pretrained("drq")).env_steps == 10


def test_candidates_that_the_artifact_brings_set_the_length_of_the_queue() -> None:
    pretrained = make_pretrained("proto-rl-s")
    assert DownstreamConfig().resolved("walker_run", pretrained).queue_size == 2_048
    pretrained.queue = torch.rand(16, 4)
    assert DownstreamConfig().resolved("walker_run", pretrained).queue_size == 16
    train(None, pretrained, env_steps=40)


def test_a_run_keeps_its_precision_and_features_on_another_machine_unless_its_maps_no_longer_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def continued(env_steps: int, **options: Any) -> tuple[str, str]:
        result = train(tmp_path / "run", env_steps=env_steps, **{"precision": "auto", "features": "auto"} | options)
        _, card = load_agent(result.agent_path)
        return card["precision"], card["features"]

    pretend_cpu("amx_bf16", monkeypatch, tmp_path)
    continued(40)
    pretend_cpu("", monkeypatch, tmp_path)
    assert continued(60) == ("bf16", "dense")
    monkeypatch.setattr("crptpro.training.downstream.free_bytes", lambda device: 0)
    with pytest.raises(CRPTproError, match=r"dense maps do not fit in memory: .*can be continued"):
        continued(80, features="dense")
    assert continued(80) == ("bf16", "reencode")
    assert "re-encoding at every update: too little memory for dense maps" in caplog.text
    monkeypatch.undo()
    assert continued(100) == ("bf16", "reencode")
    assert continued(120, features="dense") == ("bf16", "dense")


def test_batches_too_small_for_the_prototypes_are_announced(caplog: pytest.LogCaptureFixture) -> None:
    train(None, batch_size=2, env_steps=40)
    assert "8 prototypes draw their candidates from batches of 2" in caplog.text


def test_a_run_that_begins_removes_no_file_of_anybody_else(tmp_path: Path) -> None:
    (tmp_path / "replay").mkdir()
    (tmp_path / "replay" / "mine.txt").touch()
    train(tmp_path, env_steps=40)
    assert (tmp_path / "replay" / "mine.txt").exists()


def returns(run_dir: Path) -> list[str]:
    return [row["episode_return"] for row in record(run_dir / "episodes.csv")]


def test_an_agent_acts_by_its_policy_after_the_random_decisions(tmp_path: Path) -> None:
    for rate in (1e-4, 1e-1):
        train(tmp_path / f"{rate}", learning_rate=rate, env_steps=80)
    slow, fast = (returns(tmp_path / f"{rate}") for rate in (1e-4, 1e-1))
    assert slow[0] == fast[0]  # ten of the twelve random decisions
    assert slow[2:] != fast[2:]


CHANGED = {
    "discount": 0.5,
    "initial_temperature": 1.0,
    "critic_tau": 0.9,
    "learning_rate": 1e-2,
    "knn_k": 2,
    "queue_size": 8,
    "intrinsic_reward_coef": 0.7,
    "batch_size": 4,
    "hidden_dim": 8,
    "random_agent_steps": 14,
    "replay_capacity": 20,
    "action_repeat": 4,
    "colors": "reversed_image",
    "seed": 1,
}


@pytest.fixture(scope="module")
def usual() -> Any:
    return train(None, env_steps=80, eval_interval_env_steps=80).agent.actor.state_dict()


@pytest.mark.parametrize("name", CHANGED)
def test_a_setting_reaches_the_run(usual: Any, name: str) -> None:
    found = train(None, env_steps=80, eval_interval_env_steps=80, **{name: CHANGED[name]}).agent.actor.state_dict()
    assert not all(a.shape == b.shape and torch.equal(a, b) for a, b in zip(found.values(), usual.values()))
