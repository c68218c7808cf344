"""What every loss of this library tells of its outputs."""

from __future__ import annotations

from typing import ClassVar

from tensordict import NestedKey


class OutKeys:
    """Entries that ``forward`` returns, or those that a caller names; a base before ``LossModule``."""

    default_out_keys: ClassVar[tuple[str, ...]] = ()
    """Entries that ``forward`` returns."""

    _out_keys: list[NestedKey] | None = None

    @property
    def out_keys(self) -> list[NestedKey]:
        """Entries that ``forward`` returns."""
        if self._out_keys is None:
            self._out_keys = list(self.default_out_keys)
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[NestedKey]) -> None:
        self._out_keys = values
