"""What TorchRL expects of a loss, for every loss of ours (cases in ``loss_cases.py``)."""

from __future__ import annotations

import copy
import pickle
import re

import pytest
import torch
from loss_cases import CASES, LossCase, assert_same, disturb, keep_targets, leaves, run, total, view_batch
from tensordict import TensorDictBase
from tensordict.utils import unravel_key

from crptpro.objectives import SimCLRLoss

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")
each = pytest.mark.parametrize("case", CASES, ids=str)


def renamed(case: LossCase, names: dict) -> tuple[TensorDictBase, TensorDictBase]:
    """A batch, and the same batch with some entries under other names."""
    original = case.batch()
    moved = original.copy()
    for name, new in names.items():
        default = case.keys[name]
        if default in original.keys(True):
            moved.rename_key_(default, new)
        following = unravel_key(("next", default))
        if case.keys_hold_under_next and following in original.keys(True):
            moved.rename_key_(following, unravel_key(("next", new)))
    return original, moved


@each
def test_each_key_has_its_default_and_can_be_renamed_and_nested(case: LossCase) -> None:
    loss = case.make()
    assert {name: getattr(loss.tensor_keys, name) for name in case.keys} == case.keys
    groups = [{name: ("group", name)} for name in case.keys]
    groups += [{name: ("group", name) for name in case.keys}]
    expected = run(loss, case.batch())
    for names in groups:
        original, moved = renamed(case, names)
        loss.set_keys(**names)
        assert set(loss.in_keys) <= set(moved.keys(True))
        assert_same(run(loss, moved), expected)
        loss.set_keys(**dict.fromkeys(names))
        assert_same(run(loss, original), expected)
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        loss.set_keys(unheard_of="x")


@each
def test_a_missing_entry_is_named(case: LossCase) -> None:
    loss = case.make()
    for key in loss.in_keys:
        with pytest.raises(KeyError, match=re.escape(f"{type(loss).__name__} needs the entry {key!r} and found")):
            run(loss, case.batch().exclude(key))


@each
def test_forward_writes_neither_to_its_input_nor_to_a_parameter(case: LossCase) -> None:
    loss, td = case.make(), case.batch()
    disturb(loss)
    before = {**leaves(td.clone()), **{name: value.clone() for name, value in loss.state_dict().items()}}
    run(loss, td)
    after = {**leaves(td), **loss.state_dict()}
    assert after.keys() == before.keys()
    for key, value in before.items():
        assert torch.equal(after[key], value), key


@each
def test_keyword_positional_and_selecting_calls_equal_the_tensordict_call(case: LossCase) -> None:
    loss, td = case.make(), case.batch()
    expected = run(loss, td)
    assert set(expected.keys()) == set(loss.out_keys)
    assert set(case.routing) == {key for key in loss.out_keys if key.startswith("loss_")}
    values = [td[key] for key in loss.in_keys]
    names = ["_".join(key) if isinstance(key, tuple) else key for key in loss.in_keys]
    torch.manual_seed(7)
    by_keyword = loss(**dict(zip(names, values)))
    torch.manual_seed(7)
    by_position = loss(*values)
    for key, first, second in zip(loss.out_keys, by_keyword, by_position, strict=True):
        torch.testing.assert_close((first, second), (expected[key], expected[key]))
    selected = next(iter(case.routing))
    loss.select_out_keys(selected)
    torch.manual_seed(7)
    torch.testing.assert_close(loss(*values), expected[selected])


@each
def test_batches_of_two_dimensions_and_of_one_row_are_legal(case: LossCase) -> None:
    td = case.batch(6)
    assert_same(run(case.make(), td.reshape(2, 3)), run(case.make(), td))
    out = run(case.make(), case.batch(1))
    total(out).backward()
    assert all(value.isfinite().all() for value in out.values())


@each
def test_each_loss_term_reaches_exactly_its_parameters(case: LossCase) -> None:
    groups = set.union(*case.routing.values())
    for key, expected in case.routing.items():
        loss = case.make()
        out = run(loss, case.batch())
        assert all(value.requires_grad == name.startswith("loss_") for name, value in out.items())
        out[key].sum().backward()
        reached = set()
        for name, parameter in loss.named_parameters():
            group = name.split(".")[0]
            assert group in groups, name  # no target among them
            if parameter.grad is not None and parameter.grad.any():
                reached.add(group)
                assert group in expected, f"{key} reaches {name}"
            elif group in expected:
                assert "bias" in name, f"{key} does not reach {name}"
        assert reached == expected
        for name, value in loss.state_dict(keep_vars=True).items():
            assert not (name.startswith("target_") and value.requires_grad), name


@each
def test_state_dict_round_trip_restores_outputs_and_targets(case: LossCase) -> None:
    first, second = case.make(seed=0), case.make(seed=1)
    td = case.batch()
    disturb(first)
    keep_targets(case, second)
    assert not torch.equal(total(run(first, td)), total(run(second, td)))
    second.load_state_dict(first.state_dict())
    assert_same(run(second, td), run(first, td))
    for name, value in first.state_dict().items():
        assert torch.equal(second.state_dict()[name], value), name


