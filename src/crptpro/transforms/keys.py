"""Keys of one step seen from two sides: an environment's step output, and ``"next"`` of a replay batch."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.utils import NestedKey, unravel_key


def is_next(key: NestedKey) -> bool:
    """Whether a key lies under ``"next"``, where replay batches keep what followed."""
    return isinstance(key, tuple) and key[0] == "next"


def with_next(key: NestedKey) -> NestedKey:
    """Return where a replay batch keeps this entry of an environment's step."""
    return key if is_next(key) else unravel_key(("next", key))


def without_next(key: NestedKey) -> NestedKey:
    """Return where an environment's step keeps this entry of a replay batch."""
    return unravel_key(key[1:]) if is_next(key) else unravel_key(key)


def as_key_list(keys: NestedKey | Sequence[NestedKey]) -> list[NestedKey]:
    """Return a list of keys.

    As in TorchRL, a string or a tuple of strings is one (nested) key and a list is several. A tuple that
    holds tuples can only be meant as several.

    Examples:
        >>> as_key_list(("next", "pixels"))
        [('next', 'pixels')]
        >>> as_key_list(("pixels", ("next", "pixels")))
        ['pixels', ('next', 'pixels')]
    """
    is_one = isinstance(keys, str) or (isinstance(keys, tuple) and all(isinstance(k, str) for k in keys))
    return [unravel_key(key) for key in ([keys] if is_one else keys)]
