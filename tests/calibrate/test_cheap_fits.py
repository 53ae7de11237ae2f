"""Table and network from presses: what a known colour law shows, they show."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from raytac.calibrate import model_fits
from raytac.calibrate.direct_fit import FitState
from raytac.calibrate.image_fits import PressSamples, fit_mlp, fit_table, press_samples, with_cast_shadows
from raytac.calibrate.imprint import RIGID_PAD, press_surface
from raytac.calibrate.light_parameters import LightParameters
from raytac.calibrate.photographs import Photographs
from raytac.calibrate.ray_fit import Fitted
from raytac.calibrate.start import leds_at_walls
from raytac.gel.surface import make_grid
from raytac.optics import Mlp, Taxim
from raytac.optics.taxim.bake.settings import BakeSettings
from raytac.optics.taxim.bake.shadow import NOTHING
from raytac.optics.taxim.folder import load_calibration, save_calibration
from raytac.optics.taxim.table import PolyTable, polynomial_basis, slope_bins
from raytac.specs import SensorSpec, load_sensor, with_lights

RADIUS = 3.155e-3
SENSOR = load_sensor("gelsight_mini")
GAIN = np.array([[60.0, 0.0], [-30.0, 50.0], [20.0, -70.0]])
"""Levels by slope along x and y, of each channel."""
GLOW = 12.0
"""Levels that touched pixels have besides."""


def presses(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(70, 250, count), rng.uniform(60, 180, count), rng.uniform(26, 33, count)])


@pytest.fixture(scope="module")
def samples() -> PressSamples:
    """Of 30 presses whose colour changes by ``GAIN`` times the slope."""
    at = presses(30, 0)
    blank = Photographs(np.full((240, 320, 3), 90.0), np.full((30, 240, 320, 3), 90.0), at, np.full(30, RADIUS))
    found = press_samples(SENSOR, blank, at, RIGID_PAD, device="cpu")
    assert len(found.row) > 50_000 and np.abs(found.slope_x).max() > 0.3
    rho = np.hypot(found.column + 0.5 - at[found.press, 0], found.row + 0.5 - at[found.press, 1]) / at[found.press, 2]
    np.testing.assert_array_equal(found.touched, rho < 1)
    # Touched pixels shine besides, which slopes do not tell.
    change = np.stack([found.slope_x, found.slope_y], 1) @ GAIN.T + GLOW * found.touched[:, None]
    return dataclasses.replace(found, difference=change)


def every(samples: PressSamples, step: int) -> PressSamples:
    """Every ``step``-th sample."""
    return PressSamples(*(getattr(samples, field.name)[::step] for field in dataclasses.fields(samples)))


@pytest.mark.parametrize("kind", ["table", "network"])
def test_a_known_law_of_slopes_is_found(samples: PressSamples, kind: str) -> None:
    background = np.full((240, 320, 3), 90.0)
    if kind == "table":
        mode = Taxim(calibration=fit_table(SENSOR, background, samples)).build(SENSOR, device="cpu")
    else:
        mode = Mlp(weights=fit_mlp(SENSOR, background, every(samples, 5))).build(SENSOR, device="cpu")
    at = presses(2, 1)
    surface = press_surface(SENSOR, make_grid(SENSOR.gelpad, 0.06e-3), at, np.full(2, RADIUS), RIGID_PAD)
    levels = mode.render_levels(surface)
    _, moved = mode.image_heights(surface)
    sy, sx = np.gradient(moved.astype(float), axis=(1, 2))
    v, u = np.mgrid[:240, :320] + 0.5
    x, y, r = at.T[:, :, None, None]
    rho = np.hypot(u - x, v - y) / r
    expected = 90 + np.stack([sx, sy], axis=-1) @ GAIN.T + GLOW * (rho < 1)[..., None]
    pressed = (moved > 0.5) & (np.abs(rho - 1) > 0.05)  # the rim's own pixels may be on either side
    change, off = np.abs(expected - 90)[pressed].mean(), np.abs(levels - expected)[pressed].mean()
    assert off < 0.12 * change, f"{off:.2f} levels off where the press changes {change:.2f}"


def test_the_same_seed_gives_the_same_network(samples: PressSamples) -> None:
    few = every(samples, 50)
    background = np.full((240, 320, 3), 90.0)
    a, b, c = (fit_mlp(SENSOR, background, few, seed=seed).matrices[0] for seed in (0, 0, 1))
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 0.1


def test_a_reader_of_one_sheet_gets_what_all_samples_say(samples: PressSamples, tmp_path: Path) -> None:
    """``polycalib.npz`` alone, as upstream reads a folder, is nearer to the pixels around contacts than the touched sheet is."""
    table = fit_table(SENSOR, np.full((240, 320, 3), 90.0), every(samples, 3))
    save_calibration(table, tmp_path)
    back = load_calibration(tmp_path)
    for name in ("gradients", "surround", "one_sheet", "covered"):
        np.testing.assert_array_equal(getattr(back, name), getattr(table, name))
    (tmp_path / "raytac.npz").unlink()
    upstream = load_calibration(tmp_path)
    assert upstream.surround is None and upstream.one_sheet is None
    seen = every(samples, 7)
    i, j = slope_bins(seen.slope_x, seen.slope_y, table.n_bins)
    basis = polynomial_basis(seen.column, seen.row)

    def error(gradients: np.ndarray, own: np.ndarray) -> float:
        found = np.einsum("cnk,nk->nc", gradients[:, i, j], basis)
        return float(np.abs(found - seen.difference)[own].mean())

    outside, inside = ~seen.touched, seen.touched
    assert error(upstream.gradients, outside) < 0.7 * error(table.gradients, outside)
    # What it gains there it pays for inside, where touched pixels shine: one sheet is a mean of two.
    assert table.surround is not None
    assert error(table.surround, outside) < error(upstream.gradients, outside)
    assert error(table.gradients, inside) < error(upstream.gradients, inside)


def test_a_tables_shadows_are_of_its_own_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lights are the fitted ones, the camera that of the table, which knows no other."""
    at = presses(4, 0)
    blank = Photographs(np.full((240, 320, 3), 90.0), np.full((4, 240, 320, 3), 90.0), at, np.full(4, RADIUS))
    state = FitState(LightParameters.of(SENSOR, blank.background), RIGID_PAD.copy(), at)
    camera = dataclasses.replace(SENSOR.camera, position=(0.0, 0.0, -36e-3), distortion=(0.7, 0.0, 0.0, 0.0))
    fitted = with_lights(dataclasses.replace(SENSOR, camera=camera), leds_at_walls(SENSOR, "2,1,1"))
    baked: list[SensorSpec] = []

    def bake(table: PolyTable, lit: SensorSpec, **_: object) -> PolyTable:
        baked.append(lit)
        return table

    monkeypatch.setattr(model_fits, "fit_lights", lambda *_, **__: Fitted(fitted, state, (0.0,), (0.0,)))
    monkeypatch.setattr(model_fits, "with_cast_shadows", bake)
    how: dict[str, Any] = {"settle": False, "drift": False, "prior": "tied", "shadow_table": "raytrace", "device": "cpu"}
    model_fits.fit_models(SENSOR, blank, modes=("taxim",), **how)
    assert [lit.lights for lit in baked] == [fitted.lights] and baked[0].camera == SENSOR.camera != fitted.camera


