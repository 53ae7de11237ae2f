"""Bodies of a MuJoCo model that pads may touch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from raytac.checks import check_number
from raytac.errors import InputError
from raytac.physics.geoms import geom_part
from raytac.robots.mount import MountedSensor
from raytac.se3 import pose_of
from raytac.shapes.part import Part, mesh_part

TouchChoice = Sequence[str] | Mapping[str, float | None]
"""Names of bodies or geoms that pads touch; a mapping has friction, None the gel's own."""


@dataclass(frozen=True)
class TouchedBody:
    """A body that pads may touch, or one geom of it."""

    name: str
    index: int
    """Body in the model."""
    parts: tuple[Part, ...]
    """Shape that pads sense, body frame [m]."""
    friction: float | None
    """Coulomb coefficient against gel; None: the gel's own."""
    geoms: tuple[int, ...]
    """Geoms of the model that have this shape."""
    members: tuple[int, ...]
    """The body and those that are fixed to it, which move as one."""
    qpos: int
    """Address of its free joint's seven positions, else −1."""
    mocap: int = -1
    """Index into ``mocap_pos`` of a body that is placed from outside, else −1."""

    @property
    def is_free(self) -> bool:
        """True if a free joint moves it."""
        return self.qpos >= 0

    @property
    def is_placed(self) -> bool:
        """True if a start can put it anywhere."""
        return self.is_free or self.mocap >= 0

    @property
    def is_plane(self) -> bool:
        """True for a half-space, which is unbounded."""
        return self.parts[0].kind == "plane"

    @classmethod
    def of(
        cls, model: mujoco.MjModel, name: str, index: int, parts: tuple[Part, ...], friction: float | None, geoms: Sequence[int]
    ) -> TouchedBody:
        """The body of that index, with the joint and the fixed bodies that it has."""
        members = tuple(fixed_bodies(model, index))
        return cls(name, index, parts, friction, tuple(geoms), members, _free_joint(model, index), int(model.body_mocapid[index]))


def touched_bodies(
    model: mujoco.MjModel, touches: TouchChoice | None, sensors: Sequence[MountedSensor]
) -> tuple[TouchedBody, ...]:
    """Bodies of a compiled model that pads touch.

    A body is sensed by its geoms that collide in MuJoCo, so that pads and the rest of the model meet the same shape, with those of bodies
    that are fixed to it; a mesh keeps its own triangles. A name that no body has is that of one geom, which may be one that is only looked
    at, as the finer shape often is.

    Args:
        touches: names of bodies or geoms; None is every body with a free joint that has a geom that collides and carries no sensor.

    Raises:
        InputError: a name that no body and no geom has or that comes twice, a body that is part of a sensor or fixed to it, no geom that
            collides, a half-space among other geoms, a mesh that is not closed, a friction coefficient outside [0, 10], or no body at all.
    """
    carried = [int(model.body(sensor.body).id) for sensor in sensors]
    if touches is None:
        carriers = {ancestor for body in carried for ancestor in _ancestors(model, body)}
        free = [b for b in range(1, model.nbody) if _free_joint(model, b) >= 0 and b not in carriers and _colliding(model, b)]
        if not free:
            rule = "must name what the pads touch: the model has no body with a free joint and a geom that collides"
            raise InputError("touches", value=None, rule=rule, choices=_names(model, "BODY"))
        return tuple(_touched(model, model.body(b).name or f"body{b}", b, None) for b in free)
    if isinstance(touches, str) or not isinstance(touches, (Sequence, Mapping)):
        rule = "must be names of bodies or geoms, such as ['cube'], or a mapping of them to friction coefficients"
        raise InputError("touches", value=touches, rule=rule)
    if not touches:
        rule = "must name one body or more; None is every body with a free joint"
        raise InputError("touches", value=touches, rule=rule, choices=_names(model, "BODY"))
    result: list[TouchedBody] = []
    for name in touches:
        body, geom = _find(model, name)
        if body in carried or (body and model.body_weldid[body] in model.body_weldid[carried]):
            sensor = sensors[next(i for i, b in enumerate(carried) if model.body_weldid[b] == model.body_weldid[body])].name
            raise InputError("touches", value=name, rule=f"must not be part of the sensor {sensor!r} or of what carries it")
        one = _touched(model, name, body, geom)
        for other in result:
            if set(one.geoms) & set(other.geoms):
                raise InputError("touches", value=name, rule=f"has a geom that {other.name!r} has already")
        friction = touches[name] if isinstance(touches, Mapping) else None
        if friction is not None:
            one = replace(one, friction=check_number(f"touches[{name!r}]", friction, "[0, 10]"))
        result.append(one)
    return tuple(result)


