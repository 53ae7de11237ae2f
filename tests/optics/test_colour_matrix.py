"""Colour matrix and tone curve wherever light becomes an image: monochrome cameras, flat field, exposure, advice, shading, darkness."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from raytac.calibrate.image_fits import ShadingSettings, with_shading
from raytac.errors import InputError, SpecError
from raytac.gel.surface import GelSurface, make_grid
from raytac.optics import RayTraced
from raytac.optics.camera import Pinhole
from raytac.optics.response import Response, mid_grey_exposure
from raytac.optics.runtime import load_mitsuba
from raytac.optics.trace.fast_tracer import with_exposure
from raytac.specs import SensorSpec
from raytac.specs.sensor import AUTO
from raytac.specs.tone import ToneCurve
from tests.optics.scenes import PITCH, RESOLUTION
from tests.optics.test_exposure import exposed

MIX = (-0.03, 0.2, 0.25, -0.02, 0.3, 0.1)
MATRIX = np.array([[1, -0.03, 0.2], [0.25, 1, -0.02], [0.3, 0.1, 1]])
TONE = (0.3, -0.1, 0.4)
TRACING = RayTraced(bounce=False, shadows=False)
TARGET = np.array([120.0, 100.0, 90.0])


def mixed(exposure: float | str = 12.0, *, monochrome: bool = False, **response: object) -> SensorSpec:
    """A small sensor with a colour matrix and a tone curve."""
    sensor = exposed(exposure, colour_mix=MIX, tone=TONE, **response)
    return replace(sensor, camera=replace(sensor.camera, monochrome=monochrome))


def at_rest(sensor: SensorSpec, tracing: RayTraced = TRACING) -> np.ndarray:
    """Levels of the untouched sensor, (H, W, 3)."""
    tracer = tracing.build(sensor, resolution=RESOLUTION, device="cpu")
    rgb = tracer.render(GelSurface.at_rest(make_grid(sensor.gelpad, PITCH))).rgb
    assert rgb is not None
    return rgb[0].astype(float)


def by_flat_field(sensor: SensorSpec) -> np.ndarray:
    """What the image at rest with an even flat field of ``TARGET`` is off, over 127.5."""
    field = np.broadcast_to(TARGET, (*RESOLUTION[::-1], 3)).astype(np.uint8)
    wanted = TARGET.mean() if sensor.camera.monochrome else TARGET
    flat = at_rest(sensor, replace(TRACING, flat_field=field))
    return np.abs(flat - wanted) + 127.5


def by_exposure(sensor: SensorSpec) -> np.ndarray:
    """The image at rest with the exposure that is found for it."""
    auto = replace(sensor, response=replace(sensor.response, exposure=AUTO))
    return at_rest(with_exposure(auto, "cpu"), RayTraced())


def by_advice(sensor: SensorSpec) -> np.ndarray:
    """The same with the exposure that a warning of a white image names."""
    white = replace(sensor, response=replace(sensor.response, exposure=1e4))
    with pytest.warns(UserWarning, match="at 255 at rest") as caught:
        at_rest(white)
    match = re.search(r"; exposure = (\S+) makes", str(caught[0].message))
    assert match
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return at_rest(replace(sensor, response=replace(sensor.response, exposure=float(match[1]))))


def by_shading(sensor: SensorSpec) -> np.ndarray:
    """The image at rest with the shading that is fitted to an even photograph."""
    even = np.full((*RESOLUTION[::-1], 3), 127.5)
    return at_rest(with_shading(sensor, even, device="cpu", tracing=TRACING, settings=ShadingSettings(pitch=PITCH)))


@pytest.mark.parametrize("by", [by_flat_field, by_exposure, by_advice, by_shading])
@pytest.mark.parametrize("monochrome", [False, True], ids=["colours", "monochrome"])
def test_what_is_made_mid_grey_is_so_after_the_colour_matrix(by: Callable[[SensorSpec], np.ndarray], monochrome: bool) -> None:
    brightest = by(mixed(monochrome=monochrome)).mean((0, 1)).max()
    assert brightest == pytest.approx(127.5, abs=1.0)


def test_a_monochrome_camera_shows_the_mean_of_mixed_channels() -> None:
    """On device and host, against the formula."""
    mi, _ = load_mitsuba("cpu")
    sensor = mixed(3.0, monochrome=True, black_level=(0.01, 0.02, 0.0), white_balance=(1.1, 0.9, 0.8))
    spec, light = sensor.response, np.random.default_rng(0).uniform(0, 0.4, (*RESOLUTION[::-1], 3)).astype(np.float32)
    response = Response(spec, Pinhole.from_spec(sensor.camera, RESOLUTION), monochrome=True)
    value = (3.0 * np.array(spec.white_balance) * (light @ MATRIX.T) + spec.black_level).mean(-1, keepdims=True)
    expected = 255 * ToneCurve(TONE).bent(np.clip(value, 0, 1) ** (1 / spec.gamma))
    host = response.encode_numpy(light)
    assert np.abs(host - expected).max() <= 0.51 and host.std() > 10
    channels = [mi.Float(np.ascontiguousarray(light[..., c]).ravel()) for c in range(3)]
    device = response.encode(mi, channels, response.device_scale(mi))
    dr.eval(device)
    assert np.abs(np.array(device).reshape(light.shape).astype(int) - host).max() <= 1


def test_an_image_that_is_half_negative_has_an_exposure_that_solves_its_equation_or_none() -> None:
    """A positive black level under negative light falls with the exposure: brightness is no longer monotonic, a root is one still."""
    sensor = exposed(AUTO, gamma=2.0, black_level=(0.23, 0.0, 0.0))
    signal = np.zeros((10, 10, 3))
    signal[..., 0] = -1e-3
    signal[:6, :, 0] = 1.0

    def brightness(exposure: float) -> float:
        return float((np.clip(exposure * signal + sensor.response.black_level, 0, 1) ** 0.5).mean((0, 1)).max())

    levels = [brightness(e) for e in np.geomspace(1e-3, 1e4, 50)]
    assert np.diff(levels).min() < -1e-3 and levels[0] < 0.5 < levels[-1]
    assert brightness(mid_grey_exposure(sensor, signal)) == pytest.approx(0.5, abs=1e-3)
    signal[4:, :, 0] = -1.0
    with pytest.raises(SpecError, match="dark or negative after the colour matrix"):
        mid_grey_exposure(sensor, signal)


def test_light_that_the_matrix_makes_negative_is_refused_by_name() -> None:
    """Red less all of green and blue, for a flat field and for shading."""
    sensor = mixed()
    sensor = replace(sensor, response=replace(sensor.response, colour_mix=(-1.0, -1.0, 0.0, 0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match="dark or negative after the colour matrix"):
        by_flat_field(sensor)
    with pytest.raises(InputError, match="dark or negative after the colour matrix"):
        by_shading(sensor)
