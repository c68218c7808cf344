from __future__ import annotations

import copy
import pickle
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from fake_pixel_env import SIZE, FakePixelEnv, FakeReplay, small_encoder, small_heads
from tensordict import TensorDict
from torch import nn
from torchrl.envs import Compose, TransformedEnv
from toy_env import rollout_of

from crptpro.data import FrameReplay
from crptpro.errors import CRPTproError
from crptpro.modules import PixelEncoder
from crptpro.transforms import DenseShiftFeatures, FrozenEncoder, RandomShift, choose_feature_mode, random_shift
from crptpro.transforms.dense_shift import _crop_by_index, crop_features, dense_maps_bytes, dense_shift_maps

ALL_SHIFTS = torch.cartesian_prod(torch.arange(9), torch.arange(9))
KEYS = {"in_keys": ["pixels", ("next", "pixels")], "out_keys": ["features", ("next", "features")]}


def seeded(seed=3):
    return torch.Generator().manual_seed(seed)


def dense_of(encoder=None, replay=None, **options):
    encoder = small_encoder() if encoder is None else encoder
    replay = FakeReplay() if replay is None else replay  # an empty FrameReplay is false
    return DenseShiftFeatures(encoder, replay, **{"generator": seeded(), **options})


def require_same(dense, plain, td):
    """Up to the order of a sum, which may depend on the size of image and batch on some processors."""
    ours, theirs = dense(td.clone()), plain(td.clone())
    for key in KEYS["out_keys"]:
        assert not ours[key].requires_grad
        tolerance = 1e-6 * float(theirs[key].abs().max())
        torch.testing.assert_close(ours[key], theirs[key], rtol=0, atol=tolerance)


def reencoding(encoder):
    """What the dense features replace."""
    shift = RandomShift(in_keys=KEYS["in_keys"], generator=seeded())
    return Compose(shift, FrozenEncoder(encoder, **KEYS))


def crops_and_features(encoder, pixels):
    maps = dense_shift_maps(encoder, pixels.unsqueeze(0))
    rows, out = torch.zeros(81, dtype=torch.int64), torch.empty(81, encoder.feature_dim, dtype=maps.dtype)
    with torch.no_grad():
        direct = encoder(random_shift(pixels.expand(81, *pixels.shape), ALL_SHIFTS))
    return crop_features(maps, rows, ALL_SHIFTS, out), direct


@pytest.mark.parametrize(
    ("encoder", "dtype", "tolerance"),
    [
        (PixelEncoder(), torch.float32, 0),  # bit for bit
        (PixelEncoder(), torch.bfloat16, 2**-8),
        (small_encoder(), torch.float32, 1e-6),
        (small_encoder(channels=(4, 6, 5), strides=(2, 2, 1), image_size=25), torch.float32, 1e-6),
        (small_encoder(strides=(1, 1)), torch.float32, 1e-6),
        (small_encoder(strides=(3, 1), image_size=21), torch.float32, 1e-6),
        (small_encoder(pixel_offset=0.5), torch.float32, 1e-6),
    ],
)
def test_crops_equal_direct_features_for_every_shift_and_geometry(encoder, dtype, tolerance):
    for parameter in encoder.parameters():
        nn.init.normal_(parameter, std=0.1)  # biases, too
    encoder.compute_dtype = dtype
    size = encoder.image_size
    crops, direct = crops_and_features(encoder, torch.randint(0, 256, (9, size, size), dtype=torch.uint8))
    torch.testing.assert_close(crops, direct, rtol=0, atol=tolerance * float(direct.abs().max()))


def test_indexing_as_on_a_gpu_and_bfloat16_maps_read_as_float32_give_the_same_crops():
    maps, rows = torch.randn(7, 4, 3, 11, 12), torch.randint(0, 7, (81,))
    expected = crop_features(maps, rows, ALL_SHIFTS, torch.empty(81, 3 * 7 * 8))
    assert torch.equal(_crop_by_index(maps, rows, ALL_SHIFTS, 2, (5, 7, 8)), expected)
    maps = maps.bfloat16()
    maps[0, 0, 0, 0, :4] = torch.tensor([-0.0, torch.inf, -torch.inf, 1e-40])
    expected = crop_features(maps, rows, ALL_SHIFTS, torch.empty(81, 3 * 7 * 8, dtype=torch.bfloat16))
    crops = crop_features(maps, rows, ALL_SHIFTS, torch.full((81, 3 * 7 * 8), torch.nan))
    assert torch.equal(crops.view(torch.int32), expected.float().view(torch.int32))


