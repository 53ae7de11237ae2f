"""Composition of a task scene to one MuJoCo model: robot, sensors, bodies, start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from raytac.errors import InputError, MeshError, SpecError
from raytac.physics.mjcf_size import check_mjcf_size
from raytac.physics.objects import object_parts
from raytac.robots.arm import Arm
from raytac.robots.gripper import floating_gripper
from raytac.robots.mount import RobotModel, mount
from raytac.robots.panda import READY, one_sensor_panda, two_finger_panda
from raytac.se3 import pose_of, quaternion
from raytac.shapes.part import Part
from raytac.specs.sensor import SensorSpec
from raytac.specs.sensor_file import sensor_spec
from raytac.specs.task import PAIR_FRICTION, ROBOTS, BodySpec, MountSpec, RobotSpec, TaskScene
from raytac.world.hard_contacts import HARD_MARGIN
from raytac.world.touched import TouchedBody
from raytac.world.world_model import WorldModel, compiled_model

_GEOMS = {
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "plane": mujoco.mjtGeom.mjGEOM_PLANE,
}
_PLANE = (2.0, 2.0, 0.1)
"""Half widths and grid spacing [m] of the picture of a half-space, which is unbounded."""
_COLOUR = (0.72, 0.72, 0.7)
_HARD = 0.2, 0.999
"""Contacts of rigid bodies beside soft pads: ω Δt of their direct form, and impedance d.

A force F on a mass m penetrates by (1 − d) F Δt² / (m 0.2²): 25 µm for a steel ball of 4 g under 1 N at 2 ms, some tenths of a millimetre
with MuJoCo's default."""
_HARDER = 0.9999
"""Impedance d of contacts of rigid bodies beside rigid pads (``world.hard_contacts``)."""


def compose(scene: TaskScene, physics: str) -> WorldModel:
    """Build and compile the model of a scene.

    With ``physics="ipc"`` bodies that belong to IPC are mocap bodies that touch nothing, and soft ones are left out.

    Raises:
        SpecError: a soft body with the rigid pad, a body or robot that cannot be built; names the scene's file and key.
        InputError: MuJoCo refuses the model.
    """
    robot = _robot(scene)
    spec: mujoco.MjSpec = robot.spec
    spec.option.timestep = timestep = _timestep(scene, physics)
    spec.option.gravity = scene.gravity
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Elliptic cones have one coefficient for every direction. Between rigid bodies MuJoCo's soft friction creeps, the less the greater
    # ``impratio``; a rigid pad's friction has its own stiffness.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    # A noslip pass removes that creep, but would undo the shear of a rigid pad's gel.
    spec.option.noslip_iterations = 0 if physics == "rigid" else 4
    # MuJoCo measures what a solver's iteration gains by the model's mean inertia, an arm's: by its own 1e-8 it stops before the forces
    # on a cube of 50 g are in balance.
    spec.option.tolerance = 1e-10
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    shapes: dict[str, tuple[Part, ...]] = {}
    for i, body in enumerate(scene.bodies):
        if body.name in (mounted.name for mounted in robot.sensors):
            rule = "a sensor of the robot has this name"
            raise SpecError(rule, file=scene.source, key=f"body[{i}].name", value=body.name)
        shapes[body.name] = _parts(scene, i)
        if body.dynamics == "soft":
            if physics == "rigid":
                choices = ("fixed", "free")
                rule = "is for soft pads, physics='ipc': with the rigid pad nothing deforms"
                raise SpecError(rule, file=scene.source, key=f"body[{i}].dynamics", value="soft", choices=choices)
            continue
        if spec.body(body.name) is not None:
            rule = "the robot has a body of this name"
            raise SpecError(rule, file=scene.source, key=f"body[{i}].name", value=body.name)
        _add_body(
            spec,
            body,
            shapes[body.name],
            timestep,
            mirrored=physics == "ipc" and body.dynamics == "free" and body.owner == "ipc",
            rigid_pads=physics == "rigid",
        )
    try:
        model = compiled_model(spec)
    except InputError as error:
        raise InputError("scene", value=scene.name, rule=error.rule) from error
    bodies = {b.name: _touched(model, b, shapes[b.name]) for b in scene.bodies if b.dynamics != "soft"}
    arm = Arm(model, robot.site, robot.joints) if robot.joints else None
    opening = None if robot.opening is None else int(model.actuator(robot.opening).id)
    fingers = _fingers(model, opening)
    start, ctrl = _start(scene, model, arm, opening, fingers, bodies)
    steps = timestep, scene.control_timestep
    return WorldModel(
        model,
        robot.sensors,
        tuple(bodies.values()),
        *steps,
        start,
        ctrl,
        scene=scene,
        arm=arm,
        opening=opening,
        fingers=fingers,
        spec=spec,
    )


