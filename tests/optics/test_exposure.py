"""The exposure that makes mid-grey, and the warning of an image at rest that is white."""

from __future__ import annotations

import json
import math
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from raytac import TactileSensor
from raytac.cli import main
from raytac.errors import SpecError
from raytac.gel.surface import GelSurface
from raytac.optics import Phong, RayTraced, Taxim
from raytac.optics.response import mid_grey_exposure
from raytac.optics.taxim.bake import bake
from raytac.optics.trace.fast_tracer import with_exposure
from raytac.specs import SensorSpec, load_sensor
from raytac.specs.sensor import AUTO, LightsSpec, RefractionSpec
from raytac.specs.sensor_file import response_text
from tests.optics.scenes import RESOLUTION, built, grid_of, like_a_mini
from tests.optics.test_taxim_mode import make_table

COMMON: dict[str, Any] = {"resolution": RESOLUTION, "device": "cpu"}


def exposed(exposure: Any, **response: Any) -> SensorSpec:
    """A sensor whose own image is as small as those here."""
    mini = like_a_mini()
    camera, (width, height) = mini.camera, RESOLUTION
    small = replace(
        camera, resolution=RESOLUTION, pixel_pitch=camera.pitch_at(RESOLUTION), principal_point=(width / 2, height / 2)
    )
    return replace(mini, camera=small, response=replace(mini.response, exposure=exposure, **response))


WHITE = exposed(1e4)


def at_rest(mode: Any) -> np.ndarray:
    rgb = mode.render(GelSurface.at_rest(grid_of(WHITE))).rgb
    assert rgb is not None
    return rgb[0]


def told(caught: list[warnings.WarningMessage]) -> list[str]:
    return [str(one.message) for one in caught if "at 255 at rest" in str(one.message)]


def test_an_even_image_has_the_exposure_of_the_formula() -> None:
    """0.5 = (e s + b)^(1/γ) of the brightest channel, whatever the others are."""
    sensor = exposed(1.0, gamma=2.0, black_level=(0.05, 0.1, 0.0))
    signal = np.ones((6, 8, 3)) * [0.02, 0.01, 0.001]
    expected = (0.5**2 - 0.05) / 0.02
    assert mid_grey_exposure(sensor, signal) == pytest.approx(expected, rel=1e-3)
    assert mid_grey_exposure(sensor, 1e-6 * signal) == pytest.approx(1e6 * expected, rel=1e-3)
    uneven = signal * np.linspace(0.1, 3.0, 8)[:, None]
    e = mid_grey_exposure(sensor, uneven)
    means = (np.clip(e * uneven + sensor.response.black_level, 0, 1) ** 0.5).mean((0, 1))
    assert means.max() == pytest.approx(0.5, abs=1e-4) and f"{e:.4g}" == f"{e:g}"


@pytest.mark.parametrize(("black", "lit"), [((0.3, 0.0, 0.0), 1.0), ((0.0, 0.0, 0.0), 0.4), ((0.0, 0.0, 0.0), 0.0)])
def test_what_no_exposure_makes_grey_is_refused(black: tuple[float, ...], lit: float) -> None:
    signal = np.zeros((10, 10, 3))
    signal[: round(10 * lit)] = 1.0
    with pytest.raises(SpecError, match=r"response\.exposure = .*no exposure makes the image at rest mid-grey"):
        mid_grey_exposure(exposed(AUTO, gamma=2.0, black_level=black), signal)


@pytest.mark.parametrize("integrator", ["fast", "reference"])
def test_a_white_image_at_rest_is_told_of_once_with_the_exposure_that_mends_it(integrator: str) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tracer = built(RayTraced, WHITE, integrator=integrator, spp=1, **COMMON)
        assert (at_rest(tracer) == 255).any(axis=-1).mean() > 0.5
        at_rest(tracer)
    (message,) = told(caught)
    match = re.search(r"(\d+) % of the pixels are at 255 at rest with exposure = 10000; exposure = (\S+) makes", message)
    assert match and 50 < int(match[1]) <= 100
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rgb = at_rest(built(RayTraced, exposed(float(match[2])), integrator="fast", **COMMON))
    assert rgb.mean((0, 1)).max() == pytest.approx(127.5, abs=1.0 if integrator == "fast" else 5.0)


