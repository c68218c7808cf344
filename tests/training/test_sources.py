from __future__ import annotations

import pytest
import torch
from tensordict import NestedKey, TensorDict
from torchrl.envs import ToTensorImage

from crptpro.data import FrameDataset, FrameStorage
from crptpro.errors import DatasetError
from crptpro.training.pretrain.sources import Augmenter, Source

EPISODES, LENGTH, SIZE = 4, 6, 12


def make_dataset(**options: object) -> FrameDataset:
    """Short episodes, so that many stacks begin before their episode does."""
    generator = torch.Generator().manual_seed(0)
    frames = EPISODES * (LENGTH + 1)
    pixels = torch.randint(0, 256, (frames, 3, SIZE, SIZE), dtype=torch.uint8, generator=generator)
    step = torch.arange(LENGTH).repeat(EPISODES)
    first = torch.arange(EPISODES).repeat_interleave(LENGTH) * (LENGTH + 1)
    transitions = TensorDict(
        {"row": first + step, "step": step, "action": torch.rand(len(step), 2, generator=generator)},
        [len(step)],
    )
    return FrameDataset(FrameStorage(TensorDict({"pixels": pixels}, [frames]), transitions), **options)


@pytest.mark.parametrize("keys", [None, ["pixels", ("next", "pixels")], ["pixels", "action"]])
def test_shifting_while_reading_gives_the_batches_of_reading_and_then_shifting(
    keys: list[NestedKey] | None,
) -> None:
    fused, plain = Source("toy", make_dataset(), seed=5), Source("toy", make_dataset(), seed=5)
    first, second = Augmenter("random_shift", seed=7), Augmenter("random_shift", seed=7)
    assert fused.is_shifted_when_read
    for _ in range(3):
        ours, theirs = first.sample(fused, 50, keys), second(plain.sample(50, keys))
        assert set(ours.keys(True, True)) == set(theirs.keys(True, True))
        assert all(torch.equal(ours[key], theirs[key]) for key in theirs.keys(True, True))
    assert torch.equal(first.generator.get_state(), second.generator.get_state())


def test_without_augmentation_the_stacks_are_as_they_were_seen() -> None:
    source = Source("toy", make_dataset(), seed=5)
    expected = Source("toy", make_dataset(), seed=5).sample(20, ["pixels"])
    assert torch.equal(Augmenter("none", seed=0).sample(source, 20, ["pixels"])["pixels"], expected["pixels"])


def test_a_dataset_with_transforms_or_prefetching_of_its_own_is_read_its_own_way() -> None:
    transform = ToTensorImage(in_keys=["pixels"])
    assert not Source("toy", make_dataset(transform=transform), seed=0).is_shifted_when_read
    assert not Source("toy", make_dataset(prefetch=1, batch_size=2), seed=0).is_shifted_when_read
    assert not Source("toy", make_dataset(collate_fn=lambda batch: batch), seed=0).is_shifted_when_read
    with pytest.raises(ValueError, match="cannot leave the pixels out"):
        make_dataset(prefetch=1, batch_size=4).sample(pixels=False)


def test_an_entry_that_the_dataset_lacks_is_named_either_way() -> None:
    source = Source("toy", make_dataset(), seed=0)
    for augment in ("random_shift", "none"):
        with pytest.raises(
            DatasetError, match=r"reads 'skill', which the dataset 'toy' lacks; it has .*action"
        ):
            Augmenter(augment, seed=0).sample(source, 4, ["pixels", "skill"])
