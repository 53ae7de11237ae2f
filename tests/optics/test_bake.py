"""A table baked coarsely from the ray tracer: exact at rest, near it on a ball, honest about its gaps; shadows fall as light says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytac.gel.pyramid import ElasticSurround
from raytac.gel.surface import GelSurface
from raytac.optics import Taxim
from raytac.optics.taxim.bake.bake import Baked, bake, calibrate
from raytac.optics.taxim.bake.presses import pressed
from raytac.optics.taxim.bake.settings import BakeSettings
from raytac.optics.taxim.bake.views import Calibration
from raytac.optics.taxim.table import ShadowTable
from raytac.report.bake import SceneError, table_errors
from raytac.shapes.part import primitive
from raytac.specs import load_sensor
from raytac.specs.sensor import SensorSpec
from tests.optics.scenes import at_rest, led, like_a_mini, sensor

SIZE = (80, 60)
QUICK = BakeSettings(images=40, n_bins=45, pins=8)
MINI = like_a_mini()


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return Calibration(MINI, device="cpu", resolution=SIZE)


@pytest.fixture(scope="module")
def baked(calibration: Calibration) -> Baked:
    return calibrate(calibration, settings=QUICK)


def ball(at: Calibration, radius: float, depth: float, surround: bool = True) -> GelSurface:
    """A ball ``depth`` [m] deep into the middle of the pad."""
    place = np.eye(4)
    place[2, 3] = radius - depth
    gel = ElasticSurround(at.grid, thickness=at.sensor.gelpad.thickness) if surround else None
    return pressed(at.grid, [primitive("sphere", (radius,), place)], gel)


def errors(baked: Baked, surfaces: dict[str, GelSurface]) -> dict[str, dict[str, SceneError]]:
    return table_errors(baked.calibration.sensor, surfaces, baked.table, baked.calibration.tracer)


@pytest.mark.parametrize("shadow", [False, True])
def test_at_rest_it_is_the_ray_tracers_image(baked: Baked, calibration: Calibration, shadow: bool) -> None:
    mode = Taxim(calibration=baked.table, shadows=shadow).build(MINI, resolution=SIZE, device="cpu")
    image = mode.render(at_rest(calibration.grid)).rgb
    assert image is not None and calibration.rest_image.max() > 60
    assert np.array_equal(image[0], calibration.rest_image)


def test_a_ball_looks_as_the_ray_tracer_shows_it(baked: Baked, calibration: Calibration) -> None:
    surface = ball(calibration, 3.2e-3, 0.8e-3)
    error = errors(baked, {"ball": surface})["taxim"]["ball"]
    change = np.abs(calibration.rest_image.astype(float) - error.traced)[error.contact].mean()
    assert change > 10
    assert error.contact_mae < 0.3 * change
    assert error.box_psnr > 31
    assert error.uncovered == 0


def test_a_touch_of_a_micrometre_hardly_changes_the_image(baked: Baked, calibration: Calibration) -> None:
    """As the image at rest is exact, one that jumped at first touch would show contact where the ray tracer sees none."""
    rest = calibration.rest_image.astype(int)
    mode = Taxim(calibration=baked.table, shadows=False).build(MINI, resolution=SIZE, device="cpu")
    change = []
    for depth in (1e-6, 5e-6, 0.1e-3):
        image = mode.render(ball(calibration, 4e-3, depth)).rgb
        assert image is not None
        change.append(np.abs(image[0].astype(int) - rest).max())
    assert change[0] <= 1 and change[0] <= change[1] < 0.5 * change[2]


def test_touched_gel_and_that_around_have_sheets_of_their_own() -> None:
    """Near lights see slopes of the deep contact and of the skirt beside it unlike: one sheet takes the mean of both."""
    at = Calibration(load_sensor("gelsight_mini"), device="cpu", resolution=SIZE)
    both = calibrate(at, settings=replace(QUICK, pins=0))
    one = replace(both.table, gradients=both.table.one_sheet, surround=None, one_sheet=None)
    surfaces = {f"{k}": ball(at, *size) for k, size in enumerate(((2e-3, 0.6e-3), (4e-3, 0.9e-3)))}
    two, together = (errors(replace(both, table=table), surfaces)["taxim"] for table in (both.table, one))
    for name in surfaces:
        assert two[name].contact_mae < 0.9 * together[name].contact_mae, (two[name].contact_mae, together[name].contact_mae)


def test_steep_gel_beside_a_pin_has_no_speckle() -> None:
    """Neighbouring directions have like colours, as steep as the untouched gel gets: 4.9 levels by these presses, 14.7 with caps' rims."""
    at = Calibration(load_sensor("gelsight_mini"), device="cpu", resolution=(160, 120))
    table = calibrate(at, settings=BakeSettings(images=60, punches=30, n_bins=65, pins=0)).table
    assert table.surround is not None
    middle = np.array([79.5**2, 59.5**2, 79.5 * 59.5, 79.5, 59.5, 1.0])
    steep = (table.surround @ middle)[:, 32:, :-1]  # 45 degrees and more
    assert np.abs(np.diff(steep, axis=2)).mean() < 7


