"""Overlaps that no world may have: at its start, and of soft pads' bodies with the robot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from raytac.errors import InputError
from raytac.physics.geoms import geom_part
from raytac.robots.states import StateReader, numbers
from raytac.shapes.point_depth import SOLIDS, point_depth
from raytac.world.world_model import WorldModel

_REACH = 1e-6
"""Greatest distance that MuJoCo reports [m]; only overlap matters."""
_OVERLAP = 1e-4
"""Greatest overlap of rigid bodies at the start [m]: rounding of a scene's lengths."""


def check_start(composed: WorldModel, data: mujoco.MjData, overlaps: Sequence[tuple[str, str, float]]) -> None:
    """Raise ``InputError`` for a start ``data`` in which bodies overlap.

    ``overlaps``: sensor, body and depth [m]. A user's own model may start in contact, but not through a pad.
    """
    model, scene = composed.model, composed.scene
    for contact in data.contact[: data.ncon]:
        if contact.dist < -_OVERLAP and scene is not None:
            names = [model.body(int(model.geom_bodyid[g])).name or "world" for g in contact.geom]
            rule = f"overlap by {-contact.dist * 1e3:.3g} mm at the start: move one of them in the scene"
            raise InputError("bodies", value=tuple(names), rule=rule)
    for sensor, body, depth in overlaps:
        if depth > (_OVERLAP if scene is not None else np.inf) or np.isinf(depth):
            rule = f"must not be pressed into the pad of {sensor!r} at the start; it is, by {depth * 1e3:.3g} mm"
            if np.isinf(depth):
                large = _size_if_large(composed, body)
                rule = f"must not start beyond the face that the gel of {sensor!r} is bonded to{large}"
            raise InputError("body", value=body, rule=rule)


def _size_if_large(composed: WorldModel, name: str) -> str:
    """End of a message: the diameter of a body's largest geom, if it is beyond 1 m."""
    geoms = list(composed.bodies[name].geoms)
    size = 2.0 * float(composed.model.geom_rbound[geoms].max(initial=0.0))
    return f"; it is {size:.3g} m large: are its units metres?" if size > 1.0 else ""


@dataclass(frozen=True)
class Inside:
    """Body of the solver that lies inside the robot."""

    body: str
    geom: str
    """Geom of the robot; one without a name has that of its body."""
    depth: float
    """Depth of the overlap [m]."""


class RobotOverlap:
    """Overlap of the solver's bodies with the robot's colliding geoms: cases, links, holders.

    The solver has neither cases nor links, so that nothing stops these bodies. Rigid ones are checked at the poses that MuJoCo mirrors,
    meshes by their convex hulls. Soft ones are checked by their surface's vertices, against boxes, balls, capsules, cylinders and
    half-spaces of the robot.
    """

    def __init__(self, composed: WorldModel, datas: Sequence[mujoco.MjData]) -> None:
        """``datas``: states of all environments."""
        self.model = model = composed.model
        self._datas = tuple(datas)
        scene = {body.index for body in composed.touched}
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        self._robot = np.array([g for g in np.flatnonzero(solid) if int(model.geom_bodyid[g]) not in scene], int)
        mirrored = [(body.name, int(g)) for body in composed.touched if body.mocap >= 0 for g in body.geoms]
        self._names, self._own = [name for name, _ in mirrored], np.array([g for _, g in mirrored], int)
        radius = model.geom_rbound
        self._reach = radius[self._own, None] + radius[self._robot]
        self._reach[:, radius[self._robot] == 0.0] = np.inf  # a half-space
        places = 3 * np.concatenate([self._own, self._robot])[:, None] + np.arange(3)
        self._places = StateReader(self._datas, {"places": numbers("geom_xpos", places)}) if self._reach.size else None
        known = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")) for kind in SOLIDS}
        self._parts = {int(g): geom_part(model, int(g)) for g in self._robot if int(model.geom_type[g]) in known}

    def rigid(self, envs: Sequence[int] | range | np.ndarray) -> Iterator[tuple[int, Inside]]:
        """Mirrored bodies inside the robot, by environment, at the present poses.

        After ``mj_kinematics``.
        """
        if self._places is None:
            return
        chosen, own = np.asarray(envs, int), len(self._own)
        places = self._places.values()["places"][chosen]
        near = np.linalg.norm(places[:, :own, None] - places[:, None, own:], axis=3) < self._reach
        for row, k, geom in np.argwhere(near).tolist():
            b, robot = int(chosen[row]), int(self._robot[geom])
            gap = mujoco.mj_geomDistance(self.model, self._datas[b], int(self._own[k]), robot, _REACH, None)
            if gap < 0.0:
                yield b, Inside(self._names[k], self._name(robot), -float(gap))

    def soft(self, env: int, name: str, vertices: np.ndarray) -> list[Inside]:
        """Overlaps of a soft body with the robot, by its surface's vertices (n, 3) [m], world frame."""
        result, data = [], self._datas[env]
        middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        reach = float(np.linalg.norm(vertices - middle, axis=1).max())
        for geom, part in self._parts.items():
            radius = self.model.geom_rbound[geom]
            if radius > 0.0 and np.linalg.norm(data.geom_xpos[geom] - middle) > radius + reach:
                continue
            body = int(self.model.geom_bodyid[geom])
            local = (vertices - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
            depth = float(point_depth(part, local).max())
            if depth > 0.0:
                result.append(Inside(name, self._name(geom), depth))
        return result

    def _name(self, geom: int) -> str:
        return self.model.geom(geom).name or f"of {self.model.body(int(self.model.geom_bodyid[geom])).name or 'the world'}"
