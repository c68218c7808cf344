"""What the command line refuses: one line, a status, and nothing left behind."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import re
from pathlib import Path

import pytest
from command import SIZE, TASK, Call, refused, rows, toy_dataset


@pytest.mark.parametrize(("arguments", "message"), [
    (("collect", "cartpole", "walkr"), r"no domain or task 'walkr'\. Nearest: walker"),
    (("collect",), r"Name at least one domain"),
    (("collect", "gymnasium:HalfChetah-v5"), r"HalfChetah.*Nearest: gymnasium:HalfCheetah"),
    (("collect", "cartpole", "--transitions", "0"), r"at least 1, got 0"),
    (("collect", "cartpole", "--action-repeat", "0"), r"action_repeat must be at least 1, got 0"),
    (("collect", "cartpole", "--seed", "-1"), r"`seed` must be from 0 to 4294967295, got -1"),
    (("drq", TASK, "--seed", str(2**32)), r"`seed` must be from 0 to 4294967295, got 4294967296"),
    (("pretrain",), r"at least one dataset directory"),
    (("pretrain", "absent"), r"absent"),
    (("finetune", "absent", "absent"), r"absent"),
    (("downstream", "walker_rum", "--pretrained", "random-encoder"), r"'walker_rum'\. Nearest: walker_run"),
    (("downstream", TASK, "--pretrained", "absent"), r"absent does not exist"),
    (("downstream", TASK, "--pretrained", "random-encoder", "--device", "abacus"), r"'abacus' cannot be used"),
    (("downstream", TASK, "--pretrained", "random-encoder", "--discount", "2"), r"discount.*got 2"),
    (("downstream", TASK, "--pretrained", "random-encoder", "--algorithm", "drq"), r"crptpro drq toy-fixed_go --out"),
    (("drq", "walker_rum"), r"'walker_rum'\. Nearest: walker_run"),
])  # fmt: skip
def test_a_request_that_cannot_be_met_leaves_nothing_behind(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    line = refused(call(*arguments, "--out", tmp_path / "out"))
    assert re.search(message, line), line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("arguments", "message"), [
    (("random-policy",), "name one with --task"),
    (("absent",), "absent does not exist"),
    (("random-policy", "--task", "walker_rum"), "Nearest: walker_run"),
    (("random-policy", "--task", TASK, "--episodes", "0"), "at least 1, got 0"),
    (("random-policy", "--task", TASK, "--seed", "-1"), "`seed` must be from 0 to 4294967295, got -1"),
    (("random-policy", "--task", TASK, "--colors", "reversed_background"), "colors='reversed_image'"),
])  # fmt: skip
def test_an_evaluation_that_cannot_run_says_why(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in refused(call("evaluate", *arguments, "--csv", "out/returns.csv"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["--csv", "--video"])
def test_what_cannot_be_written_is_refused_before_any_episode(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    asked = ("evaluate", "random-policy", "--task", TASK, option)
    (tmp_path / "file").touch()
    for path, message in (
        (tmp_path, "is a directory"),
        (Path("/dev/null"), "no ordinary file"),
        (tmp_path / "file" / "x", "file is a file"),
    ):
        assert f"{option} {path} " in (line := refused(call(*asked, path)))
        assert message in line
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert f"you may not write to {tmp_path}" in refused(call(*asked, tmp_path / "new" / "x"))


def test_a_video_without_the_extra_is_refused_before_any_episode(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *_: None if name == "imageio_ffmpeg" else find(name, *_)
    )
    line = refused(call("evaluate", "random-policy", "--task", TASK, "--video", tmp_path / "x.mp4"))
    assert "--video needs the `video` extra: pip install 'crptpro[video]'" in line


def test_a_video_that_could_not_be_written_fails_below_the_scores_and_the_table(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("crptpro.training.video.can_encode", lambda: True)
    monkeypatch.setattr("crptpro.training.video.write_video", lambda *_: None)
    asked = ("evaluate", "random-policy", "--task", TASK, "--episodes", 1, "--csv", tmp_path / "x.csv")
    status, out, err = call(*asked, "--video", tmp_path / "x.mp4")
    assert status == 1
    assert out.startswith(f"{TASK}: ")
    assert len(rows(tmp_path / "x.csv")) == 1
    assert err.splitlines()[-1].startswith(f"error: --video {tmp_path / 'x.mp4'} was not written")


def test_a_table_for_which_the_disk_is_full_is_named_below_the_scores(call: Call, tmp_path: Path) -> None:
    (tmp_path / f".x.csv.{os.getpid()}.partial").symlink_to("/dev/full")
    asked = ("evaluate", "random-policy", "--task", TASK, "--episodes", 1, "--csv", tmp_path / "x.csv")
    status, out, err = call(*asked)
    assert status == 1
    assert out.startswith(f"{TASK}: ")
    assert err.splitlines()[-1].startswith(
        f"error: The disk is full: {tmp_path / 'x.csv'} cannot be written."
    )
    assert list(tmp_path.iterdir()) == []


def test_a_truncated_dataset_is_named(call: Call, dataset: Path, tmp_path: Path) -> None:
    file = next(dataset.rglob("pixels.memmap"))
    os.truncate(file, file.stat().st_size - 1)
    assert str(file) in refused(call("pretrain", dataset, "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("flag", "value", "message"), [
    ("--method", "protto", "Nearest: .*proto|'protto'"),
    ("--updates", "0", "updates.*0"),
    ("--batch-size", "0", "batch_size.*0"),
    ("--learning-rate", "-1", "learning_rate.*-1"),
    ("--log-interval", "0", "log_interval.*0"),
    ("--assignment-temperature", "0", "temperature.*0"),
    ("--annealing-updates", "9", "needs an assignment_temperature"),
    ("--seed", "-1", "`seed`.*got -1"),
])  # fmt: skip
def test_a_setting_that_pretraining_refuses_is_one_line(
    call: Call, dataset: Path, tmp_path: Path, flag: str, value: str, message: str
) -> None:
    line = refused(call("pretrain", dataset, "--out", tmp_path / "out", flag, value))
    assert re.search(message, line), line
    assert not list((tmp_path / "out").rglob("*.csv"))


def test_datasets_of_different_images_are_refused(call: Call, dataset: Path, tmp_path: Path) -> None:
    other = toy_dataset(tmp_path / "data" / "other", SIZE + 2)
    line = refused(call("pretrain", dataset, other, "--out", tmp_path / "out"))
    assert f"{dataset} has 16 px" in line
    assert f"{other} has 18 px" in line
    assert not (tmp_path / "out").exists()


def test_an_encoder_for_other_images_is_refused(call: Call, encoder: Path, tmp_path: Path) -> None:
    other = toy_dataset(tmp_path / "data" / "other", SIZE + 2)
    line = refused(call("finetune", encoder, other, "--out", tmp_path / "out"))
    assert "image_size 16, not 18" in line
    assert not (tmp_path / "out").exists()


def test_a_run_with_other_settings_is_not_continued(call: Call, dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    common = ("pretrain", dataset, "--out", out, "--updates", 2, "--log-interval", 1)
    assert call(*common, "--batch-size", 4)[0] == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    line = refused(call(*common, "--batch-size", 6))
    assert "batch_size was 4, now 6" in line
    assert before == {path: path.read_bytes() for path in before}