def test_cast_shadows_are_levels_of_the_photographs() -> None:
    """Of a linear camera: over a background of twice the levels, shadows are twice as deep, and they end in the same places."""
    response = dataclasses.replace(SENSOR.response, gamma=1.0, black_level=(0.0, 0.0, 0.0))
    lit, settings, found = dataclasses.replace(SENSOR, response=response), BakeSettings(pins=16), []
    for level in (60.0, 120.0):
        background = np.full((60, 80, 3), level, np.float32)
        table = PolyTable(
            np.zeros((3, 4, 4, 6)), None, background, SENSOR.camera.pitch_at((80, 60)), provenance={"source": "test"}
        )
        cast = with_cast_shadows(table, lit, device="cpu", settings=settings)
        assert cast.shadow is not None and cast.background is background and "ray tracer" in cast.provenance["shadow"]
        length = cast.shadow.values.shape[-1]
        known = (np.arange(length) < cast.shadow.lengths[..., None]) & (cast.shadow.values != NOTHING)
        found.append((known, cast.shadow.values))
    shortest = min(values.shape[-1] for _, values in found)
    (dim, once), (bright, twice) = ((known[..., :shortest], values[..., :shortest]) for known, values in found)
    both = dim & bright
    assert both.sum() > 50 and once[both].min() < -30
    # Fewer pixels of the dim one are more than two levels darker for their shadow.
    assert both.sum() > 0.8 * dim.sum()
    ratio = (twice / np.where(both, once, 1))[both & (once < -10)]
    np.testing.assert_allclose(np.quantile(ratio, [0.1, 0.5, 0.9]), 2.0, atol=0.15)
