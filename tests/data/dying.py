"""A run that dies at a moment of the test's choice, as a killed process does: nothing of it catches that."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest


class Killed(BaseException):
    pass


@contextmanager
def killed_in(owner: type, method: str, when: Callable[[Any], bool]) -> Iterator[None]:
    """Expect the block to die in the method, at the first object for which ``when`` is true."""
    original = getattr(owner, method)

    def dies(owned: Any, *arguments: Any) -> Any:
        if when(owned):
            raise Killed
        return original(owned, *arguments)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(owner, method, dies)
        with pytest.raises(Killed):
            yield
