"""Options that several commands have, and the data set that ``calibrate`` and ``compare-real`` read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from raytac.calibrate.circles import with_found_circles
from raytac.calibrate.light_parameters import leds_at_walls, leds_split
from raytac.calibrate.photographs import Photographs, photographs_of
from raytac.calibrate.presses import RealPresses, read_presses
from raytac.calibrate.prior_choice import INNER, STRENGTHS
from raytac.errors import InputError
from raytac.io.options import CommonOptions
from raytac.physics.soft.availability import check_solver, hush_solver
from raytac.specs import SensorSpec, load_sensor, with_lights
from raytac.specs.sensor import AUTO

__all__ = ["CASTING", "FROM_SCRATCH", "INNER", "OWN_LEDS", "ShadowOptions", "SolverOptions", "prior_of", "read_data"]

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


@dataclass(frozen=True, kw_only=True)
class SolverOptions(CommonOptions):
    """Options of a command that may use the contact solver."""

    verbose: bool = False
    """Let Warp, on which the contact solver runs, list devices and the kernels that it loads; warnings and errors only if not given."""

    def prepare_solver(self, user: str) -> None:
        """Call before the solver is first used; ``user`` is what needs it.

        Raises:
            BackendError: the solver is not installed.
        """
        check_solver(user)
        if not self.verbose:
            hush_solver()


CASTING = ("raytrace", "taxim")
"""Optical modes that can cast shadows."""


@dataclass(frozen=True, kw_only=True)
class ShadowOptions:
    shadows: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Cast shadows, of a sensor whose file says otherwise too."""
    no_shadows: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Cast none; as the sensor file says ([optics] shadows) if neither is given."""

    def chosen_shadows(self, optics: str = CASTING[0]) -> dict[str, bool]:
        """``{"shadows": …}`` for the optical mode; empty if the sensor decides.

        Raises:
            InputError: both flags, or one for a mode that casts no shadows.
        """
        if not (self.shadows or self.no_shadows):
            return {}
        if self.shadows and self.no_shadows:
            raise InputError("shadows, no_shadows", value=(True, True), rule="contradict each other: give one")
        if optics not in CASTING:
            name = "shadows" if self.shadows else "no_shadows"
            raise InputError(name, value=True, rule=f"is for optics that cast shadows, not for {optics!r}", choices=CASTING)
        return {"shadows": self.shadows}