@each
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda loss: pickle.loads(pickle.dumps(loss))])
def test_copies_are_equal_and_independent_and_their_networks_hold_their_parameters(case: LossCase, duplicate) -> None:
    loss, td = case.make(), case.batch()
    expected = run(loss, td)
    twin = duplicate(loss)
    assert_same(run(twin, td), expected)
    own = {id(parameter) for parameter in twin.parameters()}
    for name, module in vars(twin).items():
        if isinstance(module, torch.nn.Module):
            assert {id(p) for p in module.parameters()} <= own, name
    disturb(twin)
    assert_same(run(loss, td), expected)
    fresh = case.make(seed=1)  # never copied, so it cannot hold anything stale
    fresh.load_state_dict(twin.state_dict())
    assert_same(run(twin, td), run(fresh, td))


class Normalising(torch.nn.Sequential):
    """An encoder with statistics of its batches."""

    feature_dim = 3 * 15 * 15

    def __init__(self) -> None:
        super().__init__(torch.nn.BatchNorm2d(3), torch.nn.Flatten())

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        return super().forward(pixels.to(self[0].weight.dtype))


def test_the_encoder_of_a_loss_that_was_cast_has_its_parameters_and_its_statistics() -> None:
    loss = SimCLRLoss(Normalising(), latent_dim=4)
    held = [*loss.parameters()]
    loss.to(torch.float64)
    assert {id(parameter) for parameter in loss.parameters()} == {id(parameter) for parameter in held}
    assert {id(parameter) for parameter in loss.encoder.parameters()} <= {id(parameter) for parameter in held}
    loss(view_batch())
    assert loss.encoder[0].running_mean.all()
    assert loss.encoder(view_batch()["pixels"]).dtype == torch.float64


@each
def test_soft_update_moves_targets_by_tau(case: LossCase) -> None:
    loss = case.make()
    update_targets = keep_targets(case, loss)
    disturb(loss)
    before = {k: v.clone() for k, v in loss.state_dict().items()}
    update_targets()
    after = loss.state_dict()
    targets = [name for name in after if name.startswith("target_")]
    assert {name.removeprefix("target_").split("_params")[0] for name in targets} == set(case.targets)
    for name in targets:
        source = before[name.removeprefix("target_")]
        torch.testing.assert_close(after[name], before[name] + 0.05 * (source - before[name]))


@each
def test_reset_changes_every_parameter_and_target(case: LossCase) -> None:
    loss = case.make()
    with torch.no_grad():
        for name, value in loss.state_dict(keep_vars=True).items():
            if "_params" in name or name == "log_alpha":
                value.add_(1000.0)
    loss.reset_parameters_recursive()
    for name, value in loss.state_dict().items():
        if "_params" in name or name == "log_alpha":
            assert value.abs().max() < 100, name
        if name.startswith("target_"):
            assert torch.equal(value, loss.state_dict()[name.removeprefix("target_")]), name


@each
def test_double_precision_runs_in_double_and_nan_shows(case: LossCase) -> None:
    loss = case.make().to(torch.float64)
    td = case.batch().apply(lambda value: value.double() if value.is_floating_point() else value)
    out = run(loss, td)
    assert all(value.dtype == torch.float64 for key, value in out.items() if key.startswith("loss_"))
    total(out).backward()
    assert all(p.grad.dtype == torch.float64 for p in loss.parameters() if p.grad is not None)
    with torch.no_grad():
        next(p for name, p in loss.named_parameters() if "weight" in name).fill_(float("nan"))
    assert total(run(loss, td)).isnan()


@each
def test_twenty_adam_updates_lower_the_loss(case: LossCase) -> None:
    loss, td = case.make(), case.batch()
    update_targets = keep_targets(case, loss)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    key = next(iter(case.routing))
    first = run(loss, td)[key].item()
    for _ in range(20):
        if hasattr(loss, "before_update"):
            loss.before_update()
        optimizer.zero_grad()
        total(run(loss, td)).backward()
        optimizer.step()
        update_targets()
    assert run(loss, td)[key].item() < 0.9 * first


COMPILED = {
    **dict.fromkeys(("ProtoLoss", "ATCLoss", "SimCLRLoss", "BeCLLoss"), "forward"),
    "RADSACLoss": "critic_loss",
    "DrQLoss": "actor_and_temperature_loss",
}


@pytest.mark.parametrize("case", [case for case in CASES if case.name in COMPILED], ids=str)
def test_what_training_compiles_compiles_as_a_whole_and_equals_eager(case: LossCase) -> None:
    loss, td, method = case.make(), case.batch(), COMPILED[case.name]
    outcomes = []
    for wrap in (lambda step: step, lambda step: torch.compile(step, fullgraph=True, backend="eager")):
        step = wrap(loss if method == "forward" else getattr(loss, method))
        torch.manual_seed(7)
        out = step(td)
        loss.zero_grad()
        total(out).backward()
        gradients = {name: p.grad for name, p in loss.named_parameters() if p.grad is not None}
        outcomes.append((out, gradients))
    assert_same(outcomes[1][0], outcomes[0][0])
    torch.testing.assert_close(outcomes[1][1], outcomes[0][1])
