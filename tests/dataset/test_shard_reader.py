"""A shard is read without trust: only arrays of the expected names, types and shapes, and never beyond the file."""

from __future__ import annotations

import hashlib
import io
import os
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from raytac.dataset.arrays import ArrayKind
from raytac.dataset.shard import open_shard
from raytac.errors import InputError
from raytac.io.arrays import npz_bytes

KINDS = {
    "a": ArrayKind("float32", ("N", 3, 4), "", ""),
    "b": ArrayKind("bool", ("N",), "", ""),
    "c": ArrayKind("float64", ("M", 5), "", ""),
    "d": ArrayKind("float64", (), "", ""),
}
ARRAYS = {
    "a": np.arange(24, dtype=np.float32).reshape(2, 3, 4),
    "b": np.array([True, False]),
    "c": np.zeros((0, 5)),
    "d": np.float64(3.0).reshape(()),
}


def npy(header: str, data: bytes = b"") -> bytes:
    """An ``.npy`` file with any header."""
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header) + 1) + header.encode() + b"\n" + data


def archive(path: Path, members: dict[str, bytes], compress: bool = False) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED) as made:
        for name, data in members.items():
            made.writestr(f"{name}.npy", data)
    return path


@pytest.mark.parametrize("compress", [False, True])
def test_arrays_are_those_that_numpy_reads(tmp_path: Path, compress: bool) -> None:
    path, data = tmp_path / "x.npz", npz_bytes(ARRAYS, compress=compress)
    path.write_bytes(data)
    found, mapped = open_shard(path, KINDS, sizes={"N": 2}, sha256=hashlib.sha256(data).hexdigest())
    assert mapped is not compress and npz_bytes(ARRAYS, compress=compress) == data
    with np.load(path, allow_pickle=False) as read:
        for name, values in ARRAYS.items():
            np.testing.assert_array_equal(found[name], values)
            np.testing.assert_array_equal(read[name], values)
            assert found[name].dtype == values.dtype and found[name].shape == values.shape


@pytest.mark.parametrize("compress", [False, True])
def test_columns_first_are_read_in_their_order(tmp_path: Path, compress: bool) -> None:
    members = {}
    for name, values in ARRAYS.items():
        stream = io.BytesIO()
        np.save(stream, np.asfortranarray(values) if values.ndim > 1 else values)
        members[name] = stream.getvalue()
    assert b"'fortran_order': True" in members["a"]
    found, _ = open_shard(archive(tmp_path / "x.npz", members, compress), KINDS)
    np.testing.assert_array_equal(found["a"], ARRAYS["a"])


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize(
    "descr",
    [
        "'|O'",
        "'O'",
        "[('x', '|O')]",
        "'<f8'",
        "'>f4'",
        "'<i4'",
        "'<U1'",
        "'<M8[s]'",
        "'|V4'",
        "[('x', '<f4')]",
        "('<f4', (1,))",
        "5",
    ],
)
def test_no_type_but_the_declared_one(tmp_path: Path, descr: str, compress: bool) -> None:
    """``|O`` would make pointers of the file's bytes."""
    pointer = struct.pack("<Q", id(ARRAYS)) * 12
    header = "{'descr': %s, 'fortran_order': False, 'shape': (1, 3, 4), }"
    path = archive(tmp_path / "x.npz", {"a": npy(header % descr, pointer)}, compress)
    with pytest.raises(InputError, match=r"x\.npz: cannot be used"):
        open_shard(path, {"a": KINDS["a"]})
    with pytest.raises(InputError, match=r"x\.npz"):
        open_shard(archive(tmp_path / "x.npz", {"rgb": npy(header % descr, pointer)}, compress))


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize(
    "shape",
    [
        "(1, 3, 5)",
        "(3, 4)",
        "(1, 3, 4, 1)",
        "(2, 3, 4)",
        "(10**9, 3, 4)",
        "(1000000000, 3, 4)",
        "(-1, 3, 4)",
        "(True, 3, 4)",
        "(1.0, 3, 4)",
        "5",
        "()",
    ],
)
def test_no_shape_but_the_declared_one_and_as_many_bytes(tmp_path: Path, shape: str, compress: bool) -> None:
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}"
    path = archive(tmp_path / "x.npz", {"a": npy(header, bytes(48))}, compress)
    with pytest.raises(InputError, match="cannot be used"):
        open_shard(path, {"a": KINDS["a"]})


def test_sizes_agree_with_each_other_and_with_what_is_known(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    path.write_bytes(npz_bytes(ARRAYS))
    with pytest.raises(InputError, match=r"shape \(2, 3, 4\) where \(3, 3, 4\)"):
        open_shard(path, KINDS, sizes={"N": 3})
    path.write_bytes(npz_bytes({**ARRAYS, "b": np.ones(3, bool)}))
    with pytest.raises(InputError, match=r"\(3,\) where \(2,\)"):
        open_shard(path, KINDS)


def test_no_array_more_less_or_twice(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    for arrays in ({**ARRAYS, "e": np.zeros(1)}, {name: ARRAYS[name] for name in "abc"}):
        path.write_bytes(npz_bytes(arrays))
        with pytest.raises(InputError, match="must hold the arrays of a data set"):
            open_shard(path, KINDS)
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(path, "a") as made:
        made.writestr("a.npy", b"")
    with pytest.raises(InputError, match="must hold the arrays of a data set"):
        open_shard(path, {name: KINDS[name] for name in "abc"})


def test_every_byte_counts_with_a_checksum_and_none_is_a_crash_without(tmp_path: Path) -> None:
    path, whole = tmp_path / "x.npz", npz_bytes(ARRAYS)
    digest = hashlib.sha256(whole).hexdigest()
    rng = np.random.default_rng(0)
    for k in range(300):
        harmed = bytearray(whole)
        for place in rng.integers(0, len(whole), k % 3 + 1):
            harmed[place] ^= 1 << rng.integers(8)
        path.write_bytes(harmed if k % 4 else harmed[: int(rng.integers(0, len(whole)))])
        with pytest.raises(InputError):
            open_shard(path, KINDS, sha256=digest)
        try:
            found, _ = open_shard(path, KINDS, sizes={"N": 2})
        except InputError:
            continue
        for name, values in found.items():
            assert values.dtype == KINDS[name].dtype and values.shape == ARRAYS[name].shape
            values.copy()


def test_a_member_that_goes_beyond_the_file_is_refused(tmp_path: Path) -> None:
    path, data = tmp_path / "x.npz", bytearray(npz_bytes({"b": np.ones(1000, bool)}))
    central = data.rindex(b"PK\x01\x02")
    place = central + 42  # offset of the local header, which is moved to near the end
    start = len(data) - 200
    data[start : start + 30 + 5] = data[:35]
    data[start + 28 : start + 30] = b"\0\0"
    data[place : place + 4] = struct.pack("<I", start)
    path.write_bytes(data)
    with pytest.raises(InputError):
        open_shard(path, {"b": ArrayKind("bool", (1000,), "", "")})


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name in ("pipe", "none", "."):
        with pytest.raises(InputError, match="cannot be used"):
            open_shard(tmp_path / name)
