from __future__ import annotations

import copy
import errno
import itertools
import math
import os
import pickle
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
import toy_env
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import PrioritizedSampler, SamplerWithoutReplacement, SliceSampler
from torchrl.envs import CatFrames, SerialEnv, Transform, TransformedEnv
from torchrl.modules import RandomPolicy
from toy_env import ToyEnv, rollout_of, variable_length

from crptpro.data import FrameDataset, FrameReplay, StoredReplay, storage
from crptpro.errors import CheckpointError, DatasetError, DiskSpaceError, NonFiniteError

GAMMA = 0.9


def frame(number: int) -> torch.Tensor:
    return torch.full((3, 2, 2), number % 251, dtype=torch.uint8)


def small(capacity: int = 20, **options: Any) -> FrameReplay:
    return FrameReplay(capacity, frame_shape=(3, 2, 2), action_dim=1, **options)


class RunningMean(Transform):
    """Has a state that every sample changes."""

    def __init__(self) -> None:
        super().__init__(in_keys=["action"])
        self.register_buffer("mean", torch.zeros(()))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.mean.lerp_(tensordict["action"].mean(), 0.5)
        return tensordict


class Driver:
    """Writes episodes whose frames, rewards and actions count up, and knows what must be in the replay."""

    def __init__(self, replay: FrameReplay, length: int = 9, chunk: int = 1):
        self.replay, self.length, self.chunk, self.number = replay, length, chunk, 0
        self.episode: list[int] = []
        self.history: list[tuple[list[int], int]] = []

    def step(self) -> TensorDict:
        if not self.episode:
            self.episode = [self.number]
            self.number += 1
        padded = [self.episode[0]] * 3 + self.episode
        self.episode.append(self.number)
        is_last = len(self.episode) == self.length + 1
        end = ("terminated" if self.number % 2 else "truncated") if is_last else ""
        value = torch.tensor([[float(self.number)]])
        row = rollout_of(torch.stack([frame(0)] * 2), action=value, reward=value, end=end)[0]
        row["pixels"] = torch.cat([frame(n) for n in padded[-3:]])
        row["next", "pixels"] = torch.cat([frame(n) for n in [*padded, self.number][-3:]])
        self.history.append((list(self.episode), self.number))
        self.number += 1
        if is_last:
            self.episode = []
        return row

    def write(self, transitions: int) -> Driver:
        rows = [self.step() for _ in range(transitions)]
        for begin in range(0, len(rows), self.chunk):
            part = rows[begin : begin + self.chunk]
            self.replay.add(part[0]) if self.chunk == 1 else self.replay.extend(torch.stack(part))
        return self

    def check(self) -> None:
        everything = self.replay[:]
        for i, (episode, number) in enumerate(self.history[len(self.history) - len(self.replay) :]):
            padded = [episode[0]] * 3 + episode
            assert torch.equal(everything["pixels"][i], torch.cat([frame(n) for n in padded[-4:-1]]))
            assert torch.equal(everything["next", "pixels"][i], torch.cat([frame(n) for n in padded[-3:]]))
            assert everything["next", "reward"][i].item() == everything["action"][i].item() == number
            done, ended = everything["next", "done"][i], len(episode) == self.length + 1
            assert done == (everything["next", "terminated"][i] | everything["next", "truncated"][i])
            assert done.item() == ended

    def windows(self, n: int) -> dict[float, tuple[float, float]]:
        """First reward of a window -> n-step return and discount, by the loop of url_benchmark."""
        valid = self.history[len(self.history) - len(self.replay) :]
        found = {}
        for i in range(len(valid) - n + 1):
            episodes = [valid[i + j][0] for j in range(n)]
            if any(later[:-1] != earlier for earlier, later in itertools.pairwise(episodes)):
                continue
            reward, discount = 0.0, 1.0
            for episode, number in valid[i : i + n]:
                reward += discount * number
                terminated = len(episode) == self.length + 1 and number % 2 == 1
                discount *= (0.0 if terminated else 1.0) * GAMMA
            found[float(valid[i][1])] = (reward, discount)
        return found


