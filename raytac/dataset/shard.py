"""Shards on disk: a ``.npz`` of arrays and a ``.json`` of rows each, checked by SHA-256."""

from __future__ import annotations

import hashlib
import json
import math
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np

from raytac.dataset.arrays import ARRAYS, SHARED, ArrayKind
from raytac.dataset.renderer import Row, ShardResult
from raytac.errors import InputError
from raytac.io.arrays import npz_bytes
from raytac.io.atomic import PARTIAL, open_regular, read_regular, write_atomic

FOLDER = "shards"
"""Folder of the shards in a data set."""
_FILE = re.compile(rf"{FOLDER}/[0-9]{{6,12}}\.npz")


@dataclass(frozen=True)
class ShardRecord:
    """Record of a finished shard."""

    shard: int
    file: str
    """Path in the data set; empty if no press of it went well."""
    sha256: str
    bytes: int
    rows: list[Row]
    made_by: dict[str, str | int | float]


class ShardStore:
    """The shards of one plan in a data set's folder. Only one process writes."""

    def __init__(self, folder: Path, plan_sha256: str, *, compress: bool = False) -> None:
        """``plan_sha256``: of the plan that shards must be of; ``compress``: deflate new ones."""
        self.folder, self._plan, self._compress = Path(folder), plan_sha256, compress
        self.shorter: str | None = None
        """Digest of a plan of fewer presses, whose shards are read too."""

    def write(self, result: ShardResult) -> ShardRecord:
        """Keep a shard; its ``.json`` comes last, so that an interrupt leaves none half finished."""
        (self.folder / FOLDER).mkdir(parents=True, exist_ok=True)
        data, file = b"", ""
        arrays = self._path(result.shard, "npz")
        if result.arrays:
            data, file = npz_bytes(result.arrays, compress=self._compress), f"{FOLDER}/{arrays.name}"
            write_atomic(arrays, data)
        else:
            arrays.unlink(missing_ok=True)
        sha256 = hashlib.sha256(data).hexdigest() if data else ""
        record = ShardRecord(result.shard, file, sha256, len(data), result.rows, result.made_by)
        self.stamp(record)
        return record

    def stamp(self, record: ShardRecord) -> None:
        """Write the ``.json`` of a shard, which says that it is of this plan."""
        kept = {"plan_sha256": self._plan, **{name: getattr(record, name) for name in ("file", "sha256", "bytes", "made_by")}}
        kept |= {"rows_sha256": _rows_digest(record.rows), "rows": record.rows}
        write_atomic(self._path(record.shard, "json"), (json.dumps(kept, allow_nan=False) + "\n").encode())

    def read(self, shard: int) -> ShardRecord | str:
        """The record of a whole shard; else a text that says what is wrong, or ``missing``."""
        record, arrays = self._record(shard), self._path(shard, "npz")
        if isinstance(record, str) or not record.file:
            return record
        try:
            if arrays.stat().st_size != record.bytes or sha256_of(arrays) != record.sha256:
                return f"{arrays.name} differs from its checksum"
        except FileNotFoundError:
            return f"{arrays.name} is missing"
        except OSError as error:
            return f"{arrays.name} cannot be read ({error.strerror})"
        return record

    def presses(self) -> int:
        """Number of presses of the shards that are there, by their ``.json`` alone."""
        records = map(self._record, self.present())
        return sum(len(record.rows) for record in records if isinstance(record, ShardRecord))

    def _record(self, shard: int) -> ShardRecord | str:
        path = self._path(shard, "json")
        try:
            kept = json.loads(read_regular(path))
            record = ShardRecord(shard, kept["file"], kept["sha256"], kept["bytes"], kept["rows"], kept["made_by"])
            if kept["plan_sha256"] not in (self._plan, self.shorter):
                return f"{path.name} is of another plan"
            if kept["rows_sha256"] != _rows_digest(record.rows):
                return f"{path.name} differs from its checksum"
            _check_record(record, f"{FOLDER}/{path.stem}.npz")
        except FileNotFoundError:
            return "missing"
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            return f"{path.name} cannot be read ({type(error).__name__})"
        return record

    def present(self) -> list[int]:
        """Numbers of the shards of which there is a ``.json``, whole or not."""
        folder = self.folder / FOLDER
        names = [path.stem for path in folder.glob("*.json")] if folder.is_dir() else []
        return sorted(int(name) for name in names if is_shard_file(f"{FOLDER}/{name}.npz"))

    def clear_partial(self) -> None:
        """Remove what a killed run left half-written."""
        for folder in (self.folder, self.folder / FOLDER):
            for path in folder.glob(f".*{PARTIAL}"):
                if path.is_file():
                    path.unlink()

    def _path(self, shard: int, suffix: str) -> Path:
        return self.folder / FOLDER / f"{shard:06d}.{suffix}"


def sha256_of(path: Path) -> str:
    """Hex digest of a file."""
    with open_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _rows_digest(rows: list[Row]) -> str:
    return hashlib.sha256(json.dumps(rows, sort_keys=True).encode()).hexdigest()


