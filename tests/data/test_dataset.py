from __future__ import annotations

import copy
import errno
import json
import os
import pickle
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import RandomSampler, ReplayBuffer, SliceSampler
from torchrl.envs import CatFrames, TransformedEnv
from toy_env import ToyEnv, collect_toy, collection_request, data_bytes, random_episode, variable_length, write_dataset

from crptpro import provenance
from crptpro.artifact import CARD_FILE
from crptpro.data import FrameDataset, FrameReplay
from crptpro.errors import DatasetError, DiskSpaceError

LENGTHS = (4, 1, 7, 2, 12)
TOTAL = sum(LENGTHS)


@pytest.fixture(scope="module")
def episodes() -> list[TensorDict]:
    return [random_episode(length, seed=index) for index, length in enumerate(LENGTHS)]


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory, episodes: list[TensorDict]) -> Path:
    return write_dataset(tmp_path_factory.mktemp("dataset") / "toy", episodes)


@pytest.fixture
def dataset(path: Path) -> FrameDataset:
    return FrameDataset.open(path)


@pytest.fixture
def duplicate(path: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(path, tmp_path / "copy"))


@pytest.mark.parametrize("frame_stack", [1, 2, 3, 4])
def test_stacks_equal_a_live_stack_at_every_step(tmp_path: Path, frame_stack: int) -> None:
    def rollout(env: Any, seed: int) -> TensorDict:
        torch.manual_seed(seed)
        return env.rollout(100)

    catframes = CatFrames(N=frame_stack, dim=-3, in_keys=["pixels"], padding="same")
    envs = [ToyEnv(variable_length, seed=seed) for seed in range(4)]
    live = torch.cat([rollout(TransformedEnv(env, catframes.clone()), 7) for env in envs])
    path = write_dataset(tmp_path, [rollout(env, 7) for env in envs])
    everything = FrameDataset.open(path, frame_stack=frame_stack)[:]
    for key in ("pixels", ("next", "pixels"), "action", ("next", "reward"), ("next", "done")):
        assert torch.equal(everything[key], live[key]), key


def test_sampling_is_uniform_over_all_pairs(dataset: FrameDataset) -> None:
    dataset.set_rng(torch.Generator().manual_seed(0))
    counts = torch.bincount(dataset.sample(26_000)["index"], minlength=TOTAL)
    assert ((counts - 1000.0) ** 2 / 1000).sum() < 60  # 25 degrees of freedom: once in 10,000 seeds


def test_samples_are_uint8_and_alias_neither_each_other_nor_the_files(path: Path) -> None:
    dataset = FrameDataset.open(path)
    batch, before = dataset.sample(5), dataset.frames["pixels"].clone()
    assert batch["pixels"].dtype == batch["next", "pixels"].dtype == torch.uint8
    assert batch["pixels"].shape == (5, 9, 6, 6)
    following = batch["next", "pixels"].clone()
    batch["pixels"].zero_()
    assert torch.equal(batch["next", "pixels"], following)
    assert torch.equal(dataset.frames["pixels"], before)
    dataset.frames["pixels"].zero_()
    assert FrameDataset.open(path).frames["pixels"].any()


def test_plain_torchrl_buffers_and_samplers_read_it(dataset: FrameDataset) -> None:
    options = {"storage": dataset.storage, "collate_fn": lambda rows: rows}
    assert ReplayBuffer(sampler=RandomSampler(), batch_size=6, **options).sample()["pixels"].shape == (6, 9, 6, 6)
    sampler = SliceSampler(slice_len=2, traj_key="episode", strict_length=False, truncated_key=None)
    assert ReplayBuffer(sampler=sampler, batch_size=8, **options).sample()["pixels"].shape[1:] == (9, 6, 6)


def test_both_stores_work_under_a_default_device_that_is_not_the_cpu(path: Path, episodes: list[TensorDict]) -> None:
    torch.set_default_device("meta")
    try:
        generator = torch.Generator("cpu")
        replay = FrameReplay(20, frame_shape=(3, 6, 6), action_dim=2, n_step=2, generator=generator)
        replay.extend(episodes[0])
        for buffer in (replay, FrameDataset.open(path)):
            batch = buffer.sample(4)
            assert batch["pixels"].device.type == batch["action"].device.type == "cpu"
        assert replay.observations(replay.sample(4)["number"]).device.type == "cpu"
    finally:
        torch.set_default_device(None)


