"""Sensor that a fit begins from: lights, response, size and scale of its images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from raytac.calibrate.light_parameters import CHANNELS
from raytac.checks import check_whole
from raytac.errors import InputError
from raytac.specs import LedSpec, LightsSpec, SensorSpec
from raytac.specs.sensor import UNMIXED
from raytac.specs.sensor_check import led_corners, validate_sensor

GAMMA, VIGNETTE = 1.4, -0.1
"""Exponent and first coefficient of the vignette where fits begin (docs/guide/calibrate.md)."""
SHAPE_TOLERANCE = 0.01
"""Most that the ratio of sides of photographs may differ from the sensor's."""
SIDES = {"red": (0.0, -1.0), "green": (1.0, 0.0), "blue": (0.0, 1.0)}
"""Outward direction (x, y) of the wall that the LEDs of a layer start at."""
LOWEST_START, HIGHEST_START = -30.0, -0.6
"""Range of heights z [mm] where rows of LEDs may begin."""
SPREAD = 1.5
"""Width over which an LED is split, over its own: with its neighbours a row (a guess)."""


def with_first_response(sensor: SensorSpec) -> SensorSpec:
    """The sensor with the response that a fit begins from, whatever its file was fitted to.

    Gamma ``GAMMA``, no stray light, the vignette 1 + ``VIGNETTE`` r², no shading, mix or tone curve; exposure and white balance are the
    sensor's.
    """
    vignetting = (VIGNETTE, 0.0, 0.0)
    bare = replace(sensor.response.unshaded, black_level=(0.0, 0.0, 0.0), colour_mix=UNMIXED, tone=())
    plain = replace(bare, gamma=GAMMA, vignetting=vignetting)
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


def leds_split(sensor: SensorSpec, count: int) -> LightsSpec:
    """Start of a fit: ``count`` LEDs in place of each of the sensor's own.

    They stand side by side over ``SPREAD`` times its width. What would stick out of the case's walls is moved inside. Raises InputError
    unless ``count`` is a whole number >= 1.
    """
    count = check_whole("split", count)
    if count == 1:
        return sensor.lights
    half, leds = 0.5 * np.array(sensor.case.size), []
    for led in sensor.lights.leds:
        width, along = SPREAD * led.size[0], np.array(led.edges[0])
        for k in range(count):
            place = np.array(led.position) + ((k + 0.5) / count - 0.5) * width * along
            part = replace(
                led,
                name=f"{led.name}_{k + 1}",
                position=tuple(map(float, place)),
                size=(width / count, led.size[1]),
                power=tuple(p / count for p in led.power),
            )
            corners = np.array(led_corners(part))[:, :2]
            inwards = np.maximum(-half - corners.min(0), 0) - np.maximum(corners.max(0) - half, 0)
            x, y, z = part.position
            leds.append(replace(part, position=(x + float(inwards[0]), y + float(inwards[1]), z)))
    return replace(sensor.lights, leds=tuple(leds))


def leds_at_walls(sensor: SensorSpec, sides: str) -> LightsSpec:
    """Start of a fit: LEDs along the walls, near the gel's height.

    They are aimed across the pad and towards the camera. Raises InputError unless ``sides`` is three whole numbers >= 1 joined by
    commas.
    """
    counts = sides.split(",")
    if len(counts) != 3 or not all(count.strip().isdecimal() and int(count) for count in counts):
        raise InputError("sides", value=sides, rule="must be three whole numbers >= 1 joined by commas, as in 3,2,3")
    half, leds = 0.5 * np.array(sensor.case.size), []
    for layer, count in zip(CHANNELS, map(int, counts), strict=True):
        out = np.array(SIDES[layer])
        own = np.eye(3)[CHANNELS.index(layer)]
        for k in range(count):
            along = 0.5 * (2 * k + 1 - count) / max(count, 2) * 2
            place = out * (half - 2.2e-3) + np.array([abs(out[1]), abs(out[0])]) * along * half * 0.8
            axis = np.array([*(-0.95 * out), -0.3])
            leds.append(
                LedSpec(
                    name=f"{layer}_{k + 1}",
                    layer=layer,
                    position=(float(place[0]), float(place[1]), -7.0e-3),
                    axis=tuple(map(float, axis / np.linalg.norm(axis))),  # type: ignore[arg-type]
                    size=(2.0e-3, 1.0e-3),
                    lobe=2.5,
                    power=tuple(map(float, 5e-5 / count * own)),  # type: ignore[arg-type]
                )
            )
    return LightsSpec(tuple(leds))


def leds_in_rows(lights: LightsSpec, heights: str | None, *, virtual: bool) -> LightsSpec:
    """Start of a fit: the LEDs in rows, one over the other, their powers shared.

    ``heights``: numbers joined by commas, z of the rows [mm]; None is one row where the LEDs are. ``virtual`` declares them so. Raises
    InputError for what is no such text, and heights outside ``LOWEST_START`` to ``HIGHEST_START``.
    """
    if heights is None:
        return replace(lights, leds=tuple(replace(led, virtual=virtual) for led in lights.leds))
    rule = f"must be numbers in [{LOWEST_START:g}, {HIGHEST_START:g}] joined by commas, as in -3.5,-9"
    try:
        rows = [float(part) for part in heights.split(",")]
    except ValueError:
        raise InputError("heights", value=heights, rule=rule) from None
    if not all(LOWEST_START <= z <= HIGHEST_START for z in rows):
        raise InputError("heights", value=heights, rule=rule)
    leds = [
        replace(
            led,
            name=led.name if len(rows) == 1 else f"{led.name}_row_{k + 1}",
            position=(*led.position[:2], z / 1e3),
            power=tuple(p / len(rows) for p in led.power),
            virtual=virtual,
        )
        for led in lights.leds
        for k, z in enumerate(rows)
    ]
    return replace(lights, leds=tuple(leds))
