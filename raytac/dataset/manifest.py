"""``manifest.parquet``: one row a press, failed or not, with its parameters, its forces and where its arrays are."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from raytac.dataset.arrays import COLUMNS
from raytac.dataset.shard import ShardRecord
from raytac.errors import BackendError, InputError

__all__ = ["FILE", "check_pyarrow", "read_manifest", "write_manifest"]

FILE = "manifest.parquet"


def check_pyarrow() -> None:
    """Raises ``BackendError`` where Parquet cannot be written."""
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise BackendError(f"a manifest needs pyarrow ({error}): `pip install 'raytac[dataset]'`") from error


def write_manifest(folder: Path, records: Iterable[ShardRecord]) -> Path:
    """Write the rows of shards, in the order given; units and meanings are in the fields' metadata."""
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
    partial = folder / f".{FILE}.partial"
    pq.write_table(pa.table(columns, schema=pa.schema(fields)), partial)
    os.replace(partial, folder / FILE)
    return folder / FILE


def read_manifest(folder: Path) -> Any:
    """The manifest as a ``pyarrow.Table``; ``.to_pandas()`` where pandas is installed.

    Raises:
        InputError: there is none, or it cannot be read.
        BackendError: pyarrow is not installed.
    """
    check_pyarrow()
    import pyarrow.parquet as pq

    path = Path(folder) / FILE
    if not path.is_file():
        raise InputError("data set", value=folder, rule=f"must hold {FILE}: it is written when all shards are done")
    try:
        return pq.read_table(path)
    except OSError as error:
        raise InputError("data set", value=path, rule=f"must be Parquet ({error})") from error
