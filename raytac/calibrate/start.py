"""Camera that a fit begins from: its response, and another size or scale of its images."""

from __future__ import annotations

from dataclasses import replace

from raytac.errors import InputError
from raytac.specs import SensorSpec
from raytac.specs.sensor_check import validate_sensor

GAMMA, VIGNETTE = 1.4, -0.1
"""Exponent and first coefficient of the vignette where every fit begins (docs/accuracy.md)."""
SHAPE_TOLERANCE = 0.01
"""Most that the ratio of sides of photographs may differ from the sensor's."""


def with_first_response(sensor: SensorSpec) -> SensorSpec:
    """The sensor with the response that a fit begins from, whatever its file was fitted to.

    Gamma ``GAMMA``, no stray light, the vignette 1 + ``VIGNETTE`` r², no colour shading; exposure and white balance are the sensor's.
    """
    plain = replace(sensor.response.unshaded, gamma=GAMMA, black_level=(0.0, 0.0, 0.0), vignetting=(VIGNETTE, 0.0, 0.0))
    return replace(sensor, response=plain)


def with_images(sensor: SensorSpec, resolution: tuple[int, int], pixel_pitch: float) -> SensorSpec:
    """The sensor whose camera gives images of ``resolution`` (width, height) with square pixels.

    ``pixel_pitch``: side of a pixel on the coat [m]. The optical axis meets the same place of the image. Raises InputError: another
    ratio of sides than the sensor's; SpecError: a view that is larger than the pad.
    """
    camera = sensor.camera
    ratio = resolution[0] / resolution[1] / (camera.resolution[0] / camera.resolution[1])
    if abs(ratio - 1) > SHAPE_TOLERANCE:
        rule = f"must have images whose sides are as {camera.resolution[0]} to {camera.resolution[1]}, the sensor's"
        raise InputError("data", value=resolution, rule=rule)
    x, y = (p * n / own for p, n, own in zip(camera.principal_point, resolution, camera.resolution, strict=True))
    pitch = (float(pixel_pitch), float(pixel_pitch))
    other = replace(sensor, camera=replace(camera, resolution=resolution, pixel_pitch=pitch, principal_point=(x, y)))
    validate_sensor(other)
    return other
