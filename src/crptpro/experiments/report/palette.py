"""One colour, marker and dash per system, the same in every figure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Style:
    """How a system is drawn; colour is never the only difference.

    Args:
        color: readable on white and on near black.
        marker: of matplotlib.
        dashes: of matplotlib.
    """

    color: str
    marker: str = "o"
    dashes: str = "-"


# Of Okabe and Ito's and of Tol's colour-blind-safe sets, those of a middle lightness: a page may be light or dark.
_STYLES = {
    "crptpro": Style("#0b80c3", "o"),
    "crptpro-fast": Style("#3d74d8", "p", "-."),
    "crptpro-finetune": Style("#2fa7e0", "D", "--"),
    "proto-rl-c": Style("#d9640a", "s"),
    "proto-rl-s": Style("#e69f00", "P", "--"),
    "atc": Style("#109e77", "^"),
    "apt-c": Style("#c76aa2", "v"),
    "apt-s": Style("#a64d84", "X", "--"),
    "becl": Style("#8f8a2a", "<"),
    "drq": Style("#8a7bd8", ">"),
    "random-encoder": Style("#858a91", "h", ":"),
    "random policy": Style("#858a91", ".", ":"),
}

_VARIANTS = (
    ("o", "-"),
    ("s", "--"),
    ("^", "-."),
    ("D", ":"),
    ("v", (0, (5, 1, 1, 1, 1, 1))),
    ("P", (0, (1, 3))),
)
_OTHERS = (
    "#0b80c3", "#d9640a", "#109e77", "#c76aa2", "#8f8a2a", "#8a7bd8", "#e69f00", "#858a91", "#bb5566",
)  # fmt: skip


def styles(labels: Iterable[str]) -> dict[str, Style]:
    """Return how labels are drawn.

    A variant (``"proto-rl-c with dispersion"``, ``"crptpro, alpha 0.05"``) has its method's colour with another marker
    and dash; a label of no known method takes the next free colour, in the order given.

    Args:
        labels: in the order of the legend.
    """
    found: dict[str, Style] = {}
    variants: dict[str, int] = {}
    others = 0
    unique = list(dict.fromkeys(labels))
    taken = {_STYLES[base].color for label in unique if (base := base_method(label))}
    free = [color for color in _OTHERS if color not in taken]
    for label in unique:
        base = base_method(label)
        if label in _STYLES:
            found[label] = _STYLES[label]
        elif base:
            place = variants[base] = variants.get(base, 0 if base in unique else -1) + 1
            marker, dashes = _VARIANTS[place % len(_VARIANTS)]
            found[label] = replace(_STYLES[base], marker=marker, dashes=dashes)  # type: ignore[arg-type]
        else:
            marker, dashes = _VARIANTS[others % len(_VARIANTS)]
            found[label] = Style(free[others % len(free)], marker, dashes)  # type: ignore[arg-type]
            others += 1
    return found


def base_method(label: str) -> str:
    """Return the method that a label is a variant of; empty if there is none.

    Examples:
        >>> base_method("proto-rl-c with dispersion"), base_method("crptpro-finetune"), base_method("mine")
        ('proto-rl-c', 'crptpro-finetune', '')
    """
    fitting = [m for m in _STYLES if label == m or label.startswith((f"{m} ", f"{m},", f"{m}-"))]
    return max(fitting, key=len, default="")


def in_order(labels: Iterable[str]) -> list[str]:
    """Sort labels as tables show them: methods as the paper's, variants after their method, others last."""
    order = list(_STYLES)
    unique = list(dict.fromkeys(labels))

    def place(label: str) -> tuple[int, bool, int]:
        base = base_method(label)
        return (order.index(base) if base else len(order), label != base, unique.index(label))

    return sorted(unique, key=place)
