"""The queue of latents that the prototype reward measures distances to."""

from __future__ import annotations

import pickle

import pytest
import torch
import torch.nn.functional as F
from test_prototype_reward import B, D, M, batch, on_latents, seeded

from crptpro.modules import Prototypes
from crptpro.transforms import PrototypeReward


def test_the_queue_is_first_in_first_out():
    transform = on_latents()
    for seed in range(4):
        transform(batch(seed=seed))
    full = transform.queue.clone()
    assert (full.norm(dim=-1) > 0.99).all()
    transform(batch(seed=4))
    assert torch.equal(transform.queue[M:], full[M:])
    assert not torch.equal(transform.queue[:M], full[:M])


def test_unfilled_rows_are_at_distance_one():
    transform = on_latents(queue_size=64)
    assert float(transform.intrinsic_reward(torch.randn(B, D, generator=seeded(5))).max()) <= 1.0 + 1e-6


def test_the_queue_survives_a_state_dict_round_trip():
    first = on_latents(reward_norm="rms", queue_size=32)
    for seed in range(3):
        first(batch(seed=seed))
    second = on_latents(reward_norm="rms", queue_size=32, prototypes=torch.zeros(M, D))
    second.load_state_dict(first.state_dict())
    second.generator.set_state(first.generator.get_state())
    for name in ("queue", "queue_pointer", "prototypes", "reward_square_sum", "reward_count"):
        assert torch.equal(getattr(first, name), getattr(second, name))
    latents = torch.randn(B, D)
    assert torch.equal(first.intrinsic_reward(latents), second.intrinsic_reward(latents))


def test_a_queue_can_be_handed_over_and_emptied():
    handed = F.normalize(torch.randn(32, D, generator=seeded(8)), dim=-1)
    transform = on_latents(queue=handed, queue_pointer=M)
    assert transform.queue.data_ptr() != handed.data_ptr()
    transform(batch())
    assert torch.equal(transform.queue[:M], handed[:M])
    assert not torch.equal(transform.queue[M : 2 * M], handed[M : 2 * M])
    transform.reset_queue()
    assert not transform.queue.any()
    assert int(transform.queue_pointer) == 0


def test_clones_and_pickles_have_their_own_queue():
    transform = on_latents()
    transform(batch())
    before = transform.queue.clone()
    clone, copy = transform.clone(), pickle.loads(pickle.dumps(transform))
    for other in (clone, copy):
        assert torch.equal(other.queue, before)
        other(batch(seed=1))
        assert not torch.equal(other.queue, before)
    assert torch.equal(transform.queue, before)


def test_the_same_seed_gives_the_same_draws_and_another_seed_others():
    queues = []
    for seed in (1, 1, 2):
        transform = on_latents(generator=seeded(seed))
        transform(batch())
        queues.append(transform.queue)
    assert torch.equal(queues[0], queues[1])
    assert not torch.equal(queues[0], queues[2])


def test_a_queue_that_is_no_multiple_of_the_prototypes_is_refused_naming_both():
    with pytest.raises(ValueError, match=r"queue_size.*num_prototypes.*2000.*512"):
        PrototypeReward(None, Prototypes(512, 4), queue_size=2000)
