"""The two file formats of ``torch.save``: a zip archive, and before torch 1.6 a row of pickles."""

from __future__ import annotations

import io
import math
import mmap
import struct
import zipfile
from typing import IO, Any

import torch
from torch import Tensor

from crptpro.errors import PretrainedError
from crptpro.pretrained.importing.restricted_pickle import RestrictedUnpickler, StorageRecord, TensorRecord

_ZIP_START = b"PK\x03\x04"
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_VERSION = 1001
_DTYPES = {
    "FloatStorage": torch.float32,
    "DoubleStorage": torch.float64,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}


class TorchFile:
    """A file that ``torch.save`` wrote, opened for reading without running anything in it.

    Own code instead of ``torch.load``: that one hands an archive with TorchScript in it to another loader,
    unpacks tar files, warns about and patches source text, and allocates a legacy storage as large as the
    file claims before reading it. Here no block of numbers larger than the file is ever made.

    Args:
        file: the file, open for reading, and until the last tensor is read.

    Attributes:
        root: the object saved, in plain data, :class:`~.restricted_pickle.Foreign` and
            :class:`~.restricted_pickle.TensorRecord`.

    Raises:
        PretrainedError: the reason, as the end of a sentence about the file.
    """

    def __init__(self, file: IO[bytes]) -> None:
        start = file.read(len(_ZIP_START))
        file.seek(0)
        if not start:
            raise PretrainedError("it is empty.")
        self._storages: _ZipStorages | _LegacyStorages
        try:
            self._storages = _ZipStorages(file) if start == _ZIP_START else _LegacyStorages(file)
        except PretrainedError:
            raise
        except Exception as reason:  # whatever bytes that somebody else made up may provoke
            name = type(reason).__name__
            raise PretrainedError(f"it is damaged, or no file that torch.save wrote ({name}).") from None
        self.root: Any = self._storages.root

    def read(self, record: TensorRecord) -> Tensor:
        """Return a tensor of the file as a tensor of its own, on the CPU.

        Raises:
            PretrainedError: it is not all there, or of an unknown type.
        """
        storage = record.storage
        if storage.kind not in _DTYPES:
            raise PretrainedError(f"it holds numbers of an unknown type ({storage.kind[:40]!r}).")
        dtype = _DTYPES[storage.kind]
        numel = math.prod(record.size)
        last = record.offset + sum((n - 1) * step for n, step in zip(record.size, record.stride))
        # More elements than the storage has would be one number repeated: no network stores that.
        if numel and (last >= storage.length or numel > storage.length):
            raise PretrainedError("it describes a tensor that reaches beyond its block of numbers.")
        if not numel:
            raise PretrainedError("it describes a tensor without numbers.")
        try:
            content = self._storages.content(storage, dtype.itemsize)
        except PretrainedError:
            raise
        except Exception as reason:
            raise PretrainedError(f"it is damaged ({type(reason).__name__}).") from None
        flat = torch.frombuffer(content, dtype=dtype)
        return flat.as_strided(record.size, record.stride, storage.start + record.offset).clone()


class _ZipStorages:
    """``<name>/data.pkl`` and one uncompressed ``<name>/data/<key>`` per storage."""

    def __init__(self, file: IO[bytes]) -> None:
        self._zip = zipfile.ZipFile(file)
        names = self._zip.namelist()
        roots = [name.removesuffix("/data.pkl") for name in names if name.endswith("/data.pkl")]
        if len(roots) != 1 or f"{roots[0]}/constants.pkl" in names:
            raise PretrainedError("it is an archive, but not one of torch.save.")
        self._folder = roots[0]
        if f"{self._folder}/byteorder" in names and self._member("byteorder") != b"little":
            raise PretrainedError("it was written on a big-endian machine.")
        self.root = RestrictedUnpickler(io.BytesIO(self._member("data.pkl"))).load()

    def _member(self, name: str) -> bytearray:
        entry = self._zip.getinfo(f"{self._folder}/{name}")
        if entry.compress_type != zipfile.ZIP_STORED or entry.file_size != entry.compress_size:
            raise PretrainedError("it is compressed, which torch.save does not do.")
        return bytearray(self._zip.read(entry))

    def content(self, storage: StorageRecord, itemsize: int) -> bytearray:
        content = self._member(f"data/{storage.key}")
        if len(content) != storage.numel * itemsize:
            raise PretrainedError(
                f"a block of numbers has {len(content)} bytes, not {storage.numel * itemsize}."
            )
        return content


class _LegacyStorages:
    """Pickles of a magic number, a version, the machine, the object and the storage keys; then the storages."""

    def __init__(self, file: IO[bytes]) -> None:
        # A map, unlike a file, never makes a buffer as long as a pickle claims to need.
        self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        if self._load() != _LEGACY_MAGIC:
            raise PretrainedError("it is a pickle, but not one of torch.save.")
        if self._load() != _LEGACY_VERSION:
            raise PretrainedError("it has an unknown version of torch.save's old format.")
        if self._load().get("little_endian") is not True:
            raise PretrainedError("it was written on a big-endian machine.")
        unpickler = RestrictedUnpickler(self._map)
        self.root = unpickler.load()
        self._begins = self._locate(self._load(), unpickler.storages)

    def _load(self) -> Any:
        return RestrictedUnpickler(self._map).load()

    def _locate(self, keys: list[str], storages: dict[str, StorageRecord]) -> dict[str, int]:
        """Return where in the file each storage's numbers begin; its length stands before them."""
        begins = {}
        position = self._map.tell()
        for key in keys:
            storage = storages[key]
            if storage.kind not in _DTYPES:
                raise PretrainedError(f"it holds numbers of an unknown type ({storage.kind[:40]!r}).")
            (numel,) = struct.unpack_from("<q", self._map, position)
            if numel != storage.numel:
                raise PretrainedError(f"a block of {storage.numel} numbers has {numel}.")
            begins[key] = position + 8
            position += 8 + numel * _DTYPES[storage.kind].itemsize
        if position > len(self._map):
            raise PretrainedError("it is truncated.")
        return begins

    def content(self, storage: StorageRecord, itemsize: int) -> bytearray:
        begin = self._begins[storage.key]
        return bytearray(self._map[begin : begin + storage.numel * itemsize])
