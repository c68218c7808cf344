"""Keys, outputs and reductions as TorchRL expects them, for every loss (cases in ``loss_cases.py``)."""

from __future__ import annotations

import ast
import inspect
import textwrap

import pytest
import torch
from loss_cases import CASES, LossCase, assert_same, leaves, run
from tensordict import TensorDictBase
from tensordict.utils import unravel_key

pytestmark = [
    pytest.mark.parametrize("case", CASES, ids=str),
    pytest.mark.filterwarnings("ignore:No target network updater"),
]


# L1 ------------------------------------------------------------------------------------------------------


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


# L2 ------------------------------------------------------------------------------------------------------


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


# L3 ------------------------------------------------------------------------------------------------------


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


# L4 ------------------------------------------------------------------------------------------------------


def test_reductions_are_consistent(case: LossCase) -> None:
    td = case.batch()
    rows, mean, sums = (run(case.make(reduction=name), td) for name in ("none", "mean", "sum"))
    for key in case.routing:
        assert mean[key].shape == sums[key].shape == ()
        if key in case.per_row:
            assert rows[key].shape == td.batch_size
            torch.testing.assert_close(rows[key].mean(), mean[key])
            torch.testing.assert_close(rows[key].sum(), sums[key])


def test_two_batch_dimensions_equal_one(case: LossCase) -> None:
    td = case.batch(6)
    flat, folded = run(case.make(), td), run(case.make(), td.reshape(2, 3))
    assert_same(folded, flat)
    assert run(case.make(reduction="none"), td.reshape(2, 3))[case.per_row[0]].shape == (2, 3)


def test_an_unknown_reduction_is_refused_or_fails_at_once(case: LossCase) -> None:
    with pytest.raises((ValueError, NotImplementedError)):
        run(case.make(reduction="median"), case.batch())


# L11 ----------------------------------------------------------------------------------------------------


def not_methods(owner: type) -> list[str]:
    """Public names ending in "loss" that a class body binds to something else than a plain method.

    TorchRL's metaclass wraps whatever bears such a name into a function, so the class itself no longer tells.
    """
    found = []
    for statement in ast.parse(textwrap.dedent(inspect.getsource(owner))).body[0].body:
        if isinstance(statement, ast.FunctionDef):
            decorators = {node.id if isinstance(node, ast.Name) else "" for node in statement.decorator_list}
            bound = [] if decorators <= {"dispatch"} else [statement.name]
        elif isinstance(statement, (ast.Assign, ast.AnnAssign, ast.ClassDef)):
            nodes = getattr(statement, "targets", [getattr(statement, "target", None)])
            bound = [node.id for node in nodes if isinstance(node, ast.Name)]
            bound += [statement.name] if isinstance(statement, ast.ClassDef) else []
        else:
            bound = []
        found += [name for name in bound if name.endswith("loss") and not name.startswith("_")]
    return found


def test_every_attribute_ending_in_loss_is_a_method(case: LossCase) -> None:
    own = [base for base in type(case.make()).__mro__ if base.__module__.startswith("crptpro")]
    assert own
    for base in own:
        assert not_methods(base) == [], base


def test_the_check_for_methods_sees_through_the_metaclass(case: LossCase) -> None:
    class Trapped(type(case.make())):
        base_loss = torch.nn.functional.mse_loss
        cached_loss: int = 3

        @property
        def last_loss(self) -> float:
            return 0.0

        @torch.no_grad()
        def slow_loss(self) -> float:
            return 0.0

        def plain_loss(self) -> float:
            return 0.0

    assert not_methods(Trapped) == ["base_loss", "cached_loss", "last_loss", "slow_loss"]
