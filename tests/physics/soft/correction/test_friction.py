"""Friction below the mesh's cells: the layer under shear, stick and slip, and what is exchanged of a coat's motion."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from raytac.gel.surface import make_grid
from raytac.physics.bonded_layer import layer_shear
from raytac.physics.soft.correction.mesh_compliance import coat_compliance
from raytac.physics.soft.mesh import PadLevel, pad_mesh
from raytac.specs import load_sensor
from tests.physics.soft.oracles import tangential
from tests.physics.soft.oracles.coat_surface import CoatSurface
from tests.physics.soft.oracles.normal import NormalCorrection
from tests.physics.soft.oracles.tangential import (
    FrictionCorrection,
    PlaneMotion,
    TangentialCorrection,
    _share,
    plane_displacement,
)

GELPAD = load_sensor("gelsight_mini").gelpad
MESH = pad_mesh(GELPAD, PadLevel(2.0e-3, 3, 1.5, 1.5, 5e-5))
REST = MESH.coat.rest
RADIUS = 2.5e-3


def test_long_waves_shear_the_layer_and_short_ones_a_half_space():
    young, nu, thickness = GELPAD.youngs_modulus, GELPAD.poisson_ratio, GELPAD.thickness
    short = np.array([2e4])
    along, across = layer_shear(short, GELPAD)
    assert along == pytest.approx(2.0 * (1.0 - nu**2) / (young * short), rel=1e-6)
    assert across == pytest.approx(2.0 * (1.0 + nu) / (young * short), rel=1e-6)
    for law in layer_shear(np.array([0.1]), GELPAD):
        assert law == pytest.approx(2.0 * thickness * (1.0 + nu) / young, rel=1e-3)


def test_finite_elements_tend_to_the_layers_answer_to_shear():
    """A wave of traction, along its wave vector and across, on a flat pad between rollers: linear tetrahedra against the closed forms."""
    flat = replace(GELPAD, dome_radius=(math.inf, math.inf))
    off = []
    for cell, layers in ((2.2e-3, 3), (1.1e-3, 6)):
        mesh = pad_mesh(flat, PadLevel(cell, layers, 1.0001, 1.5, 5e-5))
        k = np.array([3.0, 2.0]) * math.pi / np.array(flat.size)
        x, y = (k * (mesh.coat.rest[:, :2] + 0.5 * np.array(flat.size))).T
        waves = np.stack([np.sin(x) * np.cos(y), np.cos(x) * np.sin(y)])
        corners = mesh.coat.rest[mesh.coat.faces]
        area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        lumped = np.bincount(mesh.coat.faces.ravel(), np.repeat(area / 3.0, 3))
        compliance = coat_compliance(mesh, flat, rollers=True, along=(0, 1))[:, :2]
        truth = layer_shear(np.array([float(np.hypot(*k))]), flat)
        for way, law in zip((k, np.array([-k[1], k[0]])), truth, strict=True):
            traction = way[:, None] / np.hypot(*k) * waves
            moved = np.einsum("acij,aj->ci", compliance, traction * lumped)
            found = (moved * traction * lumped).sum() / (traction**2 * lumped).sum()
            off.append(abs(1.0 - found / float(law[0])))
    assert off[2] < 0.5 * off[0] and off[3] < 0.5 * off[1] and max(off) < 0.3 and min(off) > 0.0


@pytest.fixture(scope="module")
def contact():
    grid = make_grid(GELPAD, 0.2e-3)
    surface = CoatSurface(MESH.coat, GELPAD)
    found, continued = coat_compliance(MESH, GELPAD)[0], coat_compliance(MESH, GELPAD, rollers=True, along=(0, 1, 2))
    fine = NormalCorrection(surface, GELPAD, grid.x, grid.y, found[2], continued[2, 2])
    return fine, TangentialCorrection(fine, GELPAD, found, continued), continued[:2, :2]


@pytest.fixture(scope="module")
def stage(contact):
    return FrictionCorrection(contact[0], GELPAD, contact[2])


def dome(fine, height=1e5):
    """Pressure of a ball on a half-space over the fine grid [Pa]."""
    square = 1.0 - (fine.x[None, :] ** 2 + fine.y[:, None] ** 2) / RADIUS**2
    return height * np.sqrt(np.maximum(square, 0.0)).astype(np.float32)


def motion(x=0.0, y=0.0, turn=0.0):
    return PlaneMotion(np.zeros(2), np.array([x, y]), turn)


def mean_motion(solution):
    """Mean of the displacement in contact, weighted by the slip limit."""
    moved = np.moveaxis(solution.displacement, 0, -1).reshape(-1, 2)
    return PlaneMotion.fit(moved, solution.place.reshape(-1, 2), solution.bound.ravel())


def test_a_rigid_motion_is_found_again():
    place = np.random.default_rng(0).normal(size=(40, 2)) * 1e-3
    weight = np.random.default_rng(1).uniform(size=40)
    given = motion(1e-4, -2e-4, math.sin(0.4))
    turned = place @ np.array([[math.cos(0.4), math.sin(0.4)], [-math.sin(0.4), math.cos(0.4)]]) - place + given.shift
    assert np.allclose(given.at(place), turned)
    found = PlaneMotion.fit(turned, place, weight)
    assert found.sine == pytest.approx(math.sin(0.4)) and np.allclose(found.at(place), turned)


def test_what_sticks_moves_with_the_object(contact, stage):
    """With friction enough the contact moves as one, but for its very edge, and drags as a disc does on a half-space with a back."""
    goal = motion(1e-4, 0.5e-4, 0.05)
    solution = stage.solve(dome(contact[0]), goal, 1e4)
    inside = solution.bound > 0.0
    well = inside & (np.hypot(solution.place[..., 0], solution.place[..., 1]) < RADIUS - 0.3e-3)
    off = np.abs(np.moveaxis(solution.displacement, 0, -1) - goal.at(solution.place)).max(axis=-1)
    assert well.sum() > 300 and off[well].max() < 3e-6 and off[inside].max() < 3e-5
    assert np.hypot(*solution.traction).max() < solution.bound.max()
    force = solution.traction.sum(axis=(1, 2)) * 4e-8
    disc = 8.0 * RADIUS / (2.0 - GELPAD.poisson_ratio) * GELPAD.youngs_modulus / (2.0 * (1.0 + GELPAD.poisson_ratio)) * goal.shift
    assert (force > 1.05 * disc).all() and (force < 2.0 * disc).all()  # a disc on a half-space, which has no back to hold it


def test_slip_begins_at_the_edge_and_never_exceeds_friction(contact, stage):
    pressure, friction = dome(contact[0]), 0.4
    normal = pressure.sum() * 4e-8
    slipping, forces = [], []
    for shift in (3e-5, 6e-5, 1.2e-4):
        solution = stage.solve(pressure, motion(shift), friction)
        size, inside = np.hypot(*solution.traction), solution.bound > 0.0
        assert (size <= solution.bound * 1.0001).all() and size.max() > 0.0
        radius = np.hypot(solution.place[..., 0], solution.place[..., 1])
        slips = inside & (size > 0.999 * solution.bound)
        if slips.any() and (inside & ~slips).any():
            assert radius[slips].mean() > radius[inside & ~slips].mean()
        slipping.append(slips.sum() / inside.sum())
        forces.append(solution.traction[0].sum() * 4e-8)
        assert abs(solution.traction[1].sum()) < 1e-3 * solution.traction[0].sum()
    assert np.all(np.diff(slipping) > 0.0) and slipping[-1] < 0.9
    assert np.all(np.diff(forces) > 0.0) and forces[-1] < friction * normal


def test_where_all_slides_friction_is_as_large_as_the_motion_says(contact, stage):
    """A mean motion that μ p cannot reach: traction in proportion to pressure, and more of it."""
    goal = motion(0.0, 6e-4)
    solution = stage.solve(dome(contact[0]), goal, 0.4)
    inside = solution.bound > 0.0
    assert (np.hypot(*solution.traction) > 0.999 * solution.bound)[inside].mean() > 0.9
    assert solution.bound.max() > 1.2 * 0.4 * dome(contact[0]).max()
    mean = mean_motion(solution)
    assert mean.shift == pytest.approx(goal.shift, abs=0.03 * 6e-4)


def test_less_is_exchanged_where_the_contact_moved_otherwise(stage):
    moved, weight = np.random.default_rng(0).normal(size=(30, 2)), np.ones(30)
    shares = [stage._blend((1.0 - missed) * moved, moved, weight) for missed in (0.0, 0.29, 0.4, 0.51, 1.0)]
    assert shares == pytest.approx([1.0, 1.0, 0.5, 0.0, 0.0])


@pytest.mark.parametrize("squeezed", [0.0, 3e-6, 1e-5])
def test_a_press_a_little_off_the_middle_is_shown_as_one_there(contact, stage, squeezed):
    """What friction has kept back, with hardly a motion of the whole besides: there was a jump where that motion began to count."""
    touching = np.hypot(*REST[:, :2].T) < 2.2e-3
    load = np.where(touching, 1.0, 0.0)
    pattern = np.where(touching[:, None], REST[:, :2] * np.hypot(*REST[:, :2].T)[:, None], 0.0)
    pattern *= squeezed / np.abs(pattern).max()
    shape = SimpleNamespace(pressure=dome(contact[0]))
    moved = [pattern + np.array([shift, 0.0]) for shift in (0.0, 4.9e-7, 5.2e-7, 1e-6)]
    shown = [stage.correct(shape, one, touching, load, 0.6) for one in moved]  # type: ignore[arg-type]
    assert np.abs(np.diff(shown, axis=0)).max() < 1e-6
    assert np.abs(shown[-1]).max() > 0.9 * min(squeezed, 4e-6)


def test_the_mean_motion_is_the_one_asked_for_also_where_the_edge_slips(contact, stage):
    for goal in (motion(2e-5), motion(0.0, -2e-5), motion(turn=0.01), motion(1e-5, 1e-5, -0.005)):
        solution = stage.solve(dome(contact[0]), goal, 0.6)
        assert (np.hypot(*solution.traction) > 0.999 * solution.bound)[solution.bound > 0.0].mean() > 0.02
        mean = mean_motion(solution)
        at = solution.place[solution.bound > 0.0]
        assert np.abs(mean.at(at) - goal.at(at)).max() < 1.5e-6


def dragged(contact, x=0.0, y=0.0, turn=0.0):
    """A linear solution of the mesh that is held down and sticks, and what the skin is shown to do with the exchange and without."""
    fine, skin, compliance = contact
    touching = np.hypot(*REST[:, :2].T) < 2.2e-3
    v = len(REST)
    load = np.where(touching, 1.0 - (np.hypot(*REST[:, :2].T) / 4e-3) ** 2, 0.0) / touching.sum()
    goal = motion(x, y, turn).at(REST[:, :2])
    at = np.flatnonzero(np.tile(touching, 2))
    whole = compliance.transpose(1, 2, 0, 3).reshape(2 * v, 2 * v)
    sideways = (whole[:, at] @ np.linalg.solve(whole[np.ix_(at, at)], goal.T.ravel()[at])).reshape(2, v).T
    moved = np.concatenate([sideways, np.zeros((v, 1))], axis=1)
    grid = make_grid(GELPAD, 0.2e-3)
    square = (4e-3) ** 2 - grid.x[None, :] ** 2 - grid.y[:, None] ** 2
    under = np.where(square > 0, 4e-3 - 0.6e-3 - np.sqrt(np.maximum(square, 0.0)), np.inf)
    down = coat_compliance(MESH, GELPAD)[0, 2] @ -load
    shape = fine.solve(fine.surface.places(moved), down, load, under - grid.rest)
    return shape, moved, touching, skin.sideways(shape, moved, load, 1e4), skin.sideways(shape, moved, load)


def test_a_linear_drag_of_the_mesh_is_exchanged_for_the_layers(contact, stage):
    """In contact the skin goes with the object, around it as the layer under the fine contact's friction does, whatever the mesh did."""
    shape, moved, touching, went, before = dragged(contact, 2e-4)
    solution = stage.solve(shape.pressure, motion(2e-4), 1e4)
    layer = plane_displacement(solution.waves, stage._vertices).reshape(2, -1).T
    assert np.abs(before - moved[:, :2]).max() < 2e-6  # nothing was exchanged: no spread is in a drag
    assert np.abs(went - layer).max() < 4e-6
    assert np.abs(went - moved[:, :2])[~touching].max() > 2e-5


