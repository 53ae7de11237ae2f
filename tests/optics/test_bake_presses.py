"""The calibration's presses: evenly spread, wholly in view, apart from each other, never past a ball's equator."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import islice

import numpy as np

from raytac.optics.camera import Pinhole
from raytac.optics.taxim.bake.presses import ball_presses, even_sequence, pin_presses, punch_presses, view_half
from raytac.optics.taxim.bake.settings import BakeSettings
from tests.optics.scenes import grid_of, like_a_mini

SPEC = like_a_mini()
GRID = grid_of(SPEC)
CAMERA = Pinhole.from_spec(SPEC.camera, (80, 60))


def test_even_sequence_fills_the_cube_more_evenly_than_chance() -> None:
    points = np.array(list(islice(even_sequence(2, np.array([0.3, 0.7])), 400)))
    assert points.min() >= 0 and points.max() < 1
    cells = np.histogram2d(points[:, 0], points[:, 1], bins=10, range=((0, 1), (0, 1)))[0]
    # 400 points in 100 cells: chance has a variance of 4.
    assert cells.var() < 1.5


def test_golden_ratio_in_one_dimension() -> None:
    first = next(even_sequence(1, np.zeros(1)))
    np.testing.assert_allclose(first, 2 / (1 + np.sqrt(5)))


def test_balls_lie_in_view_and_reach_the_depth_they_say() -> None:
    settings = BakeSettings(images=12, depth=(0.5e-3, 0.9e-3), bare_share=1.0)
    surfaces = list(ball_presses(SPEC.gelpad, GRID, CAMERA, settings, seed=0, bare=True))
    assert len(surfaces) == 12
    half = view_half(CAMERA)
    for surface in surfaces:
        moved = surface.indentation[0]
        iy, ix = np.nonzero(moved > 1e-6)
        # A bare cap is wider than the contact on a dome by the sag of the pad; one node of slack.
        assert np.abs(GRID.x[ix]).max() < half[0] + 0.3e-3 and np.abs(GRID.y[iy]).max() < half[1] + 0.3e-3
        assert 0.4e-3 < moved.max() < 0.95e-3


def test_same_seed_same_presses() -> None:
    settings = BakeSettings(images=3)
    a, b, c = (list(ball_presses(SPEC.gelpad, GRID, CAMERA, settings, seed)) for seed in (4, 4, 5))
    assert all(np.array_equal(p.height, q.height) for p, q in zip(a, b, strict=True))
    assert not any(np.array_equal(p.height, q.height) for p, q in zip(a, c, strict=True))


def test_caps_and_balls_are_the_images_that_were_asked_for() -> None:
    settings = BakeSettings(images=10, bare_share=0.3)
    counts = [len(list(ball_presses(SPEC.gelpad, GRID, CAMERA, settings, seed=0, bare=bare))) for bare in (False, True)]
    assert counts == [7, 3]


def test_gel_beside_punches_is_steeper_than_beside_balls() -> None:
    settings = BakeSettings(images=6, punches=6, bare_share=0.0)
    balls, pins = (make(SPEC.gelpad, GRID, CAMERA, settings, seed=0) for make in (ball_presses, punch_presses))

    def steepest(surface) -> float:
        slopes = np.hypot(*np.gradient(surface.indentation[0], *GRID.pitch[::-1]))
        return slopes[~surface.contact[0]].max()

    assert min(map(steepest, pins)) > max(map(steepest, balls))


def test_pins_rise_in_equal_steps() -> None:
    settings = BakeSettings(pins=8, depth=(0.3e-3, 0.8e-3))
    flat = replace(SPEC, gelpad=replace(SPEC.gelpad, dome_radius=(math.inf, math.inf)))
    deepest = [s.indentation.max() for s in pin_presses(flat.gelpad, grid_of(flat), CAMERA, settings, 0)]
    np.testing.assert_allclose(deepest, 0.1e-3 * np.arange(1, 9), atol=1e-6)
