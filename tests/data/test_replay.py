from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
import textwrap

import pytest
import torch

from crptpro.data import FrameReplay, mapped_file
from crptpro.errors import CheckpointError, DiskSpaceError


def frame(number: int) -> torch.Tensor:
    return torch.full((3, 2, 2), number % 251, dtype=torch.uint8)


class Driver:
    """Writes episodes whose frames, rewards and actions count up, and knows what must be in the replay."""

    def __init__(self, replay: FrameReplay, length: int = 9):
        self.replay, self.length, self.number = replay, length, 0
        self.episode: list[int] = []
        self.history: list[
            tuple[list[int], int]
        ] = []  # stack of an observation and of its successor, by number

    def write(self, transitions: int) -> Driver:
        for _ in range(transitions):
            if not self.episode:
                self.replay.begin_episode(frame(self.number))
                self.episode = [self.number]
                self.number += 1
            step = len(self.episode)
            is_last = step == self.length
            self.replay.append(
                torch.tensor([float(self.number)]), self.number, is_last and self.number % 2 == 0,
                is_last and self.number % 2 == 1, frame(self.number),
            )  # fmt: skip
            self.episode.append(self.number)
            self.history.append((list(self.episode), self.number))
            self.number += 1
            if is_last:
                self.episode = []
        return self

    def check(self) -> None:
        everything = self.replay[:]
        expected = self.history[len(self.history) - len(self.replay) :]
        for i, (episode, number) in enumerate(expected):
            padded = [episode[0]] * 3 + episode
            following = torch.cat([frame(n) for n in padded[-3:]])
            current = torch.cat([frame(n) for n in padded[-4:-1]])
            assert torch.equal(everything["next", "pixels"][i], following)
            assert torch.equal(everything["pixels"][i], current)
            assert everything["next", "reward"][i].item() == everything["action"][i].item() == number
            done = everything["next", "done"][i]
            assert done == (everything["next", "terminated"][i] | everything["next", "truncated"][i])
            assert done.item() == (len(episode) == self.length + 1)


@pytest.mark.parametrize("length", [1, 2, 9, 1000])
@pytest.mark.parametrize("on_disk", [False, True])
def test_content_is_the_newest_transitions_with_live_stacks(tmp_path, length, on_disk):
    path = tmp_path / "ring" if on_disk else None
    replay = FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, path=path, slack=5)
    driver = Driver(replay, length)
    for transitions in (1, 3, 30, 17, 44, 1):
        driver.write(transitions).check()
        assert len(replay) <= 20
    assert len(replay) == 20 or length == 1  # very short episodes cost a frame more per transition


def test_interrupted_episodes_are_not_joined():
    replay = FrameReplay(10, frame_shape=(3, 2, 2), action_dim=1)
    replay.begin_episode(frame(1))
    replay.append(torch.zeros(1), 0.0, False, False, frame(2))
    replay.begin_episode(frame(100))
    replay.append(torch.zeros(1), 0.0, False, False, frame(101))
    assert replay[:]["next", "pixels"][:, ::3, 0, 0].tolist() == [[1, 1, 2], [100, 100, 101]]


def test_misuse_is_refused_in_words():
    replay = FrameReplay(10, frame_shape=(3, 2, 2), action_dim=1)
    with pytest.raises(RuntimeError, match="No episode is running"):
        replay.append(torch.zeros(1), 0.0, False, False, frame(0))
    with pytest.raises(RuntimeError, match="begin_episode"):
        replay.extend(torch.zeros(3))
    with pytest.raises(RuntimeError, match="begin_episode"):
        replay[0] = 1
    with pytest.raises(ValueError, match=r"must be uint8 \(3, 2, 2\).*got torch.float32"):
        replay.begin_episode(frame(0).float())
    with pytest.raises(ValueError, match=r"got torch.uint8 \(9, 2, 2\)"):
        replay.begin_episode(torch.cat([frame(0)] * 3))
    with pytest.raises(ValueError, match="at least 1"):
        FrameReplay(0, action_dim=1)


def test_sampling_is_uniform_over_valid_transitions():
    replay = FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, generator=torch.Generator().manual_seed(0))
    Driver(replay).write(47)
    counts = torch.bincount(replay.sample(20_000, pixels=False)["index"], minlength=20)
    assert ((counts - 1000.0) ** 2 / 1000).sum() < 50  # 19 degrees of freedom: once in 7,000 seeds


def test_slots_address_the_observations(tmp_path):
    replay = FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path)
    Driver(replay, length=7).write(90)
    batch = replay.sample(64)
    slots = torch.cat([batch["row"], batch["next", "row"]])
    assert slots.min() >= 0
    assert slots.max() < replay.frame_slots
    assert torch.equal(replay.observations_at(batch["row"]), batch["pixels"])
    assert torch.equal(replay.observations_at(batch["next", "row"]), batch["next", "pixels"])
    everything = replay[:]
    referred = set(everything["row"].tolist()) | set(everything["next", "row"].tolist())
    assert referred <= set(replay.live_slots().tolist())


