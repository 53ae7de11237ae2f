"""The tone curve: ends, inverse, slope and continuation; curves that fall are refused; files keep it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytac.errors import SpecError
from raytac.specs import load_sensor
from raytac.specs.sensor_check import validate_sensor
from raytac.specs.tone import LEAST_SLOPE, STRAIGHT, ToneCurve

U = np.linspace(0, 1, 501)


def rising(count: int, most: int = 5) -> list[ToneCurve]:
    """Curves of up to ``most`` random coefficients that are steep enough everywhere."""
    rng, curves = np.random.default_rng(0), []
    while len(curves) < count:
        curve = ToneCurve(tuple(rng.uniform(-1, 1, rng.integers(1, most + 1))))
        if curve.least_slope >= LEAST_SLOPE:
            curves.append(curve)
    return curves


def test_the_formula() -> None:
    curve = ToneCurve((0.3, -0.1, 0.4))
    w = 2 * U - 1
    np.testing.assert_allclose(curve.bent(U), U + U * (1 - U) * (0.3 - 0.1 * w + 0.4 * (1.5 * w**2 - 0.5)), atol=1e-12)
    assert curve.bent(0.0) == 0 and curve.bent(1.0) == pytest.approx(1, abs=1e-12)
    assert STRAIGHT.is_plain and ToneCurve((0.0, 0.0)).is_plain and STRAIGHT.bent(0.3) == STRAIGHT.straight(0.3) == 0.3


def test_every_rising_curve_has_its_inverse() -> None:
    for curve in rising(300):
        np.testing.assert_allclose(curve.straight(curve.bent(U)), U, atol=1e-9, err_msg=str(curve))


def test_it_goes_on_straight_beyond_black_and_white_with_its_slope() -> None:
    u = np.linspace(-0.5, 1.8, 231)
    for curve in rising(20):
        level, slope = curve.extended(u)
        ends = [curve.extended(u + step)[0] for step in (-1e-6, 1e-6)]
        np.testing.assert_allclose((ends[1] - ends[0]) / 2e-6, slope, atol=1e-4)
        np.testing.assert_allclose(level[(u >= 0) & (u <= 1)], curve.bent(u[(u >= 0) & (u <= 1)]), atol=1e-12)
        np.testing.assert_allclose(curve.extended_straight(level), u, atol=1e-9)
        assert slope.min() == pytest.approx(curve.least_slope, abs=2e-3)


def test_a_curve_that_falls_is_refused_by_its_key() -> None:
    sensor = load_sensor("gelsight_mini")
    validate_sensor(replace(sensor, response=replace(sensor.response, tone=(0.4, -0.1, 0.4))))
    with pytest.raises(SpecError, match=r"response\.tone.*least slope.*-1"):
        validate_sensor(replace(sensor, response=replace(sensor.response, tone=(1.0, 0.0, 1.0))))
    with pytest.raises(SpecError, match=r"tone"):
        replace(sensor.response, tone=(1.5,))
    with pytest.raises(SpecError, match=r"response\.tone.*at most 6"):
        validate_sensor(replace(sensor, response=replace(sensor.response, tone=(0.0,) * 6 + (0.01,))))


def test_six_coefficients_keep_their_levels_in_single_precision() -> None:
    for curve in rising(50, most=6):
        off = curve.bent(U.astype(np.float32)) - curve.bent(U)
        assert np.abs(255 * off).max() < 0.01, curve
