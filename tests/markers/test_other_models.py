"""Superposition and force field: what follows from their formulas."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytac.gel.surface import PadGrid
from raytac.io.arrays import npy_bytes
from raytac.markers import superposition
from raytac.markers.pattern import marker_centres
from raytac.markers.sampling import height_and_slope
from raytac.markers.superposition import SuperpositionModel, cached_compliance, coat_compliance
from raytac.markers.tracker import MarkerTracker
from raytac.physics.soft.bodies import pad_body
from raytac.physics.soft.correction.mesh_compliance import rest_stiffness
from raytac.physics.soft.mesh import PadLevel, PadMesh, pad_mesh
from raytac.specs import SensorSpec
from tests.ipc.solver.test_elasticity import energy_change, make_potential
from tests.markers.pads import BALL, MOTION, pose, pressed

DEEP = 6e-4


@pytest.fixture(scope="module", params=[None, (2, 2, 1)], ids=["elements", "blocks"])
def small(sensor: SensorSpec, request: pytest.FixtureRequest) -> PadMesh:
    return pad_mesh(sensor.gelpad, PadLevel(4e-3, 2, 1.5, 1.5, 5e-5, request.param))


def test_stiffness_of_a_uniform_strain_is_the_closed_form(sensor: SensorSpec, small: PadMesh) -> None:
    """½ uᵀ K u = V (½ λ (tr ε)² + μ ε : ε) for u = ε x; a rigid motion costs nothing."""
    pad, rng = sensor.gelpad, np.random.default_rng(0)
    strain = rng.standard_normal((3, 3))
    strain = 0.5 * (strain + strain.T)
    x = small.tets.vertices
    u = (x @ strain.T).ravel()
    stiffness = rest_stiffness(small, pad)
    mu = pad.youngs_modulus / (2 * (1 + pad.poisson_ratio))
    lam = pad.youngs_modulus * pad.poisson_ratio / ((1 + pad.poisson_ratio) * (1 - 2 * pad.poisson_ratio))
    volume = pad.size[0] * pad.size[1] * pad.thickness
    expected = volume * (0.5 * lam * np.trace(strain) ** 2 + mu * (strain**2).sum())
    assert 0.5 * u @ stiffness.times(u) == pytest.approx(expected, rel=1e-9)
    turn = np.array([[0, -1, 0.3], [1, 0, -0.2], [-0.3, 0.2, 0.0]])
    rigid = (x @ turn.T + (1, 2, 3)).ravel()
    assert np.abs(stiffness.times(rigid)).max() < 1e-9 * np.abs(stiffness.value).max()


def test_stiffness_is_that_of_the_solver(sensor: SensorSpec, small: PadMesh) -> None:
    """½ uᵀ K u against the solver's elastic energy of a small displacement."""
    material = pad_body(small, sensor.gelpad).material
    own = 0.0 if small.volume_blocks is None else small.own_volume
    solver = make_potential(material, small.tets, small.bonded, small.volume_blocks, own)
    rest = small.tets.vertices
    u = 1e-8 * np.random.default_rng(3).standard_normal(rest.shape)
    u[small.bonded] = 0
    stiffness = rest_stiffness(small, sensor.gelpad)
    assert energy_change(solver, rest, rest + u) == pytest.approx(0.5 * u.ravel() @ stiffness.times(u.ravel()), rel=1e-3)


def test_compliance_solves_the_bonded_pad(sensor: SensorSpec, small: PadMesh) -> None:
    compliance = coat_compliance(small, sensor.gelpad)
    np.testing.assert_allclose(compliance, compliance.T, rtol=0, atol=1e-12 * np.abs(compliance).max())
    assert np.linalg.eigvalsh(compliance).min() > 0
    # Pushing a vertex down moves it down, and its neighbours aside from it.
    v = int(np.argmin(np.linalg.norm(small.coat.rest[:, :2], axis=1)))
    field = -compliance[:, 3 * v + 2].reshape(-1, 3)
    assert field[v, 2] < 0 and np.abs(field[v, :2]).max() < 0.02 * -field[v, 2]


