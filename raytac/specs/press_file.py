"""Press scenes from TOML, meshes and height maps; rules between scene and sensor."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from raytac.checks import check_number, check_numbers
from raytac.errors import InputError, SpecError
from raytac.specs.files import find_file, name_of
from raytac.specs.mesh import MESH_SUFFIXES, load_mesh
from raytac.specs.press import POSE_SCHEMA, SCENE_SCHEMA, STAGE_SCHEMA, ObjectSpec, PressScene, StageSpec
from raytac.specs.sensor import SensorSpec
from raytac.specs.shape_file import OBJECT_SCHEMA, check_shape, unit_quaternion, warn_of_crossings
from raytac.specs.toml import Table, Text, in_mm, read_toml

_KIND = "kind"


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
    if target.dynamics == "affine" and any(s.kind not in ("indent", "release") or s.depth is not None for s in trajectory):
        rule = "a free body (affine) can only be laid on the pad by its weight: indent with force_n, and release"
        raise top.section("object").error(rule, "dynamics", target.dynamics)
    return PressScene(name_of(path), target, trajectory, scene["moves"], path, scene["physics"], scene["pad"])


def press_of(
    source: str | Path | PressScene | np.ndarray,
    *,
    depth: float | None = None,
    scale: float | None = None,
    pitch: float | None = None,
) -> PressScene:
    """Press scene of whatever can be pressed: a scene, a mesh or a height map.

    A mesh or a height map is pressed straight down by its −z side. The middle of its bounding box is over the centre of the pad.

    Args:
        source: a scene, or its name or file (``load_press``); an STL, OBJ or PLY file (``load_mesh``); or the heights [m] of a face,
            shape (rows, columns), as the camera sees it. The greatest height touches first, and where it is 0 there is no object.
        depth: how deep a mesh or a height map is pressed in [m].
        scale: metres per unit of a mesh file; None is 0.001, a file in millimetres.
        pitch: spacing of the rows and columns of a height map [m].

    Raises:
        InputError: an argument that is missing, or that belongs to another kind of source; heights that are not finite, negative, or all 0.
        SpecError: a depth out of range; as ``load_press``.
        MeshError: as ``load_mesh``.
    """
    if not isinstance(source, (str, Path, PressScene, np.ndarray)):
        rule = f"must be a name, a path, a PressScene or an array of heights, not {type(source).__name__}"
        raise InputError("scene", value=source, rule=rule)
    is_map = isinstance(source, np.ndarray)
    is_mesh = isinstance(source, (str, Path)) and Path(source).suffix.lower() in MESH_SUFFIXES
    for name, value, owner, belongs in (
        ("depth", depth, "a mesh or a height map", is_mesh or is_map),
        ("scale", scale, "a mesh", is_mesh),
        ("pitch", pitch, "a height map", is_map),
    ):
        if value is not None and not belongs:
            raise InputError(name, value=value, rule=f"belongs to {owner}: leave it out with a {'mesh' if is_mesh else 'scene'}")
        if value is None and belongs and name != "scale":
            units = ", in metres (on the command line in millimetres)" if name == "depth" else ", in metres"
            raise InputError(name, rule=f"must be given with {owner}{units}")
    if isinstance(source, PressScene):
        return source
    if isinstance(source, np.ndarray):
        heights = check_numbers("heights", source, (None, None), finite=True)
        if not heights.size or heights.min() < 0 or heights.max() == 0:
            raise InputError("heights", value=heights.shape, rule="must be >= 0 everywhere and > 0 somewhere [m]")
        params: dict[str, float | int | str] = {"pitch": check_number("pitch", pitch, "(0, 0.01]", "m")}
        rows = tuple(map(tuple, heights.tolist()))
        target = ObjectSpec("heights", params, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.1, heights=rows)
        return PressScene("heights", target, (StageSpec("indent", depth=depth),))
    if not is_mesh:
        return load_press(source)
    path, scale = Path(source).absolute(), check_number("scale", 0.001 if scale is None else scale, "(0, 10]", "m per file unit")
    vertices, faces = load_mesh(path, scale)
    warn_of_crossings(str(path), vertices, faces)
    x, y, _ = (-0.5 * (vertices.min(axis=0) + vertices.max(axis=0))).tolist()
    target = ObjectSpec("mesh", {"path": str(path), "scale": scale}, (x, y, 0.0), (1.0, 0.0, 0.0, 0.0), 0.1)
    return PressScene(name_of(path), target, (StageSpec("indent", depth=depth),))


def validate_press(sensor: SensorSpec, scene: PressScene) -> None:
    """Check a scene against the sensor that it is pressed into.

    Raises ``SpecError``: an indent as deep as the pad is thick or deeper, or an object whose origin starts or is sheared off the pad.
    """
    pad = sensor.gelpad
    half = (pad.size[0] / 2, pad.size[1] / 2)
    x, y, _ = scene.object.position
    if scene.object.kind == "mesh" and scene.source is None:
        x = y = 0.0  # its file's origin may lie anywhere; ``press_of`` puts its middle over the pad
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
