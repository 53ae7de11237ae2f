"""Presses of a ball and a punch, and a beam under its weight, whose forces and sag have closed forms."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import ipc
from tests.ipc.oracles.closed_forms import Elastic, boussinesq_displacement, hertz_force, punch_force
from tests.ipc.oracles.meshes import ball_tool, even_block, flat_tool, rim_block

SOLID = Elastic(1e5, 0.3)
CONTACT = 1e-3
"""Radius of the contact [m]."""
SPHERE = 50 * CONTACT
"""Of the ball [m]: strains of about 1 %, so that the closed forms of small strain apply."""
DEPTH = CONTACT**2 / SPHERE
REACH = 8.0
"""Radius and height of the block in contact radii."""


@dataclass(frozen=True)
class Pressed:
    """The result of a press: force [N], depth with the stand-off added [m], number of vertices, seconds."""

    force: float
    depth: float
    vertices: int
    seconds: float

    def error(self, exact: Callable[[float], float]) -> float:
        """Relative error of the force against ``exact`` of the depth."""
        return self.force / float(exact(self.depth)) - 1


def press(
    mesh: ipc.TetMesh,
    bonded: NDArray,
    tool: ipc.TriMesh,
    depth: float,
    *,
    solid: Elastic = SOLID,
    d_hat: float = 0.01 * CONTACT,
    kappa: float = 10.0,
    far_force: float | None = 0.0,
    device: str = "cpu",
) -> Pressed:
    """Press ``tool`` in to about ``depth``, at rest, without friction.

    Args:
        mesh: upper side at z = 0.
        bonded: bonded vertices.
        tool: its lowest point at z = 0.
        depth: [m], stand-off included.
        solid: the material.
        d_hat: [m].
        kappa: barrier stiffness as a multiple of Young's modulus.
        far_force: a first guess of the force [N]: bonded vertices carry the displacement that Boussinesq gives for the force, repeated
            with the force that came out until that changes by less than 0.1 %. None keeps them at rest.
        device: Warp device.
    """
    begin = time.perf_counter()
    body = ipc.SoftBody("block", mesh, ipc.Material(solid.young, solid.poisson), bonded=bonded)
    settings = ipc.Settings(
        dt=1e3, d_hat=d_hat, kappa=kappa * solid.young, velocity_tolerance=1e-14, linear_tolerance=1e-4, max_newton=200
    )
    start = ipc.Pose((0.0, 0.0, 1.01 * d_hat))
    world = ipc.World([body, ipc.KinematicBody("tool", tool, start)], settings, device=device)
    force, measured = (0.0 if far_force is None else far_force), np.inf
    while True:
        if far_force is not None:
            state = world.save()
            state.y[0, bonded] = mesh.vertices[bonded] + boussinesq_displacement(solid, force, mesh.vertices[bonded])
            world.restore(state)
        world.set_target("tool", (0.0, 0.0, d_hat - depth))
        report = world.step()
        if not report.converged[0]:
            raise ArithmeticError(f"the press did not converge: {report}")
        measured = float(world.wrench("tool").force[0, 2])
        if far_force is None or abs(measured - force) < 1e-3 * measured:
            break
        force = measured
    pairs = world.contacts()
    gap = float(pairs.force @ pairs.gap / pairs.force.sum())
    return Pressed(measured, depth - d_hat + gap, len(mesh.vertices), time.perf_counter() - begin)


def growth(cells: float) -> float:
    """Growth of cells away from the contact that belongs to a resolution: finer meshes grow more slowly."""
    return 1.25 ** (4 / cells)


def press_sphere(cells: int, reach: float = REACH, **options: float | str | None) -> Pressed:
    """A ball on a half-space, ``cells`` to the contact radius."""
    mesh, bonded = even_block(CONTACT, cells, growth(cells), reach * CONTACT)
    tool = ball_tool(1.6 * CONTACT, round(3.2 * cells), SPHERE)
    guess = {"far_force": float(hertz_force(SOLID, SPHERE, DEPTH))} | options
    return press(mesh, bonded, tool, DEPTH, **guess)  # type: ignore[arg-type]


def press_punch(cells: int, reach: float = REACH, **options: float | str | None) -> Pressed:
    """A flat punch on a half-space, ``cells`` to its radius."""
    mesh, bonded = rim_block(CONTACT, cells, growth(cells), reach * CONTACT)
    guess = {"far_force": float(punch_force(SOLID, CONTACT, DEPTH))} | options
    return press(mesh, bonded, flat_tool(CONTACT, cells), DEPTH, **guess)  # type: ignore[arg-type]


def hertz_error(pressed: Pressed) -> float:
    """Relative error of a ball's force."""
    return pressed.error(lambda depth: float(hertz_force(SOLID, SPHERE, depth)))


def punch_error(pressed: Pressed) -> float:
    """Relative error of a punch's force."""
    return pressed.error(lambda depth: float(punch_force(SOLID, CONTACT, depth)))


def richardson(errors: Sequence[float], ratio: float) -> tuple[float, float]:
    """Order of convergence and the limit of three values whose meshes are each ``ratio`` times finer."""
    first, second, third = errors
    order = float(np.log((first - second) / (second - third)) / np.log(ratio))
    return order, third - (second - third) / (ratio**order - 1)


def cantilever_error(cells: int, device: str = "cpu") -> float:
    """Relative error of the sag of a clamped beam of length 5 heights under its weight against Timoshenko's, ν = 0."""
    length, height, young, density, g = 0.1, 0.02, 1e6, 1000.0, 0.05
    x, y = np.linspace(0, length, 5 * cells + 1), np.linspace(0, height, cells + 1)
    mesh = ipc.box_mesh(x, y, y)
    clamped = ipc.vertices_in_box(mesh, (0, -1, -1), (0, 1, 1))
    beam = ipc.SoftBody("beam", mesh, ipc.Material(young, 0.0, density), bonded=clamped)
    settings = ipc.Settings(dt=1e3, gravity=(0, 0, -g), velocity_tolerance=1e-12, linear_tolerance=1e-8, max_linear=20000)
    world = ipc.World([beam], settings, device=device)
    if not world.step().converged[0]:
        raise ArithmeticError("the beam did not come to rest")
    end = np.isclose(mesh.vertices[:, 0], length)
    sag = (mesh.vertices[end, 2] - world.positions("beam")[0, end, 2]).mean()
    load, bending, shear = density * g * height**2, young * height**4 / 12, 5 / 6 * young / 2 * height**2
    return float(sag / (load * length**4 / (8 * bending) + load * length**2 / (2 * shear)) - 1)
