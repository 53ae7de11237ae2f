"""Episodes in the layout of LeRobot's data sets, version 3.0, without LeRobot."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from raytac.checks import check_mapping
from raytac.dataset.episode import Episode
from raytac.dataset.manifest import check_pyarrow
from raytac.errors import InputError
from raytac.io.folder import new_path
from raytac.io.images import png_bytes
from raytac.io.progress import Progress

_VERSION = "v3.0"
_PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_FILES_IN_CHUNK = 1000
_FILE_MB, _VIDEO_MB = 100, 200
"""Sizes at which a data file ends, and a video file would: there are none."""
_OWN = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""Features that every data set has."""
_MOST_AXES = 5
"""Axes of a feature that LeRobot's reader knows."""
_RENAMED = {"action": "action", "reward": "next.reward", "success": "next.success"}


def write_lerobot(
    folder: str | Path,
    episodes: Iterable[Episode],
    *,
    names: Mapping[str, str] | None = None,
    robot_type: str | None = None,
    progress: bool = False,
) -> Path:
    """Write episodes as a LeRobot data set (``codebase_version`` v3.0); returns its folder.

    Features are called as policies look for them. 8-bit images (T, H, W, 3) become ``observation.images.NAME``, other arrays
    ``observation.NAME``; ``action`` stays, ``reward`` and ``success`` become ``next.reward`` and ``next.success``, ``terminated`` and
    ``truncated`` together ``next.done``. Facts become features that are the same in every frame of an episode. 64-bit numbers become
    32-bit ones, but whole numbers 64-bit. An episode's ``task`` is its task.

    Images are PNG in the Parquet files (``dtype`` ``image``), not videos: a video encoder takes away what a tactile image is about.

    Args:
        folder: that must not exist.
        episodes: read one at a time; all of one rate, with the same arrays and facts.
        names: other names of features, by name of an array or fact.
        robot_type: text that LeRobot notes.
        progress: show the episodes that are written.

    Raises:
        InputError: a folder that exists, no episode, a rate that is no whole number, two arrays for one feature, or episodes that differ.
        BackendError: pyarrow is not installed.
    """
    check_pyarrow()
    names = {} if names is None else names
    check_mapping("names", names)
    with new_path(folder) as partial:
        writer = None
        for episode in Progress(episodes, desc="export", unit="episode", show=progress):
            if not isinstance(episode, Episode):
                raise InputError("episodes", value=type(episode).__name__, rule="must be an iterable of episodes")
            writer = writer or _Writer(partial, episode, names, robot_type)
            writer.add(episode)
        if writer is None:
            raise InputError("episodes", value=[], rule="must hold at least one episode")
        writer.finish()
    return Path(folder)


@dataclass
class _Moments:
    """Running statistics of one feature, over frames; of images over pixels too, by channel."""

    count: int = 0
    total: Any = 0.0
    squares: Any = 0.0
    low: Any = np.inf
    high: Any = -np.inf
    frames: int = 0

    def add(self, values: np.ndarray, axes: tuple[int, ...]) -> None:
        """Count ``values`` (T, …) in, along ``axes``."""
        self.frames += len(values)
        self.count += int(np.prod([values.shape[axis] for axis in axes]))
        self.total = self.total + values.sum(axis=axes, dtype=np.float64)
        self.squares = self.squares + np.square(values, dtype=np.float64).sum(axis=axes)
        self.low, self.high = np.minimum(self.low, values.min(axis=axes)), np.maximum(self.high, values.max(axis=axes))

    def described(self, is_image: bool) -> dict[str, list[Any]]:
        """``min``, ``max``, ``mean``, ``std`` and ``count`` as LeRobot has them; images in [0, 1]."""
        mean = self.total / self.count
        spread = np.sqrt(np.maximum(self.squares / self.count - mean**2, 0.0))
        made = {"min": self.low, "max": self.high, "mean": mean, "std": spread}
        if is_image:
            made = {name: np.asarray(value)[:, None, None] / 255.0 for name, value in made.items()}
        plain = {name: np.atleast_1d(np.asarray(value, np.float64)).tolist() for name, value in made.items()}
        return plain | {"count": [self.frames]}


