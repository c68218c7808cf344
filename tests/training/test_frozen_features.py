from __future__ import annotations

from pathlib import Path

import pytest
import torch

from crptpro.data import FrameReplay
from crptpro.modules import PixelEncoder, Projector
from crptpro.training.frozen_features import FrozenFeatures, dense_slots

SIZE, PAD, CAPACITY, SLACK = 16, 2, 12, 9
LENGTHS = (7, 1, 5, 3, 9, 2, 4, 8, 1, 6, 7, 5)


def make_encoder() -> PixelEncoder:
    torch.manual_seed(0)
    return PixelEncoder(channels=(4, 4), strides=(2, 1), image_size=SIZE).requires_grad_(False)


class World:
    """A replay of short episodes and the features of what is in it; the same for both ways to have them."""

    def __init__(
        self,
        mode: str,
        path: Path | None = None,
        slots: int | None = None,
        projector: torch.nn.Module | None = None,
        maps_dtype: torch.dtype | None = None,
    ) -> None:
        self.encoder, self.maps_dtype = make_encoder(), maps_dtype
        self.replay = FrameReplay(CAPACITY, frame_shape=(3, SIZE, SIZE), action_dim=1, path=path, slack=SLACK)
        self.replay_rng, self.shift_rng = (torch.Generator().manual_seed(seed) for seed in (1, 2))
        self.replay.set_rng(self.replay_rng)
        self.features = FrozenFeatures(
            self.encoder,
            self.replay,
            mode=mode,
            pad=PAD,
            slots=slots,
            maps_dtype=maps_dtype,
            generator=self.shift_rng,
            projector=projector,
        )
        self.frames = torch.Generator().manual_seed(3)
        self.slots_seen: list[int] = []

    def frame(self) -> torch.Tensor:
        return torch.randint(0, 256, (3, SIZE, SIZE), dtype=torch.uint8, generator=self.frames)

    def play(self, length: int) -> None:
        """One episode; every observation is taken in as the loop does, and checked against plain encoding."""
        stack = [self.frame()] * 3
        slot = self.replay.begin_episode(stack[-1])
        self.observe(stack, slot)
        for step in range(length):
            stack = [*stack[1:], self.frame()]
            slot = self.replay.append(torch.zeros(1), float(step), False, step == length - 1, stack[-1])
            self.observe(stack, slot)

    def observe(self, stack: list[torch.Tensor], slot: int) -> None:
        pixels = torch.cat(stack)
        self.slots_seen.append(slot)
        rtol = 1e-4 if self.maps_dtype is None else 2.0**-8
        torch.testing.assert_close(
            self.features.observe(pixels, slot), self.encoder(pixels.unsqueeze(0)), rtol=rtol, atol=1e-5
        )

    def sample(self) -> dict[str, torch.Tensor]:
        batch = self.features.sample(16)
        keys = ("features", ("next", "features"), ("next", "reward"), "index")
        return {str(key): batch[key].clone() for key in keys}


@pytest.mark.parametrize("mode", ["dense", "reencode"])
def test_what_is_observed_is_encoded_plainly_while_the_ring_goes_round(mode: str) -> None:
    world = World(mode)
    for length in LENGTHS:
        world.play(length)
    assert len(world.slots_seen) > 1.5 * world.replay.frame_slots
    assert world.replay.frame_slots == world.replay.window + SLACK


def test_dense_equals_reencoded_for_the_same_generator_states_at_every_place_of_the_ring() -> None:
    dense, plain = World("dense"), World("reencode")
    for length in LENGTHS:
        dense.play(length)
        plain.play(length)
        for _ in range(2):
            ours, theirs = dense.sample(), plain.sample()
            assert torch.equal(ours["index"], theirs["index"])
            for key, value in theirs.items():
                torch.testing.assert_close(ours[key], value, rtol=1e-4, atol=1e-5, msg=key)
        assert torch.equal(dense.shift_rng.get_state(), plain.shift_rng.get_state())
    assert max(dense.slots_seen) == dense.replay.frame_slots - 1
    assert len(dense.replay) == CAPACITY


def test_maps_in_bfloat16_give_a_float32_encoder_its_features_rounded_once() -> None:
    whole, half = World("dense"), World("dense", maps_dtype=torch.bfloat16)
    assert 2 * half.features.cache.nbytes == whole.features.cache.nbytes
    for length in LENGTHS:
        whole.play(length)
        half.play(length)
        for ours, theirs in zip(half.sample().values(), whole.sample().values()):
            assert ours.dtype == theirs.dtype
            if ours.dtype == torch.float32:  # rewards are whole numbers, which rounding leaves alone
                assert torch.equal(ours, theirs.bfloat16().float())


@pytest.mark.parametrize("mode", ["dense", "reencode"])
def test_an_observation_and_its_next_have_each_their_own_shift(mode: str) -> None:
    world = World(mode)
    picture = world.frame()
    world.frame = lambda: picture  # every observation is the same, so features differ by their shifts alone
    world.play(1)
    batch = world.sample()
    different = (batch["features"] != batch["('next', 'features')"]).any(-1)
    assert different.sum() > 0
    assert 1 < len(batch["features"].unique(dim=0)) <= (2 * PAD + 1) ** 2


@pytest.mark.parametrize("mode", ["dense", "reencode"])
def test_after_restoring_the_replay_rebuilding_gives_the_same_samples(tmp_path: Path, mode: str) -> None:
    world = World(mode, tmp_path)
    for length in LENGTHS[:-1]:
        world.play(length)
    state = world.replay.state_dict()
    generators = [world.replay_rng.get_state(), world.shift_rng.get_state()]
    expected = [world.sample() for _ in range(3)]
    world.play(LENGTHS[-1])  # overwrites rows of the slack, as a run does until it is killed
    del world

    again = World(mode, tmp_path)
    again.replay.load_state_dict(state)
    again.replay_rng.set_state(generators[0])
    again.shift_rng.set_state(generators[1])
    again.features.rebuild(progress=False)
    for sample in expected:
        for key, value in again.sample().items():
            assert torch.equal(value, sample[key]), key


