from __future__ import annotations

import json
import multiprocessing
import shutil

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import RandomSampler, ReplayBuffer, SliceSampler
from torchrl.envs import CatFrames, TransformedEnv
from toy_world import ToyEnv, random_episode, variable_length

from crptpro.data import EpisodeWriter, FrameDataset, FrameStorage
from crptpro.data.collect_worker import episode_from_rollout
from crptpro.data.layout import COLLECTION_FILE, FORMAT, VERSION, write_tensordict_metadata
from crptpro.errors import DatasetError

LENGTHS = (4, 1, 7, 2, 12)


def write_dataset(path, episodes):
    """A finished dataset of these episodes, as collection leaves it."""
    with EpisodeWriter(path, episodes[0].layout) as writer:
        for episode in episodes:
            writer.append(episode)
        write_tensordict_metadata(path, writer.layout, writer.transitions, writer.frames)
        card = {
            "format": FORMAT,
            "version": VERSION,
            "domain": "toy",
            "task": "toy_go",
            "seed": 0,
            "quality": "exact",
            "action_repeat": 2,
            "frame_stack": 3,
            "transitions": writer.transitions,
            "frames": writer.frames,
            "episodes": writer.episodes,
            "layout": writer.layout.to_dict(),
            "crc32": [entry.crc32 for entry in writer.entries],
        }
    (path / "card.json").write_text(json.dumps(card))
    return path


@pytest.fixture(scope="module")
def episodes():
    return [random_episode(length, seed=index) for index, length in enumerate(LENGTHS)]


@pytest.fixture(scope="module")
def path(tmp_path_factory, episodes):
    return write_dataset(tmp_path_factory.mktemp("dataset") / "toy", episodes)


@pytest.fixture
def dataset(path):
    return FrameDataset.open(path)


@pytest.mark.parametrize("frame_stack", [1, 2, 3, 4])
def test_stacks_equal_a_live_stack_at_every_step(tmp_path, frame_stack):
    rollouts, collected = [], []
    for seed in range(4):
        stacked = TransformedEnv(
            ToyEnv(variable_length, seed=seed),
            CatFrames(N=frame_stack, dim=-3, in_keys=["pixels"], padding="same"),
        )
        torch.manual_seed(seed)
        rollouts.append(stacked.rollout(100))
        torch.manual_seed(seed)
        collected.append(episode_from_rollout(ToyEnv(variable_length, seed=seed).rollout(100)))
    dataset = FrameDataset.open(write_dataset(tmp_path / "toy", collected), frame_stack=frame_stack)
    live = torch.cat(rollouts)
    assert len(dataset) == len(live)
    everything = dataset[:]
    for key in ("pixels", ("next", "pixels"), "action", ("next", "reward"), ("next", "done")):
        assert torch.equal(everything[key], live[key]), key
    first = torch.cat([rollouts[1]["pixels"], rollouts[1]["next", "pixels"][-1:]])
    assert torch.equal(dataset.episode_stacks(1), first)


def test_no_pair_crosses_an_episode(dataset, episodes):
    everything = dataset[:]
    flat = {name: value for name, value in everything.items() if name in ("episode", "step")}
    for i in range(len(dataset)):
        episode, step = episodes[int(flat["episode"][i])], int(flat["step"][i])
        for key, newest in (("pixels", step), (("next", "pixels"), step + 1)):
            frames = [episode.pixels[max(0, newest - age)] for age in (2, 1, 0)]
            assert torch.equal(everything[key][i], torch.cat([torch.from_numpy(frame) for frame in frames]))
    is_last = everything["next", "done"].squeeze(-1).nonzero().squeeze(-1)
    assert (is_last + 1).tolist() == torch.tensor(LENGTHS).cumsum(0).tolist()


def test_sampling_is_uniform_over_all_pairs(dataset):
    dataset.set_rng(torch.Generator().manual_seed(0))
    draws = 26_000
    batch = dataset.sample(draws)
    index = batch["row"] - batch["episode"]
    counts = torch.bincount(index, minlength=len(dataset))
    expected = draws / len(dataset)
    chi_square = ((counts - expected) ** 2 / expected).sum()
    assert chi_square < 60  # 25 degrees of freedom: exceeded once in 10,000 seeds


def test_pixels_are_uint8_and_do_not_alias(dataset):
    batch = dataset.sample(5)
    assert batch["pixels"].dtype == batch["next", "pixels"].dtype == torch.uint8
    assert batch["pixels"].shape == (5, 9, 6, 6)
    assert batch["pixels"].is_contiguous()
    before = dataset.frames["pixels"].clone()
    following = batch["next", "pixels"].clone()
    batch["pixels"].zero_()
    assert torch.equal(batch["next", "pixels"], following)
    assert torch.equal(dataset.frames["pixels"], before)


