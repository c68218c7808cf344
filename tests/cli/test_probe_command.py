"""``crptpro probe``: its table, its file, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
import torch
from command import SIZE, Call, rows
from toy_env import collect_toy, random_episode, write_dataset

from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss
from crptpro.pretrained import save_pretrained


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    episodes = [random_episode(10, size=SIZE, seed=index) for index in range(6)]
    return write_dataset(tmp_path / "data" / "toy", episodes)


@pytest.fixture
def encoder(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    loss = ProtoLoss(PixelEncoder(image_size=SIZE), num_prototypes=16, latent_dim=4, hidden_dim=8)
    trained = SimpleNamespace(loss=loss, method="crptpro", training={"datasets": [{"domain": "toy"}]})
    return save_pretrained(trained, tmp_path / "encoder")


def table(out: str) -> list[list[str]]:
    lines = [line for line in out.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_an_encoder_and_the_control_are_probed_with_table_and_csv(
    call: Call, dataset: Path, encoder: Path, tmp_path: Path
) -> None:
    file = tmp_path / "new" / "probe.csv"
    status, out, _ = call("probe", encoder, dataset, "--csv", file)
    assert status == 0
    assert [line[:5] for line in table(out)] == [["crptpro", "toy", "yes", "normal", z] for z in ("features", "z")]
    found = pd.read_csv(file)
    own = found[found["embedding"] == "z"].fillna("")
    assert list(zip(own["measure"], own["coordinate"])) == [
        *(("r2_position", f"qpos[{index}]") for index in range(4)),
        *(("r2_velocity", f"qvel[{index}]") for index in range(3)),
        *((name, "") for name in ("r2_position", "r2_velocity", "effective_rank", "mean_cosine")),
    ]
    about = found[["encoder", "method", "samples", "held_out_episodes"]].drop_duplicates()
    assert about.to_numpy().tolist() == [[str(encoder), "crptpro", 60, 2]]
    assert table(out)[1][5] == f"{own['value'].iloc[-4]:.3f}"

    status, out, _ = call("probe", "random-encoder", dataset, "--samples", 40)
    assert status == 0
    assert [line[:3] for line in table(out)] == [["random-encoder", "toy", "no"]] * 2


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
    words = [dataset if part == "DATA" else part for part in arguments]
    status, out, err = call("probe", *words, "--csv", file)
    assert (status, out) == (1, "")
    assert message in err
    assert err.splitlines()[-1].startswith("error: ")
    assert not file.exists()


def test_an_encoder_of_other_images_and_data_without_state_are_refused(
    call: Call, encoder: Path, dataset: Path, tmp_path: Path
) -> None:
    assert "image_size 16, not 8" in call("probe", encoder, collect_toy(tmp_path / "small"))[2]
    write_dataset(tmp_path / "stateless", [random_episode(9, size=SIZE, state=False)])
    # What was measured before it came to the one that is refused is kept.
    file = tmp_path / "probe.csv"
    status, out, err = call("probe", "random-encoder", dataset, tmp_path / "stateless", "--csv", file)
    assert status == 1
    assert "no physical state" in err
    assert [line[:2] for line in table(out)] == [["random-encoder", "toy"]] * 2
    assert len(rows(file)) > 4
