from __future__ import annotations

from crptpro.transforms.keys import as_key_list, is_next, with_next, without_next


def test_adding_and_removing_next_are_inverse():
    for key in ("pixels", ("agents", "pixels")):
        assert without_next(with_next(key)) == key
        assert is_next(with_next(key))
        assert not is_next(without_next(key))


def test_next_is_added_and_removed_once_only():
    assert with_next(("next", "pixels")) == ("next", "pixels")
    assert without_next("pixels") == "pixels"


def test_a_tuple_is_one_nested_key_and_a_list_is_several():
    assert as_key_list(("next", "pixels")) == [("next", "pixels")]
    assert as_key_list(["next", "pixels"]) == ["next", "pixels"]
    assert as_key_list("pixels") == ["pixels"]


def test_a_tuple_that_holds_tuples_is_several_keys():
    assert as_key_list(("pixels", ("next", "pixels"))) == ["pixels", ("next", "pixels")]