def test_writing_to_the_mapped_frames_leaves_the_file_alone(path):
    dataset = FrameDataset.open(path)
    dataset.frames["pixels"].zero_()
    assert FrameDataset.open(path).frames["pixels"].any()


def test_the_same_generator_gives_the_same_batches(path):
    def batches():
        dataset = FrameDataset.open(path, batch_size=4)
        dataset.set_rng(torch.Generator().manual_seed(3))
        return [dataset.sample() for _ in range(3)]

    for first, second in zip(batches(), batches()):
        assert (first == second).all()


def test_a_sample_without_pixels_names_the_frames_that_a_sample_with_pixels_shows(path):
    whole, bare = (FrameDataset.open(path, generator=torch.Generator().manual_seed(3)) for _ in range(2))
    shown, named = whole.sample(40), bare.sample(40, pixels=False)
    assert "pixels" not in named.keys() and ("next", "pixels") not in named.keys(True)  # noqa: SIM118, PT018
    for key, rows in bare.stack_rows_of(named).items():
        assert torch.equal(bare.frames["pixels"][rows].flatten(1, 2), shown[key])
    for key in ("row", "action", ("next", "reward")):
        assert torch.equal(named[key], shown[key])
    assert "pixels" in bare.sample(2).keys()  # noqa: SIM118


def test_plain_torchrl_buffers_read_it(path):
    storage = FrameStorage.open(path)
    rb = ReplayBuffer(storage=storage, sampler=RandomSampler(), batch_size=6)
    assert rb.sample()["next", "pixels"].shape == (6, 9, 6, 6)
    assert len(rb) == sum(LENGTHS)
    sampler = SliceSampler(slice_len=2, traj_key="episode", strict_length=False, truncated_key=None)
    slices = ReplayBuffer(storage=storage, sampler=sampler, batch_size=8).sample()
    assert len(slices) <= 8
    assert slices["pixels"].shape[1:] == (9, 6, 6)


def test_a_torchrl_transform_sees_the_stacks(path):
    from torchrl.envs.transforms import ToTensorImage

    keys = ["pixels", ("next", "pixels")]
    dataset = FrameDataset.open(path, batch_size=3, transform=ToTensorImage(in_keys=keys), prefetch=1)
    assert dataset.sample()["next", "pixels"].dtype == torch.float32


@pytest.mark.parametrize("index", [3, -1, slice(2, 9, 3), [0, 5], torch.tensor([[1, 2], [3, 4]]), range(3)])
def test_indexing_follows_tensors(dataset, index):
    expected = dataset.transitions["row"][list(index) if isinstance(index, range) else index]
    assert torch.equal(dataset[index]["row"], expected)


def test_a_mask_selects_and_an_index_out_of_range_is_refused(dataset):
    mask = dataset.transitions["episode"] == 2
    assert len(dataset[mask]) == LENGTHS[2]
    with pytest.raises(IndexError, match="26 transitions"):
        dataset[26]


def test_frames_and_physics_are_read_by_row(dataset, episodes):
    rows = torch.tensor([[0, 4], [5, 7]])
    assert dataset.frames_at(rows).shape == (2, 2, 3, 6, 6)
    assert torch.equal(dataset.frames_at(rows)[1, 0], torch.from_numpy(episodes[1].pixels[0]))
    physics = dataset.physics_at(rows)
    assert physics["qpos"].dtype == torch.float64
    assert torch.equal(physics["qvel"][1, 0], torch.from_numpy(episodes[1].state["qvel"][0]))


def test_a_domain_without_physics_says_so(tmp_path):
    dataset = FrameDataset.open(write_dataset(tmp_path / "toy", [random_episode(3, state=False)]))
    with pytest.raises(DatasetError, match="no physical state"):
        dataset.physics_at(torch.tensor([0]))


def test_tensordict_opens_both_stores(path, episodes):
    frames, transitions = (TensorDict.load_memmap(path / part) for part in ("frames", "transitions"))
    assert frames["pixels"].shape == (sum(LENGTHS) + len(LENGTHS), 3, 6, 6)
    assert torch.equal(transitions["action"][4], torch.from_numpy(episodes[1].action[0]))
    assert transitions["next", "done"].sum() == len(LENGTHS)