@pytest.mark.parametrize("index", [3, -1, slice(2, 9, 3), [0, 5], torch.tensor([[1, 2], [3, 4]]), range(3)])
def test_indexing_follows_tensors(dataset: FrameDataset, index: Any) -> None:
    expected = dataset.transitions["row"][list(index) if isinstance(index, range) else index]
    assert torch.equal(dataset[index]["number"], expected)
    assert len(dataset[dataset.transitions["episode"] == 2]) == LENGTHS[2]
    with pytest.raises(IndexError, match="26 is out of bounds"):
        dataset[26]


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda dataset: pickle.loads(pickle.dumps(dataset))])
def test_a_copy_samples_what_the_original_samples(path: Path, copied: Any) -> None:
    dataset = FrameDataset.open(path, generator=torch.Generator().manual_seed(1), frame_stack=2)
    assert (copied(dataset).sample(8) == dataset.sample(8)).all()
    assert len(pickle.dumps(dataset.storage)) < 1000  # the receiver opens the files


def test_a_checkpoint_refers_to_the_dataset(dataset: FrameDataset, tmp_path: Path, episodes: list[TensorDict]) -> None:
    dataset.dumps(tmp_path / "checkpoint")
    files = [file for file in (tmp_path / "checkpoint").rglob("*") if file.is_file()]
    assert sum(file.stat().st_size for file in files) < 10_000
    dataset.loads(tmp_path / "checkpoint")
    other = FrameDataset.open(write_dataset(tmp_path / "other", episodes[:3]))
    with pytest.raises(DatasetError, match="transitions 12 there, 26 requested"):
        other.loads(tmp_path / "checkpoint")


@pytest.mark.parametrize("file", ["frames/pixels.memmap", "frames/qpos.memmap", "transitions/next/done.memmap"])
def test_a_missing_or_truncated_file_is_named(duplicate: Path, file: str) -> None:
    content = (duplicate / file).read_bytes()
    (duplicate / file).write_bytes(content[:-1])
    with pytest.raises(DatasetError, match=f"{file} is truncated: {len(content) - 1:,} bytes.*{len(content):,}"):
        FrameDataset.open(duplicate)
    (duplicate / file).unlink()
    with pytest.raises(DatasetError, match=f"{file} is missing"):
        FrameDataset.open(duplicate)


@pytest.mark.parametrize(("changes", "message"), [
    ({"format": "safetensors"}, "has the format 'safetensors': it is not a dataset"),
    ({"version": 99}, "version 99; this release reads"),
    ({"frames": 5}, "pixels.memmap is longer than it should be"),
])  # fmt: skip
def test_a_card_that_cannot_be_is_refused(duplicate: Path, changes: dict[str, Any], message: str) -> None:
    card = json.loads((duplicate / CARD_FILE).read_text())
    (duplicate / CARD_FILE).write_text(json.dumps(card | changes))
    with pytest.raises(DatasetError, match=message):
        FrameDataset.open(duplicate)


def test_what_is_no_dataset_is_named(duplicate: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="is not a directory"):
        FrameDataset.open(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match=r"not a dataset. Did you mean one of its datasets: copy\?"):
        FrameDataset.open(tmp_path)
    with pytest.raises(ValueError, match="`frame_stack` must be at least 1, got 0"):
        FrameDataset.open(duplicate, frame_stack=0)
    (duplicate / CARD_FILE).write_text("{")
    with pytest.raises(DatasetError, match="damaged or not written by crptpro"):
        FrameDataset.open(duplicate)


def test_a_torchrl_collector_fills_a_dataset(tmp_path: Path) -> None:
    env, seen = ToyEnv(variable_length, seed=4, physics_state=True), []
    dataset = FrameDataset.create(tmp_path, domain="mine", transitions=45)
    for rollout in Collector(env, frames_per_batch=10, total_frames=-1):
        seen.append(rollout.clone())
        dataset.extend(rollout)
        if dataset.is_complete:
            break
        for read in (lambda: dataset[:], lambda: pickle.dumps(dataset)):
            with pytest.raises(DatasetError, match="is being collected"):
                read()
    expected, again = torch.cat(seen)[:45], FrameDataset.open(tmp_path, frame_stack=1)
    assert len(again) == len(dataset) == 45
    for key in ("pixels", ("next", "pixels"), "action", ("next", "reward")):
        assert torch.equal(again[:][key], expected[key]), key
    assert again[44]["next", "done"].item()  # the last episode was cut to fit
    assert torch.equal(again.frames["qpos"][again[:]["number"]], expected["qpos"])
    assert (dataset.sample(4)["pixels"].shape, dataset.domain) == ((4, 9, 8, 8), "mine")
    with pytest.raises(DatasetError, match="complete and read-only"):
        dataset.extend(rollout)
    with pytest.raises(DatasetError, match="use extend"):
        dataset[0] = dataset[1]


