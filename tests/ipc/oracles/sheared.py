"""A ball pressed into a block and moved along or turned, with friction, and the closed forms of Cattaneo, Mindlin and Deresiewicz."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import ipc
from tests.ipc.oracles.closed_forms import Elastic
from tests.ipc.oracles.meshes import ball_tool, even_block
from tests.ipc.oracles.presses import growth

SOLID = Elastic(1e5, 0.45)
CONTACT = 1e-3
"""Radius of the contact [m]."""
SPHERE = 10 * CONTACT
DEPTH = CONTACT**2 / SPHERE
MU = 0.5
D_HAT = 0.02 * CONTACT


@dataclass
class Sheared:
    """A world with a pressed ball; ``load`` is the normal force [N], shape ()."""

    world: ipc.World
    load: float

    @property
    def limit(self) -> float:
        """μ times the present normal force [N]."""
        return MU * -float(self.world.wrench("ball").force[0, 2]) * -1.0

    def pull(self, distance: float, steps: int) -> NDArray[np.float64]:
        """Tangential force [N] after each step of a straight move by ``distance`` [m] along x."""
        start = self.world.frame("ball")[1][0]
        forces = []
        for k in range(1, steps + 1):
            self.world.set_target("ball", start + [distance * k / steps, 0.0, 0.0])
            self.step()
            forces.append(-float(self.world.wrench("ball").force[0, 0]))
        return np.array(forces)

    def hold(self, steps: int) -> float:
        """Tangential force [N] after ``steps`` in which nothing is moved."""
        for _ in range(steps):
            self.step()
        return -float(self.world.wrench("ball").force[0, 0])

    def turn(self, angle: float, steps: int) -> NDArray[np.float64]:
        """Torque [N m] about the ball's axis after each step of a turn by ``angle`` [rad]."""
        torques = []
        for k in range(1, steps + 1):
            half = 0.5 * angle * k / steps
            self.world.set_target("ball", rotation=(np.cos(half), 0.0, 0.0, np.sin(half)))
            self.step()
            torques.append(-float(self.world.wrench("ball").torque[0, 2]))
        return np.array(torques)

    def step(self) -> None:
        report = self.world.step()
        if not report.converged[0]:
            raise ArithmeticError(f"a step did not converge: {report}")


def pressed_ball(cells: int = 3, reach: float = 6.0, friction: float = MU, **changes: Any) -> Sheared:
    """A ball pressed by ``DEPTH`` into a block that is bonded below and on its side, ``cells`` to the contact radius."""
    mesh, bonded = even_block(CONTACT, cells, growth(cells), reach * CONTACT)
    tool = ball_tool(1.6 * CONTACT, round(3.2 * cells), SPHERE)
    block = ipc.SoftBody("block", mesh, ipc.Material(SOLID.young, SOLID.poisson), bonded=bonded)
    options: dict[str, Any] = {"dt": 0.01, "d_hat": D_HAT, "friction": friction, "velocity_tolerance": 1e-5} | changes
    ball = ipc.KinematicBody("ball", tool, ipc.Pose((0.0, 0.0, 1.01 * D_HAT)))
    result = Sheared(ipc.World([block, ball], ipc.Settings(**options), device="cpu"), 0.0)
    for k in range(1, 6):
        result.world.set_target("ball", (0.0, 0.0, D_HAT - k / 5 * DEPTH))
        result.step()
    result.load = float(result.world.wrench("ball").force[0, 2])
    return result


def mindlin_stiffness(solid: Elastic, radius: float) -> float:
    """8 G a/(2 − ν), of a half-space under a disc that sticks [N/m] (Johnson 1985, eq. 7.42 with a rigid upper body)."""
    return 8 * solid.shear * radius / (2 - solid.poisson)


def mindlin_displacement(share: ArrayLike, limit: float, stiffness: float) -> NDArray[np.float64]:
    """Displacement [m] under the ``share`` T/(μP): 3 μP/(2 k) (1 − (1 − T/μP)^(2/3)) (Johnson 1985, eq. 7.42)."""
    return 1.5 * limit / stiffness * (1 - (1 - np.asarray(share, np.float64)) ** (2 / 3))