def _touched(model: mujoco.MjModel, name: str, body: int, geom: int | None) -> TouchedBody:
    geoms = _colliding(model, body) if geom is None else [geom]
    if not geoms:
        own = _geoms(model, body)
        there = [model.geom(g).name for g in own if model.geom(g).name]
        rule = "has no geom that collides: name the geoms that are its shape" if own else "has no geom"
        raise InputError("touches", value=name, rule=rule, choices=there)
    parts = tuple(_in_body(model, body, g, _solid(name, model.geom(g).name or f"geom{g}", geom_part(model, g))) for g in geoms)
    if len(parts) > 1 and any(part.kind == "plane" for part in parts):
        named = [model.geom(g).name for g in geoms if model.geom(g).name]
        raise InputError("touches", value=name, rule="has a half-space among other geoms: name the geoms", choices=named)
    return TouchedBody.of(model, name, body, parts, None, geoms)


def fixed_bodies(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and all below it that no joint moves against it; of the world the world alone."""
    below = [b for b in range(body + 1, model.nbody) if body and model.body_weldid[b] == model.body_weldid[body]]
    return [body, *(b for b in below if body in _ancestors(model, b))]


def _geoms(model: mujoco.MjModel, body: int) -> list[int]:
    return np.flatnonzero(np.isin(model.geom_bodyid, fixed_bodies(model, body))).tolist()


def _colliding(model: mujoco.MjModel, body: int) -> list[int]:
    return [g for g in _geoms(model, body) if model.geom_contype[g] or model.geom_conaffinity[g]]


def _in_body(model: mujoco.MjModel, body: int, geom: int, part: Part) -> Part:
    """The part in the frame of ``body``, which its geom's body is or is fixed to."""
    pose, at = part.object_from_part, int(model.geom_bodyid[geom])
    while at != body:
        pose, at = pose_of(model.body_pos[at], model.body_quat[at]) @ pose, int(model.body_parentid[at])
    return part if pose is part.object_from_part else replace(part, object_from_part=pose)


def _solid(name: str, geom: str, part: Part) -> Part:
    """The part; a mesh whose corners coincide without being one gets them joined."""
    if part.kind != "mesh" or part.closed:
        return part
    assert part.vertices is not None and part.faces is not None
    vertices, index = np.unique(part.vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[part.faces]
    corners = np.sort(faces, axis=1)
    joined = mesh_part(vertices, faces[(np.diff(corners, axis=1) > 0).all(axis=1)], part.object_from_part)
    if not joined.closed:
        rule = (
            f"its geom {geom!r} is a mesh that is not closed: every edge must join two faces of one orientation. "
            "Mend the mesh, or name other geoms of the body"
        )
        raise InputError("touches", value=name, rule=rule)
    return joined


def _find(model: mujoco.MjModel, name: object) -> tuple[int, int | None]:
    """Body of a name, or geom of it and its body."""
    if isinstance(name, str):
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        if body >= 0:
            return body, None
        geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
        if geom >= 0:
            return int(model.geom_bodyid[geom]), geom
    choices = [*_names(model, "BODY"), *_names(model, "GEOM")]
    raise InputError("touches", value=name, rule="must be the name of a body or a geom of the model", choices=choices)


def _names(model: mujoco.MjModel, kind: str) -> list[str]:
    count, what = (model.nbody if kind == "BODY" else model.ngeom), getattr(mujoco.mjtObj, f"mjOBJ_{kind}")
    return [name for name in (mujoco.mj_id2name(model, what, i) for i in range(count)) if name]


def _free_joint(model: mujoco.MjModel, body: int) -> int:
    joint = int(model.body_jntadr[body])
    return int(model.jnt_qposadr[joint]) if joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE else -1


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and all that it hangs on, without the world."""
    result = []
    while body > 0:
        result.append(body)
        body = int(model.body_parentid[body])
    return result