def test_rows_of_another_shape_or_without_a_reset_are_refused_and_leave_no_trace(tmp_path: Path) -> None:
    dataset = FrameDataset.create(tmp_path, **collection_request())
    dataset.extend(random_episode(5, size=8))
    with pytest.raises(DatasetError, match="Collect it into another directory"):
        dataset.extend(random_episode(5, size=8, action_dim=3))
    late = random_episode(3, size=8)
    frames = torch.randint(0, 256, (6, 3, 8, 8), dtype=torch.uint8)
    for first, part in enumerate((late, late["next"])):
        part["pixels"] = torch.stack([frames[i : i + 3].flatten(0, 1) for i in range(first, first + 3)])
    with pytest.raises(ValueError, match="begins at its reset"):
        dataset.extend(late)
    dataset.writer.close()
    resumed = FrameDataset.create(tmp_path, **collection_request())
    for _ in range(3):
        resumed.extend(random_episode(10, size=8))
    assert len(FrameDataset.open(tmp_path)) == 27


@pytest.mark.parametrize("killed_at", ["nothing", "bytes", "half a card"])
def test_killed_anywhere_the_same_request_continues_to_the_same_bytes(tmp_path: Path, killed_at: str) -> None:
    whole = collect_toy(tmp_path / "whole", transitions=40)
    path = collect_toy(tmp_path / "killed", transitions=40, episodes=3)
    if killed_at == "bytes":  # of an episode that was not counted yet
        for file in path.rglob("*.memmap"):
            file.write_bytes(file.read_bytes() + b"some")
    elif killed_at == "half a card":
        (path / f".{CARD_FILE}.12345.partial").write_text('{"episodes": 4, "transi')
    with pytest.raises(DatasetError, match=r"\d+ of 40 transitions.*same collect command"):
        FrameDataset.open(path)
    collect_toy(path, transitions=40)
    assert data_bytes(path) == data_bytes(whole)
    assert len(FrameDataset.open(path)) == 40


def test_what_was_written_is_read_back_at_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def lose_a_byte(descriptor: int) -> None:
        if os.readlink(f"/proc/self/fd/{descriptor}").endswith("pixels.memmap"):
            os.ftruncate(descriptor, os.fstat(descriptor).st_size - 1)

    monkeypatch.setattr(os, "fsync", lose_a_byte)
    with pytest.raises(DatasetError, match=r"pixels\.memmap is truncated"):
        collect_toy(tmp_path / "toy")


def test_files_that_lack_finished_episodes_are_named_and_left_alone(tmp_path: Path) -> None:
    path = collect_toy(tmp_path, episodes=2)
    pixels = path / "frames/pixels.memmap"
    pixels.write_bytes(pixels.read_bytes()[:-1])
    before = data_bytes(path)
    with pytest.raises(DatasetError, match=r"pixels.memmap is truncated"):
        collect_toy(path)
    assert data_bytes(path) == before


@pytest.mark.parametrize("finished", [True, False])
@pytest.mark.parametrize(("asked", "message"), [
    ({"seed": 4}, "seed 0 there, 4 requested"),
    ({"transitions": 70}, "transitions 27 there, 70 requested"),
    ({"colors": "reversed_image"}, "colors 'normal' there, 'reversed_image' requested"),
])  # fmt: skip
def test_another_request_is_refused(tmp_path: Path, finished: bool, asked: dict[str, Any], message: str) -> None:
    collect_toy(tmp_path, episodes=None if finished else 1)
    with pytest.raises(DatasetError, match=f"{message}.*choose another directory"):
        FrameDataset.create(tmp_path, **collection_request(**asked))


@pytest.mark.parametrize("left", [[], [".lock"], [".lock", ".card.json.77.partial"], [CARD_FILE]])
def test_what_holds_no_episode_yet_blocks_no_request(tmp_path: Path, left: list[str]) -> None:
    for name in left:
        (tmp_path / name).write_text('{"format"')
    if left == [CARD_FILE]:
        (tmp_path / CARD_FILE).unlink()
        dataset = FrameDataset.create(tmp_path, **collection_request(seed=5))
        dataset.writer.note_rendering({})  # which writes the card
        dataset.writer.close()
    assert len(FrameDataset.open(collect_toy(tmp_path))) == 27
    assert not list(tmp_path.glob(".*.partial"))


def test_a_directory_with_something_else_or_another_writer_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("x")
    with pytest.raises(DatasetError, match="not empty and not a collection"):
        FrameDataset.create(tmp_path / "full", **collection_request())
    assert [file.name for file in (tmp_path / "full").iterdir()] == ["thesis.tex"]
    first = FrameDataset.create(tmp_path / "toy", **collection_request())
    with pytest.raises(DatasetError, match=r"This process is already writing to .*dataset\.writer"):
        FrameDataset.create(tmp_path / "toy", **collection_request())
    first.writer.close()
    FrameDataset.create(tmp_path / "toy", **collection_request()).writer.close()
    with pytest.raises(DatasetError, match="is closed"):  # its lock may be another's by now
        first.extend(random_episode(5, size=8))


