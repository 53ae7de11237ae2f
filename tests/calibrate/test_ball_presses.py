"""Balls pressed by physics: the imprint's edge is as wide as the circle, whatever the pad; the overlap's depth is that of a cut sphere."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from raytac.calibrate import ball_presses as balls_module
from raytac.calibrate import circles as circle_search
from raytac.calibrate.ball_presses import EDGE, contact_radius, edge_radius, overlap_depth, pressed_balls
from raytac.calibrate.circles import find_circles
from raytac.calibrate.imprint import circles_on_pad
from raytac.calibrate.presses import RealPresses
from raytac.gel.surface import GelSurface, make_grid
from raytac.optics import RayTraced
from raytac.physics import Ipc, Rigid
from raytac.physics.base import PhysicsConfig
from raytac.specs import ObjectSpec, PressScene, StageSpec, load_sensor

MINI = load_sensor("gelsight_mini")
CIRCLES = np.array([[160.0, 120.0, 26.0], [120.0, 90.0, 20.0]])
RADIUS = np.array([3.155e-3, 3.155e-3])
PITCH = 0.08e-3


@pytest.mark.parametrize("physics", [Rigid(), pytest.param(Ipc(level="coarse"), marks=pytest.mark.slow)])
def test_edge_is_as_wide_as_the_circle(physics: PhysicsConfig) -> None:
    wanted = circles_on_pad(MINI, CIRCLES, RADIUS)
    for (x, y, a), ball in zip(wanted, pressed_balls(MINI, CIRCLES, RADIUS, physics, pitch=PITCH, device="cpu"), strict=True):
        assert ball.overlap_depth == pytest.approx(RADIUS[0] - np.sqrt(RADIUS[0] ** 2 - a**2))
        assert ball.surface is not None and edge_radius(ball.surface, (x, y), 1.5 * a) == pytest.approx(a, rel=0.0025)
        # Gel leaves the ball smoothly, so that the edge lies outside the contact, by about the step's half width at most.
        assert 1.0 - (EDGE if isinstance(physics, Rigid) else 1.1 * EDGE) < contact_radius(ball.surface) / a < 0.99
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


def test_edge_of_a_sharp_cap_is_a_step_outside_its_rim() -> None:
    """A spherical cap in a flat pad: normals change most where the inner end of the step just lies on the cap."""
    pad = replace(MINI.gelpad, dome_radius=(math.inf, math.inf))
    grid = make_grid(pad, 0.03e-3)
    at, rim, radius = (1.3e-3, -0.7e-3), 1.8e-3, 3e-3
    rho = np.hypot(grid.x[None, :] - at[0], grid.y[:, None] - at[1])
    cap = np.where(rho < rim, np.sqrt(radius**2 - rim**2) - np.sqrt(np.maximum(radius**2 - rho**2, 0.0)), 0.0)
    surface = GelSurface(grid, cap[None].astype(np.float32), rho[None] < rim, np.array([at]))
    # Slopes at nodes are means over two cells, and those between nodes of two nodes: the kink is seen up to two nodes early.
    early = 2.5 * float(grid.x[1] - grid.x[0])
    assert (rim - early) / (1.0 - EDGE) < edge_radius(surface, at, 2.0 * rim) < rim / (1.0 - EDGE)
    assert edge_radius(GelSurface.at_rest(grid), at, 2.0 * rim) == 0.0


@pytest.mark.parametrize("depth", [0.6e-3, 0.9e-3])
def test_depth_is_recovered_from_the_circle_of_an_image(depth: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rendered press whose depth is known, its circle found as in a photograph. The contact itself, as the circle, is too deep."""
    monkeypatch.setattr(balls_module, "EDGE", circle_search._REACH)
    ball = ObjectSpec("sphere", {"radius": RADIUS[0]}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.1)
    pad = Rigid().build(
        MINI, PressScene("ball", ball, (StageSpec("indent", depth=depth),)), pitch=0.06e-3, num_envs=1, device="cpu"
    )
    (reading,) = pad.follow(StageSpec("indent", depth=depth))
    tracer = RayTraced().build(MINI, device="cpu")
    rest, image = (tracer.render(surface).rgb for surface in (GelSurface.at_rest(reading.surface.grid), reading.surface))
    assert rest is not None and image is not None
    nothing = np.full((1, 3), np.nan)
    presses = RealPresses(rest[0], image, RADIUS[:1], nothing, ("ball",))
    circle = find_circles(presses, MINI.camera.pixel_pitch[0]).circles
    (result,) = pressed_balls(MINI, circle, RADIUS[:1], Rigid(), pitch=0.06e-3, device="cpu")
    assert result.depth == pytest.approx(depth, rel=0.05)
    assert circle[0, 2] * MINI.camera.pixel_pitch[0] > 1.02 * contact_radius(reading.surface)


def test_overlap_depth_is_that_of_a_cut_sphere() -> None:
    assert overlap_depth(3.0, 5.0) == pytest.approx(1.0) and overlap_depth(5.0, 5.0) == pytest.approx(5.0)
