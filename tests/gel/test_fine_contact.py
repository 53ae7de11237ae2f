"""The contact below the mesh's cells: compliance of layer and mesh, complementarity, and what is left of the mesh."""

from __future__ import annotations

import math

import numpy as np
import pytest

from raytac.gel.coat_surface import CoatSurface
from raytac.gel.fine_contact import FineContact, FineGrid
from raytac.gel.layer_compliance import CosineSeries, layer_compliance
from raytac.gel.pad import make_grid
from raytac.physics.pad_compliance import coat_compliance
from raytac.physics.soft_mesh import PadLevel, pad_mesh
from raytac.specs import load_sensor

GELPAD = load_sensor("gelsight_mini").gelpad
MESH = pad_mesh(GELPAD, PadLevel(2.5e-3, 3, 1.5, 1.5, 5e-5))


def test_a_short_wave_feels_a_half_space_and_a_long_one_a_confined_layer():
    young, nu, thickness = GELPAD.youngs_modulus, GELPAD.poisson_ratio, GELPAD.thickness
    short, long = np.array([2e4]), np.array([0.0, 0.1])
    assert layer_compliance(short, GELPAD) == pytest.approx(2.0 * (1.0 - nu**2) / (young * short), rel=1e-6)
    confined = thickness * (1.0 + nu) * (1.0 - 2.0 * nu) / (young * (1.0 - nu))
    assert layer_compliance(long, GELPAD) == pytest.approx([confined, confined], rel=1e-3)


def test_cosines_pass_through_their_nodes():
    nodes, values = np.linspace(-2e-3, 3e-3, 11), np.random.default_rng(0).normal(size=11)
    series = CosineSeries(nodes)
    assert np.allclose(series.synthesis(nodes) @ series.analysis @ values, values, atol=1e-12)
    slope = (series.synthesis(nodes[:1] + 1e-9) - series.synthesis(nodes[:1])) @ series.analysis @ values / 1e-9
    assert abs(slope[0]) < 1e-2 * np.abs(values).max() / 0.5e-3


@pytest.mark.parametrize("rollers", [False, True])
def test_the_coats_compliance_is_that_of_the_whole_stiffness(rollers):
    """Against a dense solve of the same stiffness: eliminating layers, and halves of a symmetric pad, loses nothing."""
    from raytac.physics.pad_compliance import _stiffness

    found = coat_compliance(MESH, GELPAD, rollers=rollers)
    sparse = _stiffness(MESH.tets.vertices, MESH.tets.tets, GELPAD)
    dense = np.zeros(sparse.shape)
    dense[sparse.row, sparse.column] = sparse.value
    held = np.zeros((len(MESH.tets.vertices), 3), bool)
    held[MESH.bonded] = True
    if rollers:
        for axis in (0, 1):
            held[np.abs(MESH.tets.vertices[:, axis]) > 0.5 * GELPAD.size[axis] - 1e-9, axis] = True
    free = np.flatnonzero(~held.ravel())
    along_z = np.searchsorted(free, 3 * MESH.coat_vertices + 2)
    force = np.zeros((len(free), len(along_z)))
    force[along_z, np.arange(len(along_z))] = 1.0
    truth = np.linalg.solve(dense[np.ix_(free, free)], force)[along_z]
    assert np.abs(found - truth).max() < 1e-9 * truth.max()


def test_finite_elements_tend_to_the_layers_compliance():
    """A wave of pressure on a flat pad between rollers: linear tetrahedra against the closed form, closer on finer cells."""
    from dataclasses import replace

    flat = replace(GELPAD, dome_radius=(math.inf, math.inf))
    off = []
    for cell, layers in ((2.2e-3, 3), (1.1e-3, 6)):
        mesh = pad_mesh(flat, PadLevel(cell, layers, 1.0001, 1.5, 5e-5))
        along = mesh.coat.rest[:, 0]
        wave_number = 4.0 * math.pi / flat.size[0]
        wave = np.cos(wave_number * (along + 0.5 * flat.size[0]))
        corners = mesh.coat.rest[mesh.coat.faces]
        area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        lumped = np.bincount(mesh.coat.faces.ravel(), np.repeat(area / 3.0, 3))
        moved = coat_compliance(mesh, flat, rollers=True) @ (lumped * wave)
        found = (moved * wave * lumped).sum() / (wave**2 * lumped).sum()
        off.append(1.0 - found / float(layer_compliance(np.array([wave_number]), flat)[0]))
    assert 0.0 < off[1] < 0.5 * off[0] < 0.15


