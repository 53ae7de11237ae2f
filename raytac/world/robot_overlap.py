"""Bodies of the contact solver that lie inside a case or a link: the solver has neither, so nothing stops them, and someone must say so."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from raytac.physics.geoms import geom_part
from raytac.shapes.point_depth import SOLIDS, point_depth
from raytac.world.compose import ComposedScene

__all__ = ["Inside", "RobotOverlap"]

_REACH = 1e-6
"""Only overlap matters: distances beyond this [m] are not looked for."""


@dataclass(frozen=True)
class Inside:
    """A body that lies inside the robot."""

    body: str
    geom: str
    """Of the robot; one without a name is called by its body's."""
    depth: float
    """[m]."""


class RobotOverlap:
    """Looks where the solver's bodies are against everything of the robot that collides in MuJoCo: cases, links, holders.

    Rigid bodies are looked at as MuJoCo mirrors them, meshes by their convex hulls; of soft ones, the surface's vertices, against boxes,
    balls, capsules, cylinders and half-spaces of the robot.
    """

    def __init__(self, composed: ComposedScene) -> None:
        self.model = model = composed.model
        scene = {body.index for body in composed.bodies.values()}
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        self.robot = np.array([g for g in np.flatnonzero(solid) if int(model.geom_bodyid[g]) not in scene], int)
        self.mirrors = {
            body.spec.name: np.arange(model.body_geomnum[body.index]) + model.body_geomadr[body.index]
            for body in composed.bodies.values()
            if body.mocap >= 0
        }
        known = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")) for kind in SOLIDS}
        self._parts = {int(g): geom_part(model, int(g)) for g in self.robot if int(model.geom_type[g]) in known}

    def rigid(self, data: mujoco.MjData) -> list[Inside]:
        """Mirrored bodies inside the robot at the present poses (after ``mj_kinematics``)."""
        found, radius = [], self.model.geom_rbound
        for name, geoms in self.mirrors.items():
            for mine in geoms:
                far = np.linalg.norm(data.geom_xpos[self.robot] - data.geom_xpos[mine], axis=1)
                near = (far < radius[self.robot] + radius[mine]) | (radius[self.robot] == 0.0)
                for geom in self.robot[near]:
                    distance = mujoco.mj_geomDistance(self.model, data, int(mine), int(geom), _REACH, None)
                    if distance < 0.0:
                        found.append(Inside(name, self._name(int(geom)), -float(distance)))
        return found

    def soft(self, data: mujoco.MjData, name: str, vertices: np.ndarray) -> list[Inside]:
        """A soft body inside the robot, by its surface's vertices (n, 3) [m], world frame."""
        found = []
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
                found.append(Inside(name, self._name(geom), depth))
        return found

    def _name(self, geom: int) -> str:
        return self.model.geom(geom).name or f"of {self.model.body(int(self.model.geom_bodyid[geom])).name or 'the world'}"