def _timestep(scene: TaskScene, physics: str) -> float:
    """Step of MuJoCo [s]; at most half of that of soft pads.

    Their solver steps early where a contact begins. If it could not, a pad that is pressed would bounce from step to step.
    """
    return scene.timestep if physics == "rigid" else min(scene.timestep, 0.5 * scene.soft_timestep)


def _robot(scene: TaskScene) -> RobotModel:
    """The robot of a scene, not compiled, with the sensors on it."""
    robot = scene.robot
    sensor = sensor_spec(robot.sensor)
    if robot.model == "panda_one_sensor":
        return one_sensor_panda(sensor)
    if robot.model == "panda_two_fingers":
        return two_finger_panda(sensor)
    if robot.model == "floating_gripper":
        return floating_gripper(sensor, position=robot.position, quaternion=robot.quaternion)
    if robot.model == "fixed_sensor":
        spec = mujoco.MjSpec()
        mounted = mount(spec, sensor, body="world", pose=pose_of(robot.position, robot.quaternion))
        return RobotModel(spec, (mounted,), mounted.nominal, None, ())
    return _own_robot(scene, robot, sensor)


def _own_robot(scene: TaskScene, robot: RobotSpec, sensor: SensorSpec) -> RobotModel:
    try:
        check_mjcf_size(robot.model)
        spec = mujoco.MjSpec.from_file(robot.model)
    except (ValueError, mujoco.FatalError) as error:
        rule = f"must be one of raytac's robots or an MJCF file that MuJoCo reads ({' '.join(str(error).split())})"
        raise SpecError(rule, file=scene.source, key="robot.model", value=robot.model, choices=ROBOTS) from error
    if not robot.mounts:
        raise SpecError("a robot from a file needs a sensor", file=scene.source, key="robot.mount")
    mounted = []
    for i, one in enumerate(robot.mounts):
        placement = None if one.position is None else pose_of(one.position, one.quaternion)
        try:
            mounted.append(mount(spec, sensor, **_carrier(spec, one), name=one.name, pose=placement))
        except InputError as error:
            key = f"robot.mount[{i}].{error.name if error.name in ('at', 'name') else 'position_mm'}"
            raise SpecError(error.rule, file=scene.source, key=key, value=error.value, choices=error.choices) from error
    return RobotModel(spec, tuple(mounted), mounted[0].nominal, None, robot.arm_joints)


def _carrier(spec: mujoco.MjSpec, one: MountSpec) -> dict[str, Any]:
    """The site or body that a scene names, as ``mount`` takes it."""
    names = {"body": [b.name for b in spec.bodies if b.name], "site": [s.name for s in spec.sites if s.name]}
    names = {kind: there for kind, there in names.items() if one.kind in (None, kind)}
    kinds = [kind for kind, there in names.items() if one.at in there]
    if len(kinds) > 1:
        raise InputError("at", value=one.at, rule="is the name of a body and of a site: say which by `kind`", choices=kinds)
    if not kinds:
        rule = f"must be the name of a {one.kind or 'body or site'} of the robot"
        raise InputError("at", value=one.at, rule=rule, choices=[name for there in names.values() for name in there])
    return {kinds[0]: one.at}


def _parts(scene: TaskScene, index: int) -> tuple[Part, ...]:
    body = scene.bodies[index]
    try:
        return object_parts(body)
    except MeshError:
        raise
    except SpecError as error:
        key = (error.key or "").replace("object", f"body[{index}]", 1)
        raise SpecError(error.rule, file=scene.source, key=key, value=error.value, choices=error.choices) from error


def _add_body(
    spec: mujoco.MjSpec, body: BodySpec, parts: Sequence[Part], timestep: float, *, mirrored: bool, rigid_pads: bool
) -> None:
    mjs_body = spec.worldbody.add_body(name=body.name, pos=body.position, quat=body.quaternion, mocap=mirrored)
    free = body.dynamics == "free" and not mirrored
    if free:
        mjs_body.add_freejoint(name=f"{body.name}_free")
    density = body.density
    if free and body.mass is not None:
        density = body.mass / _mass(parts)
    friction = PAIR_FRICTION if body.friction is None else body.friction
    for i, part in enumerate(parts):
        geom = _add_geom(spec, mjs_body, part, f"{body.name}_{i}")
        geom.density = density
        geom.friction = (friction, 0.0, 0.0)
        geom.priority = 1
        if rigid_pads:
            geom.solref, geom.solimp = (-_HARDER / timestep**2, -_HARDER / timestep), (_HARDER, _HARDER, 1e-3, 0.5, 2.0)
            geom.margin = HARD_MARGIN
        else:
            rate, impedance = _HARD[0] / timestep, _HARD[1]
            geom.solref, geom.solimp = (-(rate**2), -2.0 * rate), (impedance, impedance, 1e-3, 0.5, 2.0)
        geom.rgba = (*(_COLOUR if body.colour is None else body.colour), 1.0)
        if mirrored:
            geom.contype, geom.conaffinity = 0, 0


