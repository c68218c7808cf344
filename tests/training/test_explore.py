"""Active pre-training: every exploring method, turns and schedules, resuming, refusals."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torchrl.objectives import LossModule
from worlds import EPISODE, make_encoder, make_loss, make_toy_env, record, same_state

from crptpro.errors import CheckpointError, CRPTproError
from crptpro.objectives import get_method
from crptpro.pretrained import load_pretrained, save_pretrained
from crptpro.training import ExploreConfig, ExploreResult, pretrain_active

SMALL = ExploreConfig(
    env_steps=144,
    batch_size=4,
    random_agent_steps=8,
    hidden_dim=16,
    queue_size=32,
    log_interval=4,
    checkpoint_interval_env_steps=32,
    precision="fp32",
)
DOMAINS = ["left", "right"]


def build(method: str) -> LossModule:
    torch.manual_seed(0)
    options: dict[str, Any] = {"hidden_dim": 16} if method == "becl" else {"latent_dim": 8}
    if method.startswith("proto"):
        options |= {"num_prototypes": 8, "hidden_dim": 16}
    row = get_method(method)
    return row.build(make_encoder(9), **options)


def run(method: str, run_dir: Path | None = None, **options: Any) -> ExploreResult:
    domains = options.pop("domains", None) or (DOMAINS[:1] if method.endswith("-s") else DOMAINS)
    defaults: dict[str, Any] = {
        "config": SMALL,
        "env_factory": make_toy_env,
        "progress": False,
        "method": method,
    }
    return pretrain_active(
        options.pop("loss", None) or build(method), domains, run_dir=run_dir, **{**defaults, **options}
    )


@pytest.mark.parametrize("method", ["proto-rl-c", "proto-rl-s", "apt-c", "apt-s", "becl"])
def test_every_method_explores_learns_and_resumes_as_if_uninterrupted(tmp_path: Path, method: str) -> None:
    whole = run(method, tmp_path / "whole")
    exploration = get_method(method).exploration
    assert exploration is not None
    domains = 1 if method.endswith("-s") else 2
    decisions = 72 // domains
    assert whole.env_steps == 144
    assert whole.updates == domains * exploration.encoder_updates_each * (decisions - 8) // 2
    assert whole.actor is not None if method == "proto-rl-s" else whole.actor is None
    assert (whole.queue is not None) == method.startswith("proto")

    with pytest.raises(KeyboardInterrupt):
        run(method, tmp_path / "parts", env_factory=interrupting(30))
    resumed = run(method, tmp_path / "parts")
    assert 0 < resumed.resumed_from < 144
    assert same_state(resumed.loss, whole.loss)
    for name in ("pretrain.csv", "explore.csv", "episodes.csv"):
        assert record(tmp_path / "parts" / name) == record(tmp_path / "whole" / name), name
    artifact = load_pretrained(save_pretrained(resumed, tmp_path / "encoder"))
    assert (artifact.method, artifact.card["training"]["updates"]) == (method, whole.updates)
    assert (artifact.actor is not None) == (method == "proto-rl-s")


def interrupting(step: int) -> Any:
    """A factory of worlds, of which the first brings Ctrl-C with one of its steps."""
    steps = 0

    def make(task: str, **settings: Any) -> Any:
        env = make_toy_env(task, **settings)
        inner = env.base_env._step

        def count(td: Any) -> Any:
            nonlocal steps
            steps += 1
            if steps == step:
                os.kill(os.getpid(), signal.SIGINT)
            return inner(td)

        env.base_env._step = count
        return env

    return make


KILLED = """
import os, signal, sys
from pathlib import Path
import test_explore, worlds
steps = 0
def make(task, **settings):
    env = worlds.make_toy_env(task, **settings)
    step = env.base_env._step
    def count(td):
        global steps
        steps += 1
        if steps == 50:
            os.kill(os.getpid(), signal.SIGKILL)
        return step(td)
    env.base_env._step = count
    return env
test_explore.run("proto-rl-c", Path(sys.argv[1]), env_factory=make)
"""


def test_a_killed_run_continues_with_the_same_command(tmp_path: Path) -> None:
    path = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parents[1] / "data"), *sys.path])
    command = [sys.executable, "-c", KILLED, str(tmp_path / "parts")]
    killed = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    resumed, whole = run("proto-rl-c", tmp_path / "parts"), run("proto-rl-c", tmp_path / "whole")
    assert same_state(resumed.loss, whole.loss)
    assert record(tmp_path / "parts" / "pretrain.csv") == record(tmp_path / "whole" / "pretrain.csv")


def test_domains_take_turns_and_each_has_its_own_agent(tmp_path: Path) -> None:
    result = run("proto-rl-c", tmp_path)
    facts = {row["domain"]: row["agent_steps"] for row in result.training["datasets"]}
    assert facts == {"left": 36, "right": 36}
    rows = record(tmp_path / "episodes.csv")
    assert [row["domain"] for row in rows] == ["left", "right"] * 3
    assert {row["episode_agent_steps"] for row in rows} == {str(EPISODE)}
    columns = record(tmp_path / "explore.csv")[-1]
    for domain in DOMAINS:
        assert float(columns[f"intrinsic_reward/{domain}"]) >= 0
        assert f"loss_qvalue/{domain}" in columns


def test_the_agents_never_move_the_encoder() -> None:
    # Without an encoder update the loss stays as it was, whatever the agents learn.
    loss = build("proto-rl-c")
    before = {key: value.clone() for key, value in loss.state_dict().items() if "encoder" in key}
    result = run("proto-rl-c", loss=loss, learning_rate=0.0)
    moved = result.loss.state_dict()
    assert all(torch.equal(value, moved[key]) for key, value in before.items())


def test_a_domains_networks_do_not_depend_on_its_company() -> None:
    alone = run("proto-rl-c", domains=["left"], env_steps=40)
    with_another = run("proto-rl-c", env_steps=80)
    assert alone.training["datasets"][0] == with_another.training["datasets"][0]


def test_a_run_of_other_settings_is_refused_by_name(tmp_path: Path) -> None:
    run("proto-rl-c", tmp_path)
    with pytest.raises(CheckpointError, match="batch_size was 4, now 8"):
        run("proto-rl-c", tmp_path, batch_size=8)


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("apt-s", {"domains": DOMAINS}, "apt-s pre-trains on one domain, got 2"),
        ("proto-rl-c", {"domains": ["left", "left"]}, "named twice"),
        ("proto-rl-c", {"env_steps": 10}, "nothing would be learned"),
        ("proto-rl-c", {"domains": ["a/b"]}, "cannot name a directory"),
        ("crptpro", {}, "learns from datasets and does not explore"),
    ],
)
def test_what_cannot_run_is_refused_before_anything_is_written(
    tmp_path: Path, method: str, options: dict[str, Any], message: str
) -> None:
    loss = make_loss(channels=9)
    with pytest.raises(CRPTproError, match=message):
        run(method, tmp_path / "run", loss=loss, **options)
    assert not (tmp_path / "run").exists()


def test_a_world_that_fails_is_named(tmp_path: Path) -> None:
    def make(task: str, **settings: Any) -> Any:
        env = make_toy_env(task, **settings)
        if task == "right":
            env.base_env._step = lambda td: (_ for _ in ()).throw(RuntimeError("the motor burnt out"))
        return env

    with pytest.raises(
        CRPTproError, match=r"The world of right failed in episode 0, decision 0: .*motor burnt out"
    ):
        run("proto-rl-c", env_factory=make)
