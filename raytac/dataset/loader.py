"""``PressDataset``: presses of a data set by number; needs NumPy and pyarrow alone."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, SupportsIndex

import numpy as np

from raytac.dataset.arrays import COLUMNS, ArrayKind
from raytac.dataset.describe import read_description
from raytac.dataset.manifest import read_manifest
from raytac.dataset.shard import FOLDER, is_shard_file, open_shard
from raytac.errors import InputError

_TEXTS = ("object", "sensor")
"""Columns of text that a sample may hold."""
_LABEL = "label"
"""Name of the number of a press's object among the classes."""


class PressDataset:
    """Sound presses of a data set, as a map-style data set of PyTorch has them.

    ``torch.utils.data.DataLoader`` takes it; PyTorch is not needed.

    .. code-block:: python

        data = PressDataset("runs/dataset", ("rgb", "wrench", "press_depth", "label"))
        data[0]  # {"rgb": (H, W, 3) uint8, "wrench": (6,), "press_depth": (), "label": ()}
        data.classes[data[0]["label"]]  # "sphere"
        loader = torch.utils.data.DataLoader(data, batch_size=64, shuffle=True, num_workers=4)

    ``PressTensors`` gives the same as tensors, channels first.

    Arrays that are not compressed are mapped into memory, so that a press is read without the rest of its shard. What is given is a copy
    that may be changed. Manifest and shards are compared with their checksums when they are opened, which reads a shard once as a whole;
    ``verify=False`` leaves that out. Whatever the files hold, only arrays of the types and shapes that ``dataset.json`` declares are given.

    Attributes:
        description: its ``dataset.json``.
        manifest: rows of the presses that are given, a ``pyarrow.Table``.
        classes: names of the objects of its plan, whose numbers the labels are; the same for every part of the data set.
    """

    def __init__(
        self,
        folder: str | Path,
        names: Sequence[str] | None = None,
        *,
        sensor: str | None = None,
        verify: bool = True,
        transform: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        """Read the manifest.

        Args:
            names: arrays of the shards, one of a press or one of a shard, such as ``rest_rgb``; columns of numbers of the manifest; its
                texts ``object`` and ``sensor``; and ``label``, the number of the object in ``classes``. None is all arrays of a press, its
                object and its label.
            sensor: presses into this sensor only; must be given where the data set has several of different shapes and a stack is wanted.
            verify: compare manifest and shards with their checksums.
            transform: function of a sample, whose result is given in its place. Processes of a loader need one that can be pickled.

        Raises:
            InputError: no data set, one that is damaged or (with ``verify``) not complete, or a name that it does not have.
            BackendError: pyarrow is not installed.
        """
        self.folder, self.description = Path(folder), read_description(Path(folder))
        if verify and not self.description["complete"]:
            rule = "is not complete: the command that renders it goes on with the rest"
            raise InputError("data set", value=self.folder, rule=rule)
        table = read_manifest(self.folder, self.description["manifest_sha256"] if verify else None)
        keep = np.asarray(table["status"].to_pylist()) == "ok"
        self._files = _shard_files(self.folder, table.filter(keep), self.description["sensors"])
        self._verify = verify
        if sensor is not None:
            known = tuple(self.description["sensors"])
            if sensor not in known:
                raise InputError("sensor", value=sensor, rule="must be in the data set", choices=known)
            keep &= np.asarray(table["sensor"].to_pylist()) == sensor
        self.manifest = table.filter(keep)
        self.classes: tuple[str, ...] = tuple(self.description["plan"]["objects"])
        arrays, once = tuple(self.description["arrays"]), tuple(self.description["arrays_of_a_shard"])
        numbers = tuple(name for name, column in COLUMNS.items() if column.type != "string")
        known = tuple(dict.fromkeys((*arrays, *once, *numbers, *_TEXTS, _LABEL)))
        names = (*arrays, "object", _LABEL) if names is None else tuple(names)
        for name in names:
            if name not in known:
                rule = "must be an array, a column of numbers, or a name or label of what was pressed"
                raise InputError("names", value=name, rule=rule, choices=known)
        if transform is not None and not callable(transform):
            raise InputError("transform", value=transform, rule="must be a function of a sample")
        self._names, self._transform = names, transform
        self._columns = {name: self._column(name) for name in names if name not in (*arrays, *once)}
        self._shards: list[str] = self.manifest["shard"].to_pylist()
        self._rows: np.ndarray = self.manifest["row"].to_numpy()
        self._open: dict[str, dict[str, np.ndarray]] = {}

    @property
    def frames(self) -> int | None:
        """Frames T of every press of a data set of videos; None where presses have one frame."""
        if "T" not in self.description["arrays"]["pad_from_object"]["shape"]:
            return None
        return int(next(iter(self.description["sensors"].values()))["arrays"]["pad_from_object"][1])

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, i: SupportsIndex) -> dict[str, Any]:
        """Press ``i`` of those in ``manifest``, counted from the end if it is negative.

        Arrays of NumPy, but for ``object`` and ``sensor``, which are texts; or what ``transform`` makes of it.

        Raises:
            IndexError: there is no such press.
            InputError: ``i`` is no whole number, or the shard is damaged.
        """
        i = self._place(i)
        row, once = self._rows[i], self.description["arrays_of_a_shard"]
        sample: dict[str, Any] = {}
        for name in self._names:
            if name in self._columns:
                value = self._columns[name][i]
                sample[name] = value if name in _TEXTS else np.asarray(value)
            else:
                values = self._shard(self._shards[i])[name]
                sample[name] = np.array(values if name in once else values[row])
        return sample if self._transform is None else self._transform(sample)

    def __repr__(self) -> str:
        return f"PressDataset({str(self.folder)!r}, {len(self)} presses; {', '.join(self._names)})"

    def _repr_html_(self) -> str:
        """Card for notebooks, with the first presses; of a video its last image."""
        from raytac.io.html import card, coloured, picture

        arrays = self.description["arrays"]
        rows = {
            "folder": self.folder,
            "presses": f"{len(self)}, without those that failed",
            "sensors": ", ".join(self.description["sensors"]),
            "arrays": ", ".join(f"{name} {item['dtype']}" for name, item in arrays.items()),
        }
        pictures = ""
        for i in range(min(len(self), 6)):
            shard, row = self._shard(self._shards[i]), self._rows[i]
            caption = f"{self.manifest['index'][i].as_py()}: {self.manifest['object'][i].as_py()}"
            if "rgb" in arrays:
                image = np.asarray(shard["rgb"][row])
                pictures += picture(image[-1] if image.ndim == 4 else image, caption)
            elif "height" in arrays:
                height = np.asarray(shard["height"][row], float)
                dent = shard["rest_height"] - (height[-1] if height.ndim == 3 else height)
                pictures += picture(coloured(dent, 0.0, float(np.nanmax(dent))), f"{caption}, indentation")
        return card("PressDataset", rows, pictures)

    def shared(self, i: SupportsIndex) -> dict[str, np.ndarray]:
        """Arrays of press ``i``'s shard: grid, height and image at rest. Errors as for ``data[i]``."""
        shard = self._shard(self._shards[self._place(i)])
        return {name: np.array(shard[name]) for name in self.description["arrays_of_a_shard"]}

    def _column(self, name: str) -> Any:
        """Values by press: of a column of the manifest, or the labels."""
        if name in _TEXTS:
            return self.manifest[name].to_pylist()
        if name != _LABEL:
            return self.manifest[name].to_numpy(zero_copy_only=False)
        numbers = {name: number for number, name in enumerate(self.classes)}
        objects = self.manifest["object"].to_pylist()
        for name in objects:
            if name not in numbers:
                raise InputError(
                    "data set", value=name, rule=f"is not an object of the plan of {self.folder}", choices=self.classes
                )
        return np.array([numbers[name] for name in objects], np.int64)

    def _place(self, i: SupportsIndex) -> int:
        try:
            place = operator.index(i)
        except TypeError as error:
            raise InputError("press", value=i, rule="must be a whole number") from error
        if not -len(self) <= place < len(self):
            raise IndexError(f"press {i} of {len(self)}")
        return place

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}  # each process of a loader maps files of its own

    def _shard(self, name: str) -> dict[str, np.ndarray]:
        if name not in self._open:
            file, path = self._files[name], self.folder / name
            if not path.resolve().is_relative_to(self.folder.resolve()):
                raise InputError("shard", value=path, rule="must not be a link to a file outside the data set")
            kinds, sizes = _declared(self.description, file)
            arrays, mapped = open_shard(path, kinds, sizes=sizes, sha256=file.sha256 if self._verify else None)
            if not mapped:
                self._open.clear()  # it was read as a whole
            self._open[name] = arrays
        return self._open[name]


