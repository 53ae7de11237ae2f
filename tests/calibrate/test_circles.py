"""Contact circles are found again in images that are shaded like pressed balls, with a camera's noise."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.calibrate.circles import DOUBTFUL, circle_score, find_circles, with_found_circles
from raytac.calibrate.presses import RealPresses
from raytac.errors import InputError

PITCH = 0.0634e-3
RADIUS = 3.155e-3
CIRCLES = np.array([[160.3, 120.8, 31.0], [70.0, 60.4, 27.5], [255.2, 170.9, 34.0], [40.0, 40.0, 30.0], [300.0, 120.0, 33.0]])


def presses(circles: np.ndarray, noise: float = 3.0) -> RealPresses:
    """Each channel brightens with the slope towards its own side; the slope of the ball falls to half at the rim, then to nothing."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:240, :320] + 0.5
    images = []
    for x, y, r in circles:
        rho = np.hypot(u - x, v - y) / r
        slope = np.where(rho < 1, rho, 0.5 * np.exp(-4 * (rho - 1)))
        away = np.arctan2(v - y, u - x)
        shade = [70 * slope * np.cos(away - side) for side in (-1.6, 0.0, 1.6)]
        images.append(110 + np.stack(shade, axis=-1) + noise * rng.normal(size=(240, 320, 3)))
    stack = np.clip(np.round(images), 0, 255).astype(np.uint8)
    count = len(circles)
    background = np.full((240, 320, 3), 110, np.uint8)
    return RealPresses(background, stack, np.full(count, RADIUS), np.full((count, 3), np.nan), tuple(map(str, range(count))))


def test_circles_are_found_within_a_pixel() -> None:
    found = find_circles(presses(CIRCLES), PITCH)
    off = np.abs(found.circles - CIRCLES)
    assert off.max() < 1.5 and off.mean() < 0.6, f"off by {off} px"
    assert not found.doubtful.any() and found.score.min() > 15


def test_an_image_without_a_press_is_doubtful() -> None:
    empty = presses(CIRCLES[:1])
    noise = np.random.default_rng(1).normal(size=empty.images.shape)
    still = np.clip(np.round(empty.background + noise), 0, 255).astype(np.uint8)
    found = find_circles(RealPresses(empty.background, still, empty.ball_radius, empty.circles, empty.names), PITCH)
    assert found.doubtful.all() and found.score[0] < DOUBTFUL


def test_only_unknown_circles_are_searched() -> None:
    shots = presses(CIRCLES[:2])
    known = np.array([[1.0, 2.0, 3.0], [np.nan] * 3])
    filled, doubtful = with_found_circles(shots.with_circles(known), PITCH)
    np.testing.assert_array_equal(filled.circles[0], known[0])
    assert np.abs(filled.circles[1] - CIRCLES[1]).max() < 1.5
    assert doubtful.tolist() == [False, False]
    again, _ = with_found_circles(filled, PITCH)
    np.testing.assert_array_equal(again.circles, filled.circles)


def test_the_score_is_the_colour_step_and_needs_enough_of_the_circle() -> None:
    v, u = np.mgrid[:240, :320] + 0.5
    disc = (np.hypot(u - 160, v - 120) < 40)[..., None] * np.array([3.0, 0.0, 4.0])
    inside, outside, beside = circle_score(disc, np.array([[160, 120, 40.0], [160, 120, 20.0], [600, 120, 40.0]]))
    assert inside == pytest.approx(5.0, rel=1e-6) and outside == 0.0 and beside == -1.0


def test_a_ball_larger_than_the_view_is_refused() -> None:
    shots = presses(CIRCLES[:1])
    with pytest.raises(InputError, match=r"ball_diameter_mm = 6\.31.*view"):
        find_circles(shots, 0.02e-3)