def test_the_skin_follows_a_mirrored_or_turned_drag_likewise(contact):
    rows, columns = MESH.coat.shape
    right, left = (dragged(contact, x)[3].reshape(rows, columns, 2) for x in (1e-4, -1e-4))
    assert np.abs(right - left[:, ::-1] * [-1.0, 1.0]).max() < 1e-6 < 1e-2 * np.abs(right).max()
    up = dragged(contact, y=1e-4)[3].reshape(rows, columns, 2)
    assert np.abs(up - up[:, ::-1] * [-1.0, 1.0]).max() < 1e-6
    twist = dragged(contact, turn=0.05)[3]
    assert np.abs((twist * REST[:, :2]).sum(axis=1)).max() < 0.15 * np.abs(twist).max() * np.abs(REST[:, :2]).max()
    assert np.abs(twist.sum(axis=0)).max() < 1e-3 * np.abs(twist).sum()


def test_forces_that_hold_are_those_of_a_direct_solve_and_what_cannot_move_bears_none(stage):
    rng = np.random.default_rng(0)
    square = rng.normal(size=(12, 12))
    whole = square @ square.T + np.eye(12)
    whole[3] = whole[:, 3] = whole[7] = whole[:, 7] = 0.0
    compliance, moved = (1e-3 * whole).astype(np.float32), rng.normal(size=12).astype(np.float32)
    free = np.isin(np.arange(12), (3, 7), invert=True)
    force = stage._mesh_forces(compliance, moved)
    assert (force[~free] == 0.0).all()
    assert force[free] == pytest.approx(np.linalg.solve(1e-3 * whole[np.ix_(free, free)], moved[free]), rel=1e-2)
    assert np.abs(compliance @ force - moved)[free].max() < 1e-6
    assert not stage._mesh_forces(np.zeros((4, 4), np.float32), moved[:4]).any()


