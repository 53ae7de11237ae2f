"""Model of a world, made from a task scene or a user's own MuJoCo model."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

from raytac.checks import check_number
from raytac.errors import InputError
from raytac.robots.arm import Arm
from raytac.robots.mount import MountedSensor, SensorChoice, mounted_sensors
from raytac.specs.sensor import SensorSpec
from raytac.specs.task import TaskScene
from raytac.world.touched import TouchChoice, TouchedBody, touched_bodies

_OVERLAP = 1e-4
"""Greatest depth of a gel in the robot at the start [m]: rounding of a model's lengths."""


@dataclass(frozen=True)
class WorldModel:
    """Compiled model, its sensors and the bodies that they may touch."""

    model: mujoco.MjModel
    sensors: tuple[MountedSensor, ...]
    touched: tuple[TouchedBody, ...]
    timestep: float
    """Of MuJoCo [s]."""
    control_timestep: float
    """Of ``TactileWorld.step`` [s], a whole multiple of it."""
    start: np.ndarray
    """Positions (nq,) at the start."""
    ctrl: np.ndarray
    """Controls (nu,) at the start: a keyframe's, or those that keep a task scene's start.

    Position actuators keep it, motors are idle."""
    key: int = -1
    """Keyframe from which speeds, activations and mocap bodies start too; −1: none."""
    scene: TaskScene | None = None
    """Task scene that it was composed of; None of a user's own model."""
    arm: Arm | None = None
    """Joints that move the robot's site; None without joints and of a user's own model."""
    opening: int | None = None
    """Actuator of the gap between two pads; None without one."""
    fingers: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """Addresses in ``qpos`` of the joints whose sum is that gap."""
    spec: mujoco.MjSpec | None = None
    """Spec of which the model was compiled, for pictures; None of a compiled model."""

    @cached_property
    def bodies(self) -> dict[str, TouchedBody]:
        """Touched bodies by name; soft ones are not MuJoCo's."""
        return {body.name: body for body in self.touched}

    @cached_property
    def sensor_specs(self) -> tuple[SensorSpec, ...]:
        return tuple(mounted.spec for mounted in self.sensors)

    def reset(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Put a state to the start; ``model`` is this one or another of the same names."""
        if self.key < 0:
            mujoco.mj_resetData(model, data)
        else:
            mujoco.mj_resetDataKeyframe(model, data, self.key)
        data.qpos[:], data.ctrl[:] = self.start, self.ctrl


def compiled_model(source: mujoco.MjSpec | mujoco.MjModel) -> mujoco.MjModel:
    """The model itself, or a spec's; raises ``InputError`` where MuJoCo refuses it."""
    if isinstance(source, mujoco.MjModel):
        return source
    try:
        return source.compile()
    except ValueError as error:
        raise InputError("spec", value=source.modelname, rule=f"MuJoCo refuses it: {' '.join(str(error).split())}") from error


def own_world_model(
    model: mujoco.MjModel,
    *,
    sensors: SensorChoice | None = None,
    touches: TouchChoice | None = None,
    control_timestep: float | None = None,
    keyframe: str | None = None,
    allow_overlap: Sequence[str] = (),
    own_contact: bool = True,
    spec: mujoco.MjSpec | None = None,
) -> WorldModel:
    """A user's own model, with its own start, options and controls.

    Args:
        model: compiled model; it is not changed.
        sensors: see ``mounted_sensors``; ``touches``: see ``touched_bodies``.
        control_timestep: of one step of the world [s], a whole multiple of the model's own; None is one of those.
        keyframe: the start; None is ``qpos0``.
        allow_overlap: geoms in which a gel may lie at the start.
        own_contact: pads push by the gel's law, and MuJoCo must not collide the gels; else it must, and pads only look.
        spec: what the model was compiled of, for pictures.

    Raises:
        InputError: no ``MjModel``, what those two refuse, a gel that collides or does not, an option with which pads cannot be stepped, a
            control step that is no multiple, an unknown keyframe, or a gel that lies deeper than 0.1 mm in another geom that collides (by
            MuJoCo's distance, of convex hulls).
        SpecError: a sensor's file is missing or wrong.

    With ``own_contact`` a ``RuntimeWarning`` names what moves as a mocap body.
    """
    if not isinstance(model, mujoco.MjModel):
        rule = "must be a mujoco.MjModel, of which the states are: model = spec.compile()"
        raise InputError("model", value=type(model).__name__, rule=rule)
    mounted = mounted_sensors(model, sensors)
    if own_contact:
        _check_options(model)
    _check_collisions(model, mounted, own_contact)
    touched, timestep = touched_bodies(model, touches, mounted), float(model.opt.timestep)
    if own_contact:
        _warn_of_mocap(model, mounted, touched)
    if control_timestep is None:
        control_timestep = timestep
    steps = check_number("control_timestep", control_timestep, "(0, 1]", "s") / timestep
    if round(steps) < 1 or abs(steps - round(steps)) > 1e-6:
        rule = f"must be a whole multiple of the model's timestep of {timestep:g} s"
        raise InputError("control_timestep", value=control_timestep, rule=rule)
    key, start, ctrl = -1, model.qpos0.copy(), np.zeros(model.nu)
    if keyframe is not None:
        names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, i) for i in range(model.nkey)]
        if keyframe not in names:
            rule = "must be a keyframe of the model" + ("" if model.nkey else ", which has none: add one by spec.add_key")
            raise InputError("keyframe", value=keyframe, rule=rule, choices=[name for name in names if name])
        key = names.index(keyframe)
        start, ctrl = model.key_qpos[key].copy(), model.key_ctrl[key].copy()
    kept = None if spec is None else spec.copy()
    result = WorldModel(model, mounted, touched, timestep, float(control_timestep), start, ctrl, key, spec=kept)
    _check_gels(result, allow_overlap)
    return result


