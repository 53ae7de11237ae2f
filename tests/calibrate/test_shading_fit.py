"""Colour shading from a photograph of the untouched sensor: reached as nearly as its degree allows, or refused."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from raytac.calibrate.image_fits import ShadingSettings, with_shading
from raytac.calibrate.photographs import encode
from raytac.errors import InputError
from raytac.gel.surface import GelSurface, make_grid
from raytac.optics import RayTraced
from raytac.optics.response import shading_gain
from raytac.specs import SensorSpec, load_sensor, validate_sensor
from raytac.specs.sensor_file import response_text

SIZE = (80, 60)
TRACING = RayTraced(bounce=False)
MINI = load_sensor("gelsight_mini")
BARE = dataclasses.replace(MINI, response=dataclasses.replace(MINI.response, shading_red=(), shading_green=(), shading_blue=()))


def at_rest(sensor: SensorSpec) -> np.ndarray:
    grid = make_grid(sensor.gelpad, 0.12e-3)
    rgb = TRACING.build(sensor, resolution=SIZE, device="cpu").render(GelSurface.at_rest(grid)).rgb
    assert rgb is not None
    return rgb[0].astype(float)


def test_known_shading_is_found_again() -> None:
    """A photograph that the sensor itself took under a known shading, but for rounding to whole levels."""
    rng = np.random.default_rng(0)
    degree = ShadingSettings().degree
    known = [tuple(map(float, rng.normal(0, 0.08, (degree + 1) * (degree + 2) // 2))) for _ in range(3)]
    response = dataclasses.replace(
        BARE.response, **dict(zip(("shading_red", "shading_green", "shading_blue"), known, strict=True))
    )
    photograph = at_rest(dataclasses.replace(BARE, response=response))
    found = with_shading(MINI, photograph, device="cpu", tracing=TRACING)
    ratio = shading_gain(found.response.shading, SIZE) / shading_gain(known, SIZE)
    assert np.abs(np.log(ratio)).mean() < 0.005, np.abs(np.log(ratio)).mean()
    assert np.abs(at_rest(found) - photograph).max() <= 2
    validate_sensor(found)


def test_a_higher_degree_comes_nearer_to_a_photograph_with_a_spot() -> None:
    v, u = (np.mgrid[: SIZE[1], : SIZE[0]] + 0.5) / 30 - 1
    spot = np.exp(-((u - 0.2) ** 2 + v**2) / 0.3)
    gamma, black = BARE.response.gamma, np.array(BARE.response.black_level)
    photograph = np.rint(encode(black + 0.1 + 0.2 * spot[..., None] * np.array([1.0, 0.5, 0.8]), gamma))
    off = []
    for degree in (0, 2, 4, 6):
        shaded = with_shading(BARE, photograph, settings=ShadingSettings(degree), device="cpu", tracing=TRACING)
        off.append(float(np.sqrt(((at_rest(shaded) - photograph) ** 2).mean())))
    assert all(finer < 0.75 * coarser for coarser, finer in itertools.pairwise(off)), off
    assert off[-1] < 4, off


def test_what_is_written_loads_again(tmp_path) -> None:  # type: ignore[no-untyped-def]
    shading = {"shading_red": tuple(0.01 * k for k in range(28)), "shading_blue": (0.25,)}
    response = dataclasses.replace(BARE.response, **shading)
    path = tmp_path / "mine.toml"
    path.write_text(f'base = "gelsight_mini"\n\n{response_text(response)}', "utf-8")
    assert load_sensor(path).response == response


def test_a_photograph_as_dark_as_the_black_level_is_refused() -> None:
    with pytest.raises(InputError, match="brighter than the black level"):
        with_shading(BARE, np.full((*SIZE[::-1], 3), 5.0), device="cpu", tracing=TRACING)


def test_lights_that_leave_pixels_dark_are_refused() -> None:
    dark = dataclasses.replace(
        BARE, lights=dataclasses.replace(BARE.lights, leds=tuple(led for led in BARE.lights.leds if led.layer == "blue"))
    )
    dark = dataclasses.replace(
        dark,
        lights=dataclasses.replace(
            dark.lights, leds=tuple(dataclasses.replace(led, power=(0.0, 0.0, 1e-4), glow=0.0) for led in dark.lights.leds)
        ),
    )
    with pytest.raises(InputError, match=r"lights = \d+: leave this many values"):
        with_shading(dark, np.full((*SIZE[::-1], 3), 120.0), device="cpu", tracing=TRACING)
