"""Baked tables on disk, each under a digest of all that shapes it, code included."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

from raytac.errors import InputError
from raytac.io.atomic import PARTIAL, read_regular, sync_folder, write_atomic
from raytac.io.cache import cache_folder, warn_not_kept
from raytac.io.code_digest import code_digest
from raytac.optics.taxim.bake.settings import BakeSettings
from raytac.optics.taxim.folder import load_calibration, save_calibration
from raytac.optics.taxim.table import PolyTable
from raytac.specs.sensor import MarkerSpec, NoiseSpec, SensorSpec

NO_MARKERS = MarkerSpec(0, 0, (0.0, 0.0), (0.0, 0.0), 0.0, 0.0)

CHECKSUMS = "SHA256SUMS"
"""File of a kept table that lists the digests of the others, as ``sha256sum -c`` reads it."""


def table_key(sensor: SensorSpec, settings: BakeSettings, seed: int, resolution: tuple[int, int]) -> str:
    """Digest of sensor and lights (not of where their files lie), settings and baking code.

    Device, markers and grain are not in it: sensors that differ in these alone share a table, which is baked on a plain coat.
    """
    lights = replace(sensor.lights, source=None)
    plain = replace(sensor, source=None, name="", lights=lights, marker_motion=None, markers=NO_MARKERS, noise=NoiseSpec())
    basis = plain, settings, seed, resolution, code_digest("raytac.optics.taxim.bake.bake")
    return hashlib.sha256(repr(basis).encode()).hexdigest()[:24]


def table_folder(sensor: SensorSpec, settings: BakeSettings, seed: int, resolution: tuple[int, int]) -> Path | None:
    """Folder of the table of ``table_key``; None for a user without a home folder."""
    folder = cache_folder("tables")
    return None if folder is None else folder / table_key(sensor, settings, seed, resolution)


def cached(folder: Path | None) -> PolyTable | None:
    """The table kept in ``folder``; None if there is none, or, with a warning, if it is damaged."""
    if folder is None or not folder.is_dir():
        return None
    try:
        return _load(folder)
    except (OSError, ValueError) as error:
        warnings.warn(f"the baked table in {folder} is damaged and is baked again: {error}", RuntimeWarning, stacklevel=3)
        return None


def keep(table: PolyTable, folder: Path | None) -> bool:
    """Write the table beside ``folder``, synchronise and rename it; True if the table is there.

    A whole table that is there already stays, so that a reader never finds half of it: under one digest all are the same. Where the
    cache cannot be written there is none, with a warning.
    """
    work = None
    try:
        if folder is None:
            raise OSError("there is no home folder")
        folder.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", suffix=PARTIAL, dir=folder.parent))
        if os.path.lexists(folder):
            try:
                _load(folder)
                return True
            except (OSError, ValueError):
                os.replace(folder, work / "damaged")
        _save(table, work / folder.name)
        try:
            os.replace(work / folder.name, folder)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            # Another process was faster.
        sync_folder(folder.parent)
    except (OSError, InputError) as error:
        warn_not_kept(folder, error)
        return False
    finally:
        if work is not None:
            shutil.rmtree(work, ignore_errors=True)
    return True


def _save(table: PolyTable, folder: Path) -> None:
    """A calibration folder with the checksums of its files, on the disk."""
    save_calibration(table, folder)
    lines = []
    for path in sorted(folder.iterdir()):
        with path.open("rb") as stream:
            lines.append(f"{hashlib.file_digest(stream, 'sha256').hexdigest()}  {path.name}\n")
            os.fsync(stream.fileno())
    write_atomic(folder / CHECKSUMS, "".join(lines).encode())


def _load(folder: Path) -> PolyTable:
    """The table of a folder, files checked by checksum; raises ``ValueError`` or ``OSError``."""
    lines = (line.partition("  ") for line in read_regular(folder / CHECKSUMS).decode().splitlines())
    listed = {name: digest for digest, _, name in lines}
    there = {path.name for path in folder.iterdir()} - {CHECKSUMS}
    if not listed or set(listed) != there:
        raise ValueError(f"{CHECKSUMS} does not list the files that are there")
    for name, digest in listed.items():
        if hashlib.sha256(read_regular(folder / name)).hexdigest() != digest:
            raise ValueError(f"{name} differs from its checksum")
    return load_calibration(folder)
