"""Options of commands that fit models to photographs, and how they read those."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from raytac.calibrate.circles import with_found_circles
from raytac.calibrate.photographs import Photographs, photographs_of
from raytac.calibrate.presses import RealPresses, read_presses
from raytac.calibrate.prior_choice import INNER, STRENGTHS
from raytac.calibrate.start import leds_at_walls, leds_in_rows, leds_split, with_first_response, with_images
from raytac.checks import check_known
from raytac.errors import InputError
from raytac.io.options import CommonOptions
from raytac.specs import SensorSpec, load_sensor, with_lights
from raytac.specs.sensor import AUTO

FROM_SCRATCH = "12,8,9"
"""Numbers of LEDs of the Mini's main figures in docs/measurements/photographs.md.

Priors hold a fit to its start, and the shipped sensors' own lights were fitted to photographs: begun from these, presses that are
held out would not be new to it."""
OWN_LEDS = "own"


def read_data(
    data: Path,
    sensor_name: str,
    ball_diameter_mm: float | None,
    sides: str,
    split: int = 1,
    device: str = "auto",
    *,
    border: bool = True,
    own_response: bool = False,
    pixel_mm: float | None = None,
    heights: str | None = None,
    virtual: bool = False,
) -> tuple[SensorSpec, RealPresses, Photographs, dict[str, str]]:
    """The sensor, its presses as read and as floats, and what to say of some, by name.

    ``border``: with presses whose labelled circle leaves the image. One without a label is left out there, since circles are searched
    for badly at the border. A press is doubtful if its circle was found in the image without a clear step of colour.
    ``own_response``: begin from the response of the sensor's file, and not from ``with_first_response``. ``pixel_mm``: side of a
    pixel on the coat, for photographs of another size or scale than the sensor's.
    ``sides`` as of ``leds_at_walls``, or ``OWN_LEDS``, each of which then is ``split`` into so many. ``heights`` [mm]: z of rows of
    LEDs, all of them at each; ``virtual`` declares them virtual sources. ``device``: where an exposure of ``AUTO`` is
    found, under the sensor's own lights.

    Raises:
        SpecError, InputError, CalibrationError: as the readers say.
    """
    sensor = load_sensor(sensor_name)
    if sensor.response.exposure == AUTO:
        from raytac.optics.trace.fast_tracer import with_exposure

        sensor = with_exposure(sensor, device)
    presses = read_presses(data, ball_diameter=None if ball_diameter_mm is None else ball_diameter_mm / 1e3)
    if not own_response:
        sensor = with_first_response(sensor)
    if pixel_mm is not None:
        if not 0 < pixel_mm < 1:
            raise InputError("pixel_mm", value=pixel_mm, rule="must be the side of a pixel on the coat, in (0, 1) mm")
        sensor = with_images(sensor, presses.resolution, pixel_mm / 1e3)
    if sides != OWN_LEDS:
        if split != 1:
            raise InputError("split", value=split, rule=f"is for --sides {OWN_LEDS}: name the numbers of LEDs themselves")
        sensor = with_lights(sensor, leds_at_walls(sensor, sides))
    elif split != 1:
        sensor = with_lights(sensor, leds_split(sensor, split))
    if heights is not None or virtual:
        sensor = with_lights(sensor, leds_in_rows(sensor.lights, heights, virtual=virtual))
    labelled = ~np.isnan(presses.circles).any(axis=1)
    presses, doubtful = with_found_circles(presses, sensor.camera.pixel_pitch[0])
    used = presses.fully_visible | (labelled & border)
    said = {name: "the circle is doubtful" for name, bad in zip(presses.names, doubtful & used, strict=True) if bad}
    why = "it is not fully visible" + (", and its circle is not labelled" if border else "")
    said |= {name: f"not used: {why}" for name, is_used in zip(presses.names, used, strict=True) if not is_used}
    presses = presses.take(used)
    if not len(presses):
        raise InputError("data", value="0 presses", rule="must hold a press whose contact circle lies in the image")
    return sensor, presses, photographs_of(presses, sensor), said


@dataclass(frozen=True, kw_only=True)
class FitOptions(CommonOptions):
    """Options of a command that fits models to photographs."""

    ball_diameter_mm: float | None = None
    """Diameter of the ball, of plain photographs, a dataPack.npz or forces, which do not say it."""
    sides: str = FROM_SCRATCH
    """Numbers of red, green, blue LEDs at their walls, joined by commas; or `own`, the sensor's.

    Where those were fitted to photographs that are tested on, errors are not of held-out presses."""
    split: int = 1
    """With `--sides own`: LEDs that each is split into, side by side over 1.5 times its width.

    LEDs behind a diffuser light like a row."""
    heights: str | None = None
    """Heights z of rows of LEDs where a fit begins [mm], joined by commas, as in -3.5,-9.

    Each row has all LEDs. If not given, one row, at -7 or where the sensor's own are."""
    virtual: bool = False
    """Declare the LEDs virtual sources (docs/guide/calibrate.md).

    They stand for light that entered gel and plate at their sides, and may lie beside the view up to the coat, which LEDs of glass
    and metal may not."""
    starts: int = 3
    """Starts of a fit of direct light; the best goes on."""
    rounds: int = 3
    """Rounds with the ray tracer after direct light."""
    prior: str = INNER
    """Strength of the LEDs' priors: free, tied, tied-dark or tied-darkest.

    Or `inner`, which chooses by cross-validation between halves of the pad within the presses that are fitted to."""

    pixel_mm: float | None = None
    """Side of a pixel on the coat [mm]; needed for images of another size than the sensor's."""
    own_response: bool = False
    """Begin from the response of the sensor's file, in place of gamma 1.4 without stray light.

    That of a shipped sensor was fitted to photographs."""
    border: bool = True
    """Also fit presses whose labelled circle leaves the image; they are tested apart."""
    drift: bool = True
    """Take session drift from every photograph: a gain and an offset a channel.

    They are measured where no press reaches."""

    @property
    def chosen_prior(self) -> str | None:
        """``--prior``; None is ``INNER``. Raises ``InputError`` for no name of ``STRENGTHS``."""
        return None if check_known("prior", self.prior, (INNER, *STRENGTHS)) == INNER else self.prior

    def read(self, data: Path, sensor: str) -> tuple[SensorSpec, RealPresses, Photographs]:
        """As ``read_data``; doubtful circles and presses that are not used are printed."""
        spec, presses, shots, said = read_data(
            data,
            sensor,
            self.ball_diameter_mm,
            self.sides,
            self.split,
            self.device,
            border=self.border,
            own_response=self.own_response,
            pixel_mm=self.pixel_mm,
            heights=self.heights,
            virtual=self.virtual,
        )
        for name, what in said.items():
            print(f"press {name}: {what}")
        return spec, presses, shots
