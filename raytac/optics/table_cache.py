"""Baked tables on disk, each under a digest of all that shapes it, so that a table is never taken for that of another sensor or code."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

from raytac.errors import CalibrationError, InputError
from raytac.io.code_digest import code_digest
from raytac.optics.bake_settings import BakeSettings
from raytac.optics.calib_folder import load_calibration, save_calibration
from raytac.optics.table import PolyTable
from raytac.specs.sensor import MarkerSpec, SensorSpec

NO_MARKERS = MarkerSpec(0, 0, (0.0, 0.0), (0.0, 0.0), 0.0, 0.0)

__all__ = ["cache_root", "cached", "keep", "table_folder", "table_key"]


def cache_root() -> Path:
    """``RAYTAC_CACHE`` if set, else ``raytac`` in ``XDG_CACHE_HOME`` or in ``~/.cache``."""
    if chosen := os.environ.get("RAYTAC_CACHE"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "raytac"


def table_key(sensor: SensorSpec, settings: BakeSettings, seed: int, resolution: tuple[int, int]) -> str:
    """Digest of sensor and lights (not of where their files lie), settings, and the code that bakes; the device is not in it.

    Nor are the markers: a table is baked on a plain coat, and sensors that differ in their dots alone share it.
    """
    plain = replace(
        sensor, source=None, name="", lights=replace(sensor.lights, source=None), marker_motion=None, markers=NO_MARKERS
    )
    basis = plain, settings, seed, resolution, code_digest("raytac.optics.bake")
    return hashlib.sha256(repr(basis).encode()).hexdigest()[:24]


def table_folder(sensor: SensorSpec, settings: BakeSettings, seed: int, resolution: tuple[int, int]) -> Path:
    """Where the table of ``table_key`` is kept."""
    return cache_root() / "tables" / table_key(sensor, settings, seed, resolution)


def cached(folder: Path) -> PolyTable | None:
    """The table kept in ``folder``; None if there is none, or, with a warning, if it is damaged."""
    if not folder.is_dir():
        return None
    try:
        return load_calibration(folder)
    except CalibrationError as error:
        warnings.warn(f"the baked table in {folder} is damaged and is baked again: {error}", RuntimeWarning, stacklevel=3)
        return None


def keep(table: PolyTable, folder: Path) -> None:
    """Write the table to ``folder`` as a whole: it is written beside it and then renamed, in place of a damaged one.

    A whole table that is there already stays, so that a reader never finds half of it: under one digest all are the same.

    Raises:
        InputError: the folder cannot be written.
    """
    work = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=".partial", dir=folder.parent))
        if folder.exists():
            if _is_whole(folder):
                return
            os.replace(folder, work / "damaged")
        save_calibration(table, work / folder.name)
        try:
            os.replace(work / folder.name, folder)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            # Another process was faster.
    except OSError as error:
        rule = f"must be a folder that can be written ({error.strerror}); RAYTAC_CACHE names another"
        raise InputError("cache", value=folder, rule=rule) from error
    finally:
        if work is not None:
            shutil.rmtree(work, ignore_errors=True)


def _is_whole(folder: Path) -> bool:
    try:
        load_calibration(folder)
    except CalibrationError:
        return False
    return True
