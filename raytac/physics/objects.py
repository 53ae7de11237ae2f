"""From the description of an object to the parts that make it up."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import Protocol

import numpy as np

from raytac.errors import InputError, SpecError
from raytac.shapes.part import Part, mesh_part, primitive
from raytac.shapes.relief import coin_elevation, relief_part
from raytac.specs.press import ObjectSpec
from raytac.specs.shape_file import OBJECT_SCHEMA


class Shape(Protocol):
    """Named shape: the object of a press scene, or a body of a task scene."""

    @property
    def kind(self) -> str: ...

    @property
    def params(self) -> dict[str, float | int | str]: ...


def object_parts(spec: Shape) -> tuple[Part, ...]:
    """Parts of the object, object frame [m]; empty for ``none``.

    The −z side looks at the pad when the quaternion is the identity. ``sphere``: centre at the origin. ``cylinder``: axis z,
    centre at the origin (standing; turn it by 90° about y to lie along x). ``box``: length along x, width along y, height along
    z, centre at the origin. ``edge``: a cube about the origin with one edge down, along x. ``cone``: rounded tip down at the
    origin, base of the given radius at ``height`` above it. ``torus``: axis z, lying flat. ``pins``: a plate with rows × columns
    (y × x) of flat-ended pins, ``pin_height`` long, under its face z = 0. ``plane``: the half-space under z = 0 (task scenes
    only). ``coin``: face down, field at z = 0. ``mesh``: as its file has it. ``mjcf``: every geom of one body, body frame.
    ``heights``: a relief under z = 0, centred. ``triangles``: as they are. Curved parts are exact shapes, not facets. Raises
    ``SpecError`` for an unknown kind, a missing or impossible length, or a model that MuJoCo refuses or that has no such body.
    """
    if spec.kind == "plane":
        return (primitive("plane"),)
    if isinstance(spec, ObjectSpec) and spec.heights:
        return (_heights(spec),)
    if isinstance(spec, ObjectSpec) and spec.triangles is not None:
        return (mesh_part(spec.triangles.vertices, spec.triangles.faces),)
    if spec.kind not in OBJECT_SCHEMA:
        raise SpecError("must be a known kind of object", key="object.kind", value=spec.kind, choices=tuple(OBJECT_SCHEMA))
    if spec.kind == "none":
        return ()
    if spec.kind == "sphere":
        return (primitive("sphere", (_length(spec, "radius"),)),)
    if spec.kind == "cylinder":
        return (primitive("cylinder", (_length(spec, "radius"), 0.5 * _length(spec, "length"))),)
    if spec.kind == "box":
        return (primitive("box", tuple(0.5 * _length(spec, key) for key in ("length", "width", "height"))),)
    if spec.kind == "edge":
        c = math.sqrt(0.5)
        edge_down = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, c, -c, 0.0], [0.0, c, c, 0.0], [0.0, 0.0, 0.0, 1.0]])
        return (primitive("box", (0.5 * _length(spec, "side"),) * 3, edge_down),)
    if spec.kind == "cone":
        size = (_length(spec, "radius"), _length(spec, "height"), _length(spec, "tip_radius", zero=True))
        return (primitive("cone", size),)
    if spec.kind == "torus":
        return (primitive("torus", (_length(spec, "major_radius"), _length(spec, "minor_radius"))),)
    if spec.kind == "pins":
        return _pins(spec)
    if spec.kind == "coin":
        return _coin(spec)
    if spec.kind == "mjcf":
        return _mjcf(spec)
    from raytac.specs.mesh import load_mesh

    vertices, faces = load_mesh(str(spec.params["path"]), _length(spec, "scale"))
    return (mesh_part(vertices, faces),)


def _pins(spec: Shape) -> tuple[Part, ...]:
    rows, columns = _count(spec, "rows"), _count(spec, "columns")
    pitch, radius, height = (_length(spec, key) for key in ("pitch", "pin_radius", "pin_height"))
    if max(rows, columns) > 1 and pitch < 2.0 * radius:
        raise SpecError(f"must be at least a pin's diameter, {2.0 * radius} m", key="object.pitch", value=pitch)
    plate = (0.5 * columns * pitch, 0.5 * rows * pitch, 0.5 * height)
    parts = [primitive("box", plate, _shift(0.0, 0.0, 0.5 * height))]
    for j in range(rows):
        for i in range(columns):
            x, y = (i - 0.5 * (columns - 1)) * pitch, (j - 0.5 * (rows - 1)) * pitch
            parts.append(replace(primitive("cylinder", (radius, 0.5 * height), _shift(x, y, -0.5 * height)), joined=True))
    return tuple(parts)


def _coin(spec: Shape) -> tuple[Part, ...]:
    radius, thickness, relief = (_length(spec, key) for key in ("radius", "thickness", "relief_height"))
    body = primitive("cylinder", (radius, 0.5 * thickness), _shift(0.0, 0.0, 0.5 * thickness))
    return body, _coin_face(radius, relief)


@lru_cache(1)
def _coin_face(radius: float, relief: float) -> Part:
    """Relief of a coin; that of the last size is kept, since it has a million triangles."""
    face = replace(relief_part(coin_elevation(radius, relief), radius), joined=True)
    for values in (face.elevation, face.vertices, face.faces):
        assert values is not None
        values.setflags(write=False)
    return face


def _heights(spec: ObjectSpec) -> Part:
    """The map in a square of zeros, no object; at its ends it falls to 0 over one pitch."""
    data, pitch = np.array(spec.heights), _length(spec, "pitch")
    rows, columns = data.shape
    n = max(rows, columns)
    square = np.zeros((n + 2, n + 2))
    square[1 : rows + 1, 1 : columns + 1] = data
    return relief_part(square, 0.5 * pitch * (n + 1), _shift(0.5 * pitch * (n - columns), 0.5 * pitch * (n - rows), 0.0))


def _mjcf(spec: Shape) -> tuple[Part, ...]:
    from raytac.physics.geoms import body_parts, load_mjcf

    try:
        model = load_mjcf(str(spec.params["path"]))
    except InputError as error:
        raise SpecError(error.rule, key="object.path", value=spec.params["path"]) from error
    try:
        return body_parts(model, str(spec.params["body"]))
    except InputError as error:
        about = "" if error.name == "body" else f"{error.name} = {error.value!r} "
        raise SpecError(about + error.rule, key="object.body", value=spec.params["body"], choices=error.choices) from error


def _shift(x: float, y: float, z: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def _length(spec: Shape, key: str, *, zero: bool = False) -> float:
    value = spec.params.get(key)
    if not isinstance(value, int | float) or not math.isfinite(value) or value < 0.0 or (value == 0.0 and not zero):
        raise SpecError(f"must be a length {'>=' if zero else '>'} 0 [m]", key=f"object.{key}", value=value)
    return float(value)


def _count(spec: Shape, key: str) -> int:
    value = spec.params.get(key)
    if not isinstance(value, int) or value < 1:
        raise SpecError("must be a whole number >= 1", key=f"object.{key}", value=value)
    return value
