from __future__ import annotations

from crptpro.experiments.goals import METHODS
from crptpro.experiments.report.palette import base_method, in_order, styles


def test_every_system_has_a_look_of_its_own() -> None:
    looks = styles(METHODS)
    assert list(looks) == list(METHODS)
    assert len(set(looks.values())) == len(METHODS)
    assert len({(look.marker, look.dashes) for look in looks.values()}) == len(
        METHODS
    )  # told apart without colour
    assert [base_method(method) for method in METHODS] == list(METHODS)


def test_a_variant_has_its_methods_colour_and_a_dash_of_its_own() -> None:
    looks = styles(["crptpro", "crptpro, alpha 0.05", "crptpro, alpha 0.5", "mine"])
    assert len({look.color for look in list(looks.values())[:3]}) == 1
    assert len(set(looks.values())) == 4
    assert looks["mine"].color != looks["crptpro"].color


def test_tables_show_methods_as_the_paper_does_with_variants_after_them() -> None:
    assert in_order(["mine", "atc", "crptpro, alpha 0.5", "crptpro"]) == [
        "crptpro", "crptpro, alpha 0.5", "atc", "mine",
    ]  # fmt: skip
