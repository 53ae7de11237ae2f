"""FOTS against an independent loop over nodes, and what it must do at zero load, zero twist and at its caps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.markers.base import MarkerModel
from raytac.markers.config import Fots
from raytac.markers.contact_tracker import ContactTracker
from raytac.markers.contacts import ContactCells
from raytac.markers.pattern import marker_centres
from raytac.markers.tracker import MarkerTracker
from raytac.specs import SensorSpec, load_sensor
from tests.markers.pads import MOTION, pose, pressed

DEEP = 6e-4


def run(sensor: SensorSpec, grid: PadGrid, *surfaces: GelSurface) -> np.ndarray:
    tracker = MarkerTracker(sensor, "fots", grid, num_envs=surfaces[0].batch, device="cpu")
    return [tracker.update(surface).displacement for surface in surfaces][-1]


def by_loop(
    sensor: SensorSpec, grid: PadGrid, surface: GelSurface, contacts: list[tuple[float, float, float, float, float]]
) -> np.ndarray:
    """Thesis eq. 4.1 to 4.3, node by node and marker by marker; ``contacts``: G_x, G_y, Δs_x, Δs_y, Δθ, all before the caps."""
    result = []
    dx, dy = grid.pitch
    ys, xs = np.nonzero(surface.contact[0])
    for mx, my in marker_centres(sensor.markers):
        ux = uy = 0.0
        for gx, gy, sx, sy, theta in contacts:
            share = min(1.0, MOTION.shear_max / max(math.hypot(sx, sy), 1e-12))
            sx, sy = sx * share, sy * share
            theta = max(-MOTION.twist_max, min(MOTION.twist_max, theta))
            ex, ey = mx - (gx - sx), my - (gy - sy)
            r2 = ex * ex + ey * ey
            ux, uy = ux + sx * math.exp(-MOTION.shear_lambda * r2), uy + sy * math.exp(-MOTION.shear_lambda * r2)
            e = math.exp(-MOTION.twist_lambda * r2)
            ux += e * (math.cos(theta) * ex - math.sin(theta) * ey - ex)
            uy += e * (math.sin(theta) * ex + math.cos(theta) * ey - ey)
        dragged_x, dragged_y = mx + ux, my + uy
        for j, i in zip(ys, xs, strict=True):
            h = grid.rest[j, i] - float(surface.height[0, j, i])
            ex, ey = dragged_x - grid.x[i], dragged_y - grid.y[j]
            w = MOTION.dilate_gain * dx * dy * h * math.exp(-MOTION.dilate_lambda * (ex * ex + ey * ey))
            ux, uy = ux + w * ex, uy + w * ey
        result.append((ux, uy))
    return np.array(result)


@pytest.mark.parametrize(("shear", "twist"), [((3e-4, -4e-4), -0.2), ((-6e-4, 7e-4), 0.8)], ids=["within", "beyond the caps"])
def test_it_equals_a_loop(shear: tuple[float, float], twist: float, sensor: SensorSpec, grid: PadGrid) -> None:
    x, y = 1e-3 + shear[0], -5e-4 + shear[1]
    first = pressed(grid, [(1e-3, -5e-4, DEEP)], poses=[pose(1e-3, -5e-4)])
    last = pressed(grid, [(x, y, DEEP)], poses=[pose(x, y, 0.0, twist)])
    expected = by_loop(sensor, grid, last, [(x, y, *shear, twist)])
    moved = run(sensor, grid, first, last)[0]
    assert np.linalg.norm(expected, axis=1).max() > 3e-4
    # The kernel sums cells of 0.4 mm where the loop sums nodes of 0.1 mm.
    np.testing.assert_allclose(moved, expected, atol=4e-6)


def test_the_sum_over_cells_alone_equals_a_loop_over_cells(sensor: SensorSpec, grid: PadGrid) -> None:
    """To rounding, on the kernel's own samples."""
    from raytac.markers.contacts import ContactCells
    from raytac.markers.fots import FotsKernel

    cells = ContactCells.over(grid)
    samples = cells.sample(pressed(grid, [(1e-3, 0, DEEP), (-3e-3, 2e-3, 3e-4)]))
    kernel = FotsKernel(cells.x, cells.y, device="cpu")
    markers = marker_centres(sensor.markers)
    motion = replace(MOTION, dilate_gain=2e8, dilate_lambda=1e5)
    none = np.zeros((1, 1, 12))
    moved = kernel.displacement(markers[None], samples.depth, samples.boxes, none, motion)[0]
    expected = np.zeros_like(markers)
    for j, i in zip(*np.nonzero(samples.contact[0]), strict=True):
        out = markers - (cells.x[i], cells.y[j])
        weight = 2e8 * cells.area * samples.depth[0, j, i] * np.exp(-1e5 * (out**2).sum(axis=1))
        expected += weight[:, None] * out
    assert np.abs(expected).max() > 1e-5
    np.testing.assert_allclose(moved, expected, atol=2e-9)


def test_nothing_moves_without_contact(sensor: SensorSpec, grid: PadGrid) -> None:
    turned = [pressed(grid, [], poses=[pose(x, 0, 1e-3, t)]) for x, t in ((0, 0), (1e-3, 0.5))]
    tracker = MarkerTracker(sensor, "fots", grid, device="cpu")
    for surface in turned:
        frame = tracker.update(surface)
        assert not frame.displacement.any() and not frame.displacement_px.any()


