"""Data sets and episodes as HDF5 or Zarr: one tree of groups, arrays and attributes."""

# pyright: reportMissingImports=false
# (h5py and zarr belong to the extra "export".)

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from raytac.checks import check_known
from raytac.dataset.episode import Episode, press_episodes
from raytac.dataset.loader import PressDataset
from raytac.errors import BackendError, InputError
from raytac.io.folder import new_path
from raytac.io.progress import Progress
from raytac.specs import SweepSpec

_FORMAT = "raytac export"
_CHUNK_BYTES, _BLOCK_BYTES = 1 << 20, 1 << 26
"""Sizes of a chunk of an array, and of what is read before it is written."""
_MAPS = {"height", "contact", "traction"}
"""Arrays on the pad's grid."""
Source = PressDataset | Iterable[Episode]
EXPORTS: Mapping[str, tuple[str, str]] = {
    "lerobot": ("lerobot", "pyarrow"),
    "hdf5": ("presses.h5", "h5py"),
    "zarr": ("presses.zarr", "zarr"),
}
"""Formats of ``export_presses``: name beside the shards, and package that writes it."""


def check_export(kind: str, folder: Path, sweep: SweepSpec) -> None:
    """Raise what ``export_presses`` would after a sweep is rendered into ``folder``.

    ``InputError``: an unknown format, a name that is taken, presses without a time axis for LeRobot. ``BackendError``: the writer's
    package is not installed.
    """
    check_known("export", kind, tuple(EXPORTS))
    name, package = EXPORTS[kind]
    if importlib.util.find_spec(package) is None:
        raise BackendError(f"export {kind!r} needs {package}, which is not installed: pip install 'raytac[export]'")
    if kind == "lerobot" and sweep.frames_per_stage is None:
        rule = "is of videos, and the sweep has one frame a press: give it frames_per_stage, or export hdf5 or zarr"
        raise InputError("export", value=kind, rule=rule)
    for path in _export_paths(folder, name, [sensor.name for sensor in sweep.sensors]).values():
        if path.exists():
            raise InputError("export", value=path, rule="must not exist: nothing is replaced; move it away")


def export_presses(folder: str | Path, kind: str, *, fps: float = 30.0, progress: bool = False) -> list[Path]:
    """Write a rendered data set in another format beside its shards, once a sensor.

    Args:
        folder: of the data set.
        kind: ``lerobot`` (episodes, of videos alone), ``hdf5`` or ``zarr`` (arrays with the press first).
        fps: of ``lerobot``: frames a second at which a press is shown.

    Returns:
        The paths: ``lerobot``, ``presses.h5`` or ``presses.zarr``; of several sensors with ``_SENSOR`` in their names.

    Raises ``InputError`` and ``BackendError`` as ``write_lerobot``, ``write_hdf5`` and ``write_zarr``.
    """
    check_known("export", kind, tuple(EXPORTS))
    from raytac.dataset.lerobot import write_lerobot

    paths = _export_paths(Path(folder), EXPORTS[kind][0], tuple(PressDataset(folder, verify=False).description["sensors"]))
    for sensor, path in paths.items():
        data = PressDataset(folder, sensor=sensor)
        if kind == "lerobot":
            write_lerobot(path, press_episodes(data, fps=fps), progress=progress)
        else:
            (write_hdf5 if kind == "hdf5" else write_zarr)(path, data, progress=progress)
    return list(paths.values())


def _export_paths(folder: Path, name: str, sensors: Sequence[str]) -> dict[str, Path]:
    stem, dot, suffix = name.partition(".")
    return {sensor: folder / (name if len(sensors) == 1 else f"{stem}_{sensor}{dot}{suffix}") for sensor in sensors}


def write_hdf5(path: str | Path, data: Source, *, compress: bool = True, progress: bool = False) -> Path:
    """Write presses or episodes as one HDF5 file; returns its path.

    A data set of presses becomes arrays with the press first: what its samples hold, each with the attributes ``unit`` and ``meaning``, and
    ``grid_x`` and ``grid_y`` with maps. ``classes`` is an attribute of the file, ``description`` the text of ``dataset.json``. Episodes
    become groups ``episodes/000000``, … of arrays with time first, with their facts, ``fps`` and ``task`` as attributes.

    Args:
        path: file that must not exist.
        data: a ``PressDataset`` of one sensor, whose transform, if it has one, gives arrays by name; or episodes, read one at a time.
        compress: deflate the arrays.
        progress: show the presses or episodes that are written.

    Raises:
        InputError: a file that exists, no samples, or samples that differ in names, types or shapes.
        BackendError: h5py is not installed.
    """
    try:
        import h5py
    except ImportError as error:
        raise BackendError(f"HDF5 needs h5py ({error}): `pip install 'raytac[export]'`") from error

    def make(group: Any, name: str, shape: tuple[int, ...], dtype: Any, rows: int) -> Any:
        kind = h5py.string_dtype() if dtype is str else dtype
        options: dict[str, Any] = {"chunks": (min(rows, shape[0]), *shape[1:])} if shape else {}
        if compress and shape:
            options |= {"compression": "gzip", "compression_opts": 4, "shuffle": True}
        return group.create_dataset(name, shape, kind, **options)

    with new_path(path) as partial, h5py.File(partial, "w") as file:
        _write(file, data, make, progress)
    return Path(path)