@pytest.mark.parametrize("length", [1, 2, 9, 1000])
@pytest.mark.parametrize(("on_disk", "chunk"), [(False, 1), (True, 1), (False, 7), (False, 50)])
def test_it_holds_the_newest_transitions_as_live_stacks(tmp_path: Path, length: int, on_disk: bool, chunk: int) -> None:
    replay = small(path=tmp_path / "ring" if on_disk else None, slack=5)
    driver = Driver(replay, length, chunk)
    for transitions in (1, 3, 30, 17, 44, 1):
        driver.write(transitions).check()
        assert len(replay) <= 20
    assert len(replay) == 20 or length == 1  # very short episodes cost a frame more per transition


@pytest.mark.parametrize(("frame_stack", "stacked"), [(3, False), (3, True), (4, False)])
def test_what_a_collector_hands_out_is_sampled_as_catframes_showed_it(frame_stack: int, stacked: bool) -> None:
    catframes = CatFrames(N=frame_stack, dim=-3, in_keys=["pixels"], padding="same")
    env, seen = TransformedEnv(ToyEnv(variable_length, seed=4), catframes), []
    replay = FrameReplay(100, frame_shape=(3, 8, 8), action_dim=2, frame_stack=frame_stack)
    for rollout in Collector(env, frames_per_batch=10, total_frames=60):
        seen.append(rollout.clone())
        if not stacked:  # as an environment without CatFrames
            for part in (rollout, rollout["next"]):
                part["pixels"] = part["pixels"][:, -3:]
        replay.extend(rollout)
    expected, everything = torch.cat(seen), replay[:]
    for key in ("pixels", ("next", "pixels"), "action", ("next", "reward"), ("next", "done")):
        assert torch.equal(everything[key], expected[key]), key


def test_rollouts_of_several_environments_are_stored_one_after_another() -> None:
    catframes = CatFrames(N=3, dim=-3, in_keys=["pixels"], padding="same")
    envs = [lambda seed=seed: TransformedEnv(ToyEnv(variable_length, seed=seed), catframes.clone()) for seed in (4, 5)]
    replay, seen = FrameReplay(100, frame_shape=(3, 8, 8), action_dim=2), []
    for rollout in Collector(SerialEnv(2, envs), frames_per_batch=20, total_frames=60):
        assert rollout.shape == (2, 10)
        seen.append(rollout.reshape(-1).clone())
        replay.extend(seen[-1])
    expected, everything = torch.cat(seen), replay[:]
    for key in ("pixels", ("next", "pixels"), "action", ("next", "reward"), ("next", "done")):
        assert torch.equal(everything[key], expected[key]), key


def test_what_does_not_continue_begins_an_episode() -> None:
    replay = small()
    replay.extend(rollout_of(torch.stack([frame(1), frame(2)]), end=""))
    replay.extend(rollout_of(torch.stack([frame(100), frame(101)]), end=""))  # another one, nothing was done
    late = rollout_of(torch.stack([frame(7), frame(8)]), end="")
    late["pixels"] = torch.cat([frame(5), frame(6), frame(7)]).unsqueeze(0)  # joins an episode under way
    late["next", "pixels"] = torch.cat([frame(6), frame(7), frame(8)]).unsqueeze(0)
    assert replay.extend(late).tolist() == [6]
    assert replay.extend(late[:0]).tolist() == []
    shown = replay[:]
    assert shown["pixels"][:, ::3, 0, 0].tolist() == [[1, 1, 1], [100, 100, 100], [5, 6, 7]]
    assert shown["next", "pixels"][:, ::3, 0, 0].tolist() == [[1, 1, 2], [100, 100, 101], [6, 7, 8]]


