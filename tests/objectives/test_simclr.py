"""SimCLRLoss against the published arithmetic, typed again with plain torch."""

from __future__ import annotations

import copy

import pytest
import torch
import torch.nn.functional as F
from loss_cases import as_images, passing_through, simclr, view_batch
from tensor_checks import close, double
from tensordict import TensorDict

from crptpro.modules import PixelEncoder
from crptpro.objectives import SimCLRLoss


def released_update(loss: SimCLRLoss, td: TensorDict, temperature: float):
    """The authors' InfoNCE over 2B views: the positive is moved to column 0 of the logits."""
    encoder, projector = copy.deepcopy(loss.encoder), copy.deepcopy(loss.projector)
    features = F.normalize(projector(encoder(torch.cat([td["pixels"], td["pixels_view"]]))), dim=1)
    labels = torch.cat([torch.arange(len(td)), torch.arange(len(td))])
    labels = (labels[:, None] == labels[None]).float()
    similarity = features @ features.T
    others = ~torch.eye(len(labels), dtype=torch.bool)
    labels = labels[others].view(len(labels), -1)
    similarity = similarity[others].view(len(labels), -1)
    positives = similarity[labels.bool()].view(len(labels), -1)
    negatives = similarity[~labels.bool()].view(len(labels), -1)
    logits = torch.cat([positives, negatives], dim=1) / temperature
    value = F.cross_entropy(logits, torch.zeros(len(logits), dtype=torch.long))
    value.backward()
    return value.detach(), [p.grad for m in (encoder, projector) for p in m.parameters()]


@pytest.mark.parametrize("options", [{}, {"temperature": 0.5}])
def test_loss_and_gradients_equal_the_released_update(options: dict) -> None:
    loss, td = simclr(**options), view_batch(9)
    expected, gradients = released_update(loss, td, options.get("temperature", 0.07))
    value = loss(td)["loss_contrast"]
    torch.testing.assert_close(value.detach(), expected)
    value.backward()
    for (name, parameter), gradient in zip(loss.named_parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-3, atol=1e-5, msg=name)


def test_golden_value_passes_through_the_module() -> None:
    encoder, projector = passing_through()
    views = double([[1, 0], [0, 1], [0.8, 0.6], [-0.6, 0.8]])
    td = TensorDict({"pixels": as_images(views[:2]), "pixels_view": as_images(views[2:])}, [2])
    loss = SimCLRLoss(encoder, projector=projector)
    assert loss(td)["loss_contrast"].item() == pytest.approx(0.027933, abs=1e-6)
    # Only the directions matter.
    longer = td.apply(lambda images: 3 * images)
    close(loss(longer)["loss_contrast"], loss(td)["loss_contrast"], 1e-9)


def test_the_views_change_places_without_changing_the_loss() -> None:
    td, loss = view_batch(), simclr()
    swapped = TensorDict({"pixels": td["pixels_view"], "pixels_view": td["pixels"]}, td.batch_size)
    torch.testing.assert_close(loss(swapped)["loss_contrast"], loss(td)["loss_contrast"])


def test_the_gradient_reaches_both_views() -> None:
    td = view_batch(4).apply(lambda pixels: pixels.float().requires_grad_())
    simclr()(td)["loss_contrast"].backward()
    assert td["pixels"].grad.any()
    assert td["pixels_view"].grad.any()


def test_it_says_which_entry_is_a_view_of_which() -> None:
    loss = simclr()
    assert loss.views == {"pixels_view": "pixels"}
    loss.set_keys(observation=("next", "pixels"), observation_view=("next", "pixels_view"))
    assert loss.views == {("next", "pixels_view"): ("next", "pixels")}
    assert loss.in_keys == [("next", "pixels"), ("next", "pixels_view")]


def test_a_missing_view_is_named() -> None:
    with pytest.raises(KeyError, match="pixels_view"):
        simclr()(view_batch().exclude("pixels_view"))


def test_defaults_are_apts() -> None:
    loss = SimCLRLoss(PixelEncoder())
    assert loss.projector.config["latent_dim"] == 128
    assert loss.temperature.item() == 0.07
    assert loss.target_state() == {}
    with pytest.raises(ValueError, match="temperature must be positive, got 0"):
        simclr(temperature=0)
