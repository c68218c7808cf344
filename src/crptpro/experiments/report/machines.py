"""Where numbers were made: machines by number, for tables of times."""

from __future__ import annotations

from collections.abc import Iterable

from crptpro.experiments.report.blocks import ABSENT


class Machines:
    """Numbers of machines, in the order in which a table names them."""

    def __init__(self) -> None:
        """Start without any."""
        self._numbers: dict[str, int] = {}

    @property
    def differ(self) -> bool:
        """Whether there are several."""
        return len(self._numbers) > 1

    def numbers_of(self, names: Iterable[str]) -> str:
        """Return the numbers of what was made together; machines that have none yet get the next ones.

        Args:
            names: of machines, in words; repeats count once.

        Examples:
            >>> machines = Machines()
            >>> machines.numbers_of(["two cores"]), machines.numbers_of(["two cores", "a GPU", "two cores"])
            ('1', '1, 2')
        """
        found = {self._numbers.setdefault(name, len(self._numbers) + 1) for name in sorted(set(names))}
        return ", ".join(map(str, sorted(found))) or ABSENT

    def text(self) -> str:
        """Say which is which, and what may be compared; empty if there are none.

        Examples:
            >>> machines = Machines()
            >>> _ = machines.numbers_of(["two cores"])
            >>> machines.text()
            'Made on 1: two cores.'
        """
        if not self._numbers:
            return ""
        text = f"Made on {'; '.join(f'{number}: {name}' for name, number in self._numbers.items())}."
        if self.differ:
            text += (
                " Times compare only within one machine, and pieces that shared one slowed each other down."
            )
        return text
