"""Reading a pickle without believing it: nothing it names is imported, nothing it asks for is called."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

from crptpro.errors import PretrainedError

_ORDERED_DICTS = ("collections.OrderedDict", "collections.defaultdict")
_TENSOR_BUILDERS = ("torch._utils._rebuild_tensor_v2", "torch._utils._rebuild_tensor")
_PARAMETER_BUILDERS = ("torch._utils._rebuild_parameter", "torch._utils._rebuild_parameter_with_state")
_STORAGE_MODULES = ("torch", "torch.cuda")
_LONGEST_NAME = 1_000
_MOST_COPIED = 1_000_000

# The machine in Python: the one in C offers no way to replace its instructions.
_Machine: Any = pickle._Unpickler


@dataclass(frozen=True, eq=False)
class Name:
    """A class or function that the pickle names. It is never looked up."""

    path: str


@dataclass(eq=False)
class Foreign:
    """What the pickle says about an object that is not built: its class and its state."""

    path: str
    state: Any = None


@dataclass(frozen=True, eq=False)
class StorageRecord:
    """A block of numbers in the file.

    Attributes:
        kind: name of its torch storage class, such as ``"FloatStorage"``.
        key: name of the block in the file.
        numel: elements of the whole block.
        start: first element of a view of the block; ``length`` its elements.
        length: elements that a tensor on it may reach.
    """

    kind: str
    key: str
    numel: int
    start: int
    length: int


@dataclass(frozen=True, eq=False)
class TensorRecord:
    """A strided view of a storage; the numbers stay in the file until they are asked for."""

    storage: StorageRecord
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]


@dataclass(eq=False)
class _Discard:
    """Takes the place of a set, whose members would have to be hashed."""

    items: list[Any] = field(default_factory=list)


class RestrictedUnpickler(_Machine):
    """Executes the instructions of a pickle on plain data only.

    Numbers, strings, tuples, lists and dicts with scalar keys are built. Tensors become
    :class:`TensorRecord`. Everything else becomes a :class:`Name` or a :class:`Foreign`, whatever it is
    called: ``REDUCE``, ``NEWOBJ``, ``BUILD`` and their kin call nothing, no module is imported, and no
    attribute of anything is looked up. Allowed instructions are listed; any other is refused.

    Args:
        file: has ``read(n)`` and ``readline()`` that never return more than the file holds.
    """

    def __init__(self, file: Any) -> None:
        super().__init__(file)
        self.storages: dict[str, StorageRecord] = {}
        """Every block of numbers referred to, by its key."""
        self._copied = 0

    def find_class(self, module: str, name: str) -> Name:
        """Return the name itself."""
        if len(module) + len(name) > _LONGEST_NAME:  # joined anew each time that a few bytes refer to both
            raise PretrainedError("it names something of an endless name.")
        return Name(f"{module}.{name}")

    def persistent_load(self, pid: Any) -> Any:
        """Return the storage that torch's persistent identifier means, or the class of a wrapped module."""
        if isinstance(pid, tuple) and len(pid) >= 2 and pid[0] == "module":
            return pid[1]  # the legacy format keeps the source text beside the class
        if not (isinstance(pid, tuple) and len(pid) in (5, 6) and pid[0] == "storage"):
            raise PretrainedError("it refers to something outside of itself.")
        kind, key, _, numel = pid[1:5]
        module, _, kind = kind.path.rpartition(".") if isinstance(kind, Name) else ("", "", "")
        if module not in _STORAGE_MODULES or not isinstance(key, str) or not _is_count(numel):
            raise PretrainedError("it describes a block of numbers in an unknown way.")
        whole = self.storages.setdefault(key, StorageRecord(kind, key, numel, 0, numel))
        if (whole.kind, whole.numel) != (kind, numel):
            raise PretrainedError("it describes one block of numbers in two ways.")
        view = pid[5] if len(pid) == 6 else None
        if view is None:
            return whole
        start, length = view[1:]
        if not _is_count(start) or not _is_count(length) or start + length > numel:
            raise PretrainedError("it describes a view that reaches beyond its block of numbers.")
        return StorageRecord(kind, key, numel, start, length)

    def _reduce(self) -> None:
        arguments = self.stack.pop()
        self._count_copies(self.stack[-1], arguments)
        self.stack[-1] = _build(self.stack[-1], arguments)

    def _count_copies(self, named: Any, arguments: Any) -> None:
        """Bound what dicts and tensors copy: a few bytes may refer to the same long list any number of times."""
        if not isinstance(named, Name) or named.path not in (*_ORDERED_DICTS, *_TENSOR_BUILDERS):
            return
        parts = arguments[:4] if isinstance(arguments, tuple) else ()
        self._copied += sum(len(part) for part in parts if isinstance(part, (list, tuple)))
        if self._copied > _MOST_COPIED:
            raise PretrainedError("its dicts or tensors have no end.")

    def _new_object(self) -> None:
        del self.stack[-1]  # arguments of __new__
        self.stack[-1] = _build(self.stack[-1], ())

    def _new_object_with_keywords(self) -> None:
        del self.stack[-2:]
        self.stack[-1] = _build(self.stack[-1], ())

    def _instance(self) -> None:
        self.load_global()
        named = self.stack.pop()
        self.pop_mark()
        self.append(_build(named, ()))

    def _object(self) -> None:
        named = self.pop_mark()[0]
        self.append(_build(named, ()))

    def _set_state(self) -> None:
        state = self.stack.pop()
        target = self.stack[-1]
        if isinstance(target, Foreign):
            target.state = state
        elif not isinstance(target, (dict, TensorRecord)):  # attributes of a dict or a tensor are not kept
            raise PretrainedError("it gives a state to something that has none.")

    def _append(self) -> None:
        item = self.stack.pop()
        _extend(self.stack[-1], [item])

    def _extend(self) -> None:
        items = self.pop_mark()
        _extend(self.stack[-1], items)

    def _set_item(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        _update(self.stack[-1], [key, value])

    def _set_items(self) -> None:
        items = self.pop_mark()
        _update(self.stack[-1], items)

    def _dict(self) -> None:
        items = self.pop_mark()
        self.append(_update({}, items))

    def _empty_set(self) -> None:
        self.append(_Discard())

    def _frozen_set(self) -> None:
        self.append(_Discard(self.pop_mark()))

    _inert: ClassVar[tuple[str, ...]] = (
        "PROTO", "FRAME", "STOP", "MARK", "POP", "POP_MARK", "DUP", "NONE", "NEWTRUE", "NEWFALSE",
        "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT",
        "STRING", "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8",
        "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8",
        "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_LIST", "LIST", "EMPTY_DICT",
        "GET", "BINGET", "LONG_BINGET", "PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE",
        "GLOBAL", "STACK_GLOBAL", "PERSID", "BINPERSID",
    )  # fmt: skip
    """Instructions taken over as they are: they make plain data, or call the two methods above."""

    dispatch: ClassVar[dict[int, Callable[..., None]]] = {
        **{code[0]: _Machine.dispatch[code[0]] for code in (getattr(pickle, n) for n in _inert)},
        pickle.REDUCE[0]: _reduce,
        pickle.NEWOBJ[0]: _new_object,
        pickle.NEWOBJ_EX[0]: _new_object_with_keywords,
        pickle.INST[0]: _instance,
        pickle.OBJ[0]: _object,
        pickle.BUILD[0]: _set_state,
        pickle.APPEND[0]: _append,
        pickle.APPENDS[0]: _extend,
        pickle.ADDITEMS[0]: _extend,
        pickle.SETITEM[0]: _set_item,
        pickle.SETITEMS[0]: _set_items,
        pickle.DICT[0]: _dict,
        pickle.EMPTY_SET[0]: _empty_set,
        pickle.FROZENSET[0]: _frozen_set,
    }


def _build(named: Any, arguments: Any) -> Any:
    """Return what stands for the result of calling ``named``; only tensors and dicts get a form of their own."""
    path = named.path if isinstance(named, (Name, Foreign)) else ""
    if not isinstance(arguments, tuple):
        raise PretrainedError("it calls something in an unknown way.")
    if path in _ORDERED_DICTS:
        # Filled by instructions, or (old protocols) from a list of pairs.
        pairs = arguments[0] if arguments and isinstance(arguments[0], list) else []
        if not all(isinstance(pair, (tuple, list)) and len(pair) == 2 for pair in pairs):
            raise PretrainedError("it fills a dict with something else than pairs.")
        return _update({}, [part for pair in pairs for part in pair])
    if path in _TENSOR_BUILDERS:
        return _tensor(*arguments[:4])
    if path in _PARAMETER_BUILDERS and arguments and isinstance(arguments[0], TensorRecord):
        return arguments[0]
    return Foreign(path)


def _tensor(storage: Any, offset: Any, size: Any, stride: Any) -> TensorRecord:
    counts = (offset, *size, *stride)
    if not isinstance(storage, StorageRecord) or not all(map(_is_count, counts)) or len(size) != len(stride):
        raise PretrainedError("it describes a tensor in an unknown way.")
    return TensorRecord(storage, offset, tuple(size), tuple(stride))


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**48


def _extend(target: Any, items: list[Any]) -> None:
    if isinstance(target, list):
        target.extend(items)
    elif not isinstance(target, (Foreign, _Discard)):
        raise PretrainedError("it appends to something that is no list.")


def _update(target: Any, items: list[Any]) -> Any:
    """Set entries. Keys that are no scalars are left out: they name no network, and hashing them is a call."""
    if isinstance(target, dict):
        for key, value in zip(items[::2], items[1::2]):
            if isinstance(key, (str, int, float, bool)):
                target[key] = value
    elif not isinstance(target, Foreign):
        raise PretrainedError("it sets entries of something that is no dict.")
    return target