def _check_options(model: mujoco.MjModel) -> None:
    """Refuse options under which a pad's contact would not act as its law says."""
    option = model.opt
    if option.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        rule = "takes no contacts between mj_step1 and mj_step2: set spec.option.integrator, or integrator= in the file"
        raise InputError("model.opt.integrator", value="RK4", rule=rule, choices=("Euler", "implicit", "implicitfast"))
    if option.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
        rule = (
            "makes a contact's stiffness depend on its friction, so that pads would not follow the gel's law: "
            "set spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC, or cone='elliptic' in the file"
        )
        raise InputError("model.opt.cone", value="pyramidal", rule=rule)
    if option.noslip_iterations:
        rule = "must be 0 (spec.option.noslip_iterations = 0): a gel sticks by its shear, which a noslip pass would undo"
        raise InputError("model.opt.noslip_iterations", value=int(option.noslip_iterations), rule=rule)
    for bit in ("CONTACT", "CONSTRAINT"):
        if option.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{bit}"):
            raise InputError("model.opt.disableflags", value=bit.lower(), rule="must not be disabled: the pads' contacts need it")
    for bit, why in (("OVERRIDE", "replaces the pads' stiffness by that of o_solref"), ("SLEEP", "lets bodies on pads sleep")):
        if option.enableflags & getattr(mujoco.mjtEnableBit, f"mjENBL_{bit}"):
            raise InputError("model.opt.enableflags", value=bit.lower(), rule=f"must not be enabled: it {why}")


def _check_collisions(model: mujoco.MjModel, sensors: Sequence[MountedSensor], own_contact: bool) -> None:
    for mounted in sensors:
        gel = model.geom(mounted.gel)
        collides = bool(gel.contype[0] or gel.conaffinity[0])
        if collides and own_contact:
            rule = "collides in MuJoCo, and its pad would push a second time: mount the sensor with collide=False"
            raise InputError("gel", value=mounted.gel, rule=rule)
        if not collides and not own_contact:
            rule = "must collide in MuJoCo, whose forces are read: mount the sensor with collide=True"
            raise InputError("gel", value=mounted.gel, rule=rule)


def _warn_of_mocap(model: mujoco.MjModel, sensors: Sequence[MountedSensor], touched: Sequence[TouchedBody]) -> None:
    """Warn of what is fixed to a mocap body, whose motion MuJoCo's contacts do not know."""
    bodies = {mounted.name: int(model.body(mounted.body).id) for mounted in sensors} | {body.name: body.index for body in touched}
    names = [name for name, body in bodies.items() if model.body_mocapid[model.body_weldid[body]] >= 0]
    if names:
        warnings.warn(
            f"{', '.join(map(repr, names))} moves as a mocap body, which has no velocity in MuJoCo: friction of a gel does not drag, and "
            "there is no force against what stands still. Give it a body with a free joint, welded to the mocap body",
            RuntimeWarning,
            stacklevel=4,
        )


def checked_states(
    own: mujoco.MjModel, model: mujoco.MjModel, data: mujoco.MjData | Sequence[mujoco.MjData], count: int
) -> list[mujoco.MjData]:
    """One state or several as a list; raises ``InputError`` unless ``count`` of ``own``."""
    if model is not own:
        raise InputError("model", value=type(model).__name__, rule="must be the model that this was made for")
    datas: list[Any] = [data] if isinstance(data, mujoco.MjData) else list(data)
    for one in datas:
        sizes = (len(one.qpos), len(one.xpos)) if isinstance(one, mujoco.MjData) else None
        if sizes != (own.nq, own.nbody):
            raise InputError("data", value=type(one).__name__, rule="must be a MjData of the model that this was made for")
    if len(datas) != count:
        raise InputError("data", value=len(datas), rule=f"must be {count} states, as num_envs says")
    return datas


def _check_gels(world: WorldModel, allowed: Sequence[str]) -> None:
    model = world.model
    if isinstance(allowed, str):
        allowed = (allowed,)
    for name in allowed:
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name) < 0:
            names = [model.geom(g).name for g in range(model.ngeom) if model.geom(g).name]
            raise InputError("allow_overlap", value=name, rule="must be the name of a geom of the model", choices=names)
    data = mujoco.MjData(model)
    world.reset(model, data)
    mujoco.mj_kinematics(model, data)
    touched = {geom for body in world.touched for geom in body.geoms}
    others = [
        g
        for g in np.flatnonzero((model.geom_contype != 0) | (model.geom_conaffinity != 0)).tolist()
        if g not in touched and model.geom(g).name not in allowed
    ]
    for mounted in world.sensors:
        gel, body = int(model.geom(mounted.gel).id), int(model.body(mounted.body).id)
        if mounted.gel in allowed:
            continue
        for geom in others:
            if model.geom_bodyid[geom] == body or _far(model, data, gel, geom):
                continue
            depth = -float(mujoco.mj_geomDistance(model, data, gel, geom, _OVERLAP, None))
            if depth > _OVERLAP:
                name = model.geom(geom).name or f"of {model.body(int(model.geom_bodyid[geom])).name or 'the world'}"
                rule = (
                    f"overlap by {depth * 1e3:.3g} mm at the start: move the sensor by pose=, remove the geom, or name it in "
                    "allow_overlap"
                )
                raise InputError("gel and geom", value=(mounted.gel, name), rule=rule)


def _far(model: mujoco.MjModel, data: mujoco.MjData, one: int, two: int) -> bool:
    """True where the bounding balls of two geoms are apart; a half-space has none."""
    radius = model.geom_rbound[[one, two]]
    return bool(radius.all() and np.linalg.norm(data.geom_xpos[one] - data.geom_xpos[two]) > radius.sum())
