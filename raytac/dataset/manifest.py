"""``manifest.parquet``: a row a press, failed or not: parameters, forces, place of arrays."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from raytac.dataset.arrays import COLUMNS
from raytac.dataset.shard import ShardRecord
from raytac.errors import BackendError, InputError
from raytac.io.atomic import read_regular, write_atomic

FILE = "manifest.parquet"
REQUIRED = ("index", "status", "shard", "row", "sensor", "shard_sha256")
"""Columns that say where a press is, and never are empty."""


def check_pyarrow() -> None:
    """Raise ``BackendError`` where Parquet cannot be written."""
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise BackendError(f"a manifest needs pyarrow ({error}): `pip install 'raytac[dataset]'`") from error


def write_manifest(folder: Path, records: Iterable[ShardRecord]) -> Path:
    """Write the rows of shards in the order given; fields' metadata hold units and meanings.

    Raises:
        InputError: a row has a value of the wrong kind.
        OSError: the folder cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns: dict[str, list[Any]] = {name: [] for name in COLUMNS}
    for record in records:
        place = 0
        for row in record.rows:
            whole = row["status"] == "ok"
            where = {"shard": record.file, "row": place, "shard_sha256": record.sha256} if whole else {"shard": "", "row": -1}
            place += whole
            full = {"shard_sha256": ""} | row | where
            for name, values in columns.items():
                values.append(full.get(name))
    fields = [
        pa.field(name, getattr(pa, column.type)(), metadata={"unit": column.unit, "meaning": column.meaning})
        for name, column in COLUMNS.items()
    ]
    stream = io.BytesIO()
    try:
        pq.write_table(pa.table(columns, schema=pa.schema(fields)), stream)
    except (pa.ArrowException, OverflowError) as error:
        raise InputError("data set", value=folder, rule=f"has rows of shards that are no rows of presses ({error})") from error
    write_atomic(folder / FILE, stream.getvalue())
    return folder / FILE


def read_manifest(folder: Path, sha256: str | None = None) -> Any:
    """The manifest as a ``pyarrow.Table``; ``.to_pandas()`` where pandas is installed.

    Args:
        sha256: hex digest that the file must have; None is any.

    Raises:
        InputError: there is none, it differs from its checksum, it cannot be read, or a column is missing or of another type.
        BackendError: pyarrow is not installed.
    """
    check_pyarrow()
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = Path(folder) / FILE
    try:
        data = read_regular(path)
    except FileNotFoundError as error:
        rule = f"must hold {FILE}: it is written when all shards are done"
        raise InputError("data set", value=folder, rule=rule) from error
    except OSError as error:
        raise InputError("data set", value=path, rule=f"cannot be read ({error.strerror})") from error
    if sha256 is not None and hashlib.sha256(data).hexdigest() != sha256:
        raise InputError("data set", value=path, rule="differs from its checksum: render again to repair it")
    try:
        table = pq.read_table(pa.BufferReader(data))
    except (OSError, ValueError, pa.ArrowException) as error:
        raise InputError("data set", value=path, rule=f"must be Parquet ({error})") from error
    for name, column in COLUMNS.items():
        if table.schema.names.count(name) != 1 or table.schema.field(name).type != getattr(pa, column.type)():
            raise InputError("data set", value=path, rule=f"must hold one column {name!r} of type {column.type}")
        if name in REQUIRED and table[name].null_count:
            raise InputError("data set", value=path, rule=f"must hold no empty {name!r}")
    return table
