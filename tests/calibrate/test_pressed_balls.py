"""Balls pressed by physics: the contact is as wide as the circle, whatever the pad; the overlap's depth is that of a cut sphere."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.calibrate.imprint import circles_on_pad
from raytac.calibrate.pressed_balls import contact_radius, overlap_depth, pressed_balls
from raytac.physics import Ipc, Rigid
from raytac.physics.base import PhysicsConfig
from raytac.specs import load_sensor

MINI = load_sensor("gelsight_mini")
CIRCLES = np.array([[160.0, 120.0, 26.0], [120.0, 90.0, 20.0]])
RADIUS = np.array([3.155e-3, 3.155e-3])
PITCH = 0.08e-3


@pytest.mark.parametrize("physics", [Rigid(), pytest.param(Ipc(level="coarse"), marks=pytest.mark.slow)])
def test_contact_is_as_wide_as_the_circle(physics: PhysicsConfig) -> None:
    wanted = circles_on_pad(MINI, CIRCLES, RADIUS)
    for (x, y, a), ball in zip(wanted, pressed_balls(MINI, CIRCLES, RADIUS, physics, pitch=PITCH, device="cpu"), strict=True):
        assert ball.overlap_depth == pytest.approx(RADIUS[0] - np.sqrt(RADIUS[0] ** 2 - a**2))
        assert ball.surface is not None and contact_radius(ball.surface) == pytest.approx(a, rel=0.005)
        np.testing.assert_allclose(ball.surface.contact_centre[0], (x, y), atol=PITCH)
        # The gel around the contact is drawn down: the overlap is as wide as the circle at a smaller depth.
        assert contact_radius(ball.at_overlap) < a and 1.05 < ball.depth / ball.overlap_depth < 2.5
        # Under the ball the gel moves with it.
        grid = ball.surface.grid
        node = 0, int(np.abs(grid.y - y).argmin()), int(np.abs(grid.x - x).argmin())
        moved = float(ball.at_overlap.height[node] - ball.surface.height[node])
        assert moved == pytest.approx(ball.depth - ball.overlap_depth, abs=5e-6)


def test_a_circle_that_no_depth_reaches_has_no_surface() -> None:
    """A contact of 0.999 of the ball's radius would need the ball to be drowned."""
    small, circles = np.array([0.5e-3]), np.array([[160.0, 120.0, 1.0]])
    for _ in range(9):
        circles[0, 2] *= 0.999 * small[0] / circles_on_pad(MINI, circles, small)[0, 2]
    (ball,) = pressed_balls(MINI, circles, small, Rigid(), pitch=PITCH, device="cpu")
    assert ball.surface is None and np.isnan(ball.depth) and ball.at_overlap.contact.any()


def test_overlap_depth_is_that_of_a_cut_sphere() -> None:
    assert overlap_depth(3.0, 5.0) == pytest.approx(1.0) and overlap_depth(5.0, 5.0) == pytest.approx(5.0)