def test_misuse_is_refused_in_words_and_stores_nothing() -> None:
    replay, good = small(), rollout_of(torch.stack([frame(1), frame(2)]))
    refusals = [
        (good.clone().set("pixels", good["pixels"].float()), "takes uint8 pixels"),
        (good.clone().set("action", torch.zeros(1, 2)), r"action of shape \(1,\), got \(2,\)"),
        (good.exclude("action"), "needs 'action' with every transition"),
        (good.unsqueeze(0), r"one environment in temporal order, got TensorDict \[1, 1\]; .*reshape\(-1\)"),
        (good.clone().set("pixels", torch.zeros(1, 12, 2, 2, dtype=torch.uint8)), "takes uint8 pixels"),
        (rollout_of(torch.zeros(2, 3, 4, 4, dtype=torch.uint8)), "holds pixels of shape"),
        (good.clone().set(("collector", "mask"), torch.tensor([False])), "takes no padding: extend it by rollout"),
    ]
    for data, message in refusals:
        with pytest.raises(ValueError, match=message):
            replay.extend(data)
    with pytest.raises(DatasetError, match="use extend"):
        replay[0] = good[0]
    for options in ({"capacity": 0}, {"slack": -1}, {"n_step": 0}, {"frame_stack": 0}, {"discount": 2}):
        with pytest.raises(ValueError, match=next(iter(options))):
            small(**options)
    with pytest.raises(ValueError, match="keeps no priorities"):
        small(sampler=PrioritizedSampler.__new__(PrioritizedSampler))
    for name in ("reward", "next", "row_of"):
        with pytest.raises(ValueError, match=name):
            small(extra_columns={name: ((1,), torch.float32)})
    assert len(replay) == 0


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e39])
def test_numbers_that_are_not_finite_never_enter_a_replay_or_a_dataset(tmp_path: Path, value: float) -> None:
    replay, dataset = small(), FrameDataset.create(tmp_path, domain="mine", transitions=3)
    for name, key in {"reward": ("next", "reward"), "action": "action"}.items():
        rows = rollout_of(torch.stack([frame(number) for number in range(4)]))
        rows[key] = rows[key].double()  # 1e39 is no float32
        rows[key][1] = value
        for store in (replay, dataset):
            with pytest.raises(NonFiniteError, match=f"The {name} of transition 1 is "):
                store.extend(rows)
    assert len(replay) == len(dataset) == 0


@pytest.mark.parametrize("n_step", [1, 3])
def test_sampling_is_uniform_over_valid_transitions(n_step: int) -> None:
    replay = small(generator=torch.Generator().manual_seed(0), returns_pixels=False, n_step=n_step)
    valid = len(Driver(replay).write(47).windows(n_step))
    counts = torch.bincount(replay.sample(1000 * valid)["index"], minlength=20)
    counts = counts[counts > 0]
    assert len(counts) == valid
    assert ((counts - 1000.0) ** 2 / 1000).sum() < 50  # at most 19 degrees of freedom: once in 7,000 seeds


def test_numbers_identify_observations_and_are_never_reused(tmp_path: Path) -> None:
    replay = small(path=tmp_path)
    driver, seen = Driver(replay, length=7), dict[int, bytes]()
    for _ in range(12):
        batch = driver.write(9).replay.sample(32)
        for part in (batch, batch["next"]):
            assert torch.equal(replay.observations(part["number"]), part["pixels"])
            for number, pixels in zip(part["number"].tolist(), part["pixels"]):
                assert seen.setdefault(number, pixels.numpy().tobytes()) == pixels.numpy().tobytes()
        held = replay[:]
        held = torch.cat([held["number"], held["next", "number"]]).unique()
        assert len((held % replay.window).unique()) == len(held)
    assert replay.frames_written - 1 == held[-1]
    for gone in (0, replay.frames_written):
        with pytest.raises(DatasetError, match=f"Observation {gone} is not stored"):
            replay.observations(torch.tensor([gone]))


def test_extra_columns_belong_to_the_transition_and_are_sampled_at_the_root(tmp_path: Path) -> None:
    replay = small(10, path=tmp_path, extra_columns={"code": ((2,), torch.bfloat16)}, n_step=3)
    code = torch.tensor([[i, i + 0.5] for i in range(3)])
    replay.extend(rollout_of(torch.stack([frame(i) for i in range(4)]), code=code))
    # Of a window it is the first transition's: what was in force at the observation.
    assert replay.sample(4)["code"].tolist() == [[0.0, 0.5]] * 4
    assert replay.sample(4)["code"].dtype == torch.bfloat16
    with pytest.raises(ValueError, match="needs 'code'"):
        replay.extend(rollout_of(torch.stack([frame(1), frame(2)])))


