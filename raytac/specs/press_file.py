"""Press scenes from TOML, meshes and height maps; rules between scene and sensor."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from raytac.checks import check_number, check_numbers, check_truth
from raytac.errors import InputError, SpecError
from raytac.se3 import quaternion, rotation_of
from raytac.specs.files import find_file, name_of
from raytac.specs.mesh import FILE_SCALE, MESH_SUFFIXES, TriangleMesh, closed_mesh, load_mesh
from raytac.specs.press import POSE_SCHEMA, SCENE_SCHEMA, STAGE_SCHEMA, ObjectSpec, PressScene, StageSpec
from raytac.specs.sensor import SensorSpec
from raytac.specs.shape_file import OBJECT_SCHEMA, check_shape, unit_quaternion, warn_of_crossings
from raytac.specs.toml import Table, Text, in_mm, read_toml

_KIND = "kind"
_UNTURNED = (1.0, 0.0, 0.0, 0.0)
_HIGHEST = 0.1
"""Greatest height of a map that is pressed [m]; a larger one is in other units."""
_MAP_IN_PYTHON = "a height map is pressed in Python: sensor.press(heights, pitch=..., depth=...), all in metres"


def load_press(name_or_path: str | Path) -> PressScene:
    """Read and check a press scene.

    Args:
        name_or_path: shipped name such as ``"coin"``, or path of a TOML file (see ``scenes/README.md``).

    Returns:
        The scene in SI units; its name is the file's stem. A mesh is read once to check it; ``params["path"]`` is absolute. An MJCF
        model is compiled only when it is pressed.

    Raises:
        SpecError: unknown name, unreadable file, unknown or missing key, wrong type, value out of range, an object whose lengths
            contradict each other, or a trajectory in an impossible order.
        MeshError: the object's mesh cannot be used (see ``load_mesh``).
    """
    path = find_file("press scene", name_or_path)
    top = read_toml(path)
    scene = top.read(SCENE_SCHEMA, sections=("object", "trajectory"))
    target = _read_object(top.section("object"))
    stages = top.sections("trajectory")
    if target.kind == "none" and "moves" in top.data:
        raise top.error("must be absent where there is no object", "moves", scene["moves"])
    if scene["pad"] is not None and scene["physics"] != "ipc":
        raise top.error('is how finely a soft pad is cut, so physics must be "ipc"', "pad", scene["pad"])
    if target.kind == "none" and stages:
        raise top.error("must be absent where there is no object", "trajectory")
    if target.kind != "none" and not stages:
        raise top.error("at least one [[trajectory]] stage is needed to press the object", "trajectory")
    trajectory = _read_trajectory(stages)
    return PressScene(name_of(path), target, trajectory, scene["moves"], path, scene["physics"], scene["pad"])


def press_of(
    source: Any,
    *,
    depth: float | None = None,
    force: float | None = None,
    offset: tuple[float, float] = (0.0, 0.0),
    yaw: float = 0.0,
    tilt: float = 0.0,
    scale: float | None = None,
    pitch: float | None = None,
    repair: bool = False,
) -> PressScene:
    """Press scene of whatever can be pressed: a scene, a mesh or a height map.

    A mesh or a height map is pressed straight down by its −z side, with the middle of its bounding box over the centre of the pad.
    There the object's frame has its origin.

    Args:
        source: a scene, or its name or file (``load_press``); an STL, OBJ, PLY, OFF or GLB file (``load_mesh``); a ``trimesh.Trimesh``;
            or the heights [m] of a face, shape (rows, columns), as the camera sees it. The greatest height touches first, and where it
            is 0 there is no object.
        depth: how deep it is pressed in [m]; of a scene, one press to this depth in place of its trajectory.
        force: normal force that it is pressed with [N], likewise. A mesh or a height map needs one of the two.
        offset: displacement of the object along x and y, pad frame [m].
        yaw: turn about the pad frame's z and the object's origin [rad], clockwise in the image.
        tilt: turn about the pad frame's x before that [rad], at the start; the object leans towards the side that is up in the image.
        scale: metres per unit of a mesh; None is 0.001, a file in millimetres, but 1 for GLB, which is in metres, and for a mesh in memory.
        pitch: spacing of the rows and columns of a height map [m].
        repair: close the holes of a mesh, as ``load_mesh`` does.

    Raises:
        InputError: an argument that is missing, out of range, or that belongs to another kind of source; a file of another kind;
            heights that are not finite, negative, all 0, or above 0.1 m.
        SpecError: a force out of range; as ``load_press``.
        MeshError: as ``load_mesh``.
    """
    place = check_numbers("offset", offset, (2,), finite=True)
    turn = _turned(check_number("yaw", yaw, "[-7, 7]", "rad"), check_number("tilt", tilt, "[-1.6, 1.6]", "rad"))
    is_file = isinstance(source, (str, Path)) and Path(source).suffix.lower() in MESH_SUFFIXES
    is_mesh = is_file or (hasattr(source, "vertices") and hasattr(source, "faces"))
    is_map = isinstance(source, np.ndarray)
    if not is_mesh and not is_map and not isinstance(source, (str, Path, PressScene)):
        rule = f"must be a name, a path, a PressScene, a trimesh.Trimesh or an array of heights, not {type(source).__name__}"
        raise InputError("scene", value=source, rule=rule)
    for name, value, owner, belongs in (
        ("scale", scale, "a mesh", is_mesh),
        ("repair", check_truth("repair", repair) or None, "a mesh", is_mesh),
        ("pitch", pitch, "a height map", is_map),
    ):
        if value is not None and not belongs:
            raise InputError(name, value=value, rule=f"belongs to {owner}: leave it out with a {'mesh' if is_mesh else 'scene'}")
    if isinstance(source, (str, Path)) and not is_file and Path(source).suffix.lower() not in ("", ".toml"):
        rule = f"must be the name of a press scene, a .toml file or a mesh ({', '.join(MESH_SUFFIXES)}); {_MAP_IN_PYTHON}"
        raise InputError("scene", value=str(source), rule=rule)
    if depth is not None and force is not None:
        raise InputError("depth, force", value=(depth, force), rule="cannot both be given: a press ends at one of them")
    if depth is None and force is None and (is_mesh or is_map):
        how = "raytac press FILE --depth 0.8 (mm) or --force 2 (N), in Python depth=0.8e-3 (m) or force=2.0 (N)"
        raise InputError("depth, force", rule=f"one of the two must be given with a mesh or a height map: {how}")
    if depth is not None:
        check_number("depth", depth, "(0, 0.05]", "m (0.8e-3 is 0.8 mm; --depth takes mm)")
    if is_mesh:
        scene = _mesh_scene(source, scale, repair=bool(repair))
    elif isinstance(source, np.ndarray):
        scene = PressScene("heights", _heights_object(source, pitch), ())
    else:
        scene = source if isinstance(source, PressScene) else load_press(source)
    given = {
        "depth": depth,
        "force": force,
        "offset": place.tolist() if place.any() else None,
        "yaw": yaw or None,
        "tilt": tilt or None,
    }
    for name, value in given.items():
        if value is not None and scene.object.kind == "none":
            raise InputError(name, value=value, rule=f"needs an object, and the scene {scene.name!r} has none")
    if depth is not None and scene.object.dynamics == "affine":
        raise InputError(
            "depth", value=depth, rule="is not for a free body (affine), which is laid on the pad by its weight: give force"
        )
    if depth is not None or force is not None:
        scene = replace(scene, trajectory=(StageSpec("indent", depth=depth, force=force),))
    if not place.any() and turn == _UNTURNED:
        return scene
    (x, y, z), own = scene.object.position, rotation_of(scene.object.quaternion)
    w, i, j, k = quaternion(rotation_of(turn) @ own).tolist()
    target = replace(scene.object, position=(x + float(place[0]), y + float(place[1]), z), quaternion=(w, i, j, k))
    return replace(scene, object=target)


def _turned(yaw: float, tilt: float) -> tuple[float, float, float, float]:
    """Quaternion wxyz of a turn about x by ``tilt``, then about z by ``yaw`` [rad]."""
    (c, s), (a, b) = ((math.cos(0.5 * angle), math.sin(0.5 * angle)) for angle in (yaw, tilt))
    return c * a, c * b, s * b, s * a


def _mesh_scene(source: Any, scale: float | None, *, repair: bool) -> PressScene:
    """A mesh without a trajectory, its origin in the middle of its bounding box."""
    is_file = isinstance(source, (str, Path))
    path = Path(source).absolute() if is_file else None
    usual = 1.0 if path is None else FILE_SCALE.get(path.suffix.lower(), 0.001)
    scale = check_number("scale", usual if scale is None else scale, "(0, 10]", "m per file unit")
    if path is not None:
        vertices, faces = load_mesh(path, scale, repair=repair)
    else:
        vertices, faces = closed_mesh(source.vertices, source.faces, scale, repair=repair)
    warn_of_crossings("in memory" if path is None else str(path), vertices, faces)
    vertices = vertices - 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    target = ObjectSpec("triangles", {}, (0.0, 0.0, 0.0), _UNTURNED, 0.1, triangles=TriangleMesh(vertices, faces))
    return PressScene("mesh" if path is None else name_of(path), target, ())


def _heights_object(source: np.ndarray, pitch: float | None) -> ObjectSpec:
    if pitch is None:
        raise InputError("pitch", rule="must be given with a height map, in metres")
    heights = check_numbers("heights", source, (None, None), finite=True)
    if not heights.size or heights.min() < 0 or heights.max() == 0:
        raise InputError("heights", value=heights.shape, rule="must be >= 0 everywhere and > 0 somewhere [m]")
    if heights.max() > _HIGHEST:
        raise InputError("heights", value=float(heights.max()), rule=f"must be in metres, at most {_HIGHEST} m")
    params: dict[str, float | int | str] = {"pitch": check_number("pitch", pitch, "(0, 0.01]", "m")}
    return ObjectSpec("heights", params, (0.0, 0.0, 0.0), _UNTURNED, 0.1, heights=tuple(map(tuple, heights.tolist())))


def validate_press(sensor: SensorSpec, scene: PressScene) -> None:
    """Check a scene against the sensor that it is pressed into.

    Raises ``SpecError``: an indent as deep as the pad is thick or deeper, or an object whose origin starts or is sheared off the pad.
    """
    pad = sensor.gelpad
    half = (pad.size[0] / 2, pad.size[1] / 2)
    x, y, _ = scene.object.position
    if scene.object.kind != "none" and (abs(x) > half[0] or abs(y) > half[1]):
        rule = f"the object must start on the pad of {sensor.name}: |x| <= {half[0] * 1e3:.4g} mm, |y| <= {half[1] * 1e3:.4g} mm"
        raise SpecError(rule, file=scene.source, key="object.position_mm", value=[x * 1e3, y * 1e3])
    for index, stage in enumerate(scene.trajectory):
        if stage.depth is not None and not stage.depth < pad.thickness:
            rule = f"the press must be less deep than the pad of {sensor.name} is thick, {pad.thickness * 1e3:.4g} mm"
            raise SpecError(rule, file=scene.source, key=f"trajectory[{index}].depth_mm", value=in_mm(stage.depth))
        dx, dy = stage.shear
        if abs(x + dx) > half[0] or abs(y + dy) > half[1]:
            rule = (
                f"the shear must leave the object on the pad of {sensor.name}: from {in_mm((x, y))} mm to "
                f"|x| <= {half[0] * 1e3:.4g} mm, |y| <= {half[1] * 1e3:.4g} mm"
            )
            raise SpecError(rule, file=scene.source, key=f"trajectory[{index}].shear_mm", value=in_mm(stage.shear))


def _read_object(table: Table) -> ObjectSpec:
    kind = table.read_one(_KIND, Text(choices=tuple(OBJECT_SCHEMA)))
    pose = {} if kind == "none" else POSE_SCHEMA
    values = table.read({_KIND: Text(), **OBJECT_SCHEMA[kind], **pose})
    del values[_KIND]
    if kind == "none":
        return ObjectSpec(kind, {}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.0)
    x, y = values.pop("position")
    quaternion, mass, dynamics = values.pop("quaternion"), values.pop("mass"), values.pop("dynamics")
    given = {name: values.pop(name) for name in ("youngs_modulus", "poisson_ratio")}
    elastic = {name: value for name, value in given.items() if value is not None}
    if elastic and dynamics != "soft":
        key = "youngs_modulus_kpa" if "youngs_modulus" in elastic else "poisson_ratio"
        raise table.error('is the material of a soft object, so dynamics must be "soft"', key, table.data[key])
    quaternion = unit_quaternion(table, quaternion)
    check_shape(table, kind, values)
    return ObjectSpec(kind, values, (x, y, 0.0), quaternion, mass, dynamics, **elastic)


def _read_trajectory(tables: tuple[Table, ...]) -> tuple[StageSpec, ...]:
    stages: list[StageSpec] = []
    touching = False
    for table in tables:
        kind = table.read_one(_KIND, Text(choices=tuple(STAGE_SCHEMA)))
        values = table.read({_KIND: Text(), **STAGE_SCHEMA[kind]})
        if kind == "indent":
            if (values["depth"] is None) == (values["force"] is None):
                given = {key: table.data[key] for key in ("depth_mm", "force_n") if key in table.data}
                rule = "an indent needs exactly one of depth_mm and force_n"
                raise table.error(f"{rule}, got both" if given else f"{rule}, got neither", "depth_mm", given.get("depth_mm"))
            touching = True
        elif not touching:
            raise table.error("must come after an indent that has not been released", _KIND, kind)
        elif kind == "release":
            touching = False
        stages.append(StageSpec(**values))
    return tuple(stages)
