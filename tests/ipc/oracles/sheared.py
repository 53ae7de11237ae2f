"""A ball pressed into a block and moved along or turned, with friction, and the closed forms of Cattaneo, Mindlin and Lubkin."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ellipe, ellipk

import ipc
from tests.ipc.oracles.closed_forms import Elastic
from tests.ipc.oracles.meshes import ball_tool, even_block
from tests.ipc.oracles.presses import growth

Floats = NDArray[np.float64]

SOLID = Elastic(1e5, 0.45)
CONTACT = 1e-3
"""Radius of the contact after Hertz [m]."""
SPHERE = 10 * CONTACT
DEPTH = CONTACT**2 / SPHERE
MU = 0.5
D_HAT = 0.02 * CONTACT
FULL_TWIST = 3 * np.pi / 16
"""Torque over μ P a of a contact that turns as a whole."""


class Sheared:
    """A ball of radius ``SPHERE`` pressed by ``DEPTH`` into a bonded block, ``cells`` of its mesh to the contact radius.

    Args:
        reach: radius and height of the block in contact radii.
        friction: μ.
        changes: of the settings.
    """

    def __init__(self, cells: int = 3, reach: float = 6.0, friction: float = MU, **changes: Any) -> None:
        mesh, bonded = even_block(CONTACT, cells, growth(cells), reach * CONTACT)
        tool = ball_tool(1.6 * CONTACT, round(3.2 * cells), SPHERE)
        block = ipc.SoftBody("block", mesh, ipc.Material(SOLID.young, SOLID.poisson), bonded=bonded)
        options: dict[str, Any] = {"d_hat": D_HAT, "friction": friction, "velocity_tolerance": 1e-5} | changes
        ball = ipc.KinematicBody("ball", tool, ipc.Pose((0.0, 0.0, 1.01 * D_HAT)))
        self.world = ipc.World([block, ball], ipc.Settings(**options), device="cpu")
        for k in range(1, 6):
            self.world.set_target("ball", (0.0, 0.0, D_HAT - k / 5 * DEPTH))
            self._step()
        self.worst = 0.0
        """Largest ratio of the tangential to the normal force over all steps since."""

    def load(self) -> float:
        """Normal force [N]."""
        return float(self.world.wrench("ball").force[0, 2])

    def pull(self, distance: float, steps: int) -> Floats:
        """Tangential over normal force after each step of a straight move by ``distance`` [m] along x."""
        start, shares = self.world.frame("ball")[1][0], []
        for k in range(1, steps + 1):
            self.world.set_target("ball", start + distance * k / steps * np.array([1.0, 0.0, 0.0]))
            self._step()
            force = self.world.wrench("ball").force[0]
            shares.append(-force[0] / force[2])
            self.worst = max(self.worst, float(np.hypot(force[0], force[1]) / force[2]))
        return np.array(shares)

    def turn(self, angle: float, steps: int) -> Floats:
        """Torque about the ball's axis [N m] after each step of a turn by ``angle`` [rad]."""
        torques = []
        for k in range(1, steps + 1):
            half = 0.5 * angle * k / steps
            self.world.set_target("ball", rotation=(np.cos(half), 0.0, 0.0, np.sin(half)))
            self._step()
            torques.append(-float(self.world.wrench("ball").torque[0, 2]))
        return np.array(torques)

    def _step(self) -> None:
        report = self.world.step()
        if not report.converged[0]:
            raise ArithmeticError(f"a step did not converge: {report}")


@dataclass(frozen=True)
class Contact:
    """What the closed forms take from a mesh: the load, and the stiffnesses of the contact while all of it sticks.

    Attributes:
        load: P [N].
        shear: tangential stiffness [N/m].
        twist: stiffness against a turn [N m/rad].
    """

    load: float
    shear: float
    twist: float

    @cached_property
    def radius(self) -> float:
        """a of Hertz's contact under the load [m]."""
        return float((0.75 * self.load * SPHERE / SOLID.plane_strain) ** (1 / 3))

    def pulled(self, distance: ArrayLike) -> Floats:
        """T/(μP) at displacements [m]: u = 3 μP/(2 k) (1 − (1 − T/μP)^(2/3)), k = 8 G a/(2 − ν) (Johnson 1985, eq. 7.42).

        What the block's sides, base and mesh add to the compliance 1/k of the half-space is in series with it.
        """
        k, limit, share = 8 * SOLID.shear * self.radius / (2 - SOLID.poisson), MU * self.load, np.linspace(0.0, 1.0, 2001)
        u = 1.5 * limit / k * (1 - (1 - share) ** (2 / 3)) + limit * share * (1 / self.shear - 1 / k)
        return np.interp(np.asarray(distance, float), u, share)

    def turned(self, angle: ArrayLike) -> Floats:
        """M over that of full slip, 3π/16 μPa, at angles [rad], in series as ``pulled``.

        While a disc of radius c sticks, β = 3 μP/(4π G a²) (K − E), K and E of the modulus k' = √(1 − c²/a²) (Lubkin 1951; Johnson 1985,
        section 7.4). M is the sum of the torques 16/3 G s³ dβ(s) of discs that turn with radii s from c to a, since the tractions of
        such discs add up to those of the annulus that slips.
        """
        a, limit, s = self.radius, MU * self.load, np.linspace(1.0, 0.0, 4001)[:-1] ** 2
        rest = 1 - s**2
        lubkin = 3 * limit / (4 * np.pi * SOLID.shear * a**2) * (ellipk(rest) - ellipe(rest))
        steps = np.diff(lubkin) * ((s[1:] + s[:-1]) / 2 * a) ** 3
        torque = 16 / 3 * SOLID.shear * np.concatenate([[0.0], np.cumsum(steps)])
        beta = lubkin + torque * (1 / self.twist - 3 / (16 * SOLID.shear * a**3))
        return np.interp(np.asarray(angle, float), beta, torque / (FULL_TWIST * limit * a))


def sticking(cells: int = 3, reach: float = 6.0) -> Contact:
    """Load and stiffnesses of the mesh, from small motions with a friction of 20."""
    options: dict[str, Any] = {"velocity_tolerance": 1e-9, "linear_tolerance": 1e-5, "friction_tolerance": 1e-3}
    pressed = Sheared(cells, reach, 20.0, **options)
    load, distance, angle = pressed.load(), 1e-6, 1e-3
    before, after = pressed.pull(0.0, 2)[-1], pressed.pull(distance, 2)[-1]
    pressed.pull(-distance, 2)
    torque, turned = pressed.turn(0.0, 2)[-1], pressed.turn(angle, 2)[-1]
    return Contact(load, float(after - before) * load / distance, float(turned - torque) / angle)
