"""Reads task scenes from TOML: the schemas of ``scenes/tasks/*.toml``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from raytac.specs.files import find_file, is_file
from raytac.specs.press import PADS, PHYSICS
from raytac.specs.shape_file import OBJECT_SCHEMA, check_shape, resolved, unit_quaternion
from raytac.specs.task import COUPLINGS, MOTIONS, OWNERS, ROBOTS, BodySpec, MountSpec, RobotSpec, TaskScene
from raytac.specs.toml import ANY, Number, Schema, Table, Text, read_toml, split_unit

__all__ = ["BODY_SCHEMA", "MOUNT_SCHEMA", "ROBOT_SCHEMA", "SHAPE_SCHEMA", "TASK_SCHEMA", "load_task"]

_NAME = Text(pattern=r"[a-z][a-z0-9_]*", described="lower-case letters, digits and _, a letter first")
_STEP = "[0.0001, 0.1]"
_POSE: Final[Schema] = {
    "position_mm": Number("[-5000, 5000]", length=3, default=(0.0, 0.0, 0.0)),
    "quaternion_wxyz": Number("[-1, 1]", length=4, default=(1.0, 0.0, 0.0, 0.0)),
}

TASK_SCHEMA: Final[Schema] = {
    "physics": Text(choices=PHYSICS, default=None),
    "pad": Text(choices=PADS, default=None),
    "coupling": Text(choices=COUPLINGS, default="two_way"),
    "timestep_s": Number(_STEP, default=0.002),
    "soft_timestep_s": Number(_STEP, default=0.01),
    "control_timestep_s": Number("[0.0001, 1]", default=0.01),
    "gravity_m_s2": Number("[-100, 100]", length=3, default=(0.0, 0.0, -9.81)),
}
"""Keys at the top of a task scene."""

ROBOT_SCHEMA: Final[Schema] = {
    "model": Text(),
    "sensor": Text(default="gelsight_mini"),
    "joints_deg": Number("[-360, 360]", length=ANY, default=None),
    "opening_mm": Number("[0, 200]", default=None),
    **_POSE,
    "arm_joints": Text(default=None),
    "keyframe": Text(default=None),
}
"""Keys of ``[robot]``; which robot takes which: ``scenes/README.md``."""

_OWN: Final = {
    "panda_one_sensor": ("joints_deg",),
    "panda_two_fingers": ("joints_deg", "opening_mm"),
    "floating_gripper": ("opening_mm", "position_mm", "quaternion_wxyz"),
    "fixed_sensor": ("position_mm", "quaternion_wxyz"),
    "": ("arm_joints", "keyframe", "mount"),
}
"""Keys that each robot takes besides ``model`` and ``sensor``; the last is an MJCF file."""

MOUNT_SCHEMA: Final[Schema] = {
    "name": _NAME,
    "at": Text(),
    "kind": Text(choices=("body", "site"), default=None),
    "position_mm": Number("[-5000, 5000]", length=3, default=None),
    "quaternion_wxyz": _POSE["quaternion_wxyz"],
}
"""Keys of ``[[robot.mount]]``."""

SHAPE_SCHEMA: Final[dict[str, Schema]] = {
    **{kind: keys for kind, keys in OBJECT_SCHEMA.items() if kind != "none"},
    "box": {key: Number("(0, 5000]") for key in ("length_mm", "width_mm", "height_mm")},
    "plane": {},
}
"""Kind of body to the keys of its own in ``[[body]]``: a press scene's objects, larger boxes, and half-spaces."""

BODY_SCHEMA: Final[Schema] = {
    "name": _NAME,
    **_POSE,
    "dynamics": Text(choices=MOTIONS, default="free"),
    "owner": Text(choices=OWNERS, default=None),
    "mass_kg": Number("[0.00001, 1000]", default=None),
    "density_kg_m3": Number("[1, 30000]", default=None),
    "friction": Number("[0, 10]", default=None),
    "gel_friction": Number("[0, 10]", default=None),
    "youngs_modulus_kpa": Number("[1, 100000]", default=None),
    "poisson_ratio": Number("[0, 0.49]", default=None),
    "cell_mm": Number("[0.1, 100]", default=None),
    "held_by": replace(_NAME, default=None),
    "colour": Number("[0, 1]", length=3, default=None),
}
"""Keys of ``[[body]]`` that every kind has."""

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
        raise top.error('is how finely a simulated pad is cut, so physics must be "ipc"', "pad", values["pad"])
    _check_steps(top, values)
    robot = _read_robot(top.section("robot"))
    tables = top.sections("body")
    bodies = tuple(_read_body(table) for table in tables)
    _check_names(tables, bodies)
    return TaskScene(path.stem, robot, bodies, source=path, **values)


def _check_steps(top: Table, values: dict[str, Any]) -> None:
    for long, short in (("soft_timestep", "timestep"), ("control_timestep", "soft_timestep")):
        ratio = values[long] / values[short]
        if ratio < 1.0 - 1e-9 or abs(ratio - round(ratio)) > 1e-6:
            rule = f"must be a whole multiple of {short}_s = {values[short]:g}"
            raise top.error(rule, f"{long}_s", values[long])


def _read_robot(table: Table) -> RobotSpec:
    values = table.read(ROBOT_SCHEMA, sections=("mount",))
    model = values["model"]
    own = model in ROBOTS
    if not own:
        if not model.endswith(".xml"):
            raise table.error("must be a robot that raytac builds, or the path of an .xml file", "model", model, ROBOTS)
        found = resolved(table, model)
        if not is_file(found):
            raise table.error(f"the model file does not exist ({found})", "model", model)
        values["model"] = str(found)
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
    own = {key: values.pop(key) for key in _names(SHAPE_SCHEMA[kind])}
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


def _names(schema: Schema) -> list[str]:
    return [split_unit(key)[0] for key in schema]


def _check_names(tables: tuple[Table, ...], bodies: tuple[BodySpec, ...]) -> None:
    names = [body.name for body in bodies]
    fixed = tuple(body.name for body in bodies if body.dynamics == "fixed")
    for i, (table, body) in enumerate(zip(tables, bodies, strict=True)):
        if body.name in names[:i]:
            raise table.error("another body has this name already", "name", body.name)
        if body.held_by is not None and body.held_by not in fixed:
            raise table.error("must be the name of a fixed body of the scene", "held_by", body.held_by, fixed)