def _sample_in_another_process(path, connection):
    dataset = FrameDataset.open(path)
    dataset.set_rng(torch.Generator().manual_seed(1))
    connection.send(dataset.sample(8)["pixels"].numpy())


def test_two_processes_open_it_at_once(path):
    dataset = FrameDataset.open(path)
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_sample_in_another_process, args=(path, theirs))
    process.start()
    dataset.set_rng(torch.Generator().manual_seed(1))
    mine = dataset.sample(8)["pixels"]
    assert torch.equal(torch.from_numpy(ours.recv()), mine)
    process.join()


def test_pickling_a_storage_reopens_the_file(path):
    import pickle

    content = pickle.dumps(FrameStorage.open(path, frame_stack=2))
    assert len(content) < 1000
    assert pickle.loads(content).frame_stack == 2


def test_it_cannot_be_written(dataset):
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        dataset.extend(dataset.sample(2))
    with pytest.raises(DatasetError, match="read-only"):
        dataset[0] = dataset[1]


def test_a_checkpoint_refers_to_the_dataset(dataset, tmp_path, episodes):
    dataset.dumps(tmp_path / "checkpoint")
    assert (
        sum(file.stat().st_size for file in (tmp_path / "checkpoint").rglob("*") if file.is_file()) < 10_000
    )
    dataset.loads(tmp_path / "checkpoint")
    other = FrameDataset.open(write_dataset(tmp_path / "other", episodes[:3]))
    with pytest.raises(DatasetError, match="another dataset: transitions was 26"):
        other.loads(tmp_path / "checkpoint")


@pytest.fixture
def copy(path, tmp_path):
    return shutil.copytree(path, tmp_path / "copy")


@pytest.mark.parametrize(
    "file", ["frames/pixels.memmap", "frames/qpos.memmap", "transitions/next/done.memmap"]
)
def test_a_missing_or_truncated_file_is_named(copy, file):
    content = (copy / file).read_bytes()
    (copy / file).write_bytes(content[:-1])
    with pytest.raises(
        DatasetError, match=f"{file} is truncated: {len(content) - 1:,} bytes.*{len(content):,}"
    ):
        FrameDataset.open(copy)
    (copy / file).unlink()
    with pytest.raises(DatasetError, match=f"{file} is missing"):
        FrameDataset.open(copy)


def test_what_is_no_dataset_is_named(copy, tmp_path):
    with pytest.raises(DatasetError, match="is not a directory"):
        FrameDataset.open(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match=r"not a dataset. Did you mean one of its datasets: copy\?"):
        FrameDataset.open(tmp_path)
    (copy / "card.json").write_text('{"format": "safetensors"}')
    with pytest.raises(DatasetError, match="its format is 'safetensors'"):
        FrameDataset.open(copy)
    (copy / "card.json").write_text('{"format": "crptpro-frames", "version": 99}')
    with pytest.raises(DatasetError, match="version 99, this release reads version 1"):
        FrameDataset.open(copy)
    (copy / "card.json").write_text("{")
    with pytest.raises(DatasetError, match="damaged or foreign"):
        FrameDataset.open(copy)


@pytest.mark.parametrize(
    ("field", "value"), [("frames", 5), ("transitions", "many"), ("layout", {}), ("layout", None)]
)
def test_a_card_that_cannot_be_is_refused(copy, field, value):
    card = json.loads((copy / "card.json").read_text())
    (copy / "card.json").write_text(json.dumps(card | {field: value}))
    with pytest.raises(DatasetError, match=f"damaged.*{field}"):
        FrameDataset.open(copy)


def test_an_unfinished_collection_says_how_far_it_is(copy):
    (copy / "card.json").unlink()
    (copy / COLLECTION_FILE).write_text('{"request": {"transitions": 100}}')
    with pytest.raises(DatasetError, match=r"26 of 100 transitions.*same collect command"):
        FrameDataset.open(copy)


def test_an_impossible_frame_stack_is_refused(path):
    with pytest.raises(DatasetError, match="frame_stack must be at least 1, got 0"):
        FrameDataset.open(path, frame_stack=0)


def test_verify_finds_a_flipped_bit(copy):
    dataset = FrameDataset.open(copy)
    dataset.verify()
    pixels = copy / "frames/pixels.memmap"
    content = bytearray(pixels.read_bytes())
    content[6 * 6 * 3 * 8] ^= 1  # frame row 8 belongs to episode 2
    pixels.write_bytes(content)
    with pytest.raises(DatasetError, match="Episode 2 of"):
        FrameDataset.open(copy).verify()
