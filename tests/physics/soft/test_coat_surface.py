"""The smooth coat against scattered interpolation of its own definition, and its splines against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from raytac.errors import InputError
from raytac.gel.coat_mesh import CoatMesh, DeformedCoat
from raytac.gel.interpolate import SplineAxis, hat_matrix
from raytac.gel.surface import make_grid, rest_height
from raytac.gel.traction import cell_areas, foundation_traction
from raytac.physics.soft.coat_points import CoatTraction
from raytac.physics.soft.mesh import pad_mesh
from raytac.specs import load_sensor
from tests.physics.soft.oracles.coat_surface import BarrierClearance, CoatSurface

GELPAD = load_sensor("gelsight_mini").gelpad
LINES = np.array([0.0, 0.3, 1.1, 1.5, 2.9, 3.0])


def dent(x, y, sideways=0.15e-3):
    """A smooth displacement (…, 3) [m]: a dent of 0.8 mm, with the skin drawn away from it."""
    bell = np.exp(-(x**2 + y**2) / (3e-3) ** 2)
    return np.stack([sideways * x / 3e-3 * bell, sideways * y / 3e-3 * bell, -0.8e-3 * bell], axis=-1)


def test_spline_equals_scipy():
    rng = np.random.default_rng(0)
    values, t = rng.normal(size=len(LINES)), np.linspace(0.0, 3.0, 77)
    assert np.allclose(SplineAxis(LINES).matrix(t) @ values, CubicSpline(LINES, values, bc_type="natural")(t), atol=1e-12)
    assert np.allclose(hat_matrix(LINES, t) @ values, np.interp(t, LINES, values), atol=1e-14)


@pytest.mark.parametrize(("level", "most"), [("coarse", 4e-6), ("medium", 2e-7)])
def test_surface_is_the_moved_coat_seen_from_above(level, most):
    """Against the analytic dent, whose material points are found by an independent, long iteration; sideways motion included."""
    mesh, grid = pad_mesh(GELPAD, level).coat, make_grid(GELPAD, 0.25e-3)
    surface = CoatSurface(mesh, GELPAD)
    moved = dent(mesh.rest[:, 0], mesh.rest[:, 1])
    rows, columns = surface.matrices(grid.x, grid.y)
    height = grid.rest + rows @ surface.rise(surface.places(moved), moved[:, 2]) @ columns
    x, y = np.meshgrid(grid.x, grid.y)
    u, v = x, y
    for _ in range(100):
        went = dent(u, v)
        u, v = x - went[..., 0], y - went[..., 1]
    truth = rest_height(GELPAD, u, v) + dent(u, v)[..., 2]
    assert np.abs(height - truth).max() < most
    straight = rest_height(GELPAD, x, y) + dent(x, y)[..., 2]
    assert np.abs(straight - truth).max() > 3 * most  # the sideways motion matters


def test_untouched_coat_is_exactly_the_dome():
    mesh, grid = pad_mesh(GELPAD, "coarse").coat, make_grid(GELPAD, 0.2e-3)
    surface = CoatSurface(mesh, GELPAD)
    still = np.zeros_like(mesh.rest)
    assert np.abs(surface.rise(surface.places(still), still[:, 2])).max() == 0.0
    assert np.allclose(mesh.rest[:, 2], rest_height(GELPAD, mesh.rest[:, 0], mesh.rest[:, 1]), atol=1e-15)
    assert grid.rest.max() == 0.0


def test_no_facet_shows():
    """The surface's slope changes by no more from node to node on the coat's lines than between them."""
    mesh, grid = pad_mesh(GELPAD, "coarse").coat, make_grid(GELPAD, 0.05e-3)
    surface = CoatSurface(mesh, GELPAD)
    moved = dent(mesh.rest[:, 0], mesh.rest[:, 1])
    rows, columns = surface.matrices(grid.x, grid.y)
    height = rows @ surface.rise(surface.places(moved), moved[:, 2]) @ columns
    bend = np.abs(np.diff(height[len(grid.y) // 2], 3)) / grid.pitch[0] ** 2
    near = np.abs(grid.x[1:-2, None] - mesh.lines_x).min(axis=1) < 0.1e-3
    assert bend[near].max() < 3 * np.percentile(bend[~near], 95)
    on_lines = np.interp(mesh.lines_x, grid.x, height[len(grid.y) // 2])
    facets = np.interp(grid.x, mesh.lines_x, on_lines)
    kinks = np.abs(np.diff(facets, 3)) / grid.pitch[0] ** 2
    assert kinks.max() > 10 * bend.max()  # the same measure finds facets


def ball(x, y, depth, radius=4e-3):
    """Underside of a ball that reaches ``depth`` [m] below z = 0, (Ny, Nx)."""
    square = radius**2 - x[None, :] ** 2 - y[:, None] ** 2
    return np.where(square > 0, radius - depth - np.sqrt(np.maximum(square, 0.0)), np.inf)


def test_clearance_is_measured():
    """A coat held 40 µm off a ball everywhere in contact: the clearance is found."""
    mesh, grid = pad_mesh(GELPAD, "medium").coat, make_grid(GELPAD, 0.2e-3)
    surface, d_hat = CoatSurface(mesh, GELPAD), 60e-6
    clearance = BarrierClearance(surface, grid.rest, grid.x, grid.y, d_hat)
    rho = np.hypot(mesh.rest[:, 0], mesh.rest[:, 1])
    bowl = np.minimum(4e-3 - 0.8e-3 - np.sqrt(np.maximum((4e-3) ** 2 - rho**2, 0.0)) - 40e-6, mesh.rest[:, 2])
    moved = np.zeros_like(mesh.rest)
    moved[:, 2] = bowl - mesh.rest[:, 2]
    pressure = np.where(rho < 2e-3, np.sqrt(np.maximum(1.0 - (rho / 2e-3) ** 2, 0.0)), 0.0) * 1e5
    places, under = surface.places(moved), ball(grid.x, grid.y, 0.8e-3)
    assert clearance.measure(places, moved[:, 2], pressure, under) == pytest.approx(40e-6, abs=2e-6)


def test_clearance_without_contact_is_none():
    mesh, grid = pad_mesh(GELPAD, "coarse").coat, make_grid(GELPAD, 0.5e-3)
    surface = CoatSurface(mesh, GELPAD)
    still = np.zeros(len(mesh.rest))
    clearance = BarrierClearance(surface, grid.rest, grid.x, grid.y, 5e-5)
    assert np.isnan(clearance.measure(surface.places(np.zeros_like(mesh.rest)), still, still, np.full(grid.shape, np.inf)))


def test_traction_integrates_to_the_forces():
    rng = np.random.default_rng(1)
    mesh, grid = pad_mesh(GELPAD, "coarse").coat, make_grid(GELPAD, 0.2e-3)
    forces = rng.normal(size=(2, len(mesh.rest), 3))
    traction = CoatTraction(mesh, grid)(forces)
    assert np.allclose((traction * cell_areas(grid)[..., None]).sum(axis=(1, 2)), forces.sum(axis=1), rtol=1e-4, atol=1e-4)
    corners = mesh.rest[mesh.faces, :2]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.bincount(mesh.faces.ravel(), np.repeat((one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]) / 6.0, 3), len(mesh.rest))
    even = CoatTraction(mesh, grid)(np.tile(area[None, :, None] * 1e4, (1, 1, 3)))
    assert np.allclose(even, 1e4, rtol=0.08)  # uniform pressure comes out uniform


def test_traction_needs_a_grid_finer_than_the_coat():
    with pytest.raises(InputError, match=r"pitch.*finer than the coat's cells"):
        CoatTraction(pad_mesh(GELPAD, "fine").coat, make_grid(GELPAD, 2e-3))


@pytest.mark.solver
def test_foundation_traction_has_the_total_and_the_twist():
    from raytac.gel.pyramid import ElasticSurround

    grid = make_grid(GELPAD, 0.1e-3)
    surface = ElasticSurround(grid, thickness=GELPAD.thickness).surface(ball(grid.x - 1e-3, grid.y, 0.5e-3)[None])
    force, twist = np.array([[0.3, -0.2, -2.0]]), np.array([1.5e-3])
    traction = foundation_traction(surface, force, twist)[0].astype(float) * cell_areas(grid)[..., None]
    assert np.allclose(traction.sum(axis=(0, 1)), force[0], rtol=1e-4)
    cx, cy = surface.contact_centre[0]
    arm_x, arm_y = grid.x[None, :] - cx, grid.y[:, None] - cy
    assert (arm_x * traction[..., 1] - arm_y * traction[..., 0]).sum() == pytest.approx(1.5e-3, rel=1e-3)
    assert not traction[~surface.contact[0]].any()


def test_coat_mesh_refuses_other_shapes():
    mesh = pad_mesh(GELPAD, "coarse").coat
    with pytest.raises(InputError, match="rest"):
        CoatMesh(mesh.rest[:-1], mesh.faces, mesh.lines_x, mesh.lines_y)
    with pytest.raises(InputError, match="positions"):
        DeformedCoat(mesh, mesh.rest)
    assert not DeformedCoat(mesh, mesh.rest[None]).displacement.any()