@pytest.mark.parametrize(("n", "length"), [(2, 6), (3, 9), (5, 6), (5, 1000)])
def test_windows_and_their_returns_are_those_of_the_published_loop(n: int, length: int) -> None:
    replay = small(40, n_step=n, discount=GAMMA, generator=torch.Generator().manual_seed(0))
    driver = Driver(replay, length)
    for transitions in (13, 20, 60):
        expected = driver.write(transitions).windows(n)
        batch = replay.sample(400)
        assert {float(action) for action in batch["action"]} == set(expected)
        for row in batch:
            reward, discount = expected[float(row["action"])]
            assert row["next", "reward"].item() == pytest.approx(reward, rel=1e-6)
            assert GAMMA**n * (not row["next", "terminated"]) == pytest.approx(discount, rel=1e-6)
            assert row["steps_to_next_obs"].item() == n
        assert torch.equal(batch["next", "number"], batch["number"] + n)
        assert torch.equal(replay.observations(batch["next", "number"]), batch["next", "pixels"])
        driver.check()  # indexing reads single transitions


def test_a_ring_that_has_lost_a_file_is_refused_instead_of_filled_with_zeros(tmp_path: Path) -> None:
    Driver(small(path=tmp_path), 4).write(12)
    for name in ("pixels", "reward"):
        (tmp_path / f"{name}.memmap").rename(tmp_path / "elsewhere")
        for _ in range(2):
            with pytest.raises(CheckpointError, match=rf"{name}\.memmap of the replay in .* is missing"):
                small(path=tmp_path)
        (tmp_path / "elsewhere").rename(tmp_path / f"{name}.memmap")
    small(path=tmp_path)


def test_what_a_frame_replay_would_store_wrongly_is_refused() -> None:
    stacks = torch.stack([torch.cat([frame(max(0, i - k)) for k in (2, 1, 0)]) for i in range(8)])
    small().extend(rollout_of(stacks))
    skipped = rollout_of(stacks[::2])
    with pytest.raises(ValueError, match="its observation moved on by one frame"):
        small().extend(skipped)
    ahead = rollout_of(stacks).set("steps_to_next_obs", torch.full((7, 1), 3))
    with pytest.raises(ValueError, match=r"takes single transitions; n_step="):
        small().extend(ahead)
    with pytest.raises(ValueError, match="leave out `sampler`"):
        small(n_step=2, sampler=SamplerWithoutReplacement())
    with pytest.raises(DatasetError, match="belongs to one process"):
        small().share()