def is_shard_file(name: str) -> bool:
    """True for a path of a shard in a data set: in the folder of the shards alone."""
    return _FILE.fullmatch(name) is not None


def _check_record(record: ShardRecord, file: str) -> None:
    """Raise ``ValueError`` for a record that agrees with its checksum and yet is none."""
    sound: Any = isinstance(record.rows, list) and isinstance(record.made_by, dict) and "device" in record.made_by
    sound = sound and all(isinstance(row, dict) and row.get("status") in ("ok", "failed") for row in record.rows)
    if not sound or record.file not in ("", file):
        raise ValueError("a record needs its own file, rows with a status, and what made it")


KINDS: dict[str, ArrayKind] = {**{name: replace(kind, shape=("N", *kind.shape)) for name, kind in ARRAYS.items()}, **SHARED}
"""Arrays that a shard may hold, with N presses."""
_HEADER = 30
"""Bytes of a zip member's local header before its name and extra field."""


def open_shard(
    path: Path,
    kinds: Mapping[str, ArrayKind] | None = None,
    *,
    sizes: Mapping[str, int] | None = None,
    sha256: str | None = None,
) -> tuple[dict[str, np.ndarray], bool]:
    """Arrays of an ``.npz``, and True if they are mapped into memory.

    They are if none is compressed; else they are read.

    Args:
        kinds: the arrays that it must hold, by name; None: any of ``KINDS``.
        sizes: numbers that names in their shapes stand for; what is not named may be any, the same in all arrays.
        sha256: hex digest that the file must have; None is any.

    Raises:
        InputError: the file cannot be read, differs from its checksum, is no such archive, or holds an array of another name, type,
            shape or length. Objects, which would be pointers into memory, are of no known type.
    """
    try:
        with open_regular(path) as stream:
            data = np.memmap(stream, np.uint8, "r")  # one map a shard: an operating system has tens of thousands
            if sha256 is not None and hashlib.sha256(data.data).hexdigest() != sha256:
                raise InputError("shard", value=path, rule="differs from its checksum: render again to repair it")
            with zipfile.ZipFile(stream) as archive:
                members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
                expected = KINDS if kinds is None else kinds
                wrong = set(members) - set(expected) if kinds is None else set(members) ^ set(expected)
                if wrong or len(members) != len(archive.infolist()):
                    rule = f"must hold the arrays of a data set, each once; it differs in {', '.join(sorted(wrong)) or 'their number'}"
                    raise InputError("shard", value=path, rule=rule)
                stored = all(member.compress_type == zipfile.ZIP_STORED for member in members.values())
                known = dict(sizes or {})
                arrays = {}
                for name, member in members.items():
                    if stored:
                        start = _start(stream, member)
                        shape, dtype, order, length = _header(stream, expected[name], known, member.file_size)
                        # NumPy refuses an array that goes beyond the end of `data`.
                        arrays[name] = np.ndarray(shape, dtype, data, start + length, order=order)
                    else:
                        with archive.open(member) as inflated:
                            shape, dtype, order, length = _header(inflated, expected[name], known, member.file_size)
                            values = np.frombuffer(inflated.read(), dtype)
                        arrays[name] = values.reshape(shape, order=order)
    except InputError:
        raise
    except Exception as error:  # a damaged archive ends in errors of many types
        raise InputError("shard", value=path, rule=f"cannot be used ({error})") from error
    return arrays, stored


def _start(stream: IO[bytes], member: zipfile.ZipInfo) -> int:
    """Offset of a member that is not compressed; the stream stays there."""
    stream.seek(member.header_offset)
    header = stream.read(_HEADER)
    names = int.from_bytes(header[26:28], "little") + int.from_bytes(header[28:30], "little")
    return stream.seek(member.header_offset + _HEADER + names)


def _header(
    stream: IO[bytes], kind: ArrayKind, sizes: dict[str, int], length: int
) -> tuple[tuple[int, ...], np.dtype, Literal["C", "F"], int]:
    """Shape, type and order of a ``.npy`` of ``length`` bytes, and the length of its header.

    Sizes that are named for the first time are noted in ``sizes``. Raises ``ValueError`` where it is not of this kind.
    """
    begin = stream.tell()
    version = np.lib.format.read_magic(stream)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
    shape, fortran, dtype = read(stream)
    expected = tuple(sizes.get(n, n) if isinstance(n, str) else n for n in kind.shape)
    if dtype != np.dtype(kind.dtype) or dtype.hasobject:
        raise ValueError(f"an array of type {dtype} where {kind.dtype} is declared")
    if len(shape) != len(expected) or any(isinstance(n, int) and n != m for n, m in zip(expected, shape, strict=True)):
        raise ValueError(f"an array of shape {shape} where {expected} is declared")
    for name, n in zip(kind.shape, shape, strict=True):
        if isinstance(name, str) and sizes.setdefault(name, n) != n:
            raise ValueError(f"an array of shape {shape} where {kind.shape} is declared, and {name} is {sizes[name]}")
    header = stream.tell() - begin
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != length - header:
        raise ValueError(f"{length - header} bytes for {dtype} of shape {shape}")
    return shape, dtype, "F" if fortran else "C", header