@dataclass(frozen=True)
class _ShardFile:
    """A shard as the manifest lists it."""

    sensor: str
    sha256: str
    count: int
    """Presses in it."""


def _shard_files(folder: Path, table: Any, sensors: Mapping[str, Any]) -> dict[str, _ShardFile]:
    """Every shard that rows of sound presses name, by its path in the folder.

    Raises:
        InputError: a path that is no shard's, an unknown sensor, shards of two sensors or checksums, or rows that are not those of a shard.
    """
    rows: dict[tuple[str, str, str], list[int]] = {}
    for *key, row in zip(*(table[name].to_pylist() for name in ("shard", "sensor", "shard_sha256", "row")), strict=True):
        rows.setdefault((key[0], key[1], key[2]), []).append(row)
    result: dict[str, _ShardFile] = {}
    for (shard, sensor, sha256), places in rows.items():
        if not is_shard_file(shard):
            raise InputError("data set", value=shard, rule=f"names a shard that is not in {folder / FOLDER}")
        if sensor not in sensors:
            raise InputError("data set", value=sensor, rule=f"is not a sensor of {folder}", choices=tuple(sensors))
        if shard in result or sorted(places) != list(range(len(places))):
            rule = "must be of one sensor and one checksum, and its presses in rows 0, 1, … of it"
            raise InputError("data set", value=shard, rule=rule)
        result[shard] = _ShardFile(sensor, sha256, len(places))
    return result


def _declared(description: dict[str, Any], file: _ShardFile) -> tuple[dict[str, ArrayKind], dict[str, int]]:
    """Kinds of a shard's arrays as in ``dataset.json``, with its sensor's shapes; known sizes."""
    own: dict[str, Any] = description["sensors"][file.sensor]["arrays"]
    declared = {**description["arrays"], **description["arrays_of_a_shard"]}
    kinds = {name: ArrayKind(item["dtype"], tuple(own.get(name, item["shape"])), "", "") for name, item in declared.items()}
    sizes = {"N": file.count}
    for name, item in description["arrays"].items():
        sizes |= {key: n for key, n in zip(item["shape"], own[name], strict=False) if isinstance(key, str) and isinstance(n, int)}
    return kinds, sizes
