"""Arrays of a shard, read without trust: nothing but the names, types and shapes that are expected, and nothing beyond the file's end."""

from __future__ import annotations

import hashlib
import math
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import IO, Literal

import numpy as np

from raytac.dataset.arrays import ARRAYS, SHARED, ArrayKind
from raytac.errors import InputError
from raytac.io.atomic import open_regular

__all__ = ["KINDS", "open_shard"]

KINDS: dict[str, ArrayKind] = {**{name: replace(kind, shape=("N", *kind.shape)) for name, kind in ARRAYS.items()}, **SHARED}
"""What a shard may hold, with N presses."""
_HEADER = 30
"""Bytes of a zip member's local header before its name and extra field."""


def open_shard(
    path: Path,
    kinds: Mapping[str, ArrayKind] | None = None,
    *,
    sizes: Mapping[str, int] | None = None,
    sha256: str | None = None,
) -> tuple[dict[str, np.ndarray], bool]:
    """Arrays of an ``.npz``, mapped into memory if none is compressed, else read; and which of the two.

    Args:
        path: of the file.
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
                raise InputError("shard", value=path, rule="differs from its checksum: render again to mend it")
            with zipfile.ZipFile(stream) as archive:
                members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
                expected = KINDS if kinds is None else kinds
                wrong = set(members) - set(expected) if kinds is None else set(members) ^ set(expected)
                if wrong or len(members) != len(archive.infolist()):
                    rule = f"must hold the arrays of a data set, each once; it differs in {', '.join(sorted(wrong)) or 'their number'}"
                    raise InputError("shard", value=path, rule=rule)
                stored = all(member.compress_type == zipfile.ZIP_STORED for member in members.values())
                known = dict(sizes or {})
                found = {}
                for name, member in members.items():
                    if stored:
                        start = _start(stream, member)
                        shape, dtype, order, length = _header(stream, expected[name], known, member.file_size)
                        # NumPy refuses an array that goes beyond the end of `data`.
                        found[name] = np.ndarray(shape, dtype, data, start + length, order=order)
                    else:
                        with archive.open(member) as inflated:
                            shape, dtype, order, length = _header(inflated, expected[name], known, member.file_size)
                            values = np.frombuffer(inflated.read(), dtype)
                        found[name] = values.reshape(shape, order=order)
    except InputError:
        raise
    except Exception as error:  # a damaged archive ends in errors of many types
        raise InputError("shard", value=path, rule=f"cannot be used ({error})") from error
    return found, stored


def _start(stream: IO[bytes], member: zipfile.ZipInfo) -> int:
    """Where a member that is not compressed begins in the file; the stream is left there."""
    stream.seek(member.header_offset)
    header = stream.read(_HEADER)
    names = int.from_bytes(header[26:28], "little") + int.from_bytes(header[28:30], "little")
    return stream.seek(member.header_offset + _HEADER + names)


def _header(
    stream: IO[bytes], kind: ArrayKind, sizes: dict[str, int], length: int
) -> tuple[tuple[int, ...], np.dtype, Literal["C", "F"], int]:
    """Shape, type and order of the ``.npy`` of ``length`` bytes at the stream's place, and the length of its header.

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
