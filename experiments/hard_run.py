"""How a hard case is run and judged: the worst figures over its steps, and what must have come about."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import ipc

D_HAT = 1e-4
MAX_NEWTON = 200
"""Newton iterations a solve may take; a step is one solve, and up to two more as friction is renewed."""
G = 9.81


@dataclass(frozen=True)
class Setup:
    """Where a case runs, and whether the twists have finer meshes and more turns."""

    device: str = "cpu"
    large: bool = False


@dataclass
class Worst:
    """Worst figures over the steps of a case, and its last state."""

    world: ipc.World | None = None
    min_gap: float = math.inf
    min_det: float = math.inf
    max_newton: int = 0
    unconverged: int = 0
    steps: int = 0
    blocked: float = 0.0
    touched: int = 0
    finite: bool = True
    notes: list[str] = field(default_factory=list)

    def add(self, world: ipc.World, report: ipc.StepReport) -> None:
        """Take in one step."""
        self.world = world
        self.min_gap = min(self.min_gap, float(report.min_gap.min()))
        self.min_det = min(self.min_det, float(report.min_det.min()))
        self.max_newton = max(self.max_newton, int(report.newton.max()))
        self.unconverged += int((~report.converged).sum())
        self.blocked = max(self.blocked, float(report.blocked.max()))
        self.touched += bool(report.pairs.any())
        self.steps += 1
        self.finite &= not report.failed.any()
        for body in world.bodies:
            if not isinstance(body, ipc.HalfSpace):
                self.finite &= bool(np.isfinite(world.positions(body.name)).all())

    def expect(self, so: object, note: str) -> Worst:
        """Note what did not come about."""
        if not so:
            self.notes.append(note)
        return self

    def passed(self) -> bool:
        """Whether gaps stayed open and elements upright, every step converged within its iterations, and what was expected came about."""
        return self.finite and self.min_gap > 0 and self.min_det > 0 and self.unconverged == 0 and not self.notes


def run(world: ipc.World, steps: int, each: Callable[[int], None] | None = None) -> Worst:
    """Step and keep the worst figures."""
    worst = Worst()
    for k in range(steps):
        if each is not None:
            each(k)
        worst.add(world, world.step())
    return worst.expect(worst.touched, "nothing touched")


def world_of(bodies: list[ipc.Body], setup: Setup, **settings: Any) -> ipc.World:
    """A world with the settings of the cases; ``settings`` differ."""
    options: dict[str, Any] = {"dt": 0.01, "gravity": (0, 0, -G), "d_hat": D_HAT, "max_newton": MAX_NEWTON, "friction": 0.1}
    return ipc.World(bodies, ipc.Settings(**(options | settings)), device=setup.device)


def mass(mesh: ipc.TetMesh, density: float = 1000.0) -> float:
    """[kg]."""
    x = mesh.vertices[mesh.tets]
    return float(density * np.linalg.det(x[:, 1:] - x[:, :1]).sum() / 6)


def carries(worst: Worst, name: str, weight: float) -> Worst:
    """Expect the force on body ``name`` to be a weight [N], to 1 %."""
    assert worst.world is not None
    force = -float(worst.world.wrench(name).force[0, 2])
    return worst.expect(abs(force / weight - 1) < 0.01, f"{name} carries {force:.4g} N of {weight:.4g} N")