def write_zarr(path: str | Path, data: Source, *, compress: bool = True, progress: bool = False) -> Path:
    """Write presses or episodes as one Zarr store, format 3; returns its path.

    Groups, arrays, attributes, arguments and errors are those of ``write_hdf5``; ``BackendError``: zarr is not installed, or of version 2.
    """
    try:
        import zarr
    except ImportError as error:
        raise BackendError(f"Zarr needs zarr-python ({error}): `pip install 'raytac[export]'`") from error
    if not hasattr(zarr, "create_group"):
        raise BackendError(f"Zarr needs zarr-python 3, not {zarr.__version__}: `pip install 'raytac[export]'`")

    def make(group: Any, name: str, shape: tuple[int, ...], dtype: Any, rows: int) -> Any:
        chunks = (min(rows, shape[0]), *shape[1:]) if shape else ()
        return group.create_array(name, shape=shape, dtype=dtype, chunks=chunks, **({} if compress else {"compressors": None}))

    with new_path(path) as partial:
        _write(zarr.create_group(partial, zarr_format=3), data, make, progress)
    return Path(path)


Make = Callable[[Any, str, tuple[int, ...], Any, int], Any]
"""Function that makes an array of a name, shape, type (or ``str``) and rows in a chunk."""


def _write(root: Any, data: Source, make: Make, progress: bool) -> None:
    root.attrs["format"] = _FORMAT
    if isinstance(data, PressDataset):
        _write_presses(root, data, make, progress)
    else:
        _write_episodes(root.create_group("episodes"), data, make, progress)


def _write_presses(root: Any, data: PressDataset, make: Make, progress: bool) -> None:
    if not len(data):
        raise InputError("data set", value=data.folder, rule="must hold a sound press")
    first = data[0]
    if not isinstance(first, dict):
        raise InputError("data", value=type(first).__name__, rule="must give samples by name: open it without its transform")
    about = {**data.description["columns"], **data.description["arrays"], **data.description["arrays_of_a_shard"]}
    about["label"] = {"unit": "", "meaning": "number of the object among the classes"}
    root.attrs["classes"] = list(data.classes)
    make(root, "description", (), str, 1)[()] = json.dumps(data.description)
    block = _power(_BLOCK_BYTES // max(sum(np.asarray(value).nbytes for value in first.values()), 1))
    made: dict[str, Any] = {}
    for name, value in first.items():
        kind, shape = (str, ()) if isinstance(value, str) else (value.dtype, value.shape)
        rows = block if isinstance(value, str) else min(block, _power(_CHUNK_BYTES // max(value.nbytes, 1)))
        made[name] = make(root, name, (len(data), *shape), kind, rows)
        made[name].attrs.update({key: about.get(name, {}).get(key, "") for key in ("unit", "meaning")})
    with Progress(desc="export", total=len(data), unit="press", show=progress) as bar:
        for start in range(0, len(data), block):
            samples = [data[i] for i in range(start, min(start + block, len(data)))]
            for name, array in made.items():
                values = [sample[name] for sample in samples]
                if array.ndim > 1:
                    _check_shapes(name, start, values, array.shape[1:])
                stacked = np.array(values, object) if isinstance(first[name], str) else np.stack(values)
                array[start : start + len(values)] = stacked
            bar.update(len(samples))
    if _MAPS & set(made):
        for name in {"grid_x", "grid_y"} - set(made):
            values = data.shared(0)[name]
            array = make(root, name, values.shape, values.dtype, len(values))
            array[:] = values
            array.attrs.update({key: about[name][key] for key in ("unit", "meaning")})


def _check_shapes(name: str, start: int, values: list[np.ndarray], shape: tuple[int, ...]) -> None:
    for i, value in enumerate(values):
        if value.shape != shape:
            rule = f"must have the shape of the first press's, {shape}: choose presses of one with sensor="
            raise InputError(f"{name} of press {start + i}", value=value.shape, rule=rule)


def _power(count: int) -> int:
    """Greatest power of two that is at most ``count``, in [1, 64]."""
    return 1 << min(max(count, 1).bit_length() - 1, 6)


def _write_episodes(root: Any, episodes: Iterable[Episode], make: Make, progress: bool) -> None:
    count = 0
    for episode in Progress(episodes, desc="export", unit="episode", show=progress):
        if not isinstance(episode, Episode):
            rule = "must be a PressDataset or an iterable of episodes"
            raise InputError("data", value=type(episode).__name__, rule=rule)
        group = root.create_group(f"{count:06d}")
        group.attrs.update({**episode.facts, "fps": episode.fps, "task": episode.task})
        for name, values in {**episode.arrays, "time": episode.time}.items():
            rows = min(len(values), max(_CHUNK_BYTES // max(values[0].nbytes, 1), 1))
            make(group, name, values.shape, values.dtype, rows)[:] = values
        count += 1
    if not count:
        raise InputError("data", value=[], rule="must hold at least one episode")
