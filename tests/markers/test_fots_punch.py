"""The punch form of FOTS: an independent loop, the closed forms of contact mechanics, and what every frame of reference must agree on."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from raytac.gel.surface import PadGrid
from raytac.markers.calibration import model_errors
from raytac.markers.contacts import ContactCells
from raytac.markers.fots import FotsKernel
from raytac.specs import PunchSpec, SensorSpec
from tests.markers.pads import MOTION, fots_presses

NU = 0.48
HALF_SPACE = PunchSpec(NU / (2 - NU), 1e6, 1e9, 0.0, 1e5)
"""An elastic half-space on which nothing slips."""
PAD = PunchSpec(0.7, 6e-3, 1e3, 0.0, 1e5)
TURN = 9 * math.pi / 32 / 1.5
"""Spin at the edge over shear, each as far as it sticks alone."""
PLACES = np.random.default_rng(0).uniform(-8e-3, 8e-3, (200, 2))


def moved(
    grid: PadGrid,
    punch: PunchSpec | None,
    contacts: list[tuple[float, ...]],
    markers: np.ndarray = PLACES,
    *,
    gain: float = 0.0,
    depth: np.ndarray | None = None,
) -> np.ndarray:
    """Markers (M, 2) moved by contacts (G_x, G_y, Δs_x, Δs_y, Δθ, T_xx, T_xy, T_yy, h̄), by the kernel."""
    cells = ContactCells.over(grid)
    kernel = FotsKernel(cells.x, cells.y, device="cpu")
    unread = np.full((len(contacts), 2), 1e3)
    table = np.concatenate([np.ones((len(contacts), 1)), np.array(contacts), unread], axis=1)[None]
    nothing = np.zeros((1, len(cells.y), len(cells.x)), dtype=np.float32)
    samples = nothing if depth is None else depth[None].astype(np.float32)
    box = np.array([[0, len(cells.x), 0, len(cells.y)]], dtype=np.uint32)
    motion = replace(MOTION, dilate_gain=gain, dilate_lambda=1e5, shear_max=1e-3, twist_max=0.5)
    motion = replace(motion, punch=punch and replace(punch, dilate_gain=gain))
    return kernel.displacement(markers[None], samples, box, table, motion)[0].astype(float)


def limited(shear: np.ndarray, theta: float, most: float, widest: float) -> tuple[np.ndarray, float]:
    """The closest point of the ellipsoid in elastic energy, by bisection: K_t / K_f = A², as on incompressible rubber."""
    x, y = np.hypot(*shear) / most, abs(theta) / widest
    if x * x + y * y <= 1:
        return shear, theta
    low, high = 0.0, x + y
    for _ in range(80):
        middle = 0.5 * (low + high)
        if (x / (1 + middle)) ** 2 + (y / (1 + middle / TURN**2)) ** 2 > 1:
            low = middle
        else:
            high = middle
    return shear / (1 + low), theta / (1 + low / TURN**2)


def by_loop(punch: PunchSpec, contacts: list[tuple[float, ...]], grid: PadGrid, gain: float, depth: np.ndarray) -> np.ndarray:
    """Contact by contact, marker by marker and cell by cell, with the confocal coordinate by bisection."""
    cells, result = ContactCells.over(grid), []
    for mx, my in PLACES:
        shears, twists, es, et = np.zeros(2), np.zeros(2), 0.0, 0.0
        for gx, gy, sx, sy, theta, xx, xy, yy, mean in contacts:
            shape = np.array([[xx, xy], [xy, yy]])
            radius = np.linalg.det(shape) ** 0.25
            most = punch.slip * mean * radius
            shear, theta = limited(np.array([sx, sy]), theta, most, TURN * most / radius)
            x = np.array([mx, my]) - (np.array([gx, gy]) - shear)
            low, high = 0.0, float(x @ x)
            for _ in range(80):
                middle = 0.5 * (low + high)
                if x @ np.linalg.solve(shape + middle * np.eye(2), x) > 1:
                    low = middle
                else:
                    high = middle
            r = math.sqrt(radius**2 + low)
            t = radius / r
            g = t * math.sqrt(max(1 - t * t, 0.0))
            fade = math.exp(-(r - radius) / punch.reach)
            hat = x / max(np.hypot(*x), 1e-12)
            bent = punch.anisotropy * g
            shears += 2 / math.pi * ((fade * math.asin(t) - bent) * shear + 2 * bent * hat * (hat @ shear))
            es += 2 / math.pi * fade * math.asin(t)
            w = 2 / math.pi * (math.asin(t) - g)
            twists += w * np.array(
                [math.cos(theta) * x[0] - math.sin(theta) * x[1] - x[0], math.sin(theta) * x[0] + math.cos(theta) * x[1] - x[1]]
            )
            et += w
        drag = shears / max(1.0, es) + twists / max(1.0, et)
        total, free = drag.copy(), max(0.0, 1 - et)
        for j, i in zip(*np.nonzero(depth), strict=True):
            e = np.array([mx, my]) + drag - (cells.x[i], cells.y[j])
            total += free * gain * cells.area * depth[j, i] * e * math.exp(-1e5 * (e @ e))
        result.append(total)
    return np.array(result)


def disc(radius: float, *, shear: tuple[float, float] = (0.0, 0.0), twist: float = 0.0, mean: float = 3e-4) -> tuple[float, ...]:
    """A round contact about the origin, where the skin was at rest."""
    return shear[0], shear[1], *shear, twist, radius**2, 0.0, radius**2, mean


def test_it_equals_a_loop(grid: PadGrid) -> None:
    contacts = [
        (1e-3, -5e-4, 3e-4, -4e-4, -0.15, 9e-6, 3e-6, 2.5e-6, 3e-4),
        (-3e-3, 2e-3, -5e-4, 6e-4, 0.6, 1e-6, 0.0, 1e-6, 1.5e-4),  # past its slip, sideways and around
        (4e-3, 3e-3, 2e-4, 1e-4, -0.05, 1e-6, 0.0, 1e-6, 2.5e-4),  # within either limit alone, not within both
    ]
    cells = ContactCells.over(grid)
    depth = np.where((cells.x[None] - 1e-3) ** 2 + (cells.y[:, None] + 5e-4) ** 2 < 4e-6, 3e-4, 0.0)
    expected = by_loop(PAD, contacts, grid, 2e8, depth)
    assert np.linalg.norm(expected, axis=1).max() > 3e-4
    np.testing.assert_allclose(moved(grid, PAD, contacts, gain=2e8, depth=depth), expected, atol=2e-8)


def test_under_the_contact_the_skin_is_the_object(grid: PadGrid) -> None:
    """Shear: as far as the object; twist: a rotation, no linear cross product, at 0.5 rad."""
    inside = PLACES[np.linalg.norm(PLACES, axis=1) < 3e-3]
    assert len(inside) > 10
    still = replace(PAD, slip=1e5)
    shear = (3e-4, -2e-4)
    np.testing.assert_allclose(
        moved(grid, still, [disc(3.4e-3, shear=shear)], inside), np.tile(shear, (len(inside), 1)), atol=1e-9
    )
    c, s = math.cos(0.5), math.sin(0.5)
    turned = inside @ np.array([[c, s], [-s, c]]) - inside
    np.testing.assert_allclose(moved(grid, still, [disc(3.4e-3, twist=0.5)], inside), turned, atol=2e-9)


def test_far_away_it_is_the_point_load_of_cerruti(grid: PadGrid) -> None:
    """u = F / (2π G r) ((1 − ν) s + ν x̂ (x̂ · s)), with the force of the disc, F = 8 G A Δs / (2 − ν) (Johnson §3.2, 3.6)."""
    radius, shear = 0.4e-3, np.array([2e-4, 1e-4])
    far = PLACES[np.linalg.norm(PLACES, axis=1) > 5e-3]
    r = np.linalg.norm(far, axis=1, keepdims=True)
    hat = far / r
    point = 8 * radius / (2 - NU) / (2 * math.pi * r) * ((1 - NU) * shear + NU * hat * (hat @ shear)[:, None])
    result = moved(grid, HALF_SPACE, [disc(radius, shear=(shear[0], shear[1]))], far)
    np.testing.assert_allclose(result, point, atol=0.01 * np.linalg.norm(point, axis=1).max())


def test_far_away_a_twist_is_the_couple_on_a_point(grid: PadGrid) -> None:
    """u_θ = T / (4π G r²) with T = 16/3 G A³ Δθ (Reissner and Sagoci)."""
    radius, angle = 0.8e-3, 0.05
    far = PLACES[np.linalg.norm(PLACES, axis=1) > 6e-3]
    r = np.linalg.norm(far, axis=1)
    result = moved(grid, HALF_SPACE, [disc(radius, twist=angle)], far)
    around = (result * np.stack([-far[:, 1], far[:, 0]], axis=1)).sum(axis=1) / r
    np.testing.assert_allclose(around, 16 / 3 * radius**3 * angle / (4 * math.pi * r**2), rtol=0.02)


def test_turning_the_load_turns_the_field(grid: PadGrid) -> None:
    c, s = math.cos(0.9), math.sin(0.9)
    turn = np.array([[c, -s], [s, c]])
    shear, shape = np.array([4e-4, 1e-4]), np.diag((9e-6, 1e-6))
    turned_shear, turned_shape = turn @ shear, turn @ shape @ turn.T

    def field(shear: np.ndarray, shape: np.ndarray, markers: np.ndarray) -> np.ndarray:
        return moved(grid, PAD, [(*shear, *shear, 0.1, shape[0, 0], shape[0, 1], shape[1, 1], 3e-4)], markers)

    plain = field(shear, shape, PLACES)
    assert np.linalg.norm(plain, axis=1).max() > 3e-4
    np.testing.assert_allclose(field(turned_shear, turned_shape, PLACES @ turn.T), plain @ turn.T, atol=3e-9)
    # Without it: a sheared disc alone already moves farther along than across.
    assert np.abs(field(turned_shear, shape, PLACES @ turn.T) - plain @ turn.T).max() > 1e-5


@pytest.mark.parametrize("punch", [None, PAD, replace(PAD, anisotropy=0.0), replace(PAD, slip=0.0)])
def test_no_load_moves_nothing(punch: PunchSpec | None, grid: PadGrid) -> None:
    """Also a marker at the very centre, a touch of no depth, and a contact of one cell."""
    markers = np.concatenate([PLACES, np.zeros((1, 2))])
    for contact in (disc(2e-3), disc(2e-3, mean=0.0), disc(1e-5)):
        assert not moved(grid, punch, [contact], markers).any()
    sheared = moved(grid, punch, [disc(2e-3, shear=(1e-12, 0.0), twist=1e-12)], markers)
    assert np.isfinite(sheared).all() and np.abs(sheared).max() < 2e-12
    large = moved(grid, punch, [disc(2e-3, shear=(1e-3, 0.0), twist=1.0)], markers)
    assert np.isfinite(large).all()


def test_it_stops_where_it_slips(grid: PadGrid) -> None:
    """Shear up to c h̄ A, and half of that at half the indentation; a spin likewise."""
    centre = np.zeros((1, 2))
    for mean, most in ((3e-4, 6e-4), (1.5e-4, 3e-4)):
        for shear, followed in ((0.5 * most, 0.5 * most), (most, most), (2 * most, most)):
            contact = (shear, 0.0, shear, 0.0, 0.0, 4e-6, 0.0, 4e-6, mean)
            assert moved(grid, PAD, [contact], centre)[0, 0] == pytest.approx(followed, rel=1e-5)
        edge = np.array([[1.9e-3, 0.0]])
        spun = [np.linalg.norm(moved(grid, PAD, [disc(2e-3, twist=t, mean=mean)], edge)) for t in (0.05, 0.8, 1.6)]
        assert spun[0] == pytest.approx(2 * math.sin(0.025) * 1.9e-3, rel=1e-4) and spun[1] == pytest.approx(spun[2], rel=1e-6)
        assert spun[1] == pytest.approx(2 * math.sin(0.5 * 3 * math.pi / 16 * most / 2e-3) * 1.9e-3, rel=1e-4)


def test_a_contact_that_spins_slides_sideways(grid: PadGrid) -> None:
    """Shear and spin share one friction: far past the limit the remaining shear goes to 0 as the spin grows, and vice versa."""
    centre, edge = np.zeros((1, 2)), np.array([[1.9e-3, 0.0]])
    most = PAD.slip * 3e-4 * 2e-3
    widest = TURN * most / 2e-3

    def after_slip(shear: float, turn: float) -> tuple[float, float]:
        dragged, theta = limited(np.array([shear, 0.0]), turn, most, widest)
        contact = (dragged[0], 0.0, shear, 0.0, turn, 4e-6, 0.0, 4e-6, 3e-4)
        shift = moved(grid, PAD, [contact], centre)[0, 0]
        spun = moved(grid, PAD, [contact], edge)[0] - (shift, 0.0)
        assert np.linalg.norm(spun) == pytest.approx(2 * math.sin(0.5 * theta) * 1.9e-3, rel=1e-3)
        return shift, theta

    within = after_slip(0.6 * most, 0.6 * widest)
    assert within == pytest.approx((0.6 * most, 0.6 * widest), rel=1e-5)
    shears, turns = zip(*(after_slip(2 * most, k * widest) for k in (0.0, 0.5, 2.0, 8.0, 30.0)), strict=True)
    assert shears[0] == pytest.approx(most, rel=1e-5) and turns[0] == 0
    assert (np.diff(shears) < 0).all() and (np.diff(turns) > 0).all()
    assert shears[-1] < 0.25 * most and turns[-1] == pytest.approx(widest, rel=0.05)
    for shear, turn in zip(shears, turns, strict=True):
        assert math.hypot(shear / most, turn / widest) == pytest.approx(1, rel=1e-5)


def test_alike_in_all_directions_and_as_published(grid: PadGrid) -> None:
    """κ = 0 moves all markers along the shear; without the punch the published Gaussians come out to rounding."""
    shear, contact = np.array([3e-4, 1e-4]), disc(2e-3, shear=(3e-4, 1e-4))
    even = moved(grid, replace(PAD, anisotropy=0.0), [contact])
    assert np.abs(even[:, 0] * shear[1] - even[:, 1] * shear[0]).max() < 1e-12 and np.abs(even).max() > 2e-4
    r2 = (PLACES**2).sum(axis=1)
    np.testing.assert_allclose(moved(grid, None, [contact]), np.exp(-0.8e5 * r2)[:, None] * shear, atol=1e-10)


def test_errors_of_the_published_form_are_those_without_the_punch(sensor: SensorSpec, grid: PadGrid) -> None:
    with_punch = replace(sensor, marker_motion=replace(MOTION, punch=PAD))
    frames = fots_presses(with_punch, grid)
    errors, times = model_errors(with_punch, frames, grid, models=("fots", "fots_published"), device="cpu")
    plain, _ = model_errors(sensor, frames, grid, models=("fots",), device="cpu")
    by = {(e.model, e.load): e.mean for e in errors}
    for row in plain:
        assert by["fots_published", row.load] == row.mean
    assert by["fots", "shear"] < 0.1 * by["fots_published", "shear"] and set(times) == {"surface", "fots", "fots_published"}
