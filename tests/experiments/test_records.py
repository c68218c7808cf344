from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest

from crptpro.downstream_config import DownstreamConfig
from crptpro.errors import RecordError
from crptpro.experiments.records import find_runs, read_run
from crptpro.loggers import RunLogger

IDENTITY = "crptpro:" + "a" * 64


def write_run(
    directory: Path,
    *,
    method: str = "crptpro",
    task: str = "walker_run",
    seed: int = 0,
    reached: int = 1000,
    encoder: str | None = IDENTITY,
    algorithm: str = "rad-sac",
    is_nested: bool = False,
    pretrained: str = "gone",
    base: float = 0.0,
) -> Path:
    """A run as the training loop leaves it: evaluations of two episodes every 500 of 1,000 env steps."""
    settings = {"algorithm": algorithm, "seed": seed, "env_steps": 1000, "eval_episodes": 2}
    config = {"task": task, **settings}
    if is_nested:
        config = {"task": task, "pretrained": pretrained, "config": settings}
    with RunLogger(directory, config=config) as records:
        for env_steps in range(0, reached + 1, 500):
            for episode in range(2):
                row = {"episode_return": base + env_steps + episode, "episode_agent_steps": 500}
                row |= {"seed": 7 + episode, "method": method}
                records.log(
                    row,
                    stream="eval",
                    episode=episode,
                    env_steps=env_steps,
                    agent_steps=env_steps // 2,
                    updates=0,
                )
    if encoder is not None or algorithm == "drq":
        (directory / "agent").mkdir()
        (directory / "agent" / "card.json").write_text(json.dumps({"pretrained": encoder}))
    return directory


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_a_run_is_read_back_as_it_was_logged(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path / "run", seed=3))
    assert (run.method, run.task, run.seed, run.encoder) == ("crptpro", "walker_run", 3, IDENTITY)
    assert (run.env_steps, run.is_finished, run.trains_encoder) == (1000, True, False)
    assert [(e.env_steps, e.episode, e.episode_return, e.seed) for e in run.episodes] == [
        (0, 0, 0.0, 7), (0, 1, 1.0, 8), (500, 0, 500.0, 7), (500, 1, 501.0, 8), (1000, 0, 1000.0, 7),
        (1000, 1, 1001.0, 8),
    ]  # fmt: skip
    assert run.episodes[-1].agent_steps == 500
    assert run.episodes[0].unix_time_s > 1.7e9
    assert run.final_score == 1000.5
    assert run.last_score(2) == 750.5
    assert "versions" in run.config


def test_settings_of_the_command_line_and_of_a_program_are_both_understood(tmp_path: Path) -> None:
    plain = read_run(write_run(tmp_path / "plain", seed=4))
    nested = read_run(write_run(tmp_path / "nested", seed=4, is_nested=True))
    assert (plain.task, plain.seed, plain.env_steps) == (nested.task, nested.seed, nested.env_steps)


def test_the_settings_that_are_read_are_settings_of_the_stage() -> None:
    assert {"algorithm", "seed", "env_steps", "eval_episodes"} <= set(DownstreamConfig.__dataclass_fields__)


def test_runs_are_found_at_any_depth_once_and_sorted(tmp_path: Path) -> None:
    write_run(tmp_path / "a" / "deep" / "z", method="atc")
    write_run(tmp_path / "b", method="crptpro", seed=1)
    write_run(tmp_path / "c", method="crptpro", seed=0)
    found = find_runs(tmp_path, tmp_path / "a")
    assert [(run.method, run.seed) for run in found] == [("atc", 0), ("crptpro", 0), ("crptpro", 1)]
    with pytest.raises(RecordError, match="no directory"):
        find_runs(tmp_path / "nowhere")