def test_numbers_of_live_observations_differ_modulo_the_window(tmp_path):
    replay = FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path, slack=13)
    driver = Driver(replay, length=7)
    for _ in range(40):
        driver.write(3)
        numbers = replay.numbers_at(replay.live_slots())
        assert len((numbers % replay.window).unique()) == len(numbers)
        assert numbers[-1] == driver.number - 1


def test_written_slots_are_the_sampled_ones():
    replay = FrameReplay(10, frame_shape=(3, 2, 2), action_dim=1)
    first = replay.begin_episode(frame(0))
    second = replay.append(torch.zeros(1), 0.0, False, True, frame(1))
    batch = replay.sample(1)
    assert (batch["row"].item(), batch["next", "row"].item()) == (first, second)


def test_pixels_can_be_left_unread():
    replay = FrameReplay(10, frame_shape=(3, 2, 2), action_dim=1)
    Driver(replay).write(5)
    assert "pixels" not in replay.sample(2, pixels=False)
    assert ("next", "pixels") not in replay.sample(2, pixels=False).keys(True)
    assert "pixels" in replay.sample(2)


def test_extra_columns_belong_to_the_transition_and_are_sampled_at_the_root(tmp_path):
    spec = {"code": ((2,), torch.bfloat16)}
    replay = FrameReplay(10, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path, extra_columns=spec)
    replay.begin_episode(frame(0))
    for i in range(3):
        replay.append(torch.zeros(1), i, False, False, frame(i), code=torch.tensor([i, i + 0.5]))
    everything = replay[:]
    assert everything["code"].tolist() == [[0.0, 0.5], [1.0, 1.5], [2.0, 2.5]]
    assert everything["code"].dtype == torch.bfloat16
    assert "code" not in everything["next"]
    # Of a window it is the first transition's: what was in force at the observation.
    assert replay.sample(4, n_step=3)["code"].tolist() == [[0.0, 0.5]] * 4
    with pytest.raises(ValueError, match=r"needs \['code'\], got \[\]"):
        replay.append(torch.zeros(1), 0.0, False, False, frame(1))
    with pytest.raises(ValueError, match=r"got \['code', 'cod'\]|got \['cod', 'code'\]"):
        replay.append(torch.zeros(1), 0.0, False, False, frame(1), code=torch.zeros(2), cod=1)
    assert len(replay) == 3


@pytest.mark.parametrize("name", ["reward", "next", "row_of", "discount"])
def test_an_extra_column_may_not_hide_what_a_sample_has_anyway(name):
    with pytest.raises(ValueError, match=name):
        FrameReplay(10, action_dim=1, extra_columns={name: ((1,), torch.float32)})


@pytest.mark.parametrize("before", [4, 33, 100])
@pytest.mark.parametrize("length", [1, 6, 1000])
def test_an_old_state_restores_the_content_of_its_moment(tmp_path, before, length):
    def build() -> FrameReplay:
        return FrameReplay(
            20, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path, slack=16,
            generator=torch.Generator().manual_seed(5),
        )  # fmt: skip

    replay = build()
    driver = Driver(replay, length).write(before)
    state, content = replay.state_dict(), replay[:].clone()
    assert "content" not in state["ring"]
    driver.write(8)  # at most 16 frames, with an episode start before each
    restored = build()
    restored.load_state_dict(state)
    assert (restored[:] == content).all()
    first = restored.sample(7)
    again = build()
    again.load_state_dict(state)
    assert (again.sample(7) == first).all()
    # The restored ring goes on like one that was never interrupted.
    continued = Driver(restored, length)
    continued.number, continued.history = driver.number, list(driver.history[:before])
    continued.write(60).check()


def test_a_state_older_than_the_slack_is_refused(tmp_path):
    replay = FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path, slack=5)
    driver = Driver(replay).write(60)
    state = replay.state_dict()
    driver.write(30)
    with pytest.raises(CheckpointError, match=r"slack of 5.*checkpoint_interval_env_steps"):
        replay.load_state_dict(state)


def test_a_state_without_its_files_or_of_another_size_is_refused(tmp_path):
    replay = FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path / "a")
    Driver(replay).write(10)
    state = replay.state_dict()
    with pytest.raises(CheckpointError, match=r"are gone: the files were removed or replaced; put them back"):
        FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path / "b").load_state_dict(state)
    with pytest.raises(CheckpointError, match="Use the capacity and slack"):
        FrameReplay(21, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path / "c").load_state_dict(state)
    with pytest.raises(CheckpointError, match="a replay of another size"):
        FrameReplay(21, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path / "a")
    replay.load_state_dict(state)


