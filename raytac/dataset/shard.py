"""Shards on disk: one ``.npz`` of arrays and one ``.json`` of rows each, written whole or not at all, and checked by SHA-256."""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from raytac.dataset.renderer import Row, ShardResult

__all__ = ["FOLDER", "ShardRecord", "ShardStore", "npz_bytes", "sha256_of"]

FOLDER = "shards"
"""Folder of the shards in a data set."""
_EPOCH = (1980, 1, 1, 0, 0, 0)
"""Date of every member of an archive, so that equal arrays are equal files."""


@dataclass(frozen=True)
class ShardRecord:
    """What is known of a shard that is done."""

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
        """``plan_sha256``: of the plan that its shards must be of; ``compress``: new ones are deflated."""
        self.folder, self._plan, self._compress = Path(folder), plan_sha256, compress

    def write(self, result: ShardResult) -> ShardRecord:
        """Keep a shard; its ``.json`` comes last, so that an interrupt leaves no shard that looks finished."""
        (self.folder / FOLDER).mkdir(parents=True, exist_ok=True)
        data, file = b"", ""
        arrays = self._path(result.shard, "npz")
        if result.arrays:
            data, file = npz_bytes(result.arrays, compress=self._compress), f"{FOLDER}/{arrays.name}"
            _replace(arrays, data)
        else:
            arrays.unlink(missing_ok=True)
        record = ShardRecord(
            result.shard, file, hashlib.sha256(data).hexdigest() if data else "", len(data), result.rows, result.made_by
        )
        kept = {
            "plan_sha256": self._plan,
            "file": file,
            "sha256": record.sha256,
            "bytes": record.bytes,
            "made_by": record.made_by,
            "rows_sha256": _rows_digest(record.rows),
            "rows": record.rows,
        }
        _replace(self._path(result.shard, "json"), (json.dumps(kept, allow_nan=False) + "\n").encode())
        return record

    def read(self, shard: int) -> ShardRecord | str:
        """The record of a shard whose files are whole; else what is wrong with them, ``missing`` if there are none."""
        path = self._path(shard, "json")
        if not path.is_file():
            return "missing"
        try:
            kept = json.loads(path.read_text(encoding="utf-8"))
            record = ShardRecord(shard, kept["file"], kept["sha256"], kept["bytes"], kept["rows"], kept["made_by"])
            if kept["plan_sha256"] != self._plan:
                return f"{path.name} is of another plan"
            if kept["rows_sha256"] != _rows_digest(record.rows):
                return f"{path.name} differs from its checksum"
        except (OSError, ValueError, KeyError, TypeError) as error:
            return f"{path.name} cannot be read ({type(error).__name__})"
        if record.file:
            arrays = self._path(shard, "npz")
            if not arrays.is_file():
                return f"{arrays.name} is missing"
            if arrays.stat().st_size != record.bytes or sha256_of(arrays) != record.sha256:
                return f"{arrays.name} differs from its checksum"
        return record

    def clear_partial(self) -> None:
        """Remove what a killed run left half-written."""
        for path in (self.folder / FOLDER).glob(".*.partial"):
            path.unlink(missing_ok=True)

    def _path(self, shard: int, suffix: str) -> Path:
        return self.folder / FOLDER / f"{shard:06d}.{suffix}"


def npz_bytes(arrays: Mapping[str, np.ndarray], *, compress: bool = False) -> bytes:
    """An ``.npz`` for ``numpy.load``; equal arrays give equal bytes, which ``numpy.savez`` does not promise: it writes the time of day."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, values in arrays.items():
            member = zipfile.ZipInfo(f"{name}.npy", _EPOCH)
            member.compress_type = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
            with archive.open(member, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.ascontiguousarray(values), allow_pickle=False)
    return out.getvalue()


def sha256_of(path: Path) -> str:
    """Hex digest of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _replace(path: Path, data: bytes) -> None:
    """Write a file so that it is never seen half-written, also after the power failed."""
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(partial, path)


def _rows_digest(rows: list[Row]) -> str:
    return hashlib.sha256(json.dumps(rows, sort_keys=True).encode()).hexdigest()
