"""Powers against NumPy, and the light of strips by angles against that of points on them."""

from __future__ import annotations

import numpy as np
import pytest

from raytac import load_sensor
from raytac.optics.geometry import PixelSample
from raytac.optics.power import power
from raytac.optics.runtime import load_mitsuba
from raytac.optics.trace.direct import _of_line, _of_points
from raytac.optics.trace.led import Lamp
from raytac.optics.trace.quadrature import quadrature


@pytest.mark.parametrize("exponent", [1 / 2.2, 1.0, 2.06, 5.19, 15.0])
def test_a_power_is_exact_to_rounding(exponent: float) -> None:
    mi, _ = load_mitsuba("cpu")
    x = np.concatenate([np.linspace(1e-6, 1, 100_001), np.geomspace(1e-30, 1, 10_001)]).astype(np.float32)
    exact = x.astype(float) ** float(np.float32(exponent))
    found = np.array(power(mi.Float(x), mi.Float(exponent)))
    assert np.abs(found - exact).max() < 1.2e-7
    large = exact > 1e-30
    # The logarithm of 1e-30, about 100 in base 2, has as many digits less.
    assert np.abs(found[large] / exact[large] - 1).max() < 7e-6


def test_a_power_of_nothing_is_dark_and_of_one_is_one() -> None:
    mi, _ = load_mitsuba("cpu")
    dark, full = np.array(power(mi.Float([0.0, 1.0]), mi.Float(1 / 2.2)))
    assert 0 <= dark < 1e-12 and full == 1.0


@pytest.mark.parametrize("refinement", [1, 2, 3])
def test_directions_of_a_strip_bring_the_light_of_its_points(refinement: int) -> None:
    """Everywhere on the pad, for normals of which some face away from a part of the strip."""
    mi, _ = load_mitsuba("cpu")
    rng = np.random.default_rng(0)
    place = (rng.uniform(-1, 1, (3, 5000)) * [[10e-3], [8e-3], [0.5e-3]] - [[0], [0], [0.5e-3]]).astype(np.float32)
    tilt = np.concatenate([rng.uniform(-2, 2, (2, 5000)), -np.ones((1, 5000))])
    normal = (tilt / np.linalg.norm(tilt, axis=0)).astype(np.float32)
    seen = PixelSample(mi.UInt32(0), mi.Point3f(place), mi.Normal3f(normal), mi.Vector3f(0, 0, -1))
    for led in load_sensor("gelsight_mini").lights.leds:
        lamp, points = Lamp.from_spec(mi, led), quadrature(led)
        along = refinement * points.along
        line = list(_of_line(seen, lamp, along))
        single = list(_of_points(mi, seen, lamp, type(points)(along, 1, points.upright), None))
        assert len(line) == len(single) == along
        for (w, gain), (w_0, gain_0) in zip(line, single, strict=True):
            assert np.abs(np.array(w) - np.array(w_0)).max() < 2e-6
            gain, gain_0 = np.array(gain), np.array(gain_0)
            assert np.abs(gain - gain_0).max() < 2e-5 * gain_0.max()
        dark = np.array(sum(gain for _, gain in line)) == 0
        assert 0.01 < dark.mean() < 0.9
