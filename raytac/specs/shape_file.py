"""Shapes of press and task scenes: keys of every kind, rules of lengths, meshes and poses."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from raytac.checks import is_number
from raytac.errors import MeshError, SpecError
from raytac.specs.files import is_file
from raytac.specs.mesh import load_mesh
from raytac.specs.mesh_crossing import find_crossings
from raytac.specs.toml import Integer, Number, Schema, Table, Text, check_fields, in_mm, split_unit

_LENGTH = Number("(0, 100]")

OBJECT_SCHEMA: Final[dict[str, Schema]] = {
    "none": {},
    "sphere": {"radius_mm": _LENGTH},
    "cylinder": {"radius_mm": _LENGTH, "length_mm": _LENGTH},
    "box": {"length_mm": _LENGTH, "width_mm": _LENGTH, "height_mm": _LENGTH},
    "edge": {"side_mm": _LENGTH},
    "cone": {"radius_mm": _LENGTH, "height_mm": _LENGTH, "tip_radius_mm": Number("[0, 100]")},
    "torus": {"major_radius_mm": _LENGTH, "minor_radius_mm": _LENGTH},
    "pins": {
        "rows": Integer("[1, 50]"),
        "columns": Integer("[1, 50]"),
        "pitch_mm": _LENGTH,
        "pin_radius_mm": _LENGTH,
        "pin_height_mm": _LENGTH,
    },
    "coin": {"radius_mm": _LENGTH, "thickness_mm": _LENGTH, "relief_height_mm": _LENGTH},
    "mesh": {"path": Text(), "scale_m_per_unit": Number("(0, 10]")},
    "mjcf": {"path": Text(), "body": Text()},
}
"""Kind of object to the keys of its own."""


def check_shape(table: Table, kind: str, values: dict[str, Any]) -> None:
    """Check rules between the values of one shape (``OBJECT_SCHEMA``); make paths absolute.

    Raises:
        SpecError: lengths that contradict each other, or a file that does not exist.
        MeshError: the mesh cannot be used.
    """
    _check_lengths(kind, values, table.prefix, table.file)
    if kind in ("mesh", "mjcf"):
        values["path"] = str(resolved(table, values["path"]))
    if kind == "mesh":
        _check_mesh(table, values)
    elif kind == "mjcf" and not is_file(Path(values["path"])):
        raise table.error(f"the model file does not exist ({values['path']})", "path", table.data["path"])


def check_params(kind: str, params: Mapping[str, Any], schema: Schema, prefix: str) -> None:
    """Check a shape that is made in code, in SI, by the rules of ``check_shape``.

    A file that it names is checked where it is read.

    Raises ``SpecError``: a length or count that is missing or out of its range, lengths that contradict each other, or an unknown name.
    """
    if not isinstance(params, Mapping):
        raise SpecError("must be a mapping of names to values", key=f"{prefix}.params", value=params)
    check_fields(params, schema, prefix)
    known = [split_unit(key)[0] for key in schema]
    for name in params:
        if name not in known:
            rule = f"is no length or count of the kind {kind!r}"
            raise SpecError(rule, key=f"{prefix}.{name}", value=params[name], choices=known)
    _check_lengths(kind, params, prefix, None)


def check_quaternion(quaternion: object, key: str) -> None:
    """Raise ``SpecError`` for what is not four finite numbers w, x, y, z of unit length, to 1 %."""
    if not isinstance(quaternion, (tuple, list)) or len(quaternion) != 4 or not all(map(is_number, quaternion)):
        raise SpecError("must be four numbers w, x, y, z", key=key, value=quaternion)
    length = math.hypot(*quaternion)
    if not abs(length - 1) <= 0.01:
        raise SpecError(f"must be a unit quaternion w, x, y, z, to 1 %; its length is {length:.4g}", key=key, value=quaternion)


def unit_quaternion(table: Table, quaternion: tuple[float, ...]) -> tuple[float, float, float, float]:
    """w, x, y, z of unit length. Raises ``SpecError`` for ``quaternion_wxyz`` more than 1 % off."""
    length = math.hypot(*quaternion)
    if abs(length - 1) > 0.01:
        rule = f"must be a unit quaternion w, x, y, z (to 1 %, then normalised); its length is {length:.4g}"
        raise table.error(rule, "quaternion_wxyz", table.data["quaternion_wxyz"])
    w, i, j, k = (component / length for component in quaternion)
    return w, i, j, k


def resolved(table: Table, path: str) -> Path:
    """Absolute path of a file that a scene names, relative to the scene's folder."""
    try:
        return (table.file.parent / Path(path).expanduser()).resolve()
    except (OSError, RuntimeError) as error:  # "~nobody/x.stl", or a circle of links
        raise table.error(f"the path has no meaning here ({error})", "path", path) from error


def _check_lengths(kind: str, p: Mapping[str, Any], prefix: str, file: Path | None) -> None:
    """Lengths [m] of one object that contradict each other."""
    key = rule = ""
    if kind == "cone" and p["tip_radius"] >= p["radius"]:
        key, rule = "tip_radius_mm", f"must be less than radius_mm = {in_mm(p['radius'])}"
    elif kind == "torus" and p["minor_radius"] >= p["major_radius"]:
        key, rule = "minor_radius_mm", f"must be less than major_radius_mm = {in_mm(p['major_radius'])}"
    elif kind == "pins" and p["rows"] * p["columns"] > 1 and p["pitch"] < 2 * p["pin_radius"]:
        key, rule = "pitch_mm", f"pins must not overlap: at least twice pin_radius_mm = {in_mm(p['pin_radius'])}"
    elif kind == "coin" and p["relief_height"] >= p["thickness"]:
        key, rule = "relief_height_mm", f"must be less than thickness_mm = {in_mm(p['thickness'])}"
    if key:
        raise SpecError(rule, file=file, key=f"{prefix}.{key}" if prefix else key, value=in_mm(p[key.removesuffix("_mm")]))


def _check_mesh(table: Table, values: Mapping[str, Any]) -> None:
    try:
        vertices, faces = load_mesh(values["path"], values["scale"])
    except MeshError as error:
        key = "scale_m_per_unit" if error.key == "scale" else "path"
        rule = f"{error.rule} (mesh {values['path']})"
        dotted = f"{table.prefix}.{key}" if table.prefix else key
        raise MeshError(rule, file=table.file, key=dotted, value=table.data[key], choices=error.choices) from error
    warn_of_crossings(values["path"], vertices, faces)


def warn_of_crossings(path: str, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Warn of a mesh [m] whose triangles cross each other."""
    crossings = find_crossings(vertices, faces)
    if crossings:
        text = crossings.text(1e-3, "mm")
        warnings.warn(f"mesh {path}: {text}; the rigid pad takes its lowest faces, physics='ipc' refuses it", stacklevel=3)