def test_other_stages_are_passed_over_in_silence(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with RunLogger(tmp_path / "pretraining", config={"method": "crptpro", "updates": 10}) as records:
        records.log({"loss": 1.0}, stream="pretrain", updates=1)
    with caplog.at_level(logging.WARNING):
        assert find_runs(tmp_path) == []
    assert not caplog.records


def test_an_unfinished_run_is_left_out_by_name_or_kept_on_request(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_run(tmp_path / "short", reached=500, encoder=None)
    with caplog.at_level(logging.WARNING):
        assert find_runs(tmp_path) == []
    assert "short is at 500 of 1,000 env steps" in caplog.text
    (kept,) = find_runs(tmp_path, unfinished=True)
    assert not kept.is_finished
    assert kept.final_score == 500.5


def test_of_an_evaluation_under_way_nothing_is_read(tmp_path: Path) -> None:
    directory = write_run(tmp_path / "run")
    path = directory / "eval.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    run = read_run(directory)
    assert not run.is_finished
    assert run.episodes[-1].env_steps == 500


DAMAGES = {
    "torn": (lambda d: (d / "eval.csv").write_text((d / "eval.csv").read_text()[:-3]), "ends within a row"),
    "not a number": (lambda d: edit(d / "eval.csv", ",501.0,", ",five,"), "damaged in line 5"),
    "not finite": (lambda d: edit(d / "eval.csv", ",501.0,", ",nan,"), "line 5: ValueError: a number in it is"),
    "short row": (lambda d: edit(d / "eval.csv", ",501.0,500,8,crptpro", ",501.0"), "too few or too many cells"),
    "two methods": (lambda d: edit(d / "eval.csv", "8,crptpro", "8,atc"), "several methods: atc, crptpro"),
    "no method": (lambda d: edit(d / "eval.csv", "method", "label"), "no column `method`"),
    "twice": (lambda d: edit(d / "eval.csv", "\n1,500,", "\n0,500,"), "episode 0 at 500 env steps twice"),
    "missing row": (lambda d: edit(d / "eval.csv", "\n1,500,", "\n1,499,"), "has 1 episodes at 500 env steps, 2"),
    "empty": (lambda d: (d / "eval.csv").write_text("episode,method\n"), "has no rows"),
    "no evaluations": (lambda d: (d / "eval.csv").unlink(), "nothing was evaluated yet"),
    "no config": (lambda d: (d / "config.json").unlink(), "no config.json"),
    "half a config": (lambda d: (d / "config.json").write_text('{"config": {'), "config.json cannot be read"),
    "a list": (lambda d: (d / "config.json").write_text("[]"), "holds no settings"),
    "another stage": (lambda d: edit(d / "config.json", "eval_episodes", "x"), "KeyError: 'eval_episodes'"),
    "binary": (lambda d: (d / "eval.csv").write_bytes(b"\xff\xfe\n"), "eval.csv cannot be read"),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_run_is_named_and_left_out_and_the_others_are_kept(
    name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    damage, message = DAMAGES[name]
    write_run(tmp_path / "whole", seed=1)
    damage(write_run(tmp_path / "broken"))
    with pytest.raises(RecordError, match=message):
        read_run(tmp_path / "broken")
    with caplog.at_level(logging.WARNING):
        assert [run.seed for run in find_runs(tmp_path)] == [1]
    assert "Left out" in caplog.text
    assert "broken" in caplog.text
    assert message in caplog.text


def test_the_encoder_of_an_unfinished_run_is_that_of_the_artifact_named(tmp_path: Path) -> None:
    artifact = tmp_path / "encoder"
    artifact.mkdir()
    (artifact / "card.json").write_text(json.dumps({"method": "atc", "weights_sha256": "b" * 64}))
    named = write_run(tmp_path / "run", encoder=None, is_nested=True, pretrained=str(artifact), reached=500)
    assert read_run(named).encoder == "atc:" + "b" * 64
    origin = "atc:" + "c" * 64
    (artifact / "card.json").write_text(json.dumps({"weights_sha256": "b" * 64, "trimmed_from": origin}))
    assert read_run(named).encoder == origin
    assert read_run(write_run(tmp_path / "other", encoder=None)).encoder is None


def test_a_run_that_trains_its_encoder_has_none_of_its_own_to_share(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path / "run", method="drq", algorithm="drq", encoder=None))
    assert run.trains_encoder
    assert run.encoder is None
