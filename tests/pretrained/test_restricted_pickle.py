"""Hostile files: none of them may do anything, whatever it names and however it is wrapped."""

from __future__ import annotations

import builtins
import contextlib
import io
import pickle
import random
import resource
import struct
import sys
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import pytest
import torch
from hostile_pickles import Calls, Named, Pickler, attacks, dumps, legacy_file, zip_file
from original_agents import PROTO, atc_state, module_file, save

from crptpro.errors import PretrainedError
from crptpro.pretrained import import_snapshot, load_pretrained
from crptpro.pretrained.importing.convert import to_pretrained
from crptpro.pretrained.importing.layouts import recognise
from crptpro.pretrained.importing.restricted_pickle import (
    Foreign,
    RestrictedUnpickler,
    StorageRecord,
    TensorRecord,
)
from crptpro.pretrained.importing.torch_file import TorchFile

MARK = "this_file_must_not_appear"


def refused(file: Path, tmp_path: Path) -> PretrainedError:
    with pytest.raises(PretrainedError) as caught:
        import_snapshot(file, tmp_path / "encoder")
    assert "cannot be imported" in str(caught.value)
    assert not (tmp_path / "encoder").exists()
    return caught.value


@pytest.mark.parametrize("attack", sorted(attacks(Path("/x"))))
def test_a_hostile_pickle_does_nothing_but_produce_an_error(
    attack: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark = tmp_path / MARK
    pickled = dumps(attacks(mark)[attack])

    def imports_nothing(self: Any, module: str, name: str) -> Any:
        raise AssertionError(f"{module}.{name} was looked up")

    monkeypatch.setattr(pickle._Unpickler, "find_class", imports_nothing)
    loaded = set(sys.modules)
    refused(zip_file(tmp_path / "zip.pt", pickled), tmp_path)
    refused(legacy_file(tmp_path / "legacy.pt", pickled), tmp_path)
    (tmp_path / "plain.pkl").write_bytes(pickled)
    refused(tmp_path / "plain.pkl", tmp_path)
    assert not mark.exists()
    assert "antigravity" not in sys.modules
    assert not {name for name in set(sys.modules) - loaded if not name.startswith(("torch._", "encodings."))}


def test_the_same_attack_works_on_an_unpickler_that_believes(tmp_path: Path) -> None:
    """Otherwise the test above would prove nothing."""
    mark = tmp_path / MARK
    for name in (
        "os.system", "eval", "open", "getattr chain", "attrgetter chain", "methodcaller", "map", "nested state",
        "inside an agent", "as a tensor", "as a key", "in a set",
    ):  # fmt: skip
        pickled = dumps(attacks(mark)[name])
        try:
            pickle.loads(pickled)
        except Exception as reason:  # some fail after they have done their work
            del reason
        assert mark.exists(), name
        mark.unlink()


@pytest.mark.parametrize(
    "pickled",
    [
        b"cos\nsystem\n(S'touch MARK'\ntR.",
        b"(S'touch MARK'\nios\nsystem\n.",
        b"(cos\nsystem\nS'touch MARK'\no.",
        b"\x80\x02cos\nsystem\nX\x0a\x00\x00\x00touch MARK\x85\x81.",
        b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x0atouch MARK\x85}\x92.",
        b"\x80\x02\x82\x01.",  # a class of the extension registry
        b"\x80\x02Pid\n.",
        b"\x80\x05\x97.",  # an out-of-band buffer
        b"\x80\x02]X\x01\x00\x00\x00a}X\x01\x00\x00\x00bX\x01\x00\x00\x00csbb.",  # a state for a text
    ],
    ids=["REDUCE", "INST", "OBJ", "NEWOBJ", "NEWOBJ_EX", "EXT1", "PERSID", "NEXT_BUFFER", "BUILD"],
)
def test_every_instruction_that_could_call_something_is_inert(
    pickled: bytes, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    refused(zip_file(tmp_path / "zip.pt", pickled.replace(b"MARK", b"mark")), tmp_path)
    assert not (tmp_path / "mark").exists()


def test_names_and_foreign_objects_are_only_told_of() -> None:
    pickled = dumps({"lr": 1e-4, "opt": Calls(Named("torch.optim", "Adam"), more=({"state": {"a": 1}},))})
    root = RestrictedUnpickler(io.BytesIO(pickled)).load()
    assert root["lr"] == 1e-4
    assert isinstance(root["opt"], Foreign)
    assert (root["opt"].path, root["opt"].state) == ("torch.optim.Adam", {"state": {"a": 1}})


def tensor(storage: Any, offset: int, size: tuple[int, ...], stride: tuple[int, ...]) -> Calls:
    return Calls(
        Named("torch._utils", "_rebuild_tensor_v2"), storage, offset, size, stride, False, OrderedDict()
    )


class WithStorages(Pickler):
    """Writes tuples that begin with ``"storage"`` as persistent identifiers, as torch does."""

    def persistent_id(self, value: Any) -> Any:
        return value if isinstance(value, tuple) and value and value[0] == "storage" else None


def atc_with(weight: Calls) -> bytes:
    """An ATC snapshot whose first kernel is the given tensor."""
    buffer = io.BytesIO()
    names = {"conv.conv.0.weight": weight, "head.model.0.weight": weight}
    WithStorages(buffer, 2).dump({"algo_state_dict": {"encoder": names, "contrast": {"W.weight": weight}}})
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("numel", "size", "stride", "offset"),
    [
        (2**40, (2**40,), (1,), 0),  # a storage of terabytes
        (4, (2**20, 2**20), (0, 0), 0),  # one number repeated
        (4, (5,), (1,), 0),
        (4, (4,), (2,), 0),
        (4, (4,), (1,), 1),
        (4, (4,), (-1,), 3),
        (2**62, (4,), (1,), 0),
        (-1, (4,), (1,), 0),
    ],
)
def test_tensors_larger_than_their_file_are_never_made(
    numel: int, size: tuple[int, ...], stride: tuple[int, ...], offset: int, tmp_path: Path
) -> None:
    storage = ("storage", Named("torch", "FloatStorage"), "0", "cpu", numel)
    pickled = atc_with(tensor(storage, offset, size, stride))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(zip_file(tmp_path / "zip.pt", pickled, {"0": bytes(16)}), tmp_path)
    legacy_storage = ("storage", Named("torch", "FloatStorage"), "0", "cpu", numel, None)
    pickled = atc_with(tensor(legacy_storage, offset, size, stride))
    tail = struct.pack("<q", numel) + bytes(16)
    refused(legacy_file(tmp_path / "legacy.pt", pickled, ("0",), tail), tmp_path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kilobytes


@pytest.mark.parametrize(
    "pickled",
    [
        b"\x80\x04\x8d" + struct.pack("<Q", 2**40) + b"x.",  # a text of a terabyte
        b"\x80\x05\x96" + struct.pack("<Q", 2**40) + b"x.",  # a byte array
        b"\x80\x04\x95" + struct.pack("<Q", 2**40) + b"x.",  # a frame
        b"\x80\x02Nr" + struct.pack("<I", 2**32 - 1) + b".",  # a memo of four billion entries
        b"\x80\x02" + b"(" * 100_000 + b"t" * 100_000 + b".",  # tuples in tuples
        b"\x80\x02}" + b"(" * 100_000 + b"t" * 100_000 + b"Ns.",  # the same for a key
        b"\x80\x02]q\x00h\x00a.",  # a list in itself
        b"\x80\x02(lp0\n" + b"(g0\ng0\nlp0\n" * 60 + b".",  # lists of two of the same, sixty deep
        b"\x80\x02I" + b"9" * 100_000 + b"\n.",
        b"\x80\x02.",
        b"\x80\x02b.",
        b"\x80\x02u.",
        b"\x80\xff.",
        b"",
    ],
)
def test_pickles_that_want_the_earth_are_refused(pickled: bytes, tmp_path: Path) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(zip_file(tmp_path / "zip.pt", pickled), tmp_path)
    refused(legacy_file(tmp_path / "legacy.pt", pickled), tmp_path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kilobytes


def test_modules_that_contain_themselves_are_refused(tmp_path: Path) -> None:
    state: dict[str, Any] = {"_parameters": {}, "_buffers": {}, "_modules": {}}
    module = Calls(Named("torch.nn", "Module"), more=(state,))
    inner: dict[str, Any] = {"_parameters": {}, "_buffers": {}, "_modules": {"a": module, "b": module}}
    for _ in range(30):  # 2**30 paths lead to the bottom
        module = Calls(Named("torch.nn", "Module"), more=(inner,))
        inner = {"_parameters": {}, "_buffers": {}, "_modules": {"a": module, "b": module}}
    assert "no end" in str(
        refused(zip_file(tmp_path / "zip.pt", dumps({"agent": {"encoder": module}})), tmp_path)
    )


def test_few_bytes_that_refer_to_something_long_again_and_again_are_refused(tmp_path: Path) -> None:
    pairs = b"\x80\x02ccollections\nOrderedDict\nq\x00](" + b"K\x01K\x01\x86" * 100_000 + b"e\x85q\x01"
    text = b"X" + (1_000_000).to_bytes(4, "little") + b"a" * 1_000_000
    for pickled, message in (
        (pairs + b"h\x00h\x01R0" * 500 + b".", "its dicts or tensors have no end"),
        (b"\x80\x04" + text + b"q\x00(" + b"h\x00h\x00\x93" * 500 + b"l.", "an endless name"),
    ):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        assert message in str(refused(zip_file(tmp_path / "zip.pt", pickled), tmp_path))
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kilobytes


@pytest.mark.parametrize("place", ["_parameters", "_buffers", "_modules", "attributes"])
def test_modules_that_share_one_big_dict_are_refused(place: str, tmp_path: Path) -> None:
    """Nothing in such a file is large or deep: a few megabytes would keep the reader busy for hours."""
    many: dict[str, Any] = {str(index): None for index in range(110_000)}
    state: dict[str, Any] = {"_parameters": {}, "_buffers": {}, "_modules": {}}
    state = {**many, **state} if place == "attributes" else {**state, place: many}
    modules = {f"n{index}": Calls(Named("torch.nn", "Linear"), more=(state,)) for index in range(1_000)}
    root = {"_parameters": {}, "_buffers": {}, "_modules": modules}
    nested = {"encoder": Calls(Named("torch.nn", "Sequential"), more=(root,))}
    file = zip_file(tmp_path / "zip.pt", dumps({"agent": modules if place == "attributes" else nested}))
    assert file.stat().st_size < 3_000_000
    assert "no end" in str(refused(file, tmp_path))


def test_state_dicts_that_are_one_big_dict_are_refused() -> None:
    record = TensorRecord(StorageRecord("FloatStorage", "0", 1, 0, 1), 0, (1,), (1,))
    shared = {str(index): record for index in range(110_000)}
    with pytest.raises(PretrainedError, match="no end"):
        recognise({f"n{index}": shared for index in range(1_000)})


def test_archives_that_torch_does_not_write_are_refused(tmp_path: Path) -> None:
    pickled = dumps({"algo_state_dict": {}})
    with zipfile.ZipFile(tmp_path / "bomb.pt", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02" + b"N" * 10_000_000 + b".")
    assert "compressed" in str(refused(tmp_path / "bomb.pt", tmp_path))
    with zipfile.ZipFile(tmp_path / "script.pt", "w") as archive:
        for name in ("data.pkl", "constants.pkl", "code/__torch__.py"):
            archive.writestr(f"archive/{name}", pickled)
    assert "not one of torch.save" in str(refused(tmp_path / "script.pt", tmp_path))
    with zipfile.ZipFile(tmp_path / "zip.pt", "w") as archive:
        archive.writestr("holiday.jpg", b"")
    assert "not one of torch.save" in str(refused(tmp_path / "zip.pt", tmp_path))
    with zipfile.ZipFile(tmp_path / "big.pt", "w") as archive:
        archive.writestr("archive/data.pkl", pickled)
        archive.writestr("archive/byteorder", b"big")
    assert "big-endian" in str(refused(tmp_path / "big.pt", tmp_path))


@pytest.mark.parametrize("is_legacy", [False, True], ids=["zip", "legacy"])
def test_a_harmless_snapshot_with_a_hostile_companion_gives_its_networks_and_nothing_else(
    is_legacy: bool, tmp_path: Path
) -> None:
    """What is not looked at is not run either: the optimiser of the original is a foreign object like any other."""
    mark = tmp_path / MARK
    state = atc_state()
    state["algo_state_dict"]["optimizer"] = Calls(builtins.eval, f"open({str(mark)!r}, 'w').close()")
    file = save(state, tmp_path / "params.pkl", is_legacy=is_legacy)
    loaded = load_pretrained(import_snapshot(file, tmp_path / "encoder"))
    assert not mark.exists()
    assert loaded.card["imported"]["left"] == ["optimizer"]
    with pytest.raises(Exception):  # noqa: B017 whatever happens to the dictionary after the call
        torch.load(file, weights_only=False)["algo_state_dict"]["optimizer"].keys()
    assert mark.exists()  # the same file, believed


@pytest.mark.parametrize("is_legacy", [False, True], ids=["zip", "legacy"])
def test_a_file_with_any_byte_changed_is_read_or_refused(is_legacy: bool, tmp_path: Path) -> None:
    with module_file(tmp_path / "repository", "proto", PROTO) as proto:
        file = save(proto.ProtoAgent(), tmp_path / "agent.pt", is_legacy=is_legacy)
    with zipfile.ZipFile(file) if not is_legacy else contextlib.nullcontext() as archive:
        members = {name: archive.read(name) for name in archive.namelist()} if archive else {}
    name = next((name for name in members if name.endswith("data.pkl")), None)
    whole = members[name] if name else file.read_bytes()
    begin = 0 if name else 100  # beyond the magic number, where all that happens is that there is none
    chance = random.Random(0)
    outcomes = set()
    for _ in range(100):
        content = bytearray(whole)
        for _ in range(chance.choice((1, 1, 3))):
            content[chance.randrange(begin, min(len(content), 12_000))] = chance.choice(
                b"(.0Kbcdehijloqrstu]a}NR\x81\x85"
            )
        if name:
            with zipfile.ZipFile(file, "w") as archive:
                for member, stored in {**members, name: bytes(content)}.items():
                    archive.writestr(member, stored)
        else:
            file.write_bytes(content)
        try:
            with open(file, "rb") as opened:
                snapshot = TorchFile(opened)
                to_pretrained(recognise(snapshot.root), snapshot)
            outcomes.add("read")
        except PretrainedError as reason:
            outcomes.add(str(reason))
    assert len(outcomes) > 1  # both happened
