from __future__ import annotations

import csv
import logging
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from toy_world import collect_toy, random_episode, write_dataset

from crptpro.cli import main
from crptpro.data import collect_random
from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import save_pretrained

SIZE = 16
Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Iterator[Call]:
    """Run `crptpro probe` in this process; returns exit status, standard output and standard error."""
    library = logging.getLogger("crptpro")
    before = library.handlers[:], library.level, library.propagate

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["crptpro", "probe", *map(str, arguments)])
        capsys.readouterr()
        try:
            main()
            status = 0
        except SystemExit as stopped:
            status = stopped.code if isinstance(stopped.code, int) else int(stopped.code is not None)
        return status, *capsys.readouterr()

    yield run
    library.handlers[:], library.propagate = before[0], before[2]
    library.setLevel(before[1])


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    return write_dataset(
        tmp_path / "data" / "toy", [random_episode(10, size=SIZE, seed=index) for index in range(6)]
    )


@pytest.fixture
def encoder(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    loss = ProtoLoss(PixelEncoder(image_size=SIZE), num_prototypes=16, latent_dim=4, hidden_dim=8)
    training = {"datasets": [{"domain": "toy"}]}
    return save_pretrained(
        SimpleNamespace(loss=loss, method="crptpro", training=training), tmp_path / "encoder"
    )


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def table(out: str) -> list[list[str]]:
    lines = [line for line in out.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_an_encoder_and_the_control_are_probed_with_table_and_csv(
    call: Call, dataset: Path, encoder: Path, tmp_path: Path
) -> None:
    file = tmp_path / "new" / "probe.csv"
    status, out, _ = call(encoder, dataset, "--csv", file)
    assert status == 0
    named = [line[:5] for line in table(out)]
    assert named == [["crptpro", "toy", "yes", "normal", embedding] for embedding in ("features", "z")]
    found = rows(file)
    own = [row for row in found if row["embedding"] == "z"]
    assert [(row["measure"], row["coordinate"]) for row in own] == [
        *(("r2_position", f"qpos[{index}]") for index in range(4)),
        *(("r2_velocity", f"qvel[{index}]") for index in range(3)),
        *((name, "") for name in ("r2_position", "r2_velocity", "effective_rank", "mean_cosine")),
    ]
    assert {(row["encoder"], row["method"], row["samples"], row["held_out_episodes"]) for row in found} == {
        (str(encoder), "crptpro", "60", "2")
    }
    assert table(out)[1][5] == f"{float(own[-4]['value']):.3f}"

    status, out, _ = call("random-encoder", dataset, "--samples", 40)
    assert status == 0
    assert [line[:5] for line in table(out)] == [
        ["random-encoder", "toy", "no", "normal", embedding] for embedding in ("features", "z")
    ]


@pytest.mark.parametrize(("arguments", "message"), [
    (("absent", "DATA"), "absent does not exist"),
    (("random-encoder", "absent"), "absent is not a directory"),
    (("random-encoder", "DATA", "--samples", "0"), "at least 1, got 0"),
    (("random-encoder", "DATA", "--samples", "4"), "draw more samples"),
    (("random-encoder", "DATA", "--device", "abacus"), "'abacus' cannot be used"),
])  # fmt: skip
def test_a_probe_that_cannot_run_says_why_and_writes_nothing(
    call: Call, dataset: Path, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    file = tmp_path / "probe.csv"
    status, out, err = call(*(dataset if part == "DATA" else part for part in arguments), "--csv", file)
    assert (status, out) == (1, "")
    assert message in err
    assert err.splitlines()[-1].startswith("error: ")
    assert not file.exists()


def test_an_encoder_of_other_images_and_data_without_state_are_refused(
    call: Call, encoder: Path, dataset: Path, tmp_path: Path
) -> None:
    small = tmp_path / "small"
    collect_toy(small)
    assert "image_size 16, not 8" in call(encoder, small)[2]
    write_dataset(tmp_path / "stateless", [random_episode(9, size=SIZE, state=False)])
    assert "no physical state" in call("random-encoder", tmp_path / "stateless")[2]
    # What was measured before it came to the one that is refused is kept.
    file = tmp_path / "probe.csv"
    status, out, err = call("random-encoder", dataset, tmp_path / "stateless", "--csv", file)
    assert status == 1
    assert "no physical state" in err
    assert [line[:2] for line in table(out)] == [["random-encoder", "toy"]] * 2
    assert len(rows(file)) > 4


@pytest.mark.gl
def test_a_real_domain_is_probed_in_the_colours_that_it_was_collected_in(call: Call, tmp_path: Path) -> None:
    settings = {"image_size": 24, "action_repeat": 20, "quality": "fast", "progress": False}
    settings["colors"] = "reversed_background"
    path = collect_random("pendulum", tmp_path, transitions=300, **settings)
    file = tmp_path / "probe.csv"
    status, out, err = call("random-encoder", path, "--samples", 150, "--csv", file)
    assert status == 0, err
    [found] = [line for line in table(out) if line[4] == "features"]
    assert found[3] == "reversed_background"
    assert {row["coordinate"] for row in rows(file)} == {"", "hinge", "sin hinge", "cos hinge"}
    assert float(found[5]) > 0.2  # even a random encoder sees where the pole is
