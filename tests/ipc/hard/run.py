"""Runs of hard cases: the worst figures over their steps, and checks of their outcome."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import ipc
from tests.ipc.hard.oracle import Oracle
from tests.ipc.hard.shapes import as_surface

D_HAT = 1e-4
MAX_NEWTON = 200
"""Newton iterations a solve may take; a step is one solve, and up to two more as friction is renewed."""
G = 9.81
FINE = 1e-6
"""Velocity tolerance [m/s] for light bodies on stiff barriers: there a force changes by its own size over a micrometre."""


@dataclass(frozen=True)
class Setup:
    """Device of a case, and finer meshes and more turns for the twists."""

    device: str = "cpu"
    large: bool = False


@dataclass
class Worst:
    """Worst figures over the steps of a case, and its last state."""

    world: ipc.World | None = None
    min_gap: float = math.inf
    min_det: float = math.inf
    max_newton: int = 0
    newton: int = 0
    """Newton iterations of all steps."""
    unconverged: int = 0
    jams: bool = False
    """True if steps may end without having converged: what moves is pushed against what cannot yield."""
    steps: int = 0
    blocked: float = 0.0
    touched: int = 0
    finite: bool = True
    crossed: int = 0
    """States in which surfaces cross or touch, by :meth:`ipc.World.overlap`, of all steps and environments."""
    crossed_by_oracle: int = 0
    """The same by ipctk, which also looks at bodies that do not look at themselves."""
    notes: list[str] = field(default_factory=list)
    _oracle: Oracle | None = field(default=None, repr=False, compare=False)

    def add(self, world: ipc.World, report: ipc.StepReport) -> None:
        """Take in one step."""
        if self.world is not world or self._oracle is None:
            self.world, self._oracle = world, Oracle(world)
        self.min_gap = min(self.min_gap, float(report.min_gap.min()))
        self.min_det = min(self.min_det, float(report.min_det.min()), self._oracle.least_det())
        self.max_newton = max(self.max_newton, int(report.newton.max()))
        self.newton += int(report.newton.max())
        self.unconverged += int((~report.converged).sum())
        self.blocked = max(self.blocked, float(report.blocked.max()))
        self.touched += bool(report.pairs.any())
        self.steps += 1
        self.finite &= not report.failed.any()
        self.crossed += sum(world.overlap(env) is not None for env in range(world.num_envs))
        self.crossed_by_oracle += self._oracle.crossed()
        for body in world.bodies:
            if not isinstance(body, ipc.HalfSpace):
                self.finite &= bool(np.isfinite(world.positions(body.name)).all())

    def include(self, other: Worst, where: str) -> None:
        """Take in a run of the same case; ``where`` says which."""
        self.world, self.jams = other.world, other.jams
        self.min_gap, self.min_det = min(self.min_gap, other.min_gap), min(self.min_det, other.min_det)
        self.max_newton, self.blocked = max(self.max_newton, other.max_newton), max(self.blocked, other.blocked)
        self.newton += other.newton
        self.unconverged += other.unconverged
        self.steps += other.steps
        self.touched += other.touched
        self.crossed += other.crossed
        self.crossed_by_oracle += other.crossed_by_oracle
        self.finite &= other.finite
        self.notes += [f"{note} {where}" for note in other.notes]

    def expect(self, so: object, note: str) -> Worst:
        """Note what did not come about."""
        if not so:
            self.notes.append(note)
        return self

    def passed(self) -> bool:
        """True if surfaces stayed apart and elements upright after every step, steps converged within their iterations (unless the case
        ``jams``), and what was expected came about."""
        sound = self.finite and self.crossed == self.crossed_by_oracle == 0 and self.min_gap > 0 and self.min_det > 0
        return sound and (self.jams or self.unconverged == 0) and not self.notes


class Mechanics:
    """Laws of every converged step of backward Euler: a free body's momentum changes by gravity and its contact forces alone, and,
    where nothing is driven, the energy of all bodies never rises by more than the elastic slip of contacts can give back.

    A contact with the limit μλ stores μλ (f0(ε) − f0(0)) = 2/3 ε μλ when it yields, which is not among the reported energies.

    Args:
        world: one environment, before its first step; soft bodies without damping, at rest in shape.
        driven: whether something is moved by order.
    """

    def __init__(self, world: ipc.World, driven: bool) -> None:
        self._world, self._driven = world, driven
        moving = [b for b in world.bodies if isinstance(b, ipc.SoftBody | ipc.AffineBody)]
        self._names = [b.name for b in moving]
        self._free = [b.name for b in moving if (not len(b.bonded) if isinstance(b, ipc.SoftBody) else b.drive == 0)]
        self._gravity = np.array(world.settings.gravity)
        self._motion = self._motions()
        self._kinetic = sum(0.5 * m.mass * float((m.velocity[0] ** 2).sum()) for m in self._motion.values())
        self._energy = self._kinetic + self._potential() + Oracle(world).barrier_energy()
        self._stored = 0.0
        self._size = 0.0
        self.force_error = 0.0
        """Largest force that is missing, over the largest sum of contact force sizes and weight of a body so far."""
        self.energy_rise = 0.0
        """Largest rise of the energy in a step, over the largest kinetic energy so far."""

    def _motions(self) -> dict[str, ipc.RigidMotion]:
        return {name: self._world.rigid_motion(name) for name in self._names}

    def _potential(self) -> float:
        return -sum(m.mass * float(self._gravity @ m.centre[0]) for m in self._motion.values())

    def add(self, report: ipc.StepReport) -> None:
        """Take in one step; one that has not converged is only gone over."""
        before, self._motion = self._motion, self._motions()
        energy = float(report.kinetic[0] + report.elastic[0] + report.barrier[0]) + self._potential()
        settings, normal = self._world.settings, float(self._world.contacts().force.sum())
        stored = 2 / 3 * settings.friction_slip * settings.friction * normal
        rise, self._energy = energy - self._energy - max(stored, self._stored), energy
        self._stored = stored
        self._kinetic = max(self._kinetic, float(report.kinetic[0]))
        if not report.converged[0] or report.halved[0]:  # of a step in halves the forces are those of its last part
            return
        for name in self._free:
            forces, mass = self._world.contact_forces(name)[0], self._motion[name].mass
            change = mass * (self._motion[name].velocity[0] - before[name].velocity[0]) / self._world.settings.dt
            missing = float(np.linalg.norm(change - mass * self._gravity - forces.sum(axis=0)))
            least = mass * settings.velocity_tolerance / settings.dt  # what the tolerance leaves open where nothing acts yet
            weight = mass * float(np.linalg.norm(self._gravity))
            self._size = max(self._size, least, float(np.linalg.norm(forces, axis=1).sum()) + weight)
            self.force_error = max(self.force_error, missing / self._size)
        if not self._driven and rise > 0:
            self.energy_rise = max(self.energy_rise, rise / self._kinetic)


def run(
    world: ipc.World, steps: int, each: Callable[[int], None] | None = None, driven: bool = False, jams: bool = False
) -> Worst:
    """Step and keep the worst figures; ``driven`` where ``each`` moves something, ``jams`` where steps may fail to converge."""
    worst, mechanics = Worst(jams=jams), Mechanics(world, driven)
    for k in range(steps):
        if each is not None:
            each(k)
        report = world.step()
        worst.add(world, report)
        mechanics.add(report)
    # Where gaps are far below what Newton's tolerance moves a point, forces are not balanced to a share of themselves.
    note = f"momentum changed by a force that is not there, {mechanics.force_error:.3g} of the forces"
    worst.expect(jams or mechanics.force_error < 0.05, note)
    worst.expect(mechanics.energy_rise < 1e-9, f"energy rose by {mechanics.energy_rise:.3g} of the kinetic energy")
    return worst.expect(worst.touched, "nothing touched")


def world_of(bodies: list[ipc.Body], setup: Setup, **settings: Any) -> ipc.World:
    """A world with the settings of the cases; ``settings`` differ."""
    options: dict[str, Any] = {"dt": 0.01, "gravity": (0, 0, -G), "d_hat": D_HAT, "max_newton": MAX_NEWTON, "friction": 0.1}
    return ipc.World(bodies, ipc.Settings(**(options | settings)), device=setup.device)


def solid(
    name: str,
    mesh: ipc.TetMesh,
    soft: bool,
    young: float = 1e6,
    density: float = 1000.0,
    stiffness: float = 1e8,
) -> ipc.Body:
    """The same tetrahedra as a soft body of that Young's modulus [Pa], or as an affine one of that stiffness [Pa]."""
    if soft:
        return ipc.SoftBody(name, mesh, ipc.Material(young, 0.4, density))
    return ipc.AffineBody(name, as_surface(mesh), ipc.Stiff(stiffness, density))


def mass(mesh: ipc.TetMesh, density: float = 1000.0) -> float:
    """[kg]."""
    x = mesh.vertices[mesh.tets]
    return float(density * np.linalg.det(x[:, 1:] - x[:, :1]).sum() / 6)


def carries(worst: Worst, name: str, weight: float) -> Worst:
    """Expect the force on body ``name`` to be a weight [N], to 1 %."""
    assert worst.world is not None
    force = -float(worst.world.wrench(name).force[0, 2])
    return worst.expect(abs(force / weight - 1) < 0.01, f"{name} carries {force:.4g} N of {weight:.4g} N")