def test_a_ring_in_ram_carries_its_content_in_the_state(tmp_path):
    replay = FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1)
    driver = Driver(replay).write(33)
    torch.save(replay.state_dict(), tmp_path / "state.pt")
    replay.dumps(tmp_path / "dump")
    content = replay[:].clone()
    driver.write(50)
    restored = FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1)
    restored.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert (restored[:] == content).all()
    loaded = FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1)
    loaded.loads(tmp_path / "dump")
    assert (loaded[:] == content).all()


def test_a_killed_process_leaves_a_ring_that_restores(tmp_path):
    program = f"""
        import os, signal, sys, torch
        sys.path.insert(0, {str(__file__.rsplit("/", 1)[0])!r})
        from test_replay import Driver, FrameReplay
        path = {str(tmp_path / "ring")!r}
        replay = FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, path=path, slack=10)
        driver = Driver(replay).write(50)
        torch.save((replay.state_dict(), replay[:].clone().to_dict()), {str(tmp_path / "state.pt")!r})
        driver.write(6)
        os.kill(os.getpid(), signal.SIGKILL)
    """
    ended = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], timeout=120)
    assert ended.returncode == -9
    state, content = torch.load(tmp_path / "state.pt", weights_only=False)
    replay = FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path / "ring", slack=10)
    replay.load_state_dict(state)
    assert torch.equal(replay[:]["next", "pixels"], content["next"]["pixels"])


def test_a_ring_that_the_disk_cannot_hold_is_refused(tmp_path):
    with pytest.raises(DiskSpaceError, match="A replay of 1000000000 transitions"):
        FrameReplay(1_000_000_000, action_dim=1, path=tmp_path / "ring")


def test_frames_are_stored_once(tmp_path):
    FrameReplay(1000, action_dim=6, path=tmp_path)
    size = sum(file.stat().st_size for file in tmp_path.iterdir())
    assert size / 1000 < 1.05 * (3 * 84 * 84 + 100)


def test_a_disk_that_fills_up_while_rows_are_reserved_keeps_none_of_them(tmp_path, monkeypatch):
    def half(file, offset, size):
        os.ftruncate(file, size // 2)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(mapped_file.os, "posix_fallocate", half)
    with pytest.raises(DiskSpaceError, match="No space left"):
        FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path)
    assert not list(tmp_path.glob("*.memmap*"))
    assert not list(tmp_path.glob(".*"))
    monkeypatch.undo()
    FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path)


def test_rows_are_reserved_where_the_system_has_to_write_them_one_by_one(tmp_path, monkeypatch):
    """It does so on network file systems that reserve nothing, and not in a file that is appended to."""
    reserve, refused = os.posix_fallocate, []

    def without_support(file, offset, size):
        if fcntl.fcntl(file, fcntl.F_GETFL) & os.O_APPEND:
            refused.append(file)
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        reserve(file, offset, size)

    monkeypatch.setattr(mapped_file.os, "posix_fallocate", without_support)
    replay = FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path)
    Driver(replay).write(15)
    state, content = replay.state_dict(), replay[:]["next", "pixels"].clone()
    again = FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path)  # what is there stays
    again.load_state_dict(state)
    assert torch.equal(again[:]["next", "pixels"], content)
    assert not refused


def test_a_kill_while_rows_are_reserved_leaves_a_directory_that_any_replay_can_use(tmp_path):
    program = f"""
        import os, signal
        from crptpro.data import FrameReplay, mapped_file
        def half(file, offset, size):
            os.ftruncate(file, size // 2)
            os.kill(os.getpid(), signal.SIGKILL)
        mapped_file.os.posix_fallocate = half
        FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, path={str(tmp_path)!r})
    """
    ended = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], timeout=120)
    assert ended.returncode == -9
    replay = FrameReplay(10, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path)
    Driver(replay).write(15)
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(("number", "kind", "message"), [
    (errno.EDQUOT, DiskSpaceError, "Free space"),
    (errno.EFBIG, DiskSpaceError, "File too large.*smaller capacity"),
    (errno.EIO, OSError, "Input/output error"),
])  # fmt: skip
def test_an_error_of_reserving_is_named_as_what_it_is(tmp_path, monkeypatch, number, kind, message):
    def fail(file, offset, size):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(mapped_file.os, "posix_fallocate", fail)
    with pytest.raises(kind, match=message) as caught:
        FrameReplay(20, frame_shape=(3, 2, 2), action_dim=1, path=tmp_path)
    assert f"{tmp_path}/" in str(caught.value)
