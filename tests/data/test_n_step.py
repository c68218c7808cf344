"""n-step windows of the replay: the rule of url_benchmark (replay_buffer.py) typed again, on live rings."""

from __future__ import annotations

import subprocess
import sys
import textwrap

import pytest
import torch

from crptpro.data import FrameReplay
from crptpro.data.n_step import n_step_return

SKILLS = 4
GAMMA = 0.9


def frame(number: int) -> torch.Tensor:
    return torch.full((3, 2, 2), number % 251, dtype=torch.uint8)


def build(path=None, capacity=40, seed=0) -> FrameReplay:
    return FrameReplay(
        capacity, frame_shape=(3, 2, 2), action_dim=1, path=path, slack=30,
        extra_columns={"skill": ((SKILLS,), torch.float32)},
        generator=torch.Generator().manual_seed(seed),
    )  # fmt: skip


class Writer:
    """Writes transition i with reward i and skill i % 4, and keeps every episode as (transitions, terminated)."""

    def __init__(self, replay: FrameReplay, lengths: tuple[int, ...]):
        self.replay, self.lengths, self.count = replay, lengths, 0
        self.episodes: list[tuple[list[int], bool]] = []

    def write(self, transitions: int) -> Writer:
        for _ in range(transitions):
            length = self.lengths[(len(self.episodes) - 1) % len(self.lengths)]
            if not self.episodes or len(self.episodes[-1][0]) == length:
                self.replay.begin_episode(frame(self.count))
                self.episodes.append(([], len(self.episodes) % 2 == 0))
                length = self.lengths[(len(self.episodes) - 1) % len(self.lengths)]
            numbers, terminates = self.episodes[-1]
            numbers.append(self.count)
            is_last = len(numbers) == length
            self.replay.append(
                torch.tensor([float(self.count)]), float(self.count), is_last and terminates,
                is_last and not terminates, frame(self.count + 1), skill=torch.eye(SKILLS)[self.count % SKILLS],
            )  # fmt: skip
            self.count += 1
        return self

    def windows(self, n: int) -> dict[int, tuple[float, float, bool, bool]]:
        """Anchor -> return, discount, terminated, truncated, as url_benchmark's loop computes them."""
        oldest = self.count - len(self.replay)
        expected = {}
        for e, (numbers, terminates) in enumerate(self.episodes):
            ended = len(numbers) == self.lengths[e % len(self.lengths)]
            for start in range(len(numbers) - n + 1):
                if numbers[start] < oldest:
                    continue
                reward, discount = 0.0, 1.0
                for i in range(n):
                    is_last = ended and start + i == len(numbers) - 1
                    reward += discount * numbers[start + i]
                    discount *= (0.0 if is_last and terminates else 1.0) * GAMMA
                expected[numbers[start]] = (
                    reward,
                    discount,
                    is_last and terminates,
                    is_last and not terminates,
                )
        return expected


def anchors(batch) -> list[int]:
    return [int(number) for number in batch["action"].squeeze(-1)]


@pytest.mark.parametrize("n", [1, 2, 3, 5])
@pytest.mark.parametrize("lengths", [(9,), (1, 6, 2, 11), (1000,)])
@pytest.mark.parametrize("on_disk", [False, True])
def test_windows_and_their_returns_are_those_of_the_published_loop(tmp_path, n, lengths, on_disk):
    replay = build(tmp_path / "ring" if on_disk else None)
    writer = Writer(replay, lengths)
    for transitions in (13, 20, 60):
        writer.write(transitions)
        expected = writer.windows(n)
        batch = replay.sample(600, n_step=n, discount=GAMMA)
        assert set(anchors(batch)) == set(expected)
        for i, anchor in enumerate(anchors(batch)):
            reward, discount, terminated, truncated = expected[anchor]
            assert batch["next", "reward"][i].item() == pytest.approx(reward, rel=1e-6)
            assert batch["next", "discount"][i].item() == pytest.approx(discount, rel=1e-6)
            assert batch["next", "terminated"][i].item() == terminated
            assert batch["next", "truncated"][i].item() == truncated
            assert batch["next", "done"][i].item() == (terminated or truncated)
            assert int(batch["skill"][i].argmax()) == anchor % SKILLS
            # Frame i + 1 follows transition i; the newest frame of a stack is its last.
            assert batch["next", "pixels"][i, -1, 0, 0] == (anchor + n) % 251
            assert batch["pixels"][i, -1, 0, 0] == anchor % 251
        assert torch.equal(replay.observations_at(batch["next", "row"]), batch["next", "pixels"])
        assert torch.equal(replay.observations_at(batch["row"]), batch["pixels"])


def test_next_observations_never_mix_episodes():
    replay = build()
    Writer(replay, (4,)).write(38)
    stacks = replay.sample(400, n_step=3)["next", "pixels"][:, ::3, 0, 0].int()
    assert (stacks.diff(dim=1) == 1).all()  # three steps in, nothing is repeated any more


