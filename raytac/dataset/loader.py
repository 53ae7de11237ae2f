"""``PressDataset``: presses of a data set by number, as dictionaries of arrays; needs NumPy and pyarrow alone."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from raytac.dataset.arrays import COLUMNS
from raytac.dataset.describe import read_description
from raytac.dataset.manifest import read_manifest
from raytac.errors import InputError

__all__ = ["PressDataset", "open_shard"]

_HEADER = 30
"""Bytes of a zip member's local header before its name and extra field."""


class PressDataset:
    """Sound presses of a data set; what ``torch.utils.data.DataLoader`` takes as a map-style data set, without PyTorch.

    .. code-block:: python

        data = PressDataset("runs/dataset", ("rgb", "wrench", "press_depth"))
        data[0]  # {"rgb": (H, W, 3) uint8, "wrench": (6,), "press_depth": ()}
        loader = torch.utils.data.DataLoader(data, batch_size=64, shuffle=True, num_workers=4)

    Arrays that are not compressed are mapped into memory, so that a press is read without the rest of its shard. What is given is a copy
    that may be changed.

    Attributes:
        folder: of the data set.
        description: its ``dataset.json``.
        manifest: rows of the presses that are given, a ``pyarrow.Table``.
    """

    def __init__(self, folder: str | Path, names: Sequence[str] | None = None, *, sensor: str | None = None) -> None:
        """Read the manifest.

        Args:
            folder: of the data set.
            names: arrays of the shards, or columns of numbers of the manifest; None is all arrays.
            sensor: presses into this sensor only; must be given where the data set has several of different shapes and a stack is wanted.

        Raises:
            InputError: no data set, or a name that it does not have.
            BackendError: pyarrow is not installed.
        """
        self.folder, self.description = Path(folder), read_description(Path(folder))
        table = read_manifest(self.folder)
        keep = np.asarray(table["status"].to_pylist()) == "ok"
        if sensor is not None:
            if sensor not in self.description["sensors"]:
                raise InputError(
                    "sensor", value=sensor, rule="must be in the data set", choices=tuple(self.description["sensors"])
                )
            keep &= np.asarray(table["sensor"].to_pylist()) == sensor
        self.manifest = table.filter(keep)
        arrays = tuple(self.description["arrays"])
        numbers = tuple(name for name, column in COLUMNS.items() if column.type != "string")
        names = arrays if names is None else tuple(names)
        for name in names:
            if name not in arrays and name not in numbers:
                raise InputError("names", value=name, rule="must be an array or a column of numbers", choices=(*arrays, *numbers))
        self._arrays = tuple(name for name in names if name in arrays)
        self._columns = {name: self.manifest[name].to_numpy(zero_copy_only=False) for name in names if name not in arrays}
        self._shards: list[str] = self.manifest["shard"].to_pylist()
        self._rows: np.ndarray = self.manifest["row"].to_numpy()
        self._open: dict[str, dict[str, np.ndarray]] = {}

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, i: int) -> dict[str, np.ndarray]:
        """Press ``i`` of those in ``manifest``."""
        if not -len(self) <= i < len(self):
            raise IndexError(f"press {i} of {len(self)}")
        shard, row = self._shards[i], self._rows[i]
        found = {name: np.array(self._shard(shard)[name][row]) for name in self._arrays}
        return found | {name: np.asarray(values[i]) for name, values in self._columns.items()}

    def shared(self, i: int) -> dict[str, np.ndarray]:
        """What the presses of press ``i``'s shard have in common: grid, height and image at rest."""
        shard = self._shard(self._shards[i])
        return {name: np.array(shard[name]) for name in self.description["arrays_of_a_shard"]}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}  # each process of a loader maps files of its own

    def _shard(self, name: str) -> dict[str, np.ndarray]:
        if name not in self._open:
            arrays, mapped = open_shard(self.folder / name)
            if not mapped:
                self._open.clear()  # it was read as a whole
            self._open[name] = arrays
        return self._open[name]


def open_shard(path: Path) -> tuple[dict[str, np.ndarray], bool]:
    """Arrays of an ``.npz``, mapped into memory if none is compressed, else read; and which of the two."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            with np.load(path) as arrays:
                return dict(arrays), False
        data = np.memmap(path, np.uint8, "r")  # one map a shard: an operating system has tens of thousands
        found = {}
        with path.open("rb") as stream:
            for member in members:
                stream.seek(member.header_offset)
                header = stream.read(_HEADER)
                stream.seek(int.from_bytes(header[26:28], "little") + int.from_bytes(header[28:30], "little"), 1)
                version = np.lib.format.read_magic(stream)
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, dtype = read(stream)
                found[member.filename.removesuffix(".npy")] = np.ndarray(shape, dtype, data, stream.tell())
    return found, True
