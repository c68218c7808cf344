"""BeCLLoss against the published arithmetic, typed again with plain torch."""

from __future__ import annotations

import copy

import pytest
import torch
import torch.nn.functional as F
from loss_cases import SKILLS, as_images, becl, passing_through, skill_batch
from tensor_checks import close, double
from tensordict import TensorDict

from crptpro.objectives import BeCLLoss


def released_update(loss: BeCLLoss, td: TensorDict):
    """Rooshy-yang/BeCL ``agent/becl.py`` on copies of the parameters."""
    encoder, head = copy.deepcopy(loss.encoder), copy.deepcopy(loss.projector)
    embed = torch.nn.Sequential(
        head.embed_input, torch.nn.ReLU(), head.embed_hidden, torch.nn.ReLU(), head.embed_output
    )
    project = torch.nn.Sequential(head.project_hidden, torch.nn.ReLU(), head.project_output)
    features = F.normalize(project(embed(encoder(td["next", "pixels"]))), dim=1)
    skills = td["skill"].argmax(dim=1)
    count = len(skills)
    off = ~torch.eye(count, dtype=torch.bool)
    same = (skills[:, None] == skills[None]).long()[off].view(count, -1)
    similarity = (features @ features.T / 0.5)[off].view(count, -1)
    similarity = similarity - similarity.max(dim=1, keepdim=True)[0].detach()
    similarity = similarity.exp()
    positive = similarity.gather(1, same.argmax(dim=1, keepdim=True)).squeeze(1)
    value = -torch.log(positive / (similarity.sum(dim=1) + 1e-6) + 1e-6).mean()
    value.backward()
    return value.detach(), [p.grad for m in (encoder, head) for p in m.parameters()]


def test_loss_and_gradients_equal_the_released_update() -> None:
    loss, td = becl(), skill_batch(11)
    expected, gradients = released_update(loss, td)
    value = loss(td)["loss_contrast"]
    torch.testing.assert_close(value.detach(), expected)
    value.backward()
    for (name, parameter), gradient in zip(loss.named_parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-3, atol=1e-6, msg=name)


def test_golden_losses_pass_through_the_module() -> None:
    encoder, projector = passing_through()
    features, skills = double([[1, 0], [0.6, 0.8], [0, 1], [-1, 0]]), torch.tensor([0, 0, 1, 1])
    td = TensorDict(
        {"next": {"pixels": as_images(features)}, "skill": F.one_hot(skills, SKILLS).double()}, [4]
    )
    rows = BeCLLoss(encoder, projector=projector, reduction="none")(td)["loss_contrast"]
    close(rows, double([0.294128, 0.948772, 1.939172, 0.362229]))


def test_it_reads_the_next_images_and_the_skill_and_nothing_else() -> None:
    loss, td = becl(), skill_batch()
    assert loss.in_keys == [("next", "pixels"), "skill"]
    expected = loss(td)["loss_contrast"]
    assert torch.equal(loss(td.exclude("pixels"))["loss_contrast"], expected)
    other = td.clone()
    other["skill"] = td["skill"].roll(1, 0)
    other["skill"][0] = td["skill"][1]
    assert not torch.equal(loss(other)["loss_contrast"], expected)
    with pytest.raises(KeyError, match="skill"):
        loss(td.exclude("skill"))


def test_the_head_is_the_projector_and_ends_in_as_many_numbers_as_skills() -> None:
    loss = becl()
    latents = loss.projector(loss.encoder(skill_batch(4)["next", "pixels"]))
    assert latents.shape == (4, SKILLS)
    assert loss.target_state() == {}
    assert loss.skill_dim == SKILLS


def test_a_temperature_that_is_not_positive_is_refused() -> None:
    with pytest.raises(ValueError, match="temperature must be positive, got -1"):
        becl(temperature=-1)