@pytest.fixture(scope="module")
def fine():
    grid = make_grid(GELPAD, 0.2e-3)
    surface = CoatSurface(MESH.coat, GELPAD)
    compliances = (coat_compliance(MESH, GELPAD, rollers=rollers) for rollers in (False, True))
    contact = FineContact(surface, GELPAD, grid.x, grid.y, *compliances)
    return contact, grid, FineGrid(contact, grid.x, grid.y)


def ball(grid, depth, radius=4e-3):
    square = radius**2 - grid.x[None, :] ** 2 - grid.y[:, None] ** 2
    return np.where(square > 0, radius - depth - np.sqrt(np.maximum(square, 0.0)), np.inf)


def pressed(fine, under, still=True):
    """The coat under an object whose solver only moved the vertex below it, by the mesh's own response to 1 N there."""
    contact, grid, to_grid = fine
    load = np.zeros(len(MESH.coat.rest))
    load[np.hypot(*MESH.coat.rest[:, :2].T).argmin()] = 1.0
    moved = np.zeros_like(MESH.coat.rest)
    moved[:, 2] = -contact._compliance @ load
    shape = contact.solve(contact.surface.places(np.zeros_like(moved)), moved[:, 2], load, under - grid.rest)
    return shape, grid.rest + to_grid.rise(shape)


def test_contact_is_complementary(fine):
    """Pressure where the coat lies on the object and nowhere else, never a pull, and nothing reaches in."""
    _, grid, _ = fine
    under = ball(grid, 0.6e-3)
    shape, height = pressed(fine, under)
    gap = under - height
    assert shape.pressure.min() == 0.0 and (shape.pressure > 0.0).sum() > 50
    assert np.abs(gap[shape.pressure > 0.0]).max() < 1.5e-6 and gap.min() > -1.5e-6
    assert (grid.rest - height).max() == pytest.approx(0.6e-3, abs=1.5e-6)


def test_a_linear_solution_of_the_mesh_is_exchanged_wholly(fine):
    """If the solver's coat is the mesh's linear response, the shown one does not depend on the mesh: it is the layer's."""
    _, grid, _ = fine
    shape, height = pressed(fine, ball(grid, 0.6e-3))
    assert np.abs(shape.rise).max() < 1e-9
    flipped = np.abs(height - height[::-1]).max(), np.abs(height - height[:, ::-1]).max()
    assert max(flipped) < 1e-6  # the ball, the dome and the pad are symmetric
    force = (shape.pressure * np.prod(grid.pitch)).sum()
    from raytac.physics.load_law import LoadLaw

    law = LoadLaw(np.maximum(ball(grid, 0.0) - grid.rest, 0.0), float(np.prod(grid.pitch)), GELPAD)
    assert force == pytest.approx(law.force(0.6e-3), rel=0.1)


def test_laying_closes_gaps_under_pressure_only(fine):
    _, grid, to_grid = fine
    under = ball(grid, 0.6e-3)
    shape, height = pressed(fine, under)
    lifted = height - 2e-6
    laid, touching = to_grid.lay(lifted, shape, under)
    assert touching.sum() == pytest.approx((shape.pressure > 0.0).sum(), rel=0.05)
    assert np.abs((under - laid)[touching]).max() < 1e-6 and np.array_equal(laid[~touching], lifted[~touching].astype(np.float32))
    laid, _ = to_grid.lay(height + 5e-6, shape, under)
    assert (under - laid).min() > -1e-9
