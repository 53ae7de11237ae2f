"""Links that move soft bodies which are held elsewhere: no drag beyond what the body is, no energy, and how far the bound holds."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import ipc
from ipc.bodies import rotation_matrix
from ipc.solver.patch_motion import RestPatches
from raytac.physics.soft.bodies import scene_body
from raytac.shapes.part import primitive
from raytac.world.coupling_inputs import STIFFENING
from tests.world.coupled import Coupled, pose
from tests.world.test_coupling import SLIDER

HALF = (6e-3, 6e-3, 10e-3)
FOOT = {"column": pose(position=(0.0, 0.0, -HALF[2]))}


def finger_over_a_column(height: float, drive: str = "", **options) -> Coupled:
    """40 g on a rail over a column of 50 kPa, some 300 N/m: a hundred times softer than the pad's face."""
    column = scene_body(
        "column",
        (primitive("box", HALF),),
        "soft",
        density=1000.0,
        youngs_modulus=5e4,
        cell=4e-3,
        bonded=lambda at: at[:, 2] < -0.99 * HALF[2],
    )
    xml = SLIDER.format(h=1e-3, g=0.0, z=height, m=0.04, drive=drive)
    return Coupled(xml, ["finger"], [column], FOOT, **options)


def test_a_link_pushes_a_held_body_as_fast_as_its_mass_and_damper_let_it() -> None:
    """m x'' = F − c x' − k x with the column's own k. With the pad's stiffness against the column's, it would take seconds."""
    rig = finger_over_a_column(0.06e-3, '<motor joint="z"/>')
    force, damping, way = 0.1, 4.0, []
    for _ in range(10):
        rig.run(0.01, lambda data: data.ctrl.fill(force - damping * data.qvel[0]))
        way.append(float(rig.data.qpos[0]))
    assert rig.wrench[0, 2] == pytest.approx(force, rel=0.02)
    touch = way[0]
    stiffness = force / (way[-1] - touch)
    x, v, h, expected = 0.0, 0.0, 1e-4, []
    for _ in range(900):
        v += h / 0.04 * (force - damping * v - stiffness * x)
        x += h * v
        expected.append(x)
    # It is still on its way after two intervals, and may then be a little later than the free motion, by what the bound is too stiff.
    assert 0.75 * expected[199] < way[2] - touch < expected[199] < 1.2 * (way[-1] - touch)


def test_a_held_body_gives_back_no_more_than_it_took() -> None:
    rig = finger_over_a_column(0.12e-3, speed=0.06)
    rig.model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    energy = np.array(rig.run(0.04))
    assert rig.data.qvel[0] < 0.0  # it was thrown back
    # The column's own motion is not counted: what swings in it comes back into sight.
    assert np.diff(energy).max() < 0.01 * energy[0] and energy[-1] < 0.8 * energy[0]


def deformed(stretch: float, twist: float, shear: float) -> float:
    """How much stiffer the end of a column is than it is taken to be, in the direction of all six where that is most."""
    young, width, height, steps = 1e5, 8e-3, 32e-3, 12
    side, up = np.linspace(-width / 2, width / 2, 4), np.linspace(0.0, height, 11)
    mesh = ipc.box_mesh(side, side, up, cut="mirrored")
    base, top = (np.flatnonzero(np.abs(mesh.vertices[:, 2] - z) < 1e-9) for z in (0.0, height))
    material = ipc.Material(young=young, poisson=0.4, density=1000.0)
    settings = ipc.Settings(
        dt=1e3, gravity=(0.0, 0.0, 0.0), velocity_tolerance=1e-15, linear_tolerance=1e-9, d_hat=1e-5, max_newton=300
    )
    plain = ipc.World([ipc.SoftBody("column", mesh, material, bonded=base)], settings, device="cpu")
    world = ipc.World([ipc.SoftBody("column", mesh, material, bonded=base, grips={"top": top})], settings, device="cpu")
    offset = world.frame("column.top")[1][0] - [0.0, 0.0, height]

    def go(centre: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Force and torque about ``centre`` on the grip, there."""
        world.set_target("column.top", centre + rotation_matrix(rotation[None])[0] @ offset, rotation)
        assert world.step().converged[0]
        found = world.wrench("column.top")
        arm = world.frame("column.top")[1][0] - centre
        return np.concatenate([found.force[0], found.torque[0] + np.cross(arm, found.force[0])])

    for k in range(1, steps + 1):
        share = k / steps
        centre = np.array([shear * height * share, 0.0, height * (1.0 + (stretch - 1.0) * share)])
        rotation = about((0.0, 0.0, 1.0), np.radians(twist) * share)
        wrench = go(centre, rotation)
    there, columns, way = world.save(), [], 2e-5
    for axis in range(6):
        sides = []
        for sign in (1.0, -1.0):
            world.restore(there)
            unit = np.eye(3)[axis % 3]
            if axis < 3:
                sides.append(go(centre + sign * way * unit, rotation))
            else:
                sides.append(go(centre, product(about(unit, sign * way / width), rotation)))
        columns.append((sides[1] - sides[0]) / (2.0 * way * (1.0 if axis < 3 else 1.0 / width)))
    found = np.array(columns).T
    patches, turn = RestPatches(plain.layout, settings, 0), np.kron(np.eye(2), rotation_matrix(rotation[None])[0])
    at_rest = patches.motion(plain._potential, 0, top).stiffness
    pulled = patches.motion(plain._potential, 0, top, float(np.linalg.norm(wrench[:3]))).stiffness
    taken = turn @ at_rest @ turn.T + (pulled - at_rest)
    return float(np.linalg.eigvals(np.linalg.solve(taken, 0.5 * (found + found.T))).real.max())


def about(axis, angle: float) -> np.ndarray:
    return np.concatenate([[np.cos(angle / 2.0)], np.sin(angle / 2.0) * np.asarray(axis)])


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.concatenate([[a[0] * b[0] - a[1:] @ b[1:]], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])


@pytest.mark.slow
@pytest.mark.parametrize(("stretch", "twist", "shear"), [(1.3, 0.0, 0.0), (1.2, 120.0, 0.0), (0.85, 0.0, 0.0), (1.0, 0.0, 0.2)])
def test_the_margin_bounds_what_a_body_stiffens_by(stretch: float, twist: float, shear: float) -> None:
    found = deformed(stretch, twist, shear)
    assert 0.5 < found < STIFFENING
