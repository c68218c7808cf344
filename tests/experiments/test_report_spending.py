"""What scores took: updates by the plan, wall clock by the records of the pieces, machines by name."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
from fake_reproduction import BUDGET, Reproduction
from report_reading import blocks_of, cell, page_of, table_in, words

from crptpro.experiments.goals import Request
from crptpro.experiments.matrix import seen
from crptpro.experiments.pieces import EncoderPiece, FinetunedPiece, Piece, PretrainedPiece, RunPiece
from crptpro.experiments.report.blocks import Block
from crptpro.experiments.scales import SMALL
from crptpro.experiments.store import DESCRIPTION, DONE

METHODS = ("crptpro", "crptpro-finetune", "proto-rl-c", "proto-rl-s", "becl", "drq", "random-encoder")
TOOK = "What scores took"


def write_done(made: Reproduction, piece: Piece, seconds: float, **job: object) -> None:
    path = made.finish(piece) / DONE
    done = json.loads(path.read_text())
    path.write_text(json.dumps({**done, "seconds": seconds, "job": {**done["job"], **job}}))


def fill(root: Path, methods: tuple[str, ...] = METHODS, *, tasks: tuple[str, ...] = ("walker_run",)) -> list:
    """Runs of an hour and of two, encoders of 20 minutes, datasets of 10."""
    made = Reproduction(root)
    goals = seen(Request(SMALL, groups=("A",), tasks=tasks, methods=methods, seeds=(0, 1)))
    made.ask("seen", goals)
    for goal in goals:
        assert isinstance(goal.piece, RunPiece)
        made.run(goal, 50)
        write_done(made, goal.piece, 3600 * (1 + goal.piece.seed))
        if goal.piece.encoder is not None:
            for encoder in chain_of(goal.piece.encoder):
                write_done(made, encoder, 1200)
                for dataset in encoder.datasets if isinstance(encoder, PretrainedPiece) else ():
                    write_done(made, dataset, 600)
    return goals


def chain_of(encoder: EncoderPiece) -> list[EncoderPiece]:
    return [encoder, *chain_of(encoder.base)] if isinstance(encoder, FinetunedPiece) else [encoder]


def spent(root: Path) -> tuple[Block, ...]:
    return blocks_of(page_of(root), "seen-small")


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> tuple[Block, ...]:
    root = tmp_path_factory.mktemp("root")
    fill(root)
    return spent(root)


@pytest.mark.parametrize(
    ("method", "updates", "env_steps", "collecting", "pretraining"),
    [
        # 20,000 random decisions of two env steps in each of three domains.
        ("crptpro", "3,000", "120,000", "30 min", "20 min"),
        # 1 % of the updates on top, on data of a domain that is there already.
        ("crptpro-finetune", "3,030", "120,000", "30 min", "40 min"),
        # 20,000 decisions in all: one update at every sixth, without the random phases of 3 * 667.
        ("proto-rl-c", "3,000", "40,000", "\N{EN DASH}", "20 min"),
        ("proto-rl-s", "3,000", "40,000", "\N{EN DASH}", "20 min"),
        ("becl", "2,997", "40,000", "\N{EN DASH}", "20 min"),
        ("random-encoder", "0", "0", "\N{EN DASH}", "20 min"),
    ],
)
def test_every_method_has_its_budget_and_its_time(
    blocks: tuple[Block, ...], method: str, updates: str, env_steps: str, collecting: str, pretraining: str
) -> None:
    table = table_in(blocks, TOOK)
    columns = ("encoder updates", "env steps before", "collecting", "pre-training")
    found = [cell(table, column, method).text for column in columns]
    assert found == [updates, env_steps, collecting, pretraining]
    assert cell(table, "one run", method).text == "90 min"  # of an hour and of two
    assert (cell(table, "encoders", method).text, cell(table, "runs", method).text) == ("1", "2")
    assert cell(table, "runs", method).beside == f"{BUDGET:,} env steps"


def test_the_updates_of_a_method_without_pre_training_come_with_the_task(blocks: tuple[Block, ...]) -> None:
    updates = cell(table_in(blocks, TOOK), "encoder updates", "drq")
    assert (updates.text, updates.beside) == (f"{BUDGET // 2:,}", "with the task")
    assert cell(table_in(blocks, TOOK), "env steps before", "drq").text == "0"


def test_times_of_several_machines_come_with_a_warning(tmp_path: Path) -> None:
    goals = fill(tmp_path, ("crptpro", "drq"))
    assert "Made on 1: A CPU, 2 cores, 24 GiB, no GPU, 1 thread." in words(spent(tmp_path))
    assert "pieces that shared one slowed" not in words(spent(tmp_path))
    piece = next(goal.piece for goal in goals if goal.label == "drq")
    path = tmp_path / "pieces" / piece.key / DONE
    done = json.loads(path.read_text())
    hardware = {**done["hardware"], "gpus": ["A GPU"]}
    path.write_text(json.dumps({**done, "hardware": hardware, "job": {"device": "cuda"}}))
    found = spent(tmp_path)
    assert cell(table_in(found, TOOK), "made on", "drq").text == "1, 2"
    assert cell(table_in(found, TOOK), "made on", "crptpro").text == "1"
    plain, with_gpu = "1: A CPU, 2 cores, 24 GiB, no GPU, 1 thread", "2: A CPU, 2 cores, 24 GiB, A GPU, cuda"
    assert f"Made on {plain}; {with_gpu}. Times compare only within one machine" in words(found)


def test_a_time_that_is_not_recorded_leaves_a_gap(tmp_path: Path) -> None:
    goals = fill(tmp_path, ("crptpro",))
    encoder = goals[0].piece.encoder
    (tmp_path / "pieces" / encoder.key / DONE).unlink()
    dataset = encoder.datasets[0]
    done = tmp_path / "pieces" / dataset.key / DONE
    done.write_text('{"seconds": "long"}')
    table = table_in(spent(tmp_path), TOOK)
    assert cell(table, "pre-training", "crptpro").text == "\N{EN DASH}"
    assert cell(table, "collecting", "crptpro").text == "\N{EN DASH}"
    assert cell(table, "encoder updates", "crptpro").text == "3,000"


def test_several_encoders_of_a_method_are_counted_and_averaged(tmp_path: Path) -> None:
    goals = fill(tmp_path, ("proto-rl-s",), tasks=("walker_run", "cheetah_run"))
    made = Reproduction(tmp_path)
    encoders = list(dict.fromkeys(goal.piece.encoder for goal in goals))
    assert len(encoders) == 2  # one per domain
    write_done(made, encoders[0], 3600)
    table = table_in(spent(tmp_path), TOOK)
    assert cell(table, "encoders", "proto-rl-s").text == "2"
    assert cell(table, "runs", "proto-rl-s").text == "4"
    assert cell(table, "encoder updates", "proto-rl-s").text == "3,000"
    assert cell(table, "pre-training", "proto-rl-s").text == "40 min"  # of an hour and of 20 min


def test_a_method_that_is_not_loaded_here_keeps_its_times(tmp_path: Path) -> None:
    goals = fill(tmp_path, ("apt-c",))
    made = Reproduction(tmp_path)
    mine = dataclasses.replace(goals[0].piece.encoder, method="mine")
    write_done(made, mine, 600)
    run = dataclasses.replace(goals[0].piece, encoder=mine)
    goal = dataclasses.replace(goals[0], label="mine", piece=run)
    made.ask("seen", [goal])
    made.run(goal, 50)
    assert (tmp_path / "pieces" / run.key / DESCRIPTION).is_file()
    table = table_in(spent(tmp_path), TOOK)
    assert cell(table, "encoder updates", "mine").text == "\N{EN DASH}"
    assert cell(table, "pre-training", "mine").text == "10 min"


def test_one_to_three_tasks_have_columns_where_methods_are_more(blocks: tuple[Block, ...]) -> None:
    table = table_in(blocks, "at the final evaluation")
    assert table.columns == ("method", "A walker_run")
    assert cell(table, "A walker_run", "crptpro").published == "513 ± 33"
    assert cell(table, "A walker_run", "proto-rl-s").beside == "n = 2"