@pytest.mark.parametrize("lead", [(7,), (2, 4)])
@pytest.mark.parametrize("is_standardised", [False, True])
def test_it_writes_what_shifting_and_encoding_with_the_same_generator_writes(lead, is_standardised):
    encoder, replay = small_encoder(), FakeReplay()
    if is_standardised:
        encoder.standardise(torch.rand(encoder.feature_dim), torch.rand(encoder.feature_dim) + 0.5)
    dense, plain = dense_of(encoder, replay), reencoding(encoder)
    for _ in range(3):
        require_same(dense, plain, replay.batch(*lead))


def test_each_observation_is_encoded_once_until_its_place_is_needed():
    dense = dense_of()
    replay = dense.replay
    for _ in range(30):
        dense(replay.batch(8))
    assert sorted(replay.asked) == list(range(12))
    dense.generator.manual_seed(3)
    require_same(dense, reencoding(dense.encoder), replay.batch(20, first=7))  # 12 to 18 take the places of 0 to 6
    assert set(replay.asked[12:]) <= set(range(12, 19))


@pytest.mark.parametrize("way", ["in place", "load_state_dict", "another tensor", "projector"])
def test_a_change_of_weights_encodes_again(way):
    encoder = small_encoder()
    projector, _ = small_heads(encoder)
    dense = dense_of(encoder, projector=projector)
    td = dense.replay.batch(4)
    dense(td.clone())
    changed = projector if way == "projector" else encoder
    with torch.no_grad():
        if way == "load_state_dict":
            changed.load_state_dict({name: 2 * value for name, value in changed.state_dict().items()})
        for weight in changed.parameters() if way != "load_state_dict" else ():
            if way == "another tensor":
                weight.data = 2 * weight
            else:
                weight.mul_(2)
    dense.generator.manual_seed(3)
    ours = dense(td.clone())
    theirs = dense_of(encoder, dense.replay, projector=projector)(td.clone())
    for key in ("features", ("next", "features"), ("next", "embedding")):
        assert torch.equal(ours[key], theirs[key])


def test_a_policy_reads_the_features_of_an_unshifted_observation_that_batches_use_again():
    dense = dense_of()
    found = dense.unshifted(5)
    direct = dense.encoder(dense.replay.frames[5].unsqueeze(0)).detach()
    torch.testing.assert_close(found, direct, rtol=0, atol=1e-6 * float(direct.abs().max()))
    assert torch.equal(dense.generator.get_state(), seeded().get_state())  # acting draws no shift
    dense(TensorDict({"number": torch.tensor([5]), "next": {"number": torch.tensor([6])}}, [1]))
    assert dense.replay.asked == [5, 6]


def test_it_follows_a_frame_replay_around_its_ring_and_survives_a_resumption(tmp_path):
    encoder = small_encoder()
    kwargs = {"frame_shape": (3, SIZE, SIZE), "action_dim": 1, "slack": 40}
    replay = FrameReplay(10, path=tmp_path, **kwargs)
    replay.set_rng(seeded(1))
    dense, plain = dense_of(encoder, replay), reencoding(encoder)
    for length in (4, 7, 1, 9, 3):
        replay.extend(rollout_of(torch.randint(0, 256, (length + 1, 3, SIZE, SIZE), dtype=torch.uint8)))
        require_same(dense, plain, replay.sample(16))
    state, rng = replay.state_dict(), seeded(5)
    again = FrameReplay(10, path=tmp_path, **kwargs)
    again.load_state_dict(state)
    resumed = dense_of(encoder, again, generator=copy.deepcopy(dense.generator))
    for each in (replay, again):
        each.set_rng(copy.deepcopy(rng))
    first = dense(replay.sample(16))["features"].clone()
    assert torch.equal(resumed(again.sample(16))["features"], first)


def test_maps_in_bfloat16_round_each_feature_of_a_float32_encoder_once():
    encoder, replay = small_encoder(), FakeReplay()
    whole, half = dense_of(encoder, replay), dense_of(encoder, replay, dtype=torch.bfloat16)
    td = replay.batch(9)
    expected = whole(td.clone())["features"].bfloat16().float()
    assert torch.equal(half(td.clone())["features"], expected)


