"""Which domains an encoder has seen; probes themselves are tested through the command and as pieces."""

from __future__ import annotations

import torch

from crptpro.experiments.probing import _untrained_projector, domains_seen
from crptpro.pretrained import Pretrained, random_pretrained


def trained_on(*domains: str, before: dict | None = None) -> dict:
    return {"datasets": [{"domain": domain} for domain in domains], "previous_training": before}


def seen(training: dict | None) -> set[str]:
    encoder = random_pretrained(channels=(4,), strides=(2,), image_size=16).encoder
    return domains_seen(Pretrained(encoder, card={"method": "crptpro", "training": training}))


def test_an_encoder_has_seen_the_domains_of_its_training() -> None:
    assert seen(trained_on("walker", "cheetah")) == {"walker", "cheetah"}
    assert seen(None) == seen({}) == set()


def test_a_fine_tuned_encoder_has_seen_those_of_the_one_it_started_from_too() -> None:
    assert seen(trained_on("finger", before=trained_on("walker", before=trained_on("hopper")))) == {
        "finger",
        "walker",
        "hopper",
    }


def test_the_untrained_control_has_a_projector_that_its_seed_decides() -> None:
    def weights(seed: int) -> torch.Tensor:
        state = torch.get_rng_state()
        projector = _untrained_projector(random_pretrained(seed, channels=(4,), strides=(2,), image_size=16))
        assert torch.equal(torch.get_rng_state(), state)
        assert not any(parameter.requires_grad for parameter in projector.parameters())
        return projector.linear.weight

    assert weights(1).shape == (128, 4 * 7 * 7)
    assert torch.equal(weights(1), weights(1))
    assert not torch.equal(weights(1), weights(2))
