"""Sensor and presses that ``calibrate`` and ``compare-real`` start from."""

from __future__ import annotations

from pathlib import Path

from raytac.calibrate.circles import with_found_circles
from raytac.calibrate.light_parameters import leds_at_walls, leds_split
from raytac.calibrate.photographs import Photographs, photographs_of
from raytac.calibrate.presses import RealPresses, read_presses
from raytac.calibrate.prior_choice import INNER, STRENGTHS
from raytac.errors import InputError
from raytac.specs import SensorSpec, load_sensor, with_lights
from raytac.specs.sensor import AUTO

__all__ = ["FROM_SCRATCH", "INNER", "OWN_LEDS", "prior_of", "read_data"]

FROM_SCRATCH = "12,8,9"
"""Numbers of LEDs that the Mini's main figures of docs/accuracy.md are of. Priors hold a fit to its start, and the shipped sensors' own
lights were fitted to photographs: begun from these, presses that are held out would not be new to it."""
OWN_LEDS = "own"


def prior_of(name: str) -> str | None:
    """``--prior``: None is ``INNER``.

    Raises:
        InputError: neither that nor a name of ``STRENGTHS``.
    """
    if name not in (INNER, *STRENGTHS):
        raise InputError("prior", value=name, rule="must be a known strength", choices=(INNER, *STRENGTHS))
    return None if name == INNER else name


def read_data(
    data: Path, sensor_name: str, ball_diameter_mm: float | None, sides: str, split: int = 1, device: str = "auto"
) -> tuple[SensorSpec, RealPresses, Photographs, list[str]]:
    """The sensor, its fully visible presses as read and as floats, and the names of those whose circles were found but are doubtful.

    ``sides`` as of ``leds_at_walls``, or ``OWN_LEDS``, each of which then is ``split`` into so many. ``device``: where an exposure of
    ``AUTO`` is found, under the sensor's own lights.

    Raises:
        SpecError, InputError, CalibrationError: as the readers say.
    """
    sensor = load_sensor(sensor_name)
    if sensor.response.exposure == AUTO:
        from raytac.optics.trace.fast_tracer import with_exposure

        sensor = with_exposure(sensor, device)
    if sides != OWN_LEDS:
        if split != 1:
            raise InputError("split", value=split, rule=f"is for --sides {OWN_LEDS}: name the numbers of LEDs themselves")
        sensor = with_lights(sensor, leds_at_walls(sensor, sides))
    elif split != 1:
        sensor = with_lights(sensor, leds_split(sensor, split))
    presses = read_presses(data, ball_diameter=None if ball_diameter_mm is None else ball_diameter_mm / 1e3)
    presses, doubtful = with_found_circles(presses, sensor.camera.pixel_pitch[0])
    names = [name for name, bad in zip(presses.names, doubtful, strict=True) if bad]
    return sensor, presses.take(presses.fully_visible), photographs_of(presses, sensor), names