def test_projections_of_every_shift_are_kept_and_written_for_the_next_observation():
    encoder, replay = small_encoder(), FakeReplay()
    projector, _ = small_heads(encoder)
    dense = dense_of(encoder, replay, projector=projector)
    kept = dense_maps_bytes(encoder, 12, torch.float32, latent_dim=5)
    assert kept == 12 * (4 * 6 * 11 * 11 * 4 + 81 * 5 * 4)
    assert dense_maps_bytes(PixelEncoder(), 1, torch.bfloat16) == 2 * 194_688
    for _ in range(20):
        td = dense(replay.batch(16))
        with torch.no_grad():
            expected = projector(td["next", "features"])
        torch.testing.assert_close(td["next", "embedding"], expected, rtol=1e-5, atol=1e-5)
        assert "embedding" not in td
    projector.register_forward_hook(lambda *call: pytest.fail("projected again"))
    assert not dense(replay.batch(16))["next", "embedding"].requires_grad


def test_projections_are_those_of_the_network_in_evaluation_and_leave_one_in_training_as_it_is():
    encoder, replay = small_encoder(), FakeReplay()
    projector = nn.Sequential(nn.Linear(encoder.feature_dim, 5), nn.BatchNorm1d(5), nn.Dropout(0.5)).train()
    before = copy.deepcopy(projector.state_dict())
    td = dense_of(encoder, replay, projector=projector)(replay.batch(16))
    assert projector.training
    torch.testing.assert_close(projector.state_dict(), before, rtol=0, atol=0)
    with torch.no_grad():
        expected = projector.eval()(td["next", "features"])
    torch.testing.assert_close(td["next", "embedding"], expected, rtol=1e-5, atol=1e-5)


def test_threads_that_sample_side_by_side_get_each_their_own():
    dense = dense_of(generator=None, observations=2)  # each needs the places of the others
    plain = {n: crops_and_features(dense.encoder, dense.replay.frames[n])[1] for n in range(12)}

    def sample(_) -> bool:
        td = dense(dense.replay.batch(1))
        found = zip(td["number"].tolist(), td["features"])
        return all(((plain[number] - features).abs().amax(-1) < 1e-5).any() for number, features in found)

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(3) as threads:
            assert all(threads.map(sample, range(300)))
    finally:
        sys.setswitchinterval(before)


@pytest.mark.parametrize("prefetch", [None, 1, 2])
def test_later_batches_leave_the_features_of_earlier_ones_alone(prefetch):
    encoder, frames = small_encoder(strides=(1, 1)), torch.randint(0, 256, (31, 3, SIZE, SIZE), dtype=torch.uint8)
    replay = FrameReplay(
        40, frame_shape=(3, SIZE, SIZE), action_dim=1, returns_pixels=False, batch_size=6, prefetch=prefetch
    )
    replay.extend(rollout_of(frames))
    replay.append_transform(dense_of(encoder, replay, pad=0))
    for batch in [replay.sample() for _ in range(8)]:
        for key in ("number", "features"), (("next", "number"), ("next", "features")):
            with torch.no_grad():
                expected = encoder(replay.observations(batch[key[0]]))
            torch.testing.assert_close(batch[key[1]], expected, rtol=0, atol=1e-6 * float(expected.abs().max()))


def test_batches_that_are_prefetched_while_the_ring_goes_round_hold_what_was_drawn():
    encoder = small_encoder(strides=(1, 1))
    replay = FrameReplay(
        100, frame_shape=(3, SIZE, SIZE), action_dim=1, returns_pixels=False, batch_size=32, prefetch=3
    )
    replay.append_transform(dense_of(encoder, replay, pad=0))
    for round_number in range(30):
        frames = torch.full((51, 3, SIZE, SIZE), round_number, dtype=torch.uint8)
        frames[:, 0, 0, 0] = torch.arange(51)
        replay.extend(rollout_of(frames))
        assert replay.sample()["features"].isfinite().all()


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x)), lambda x: x.clone()])
def test_copies_hold_no_maps_and_no_state_give_the_same_and_leave_the_features_of_the_original_alone(duplicate):
    dense = dense_of()
    td = dense.replay.batch(6)
    features = dense(td.clone())["features"]
    kept = features.clone()
    twin = duplicate(dense)
    twin.generator.manual_seed(3)
    encoded = len(twin.replay.asked)
    assert torch.equal(twin(td.clone())["features"], kept)
    assert len(twin.replay.asked) > encoded
    twin(dense.replay.batch(6))
    assert torch.equal(features, kept)
    assert not dense.state_dict()