@pytest.mark.parametrize("corner", [False, True])
def test_a_contact_at_the_pads_border_is_exchanged_too(contact, stage, corner, monkeypatch):
    """The sides cannot move across themselves in the mesh that is held: their rows of the compliance are 0, and a solve of all is NaN."""
    monkeypatch.setattr(stage, "_blend", lambda *args: 1.0)
    fine, edge = contact[0], 0.5 * np.array(GELPAD.size)
    at = edge * [1.0, 1.0 if corner else 0.0]
    square = 1.0 - ((fine.x[None, :] - at[0]) ** 2 + (fine.y[:, None] - at[1]) ** 2) / RADIUS**2
    shape = SimpleNamespace(pressure=1e5 * np.sqrt(np.maximum(square, 0.0)).astype(np.float32))
    touching = np.hypot(*(REST[:, :2] - at).T) < 3.5e-3
    assert (REST[touching, 0] > edge[0] - 1e-9).any()
    moved = np.tile([-5e-5, -1e-4], (len(REST), 1))
    shown = stage.correct(shape, moved, touching, np.where(touching, 1.0, 0.0), 0.6)
    assert np.isfinite(shown).all() and 1e-6 < np.abs(shown[:, 1]).max() < 1e-4


def test_a_contact_that_nothing_moves_is_left_alone(contact, stage, monkeypatch):
    monkeypatch.setattr(
        tangential, "plane_displacement", lambda waves, lines: np.zeros((2, len(lines[1][0]), lines[0][0].shape[1]))
    )
    assert stage.solve(dome(contact[0]), motion(1e-4), 0.6) is None


