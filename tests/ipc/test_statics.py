"""Bodies at rest against closed forms: a cantilever, Hertz's ball, a flat punch, a pressed block; and the balance of forces."""

from __future__ import annotations

import numpy as np
import pytest

import ipc
from tests.ipc.conftest import bonded_pad, small_pad, unit_cell
from tests.ipc.oracles.closed_forms import punch_force
from tests.ipc.oracles.meshes import equal_area, rim_block
from tests.ipc.oracles.nodal_press import nodal_press
from tests.ipc.oracles.presses import (
    CONTACT,
    SOLID,
    cantilever_error,
    growth,
    hertz_error,
    press_punch,
    press_sphere,
    punch_error,
    richardson,
)


def test_cantilever_converges_to_the_beam() -> None:
    """Under its own weight; linear tetrahedra are too stiff, by less and less, with an order that rises towards two (Timoshenko's beam)."""
    errors = -np.array([cantilever_error(cells) for cells in (2, 4, 8)])
    orders = np.log2(errors[:-1] / errors[1:])
    assert (errors > 0).all() and errors[-1] < 0.06, f"errors {errors}"
    assert orders[1] > orders[0] and 1.7 < orders[1] < 2.1, f"orders {orders}"


@pytest.mark.slow
def test_cantilever_is_of_second_order() -> None:
    errors = [-cantilever_error(cells) for cells in (8, 16)]
    assert errors[1] < 0.02 and np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.1), f"errors {errors}"


def test_hertz_force_is_met() -> None:
    """A ball pressed into a half-space: within 5 % at five cells to the contact radius; the stand-off counts as depth."""
    assert abs(hertz_error(press_sphere(5, reach=7.0))) < 0.05


def test_press_errs_by_its_mesh_alone() -> None:
    """A punch on a mesh of three cells to the radius: linear elasticity with exact contact at the vertices has the same force to 1 %."""
    cells, reach = 3, 6.0
    mesh, outside = rim_block(CONTACT, cells, growth(cells), reach * CONTACT)
    rim = CONTACT * equal_area(round(2 * np.pi * cells))
    under = np.isclose(mesh.vertices[:, 2], 0) & (np.hypot(*mesh.vertices[:, :2].T) < 1.001 * rim)
    pressed = press_punch(cells, reach=reach)
    nodal = nodal_press(mesh, outside, SOLID, np.where(under, -pressed.depth, np.inf))
    assert pressed.force == pytest.approx(nodal, rel=0.01)
    assert 0.08 < nodal / float(punch_force(SOLID, CONTACT, pressed.depth)) - 1 < 0.16


@pytest.mark.slow
def test_presses_converge_to_the_closed_forms() -> None:
    """Hertz within 2 % on the finest of three meshes, the flat punch within 5 %; both head for the closed form."""
    cells = (4, 6, 9)
    hertz = [hertz_error(press_sphere(n)) for n in cells]
    punch = [punch_error(press_punch(n)) for n in cells]
    for name, errors, most, lowest in (("hertz", hertz, 0.02, 1.7), ("punch", punch, 0.05, 1.2)):
        order, limit = richardson(errors, 1.5)
        assert abs(errors[-1]) < most, f"{name}: errors {errors}"
        assert lowest < order < 2.4 and abs(limit) < 0.01, f"{name}: order {order}, limit {limit}"


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_forces_balance_to_the_residual(friction: float) -> None:
    """Force on the ball + pull on the case + inertia of the pad is Newton's residual, to rounding; torques likewise.

    With friction a torque remains: the two sides of a pair are a stand-off apart, so f on one and −f on the other are a couple.
    """
    mesh = small_pad()
    ball = ipc.KinematicBody("ball", ipc.icosphere(4e-3, 2), ipc.Pose((0.0, 0.0, 4.12e-3)))
    for tolerance, relative in ((1e-5, 1e-4), (1e-9, 1e-8)):
        options: dict = {"velocity_tolerance": tolerance, "linear_tolerance": 1e-4, "friction_tolerance": 0.1 * relative}
        world = ipc.World([bonded_pad(mesh), ball], ipc.Settings(d_hat=1e-4, friction=friction, **options), device="cpu")
        corners = mesh.vertices[mesh.tets]
        quarter = 1000 * np.linalg.det(corners[:, 1:] - corners[:, :1]) / 24
        mass = np.bincount(mesh.tets.ravel(), weights=np.repeat(quarter, 4))[:, None]
        for k in range(6):
            before = world.velocities("pad")[0]
            world.set_target("ball", (3e-5 * k, 0.0, 4.12e-3 - 1e-4 * (k + 1)))
            assert world.step().converged[0]
        inertia = mass * (world.velocities("pad")[0] - before) / world.settings.dt
        on_ball, on_case = world.wrench("ball"), world.wrench("pad")
        size, remainder = np.linalg.norm(on_ball.force[0]), on_ball.force[0] + on_case.force[0] + inertia.sum(axis=0)
        assert size > 0.1 and np.abs(inertia).sum() > 1e-5 * size
        residual = world._potential.residual.numpy()[0].sum(axis=0)
        assert remainder == pytest.approx(-residual, abs=float(1e-13 * size))
        assert np.abs(remainder).max() < relative * size
        couple = on_ball.torque[0] + np.cross(world.frame("ball")[1][0], on_ball.force[0]) + on_case.torque[0]
        couple += np.cross(world.positions("pad")[0], inertia).sum(axis=0)
        tangential = np.linalg.norm(on_ball.force[0, :2])
        assert np.abs(couple).max() < relative * size * 4e-3 + (2 * world.d_hat * tangential if friction else 0.0)


def test_pressed_block_has_a_uniform_pressure() -> None:
    """ν = 0 on a half-space: the traction at every vertex is the force over the area, and the stand-off is the barrier's."""
    mesh = unit_cell(3, 0.01)
    bonded = ipc.vertices_in_box(mesh, (-1, -1, 0.01), (1, 1, 0.01))
    block = ipc.SoftBody("block", mesh, ipc.Material(1e5, 0.0), bonded=bonded, pose=ipc.Pose((0, 0, 2.2e-5)))
    settings = ipc.Settings(dt=1e3, d_hat=2e-5, velocity_tolerance=1e-14, linear_tolerance=1e-8)
    world = ipc.World([block, ipc.HalfSpace("floor")], settings, device="cpu")
    for k in range(1, 6):
        world.set_target("block", (0.0, 0.0, 2.2e-5 - 1e-4 * k))
        report = world.step()
    force = world.wrench("floor").force[0]
    lower = np.isclose(mesh.vertices[world.surface("block")[0], 2], 0)
    # A vertex on the rim has area on the sides too, and stands off a little more: the inner ones are compared.
    share = world.contact_forces("block")[0][lower, 2]
    area = world.layout.vert_area[lower]
    inside = (np.abs(mesh.vertices[world.surface("block")[0]][lower][:, :2] - 0.005) < 0.004).all(axis=1)
    pressure = share[inside] / area[inside]
    assert report.converged[0] and -force[2] == pytest.approx(world.wrench("block").force[0, 2], rel=1e-6)
    assert pressure == pytest.approx(-force[2] / 1e-4, rel=0.01)
    pairs = world.contacts()
    y = pairs.gap / world.d_hat
    stands_off = 1e5 * (4 * y * (y**2 - 1) * np.log(y**2) + 2 * (y**2 - 1) ** 2 / y)
    assert pairs.force == pytest.approx(stands_off * world.layout.vert_area[pairs.vertices[:, 0]], rel=1e-10)
