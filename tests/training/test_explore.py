"""Active pre-training: every exploring method, turns and schedules, resuming, refusals."""

from __future__ import annotations

import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torchrl.objectives import LossModule
from toy_env import ToyEnv, record
from toy_runs import EPISODE, kill, make_encoder, pretend_cpu, same_state, signalling, toy_domain

from crptpro.errors import CheckpointError, CRPTproError, EnvCrashedError
from crptpro.objectives import get_method
from crptpro.pretrained import load_pretrained, save_pretrained
from crptpro.training import ExploreConfig, ExploreResult, pretrain_active

SMALL = ExploreConfig(
    env_steps=112, batch_size=4, random_agent_steps=8, hidden_dim=16, queue_size=32, log_interval=4,
    checkpoint_interval_env_steps=32, precision="fp32",
)  # fmt: skip
LEFT, RIGHT = DOMAINS = [toy_domain("left"), toy_domain("right")]


def build(method: str) -> LossModule:
    torch.manual_seed(0)
    options: dict[str, Any] = {"hidden_dim": 16} if method == "becl" else {"latent_dim": 8}
    if method.startswith(("proto", "crptpro")):
        options |= {"num_prototypes": 8, "hidden_dim": 16}
    return get_method(method).build(make_encoder(9), **options)


def run(method: str, run_dir: Path | None = None, domains: Any = None, **options: Any) -> ExploreResult:
    loss = options.pop("loss", None) or build(method)
    domains = domains or (DOMAINS[:1] if method.endswith("-s") else DOMAINS)
    return pretrain_active(loss, domains, method=method, run_dir=run_dir, config=SMALL, progress=False, **options)


@pytest.mark.parametrize("method", ["proto-rl-c", "proto-rl-s", "apt-c", "apt-s", "becl"])
def test_every_method_explores_learns_and_resumes_as_if_uninterrupted(tmp_path: Path, method: str) -> None:
    whole, parts = run(method, tmp_path / "whole"), tmp_path / "parts"
    exploration: Any = get_method(method).exploration
    domains = 1 if method.endswith("-s") else 2
    assert whole.env_steps == 112
    assert whole.updates == domains * exploration.encoder_updates_each * (56 // domains - 8) // 2
    assert (whole.actor is not None) == (method == "proto-rl-s")
    assert (whole.queue is not None) == method.startswith("proto")

    stopping = [signalling("left", 15, signal.SIGINT), RIGHT][:domains]
    with pytest.raises(KeyboardInterrupt):
        run(method, parts, stopping)
    resumed = run(method, parts)
    assert resumed.resumed_from == (58 if domains == 2 else 30)
    assert same_state(resumed.loss, whole.loss)
    for name in ("pretrain.csv", "explore.csv", "episodes.csv"):
        assert record(parts / name) == record(tmp_path / "whole" / name), name
    artifact = load_pretrained(save_pretrained(resumed, tmp_path / "encoder"))
    assert (artifact.method, artifact.card["training"]["updates"]) == (method, whole.updates)
    assert (artifact.actor is not None) == (method == "proto-rl-s")

    facts = {row["domain"]: row["agent_steps"] for row in whole.training["datasets"]}
    assert facts == dict.fromkeys(("left", "right")[:domains], 56 // domains)
    rows = record(parts / "episodes.csv")
    assert [row["domain"] for row in rows] == (["left", "right"] * 2 if domains == 2 else ["left"] * 5)
    assert {row["episode_agent_steps"] for row in rows} == {str(EPISODE)}
    ends = [38, 40, 78, 80] if domains == 2 else [20, 40, 60, 80, 100]  # of all domains
    assert [int(row["env_steps"]) for row in rows] == ends
    assert f"loss_qvalue/{rows[-1]['domain']}" in record(parts / "explore.csv")[-1]


def test_a_killed_run_continues_with_the_same_command(tmp_path: Path) -> None:
    domains = "[toy_runs.signalling('left', 23, signal.SIGKILL), test_explore.RIGHT]"
    kill(f"import test_explore\ntest_explore.run('proto-rl-c', pathlib.Path({str(tmp_path / 'parts')!r}), {domains})")
    resumed, whole = run("proto-rl-c", tmp_path / "parts"), run("proto-rl-c", tmp_path / "whole")
    assert 0 < resumed.resumed_from < 112
    assert same_state(resumed.loss, whole.loss)
    assert record(tmp_path / "parts" / "pretrain.csv") == record(tmp_path / "whole" / "pretrain.csv")


def test_domains_whose_replays_would_be_one_directory_are_refused() -> None:
    with pytest.raises(CRPTproError, match="share a directory: my env, my-env"):
        run("apt-c", domains=[toy_domain("my env"), toy_domain("my-env")])


def returns(run_dir: Path) -> list[str]:
    return [row["episode_return"] for row in record(run_dir / "episodes.csv")]


class Paid(ToyEnv):
    """Its pictures do not show what it pays."""

    def _step(self, tensordict: Any) -> Any:
        found = super()._step(tensordict)
        return found.set("reward", 100 + 7 * found["reward"])


def test_an_explorer_learns_from_the_intrinsic_reward_alone_and_acts_by_it(tmp_path: Path) -> None:
    for method in ("apt-s", "proto-rl-s"):
        one = run(method, tmp_path / method, [toy_domain("left")])
        two = run(method, tmp_path / f"paid-{method}", [toy_domain("left", Paid)])
        assert same_state(one.loss, two.loss)
        assert record(tmp_path / method / "explore.csv") == record(tmp_path / f"paid-{method}" / "explore.csv")
        assert returns(tmp_path / method) != returns(tmp_path / f"paid-{method}")
    for width in (8, 16):  # other networks: the same random decisions, and others afterwards
        run("apt-s", tmp_path / f"{width}", [toy_domain("left")], hidden_dim=width, random_agent_steps=10)
    narrow, wide = returns(tmp_path / "8"), returns(tmp_path / "16")
    assert narrow[0] == wide[0]
    assert narrow[1:] != wide[1:]


def test_a_domains_agent_does_not_depend_on_its_company(tmp_path: Path) -> None:
    # Up to the first update on another domain's batch.
    alone = run("apt-c", tmp_path / "alone", [LEFT], env_steps=40, learning_rate=0.0)
    run("apt-c", tmp_path / "both", env_steps=80, learning_rate=0.0)
    assert alone.training["datasets"][0] == {
        "task": "left_go", "domain": "left", "camera": 0, "agent_steps": 20, "episodes": 2,
    }  # fmt: skip
    together = [row for row in record(tmp_path / "both" / "episodes.csv") if row["domain"] == "left"]
    apart = record(tmp_path / "alone" / "episodes.csv")
    assert [row["episode_return"] for row in apart] == [row["episode_return"] for row in together]


def test_a_domain_whose_name_is_no_path_is_explored_and_resumed(tmp_path: Path) -> None:
    run("apt-s", tmp_path, [toy_domain("a/b:c")], env_steps=20)
    assert (tmp_path / "replay" / "a-b-c").is_dir()
    assert run("apt-s", tmp_path, [toy_domain("a/b:c")], env_steps=20).training["datasets"][0]["domain"] == "a/b:c"


def test_a_run_that_was_killed_before_its_first_checkpoint_begins_again_in_the_space_that_it_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SystemExit):
        run("apt-s", tmp_path, [toy_domain("left", on_step=lambda count: count == 6 and sys.exit(1))])

    def held() -> int:
        return sum(file.stat().st_size for file in tmp_path.glob("replay/*/*"))

    usage, disk = shutil.disk_usage(tmp_path), int(1.9 * held())
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=disk - held()))
    assert run("apt-s", tmp_path, [LEFT]).env_steps == 112