@pytest.mark.parametrize("key", [
    {"traj_key": "episode"}, {"end_key": ("next", "done")}, {"traj_key": "episode", "cache_values": True},
])  # fmt: skip
def test_slices_of_torchrls_sampler_are_of_one_episode_in_order_and_read_no_other_stacks(
    monkeypatch: pytest.MonkeyPatch, key: dict[str, Any]
) -> None:
    sampler = SliceSampler(slice_len=4, truncated_key=None, **key)
    replay = small(40, sampler=sampler, batch_size=64)
    driver = Driver(replay, length=9).write(100)  # the newest episode is still running
    driver.check()
    assert [buffer[:].get("pixels", None) is not None for buffer in (replay, replay.storage)] == [True, False]
    gathered, gather = [], storage.gather_stacks

    def watched(frames: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        gathered.append(len(rows))
        return gather(frames, rows)

    monkeypatch.setattr(storage, "gather_stacks", watched)
    for _ in range(20):
        numbers = replay.sample()["number"].view(-1, 4)
        assert (numbers.diff(dim=1) == 1).all()
        driver.write(5)
    assert max(gathered) == 64


def test_rollouts_that_are_stored_one_after_another_are_told_apart_by_their_episode() -> None:
    replay = small(50)
    for _ in range(2):
        replay.extend(rollout_of(torch.stack([frame(n) for n in range(5)])))  # not done
    assert replay[:]["episode"].unique(return_counts=True)[1].tolist() == [4, 4]


def test_a_collector_may_fill_a_replay_and_count_what_it_wrote() -> None:
    env = ToyEnv(lambda seed: 5, image_size=6)
    replay = FrameReplay(40, frame_shape=(3, 6, 6), action_dim=env.action_spec.shape[-1])
    collected = {"frames_per_batch": 4, "total_frames": 12, "init_random_frames": 4, "replay_buffer": replay}
    counts = [replay.write_count for _ in Collector(env, RandomPolicy(env.full_action_spec), **collected)]
    assert counts == [4, 8, 12]
    assert len(replay) == 12


def test_its_transforms_and_its_generator_are_part_of_its_state() -> None:
    replay, again = (small(transform=RunningMean(), generator=torch.Generator().manual_seed(s)) for s in (1, 2))
    Driver(replay, 4).write(12)
    replay.sample(8)
    again.load_state_dict(replay.state_dict())
    assert again.transform[0].mean == replay.transform[0].mean > 0
    assert again.sample(8)["index"].equal(replay.sample(8)["index"])


def test_a_window_longer_than_every_episode_is_refused_in_words() -> None:
    replay = small(n_step=5)
    with pytest.raises(RuntimeError):
        replay.sample(2)
    driver = Driver(replay, 4)
    for _ in range(4):
        driver.write(3)
        with pytest.raises(DatasetError, match=r"n_step=5.*random_agent_steps"):
            replay.sample(2)


def test_threads_that_sample_two_views_or_extend_meanwhile_never_mix_what_they_get() -> None:
    replay = small(200, n_step=3, discount=1.0)
    driver = Driver(replay, 50).write(200)

    def sample(_: int) -> bool:
        batch = replay.sample(64)
        first = batch["action"]
        return bool(
            (batch["next", "reward"] == 3 * first + 3).all()
            and (batch["pixels"][:, -1, 0, 0] == (first.squeeze(-1) - 1) % 251).all()
            and (batch["next", "pixels"][:, -1, 0, 0] == (first.squeeze(-1) + 2) % 251).all()
        )

    with ThreadPoolExecutor(3) as threads:
        writing = threads.submit(driver.write, 400)
        assert all(threads.map(sample, range(300)))
        writing.result()


@pytest.mark.parametrize("on_disk", [False, True])
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda replay: pickle.loads(pickle.dumps(replay))])
def test_copies_hold_what_the_original_holds_and_live_apart(tmp_path: Path, on_disk: bool, copied: Any) -> None:
    replay = small(path=tmp_path if on_disk else None, generator=torch.Generator().manual_seed(3))
    driver = Driver(replay).write(33)
    other = copied(replay)
    assert (other[:] == replay[:]).all()
    assert (other.sample(8) == replay.sample(8)).all()
    before = other[:].clone()
    driver.write(20)
    assert (other[:] == before).all()
    continued = Driver(other)
    continued.number, continued.history, continued.episode = 1000, list(driver.history[:33]), []
    continued.write(15).check()


@pytest.mark.parametrize(("before", "length"), [(4, 6), (33, 1), (33, 1000), (100, 6)])
def test_an_old_state_restores_the_content_of_its_moment(tmp_path: Path, before: int, length: int) -> None:
    def build() -> FrameReplay:
        return small(path=tmp_path, slack=16, generator=torch.Generator().manual_seed(5))

    replay = build()
    driver = Driver(replay, length).write(before)
    state, content = replay.state_dict(), replay[:].clone()
    assert "content" not in state["_storage"]
    driver.write(8)  # at most 16 frames, with an episode start before each
    restored = build()
    restored.load_state_dict(state)
    assert (restored[:] == content).all()
    # The restored ring continues like one that was never interrupted.
    continued = Driver(restored, length)
    continued.number, continued.history = driver.number, list(driver.history[:before])
    continued.write(60).check()


def test_a_state_that_the_files_cannot_give_back_is_refused(tmp_path: Path) -> None:
    replay = small(path=tmp_path / "a", slack=5)
    driver = Driver(replay).write(60)
    state = replay.state_dict()
    with pytest.raises(CheckpointError, match="are gone: the files were removed or replaced"):
        small(path=tmp_path / "b", slack=5).load_state_dict(state)
    with pytest.raises(CheckpointError, match="Use the capacity and slack"):
        small(21, path=tmp_path / "c").load_state_dict(state)
    with pytest.raises(CheckpointError, match="a replay of another size"):
        small(21, path=tmp_path / "a")
    driver.write(30)
    with pytest.raises(CheckpointError, match=r"slack of 5.*checkpoint_interval_env_steps"):
        replay.load_state_dict(state)


