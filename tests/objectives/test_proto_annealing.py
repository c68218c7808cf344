"""The temperature of the targets, moved over the updates."""

from __future__ import annotations

import copy

import pytest
import torch
from loss_cases import image_batch, proto

from crptpro.objectives import ProtoLoss
from crptpro.training.fingerprint import describe_loss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

FIRST, LAST, UPDATES = 0.02, 0.1, 4


def annealed(**options) -> ProtoLoss:
    return proto(assignment_temperature=FIRST, annealing_updates=UPDATES, **options)


def constant(like: ProtoLoss, temperature: float) -> ProtoLoss:
    loss = proto(assignment_temperature=temperature)
    loss.load_state_dict({k: v for k, v in like.state_dict().items() if k in dict(loss.named_parameters())},
                         strict=False)  # fmt: skip
    return loss


def test_update_u_has_the_temperature_on_the_straight_line_from_the_first_to_the_students() -> None:
    loss, td = annealed(), image_batch(12)
    seen = []
    for u in range(UPDATES + 3):
        temperature = FIRST + (LAST - FIRST) * min(u / UPDATES, 1.0)
        out = loss.before_update()(td)
        expected = constant(loss, temperature).before_update()(td)
        torch.testing.assert_close(out["comp"], expected["comp"], rtol=1e-6, atol=0)
        torch.testing.assert_close(out["assignment_entropy"], expected["assignment_entropy"])
        seen.append(float(out["assignment_entropy"]))
    assert seen[: UPDATES + 1] == sorted(seen[: UPDATES + 1])
    assert seen[0] < seen[UPDATES] - 1e-3


def test_once_annealed_it_is_the_default_to_the_bit() -> None:
    loss, td = annealed(), image_batch(12)
    for _ in range(UPDATES + 1):
        loss.before_update()
    assert torch.equal(loss(td)["loss_comp"], constant(loss, LAST).before_update()(td)["loss_comp"])


def test_forward_counts_nothing_and_alone_has_the_first_temperature() -> None:
    loss, td = annealed(), image_batch(12)
    one, two = (float(loss(td)["comp"]) for _ in range(2))
    assert one == two == float(constant(loss, FIRST)(td)["comp"])
    assert float(loss.before_update().updates_begun) == 1
    loss(td)
    assert float(loss.updates_begun) == 1


def test_without_annealing_there_is_nothing_new_to_store_or_to_compare() -> None:
    loss = proto(assignment_temperature=FIRST)
    assert "updates_begun" not in loss.state_dict()
    assert not any("anneal" in name or "updates_begun" in name for name in describe_loss(loss))
    assert describe_loss(annealed())["annealing_updates"] == UPDATES


def test_how_far_it_is_survives_copies_and_state_dicts() -> None:
    loss, td = annealed(), image_batch(12)
    loss.before_update().before_update()
    copied, loaded = copy.deepcopy(loss), annealed()
    loaded.load_state_dict(loss.state_dict())
    for _ in range(2):
        expected = loss.before_update()(td)["comp"]
        assert torch.equal(copied.before_update()(td)["comp"], expected)
        assert torch.equal(loaded.before_update()(td)["comp"], expected)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"annealing_updates": 0, "assignment_temperature": 0.05}, "at least 1, got 0"),
        ({"annealing_updates": 10}, "needs an assignment_temperature to start from"),
    ],
)
def test_impossible_annealing_is_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        proto(**options)