@pytest.mark.parametrize("way", ["load_state_dict", "loads"])
def test_a_replay_that_goes_back_encodes_its_numbers_anew(way, tmp_path):
    replay = FrameReplay(20, frame_shape=(3, SIZE, SIZE), action_dim=1)
    dense = dense_of(small_encoder(strides=(1, 1)), replay, pad=0)
    replay.append_transform(dense)
    episodes = [rollout_of(torch.randint(0, 256, (6, 3, SIZE, SIZE), dtype=torch.uint8)) for _ in range(2)]
    state = replay.state_dict()
    replay.dumps(tmp_path)
    for episode in episodes:
        replay.load_state_dict(state) if way == "load_state_dict" else replay.loads(tmp_path)
        replay.extend(episode)
        batch = replay[:]
        with torch.no_grad():
            expected = dense.encoder(replay.observations(batch["number"]))
        torch.testing.assert_close(batch["features"], expected, rtol=0, atol=1e-6 * float(expected.abs().max()))


def test_too_few_places_are_refused_instead_of_giving_features_of_another_observation():
    dense = dense_of(observations=np.int64(4), in_keys="number", out_keys="features")
    assert dense(TensorDict({"number": torch.tensor([0, 5])}, [2]))["features"].shape[0] == 2
    with pytest.raises(ValueError, match="`observations` is 4, fewer than the replay holds"):
        dense(TensorDict({"number": torch.tensor([1, 5])}, [2]))


@pytest.mark.parametrize(
    ("encoder", "options", "named"),
    [
        (nn.Conv2d(9, 4, 3, padding=1), {}, "got Conv2d; encode shifted images instead"),
        (small_encoder(strides=(4, 4), image_size=40), {}, "total stride 16"),
        (small_encoder(), {"in_keys": ["number"]}, "pair up"),
        (small_encoder(), {"observations": 0}, "`observations` must be at least 1"),
        (small_encoder(), {"dtype": torch.float64}, r"maps in torch\.float64 .* got torch\.float32"),
    ],
)
def test_what_has_no_dense_maps_and_what_does_not_fit_is_refused(encoder, options, named):
    with pytest.raises(ValueError, match=named):
        DenseShiftFeatures(encoder, FakeReplay(), **options)


def test_frames_of_another_size_a_missing_number_and_an_environment_are_refused():
    with pytest.raises(NotImplementedError, match="on an environment use FrozenEncoder"):
        TransformedEnv(FakePixelEnv(), dense_of()).observation_spec  # noqa: B018
    with pytest.raises(KeyError, match="'number'"):
        dense_of()(TensorDict(pixels=torch.zeros(1)))
    with pytest.raises(ValueError, match="expected pixels"):
        dense_of(small_encoder(image_size=SIZE + 1))(FakeReplay().batch(2))


@pytest.mark.parametrize(
    ("encoder", "dtype", "available_gib", "options", "mode", "why"),
    [
        (PixelEncoder(), torch.bfloat16, 22, {}, "dense", "14.5 GiB for 40000 observations"),
        (PixelEncoder(), torch.bfloat16, 16, {}, "reencode", "too little memory"),
        (PixelEncoder(), torch.bfloat16, 22, {"latent_dim": 512}, "reencode", "too little memory"),
        (PixelEncoder(), torch.float32, 22, {}, "reencode", "features=dense-bf16 it would fit in 14.5 GiB"),
        (PixelEncoder(), torch.float32, 16, {}, "reencode", "16.0 GiB free)"),
        (nn.Flatten(), torch.float32, 999, {}, "reencode", "PixelEncoder, got Flatten"),
        (PixelEncoder(strides=(4, 4, 1, 1)), torch.float32, 999, {}, "reencode", "total stride 16"),
    ],
)
def test_auto_takes_dense_maps_where_they_fit_and_says_why(encoder, dtype, available_gib, options, mode, why):
    chosen, reason = choose_feature_mode("auto", encoder, 40_000, dtype, available_gib * 2**30, **options)
    assert chosen == mode
    assert why in reason
    assert "\n" not in reason


def test_explicit_modes_are_obeyed_or_refused():
    assert choose_feature_mode("reencode", PixelEncoder(), 1, torch.float32, 2**40)[0] == "reencode"
    assert choose_feature_mode("dense", PixelEncoder(), 1000, torch.bfloat16, 2**40)[0] == "dense"
    with pytest.raises(CRPTproError, match=r"do not fit in memory: 0\.4 GiB for 1000 observations, 0\.0 GiB free"):
        choose_feature_mode("dense", PixelEncoder(), 1000, torch.bfloat16, 2**20)
    with pytest.raises(ValueError, match="Flatten"):
        choose_feature_mode("dense", nn.Flatten(), 1, torch.float32, 2**40)
