"""Headers of networks' files: format and version, provenance, the view fitted to."""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from raytac.errors import CalibrationError, InputError
from raytac.optics.taxim.restricted_pickle import check_file_numbers, npz_arrays, npz_names
from raytac.specs.sensor import SensorSpec

_VIEW_TOLERANCE = 0.01
"""By which share the view may differ from that of the sensor that a network was fitted to."""


def view_size(sensor: SensorSpec) -> tuple[float, float]:
    """Width and height of the pad in a sensor's view [m]."""
    width, height = (n * p for n, p in zip(sensor.camera.resolution, sensor.camera.pixel_pitch, strict=True))
    return width, height


def look_digest(sensor: SensorSpec) -> str:
    """Digest of a sensor's lights, coat, case, camera and response: all that shapes its image.

    It does not depend on where the files lie.
    """
    lights = replace(sensor.lights, source=None)
    look = [_given(part) for part in (lights, sensor.coat, sensor.case, sensor.camera, sensor.response, sensor.optics)]
    return hashlib.sha256(repr(look).encode()).hexdigest()[:16]


def _given(value: Any) -> Any:
    """Fields that are not at their defaults.

    A field that a later version adds leaves the digest as it is.
    """
    if isinstance(value, tuple):
        return tuple(map(_given, value))
    if not is_dataclass(value):
        return value
    return {f.name: _given(getattr(value, f.name)) for f in fields(value) if getattr(value, f.name) != f.default}


def check_straight(name: str, sensor: SensorSpec) -> None:
    """Raise ``InputError`` for a tilted or distorting camera: networks know even pixels alone."""
    if not sensor.camera.lens.is_plain:
        rule = f"cannot show the distortion or tilt of the camera of {sensor.name!r}: it was fitted to pixels of one size"
        raise InputError("optics", value=name, rule=rule, choices=("raytrace", "taxim", "phong"))


def check_view(name: str, sensor: SensorSpec, view: tuple[float, float] | None, provenance: dict[str, str]) -> None:
    """Raise InputError if the network ``name`` is of another view: places are among its inputs."""
    own = view_size(sensor)
    if view is None or max(abs(a / b - 1) for a, b in zip(own, view, strict=True)) <= _VIEW_TOLERANCE:
        return
    theirs, mine = (f"{1e3 * w:.2f} mm x {1e3 * h:.2f} mm" for w, h in (view, own))
    rule = f"was fitted to the sensor {provenance.get('sensor', 'unknown')!r}, which sees {theirs}"
    rule += f": {sensor.name!r} sees {mine} and needs a network of its own"
    raise InputError("weights", value=name, rule=rule)


def header_arrays(kind: str, version: int, provenance: dict[str, str], view: tuple[float, float] | None) -> dict[str, Any]:
    """Arrays that every file holds beside its weights."""
    arrays = {"format": kind, "version": np.int64(version), "provenance": json.dumps(provenance)}
    return arrays if view is None else arrays | {"view": np.array(view)}


def check_header(path: Path, kind: str, version: int, remedy: str, *, unmarked: str = "") -> None:
    """Raise CalibrationError unless the file says this format and version.

    ``remedy``: what makes a new one. ``unmarked``: array by which a file from before versions is known.
    """
    names = npz_names(path)
    arrays = npz_arrays(path, tuple(name for name in ("format", "version") if name in names))
    header = {name: str(a.reshape(())) if a.size == 1 else f"{a.dtype} {a.shape}" for name, a in arrays.items()}
    if not header and unmarked in names:
        header = {"format": kind, "version": "0, of before files said it"}
    for key, expected in (("format", kind), ("version", str(version))):
        if header.get(key) != expected:
            rule = f"must be {expected!r}, which this raytac reads and writes: {remedy}"
            raise CalibrationError(rule, file=path, key=key, value=header.get(key, "missing"))


def file_provenance(path: Path) -> dict[str, str]:
    """Provenance that the file states; empty if it states none."""
    if "provenance" not in npz_names(path):
        return {}
    text = npz_arrays(path, ("provenance",))["provenance"]
    try:
        provenance = json.loads(str(text)) if text.dtype.kind == "U" and text.shape == () else None
    except (ValueError, RecursionError):
        provenance = None
    if not isinstance(provenance, dict) or not all(isinstance(value, str) for value in provenance.values()):
        raise CalibrationError("must be a JSON object of texts", file=path, key="provenance", value=str(text)[:80])
    return provenance


def file_view(path: Path) -> tuple[float, float] | None:
    """Width and height of the pad in view [m] that the file states; None if it states none."""
    if "view" not in npz_names(path):
        return None
    width, height = check_file_numbers(path, "view", npz_arrays(path, ("view",))["view"], (2,)).tolist()
    if min(width, height) <= 0:
        raise CalibrationError("must be two lengths > 0 [m]", file=path, key="view", value=(width, height))
    return width, height
