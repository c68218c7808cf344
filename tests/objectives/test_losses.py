"""What TorchRL expects of a loss, for every loss of ours (cases in ``loss_cases.py``)."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from loss_cases import CASES, LossCase, assert_same, keep_targets, leaves, run, total
from tensordict import TensorDictBase
from tensordict.utils import unravel_key

pytestmark = [
    pytest.mark.parametrize("case", CASES, ids=str),
    pytest.mark.filterwarnings("ignore:No target network updater"),
]


def test_keys_have_documented_defaults(case: LossCase) -> None:
    loss = case.make()
    assert {name: getattr(loss.tensor_keys, name) for name in case.keys} == case.keys


def test_unknown_key_is_refused(case: LossCase) -> None:
    with pytest.raises(ValueError, match="not an accepted tensordict key"):
        case.make().set_keys(unheard_of="x")


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


def test_each_key_can_be_renamed_and_nested(case: LossCase) -> None:
    groups = [{name: ("group", name)} for name in case.keys]
    groups += [{name: ("group", name) for name in case.keys}]
    for names in groups:
        original, moved = renamed(case, names)
        loss = case.make()
        expected = run(loss, original)
        loss.set_keys(**names)
        assert set(loss.in_keys) <= set(moved.keys(True))
        assert_same(run(loss, moved), expected)
        loss.set_keys(**dict.fromkeys(names))
        assert_same(run(loss, original), expected)


def test_forward_leaves_its_input_alone(case: LossCase) -> None:
    td = case.batch()
    before = td.clone()
    run(case.make(), td)
    assert leaves(td).keys() == leaves(before).keys()
    for key, value in leaves(before).items():
        assert torch.equal(leaves(td)[key], value), key


def test_forward_writes_to_no_parameter(case: LossCase) -> None:
    loss = case.make()
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter.add_(0.1)
    before = {name: value.clone() for name, value in loss.state_dict().items()}
    run(loss, case.batch())
    for name, value in loss.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_keyword_and_positional_calls_equal_the_tensordict_call(case: LossCase) -> None:
    loss, td = case.make(), case.batch()
    expected = run(loss, td)
    values = [td[key] for key in loss.in_keys]
    names = ["_".join(key) if isinstance(key, tuple) else key for key in loss.in_keys]
    torch.manual_seed(7)
    by_keyword = loss(**dict(zip(names, values)))
    torch.manual_seed(7)
    by_position = loss(*values)
    assert len(by_keyword) == len(loss.out_keys)
    for key, first, second in zip(loss.out_keys, by_keyword, by_position):
        torch.testing.assert_close(first, expected[key])
        torch.testing.assert_close(second, expected[key])


def test_out_keys_are_what_forward_returns_and_can_be_selected(case: LossCase) -> None:
    loss, td = case.make(), case.batch()
    out = run(loss, td)
    assert set(out.keys()) == set(loss.out_keys)
    assert set(case.routing) == {key for key in loss.out_keys if key.startswith("loss_")}
    selected = next(iter(case.routing))
    loss.select_out_keys(selected)
    values = [td[key] for key in loss.in_keys]
    torch.manual_seed(7)
    torch.testing.assert_close(loss(*values), out[selected])


def test_two_batch_dimensions_equal_one(case: LossCase) -> None:
    td = case.batch(6)
    assert_same(run(case.make(), td.reshape(2, 3)), run(case.make(), td))


def test_each_loss_term_reaches_exactly_its_parameters(case: LossCase) -> None:
    groups = set.union(*case.routing.values())
    for key, expected in case.routing.items():
        loss = case.make()
        run(loss, case.batch())[key].sum().backward()
        reached = set()
        for name, parameter in loss.named_parameters():
            group = name.split(".")[0]
            assert group in groups, name
            if parameter.grad is not None and parameter.grad.any():
                reached.add(group)
                assert group in expected, f"{key} reaches {name}"
            elif group in expected:
                assert "bias" in name, f"{key} does not reach {name}"
        assert reached == expected


def test_targets_and_diagnostics_carry_no_gradient(case: LossCase) -> None:
    loss = case.make()
    out = run(loss, case.batch())
    for key, value in out.items():
        assert value.requires_grad == key.startswith("loss_"), key
    total(out).backward()
    for name, value in loss.state_dict(keep_vars=True).items():
        if name.startswith("target_"):
            assert not value.requires_grad
            assert value.grad is None
    assert not any(name.startswith("target_") for name, _ in loss.named_parameters())


def test_state_dict_round_trip_restores_outputs(case: LossCase) -> None:
    first, second = case.make(seed=0), case.make(seed=1)
    td = case.batch()
    assert not torch.equal(total(run(first, td)), total(run(second, td)))
    second.load_state_dict(first.state_dict())
    assert_same(run(second, td), run(first, td))


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda loss: pickle.loads(pickle.dumps(loss))])
def test_copies_are_equal_and_independent(case: LossCase, duplicate) -> None:
    loss, td = case.make(), case.batch()
    expected = run(loss, td)
    twin = duplicate(loss)
    assert_same(run(twin, td), expected)
    with torch.no_grad():
        for parameter in twin.parameters():
            parameter.mul_(2)
    assert_same(run(loss, td), expected)
    fresh = case.make(seed=1)  # never copied, so it cannot hold anything stale
    fresh.load_state_dict(twin.state_dict())
    assert_same(run(twin, td), run(fresh, td))


def test_networks_of_a_copy_hold_the_copied_parameters(case: LossCase) -> None:
    twin = copy.deepcopy(case.make())
    own = {id(parameter) for parameter in twin.parameters()}
    for name, module in vars(twin).items():
        if isinstance(module, torch.nn.Module):
            assert {id(p) for p in module.parameters()} <= own, name


def test_soft_update_moves_targets_by_tau(case: LossCase) -> None:
    loss = case.make()
    update_targets = keep_targets(case, loss)
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter.add_(torch.randn_like(parameter))
    before = {k: v.clone() for k, v in loss.state_dict().items()}
    update_targets()
    after = loss.state_dict()
    targets = [name for name in after if name.startswith("target_")]
    assert {name.removeprefix("target_").split("_params")[0] for name in targets} == set(case.targets)
    for name in targets:
        source = before[name.removeprefix("target_")]
        torch.testing.assert_close(after[name], before[name] + 0.05 * (source - before[name]))


def test_targets_loaded_after_the_updater_was_built_are_kept(case: LossCase) -> None:
    first = case.make()
    with torch.no_grad():
        for parameter in first.parameters():
            parameter.add_(1.0)
    second = case.make(seed=1)
    keep_targets(case, second)
    second.load_state_dict(first.state_dict())
    for name, value in first.state_dict().items():
        assert torch.equal(second.state_dict()[name], value), name


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


def test_double_precision_runs_in_double(case: LossCase) -> None:
    loss = case.make().to(torch.float64)
    td = case.batch().apply(lambda value: value.double() if value.is_floating_point() else value)
    out = run(loss, td)
    assert all(value.dtype == torch.float64 for key, value in out.items() if key.startswith("loss_"))
    total(out).backward()
    assert all(p.grad.dtype == torch.float64 for p in loss.parameters() if p.grad is not None)


def test_compiled_forward_equals_eager(case: LossCase) -> None:
    loss, td = case.make(), case.batch()
    keep_targets(case, loss)
    expected = run(loss, td)
    total(expected).backward()
    gradients = {name: p.grad.clone() for name, p in loss.named_parameters()}
    loss.zero_grad()
    out = run(torch.compile(loss, fullgraph=True, backend="aot_eager"), td)
    assert_same(out, expected)
    total(out).backward()
    for name, parameter in loss.named_parameters():
        torch.testing.assert_close(parameter.grad, gradients[name])


def test_one_row_is_a_legal_batch(case: LossCase) -> None:
    loss = case.make()
    out = run(loss, case.batch(1))
    total(out).backward()
    assert all(value.isfinite().all() for value in out.values())


def test_non_finite_parameters_propagate_to_the_loss(case: LossCase) -> None:
    loss = case.make()
    with torch.no_grad():
        next(p for name, p in loss.named_parameters() if "weight" in name).fill_(float("nan"))
    assert total(run(loss, case.batch())).isnan()


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