@pytest.mark.parametrize("others", [10, 20, 40])
def test_a_state_is_refused_once_another_branch_has_overwritten_it(tmp_path: Path, others: int) -> None:
    def build() -> FrameReplay:
        return small(50, path=tmp_path, slack=60)

    replay = build()
    driver = Driver(replay, 1000).write(20)
    early, content = replay.state_dict(), replay[:].clone()
    driver.write(20)
    late = replay.state_dict()
    replay.load_state_dict(early)
    assert (replay[:] == content).all()
    Driver(replay, 1000).write(others)  # a branch of as many rows, or fewer, or more
    own, kept = replay.state_dict(), replay[:].clone()
    with pytest.raises(CheckpointError, match="from an earlier state"):
        replay.load_state_dict(late)
    again = build()
    again.load_state_dict(own)
    assert (again[:] == kept).all()
    again.load_state_dict(early)
    assert (again[:] == content).all()
    new = Driver(build(), 1000).write(others)  # nothing was loaded: it begins at the first row
    for state in (early, late, own):
        with pytest.raises(CheckpointError, match="are gone"):
            build().load_state_dict(state)
    assert len(new.replay) == others


def test_a_ring_in_ram_carries_its_content_in_the_state(tmp_path: Path) -> None:
    replay = small()
    driver = Driver(replay).write(33)
    torch.save(replay.state_dict(), tmp_path / "state.pt")
    replay.dumps(tmp_path / "dump")
    content = replay[:].clone()
    driver.write(50)
    restored, loaded = small(), small()
    restored.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    loaded.loads(tmp_path / "dump")
    assert (restored[:] == content).all()
    assert (loaded[:] == content).all()
    replay.empty()
    assert len(replay) == 0


def test_a_killed_process_leaves_a_ring_that_restores_and_half_a_file_that_any_replay_replaces(tmp_path: Path) -> None:
    program = f"""
        import os, signal, sys, torch
        sys.path[:0] = [{str(Path(__file__).parent)!r}, {str(Path(toy_env.__file__).parent)!r}]
        from test_replay import Driver, small, storage
        driver = Driver(small(path={str(tmp_path / "ring")!r}, slack=10)).write(50)
        torch.save((driver.replay.state_dict(), driver.replay[:].clone().to_dict()), {str(tmp_path / "state.pt")!r})
        driver.write(6)
        def half(file, offset, size):
            os.ftruncate(file, size // 2)
            os.kill(os.getpid(), signal.SIGKILL)
        storage.os.posix_fallocate = half
        small(path={str(tmp_path / "half")!r})
    """
    ended = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], timeout=300)
    assert ended.returncode == -9
    state, content = torch.load(tmp_path / "state.pt", weights_only=False)
    replay = small(path=tmp_path / "ring", slack=10)
    replay.load_state_dict(state)
    assert torch.equal(replay[:]["next", "pixels"], content["next"]["pixels"])
    Driver(small(10, path=tmp_path / "half")).write(15)
    assert not list((tmp_path / "half").glob(".*"))


