"""Bodies at rest against closed forms: a cantilever, a pressed block, a pad under gravity."""

from __future__ import annotations

import numpy as np
import pytest

import ipc
from tests.ipc.conftest import unit_cell


def test_cantilever_converges_to_the_beam() -> None:
    """Under its own weight; linear tetrahedra are too stiff, by less and less, with an order that rises towards two (Timoshenko's beam)."""
    length, height, young, density, g = 0.1, 0.02, 1e6, 1000.0, 0.05
    tips = []
    for cells in (1, 2, 4):
        x, y = np.linspace(0, length, 5 * cells + 1), np.linspace(0, height, cells + 1)
        mesh = ipc.box_mesh(x, y, y, mirrored=cells > 1)
        bonded = ipc.vertices_in_box(mesh, (0, -1, -1), (0, 1, 1))
        body = ipc.SoftBody("beam", mesh, ipc.Material(young, 0.0, density), bonded=bonded)
        settings = ipc.Settings(dt=1e3, gravity=(0, 0, -g), velocity_tolerance=1e-12, linear_tolerance=1e-8)
        world = ipc.World([body], settings, device="cpu")
        assert world.step().converged[0]
        end = np.isclose(mesh.vertices[:, 0], length)
        tips.append(-(world.positions("beam")[0, end, 2] - mesh.vertices[end, 2]).mean())
    load = density * g * height**2
    exact = load * length**4 / (8 * young * height**4 / 12) + load * length**2 / (2 * 5 / 6 * young / 2 * height**2)
    errors = 1 - np.array(tips) / exact
    orders = np.log2(errors[:-1] / errors[1:])
    assert (errors > 0).all() and errors[-1] < 0.2, f"errors {errors}"
    assert orders[1] > orders[0] and orders[1] > 1.2, f"orders {orders}"


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
