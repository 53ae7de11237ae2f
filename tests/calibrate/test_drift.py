"""Session drift: the image at rest of many photographs, and gains and offsets that were put into them."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.calibrate.drift import BLOCK, FEWEST_BLOCKS, Drift, measured_drift, no_drift, settled
from raytac.calibrate.photographs import Photographs
from raytac.report.real_drift import drift_metrics, drift_rows
from raytac.specs import SensorSpec, load_sensor

RADIUS = 3.155e-3


@pytest.fixture(scope="module")
def sensor() -> SensorSpec:
    return load_sensor("gelsight_mini")


def rest() -> np.ndarray:
    """An uneven image at rest."""
    v, u = np.mgrid[:240, :320]
    return np.stack([60 + 0.2 * u, 120 - 0.15 * v, 90 + 0.1 * u + 0.1 * v], axis=-1)


def drifting(drift: Drift, background: Drift, noise: float = 2.0) -> Photographs:
    """Photographs of dark contacts with this drift, ``noise`` levels of grain and whole levels."""
    rng, count = np.random.default_rng(5), len(drift.gain)
    circles = np.column_stack([rng.uniform(60, 260, count), rng.uniform(60, 180, count), np.full(count, 20.0)])
    shots = Photographs(rest(), np.repeat(rest()[None], count, axis=0), circles, np.full(count, RADIUS))
    pressed = np.where(shots.distance(load_sensor("gelsight_mini"))[..., None] < 2, 20.0, rest())

    def seen(images: np.ndarray, by: Drift) -> np.ndarray:
        return np.rint(by.applied(images) + noise * rng.normal(size=images.shape))

    return Photographs(seen(rest()[None], background)[0], seen(pressed, drift), circles, shots.radius)


def test_the_settled_image_at_rest_is_the_mean_of_what_no_press_reaches(sensor: SensorSpec) -> None:
    """Two presses of noise about 90 and a photograph of 84: means of three values far from both, of two or one where contacts are."""
    rng = np.random.default_rng(0)
    circles = np.array([[80.0, 60.0, 20.0], [240.0, 180.0, 20.0]])
    presses = 90 + rng.integers(-5, 6, (2, 240, 320, 3)).astype(float)
    presses[0, 60, 80], presses[1, 180, 240] = 250.0, 250.0
    shots = Photographs(np.full((240, 320, 3), 84.0), presses, circles, np.full(2, RADIUS))
    found = settled(sensor, shots, drift=False).shots
    np.testing.assert_allclose(found.background[120, 160], (84 + presses[:, 120, 160].sum(0)) / 3, rtol=1e-6)
    np.testing.assert_allclose(found.background[60, 80], (84 + presses[1, 60, 80]) / 2, rtol=1e-6)
    np.testing.assert_allclose(found.background[180, 240], (84 + presses[0, 180, 240]) / 2, rtol=1e-6)
    np.testing.assert_array_equal(found.presses, presses)


def test_gains_and_offsets_that_were_put_in_are_measured(sensor: SensorSpec) -> None:
    """To 0.1 levels at 100, under noise of 2 levels; contacts, which are 80 levels darker, do not disturb."""
    rng = np.random.default_rng(2)
    true = Drift(1 + 0.05 * rng.normal(size=(6, 3)), 3 * rng.normal(size=(6, 3)))
    shots = drifting(true, no_drift(1))
    found = measured_drift(sensor, shots, rest())
    assert np.abs(true.at(100)).max() > 3
    np.testing.assert_allclose(found.at(100), true.at(100), atol=0.1)
    np.testing.assert_allclose(found.gain, true.gain, atol=0.006)
    back = found.removed(shots.presses)
    far = shots.distance(sensor) > 3
    assert np.abs((back - rest())[far].mean(0)).max() < 0.05
    np.testing.assert_allclose(found.applied(back), shots.presses, atol=1e-3)


def test_the_reference_is_the_mean_of_the_presses(sensor: SensorSpec) -> None:
    """A photograph at rest of another day is not: its drift is reported against theirs."""
    rng = np.random.default_rng(3)
    of_presses = Drift(1 + 0.02 * rng.normal(size=(8, 3)), rng.normal(size=(8, 3)))
    of_rest = Drift(np.full((1, 3), 1.03), np.array([[4.0, -2.0, 0.0]]))
    steady = settled(sensor, drifting(of_presses, of_rest))
    np.testing.assert_allclose(steady.drift.gain.mean(0), 1, atol=1e-6)
    np.testing.assert_allclose(steady.drift.offset.mean(0), 0, atol=1e-6)
    mean = of_presses.gain.mean(0) * rest() + of_presses.offset.mean(0)
    assert np.abs(steady.shots.background - mean).mean() < 0.75, "noise of nine photographs and whole levels"
    assert np.abs((steady.shots.background - mean).mean((0, 1))).max() < 0.05
    level = rest().mean((0, 1))
    expected = np.array([(of_rest.gain[0, c] - 1) * level[c] + of_rest.offset[0, c] for c in range(3)])
    expected -= [(of_presses.gain[:, c].mean() - 1) * level[c] + of_presses.offset[:, c].mean() for c in range(3)]
    found = [(steady.background.gain[0, c] - 1) * level[c] + steady.background.offset[0, c] for c in range(3)]
    np.testing.assert_allclose(found, expected, atol=0.15)
    plain = settled(sensor, drifting(of_presses, of_rest), drift=False)
    assert np.abs((plain.shots.background - mean).mean((0, 1))).max() > 0.3


def test_a_photograph_with_next_to_no_free_pixel_counts_as_steady(sensor: SensorSpec) -> None:
    shots = drifting(Drift(np.full((2, 3), 1.1), np.full((2, 3), 5.0)), no_drift(1))
    wide = Photographs(shots.background, shots.presses, np.array([[160.0, 120.0, 80.0], [160.0, 120.0, 20.0]]), shots.radius)
    free = (wide.distance(sensor) > 3).reshape(2, 240 // BLOCK, BLOCK, 320 // BLOCK, BLOCK).all((2, 4)).sum((1, 2))
    assert free[0] < FEWEST_BLOCKS < free[1]
    found = measured_drift(sensor, wide, rest())
    assert np.all(found.gain[0] == 1) and np.all(found.offset[0] == 0) and found.gain[1].min() > 1.05


def test_figures_say_what_a_pixel_changes() -> None:
    drift = Drift(np.array([[1.1, 1.0, 0.9], [0.9, 1.0, 1.0]]), np.array([[0.0, 2.0, 0.0], [0.0, -1.0, 0.0]]))
    figures = drift_metrics(drift, no_drift(1), 100.0)
    assert figures["drift.presses.red"] == pytest.approx(10) and figures["drift.presses.largest_blue"] == pytest.approx(10)
    assert figures["drift.presses.green"] == pytest.approx(1.5) and figures["drift.background.green"] == 0
    rows = drift_rows(("a", "b"), drift)
    assert rows[0].startswith("press,gain_red") and rows[2] == "b,0.90000,1.00000,1.00000,0.000,-1.000,0.000"
