"""Whether shadows are cast is the sensor's to say, in every mode that can cast them, and an option overrides it."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.optics import RayTraced, Taxim
from raytac.optics.taxim.bake import bake
from raytac.optics.taxim.bake.settings import BakeSettings
from raytac.sensor import TactileSensor
from raytac.specs import SensorSpec, load_task
from raytac.specs.sensor import OpticsSpec
from raytac.world.world import TactileWorld
from tests.optics.scenes import RESOLUTION, built, grid_of, like_a_mini, surface
from tests.optics.test_taxim_mode import make_table

LIT = like_a_mini()
DARK = replace(LIT, optics=OpticsSpec(shadows=False))


def image(sensor: SensorSpec, kind: str, **options: Any) -> np.ndarray:
    common = {"resolution": RESOLUTION, "device": "cpu", **options}
    mode = (
        built(RayTraced, sensor, bounce=False, **common)
        if kind == "raytrace"
        else built(Taxim, sensor, calibration=TABLE, **common)
    )
    assert mode.shadows is (options["shadows"] if options else sensor.optics.shadows)
    grid = grid_of(sensor)
    dent = (np.abs(grid.x) < 2e-3) & (np.abs(grid.y[:, None]) < 2e-3)
    rgb = mode.render(surface(grid, grid.rest - 1e-3 * dent, contact=dent)).rgb
    assert rgb is not None
    return rgb


TABLE = make_table(LIT)


@pytest.mark.parametrize("kind", ["raytrace", "taxim"])
def test_the_sensor_decides_and_an_option_overrides_it(kind: str) -> None:
    cast, none = image(LIT, kind), image(DARK, kind)
    assert (np.abs(cast.astype(int) - none) > 2).mean() > 0.01
    np.testing.assert_array_equal(image(LIT, kind, shadows=False), none)
    np.testing.assert_array_equal(image(DARK, kind, shadows=True), cast)


@pytest.mark.parametrize("kind", ["raytrace", "taxim"])
def test_what_is_no_truth_value_is_refused(kind: str) -> None:
    with pytest.raises(InputError, match=r"shadows = 'no': must be True, False or None"):
        image(LIT, kind, shadows="no")


def test_a_table_without_shadows_casts_none_unless_asked() -> None:
    mode = Taxim(calibration=make_table(LIT, shadow=False)).build(LIT, resolution=RESOLUTION, device="cpu")
    assert not mode.shadows and mode.label == "taxim"


def test_a_table_is_baked_with_shadows_where_sensor_or_option_wants_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """A baked table casts only what is asked for; of a sensor that casts shadows it is the same table for all modes."""
    baked: list[bool] = []

    def fake(sensor: SensorSpec, **_: Any) -> Any:
        baked.append(sensor.optics.shadows)
        return make_table(sensor, shadow=sensor.optics.shadows)

    monkeypatch.setattr(bake, "baked_table", fake)
    cases = ((LIT, None, False), (LIT, False, False), (LIT, True, True), (DARK, None, False), (DARK, True, True))
    for sensor, asked, casts in cases:
        assert Taxim(shadows=asked).build(sensor, resolution=RESOLUTION, device="cpu").shadows is casts
    assert baked == [True, True, True, False, True]
    for sensor, casts in ((LIT, True), (DARK, False)):
        table = make_table(sensor, shadow=True)
        assert Taxim(table).build(sensor, resolution=RESOLUTION, device="cpu").shadows is casts


def test_a_sensor_without_shadows_is_baked_without_them() -> None:
    settings = replace(BakeSettings.quick(), images=2, punches=3, pins=2, n_bins=15)
    baked = bake.bake(DARK, device="cpu", resolution=RESOLUTION, settings=settings)
    assert baked.table.shadow is None and baked.images == 5 and not baked.calibration.tracer.shadows  # pyright: ignore[reportAttributeAccessIssue]


def test_path_tracing_casts_shadows_and_says_so() -> None:
    common: dict[str, Any] = {"integrator": "reference", "resolution": RESOLUTION, "device": "cpu"}
    with pytest.raises(InputError, match=r"shadows = False: .*'reference' follows light as it goes"):
        built(RayTraced, LIT, shadows=False, **common)
    with pytest.warns(UserWarning, match=r"optics\.shadows = false of sensor .*'reference' casts shadows as light does"):
        built(RayTraced, DARK, **common)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        built(RayTraced, LIT, **common)
        built(RayTraced, DARK, shadows=True, **common)


def test_sensors_and_worlds_honour_the_file(tmp_path: Path) -> None:
    path = tmp_path / "dark.toml"
    path.write_text('base = "gelsight_mini"\n[optics]\nshadows = false\n', "utf-8")
    assert not TactileSensor(path, device="cpu").optical_mode.shadows  # type: ignore[attr-defined]
    task = load_task("roll_ball")
    task = replace(task, robot=replace(task.robot, sensor=str(path)))
    for shadows, casts in (None, False), (True, True):
        world = TactileWorld(task, outputs=("rgb",), device="cpu", optics=RayTraced(shadows=shadows))
        assert [sensor.optical_mode.shadows for sensor in world.sensors.values()] == [casts]  # type: ignore[attr-defined]
