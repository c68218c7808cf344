"""Every method of the comparison through the whole of its recipe: killed on its way, started again, evaluated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from recipe_process import SHORT_TASK, free_replays, kill_recipe, records, rows, run_recipe

from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss, methods
from crptpro.pretrained import load_pretrained, save_pretrained
from crptpro.training import load_agent

Flags = tuple[object, ...]

LEARNING: Flags = (
    "env-steps", 100, "random-agent-steps", 20, "batch-size", 4, "replay-capacity", 60, "hidden-dim", 16,
    "eval-episodes", 1, "checkpoint-interval-env-steps", 50, "log-interval-env-steps", 10,
)  # fmt: skip
EXPLORING: Flags = (
    "env-steps", 120, "random-agent-steps", 8, "hidden-dim", 16, "checkpoint-interval-env-steps", 30,
    "queue-size", 32, "quality", "fast",
)  # fmt: skip
CHECKPOINT = "checkpoints/checkpoint-*.pt"


def under(prefix: str, settings: Flags) -> Flags:
    """Settings as flags of one part of a recipe."""
    return tuple(f"--{prefix}.{part}" if index % 2 == 0 else part for index, part in enumerate(settings))


DOWNSTREAM = (*under("downstream", LEARNING), "--tasks", SHORT_TASK)
EXPLORE = (*DOWNSTREAM, *under("explore", EXPLORING), "--pretrain-batch-size", 4)
COLLECT = ("--transitions", 12, "--workers", 1, "--quality", "fast")
PROTOTYPES = ("--num-prototypes", 16, "--latent-dim", 8, "--hidden-dim", 16)
QUEUE = ("--downstream.queue-size", 32)


@dataclass(frozen=True)
class Way:
    """A method's way from nothing to an evaluation.

    Attributes:
        recipe: file.
        flags: that make it tiny.
        killed_at: what is below OUT when it is killed.
        encoder: run directory of the pre-training.
        updates: of the encoder, as the artifact's card says.
        run: run directory of the task.
    """

    recipe: str
    flags: Flags
    killed_at: str
    run: str
    encoder: str | None = None
    updates: int = 0


def active(recipe: str, encoder: str, updates: int, *flags: object) -> Way:
    run = f"{SHORT_TASK}_{encoder}"
    return Way(recipe, (*EXPLORE, *flags), f"{encoder}/{CHECKPOINT}", run, encoder, updates)


# 120 env steps over a group of three domains are 20 decisions in each, of which 12 after the random ones: the encoder
# learns 6 times in each. In one domain they are 60 decisions: 26 times.
WAYS = {
    "crptpro": Way(
        "crptpro",
        (*COLLECT, *DOWNSTREAM, *QUEUE, *PROTOTYPES, "--group", "D", "--updates", 4, "--pretrain-batch-size", 4),
        "group_D_seed_0",
        f"{SHORT_TASK}_group_D_seed_0",
        "group_D_seed_0",
        4,
    ),
    "crptpro-finetune": Way(
        "finetune",
        (*COLLECT, *DOWNSTREAM[:-2], *QUEUE, "--domain", SHORT_TASK, "--updates", 3, "--batch-size", 4),
        "data/*",
        SHORT_TASK,
        f"finetune_{SHORT_TASK}",
        3,
    ),
    "atc": Way(
        "atc",
        (*COLLECT, *DOWNSTREAM, "--group", "D", "--updates", 4, "--pretrain-batch-size", 4, "--latent-dim", 8),
        "data/*",
        f"{SHORT_TASK}_atc_group_D_seed_0",
        "atc_group_D_seed_0",
        4,
    ),
    "apt-c": active("apt", "apt-c_group_D_seed_0", 18, "--group", "D", "--latent-dim", 8),
    "apt-s": active("apt", "apt-s_pendulum_seed_0", 26, "--variant", "s", "--domain", "pendulum"),
    "proto-rl-c": active("proto_rl", "proto-rl-c_group_D_seed_0", 18, "--group", "D", *PROTOTYPES, *QUEUE),
    "proto-rl-s": active(
        "proto_rl", f"proto-rl-s_{SHORT_TASK}_seed_0", 26, "--variant", "s", "--domain", SHORT_TASK, *PROTOTYPES,
        *QUEUE, "--intr-loss-coef", 5e-3,
    ),
    "becl": active(
        "becl", "becl_group_D_seed_0", 54, "--group", "D", "--hidden-dim", 16, "--downstream.algorithm", "skill-ddpg"
    ),
    "drq": Way(
        "drq",
        (*under("drq", LEARNING), "--tasks", SHORT_TASK, "--quality", "fast"),
        f"{SHORT_TASK}_drq_seed_0/{CHECKPOINT}",
        f"{SHORT_TASK}_drq_seed_0",
    ),
    "random-encoder": Way(
        "crptpro",
        ("--pretrained", "random-encoder", *DOWNSTREAM, "--quality", "fast"),
        f"{SHORT_TASK}_random-encoder_seed_0/{CHECKPOINT}",
        f"{SHORT_TASK}_random-encoder_seed_0",
    ),
}  # fmt: skip


def test_no_method_is_left_out() -> None:
    assert set(WAYS) == {*methods(), "crptpro-finetune", "drq", "random-encoder"}


@pytest.fixture
def source(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    loss = ProtoLoss(PixelEncoder(), num_prototypes=16, latent_dim=8, hidden_dim=16)
    return save_pretrained(loss, tmp_path / "source")


@pytest.fixture
def out(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path / "out"
    free_replays(tmp_path)


@pytest.mark.gl
@pytest.mark.slow
@pytest.mark.parametrize("method", WAYS)
def test_a_recipe_that_was_killed_ends_in_evaluations(
    method: str, out: Path, request: pytest.FixtureRequest
) -> None:
    way = WAYS[method]
    flags = way.flags
    if method == "crptpro-finetune":
        flags = (request.getfixturevalue("source"), *flags)
    kill_recipe(out, way.killed_at, way.recipe, *flags)
    assert not (out / way.run / "agent").exists()
    said = run_recipe(way.recipe, "--out", out, *flags).stderr
    if way.killed_at.endswith(CHECKPOINT):
        assert "continu" in said

    evaluations = rows(out / way.run / "eval.csv")
    assert [row["env_steps"] for row in evaluations] == ["0", "100"]
    assert {row["method"] for row in evaluations} == {method}
    _, card = load_agent(out / way.run / "agent")
    assert card["task"] == SHORT_TASK
    if way.encoder is not None:
        pretrained = load_pretrained(out / way.encoder / "encoder")
        assert pretrained.label == method
        assert pretrained.card["training"]["updates"] == way.updates
        assert card["pretrained"] == pretrained.identity()
    training = rows(out / way.run / "train.csv")
    assert all("intrinsic_reward" in row for row in training) == (method.startswith(("crptpro", "proto-rl")))
    CHECKS.get(method, lambda *_: None)(out, said)


def _one_encoder_of_the_group(out: Path, said: str) -> None:
    assert sorted(path.name for path in (out / "data").iterdir()) == ["hopper", "pendulum", "walker"]
    facts = load_pretrained(out / "group_D_seed_0" / "encoder").card["training"]["datasets"]
    assert [fact["domain"] for fact in facts] == ["walker", "pendulum", "hopper"]
    _finished_is_found_again("crptpro", out)


def _moved_to_one_domain(out: Path, said: str) -> None:
    before = load_pretrained(out.parent / "source")
    after = load_pretrained(out / f"finetune_{SHORT_TASK}" / "encoder")
    assert after.card["training"]["started_from"] == before.identity()
    states = [pretrained.encoder.state_dict() for pretrained in (before, after)]
    assert any(not torch.equal(states[0][key], states[1][key]) for key in states[0])


def _hands_its_actor_over(out: Path, said: str) -> None:
    assert f"goes on from the one that explored {SHORT_TASK}" in said
    pretrained = load_pretrained(out / f"proto-rl-s_{SHORT_TASK}_seed_0" / "encoder")
    assert pretrained.actor is not None
    assert pretrained.card["loss"]["config"]["intr_loss_coef"] == pytest.approx(5e-3)
    _finished_is_found_again("proto-rl-s", out)


def _acts_with_a_skill(out: Path, said: str) -> None:
    _, card = load_agent(out / WAYS["becl"].run / "agent")
    assert card["config"]["algorithm"] == "skill-ddpg"
    load_pretrained(out / "becl_group_D_seed_0" / "encoder", expect={"pixel_offset": 0.5})


def _trains_its_encoder(out: Path, said: str) -> None:
    agent, card = load_agent(out / WAYS["drq"].run / "agent")
    assert card["pretrained"] is None
    assert agent.actor.config["has_tanh"]


CHECKS = {
    "crptpro": _one_encoder_of_the_group,
    "crptpro-finetune": _moved_to_one_domain,
    "proto-rl-s": _hands_its_actor_over,
    "becl": _acts_with_a_skill,
    "drq": _trains_its_encoder,
}


def _finished_is_found_again(method: str, out: Path) -> None:
    before = records(out)
    run_recipe(WAYS[method].recipe, "--out", out, *WAYS[method].flags)
    assert records(out) == before