def test_an_environment_that_crashes_while_its_episode_is_repeated_is_named(tmp_path: Path) -> None:
    def crash(count: int) -> None:
        raise ValueError("the simulator exploded")

    with pytest.raises(KeyboardInterrupt):
        run("apt-s", tmp_path, [signalling("left", 15, signal.SIGINT)])
    with pytest.raises(EnvCrashedError, match="the simulator exploded"):
        run("apt-s", tmp_path, [toy_domain("left", on_step=crash)])


def test_a_finished_run_gives_its_result_again_without_its_replays(tmp_path: Path) -> None:
    first = run("proto-rl-s", tmp_path)
    shutil.rmtree(tmp_path / "replay")
    again = run("proto-rl-s", tmp_path)
    assert same_state(again.loss, first.loss)
    assert torch.equal(again.queue, first.queue)
    assert not (tmp_path / "replay").exists()


def test_a_run_keeps_its_precision_on_another_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pretend_cpu("amx_bf16", monkeypatch, tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run("apt-s", tmp_path / "run", [signalling("left", 15, signal.SIGINT)], precision="auto")
    pretend_cpu("", monkeypatch, tmp_path)
    resumed = run("apt-s", tmp_path / "run", precision="auto")
    assert resumed.resumed_from
    assert resumed.training["settings"]["precision"] == "bf16"


def test_batches_too_small_for_the_prototypes_are_announced(caplog: pytest.LogCaptureFixture) -> None:
    run("proto-rl-s", batch_size=2)
    assert "8 prototypes draw their candidates from batches of 2" in caplog.text


def test_a_run_of_other_settings_is_refused_by_name(tmp_path: Path) -> None:
    run("apt-s", tmp_path, env_steps=20)
    with pytest.raises(CheckpointError, match="batch_size was 4, now 8"):
        run("apt-s", tmp_path, env_steps=20, batch_size=8)
    with pytest.raises(CheckpointError, match=r"domains\[0\]\.task was 'left_go', now 'left_run'"):
        run("apt-s", tmp_path, [replace(LEFT, task="left_run")], env_steps=20)
    again = run("apt-s", tmp_path, env_steps=20, log_interval=3)  # it decides no number
    assert again.env_steps == 20
    assert again.training["datasets"][0]["task"] == "left_go"


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("apt-s", {"domains": DOMAINS}, "apt-s pre-trains on one domain, got 2"),
        ("proto-rl-c", {"domains": [LEFT, LEFT]}, "named twice"),
        ("apt-s", {"domains": [toy_domain("my,env")]}, "cannot name columns"),
        ("proto-rl-c", {"env_steps": 10}, "nothing would be learned"),
        ("crptpro", {}, "learns from datasets and does not explore"),
        ("proto-rl-s", {"loss": "apt-s"}, "prototype reward needs a loss with prototypes; SimCLRLoss has none"),
    ],
)
def test_what_cannot_run_is_refused_before_anything_is_written(
    tmp_path: Path, method: str, options: dict[str, Any], message: str
) -> None:
    if "loss" in options:
        options = {"loss": build(options["loss"])}
    with pytest.raises(CRPTproError, match=message):
        run(method, tmp_path / "run", **options)
    assert not (tmp_path / "run").exists()
