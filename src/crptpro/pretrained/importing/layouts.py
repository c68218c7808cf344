"""Recognising what a snapshot holds: flat tables of tensors from agents, modules and state dicts."""

from __future__ import annotations

import math
from collections.abc import ItemsView
from dataclasses import dataclass, field
from typing import Any

from crptpro.errors import PretrainedError
from crptpro.pretrained.importing.names import ATC, BECL, PROTO, URLB, URLB_PROTO, Layout, join
from crptpro.pretrained.importing.restricted_pickle import Foreign, TensorRecord

Section = dict[str, TensorRecord]
Scalar = int | float | str | bool

_MOST_MODULES = 10_000
_MOST_TENSORS = 100_000
_MOST_ENTRIES = 1_000_000
_LONGEST_TEXT = 200
_COUNTERS = {"_global_step": "agent_steps", "_global_episode": "episodes", "itr": "updates"}


@dataclass
class Contents:
    """What was found in a snapshot.

    Attributes:
        layout: whose it is.
        sections: networks by attribute name, as flat state dicts; a lone tensor has the name ``""``.
        strides: of the encoder's convolutions by ``encoder.name``, where the snapshot holds the modules themselves.
        settings: plain numbers and texts beside the networks, ``section.name`` for those of a network.
        counters: ``agent_steps``, ``episodes`` or ``updates`` so far, as the snapshot counts them.
        others: names of what is neither network, tensor nor setting.
        agent_class: dotted name of the agent's class; None for state dicts.
        entries: of dicts, looked at so far. Networks may share a dict, so that a small file has any number of them.
    """

    layout: Layout = URLB
    sections: dict[str, Section] = field(default_factory=dict)
    strides: dict[str, tuple[int, ...]] = field(default_factory=dict)
    settings: dict[str, Scalar] = field(default_factory=dict)
    counters: dict[str, int] = field(default_factory=dict)
    others: list[str] = field(default_factory=list)
    agent_class: str | None = None
    entries: int = 0

    def look_at(self, table: dict[Any, Any]) -> ItemsView[Any, Any]:
        """Return the entries of a dict, unless there have been too many.

        Raises:
            PretrainedError: in all that was looked at.
        """
        self.entries += len(table)
        if self.entries > _MOST_ENTRIES:
            raise PretrainedError("its networks have no end.")
        return table.items()


def recognise(root: Any) -> Contents:
    """Find the networks in what a file of ``torch.save`` holds.

    Raises:
        PretrainedError: it is no snapshot of a known kind; the reason as the end of a sentence.
    """
    contents = Contents()
    holder = root
    if isinstance(root, dict):
        for name, unit in _COUNTERS.items():
            if type(count := root.get(name)) is int and 0 <= count < 2**63:
                contents.counters[unit] = count
        holder = root.get("agent", root.get("algo_state_dict", root))
    if isinstance(holder, Foreign):
        contents.agent_class = holder.path[:_LONGEST_TEXT]
    attributes = _attributes(holder)
    if attributes is None:
        raise PretrainedError("it holds neither an agent nor state dicts.")
    for name, value in attributes.items():
        # Names end up in messages: nothing that steers a terminal.
        if _is_scalar(name) and str(name).isprintable() and name not in _COUNTERS:
            _collect(contents, str(name), value)
    contents.layout = _layout_of(contents)
    return contents


def _attributes(holder: Any) -> dict[Any, Any] | None:
    """Return the attributes of an object that was not built, or the entries of a dict."""
    if isinstance(holder, Foreign):
        holder = holder.state[0] if isinstance(holder.state, tuple) and holder.state else holder.state
    return holder if isinstance(holder, dict) else None


def _collect(contents: Contents, name: str, value: Any) -> None:
    if isinstance(value, TensorRecord):
        contents.sections[name] = {"": value}
    elif _is_scalar(value):
        contents.settings[name] = value
    elif _is_module(value):
        contents.sections[name] = {}
        _flatten(contents, name, value)
    elif (
        isinstance(value, dict)
        and value
        and all(isinstance(v, TensorRecord) for _, v in contents.look_at(value))
    ):
        contents.sections[name] = {key: v for key, v in value.items() if isinstance(key, str)}
    elif value is not None:
        contents.others.append(name)


def _is_module(value: Any) -> bool:
    attributes = _attributes(value) if isinstance(value, Foreign) else None
    return attributes is not None and {"_parameters", "_buffers", "_modules"} <= attributes.keys()


def _flatten(contents: Contents, section: str, module: Foreign) -> None:
    """Write a module's tensors and strides under their state-dict names; what it holds need not be a tree."""
    table = contents.sections[section]
    pending = [("", module)]
    visited = 0
    while pending:
        prefix, module = pending.pop()
        attributes = _attributes(module) or {}
        visited += 1
        if visited > _MOST_MODULES or len(prefix) > _LONGEST_TEXT:
            raise PretrainedError("its networks have no end.")
        for group in ("_parameters", "_buffers"):
            for name, value in _entries(contents, attributes, group).items():
                if isinstance(value, TensorRecord):
                    table[join(prefix, name)] = value
            if len(table) > _MOST_TENSORS:
                raise PretrainedError("its networks have no end.")
        for name, child in _entries(contents, attributes, "_modules").items():
            if _is_module(child):
                pending.append((join(prefix, name), child))
        if section == "encoder" and isinstance(attributes.get("stride"), tuple):
            contents.strides[join(section, prefix)] = _stride_of(attributes)
        elif not prefix:
            for name, value in contents.look_at(attributes):
                if isinstance(name, str) and _is_scalar(value) and name not in ("training", "dump_patches"):
                    contents.settings[join(section, name)] = value


def _entries(contents: Contents, attributes: dict[Any, Any], group: str) -> dict[str, Any]:
    found = attributes[group]
    if not isinstance(found, dict):
        return {}
    return {
        k: v
        for k, v in contents.look_at(found)
        if isinstance(k, str) and k.isprintable() and len(k) < _LONGEST_TEXT
    }


def _stride_of(attributes: dict[Any, Any]) -> tuple[int, ...]:
    """Return the strides of a convolution as this library has them: without padding, dilation or groups."""
    stride = attributes["stride"]
    if not 1 <= len(stride) <= 3 or any(type(step) is not int for step in stride):
        raise PretrainedError("its convolutions have strides that are no numbers.")
    plain = {"padding": (0,) * len(stride), "dilation": (1,) * len(stride), "groups": 1}
    if any(attributes.get(name, value) != value for name, value in plain.items()):
        raise PretrainedError("its convolutions are padded, dilated or grouped; this library's are not.")
    return stride


def _is_scalar(value: Any) -> bool:
    if isinstance(value, str):
        return len(value) <= _LONGEST_TEXT
    if isinstance(value, float):
        return math.isfinite(value)
    return isinstance(value, bool) or (isinstance(value, int) and abs(value) < 2**63)


def _layout_of(contents: Contents) -> Layout:
    sections = contents.sections
    if contents.settings.get("obs_type") == "states":
        raise PretrainedError("its agent saw states, not pixels: there is no encoder in it.")
    if "encoder" not in sections:
        raise PretrainedError("there is no encoder in it.")
    trunks = {name.rsplit(".", 2)[0] for name in sections["encoder"] if name.endswith("0.weight")}
    if ATC.trunk in trunks and "contrast" in sections:
        return ATC
    if PROTO.trunk in trunks and "proto" in sections:
        return PROTO
    if URLB.trunk in trunks:
        return BECL if "becl" in sections else URLB_PROTO if "protos" in sections else URLB
    raise PretrainedError("its encoder has other names than those of any known repository.")
