"""Reads task scenes from TOML: ``scenes/tasks/*.toml``."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from raytac.errors import SpecError
from raytac.specs.files import available, find_file, is_file, name_of
from raytac.specs.press import PressScene
from raytac.specs.press_file import load_press
from raytac.specs.shape_file import check_shape, resolved, unit_quaternion
from raytac.specs.task import (
    BODY_SCHEMA,
    MOUNT_SCHEMA,
    ROBOT_SCHEMA,
    ROBOTS,
    SHAPE_SCHEMA,
    TASK_SCHEMA,
    BodySpec,
    MountSpec,
    RobotSpec,
    TaskScene,
)
from raytac.specs.toml import Table, Text, read_toml, split_unit

_OWN: Final = {
    "panda_one_sensor": ("joints_deg",),
    "panda_two_fingers": ("joints_deg", "opening_mm"),
    "floating_gripper": ("opening_mm", "position_mm", "quaternion_wxyz"),
    "fixed_sensor": ("position_mm", "quaternion_wxyz"),
    "": ("arm_joints", "keyframe", "mount"),
}
"""Keys that each robot takes besides ``model`` and ``sensor``; the last is an MJCF file."""

_OF_MOTION: Final = {
    "owner": ("free",),
    "mass_kg": ("free",),
    "density_kg_m3": ("free", "soft"),
    "youngs_modulus_kpa": ("soft",),
    "poisson_ratio": ("soft",),
    "cell_mm": ("soft",),
    "held_by": ("soft",),
}
"""Keys of a body that only some dynamics have."""


def load_task(name_or_path: str | Path) -> TaskScene:
    """Read and check a task scene.

    Args:
        name_or_path: shipped name such as ``"ball_rolling"``, or path of a TOML file (see ``scenes/README.md``).

    Returns:
        The scene in SI units; its name is the file's stem. Sensors and MJCF models that it names are read when a world is made of it.

    Raises:
        SpecError: unknown name, unreadable file, unknown or missing key, wrong type, value out of range, steps that do not divide each
            other, or keys that contradict each other.
        MeshError: the mesh of a body cannot be used.
    """
    path = find_file("task scene", name_or_path)
    top = read_toml(path)
    values = top.read(TASK_SCHEMA, sections=("robot", "body"))
    if values["pad"] is not None and values["physics"] != "ipc":
        raise top.error('is how finely a soft pad is cut, so physics must be "ipc"', "pad", values["pad"])
    robot = _read_robot(top.section("robot"))
    tables = top.sections("body")
    bodies = tuple(_read_body(table) for table in tables)
    _check_names(tables, bodies)
    return TaskScene(name_of(path), robot, bodies, source=path, **values)


def _read_robot(table: Table) -> RobotSpec:
    values = table.read(ROBOT_SCHEMA, sections=("mount",))
    model = values["model"]
    own = model in ROBOTS
    if not own:
        if not model.endswith(".xml"):
            raise table.error("must be a robot that raytac builds, or the path of an .xml file", "model", model, ROBOTS)
        file = resolved(table, model)
        if not is_file(file):
            raise table.error(f"the model file does not exist ({file})", "model", model)
        values["model"] = str(file)
    takes = _OWN[model if own else ""]
    for key in table.data:
        if key not in ("model", "sensor", *takes):
            raise table.error(f"is no key of this robot, {model}", key, table.data[key], ("model", "sensor", *takes))
    values["quaternion"] = unit_quaternion(table, values["quaternion"])
    if (values["joints"] is not None) and len(values["joints"]) != 7:
        raise table.error("must be the seven angles of the arm", "joints_deg", table.data["joints_deg"])
    if values["sensor"].endswith(".toml"):
        values["sensor"] = str(resolved(table, values["sensor"]))
    mounts = tuple(_read_mount(m) for m in table.sections("mount"))
    if not own and not mounts:
        raise table.error("a robot from a file needs at least one [[robot.mount]]: a sensor, and what carries it", "mount")
    names = [mount.name for mount in mounts]
    for name in names:
        if names.count(name) > 1:
            raise table.error("two sensors have this name", "mount.name", name)
    values["arm_joints"] = tuple((values["arm_joints"] or "").split())
    return RobotSpec(mounts=mounts, **values)


def _read_mount(table: Table) -> MountSpec:
    values = table.read(MOUNT_SCHEMA)
    values["quaternion"] = unit_quaternion(table, values["quaternion"])
    if values["position"] is None and "quaternion_wxyz" in table.data:
        raise table.error("needs position_mm beside it", "quaternion_wxyz", table.data["quaternion_wxyz"])
    return MountSpec(**values)


def _read_body(table: Table) -> BodySpec:
    kind = table.read_one("kind", Text(choices=tuple(SHAPE_SCHEMA)))
    values = table.read({"kind": Text(), **BODY_SCHEMA, **SHAPE_SCHEMA[kind]})
    own = {name: values.pop(name) for name in (split_unit(key)[0] for key in SHAPE_SCHEMA[kind])}
    del values["kind"]
    check_shape(table, kind, own)
    values["quaternion"] = unit_quaternion(table, values["quaternion"])
    dynamics = values["dynamics"]
    for key, allowed in _OF_MOTION.items():
        if key in table.data and dynamics not in allowed:
            raise table.error(f"belongs to a body with dynamics {' or '.join(allowed)}, not {dynamics}", key, table.data[key])
    if kind == "plane" and dynamics != "fixed":
        raise table.error('a plane is a half-space that cannot move: dynamics must be "fixed"', "dynamics", dynamics)
    if values["mass"] is not None and values["density"] is not None:
        raise table.error("give mass_kg or density_kg_m3, not both", "density_kg_m3", table.data["density_kg_m3"])
    optional = ("owner", "density", "youngs_modulus", "poisson_ratio")
    values = {key: value for key, value in values.items() if not (key in optional and value is None)}
    return BodySpec(kind=kind, params=own, **values)


def _check_names(tables: tuple[Table, ...], bodies: tuple[BodySpec, ...]) -> None:
    names = [body.name for body in bodies]
    fixed = tuple(body.name for body in bodies if body.dynamics == "fixed")
    for i, (table, body) in enumerate(zip(tables, bodies, strict=True)):
        if body.name in names[:i]:
            raise table.error("another body has this name already", "name", body.name)
        if body.held_by is not None and body.held_by not in fixed:
            raise table.error("must be the name of a fixed body of the scene", "held_by", body.held_by, fixed)


def load_scene(name_or_path: str | Path) -> PressScene | TaskScene:
    """Read and check a press scene or a task scene, by its name or by the path of a file.

    A file with ``[robot]`` is a task.

    Raises:
        SpecError: a name that neither has (the message lists all); as ``load_press`` and ``load_task``.
        MeshError: an object's mesh cannot be used.
    """
    presses, tasks = available("press scene"), available("task scene")
    text = str(name_or_path)
    if isinstance(name_or_path, str) and not text.endswith(".toml") and not set(text) & {"/", "\\"}:
        if text not in (*presses, *tasks):
            rule = "no shipped press or task of this name, and not a path to a .toml file"
            raise SpecError(rule, key="scene", value=text, choices=(*presses, *tasks))
        return load_task(text) if text in tasks else load_press(text)
    path = find_file("press scene", name_or_path)
    return load_task(path) if "robot" in read_toml(path).data else load_press(path)
