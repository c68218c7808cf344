from __future__ import annotations

import pytest
import torch
from tensordict import NestedKey, TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import ToTensorImage

from crptpro.data import FrameDataset, FrameStorage
from crptpro.errors import DatasetError
from crptpro.seeding import derive_seed
from crptpro.training.pretrain.augmenter import Augmenter
from crptpro.training.pretrain.sources import Source
from crptpro.transforms.random_shift import draw_offsets, random_shift

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


# Second views -----------------------------------------------------------------------------------------------------

NEXT = ("next", "pixels")
VIEWS = {"pixels_view": "pixels", ("next", "pixels_view"): NEXT}


@pytest.mark.parametrize(
    ("views", "keys"),
    [
        ({"pixels_view": "pixels"}, ["pixels", "pixels_view"]),
        ({"pixels_view": "pixels"}, ["action", "pixels_view"]),
        (VIEWS, ["pixels", NEXT, *VIEWS]),
        (VIEWS, None),
    ],
)
def test_views_are_the_same_numbers_whichever_way_the_stacks_are_read(
    views: dict[NestedKey, NestedKey], keys: list[NestedKey] | None
) -> None:
    class ReadItsOwnWay(Source):
        is_shifted_when_read = False

    fused = Source("toy", make_dataset(), seed=5)
    plain = ReadItsOwnWay("toy", make_dataset(), seed=5)
    first, second = (Augmenter("random_shift", seed=7, views=views) for _ in range(2))
    for _ in range(3):
        ours, theirs = first.sample(fused, 50, keys), second.sample(plain, 50, keys)
        assert set(views) | set(keys or []) <= set(ours.keys(True, True)) == set(theirs.keys(True, True))
        assert all(torch.equal(ours[key], theirs[key]) for key in theirs.keys(True, True))
    assert torch.equal(first.generator.get_state(), second.generator.get_state())


def test_offsets_are_drawn_by_name_and_those_of_views_come_last() -> None:
    raw = Source("toy", make_dataset(), seed=5).sample(20, ["pixels", NEXT])
    generator = torch.Generator().manual_seed(derive_seed(7, "pretrain", "augment"))
    expected = {
        entry: random_shift(raw[key], draw_offsets(20, 4, generator))
        for entry, key in (
            (NEXT, NEXT),
            ("pixels", "pixels"),
            (("next", "pixels_view"), NEXT),
            ("pixels_view", "pixels"),
        )
    }
    for views in ({}, {"pixels_view": "pixels"}, VIEWS):
        source = Source("toy", make_dataset(), seed=5)
        batch = Augmenter("random_shift", seed=7, views=views).sample(source, 20, ["pixels", NEXT, *views])
        assert torch.equal(batch["pixels"], expected["pixels"])
        assert torch.equal(batch[NEXT], expected[NEXT])
    assert all(torch.equal(batch[view], expected[view]) for view in VIEWS)
    assert not torch.equal(batch["pixels_view"], batch["pixels"])


def test_without_augmentation_a_view_equals_its_entry() -> None:
    source = Source("toy", make_dataset(), seed=5)
    batch = Augmenter("none", seed=0, views=VIEWS).sample(source, 20, ["pixels", NEXT, *VIEWS])
    assert all(torch.equal(batch[view], batch[key]) for view, key in VIEWS.items())


def test_an_own_augmentation_gets_every_view_as_a_copy() -> None:
    def darken(batch: TensorDict, generator: torch.Generator) -> TensorDict:
        batch["pixels"].zero_()
        return batch

    raw = Source("toy", make_dataset(), seed=5).sample(20, ["pixels"])
    source = Source("toy", make_dataset(), seed=5)
    augmenter = Augmenter(darken, seed=0, views={"pixels_view": "pixels"})
    batch = augmenter.sample(source, 20, ["pixels", "pixels_view"])
    assert not batch["pixels"].any()
    assert torch.equal(batch["pixels_view"], raw["pixels"])


def test_a_view_of_an_entry_that_the_dataset_lacks_names_that_entry() -> None:
    source = Source("toy", make_dataset(), seed=0)
    for augment in ("random_shift", "none"):
        augmenter = Augmenter(augment, seed=0, views={"wide_view": "wide"})
        with pytest.raises(DatasetError, match="reads 'wide', which the dataset 'toy' lacks"):
            augmenter.sample(source, 4, ["pixels", "wide_view"])


def test_images_that_are_no_bytes_are_not_shifted_which_is_said_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    floats = Source("floats", make_dataset(transform=ToTensorImage(in_keys=["pixels"])), seed=0)
    bytes_of = Source("bytes", make_dataset(collate_fn=lambda batch: batch), seed=0)
    augmenter = Augmenter("random_shift", seed=7)
    plain = Source("floats", make_dataset(transform=ToTensorImage(in_keys=["pixels"])), seed=0)
    for _ in range(2):
        batch = augmenter.sample(floats, 20, ["pixels", NEXT])
        expected = plain.sample(20, ["pixels", NEXT])
        assert torch.equal(batch["pixels"], expected["pixels"])
        assert not torch.equal(batch[NEXT], expected[NEXT])
    assert len([r for r in caplog.records if "'pixels' (torch.float32)" in r.message]) == 1
    # What one dataset holds decides nothing for the next.
    expected = Source("bytes", make_dataset(), seed=0).sample(20, ["pixels"])
    assert not torch.equal(augmenter.sample(bytes_of, 20, ["pixels"])["pixels"], expected["pixels"])


def test_prefetching_is_said_to_end_in_other_numbers(caplog: pytest.LogCaptureFixture) -> None:
    Source("eager", make_dataset(prefetch=1, batch_size=2), seed=0)
    assert "'eager' prefetches" in caplog.text
    caplog.clear()
    Source("plain", make_dataset(), seed=0)
    assert not caplog.records


def test_which_rows_count_comes_with_the_batch() -> None:
    data = TensorDict({"pixels": torch.zeros(6, 3, 4, 4), "shifted_valid": torch.arange(6) > 2}, [6])
    buffer = ReplayBuffer(storage=LazyTensorStorage(6), batch_size=4)
    buffer.extend(data)
    batch = Source("masked", buffer, seed=0).sample(4, ["pixels"])
    assert set(batch.keys()) == {"pixels", "shifted_valid"}