@pytest.mark.parametrize("kind", ["dome", "one layer", "slab", "monochrome", "lens"])
def test_sensors_of_every_kind_are_told_of_if_they_are_white(kind: str) -> None:
    """Other files of this folder leave the warning out."""
    sensor = replace(WHITE, gelpad=replace(WHITE.gelpad, dome_radius=(30e-3, 25e-3) if kind == "dome" else (math.inf, math.inf)))
    if kind == "one layer":
        sensor = replace(sensor, lights=LightsSpec(tuple(replace(led, layer="all") for led in sensor.lights.leds)))
    elif kind == "slab":
        sensor = replace(sensor, refraction=RefractionSpec("slab", 1.41, 0.5e-3))
    elif kind in ("monochrome", "lens"):
        changes: dict[str, Any] = {"monochrome": True} if kind == "monochrome" else {"distortion": (0.05, 0.0, 0.0, 0.0)}
        sensor = replace(sensor, camera=replace(sensor.camera, **changes))
    for exposure, count in ((1e4, 1), (1e-3, 0)):
        tracer = built(RayTraced, replace(sensor, response=replace(sensor.response, exposure=exposure)), **COMMON)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            tracer.prepare(grid_of(sensor))
        assert len(told(caught)) == count


def test_a_sensor_that_is_not_white_is_not_told_of() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        at_rest(built(RayTraced, like_a_mini(), **COMMON))
        at_rest(built(RayTraced, WHITE, flat_field=np.full((60, 80, 3), 100, np.uint8), **COMMON))
        built(RayTraced, exposed(AUTO), outputs=("depth",), **COMMON).render(GelSurface.at_rest(grid_of(WHITE)))


def test_auto_is_one_number_of_the_sensor_whatever_is_rendered() -> None:
    sensor = with_exposure(exposed(AUTO), "cpu")
    assert isinstance(sensor.response.exposure, float) and with_exposure(sensor) is sensor
    for options in ({"spp": 4, "resolution": (40, 30)}, {"bounce": False, "integrator": "reference"}):
        assert built(RayTraced, exposed(AUTO), device="cpu", **options).sensor.response == sensor.response
    rgb = at_rest(RayTraced().build(exposed(AUTO), device="cpu"))
    assert rgb.mean((0, 1)).max() == pytest.approx(127.5, abs=0.5)
    np.testing.assert_array_equal(rgb, at_rest(built(RayTraced, sensor, **COMMON)))


def test_cheap_modes_of_a_white_sensor_tell_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    white = replace(make_table(WHITE), background=np.full((60, 80, 3), 255, np.float32))
    monkeypatch.setattr(bake, "baked_table", lambda *_, **__: white)
    for mode in (built(Taxim, WHITE, **COMMON), built(Phong, WHITE, **COMMON)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            at_rest(mode)
        assert len(told(caught)) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        at_rest(built(Taxim, WHITE, calibration=white, **COMMON))  # photographs, of which the file's exposure says nothing


def test_the_recorded_exposure_is_a_number_or_absent() -> None:
    for exposure, outputs, number in ((AUTO, ("normals",), False), (3.0, ("normals",), True), (AUTO, ("rgb",), True)):
        sampling = TactileSensor(exposed(exposure), optics="raytrace", outputs=outputs, **COMMON).sampling
        assert (sampling["integrator"], sampling["spp"]) == ("fast", 1)
        assert isinstance(sampling.get("exposure"), float) == number and ("exposure" in sampling) == number


def test_a_file_may_say_auto_and_what_is_written_holds_the_number(tmp_path: Path) -> None:
    text = response_text(load_sensor("gelsight_mini").response).replace("exposure = 20\n", 'exposure = "auto"\n')
    text += "[camera]\nresolution_px = [80, 60]\npixel_pitch_mm = [0.2536, 0.2536]\n"
    text += "position_mm = [0.0, 0.0, -28.0]\nprincipal_point_px = [40.0, 30.0]\n"
    (tmp_path / "mine.toml").write_text(f'base = "gelsight_mini"\n{text}', "utf-8")
    spec = load_sensor(tmp_path / "mine.toml")
    assert spec.response.exposure == AUTO
    with pytest.raises(SpecError, match=r"response\.exposure = 'auto': must be a number here"):
        response_text(spec.response)
    (tmp_path / "bad.toml").write_text(f'base = "gelsight_mini"\n{text.replace("auto", "outo")}', "utf-8")
    with pytest.raises(SpecError, match=r"response\.exposure = 'outo': must be a number in \(0, 1e9\], or \"auto\""):
        load_sensor(tmp_path / "bad.toml")
    out = tmp_path / "out"
    options = ["--sensor", str(tmp_path / "mine.toml"), "--outputs", "rgb", "--device", "cpu", "--out", str(out)]
    assert main(["press", "sphere", *options]) == 0
    found = json.loads((out / "metrics.json").read_text("utf-8"))["image.exposure"]
    assert found == with_exposure(spec, "cpu").response.exposure
    assert OpenEXR.File(str(out / "frame.exr")).header()["raytac:exposure"] == str(found)
