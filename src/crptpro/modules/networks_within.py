"""All networks inside a network, those that a LossModule hides included."""

from __future__ import annotations

from collections.abc import Iterator

from torch import nn


def networks_within(module: nn.Module) -> Iterator[nn.Module]:
    """Yield a network and everything inside it, each once.

    ``LossModule.convert_to_functional`` hides networks in the instance dictionary, where ``modules()`` does not look;
    they are found too.
    """
    return _walk(module, set())


def _walk(module: nn.Module, seen: set[int]) -> Iterator[nn.Module]:
    for child in module.modules():
        if id(child) in seen:
            continue
        seen.add(id(child))
        yield child
        for value in list(vars(child).values()):
            if isinstance(value, nn.Module):
                yield from _walk(value, seen)
