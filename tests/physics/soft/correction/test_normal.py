"""The contact below the mesh's cells: compliance of layer and mesh, complementarity, and what is left of the mesh."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from raytac.gel.interpolate import sampled
from raytac.gel.products import Products
from raytac.gel.surface import make_grid
from raytac.physics.bonded_layer import layer_compliance, layer_spread
from raytac.physics.soft.correction import mesh_compliance
from raytac.physics.soft.correction.cosine_series import CosineSeries
from raytac.physics.soft.correction.mesh_compliance import coat_compliance, correction_compliances, rest_stiffness
from raytac.physics.soft.correction.plane_waves import CosineSum
from raytac.physics.soft.mesh import PadLevel, pad_mesh
from raytac.physics.soft.settings import Correction
from raytac.specs import load_sensor
from tests.physics.soft.oracles.coat_surface import CoatSurface
from tests.physics.soft.oracles.normal import ContactSampler, NormalCorrection, _smoothing
from tests.physics.soft.oracles.tangential import TangentialCorrection

GELPAD = load_sensor("gelsight_mini").gelpad
MESH = pad_mesh(GELPAD, PadLevel(2.5e-3, 3, 1.5, 1.5, 5e-5))


def test_a_short_wave_feels_a_half_space_and_a_long_one_a_confined_layer():
    young, nu, thickness = GELPAD.youngs_modulus, GELPAD.poisson_ratio, GELPAD.thickness
    short, long = np.array([2e4]), np.array([0.0, 0.1])
    assert layer_compliance(short, GELPAD) == pytest.approx(2.0 * (1.0 - nu**2) / (young * short), rel=1e-6)
    confined = thickness * (1.0 + nu) * (1.0 - 2.0 * nu) / (young * (1.0 - nu))
    assert layer_compliance(long, GELPAD) == pytest.approx([confined, confined], rel=1e-3)
    drawn = -(1.0 + nu) * (1.0 - 2.0 * nu) / (young * short)
    assert layer_spread(short, GELPAD) == pytest.approx(drawn, rel=1e-6)
    gentle = np.array([2.5])
    squeezed = (1.0 + nu) * thickness**2 * gentle * (1.0 - (1.0 - 2.0 * nu) * (3.0 - 4.0 * nu)) / (4.0 * young * (1.0 - nu) ** 2)
    assert layer_spread(gentle, GELPAD) == pytest.approx(squeezed, rel=1e-3)


def test_bonded_vertices_of_the_coat_bear_no_force():
    """A pad that is bonded at its sides too: a contact that reaches them has vertices that nothing moves."""
    gelpad = replace(GELPAD, bonded="back_and_sides")
    mesh = pad_mesh(gelpad, PadLevel(2.5e-3, 3, 1.5, 1.5, 5e-5))
    grid = make_grid(gelpad, 0.4e-3)
    compliance, continued = coat_compliance(mesh, gelpad)[0, 2], coat_compliance(mesh, gelpad, rollers=True)[0, 2]
    fine = NormalCorrection(CoatSurface(mesh.coat, gelpad), gelpad, grid.x, grid.y, compliance, continued)
    rest = mesh.coat.rest
    load = np.where(rest[:, 0] > 0.5 * gelpad.size[0] - 4e-3, 1.0, 0.0)
    bonded = np.diagonal(compliance) == 0.0
    assert (bonded & (load > 0.0)).any()
    down = np.where(bonded, 0.0, -1e-4 * load)
    shape = fine.solve(fine.surface.places(np.zeros((len(rest), 3))), down, load, np.full(grid.shape, np.nan))
    assert np.isfinite(shape.mesh_forces).all() and (shape.mesh_forces[bonded] == 0.0).all()
    pressed = ~bonded & (load > 0.0)
    assert (compliance @ shape.mesh_forces)[pressed] == pytest.approx(-1e-4, rel=1e-6)


def test_a_field_read_at_no_place_is_no_number():
    x, field = np.linspace(0.0, 1.0, 5), np.arange(20.0).reshape(4, 5)
    found = sampled(field, x, np.linspace(0.0, 1.0, 4), np.array([np.nan, 0.5]), np.array([0.0, 0.0]))
    assert np.isnan(found[0]) and found[1] == 2.0


def test_cosines_pass_through_their_nodes():
    nodes, values = np.linspace(-2e-3, 3e-3, 11), np.random.default_rng(0).normal(size=11)
    series = CosineSeries(nodes)
    assert np.allclose(series.synthesis(nodes) @ series.analysis @ values, values, atol=1e-12)
    slope = (series.synthesis(nodes[:1] + 1e-9) - series.synthesis(nodes[:1])) @ series.analysis @ values / 1e-9
    assert abs(slope[0]) < 1e-2 * np.abs(values).max() / 0.5e-3


@pytest.mark.parametrize("pushed", [0, 1, 2])
@pytest.mark.parametrize("rollers", [False, True])
@pytest.mark.parametrize("block", [None, (2, 2, 1), (3, 2, 2)])
def test_the_coats_compliance_is_that_of_the_whole_stiffness(block, rollers, pushed):
    """Against a dense solve of the same stiffness: eliminating layers, and halves of a symmetric pad, loses nothing."""
    mesh = pad_mesh(GELPAD, PadLevel(2.5e-3, 3, 1.5, 1.5, 5e-5, block))
    found = coat_compliance(mesh, GELPAD, rollers=rollers, along=(0, pushed))[1]
    assert np.abs(found[pushed] - found[pushed].T).max() == 0.0
    sparse = rest_stiffness(mesh, GELPAD)
    dense = np.zeros(sparse.shape)
    np.add.at(dense, (sparse.row, sparse.column), sparse.value)
    held = np.zeros((len(mesh.tets.vertices), 3), bool)
    held[mesh.bonded] = True
    if rollers:
        for axis in (0, 1):
            held[np.abs(mesh.tets.vertices[:, axis]) > 0.5 * GELPAD.size[axis] - 1e-9, axis] = True
    free = np.flatnonzero(~held.ravel())
    force = np.zeros((len(dense), len(mesh.coat_vertices)))
    force[3 * mesh.coat_vertices + pushed, np.arange(len(mesh.coat_vertices))] = 1.0
    truth = np.zeros_like(force)
    truth[free] = np.linalg.solve(dense[np.ix_(free, free)], force[free])
    for axis in range(3):
        along = truth[3 * mesh.coat_vertices + axis]
        assert np.abs(along).max() > 0.02 * truth.max() and np.abs(found[axis] - along).max() < 1e-9 * truth.max()


def test_finite_elements_tend_to_the_layers_compliance():
    """A wave of pressure on a flat pad between rollers, downwards and sideways: linear tetrahedra against the closed forms."""
    from dataclasses import replace

    flat = replace(GELPAD, dome_radius=(math.inf, math.inf))
    off = []
    for cell, layers in ((2.2e-3, 3), (1.1e-3, 6)):
        mesh = pad_mesh(flat, PadLevel(cell, layers, 1.0001, 1.5, 5e-5))
        along = mesh.coat.rest[:, 0] + 0.5 * flat.size[0]
        wave_number = 4.0 * math.pi / flat.size[0]
        cosine, sine = np.cos(wave_number * along), np.sin(wave_number * along)
        corners = mesh.coat.rest[mesh.coat.faces]
        area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        lumped = np.bincount(mesh.coat.faces.ravel(), np.repeat(area / 3.0, 3))
        sideways, _, down = -coat_compliance(mesh, flat, rollers=True)[0] @ (lumped * cosine)
        found = [
            (-down * cosine * lumped).sum() / (cosine**2 * lumped).sum(),
            (sideways * sine * lumped).sum() / (sine**2 * lumped).sum(),
        ]
        truth = [float(law(np.array([wave_number]), flat)[0]) for law in (layer_compliance, layer_spread)]
        off.append(np.abs(1.0 - np.array(found) / truth))
    assert (off[1] < 0.5 * off[0]).all() and (off[0] < 0.3).all() and (off[1] > 0.0).all()


@pytest.fixture(scope="module")
def fine():
    grid = make_grid(GELPAD, 0.2e-3)
    surface = CoatSurface(MESH.coat, GELPAD)
    compliances = [coat_compliance(MESH, GELPAD, rollers=rollers)[0, 2] for rollers in (False, True)]
    contact = NormalCorrection(surface, GELPAD, grid.x, grid.y, *compliances)
    return contact, grid, ContactSampler(contact, grid.x, grid.y)


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
    from raytac.physics.rigid.load_law import LoadLaw

    law = LoadLaw(np.maximum(ball(grid, 0.0) - grid.rest, 0.0), grid.x, grid.y, GELPAD)
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


def test_the_best_of_the_search_is_kept_and_its_residual_given(fine, monkeypatch):
    """With few iterations the contact is not solved, and the residual says by how much; with all it is."""
    under = ball(fine[1], 0.6e-3)
    residuals = []
    for iterations in (1, 4, 40):
        monkeypatch.setattr(fine[0], "settings", Correction(normal_iterations=iterations))
        shape, height = pressed(fine, under)
        gap = under - height
        worst = max(-gap.min(), np.abs(gap[shape.pressure > 0.0]).max())
        assert shape.residual == pytest.approx(worst, abs=0.3e-6)
        residuals.append(shape.residual)
    assert residuals[0] > residuals[1] > 5e-6 > 1e-6 > residuals[2]


@pytest.fixture(scope="module")
def skin(fine):
    continued = coat_compliance(MESH, GELPAD, rollers=True, along=(0, 1, 2))
    return TangentialCorrection(fine[0], GELPAD, coat_compliance(MESH, GELPAD)[0], continued)


def rigid(turn):
    """Where the vertices go with an object that turns by ``turn`` [rad] and is dragged by 0.3 mm for each radian."""
    rest, cosine, sine = MESH.coat.rest[:, :2], math.cos(turn), math.sin(turn)
    return rest @ np.array([[cosine, sine], [-sine, cosine]]) - rest + 0.3e-3 * turn


def spread(fine, skin, held_back=0.0, turn=0.0):
    """The shape under a ball, what the mesh does sideways under its forces, where the skin goes, and its distance from the axis."""
    contact, grid, _ = fine
    rest = MESH.coat.rest
    touching = np.hypot(*rest[:, :2].T) < 3.5e-3
    compliance = coat_compliance(MESH, GELPAD)[0]
    load = np.where(touching, 1.0 - (np.hypot(*rest[:, :2].T) / 4e-3) ** 2, 0.0) / touching.sum()
    moved = -(compliance @ load).T
    shape = contact.solve(contact.surface.places(np.zeros_like(moved)), moved[:, 2], load, ball(grid, 0.6e-3) - grid.rest)
    mesh = moved[:, :2].copy()
    moved[:, :2] *= 1.0 - held_back
    moved[:, :2] += rigid(turn)
    return shape, mesh, moved, skin.sideways(shape, moved, load), touching


def test_without_friction_the_meshs_spread_is_exchanged_for_the_layers(fine, skin):
    """Exactly, for a solver that did what the mesh does linearly; the layer's is symmetric and far from the mesh's."""
    shape, mesh, moved, went, touching = spread(fine, skin)
    layer = skin._layer(shape, *(MESH.coat.rest[:, k] + moved[:, k] for k in (0, 1)))
    assert np.abs(went - layer).max() < 1e-8
    assert np.abs(mesh - layer)[touching].max() > 0.5 * np.abs(mesh[touching]).max() > 5e-6
    by_rows = went.reshape(*MESH.coat.shape, 2)
    assert np.abs(by_rows + by_rows[:, ::-1] * [1.0, -1.0]).max() < 2e-8 + np.abs(by_rows).max() * 1e-3


def test_what_friction_keeps_back_is_not_taken_out_twice_and_the_objects_motion_stays(fine, skin):
    """Half of the spread is there: half of the mesh's is taken out, half of the layer's put in, wherever object and skin went besides."""
    (shape, mesh, moved, went, touching), turned = (spread(fine, skin, held_back=0.5, turn=turn) for turn in (0.0, 0.1))
    layer = skin._layer(shape, *(MESH.coat.rest[:, k] + moved[:, k] for k in (0, 1)))
    assert np.abs(went - 0.5 * layer).max() < 1e-8 < 0.01 * np.abs(mesh - layer).max()
    stuck = spread(fine, skin, held_back=1.0)
    assert not stuck[3].any()
    assert np.abs(turned[3] - went - rigid(0.1))[touching].max() < 0.1 * np.abs(mesh).max()


def test_sampling_is_bilinear():
    x, y = np.linspace(-1.0, 2.0, 7), np.linspace(0.0, 1.0, 5)
    field = 1.0 + 2.0 * x[None, :] - 3.0 * y[:, None] + 0.5 * x[None, :] * y[:, None]
    at_x, at_y = np.random.default_rng(0).uniform([[-1.0], [0.0]], [[2.0], [1.0]], (2, 50))
    assert sampled(field, x, y, at_x, at_y) == pytest.approx(1.0 + 2.0 * at_x - 3.0 * at_y + 0.5 * at_x * at_y)
    assert sampled(field, x, y, np.array([9.0]), np.array([0.5])) == sampled(field, x, y, np.array([2.0]), np.array([0.5]))


def test_waves_of_two_cells_are_taken_out_and_straight_lines_stay():
    lines = np.array([0.0, 0.4, 0.7, 1.2, 2.0, 2.1, 3.0])
    even = _smoothing(lines)
    assert np.allclose(even @ (3.0 - 2.0 * lines), 3.0 - 2.0 * lines)
    assert np.abs((even @ (-1.0) ** np.arange(7))[1:-1]).max() < 1e-12


@pytest.mark.parametrize(("ny", "nx"), [(12, 17), (9, 10)])
def test_a_sum_of_cosines_by_quarters_is_that_of_all_nodes(ny: int, nx: int) -> None:
    """Of even and odd numbers of nodes, in two environments of three."""
    rng, products = np.random.default_rng(3), Products(3, "cpu")
    x, y = np.linspace(-3e-3, 5e-3, nx), np.linspace(-2e-3, 2e-3, ny)
    along = CosineSeries(x), CosineSeries(y)
    amplitudes, out = products.zeros(ny, nx), products.zeros(ny, nx)
    factor, values = rng.random((ny, nx)), rng.normal(size=(3, ny, nx))
    amplitudes.numbers.assign(values.astype(np.float32))
    active = wp.array([1, 0, 1], dtype=wp.int32, device="cpu")
    CosineSum(along, x, y, products).find(products.constant(factor), amplitudes, active, out)
    expected = along[1].synthesis(y) @ (values * factor) @ along[0].synthesis(x).T
    expected[1] = 0.0
    np.testing.assert_allclose(out.numbers.numpy(), expected, rtol=0, atol=2e-5)


def test_pads_of_one_mesh_share_their_compliances_and_others_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[object] = []

    def counted(*args: Any, **options: Any) -> np.ndarray:
        made.append(args)
        return coat_compliance(*args, **options)

    monkeypatch.setattr(mesh_compliance, "_kept", {})
    monkeypatch.setattr(mesh_compliance, "coat_compliance", counted)
    level = PadLevel(2.5e-3, 3, 1.5, 1.5, 5e-5)
    first = correction_compliances(pad_mesh(GELPAD, level), GELPAD)
    again = correction_compliances(pad_mesh(GELPAD, level), GELPAD)
    assert again is first and len(made) == 2
    np.testing.assert_array_equal(first[0], coat_compliance(pad_mesh(GELPAD, level), GELPAD)[0])
    with pytest.raises(ValueError, match="read-only"):
        first[1][0] = 0.0
    softer = replace(GELPAD, youngs_modulus=0.5 * GELPAD.youngs_modulus)
    np.testing.assert_allclose(correction_compliances(pad_mesh(GELPAD, level), softer)[0], 2.0 * first[0], rtol=1e-9)
    blocks = replace(level, block=(2, 2, 1))
    assert not np.array_equal(correction_compliances(pad_mesh(GELPAD, blocks), GELPAD)[0], first[0]) and len(made) == 6
    monkeypatch.setattr(mesh_compliance, "_MOST_BYTES", 3 * sum(array.nbytes for array in first))
    correction_compliances(pad_mesh(GELPAD, replace(level, cell=4e-3)), GELPAD)
    assert correction_compliances(pad_mesh(GELPAD, level), GELPAD) is not first, "the oldest go first"