def _add_geom(spec: mujoco.MjSpec, body: mujoco.MjsBody, part: Part, name: str) -> mujoco.MjsGeom:
    placement = {"name": name, "pos": part.object_from_part[:3, 3], "quat": quaternion(part.object_from_part[:3, :3])}
    if part.kind in _GEOMS:
        size = _PLANE if part.kind == "plane" else (*part.size, 0.0, 0.0)[:3]
        return body.add_geom(type=_GEOMS[part.kind], size=size, **placement)
    if part.kind == "mesh":
        vertices, faces = part.vertices, part.faces
    else:
        from raytac.shapes.triangulate import part_surface

        surface = part_surface(part)
        vertices, faces = surface.vertices, surface.faces
    assert vertices is not None and faces is not None
    spec.add_mesh(name=name, uservert=np.asarray(vertices, float).ravel(), userface=np.asarray(faces, np.int32).ravel())
    return body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **placement)


def _mass(parts: Sequence[Part]) -> float:
    """Mass of a shape of density 1 by MuJoCo's formulas [kg]."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="body")
    for i, part in enumerate(parts):
        _add_geom(spec, body, part, f"g{i}").density = 1.0
    return float(spec.compile().body("body").mass[0])


def _touched(model: mujoco.MjModel, body: BodySpec, parts: tuple[Part, ...]) -> TouchedBody:
    index = int(model.body(body.name).id)
    first = int(model.body_geomadr[index])
    geoms = range(first, first + int(model.body_geomnum[index]))
    return TouchedBody.of(model, body.name, index, parts, body.friction_on_gel, geoms)


def _start(
    scene: TaskScene,
    model: mujoco.MjModel,
    arm: Arm | None,
    opening: int | None,
    fingers: np.ndarray,
    bodies: Mapping[str, TouchedBody],
) -> tuple[np.ndarray, np.ndarray]:
    robot = scene.robot
    start, ctrl = model.qpos0.copy(), np.zeros(model.nu)
    if robot.keyframe is not None:
        names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, i) for i in range(model.nkey)]
        if robot.keyframe not in names:
            rule = "must be a keyframe of the robot"
            raise SpecError(rule, file=scene.source, key="robot.keyframe", value=robot.keyframe, choices=[n for n in names if n])
        key = names.index(robot.keyframe)
        start, ctrl = model.key_qpos[key].copy(), model.key_ctrl[key].copy()
        for body in scene.bodies:
            if body.name in bodies and bodies[body.name].is_free:
                first = bodies[body.name].qpos
                start[first : first + 7] = *body.position, *body.quaternion
    elif robot.model not in ROBOTS:
        _balance_servos(model, start, ctrl)
    if arm is not None and robot.model in ("panda_one_sensor", "panda_two_fingers"):
        joints = np.array(READY if robot.joints is None else robot.joints)
        outside = (joints < arm.range[:, 0]) | (joints > arm.range[:, 1])
        if outside.any():
            i = int(np.flatnonzero(outside)[0])
            low, high = np.degrees(arm.range[i])
            rule = f"must be within {arm.joints[i]}'s [{low:.4g}, {high:.4g}] °"
            raise SpecError(rule, file=scene.source, key=f"robot.joints_deg[{i}]", value=float(np.degrees(joints[i])))
        start[arm.qpos] = joints
    if opening is not None:
        widest = float(model.actuator_ctrlrange[opening, 1])
        gap = widest if robot.opening is None else robot.opening
        if not 0.0 <= gap <= widest:
            rule = f"must be in [0, {widest * 1e3:g}] mm, as wide as the gripper opens"
            raise SpecError(rule, file=scene.source, key="robot.opening_mm", value=gap * 1e3)
        ctrl[opening], start[fingers] = gap, gap / len(fingers)
    return start, ctrl


def _fingers(model: mujoco.MjModel, opening: int | None) -> np.ndarray:
    """Addresses of the joints that the opening's tendon adds up."""
    if opening is None:
        return np.zeros(0, int)
    tendon = int(model.actuator_trnid[opening, 0])
    first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
    return model.jnt_qposadr[model.wrap_objid[first : first + count]].astype(int)


def _balance_servos(model: mujoco.MjModel, start: np.ndarray, ctrl: np.ndarray) -> None:
    """Set controls (nu,) of position servos for no force at ``start``: g u + b₀ + b₁ l = 0."""
    data = mujoco.MjData(model)
    data.qpos[:] = start
    mujoco.mj_fwdPosition(model, data)
    gain, bias = model.actuator_gainprm[:, 0], model.actuator_biasprm
    servo = (
        (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED)
        & (model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE)
        & (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE)
        & (gain != 0.0)
        & (bias[:, 1] != 0.0)
    )
    ctrl[servo] = -(bias[servo, 0] + bias[servo, 1] * data.actuator_length[servo]) / gain[servo]