def test_facts_of_any_kind_are_the_same_request_when_they_are_repeated(tmp_path: Path) -> None:
    facts: dict[str, Any] = {"tags": ("x", "y"), "script": Path("a.py"), "rate": torch.tensor(0.5)}
    collect_toy(tmp_path, episodes=1, **facts)
    assert FrameDataset.open(collect_toy(tmp_path, **facts)).card["tags"] == ["x", "y"]


def test_frames_of_another_size_than_the_request_are_refused_at_the_first(tmp_path: Path) -> None:
    dataset = FrameDataset.create(tmp_path, **collection_request(image_size=64))
    with pytest.raises(DatasetError, match=r"of image_size 64, got frames \[3, 16, 16\]"):
        dataset.extend(random_episode(5, size=16))
    assert not list(tmp_path.rglob("*.memmap"))


def test_a_relative_path_stays_what_it_was_when_the_process_goes_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, episodes: list[TensorDict]
) -> None:
    monkeypatch.chdir(tmp_path)
    dataset = FrameDataset.create("toy", **collection_request(transitions=TOTAL, image_size=6))
    dataset.extend(episodes[0])
    replay = FrameReplay(20, frame_shape=(3, 6, 6), action_dim=2, path="ring")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    for episode in episodes[1:]:
        dataset.extend(episode)
    assert len(pickle.loads(pickle.dumps(dataset))) == len(FrameDataset.open(tmp_path / "toy")) == TOTAL
    replay.load_state_dict(replay.state_dict())
    assert not list((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize("kept", [0, 1])
def test_a_full_disk_is_named_and_what_was_kept_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept: int
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    if kept:
        collect_toy(tmp_path / "disk", episodes=kept)
    dataset = FrameDataset.create(tmp_path / "disk", **collection_request())
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(DiskSpaceError, match=f"is full after {10 * kept} transitions"):
            dataset.extend(random_episode(10, size=8, state=False))
    dataset.writer.close()
    collect_toy(tmp_path / "disk")
    assert data_bytes(tmp_path / "disk") == data_bytes(collect_toy(tmp_path / "whole"))


@pytest.mark.parametrize(("now", "message"), [
    ({"backend": "osmesa", "gl_renderer": "llvmpipe"}, "backend 'egl', now it is 'osmesa'.*MUJOCO_GL=egl"),
    ({"backend": "egl", "gl_renderer": "NVIDIA H200"}, "'llvmpipe', now it is 'NVIDIA H200'.*pixels differ"),
])  # fmt: skip
def test_another_backend_or_renderer_may_not_continue(tmp_path: Path, now: dict[str, str], message: str) -> None:
    rendered = {"backend": "egl", "gl_renderer": "llvmpipe"}
    for renderer in (now, rendered):  # before the first episode any may begin
        dataset = FrameDataset.create(tmp_path, **collection_request())
        dataset.writer.note_rendering(renderer)
        dataset.writer.close() if renderer == now else dataset.extend(random_episode(10, size=8))
    dataset.writer.close()
    resumed = FrameDataset.create(tmp_path, **collection_request())
    resumed.writer.note_rendering(rendered)
    with pytest.raises(DatasetError, match=message):
        resumed.writer.note_rendering(now)
    resumed.writer.close()


def test_a_collection_that_is_continued_with_other_versions_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    dataset = FrameDataset.create(tmp_path, **collection_request())
    dataset.extend(random_episode(10, size=8))
    dataset.writer.close()
    now = {**provenance.versions(), "mujoco": "9.9"}
    monkeypatch.setattr(provenance, "versions", lambda: now)
    FrameDataset.create(tmp_path, **collection_request()).writer.close()
    assert f"{tmp_path} is continued with other versions" in caplog.text
    assert "is now 9.9." in caplog.text


def test_a_dataset_takes_21_kb_per_transition(tmp_path: Path) -> None:
    path = write_dataset(tmp_path, [random_episode(100, size=84)])
    size = sum(file.stat().st_size for file in path.rglob("*.memmap"))
    assert size / 100 < 1.01 * (3 * 84 * 84) + 100


def test_a_directory_is_opened_by_open(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"FrameDataset\.open opens a directory"):
        FrameDataset(tmp_path)  # type: ignore[arg-type]


def test_what_an_unfinished_dataset_does_not_have_yet_is_refused(tmp_path: Path) -> None:
    unfinished = FrameDataset.create(tmp_path, domain="mine", transitions=10)
    for name in ("domain", "image_size", "frames", "transitions"):
        with pytest.raises(DatasetError, match="complete"):
            getattr(unfinished, name)
