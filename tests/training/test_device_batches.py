"""Batches made where the frames are: the pixels of the CPU's way for the same draws, repeatable, without host reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from host_reads import NoHostReads
from pretrain_world import SETTINGS, same_state
from tensordict import TensorDict

from crptpro.data import FrameDataset
from crptpro.data.frame_stacks import stack_rows
from crptpro.data.frame_storage import FrameStorage
from crptpro.errors import CheckpointError
from crptpro.modules import PixelEncoder
from crptpro.objectives import ProtoLoss
from crptpro.training import pretrain
from crptpro.training.compiled import Compiled
from crptpro.training.pretrain import loop
from crptpro.training.pretrain.device_batches import DeviceBatches
from crptpro.transforms.random_shift import shifted_stacks

KEYS: list[Any] = ["pixels", ("next", "pixels")]
SIZE, STACK = 12, 3


def make_dataset(seed: int, *, lengths: tuple[int, ...] = (4, 1, 7), size: int = SIZE) -> FrameDataset:
    """Noise frames of a few short episodes: many stacks begin with repeated frames."""
    generator = torch.Generator().manual_seed(seed)
    count = sum(lengths)
    pixels = torch.randint(
        0, 256, (count + len(lengths), 3, size, size), dtype=torch.uint8, generator=generator
    )
    step = torch.cat([torch.arange(length) for length in lengths])
    episode = torch.cat([torch.full((length,), number) for number, length in enumerate(lengths)])
    transitions = TensorDict(
        {
            "row": torch.arange(count) + episode, "step": step.int(), "episode": episode,
            "action": torch.rand(count, 2, generator=generator),
        },
        [count],
    )  # fmt: skip
    frames = TensorDict({"pixels": pixels}, [len(pixels)])
    return FrameDataset(FrameStorage(frames, transitions, frame_stack=STACK))


def make_batches(seed: int = 0, **options: Any) -> DeviceBatches:
    datasets = {"a": make_dataset(1), "b": make_dataset(2, lengths=(9,))}
    return DeviceBatches(datasets, **{"batch_size": 16, "keys": KEYS, "seed": seed, **options})


@pytest.mark.parametrize("captures", [False, True])
@pytest.mark.parametrize("pad", [0, 4])
def test_pixels_equal_those_of_the_cpu_for_the_same_draws(pad: int, captures: bool) -> None:
    batches = make_batches(pad=pad, captures=captures, keys=[*KEYS, "action"])
    for domain in ("a", "b", "a", "a"):
        batch = batches.sample(domain)
        dataset = batches.datasets[domain]
        index = batches.draws["index"]
        sampled = dataset._storage.get(index)
        assert torch.equal(batch["action"], sampled["action"])
        for number, key in enumerate(KEYS):
            offsets = batches.draws[f"offsets_{number}"]
            assert offsets.min() >= 0
            assert offsets.max() <= 2 * pad
            row, step = sampled["row"] + number, sampled["step"] + number
            rows = stack_rows(row, step, STACK)
            expected = shifted_stacks(dataset.frames["pixels"], rows, offsets, pad=pad)
            assert torch.equal(batch.get(key), expected)
            if pad == 0:
                assert torch.equal(batch.get(key), sampled.get(key))


def test_every_transition_and_every_shift_is_drawn_and_observations_are_shifted_apart() -> None:
    batches = make_batches(batch_size=4_000)
    batches.sample("a")
    draws = batches.draws
    counts = torch.bincount(draws["index"], minlength=12)
    assert len(counts) == 12
    assert counts.min() > 4_000 / 12 * 0.75
    shifts = torch.bincount(draws["offsets_0"] @ torch.tensor([9, 1]), minlength=81)
    assert len(shifts) == 81
    assert shifts.min() > 4_000 / 81 * 0.4
    assert not torch.equal(draws["offsets_0"], draws["offsets_1"])


def test_a_view_is_the_same_observation_under_its_own_shift() -> None:
    batches = make_batches(keys=["pixels", "pixels_view"], views={"pixels_view": "pixels"})
    plain = make_batches(keys=["pixels", "pixels_view"], views={"pixels_view": "pixels"}, pad=0)
    batch, whole = batches.sample("a").clone(), plain.sample("a")
    assert torch.equal(whole["pixels"], whole["pixels_view"])
    assert not torch.equal(batch["pixels"], batch["pixels_view"])


def test_the_seed_and_the_restored_state_repeat_the_batches() -> None:
    one, same, other = make_batches(3), make_batches(3), make_batches(4)
    first = one.sample("a")["pixels"].clone()
    assert torch.equal(first, same.sample("a")["pixels"])
    assert not torch.equal(first, other.sample("a")["pixels"])
    state = one.state_dict()
    expected = [one.sample(domain)["pixels"].clone() for domain in ("b", "a")]
    other.load_state_dict(state)
    assert all(
        torch.equal(other.sample(domain)["pixels"], value) for domain, value in zip(("b", "a"), expected)
    )


def test_a_batch_is_written_into_the_same_memory_without_a_look_at_a_value() -> None:
    batches = make_batches(captures=True)
    with NoHostReads():
        places = {batches.sample(domain)["next", "pixels"].data_ptr() for domain in ("a", "b", "a")}
    assert places == {batches.batch["next", "pixels"].data_ptr()}


def test_gathering_compiles_as_a_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    compile = torch.compile
    monkeypatch.setattr(
        torch, "compile", lambda f, **options: compile(f, backend="aot_eager", fullgraph=True, **options)
    )
    compiled, plain = make_batches(compiled=Compiled(is_on=True)), make_batches()
    for domain in ("a", "b"):
        assert torch.equal(compiled.sample(domain)["pixels"], plain.sample(domain)["pixels"])


def test_only_datasets_of_ours_that_are_alike_and_hold_the_keys_fit() -> None:
    dataset = make_dataset(0)
    assert DeviceBatches.fits({"a": dataset, "b": make_dataset(1)}, KEYS)
    assert DeviceBatches.fits({"a": dataset}, ["pixels", "pixels_view"], {"pixels_view": "pixels"})
    assert not DeviceBatches.fits({"a": dataset}, None)
    assert not DeviceBatches.fits({"a": dataset}, ["action"])
    assert not DeviceBatches.fits({"a": dataset}, [*KEYS, "skill"])
    assert not DeviceBatches.fits({"a": dataset, "b": make_dataset(1, size=10)}, KEYS)
    assert not DeviceBatches.fits({"a": dataset, "b": object()}, KEYS)
    dataset.append_transform(lambda td: td)
    assert not DeviceBatches.fits({"a": dataset}, KEYS)


def make_loss() -> ProtoLoss:
    torch.manual_seed(0)
    encoder = PixelEncoder(9, channels=(4, 4), strides=(2, 1), image_size=SIZE)
    return ProtoLoss(encoder, num_prototypes=8, latent_dim=8, hidden_dim=16)


@pytest.fixture
def _pretended_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "_is_gpu", lambda device: True)
    monkeypatch.setattr(loop, "resolve_cuda_graph", lambda *arguments, **keywords: True)


def pretrain_two(updates: int, run_dir: Path | None = None) -> ProtoLoss:
    loss = make_loss()
    datasets = {"a": make_dataset(1), "b": make_dataset(2)}
    pretrain(loss, datasets, updates=updates, run_dir=run_dir, **SETTINGS)
    return loss


@pytest.mark.usefixtures("_pretended_gpu")
def test_pretraining_takes_its_batches_from_there_and_continues_with_the_same_ones(tmp_path: Path) -> None:
    whole = pretrain_two(12)
    assert whole.training_record["settings"]["batches"] == "drawn on the device"
    assert whole.training_record["cuda_graph"]
    pretrain_two(7, tmp_path)
    assert same_state(pretrain_two(12, tmp_path), whole)


def test_a_run_with_batches_of_the_cpu_is_not_continued_with_those_of_the_device(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loss = pretrain_two(4, tmp_path)
    assert "batches" not in loss.training_record["settings"]
    monkeypatch.setattr(loop, "_is_gpu", lambda device: True)
    with pytest.raises(CheckpointError, match="batches was 'absent', now 'drawn on the device'"):
        pretrain_two(8, tmp_path)
