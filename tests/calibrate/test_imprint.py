"""The imprint: a sphere where the slope is that of a sphere, pixels that see the surface that the ray tracer gets, parallax."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.calibrate.imprint import KNOTS, RIGID_PAD, circles_on_pad, on_plane, pixel_geometry, press_surface, rest_geometry
from raytac.errors import InputError
from raytac.gel.surface import make_grid
from raytac.specs import SensorSpec, load_sensor

RADIUS = np.array([3.155e-3, 4.0e-3])
CIRCLES = np.array([[120.0, 90.0, 30.0], [230.0, 160.0, 34.0]])


@pytest.fixture(scope="module")
def mini() -> SensorSpec:
    return load_sensor("gelsight_mini")


def test_slopes_of_a_sphere_give_a_sphere(mini: SensorSpec) -> None:
    """s = t inside the contact is sin θ = ρ / R: depth differences are those of the ball, √(R² − ρ²)."""
    slopes = np.where(KNOTS[1:-1] <= 1, KNOTS[1:-1], 0.0)
    grid = make_grid(mini.gelpad, 0.1e-3)
    surface = press_surface(mini, grid, CIRCLES, RADIUS, slopes)
    for k, (x, y, a) in enumerate(circles_on_pad(mini, CIRCLES, RADIUS)):
        rho = np.hypot(grid.x[None, :] - x, grid.y[:, None] - y)
        inside = rho < 0.95 * a
        depth = (grid.rest - surface.height[k])[inside]
        ball = np.sqrt(RADIUS[k] ** 2 - rho[inside] ** 2)
        apart = depth - ball
        assert np.ptp(apart) < 2e-6 and np.ptp(ball) > 1e-4


def test_pixels_see_the_surface(mini: SensorSpec) -> None:
    grid = make_grid(mini.gelpad, 0.05e-3)
    surface = press_surface(mini, grid, CIRCLES, RADIUS, RIGID_PAD)
    rng = np.random.default_rng(0)
    press = np.repeat([0, 1], 200)
    u, v = (CIRCLES[press, k] + rng.uniform(-50, 50, 400) for k in (0, 1))
    camera = mini.camera
    seen = pixel_geometry(mini, on_plane(camera, u, v), press, circles_on_pad(mini, CIRCLES, RADIUS), RADIUS, RIGID_PAD)
    # On the ray of the pixel …
    for k, pixel in enumerate((u, v)):
        share = (seen.p[2] - camera.position[2]) / -camera.position[2]
        np.testing.assert_allclose(seen.p[k], (pixel - camera.principal_point[k]) * camera.pixel_pitch[k] * share, atol=1e-9)
    # … on the surface that the ray tracer gets, …
    ix, iy = (np.rint((seen.p[k] - axis[0]) / (axis[1] - axis[0])).astype(int) for k, axis in enumerate((grid.x, grid.y)))
    slope = np.hypot(seen.n[0], seen.n[1]) / -seen.n[2]
    assert (np.abs(surface.height[press, iy, ix] - seen.p[2]) < 5e-6 + 0.04e-3 * slope).all()
    # … with its normal.
    zy, zx = np.gradient(surface.height.astype(float), grid.y, grid.x, axis=(1, 2))
    normal = np.stack([zx[press, iy, ix], zy[press, iy, ix], -np.ones(400)])
    normal /= np.linalg.norm(normal, axis=0)
    assert np.median(np.abs(normal - seen.n)) < 0.01 < np.abs(seen.n[:2]).max()
    np.testing.assert_allclose(np.linalg.norm(seen.n, axis=0), 1)


@pytest.mark.parametrize("name", ["gelsight_mini", "gelsight_dome"])
def test_pixels_see_the_coat_at_rest(name: str) -> None:
    """On the pixel's ray, on the surface at rest, and with its normal by differences."""
    sensor = load_sensor(name)
    camera, pad = sensor.camera, sensor.gelpad
    u, v = np.random.default_rng(0).uniform(0.3, 0.7, (2, 200)) * np.array(camera.resolution)[:, None]
    seen = rest_geometry(sensor, on_plane(camera, u, v))
    x, y, z = seen.p
    np.testing.assert_allclose(z, -pad.sag(x, y), atol=1e-7)
    tx, ty = ((seen.p[k] - camera.position[k]) / (z - camera.position[2]) for k in (0, 1))
    focal, middle = camera.focal, camera.principal_point
    for image, pixel, f, c in zip(camera.lens.image(tx, ty), (u, v), focal, middle, strict=True):
        np.testing.assert_allclose(f * image + c, pixel, atol=1e-6)
    rise = np.stack(
        [pad.sag(x - 1e-6, y) - pad.sag(x + 1e-6, y), pad.sag(x, y - 1e-6) - pad.sag(x, y + 1e-6), np.full(200, -2e-6)]
    )
    np.testing.assert_allclose(seen.n, rise / np.linalg.norm(rise, axis=0), atol=1e-6)
    assert (np.abs(seen.n[:2]).max() > 0.05) == (name == "gelsight_dome")


def test_a_deeper_rim_is_seen_farther_out(mini: SensorSpec) -> None:
    """The rim lies a² / 2R nearer to the camera than the pad, so that the same pixel is nearer to the axis."""
    (shallow,), (deep,) = (circles_on_pad(mini, np.array([[300.0, 120.0, r]]), RADIUS[:1]) for r in (1.0, 30.0))
    expected = 0.5 * (30.0 * mini.camera.pixel_pitch[0]) ** 2 / RADIUS[0] / -mini.camera.position[2]
    assert 1 - deep[0] / shallow[0] == pytest.approx(expected, rel=0.05)


def test_a_contact_as_wide_as_its_ball_is_refused(mini: SensorSpec) -> None:
    wide = np.array([[160.0, 120.0, 55.0]])
    with pytest.raises(InputError, match=r"smaller than the ball, which has 6\.31 mm"):
        press_surface(mini, make_grid(mini.gelpad, 0.3e-3), wide, RADIUS[:1], RIGID_PAD)