def test_the_cache_gives_back_what_it_was_given_and_nothing_damaged(
    sensor: SensorSpec, small: PadMesh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAYTAC_CACHE", str(tmp_path))
    first = cached_compliance(small, sensor.gelpad)
    (kept,) = (tmp_path / "markers").glob("*.npy")
    whole = kept.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(superposition, "coat_compliance", lambda *_: pytest.fail("it was kept"))
        np.testing.assert_array_equal(cached_compliance(small, sensor.gelpad), first)
    made: list[int] = []
    monkeypatch.setattr(superposition, "coat_compliance", lambda *_: (made.append(1), first)[1])
    other = first.copy()
    other[0, 0] = np.nan
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0x40
    for count, data in enumerate((b"", whole[: len(whole) // 2], bytes(flipped), npy_bytes(other), b"broken"), 1):
        kept.write_bytes(data)
        with pytest.warns(RuntimeWarning, match="cannot be used and is made again"):
            np.testing.assert_array_equal(cached_compliance(small, sensor.gelpad), first)
        assert len(made) == count and kept.read_bytes() == whole
    monkeypatch.setenv("RAYTAC_CACHE", str(kept))  # a file, where nothing can be kept
    with pytest.warns(RuntimeWarning, match="cannot be written"):
        np.testing.assert_array_equal(cached_compliance(small, sensor.gelpad), first)


@pytest.fixture(scope="module")
def superposed(sensor: SensorSpec, grid: PadGrid) -> MarkerTracker:
    return MarkerTracker(sensor, "superposition", grid)


def test_superposition_of_a_symmetric_press_is_symmetric(sensor: SensorSpec, grid: PadGrid, superposed: MarkerTracker) -> None:
    superposed.reset()
    moved = superposed.update(pressed(grid, [(0, 0, DEEP)])).displacement[0]
    moved = moved.reshape(sensor.markers.rows, sensor.markers.columns, 2)
    assert np.abs(moved).max() > 2e-5
    np.testing.assert_allclose(moved[:, ::-1] * (-1, 1), moved, atol=2e-7)
    np.testing.assert_allclose(moved[::-1] * (1, -1), moved, atol=2e-7)


def test_superposition_drags_what_sticks(sensor: SensorSpec, grid: PadGrid, superposed: MarkerTracker) -> None:
    superposed.reset()
    start, end = (pressed(grid, [(x, 0, DEEP)], poses=[pose(x)]) for x in (0.0, 3e-4))
    before = superposed.update(start).displacement[0]
    moved = superposed.update(end).displacement[0] - before
    out = np.linalg.norm(marker_centres(sensor.markers), axis=1)
    assert moved[out.argmin(), 0] == pytest.approx(3e-4, rel=0.1)
    assert np.abs(moved[out > 8e-3]).max() < 1e-4
    superposed.reset()
    assert not superposed.update(pressed(grid, [])).displacement.any()


def test_superposition_slides_as_coulomb_has_it(sensor: SensorSpec, grid: PadGrid) -> None:
    """At μ = 0.3 a shear of two depths slides: markers stop, whatever the object does then; every load is in the cone, none pulls."""
    gel = replace(sensor, gelpad=replace(sensor.gelpad, friction=0.3))
    start = pressed(grid, [(0, 0, DEEP)], poses=[pose()])
    middle = int(np.linalg.norm(marker_centres(sensor.markers), axis=1).argmin())

    def sheared(sensor: SensorSpec, x: float) -> tuple[float, np.ndarray]:
        tracker = MarkerTracker(sensor, "superposition", grid)
        before = tracker.update(start).displacement[0, middle, 0]
        moved = tracker.update(pressed(grid, [(0, 0, DEEP)], poses=[pose(x)])).displacement[0, middle, 0] - before
        model = tracker.model
        assert isinstance(model, SuperpositionModel)
        height, _, touched = height_and_slope(start, model.coat.rest[None, :, :2])
        prescribed = np.zeros((len(model.coat.rest), 3))
        prescribed[:, 0], prescribed[:, 2] = x, height[0] - model.coat.rest[:, 2]
        coat = model._superpose(prescribed, touched[0] & (prescribed[:, 2] < 0))
        return moved, np.linalg.solve(model._compliance.astype(float) + 1e-9 * np.eye(coat.size), coat.ravel()).reshape(-1, 3)

    stuck, slid, further = (sheared(s, x) for s, x in ((sensor, 8e-4), (gel, 8e-4), (gel, 1.6e-3)))
    assert slid[0] < 0.6 * stuck[0] and further[0] == pytest.approx(slid[0], rel=0.05)
    load = slid[1]
    least = 1e-3 * np.abs(load).max()
    along, down = np.linalg.norm(load[:, :2], axis=1), -load[:, 2]
    assert (down > -least).all() and (along <= 0.3 * down + 3 * least).all()
    assert along.sum() > 0.25 * down.sum()


def test_force_field_moves_only_what_is_touched(sensor: SensorSpec, grid: PadGrid) -> None:
    tracker = MarkerTracker(sensor, "force_field", grid)
    moved = tracker.update(pressed(grid, [(0, 0, DEEP)])).displacement[0]
    out = marker_centres(sensor.markers)
    far = np.linalg.norm(out, axis=1)
    edge = np.sqrt(2 * BALL * DEEP - DEEP**2)
    assert not moved[far > edge + 1e-4].any()
    inside = (far > 1e-3) & (far < edge - 1e-4)
    assert inside.any() and ((moved * out).sum(axis=1)[inside] > 0).all()
    # g δ n_xy of a ball, where n_xy = r / R.
    depth = np.sqrt(np.maximum(BALL**2 - far**2, 0)) - (BALL - DEEP)
    np.testing.assert_allclose(moved[inside], (MOTION.field_gain * depth[:, None] * out / BALL)[inside], rtol=0.03, atol=3e-7)


def test_force_field_slips_at_its_friction(sensor: SensorSpec, grid: PadGrid) -> None:
    def sheared(x: float) -> np.ndarray:
        tracker = MarkerTracker(sensor, "force_field", grid)
        tracker.update(pressed(grid, [(0, 0, DEEP)], poses=[pose()]))
        end = tracker.update(pressed(grid, [(0, 0, DEEP)], poses=[pose(x)])).displacement[0]
        return end - MarkerTracker(sensor, "force_field", grid).update(pressed(grid, [(0, 0, DEEP)])).displacement[0]

    middle = int(np.linalg.norm(marker_centres(sensor.markers), axis=1).argmin())
    stuck, slipping, further = (sheared(x)[middle, 0] for x in (1e-4, 6e-4, 9e-4))
    assert stuck == pytest.approx(MOTION.field_gain * MOTION.field_shear * 1e-4, rel=0.02)
    assert slipping == pytest.approx(further) == pytest.approx(MOTION.field_gain * MOTION.field_friction * DEEP, rel=0.02)