def test_a_touch_without_depth_shear_or_twist_moves_nothing(sensor: SensorSpec, grid: PadGrid) -> None:
    surface = pressed(grid, [(0, 0, DEEP)])
    flat = replace(surface, height=np.repeat(grid.rest[None], 1, axis=0).astype(np.float32))
    assert not run(sensor, grid, flat, flat).any()


def test_a_symmetric_press_moves_markers_symmetrically(sensor: SensorSpec, grid: PadGrid) -> None:
    moved = run(sensor, grid, pressed(grid, [(0, 0, DEEP)]))[0].reshape(sensor.markers.rows, sensor.markers.columns, 2)
    assert np.abs(moved).max() > 1e-5
    np.testing.assert_allclose(moved[:, ::-1] * (-1, 1), moved, atol=1e-7)
    np.testing.assert_allclose(moved[::-1] * (1, -1), moved, atol=1e-7)
    assert np.abs(moved.sum(axis=(0, 1))).max() < 1e-6


def test_it_dilates_outwards(sensor: SensorSpec, grid: PadGrid) -> None:
    moved, out = run(sensor, grid, pressed(grid, [(0, 0, DEEP)]))[0], marker_centres(sensor.markers)
    far = np.linalg.norm(out, axis=1) > 1e-3
    assert ((moved * out).sum(axis=1)[far] > 0).all()


def test_caps(sensor: SensorSpec, grid: PadGrid) -> None:
    """The skin that is dragged to the contact's centre, where there is no dilation, follows to the cap and no further."""
    middle = int(np.linalg.norm(marker_centres(sensor.markers), axis=1).argmin())
    for shear in (2e-4, 5e-4, 9e-4, 1.4e-3):
        followed = min(shear, MOTION.shear_max)
        start, end = (pressed(grid, [(x, 0, DEEP)], poses=[pose(x)]) for x in (followed - shear, followed))
        assert run(sensor, grid, start, end)[0, middle] == pytest.approx((followed, 0.0), abs=2e-6)

    def twisted(angle: float) -> np.ndarray:
        return run(sensor, grid, *(pressed(grid, [(0, 0, DEEP)], poses=[pose(twist=t)]) for t in (0.0, angle)))[0]

    # One object turned by either angle dilates alike, to float32.
    np.testing.assert_allclose(twisted(1.0), twisted(MOTION.twist_max), atol=2e-7)
    assert np.abs(twisted(0.1) - twisted(MOTION.twist_max)).max() > 1e-5


def test_close_contacts_do_not_drag_twice(sensor: SensorSpec, grid: PadGrid) -> None:
    """Two feet of one object, 2.5 mm apart: what lies between them moves with the object, not further."""

    def at(x: float) -> GelSurface:
        return pressed(grid, [(x - 1.25e-3, 0, 1e-4), (x + 1.25e-3, 0, 1e-4)], poses=[pose(x)])

    moved = run(sensor, grid, at(0.0), at(5e-4))[0]
    still = run(sensor, grid, at(0.0))[0]
    assert 4.5e-4 < (moved - still)[:, 0].max() < 5.1e-4


def test_batch_is_single(sensor: SensorSpec, grid: PadGrid) -> None:
    envs = [[(0.0, 0.0, DEEP)], [], [(3e-3, -2e-3, DEEP), (-3e-3, 1e-3, DEEP)]]
    poses = [pose(), pose(), pose()], [pose(2e-4), pose(2e-4), pose(2e-4, twist=0.1)]
    batch = run(sensor, grid, *(pressed(grid, *envs, poses=list(p)) for p in poses))
    for b, balls in enumerate(envs):
        single = run(sensor, grid, *(pressed(grid, balls, poses=[p[b]]) for p in poses))
        np.testing.assert_allclose(batch[b], single[0], rtol=0, atol=1e-9)
    assert np.abs(batch[2]).max() > 1e-5 and not batch[1].any()


def test_a_sensor_that_nobody_calibrated_says_how(grid: PadGrid) -> None:
    plain = replace(load_sensor("gelsight_mini_7x9"), marker_motion=None)
    for model in ("fots", "force_field"):
        with pytest.raises(InputError, match="raytac calibrate markers"):
            MarkerTracker(plain, model, grid, device="cpu")


def test_moved_places_at_rest_are_noticed(sensor: SensorSpec, grid: PadGrid) -> None:
    """The upload of places is kept from frame to frame: not when an array is another one, or was written to."""

    def make() -> MarkerModel:
        return Fots().build(sensor, grid, num_envs=1, device="cpu")

    model, cells = make(), ContactCells.over(grid)
    surface = pressed(grid, [(1e-3, 0, DEEP)])
    samples = cells.sample(surface)
    contacts = ContactTracker(1).update(surface, samples)
    rest = np.concatenate([marker_centres(sensor.markers), np.zeros((sensor.markers.rows * sensor.markers.columns, 1))], axis=1)
    rest, moved = rest[None], rest[None] + (7e-4, 0, 0)
    first = model.displacement(rest, surface, samples, contacts)
    expected = make().displacement(moved, surface, samples, contacts)
    assert np.abs(first - expected).max() > 1e-5
    np.testing.assert_array_equal(model.displacement(moved, surface, samples, contacts), expected)
    rest[:] = moved
    model.displacement(rest, surface, samples, contacts)
    rest[..., 0] -= 7e-4
    np.testing.assert_allclose(model.displacement(rest, surface, samples, contacts), first, atol=1e-9)