def test_what_the_disk_cannot_hold_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DiskSpaceError, match="A replay of 1000000000 transitions"):
        FrameReplay(1_000_000_000, action_dim=1, path=tmp_path / "ring")
    FrameReplay(100, action_dim=6, path=tmp_path / "once")
    size = sum(file.stat().st_size for file in (tmp_path / "once").iterdir())
    assert size / 100 < 1.2 * (3 * 84 * 84 + 100)  # frames are stored once

    def half(file: int, offset: int, size: int) -> None:
        os.ftruncate(file, size // 2)
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(storage.os, "posix_fallocate", half)
        with pytest.raises(DiskSpaceError, match="disk is full"):
            small(path=tmp_path)
    assert not [file for file in tmp_path.iterdir() if file.is_file()]
    small(path=tmp_path)


def shown(replay: StoredReplay) -> list[list[int]]:
    return replay.observations(torch.arange(len(replay)))[:, ::3, 0, 0].tolist()


@pytest.mark.parametrize(("transitions", "length"), [(9, 4), (70, 30), (70, 7), (2, 1000)])
def test_a_stored_replay_shows_every_observation_in_order(tmp_path: Path, transitions: int, length: int) -> None:
    driver = Driver(small(path=tmp_path, slack=5), length).write(transitions)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    stored = StoredReplay(tmp_path)
    assert min(transitions, 20) <= len(stored) <= transitions
    expected = [([episode[0]] * 3 + episode)[-4:-1] for episode, _ in driver.history[-len(stored) :]]
    assert shown(stored) == expected
    stored.observations(torch.arange(len(stored))).zero_()
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_a_stored_replay_shows_only_what_the_last_writer_of_its_directory_stored(tmp_path: Path) -> None:
    Driver(small(200, path=tmp_path), 1000).write(100)
    assert len(StoredReplay(tmp_path)) == 100
    Driver(small(200, path=tmp_path), 1).write(10)  # twice as many frames
    stored = StoredReplay(tmp_path, frame_stack=3.0)  # type: ignore[arg-type]
    assert shown(stored) == [[2 * episode] * 3 for episode in range(10)]


def test_a_stored_replay_shows_no_frame_of_an_abandoned_branch(tmp_path: Path) -> None:
    replay = small(path=tmp_path, slack=60)
    driver = Driver(replay, 1000).write(100)
    state = replay.state_dict()
    driver.write(30)
    reopened = small(path=tmp_path, slack=60)
    reopened.load_state_dict(state)
    Driver(reopened, 1000).write(1)  # another episode than that of the abandoned frames
    newest = [stack[-1] for stack in shown(StoredReplay(tmp_path))]
    assert newest == [*range(newest[0], 100), 0]


def test_a_cut_after_which_another_episode_begins_with_the_same_picture_is_seen() -> None:
    shown = [[1, 1, 1], [1, 1, 2], [1, 2, 3], [2, 3, 1]], [[1, 1, 1], [1, 1, 4], [1, 4, 5], [4, 5, 6]]
    stacks = [torch.tensor(each, dtype=torch.uint8) for each in shown]
    replay = small(frame_stack=3)
    pixels = [each.repeat_interleave(3, 1)[..., None, None].expand(-1, -1, 2, 2) for each in stacks]
    for observed in pixels:
        end = torch.zeros(3, 1, dtype=torch.bool)
        following = {"pixels": observed[1:], "reward": torch.zeros(3, 1), "done": end, "terminated": end}
        replay.extend(TensorDict({"pixels": observed[:-1], "action": torch.zeros(3, 1), "next": following}, [3]))
    assert torch.equal(replay[:]["pixels"], torch.cat([each[:-1] for each in pixels]))


def test_a_state_of_other_columns_is_refused() -> None:
    replay = small()
    for columns, message in (({"code": ((2,), torch.float32)}, "code"), ({"code": ((3,), torch.float32)}, "code is")):
        other = small(extra_columns=columns)
        with pytest.raises(CheckpointError, match=message):
            other.load_state_dict(replay.state_dict())
        replay = small(extra_columns=columns)


def test_what_is_no_stored_replay_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"absent/number.memmap is missing"):
        StoredReplay(tmp_path / "absent")
    driver = Driver(small(path=tmp_path / "new"))
    with pytest.raises(DatasetError, match="no transition"):
        StoredReplay(tmp_path / "new")
    driver.write(5)
    (tmp_path / "new" / "pixels.memmap").rename(tmp_path / "elsewhere")
    with pytest.raises(DatasetError, match=r"pixels.memmap is missing"):
        StoredReplay(tmp_path / "new")
    (tmp_path / "elsewhere").rename(tmp_path / "new" / "pixels.memmap")
    with open(tmp_path / "new" / "pixels.memmap", "ab") as file:
        file.write(b"x")
    with pytest.raises(DatasetError, match=r"pixels.memmap is longer"):
        StoredReplay(tmp_path / "new")