def test_without_rebuilding_a_restored_replay_has_no_dense_features(tmp_path: Path) -> None:
    world = World("dense", tmp_path)
    world.play(5)
    state = world.replay.state_dict()
    again = World("dense", tmp_path)
    again.replay.load_state_dict(state)
    with pytest.raises(IndexError, match="never written"):
        again.sample()


def largest_difference(ours: World, theirs: World) -> float:
    samples = zip(ours.sample().values(), theirs.sample().values())
    return max(float((one - other).abs().max()) for one, other in samples)


def test_a_run_that_cannot_fill_the_replay_needs_two_slots_per_decision_and_no_less() -> None:
    """Episodes of one decision are the worst case: each observation has a slot of its own and none is left over."""
    decisions = CAPACITY
    plain, enough = World("reencode"), World("dense", slots=dense_slots(World("dense").replay, decisions))
    short = World("dense", slots=2 * decisions - 1)
    assert short.features.slots < enough.features.slots == 2 * decisions < enough.replay.window
    for world in (plain, enough, short):
        for _ in range(decisions):
            world.play(1)
    states = [world.replay_rng.get_state() for world in (plain, enough, short)]
    assert torch.equal(states[0], states[1])
    assert max(largest_difference(enough, plain) for _ in range(5)) < 1e-4
    plain.replay_rng.set_state(states[0])
    plain.shift_rng.manual_seed(2)
    assert max(largest_difference(short, plain) for _ in range(5)) > 1e-2


def test_a_long_run_needs_no_more_slots_than_the_replay_has_rows() -> None:
    replay = World("dense").replay
    assert dense_slots(replay, 1_000_000) == replay.window < replay.frame_slots
    assert dense_slots(replay, 1) == 2


def test_a_run_resumed_with_a_larger_budget_has_the_same_features_in_more_slots(tmp_path: Path) -> None:
    world = World("dense", tmp_path, slots=10)
    for length in (2, 2, 3):
        world.play(length)
    state = world.replay.state_dict()
    generators = [world.replay_rng.get_state(), world.shift_rng.get_state()]
    expected = world.sample()
    del world
    again = World("dense", tmp_path, slots=24)
    again.replay.load_state_dict(state)
    again.replay_rng.set_state(generators[0])
    again.shift_rng.set_state(generators[1])
    again.features.rebuild(progress=False)
    for key, value in again.sample().items():
        assert torch.equal(value, expected[key]), key
    for length in LENGTHS:
        again.play(length)  # checks every observation that is taken in


@pytest.mark.parametrize("mode", ["dense", "reencode"])
def test_all_of_a_batch_is_where_the_features_are(mode: str) -> None:
    replay = FrameReplay(CAPACITY, frame_shape=(3, SIZE, SIZE), action_dim=1)
    encoder = make_encoder().to("meta")
    features = FrozenFeatures(
        encoder, replay, mode=mode, pad=PAD, generator=torch.Generator().manual_seed(0), device="meta"
    )
    frame = torch.zeros(3, SIZE, SIZE, dtype=torch.uint8)
    slot = replay.begin_episode(frame)
    for _ in range(3):
        assert features.observe(frame.repeat(3, 1, 1), slot).shape == (1, encoder.feature_dim)
        slot = replay.append(torch.zeros(1), 1.0, False, False, frame)
    features.observe(frame.repeat(3, 1, 1), slot)
    batch = features.sample(4)
    needed = ("features", "action", ("next", "features"), ("next", "reward"), ("next", "terminated"))
    assert {batch[key].device.type for key in needed} == {"meta"}
    assert {value.device.type for value in batch.values(True, True)} == {"meta"}


def test_a_slot_that_was_never_written_is_found_whatever_the_device() -> None:
    replay = FrameReplay(CAPACITY, frame_shape=(3, SIZE, SIZE), action_dim=1)
    generator = torch.Generator().manual_seed(0)
    features = FrozenFeatures(
        make_encoder().to("meta"), replay, mode="dense", pad=PAD, generator=generator, device="meta"
    )
    frame = torch.zeros(3, SIZE, SIZE, dtype=torch.uint8)
    replay.begin_episode(frame)
    replay.append(torch.zeros(1), 1.0, False, False, frame)
    with pytest.raises(IndexError, match="never written"):
        features.sample(4)


@pytest.mark.parametrize("mode", ["dense", "reencode"])
def test_embeddings_are_the_projections_of_the_next_features(mode: str) -> None:
    projector = Projector(make_encoder().feature_dim, 6).requires_grad_(False)
    world = World(mode, projector=projector)
    for length in LENGTHS:
        world.play(length)
        batch = world.features.sample(16)
        expected = projector(batch["next", "features"])
        torch.testing.assert_close(batch["next", "embedding"], expected, rtol=1e-4, atol=1e-5)
        assert "embedding" not in batch.keys()  # noqa: SIM118 - iterating a TensorDict yields rows


def test_dense_embeddings_are_kept_and_not_projected_again_when_sampled() -> None:
    projector = Projector(make_encoder().feature_dim, 6).requires_grad_(False)
    world = World("dense", projector=projector)
    for length in LENGTHS:
        world.play(length)
    projector.register_forward_hook(lambda *call: pytest.fail("projected again"))
    world.features.sample(16)
