"""Shards on disk: one ``.npz`` of arrays and one ``.json`` of rows each, written whole or not at all, and checked by SHA-256."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from raytac.dataset.renderer import Row, ShardResult
from raytac.io.arrays import npz_bytes
from raytac.io.atomic import PARTIAL, open_regular, read_regular, write_atomic

__all__ = ["FOLDER", "ShardRecord", "ShardStore", "is_shard_file", "sha256_of"]

FOLDER = "shards"
"""Folder of the shards in a data set."""
_FILE = re.compile(rf"{FOLDER}/[0-9]{{6,12}}\.npz")


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
            write_atomic(arrays, data)
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
        write_atomic(self._path(result.shard, "json"), (json.dumps(kept, allow_nan=False) + "\n").encode())
        return record

    def read(self, shard: int) -> ShardRecord | str:
        """The record of a shard whose files are whole; else what is wrong with them, ``missing`` if there are none."""
        path, arrays = self._path(shard, "json"), self._path(shard, "npz")
        try:
            kept = json.loads(read_regular(path))
            record = ShardRecord(shard, kept["file"], kept["sha256"], kept["bytes"], kept["rows"], kept["made_by"])
            if kept["plan_sha256"] != self._plan:
                return f"{path.name} is of another plan"
            if kept["rows_sha256"] != _rows_digest(record.rows):
                return f"{path.name} differs from its checksum"
            _check_record(record, f"{FOLDER}/{arrays.name}")
        except FileNotFoundError:
            return "missing"
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            return f"{path.name} cannot be read ({type(error).__name__})"
        try:
            if record.file and (arrays.stat().st_size != record.bytes or sha256_of(arrays) != record.sha256):
                return f"{arrays.name} differs from its checksum"
        except FileNotFoundError:
            return f"{arrays.name} is missing"
        except OSError as error:
            return f"{arrays.name} cannot be read ({error.strerror})"
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
    """Whether a path is one that a data set gives its shards: in the folder of the shards and nowhere else."""
    return _FILE.fullmatch(name) is not None


def _check_record(record: ShardRecord, file: str) -> None:
    """Raise ``ValueError`` for a record that agrees with its checksum and yet is none."""
    sound: Any = isinstance(record.rows, list) and isinstance(record.made_by, dict) and "device" in record.made_by
    sound = sound and all(isinstance(row, dict) and row.get("status") in ("ok", "failed") for row in record.rows)
    if not sound or record.file not in ("", file):
        raise ValueError("a record needs its own file, rows with a status, and what made it")
