"""Grain of a camera: variance by level that was put into photographs, and what cannot be measured."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.calibrate.drift import settled
from raytac.calibrate.grain import grain_samples, measured_grain
from raytac.calibrate.photographs import Photographs
from raytac.report.real_drift import grain_metrics
from raytac.specs import SensorSpec, load_sensor

DARK, BRIGHT = np.array([1.0, 4.0, 9.0]), np.array([16.0, 2.0, 9.0])


@pytest.fixture(scope="module")
def sensor() -> SensorSpec:
    return load_sensor("gelsight_mini")


def grainy(count: int = 12, scale: float = 1.0) -> Photographs:
    """Photographs in whole levels whose variance goes from ``DARK`` at 0 to ``BRIGHT`` at 255."""
    rng = np.random.default_rng(7)
    rest = np.repeat(np.linspace(15, 240, 320)[None, :, None], 240, axis=0).repeat(3, axis=2)
    sigma = np.sqrt(scale * (DARK + (BRIGHT - DARK) * rest / 255))
    circles = np.column_stack([rng.uniform(60, 260, count), rng.uniform(60, 180, count), np.full(count, 18.0)])
    shots = Photographs(rest, np.repeat(rest[None], count, axis=0), circles, np.full(count, 3e-3))
    contact = shots.distance(load_sensor("gelsight_mini"))[..., None] < 1.5
    presses = np.rint(np.where(contact, 0.0, rest + sigma * rng.normal(size=shots.presses.shape)))
    return Photographs(np.rint(rest), presses, circles, shots.radius)


@pytest.mark.parametrize("drift", [False, True])
def test_variance_by_level_is_measured(sensor: SensorSpec, drift: bool) -> None:
    noise = measured_grain(sensor, settled(sensor, grainy(), drift=drift))
    assert noise is not None
    np.testing.assert_allclose(noise.dark_variance, DARK, atol=0.25)
    np.testing.assert_allclose(noise.bright_variance, BRIGHT, atol=0.4)
    figures = grain_metrics(noise, 127.5)
    assert figures["grain.red"] == pytest.approx(np.sqrt(8.5), rel=0.02)


def test_photographs_without_noise_have_none(sensor: SensorSpec) -> None:
    noise = measured_grain(sensor, settled(sensor, grainy(scale=0.0)))
    assert noise is not None
    assert max(noise.dark_variance + noise.bright_variance) < 0.01


def test_levels_of_the_bins_rise_and_cover_the_image(sensor: SensorSpec) -> None:
    samples = grain_samples(sensor, settled(sensor, grainy(), drift=False))
    assert samples is not None
    level, variance = samples
    assert np.all(np.diff(level, axis=0) > 0) and level.min() < 40 and level.max() > 215
    assert np.abs(variance - (DARK + (BRIGHT - DARK) * level / 255)).max() < 0.5


def test_two_photographs_are_too_few(sensor: SensorSpec) -> None:
    assert measured_grain(sensor, settled(sensor, grainy(2))) is None
    assert grain_metrics(None, 100.0) == {}