@dataclass
class _Writer:
    """Data set that is being written."""

    folder: Path
    first: Episode
    names: Mapping[str, str]
    robot_type: str | None
    tasks: dict[str, int] = field(default_factory=dict)
    rows: list[dict[str, Any]] = field(default_factory=list)
    frames: int = 0

    def __post_init__(self) -> None:
        rate = float(self.first.fps)
        if rate != round(rate):
            raise InputError("fps", value=rate, rule="must be a whole number: LeRobot has no others")
        for name in self.names:
            if name not in {*self.first.arrays, *self.first.facts}:
                choices = (*self.first.arrays, *self.first.facts)
                raise InputError("names", value=name, rule="must be an array or a fact of the episodes", choices=choices)
        columns = self._columns(self.first)
        self.fps = round(rate)
        self.features = {name: _feature(name, values) for name, values in columns.items()}
        self.statistics = {name: _Moments() for name, values in columns.items() if values.dtype.kind != "U"}
        self._stream: Any = None
        self._parquet: Any = None
        self._file = 0

    def add(self, episode: Episode) -> None:
        """Write the frames of an episode, one group of rows, and note where it is."""
        number, length = len(self.rows), len(episode)
        if episode.fps != self.first.fps:
            raise InputError(f"fps of episode {number}", value=episode.fps, rule=f"must be that of the first, {self.first.fps}")
        columns = self._columns(episode)
        features = {name: _feature(name, values) for name, values in columns.items()}
        if features != self.features:
            wrong = sorted(name for name in {**features, **self.features} if features.get(name) != self.features.get(name))
            shown = {name: features[name]["shape"] if name in features else None for name in wrong}
            raise InputError(
                f"episode {number}", value=shown, rule="must have the features of the first, of the same type and shape"
            )
        task = self.tasks.setdefault(episode.task, len(self.tasks))
        own = {
            "timestamp": np.arange(length, dtype=np.float32) / np.float32(self.fps),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, number),
            "index": np.arange(self.frames, self.frames + length),
            "task_index": np.full(length, task),
        }
        self._write_rows({**columns, **own})
        row = {"episode_index": number, "tasks": [episode.task], "length": length}
        row |= {"data/chunk_index": self._chunk, "data/file_index": self._file % _FILES_IN_CHUNK}
        row |= {"dataset_from_index": self.frames, "dataset_to_index": self.frames + length}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        self.frames += length
        for name, values in {**columns, **own}.items():
            if values.dtype.kind == "U":
                continue
            one, axes = _Moments(), (0, 1, 2) if self._is_image(name) else (0,)
            for moments in (one, self.statistics.setdefault(name, _Moments())):
                moments.add(values, axes)
            described = one.described(self._is_image(name))
            row |= {f"stats/{name}/{key}": value for key, value in described.items()}
        self.rows.append(row)

    def finish(self) -> None:
        """Write what describes the data; ``meta/info.json`` comes last."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        self._close()
        meta = self.folder / "meta"
        place = meta / "episodes" / (_PLACE.format(chunk_index=0, file_index=0) + ".parquet")
        place.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(self.rows), place)
        tasks = pa.table({"task_index": list(self.tasks.values()), "task": list(self.tasks)})
        pq.write_table(tasks.replace_schema_metadata({"pandas": json.dumps(_indexed_by_task())}), meta / "tasks.parquet")
        statistics = {name: moments.described(self._is_image(name)) for name, moments in self.statistics.items()}
        _write_json(meta / "stats.json", statistics)
        own = {name: {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None} for name in _OWN}
        info = {
            "codebase_version": _VERSION,
            "robot_type": self.robot_type,
            "total_episodes": len(self.rows),
            "total_frames": self.frames,
            "total_tasks": len(self.tasks),
            "chunks_size": _FILES_IN_CHUNK,
            "data_files_size_in_mb": _FILE_MB,
            "video_files_size_in_mb": _VIDEO_MB,
            "fps": self.fps,
            "splits": {"train": f"0:{len(self.rows)}"},
            "data_path": f"data/{_PLACE}.parquet",
            "video_path": None,
            "features": {**self.features, **own},
        }
        _write_json(meta / "info.json", info)

    @property
    def _chunk(self) -> int:
        return self._file // _FILES_IN_CHUNK

    def _is_image(self, name: str) -> bool:
        return self.features.get(name, {}).get("dtype") == "image"

    def _columns(self, episode: Episode) -> dict[str, np.ndarray]:
        """Values of every frame by feature, of types that LeRobot has."""
        columns: dict[str, np.ndarray] = {}

        def put(name: str, values: np.ndarray) -> None:
            if name in columns or name in _OWN or not name or "/" in name:
                raise InputError(
                    "names", value=name, rule="must be a feature of its own, without '/' and not one that LeRobot adds"
                )
            columns[name] = values

        ends = [episode.arrays[name].astype(bool) for name in ("terminated", "truncated") if name in episode.arrays]
        for name, values in episode.arrays.items():
            if name in ("terminated", "truncated") and name not in self.names:
                continue
            is_image = _are_images(values)
            usual = _RENAMED.get(name, f"observation.{'images.' if is_image else ''}{name}")
            put(self.names.get(name, usual), values if is_image else _plain(values))
        if ends:
            put("next.done", np.any(ends, axis=0))
        for name, value in episode.facts.items():
            constant = np.array([value] * len(episode))
            put(self.names.get(name, name), constant if isinstance(value, str) else _plain(constant))
        return columns

    def _write_rows(self, columns: dict[str, np.ndarray]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        arrays = {name: _encoded(values) if self._is_image(name) else _arrow(values) for name, values in columns.items()}
        table = pa.table(arrays)
        if self._parquet is not None and self._stream.tell() + table.nbytes > _FILE_MB << 20:
            self._close()
            self._file += 1
        if self._parquet is None:
            place = _PLACE.format(chunk_index=self._chunk, file_index=self._file % _FILES_IN_CHUNK)
            path = self.folder / "data" / f"{place}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = pa.OSFile(str(path), "wb")
            self._parquet = pq.ParquetWriter(self._stream, table.schema)
        self._parquet.write_table(table, row_group_size=len(table))

    def _close(self) -> None:
        if self._parquet is not None:
            self._parquet.close()
            self._stream.close()
            self._parquet = None


def _are_images(values: np.ndarray) -> bool:
    return values.dtype == np.uint8 and values.ndim == 4 and values.shape[3] == 3


def _plain(values: np.ndarray) -> np.ndarray:
    """Numbers as bool, int64, uint8 or float32."""
    if values.dtype.kind == "f":
        return values.astype(np.float32)
    return values if values.dtype in (np.bool_, np.uint8) else values.astype(np.int64)


def _feature(name: str, values: np.ndarray) -> dict[str, Any]:
    """Entry of ``features`` in ``meta/info.json``."""
    if values.dtype.kind == "U":
        return {"dtype": "string", "shape": [1], "names": None}
    if _are_images(values):
        return {"dtype": "image", "shape": list(values.shape[1:]), "names": ["height", "width", "channels"]}
    if values.ndim > _MOST_AXES + 1:
        raise InputError(name, value=values.shape, rule=f"must have at most {_MOST_AXES} axes besides time")
    return {"dtype": str(values.dtype), "shape": list(values.shape[1:]) or [1], "names": None}


def _arrow(values: np.ndarray) -> Any:
    """Values (T, …) as an Arrow array; vectors have a fixed length, as LeRobot's own."""
    import pyarrow as pa

    if values.ndim == 1 or values.shape[1:] == (1,):
        return pa.array(values.reshape(len(values)))
    array = pa.array(values.reshape(-1))
    if values.ndim == 2:
        return pa.FixedSizeListArray.from_arrays(array, values.shape[1])
    for size in values.shape[:0:-1]:
        array = pa.ListArray.from_arrays(np.arange(0, len(array) + 1, size, dtype=np.int32), array)
    return array


def _encoded(images: np.ndarray) -> Any:
    """Images as PNG, in the form of the library ``datasets``."""
    import pyarrow as pa

    kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    return pa.array([{"bytes": png_bytes(image), "path": None} for image in images], kind)


def _indexed_by_task() -> dict[str, Any]:
    """Metadata by which pandas reads the column ``task`` as the index."""

    def column(name: str, kind: str, stored: str) -> dict[str, Any]:
        return {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": stored, "metadata": None}

    columns = [column("task_index", "int64", "int64"), column("task", "unicode", "object")]
    levels = [
        {"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object", "metadata": {"encoding": "UTF-8"}}
    ]
    return {"index_columns": ["task"], "column_indexes": levels, "columns": columns, "pandas_version": "2.0.0"}


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False) + "\n", encoding="utf-8")