def test_what_is_not_trusted_is_not_exchanged_whatever_it_is(contact, stage, monkeypatch):
    monkeypatch.setattr(stage, "_blend", lambda *args: 0.0)
    monkeypatch.setattr(stage, "_mesh_forces", lambda compliance, moved: np.full_like(moved, np.nan))
    touching = np.hypot(*REST[:, :2].T) < 2.2e-3
    shape = SimpleNamespace(pressure=dome(contact[0]))
    shown = stage.correct(shape, np.full((len(REST), 2), 1e-4), touching, np.where(touching, 1.0, 0.0), 0.6)
    assert (shown == 0.0).all()


@pytest.mark.parametrize("angle", [0.2, 0.7, 1.2])
def test_a_turn_does_not_change_what_friction_is_said_to_have_let_happen(angle):
    """The radial part of a finite rotation was once taken for spread that friction had kept back."""
    place = REST[np.hypot(*REST[:, :2].T) < 4e-3, :2]
    spread = place * (1.0 - np.hypot(*place.T) / 8e-3)[:, None] * 0.01
    moved = 0.6 * spread
    cosine, sine = math.cos(angle), math.sin(angle)
    turned = place @ np.array([[cosine, sine], [-sine, cosine]]) - place + 1e-4
    assert _share(spread, moved, place) == pytest.approx(0.6, abs=1e-9)
    assert _share(spread, moved + turned, place) == pytest.approx(0.6, abs=1e-6)