def test_the_same_seed_gives_the_same_table(baked: Baked, calibration: Calibration) -> None:
    few = replace(QUICK, images=4, pins=0)
    a, b, c = (calibrate(calibration, settings=few, seed=seed).table for seed in (0, 0, 1))
    assert np.array_equal(a.gradients, b.gradients) and not np.array_equal(a.gradients, c.gradients)
    assert a.shadow is None and baked.table.shadow is not None


def test_slopes_beyond_the_steepest_ball_are_not_covered(calibration: Calibration) -> None:
    gentle = BakeSettings(images=20, n_bins=45, pins=0, radius=(4e-3, 5e-3), depth=(0.2e-3, 0.5e-3), bare_share=1.0)
    shallow = calibrate(calibration, settings=gentle)
    # A bare cap is steepest at its rim, cos θ = 1 − depth / radius, plus the slope of the dome there, at most 10 mm / 0.135 m.
    steepest = np.degrees(np.arccos(1 - 0.5 / 4)) + np.degrees(0.074)
    bins = np.arange(45) * 90 / 44
    assert not shallow.fit.covered[bins > steepest].any()
    assert shallow.fit.covered[bins < 18].mean() > 0.9
    assert shallow.table.covered is not None and np.array_equal(shallow.table.covered, shallow.fit.covered)
    steep = ball(calibration, 1.2e-3, 1.0e-3, surround=False)
    assert errors(shallow, {"steep": steep})["taxim"]["steep"].uncovered > 0.3


@pytest.fixture(scope="module")
def shadows() -> tuple[SensorSpec, ShadowTable]:
    """Red from the top of the image, green from its right, both low over the pad."""
    size, power = (1e-3, 1e-3), 3e-5
    spec = sensor(
        (
            led("red", (0, -16e-3, -5e-3), size=size, power=(8 * power, 0, 0)),
            led("green", (18e-3, 0, -5e-3), size=size, power=(0, 8 * power, 0)),
        )
    )
    spec = replace(spec, response=replace(spec.response, exposure=12.0))
    table = bake(spec, device="cpu", resolution=SIZE, settings=replace(QUICK, images=2, pins=32)).table
    assert table.shadow is not None
    return spec, table.shadow


@pytest.mark.parametrize(("channel", "away"), [(0, 0.5 * np.pi), (1, np.pi)])
def test_shadows_fall_away_from_each_light(shadows: tuple[SensorSpec, ShadowTable], channel: int, away: float) -> None:
    _, table = shadows
    longest = table.lengths[channel].max(axis=1)
    assert longest.max() > 4
    off = np.abs((table.directions - away + np.pi) % (2 * np.pi) - np.pi)
    assert (longest[off > np.radians(100)] <= 1).all()
    direction = np.angle((longest * np.exp(1j * table.directions)).sum())
    assert abs((direction - away + np.pi) % (2 * np.pi) - np.pi) < np.radians(20)
    inside = np.arange(table.values.shape[-1]) < table.lengths[channel][..., None]
    assert (table.values[channel][inside] <= 255).all() and (table.values[channel][inside] < -10).any()


def test_shadows_lengthen_with_depth(shadows: tuple[SensorSpec, ShadowTable]) -> None:
    _, table = shadows
    toward = np.abs(table.directions - 0.5 * np.pi) < 0.35
    longest = table.lengths[0][toward].max(axis=0)
    drops = np.flatnonzero(longest)
    assert len(drops) >= 6
    assert np.polyfit(drops, longest[drops], 1)[0] > 0.2
    assert longest[drops[-2:]].min() > 1.5 * longest[drops[:2]].max()
    assert table.lengths[2].max() == 0  # no blue light, no blue shadow


def test_another_sensor() -> None:
    result = bake(load_sensor("gelsight_dome"), device="cpu", resolution=SIZE, settings=replace(QUICK, images=16, pins=2))
    at = result.calibration
    error = errors(result, {"ball": ball(at, 3e-3, 0.8e-3), "rest": at_rest(at.grid)})
    assert error["taxim"]["ball"].box_psnr > 28
    assert np.array_equal(error["taxim_shadow"]["rest"].table, at.rest_image)