def test_a_window_that_terminates_is_not_bootstrapped_and_a_truncated_one_is():
    rewards = torch.tensor([[[1.0], [2.0], [4.0]]]).expand(3, 3, 1)
    ended = torch.zeros(3, 3, 1, dtype=torch.bool)
    ended[1, 2], ended[2, 0] = True, True
    returns, discounts = n_step_return(rewards, ended, 0.5)
    assert returns.squeeze(-1).tolist() == [3.0, 3.0, 1.0]  # 1 + 0.5 * 2 + 0.25 * 4; nothing after an end
    assert discounts.squeeze(-1).tolist() == [0.125, 0.0, 0.0]


@pytest.mark.parametrize("lengths", [(9,), (1, 1, 1, 1, 1, 1, 1, 1, 1, 4)])
def test_admissible_windows_are_equally_likely(lengths):
    """The second ring has so few of them that they are listed instead of found by redrawing."""
    replay = build(capacity=60)
    writer = Writer(replay, lengths).write(180)
    count = len(writer.windows(3))
    drawn = torch.tensor(anchors(replay.sample(500 * count, pixels=False, n_step=3)))
    counts = drawn.unique(return_counts=True)[1]
    assert len(counts) == count
    chi_square = ((counts - 500.0) ** 2 / 500).sum()
    assert chi_square < count - 1 + 5 * (2 * (count - 1)) ** 0.5


def test_one_step_draws_what_it_always_drew():
    first, second, third = (build(seed=3) for _ in range(3))
    for replay in (first, second, third):
        Writer(replay, (9,)).write(70)
    plain, named, discounted = first.sample(50), second.sample(50, n_step=1), third.sample(50, discount=0.5)
    assert set(plain.keys(True, True)) == set(named.keys(True, True))
    assert ("next", "discount") not in plain.keys(True, True)
    assert (plain == named).all()
    assert (discounted["next", "discount"] == 0.5 * ~plain["next", "terminated"]).all()
    assert (discounted.exclude(("next", "discount")) == plain).all()
    expected = torch.randint(0, 40, (50,), generator=torch.Generator().manual_seed(3))
    assert torch.equal(plain["index"], expected)


def test_reading_by_index_is_one_step_after_an_n_step_sample():
    replay = build()
    Writer(replay, (9,)).write(30)
    before = replay[:]
    replay.sample(8, n_step=4)
    assert (replay[:] == before).all()


def test_what_cannot_be_drawn_is_refused_in_words():
    replay = build()
    Writer(replay, (2,)).write(2)
    with pytest.raises(RuntimeError, match=r"2 transitions.*n_step=3"):
        replay.sample(4, n_step=3)
    Writer(replay, (2,)).write(20)
    with pytest.raises(RuntimeError, match=r"22 transitions.*n_step=3"):
        replay.sample(4, n_step=3)
    assert len(replay.sample(4, n_step=2)) == 4
    with pytest.raises(ValueError, match="got 0"):
        replay.sample(4, n_step=0)


def test_an_old_state_restores_columns_and_draws(tmp_path):
    replay = build(tmp_path)
    writer = Writer(replay, (7,)).write(90)
    state, random = replay.state_dict(), replay._rng.get_state()
    content, batch = replay[:].clone(), replay.sample(16, n_step=3)
    writer.write(20)
    restored = build(tmp_path, seed=99)
    restored.load_state_dict(state)
    restored._rng.set_state(random)
    assert (restored[:] == content).all()
    assert (restored.sample(16, n_step=3) == batch).all()


def test_a_killed_run_goes_on_bit_for_bit_with_its_skills(tmp_path):
    """State at 50, killed at 58, gone on to 80 from the state: the same draws as a run that was never killed."""
    program = f"""
        import os, signal, sys, torch
        sys.path.insert(0, {str(__file__.rsplit("/", 1)[0])!r})
        from test_n_step import Writer, build
        replay = build({str(tmp_path / "ring")!r})
        writer = Writer(replay, (6, 9))
        for _ in range(10):
            writer.write(5)
            replay.sample(8, n_step=3)
        writing = (writer.count, writer.episodes)
        torch.save((replay.state_dict(), replay._rng.get_state(), writing), {str(tmp_path / "state.pt")!r})
        writer.write(8)
        replay.sample(8, n_step=3)
        os.kill(os.getpid(), signal.SIGKILL)
    """
    ended = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], timeout=120)
    assert ended.returncode == -9
    state, random, (count, episodes) = torch.load(tmp_path / "state.pt", weights_only=False)

    whole = Writer(build(), (6, 9))
    for _ in range(10):
        whole.write(5)
        whole.replay.sample(8, n_step=3)
    resumed = Writer(build(tmp_path / "ring"), (6, 9))
    resumed.count, resumed.episodes = count, episodes
    resumed.replay.load_state_dict(state)
    resumed.replay._rng.set_state(random)
    for _ in range(6):
        drawn = [writer.write(5).replay.sample(8, n_step=3) for writer in (whole, resumed)]
        # Slots depend on the slack, which both have; everything else on what was written.
        assert (drawn[0] == drawn[1]).all()
        assert set(drawn[1].keys(True, True)) >= {"skill", ("next", "discount")}
