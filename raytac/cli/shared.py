"""Options of several commands, and the data set of ``calibrate`` and ``compare-real``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from raytac.calibrate.circles import with_found_circles
from raytac.calibrate.light_parameters import leds_at_walls, leds_split
from raytac.calibrate.photographs import Photographs, photographs_of
from raytac.calibrate.presses import RealPresses, read_presses
from raytac.calibrate.prior_choice import INNER, STRENGTHS
from raytac.checks import check_known
from raytac.errors import InputError
from raytac.io.options import CommonOptions
from raytac.physics.base import PhysicsConfig
from raytac.physics.registry import PHYSICS, scene_physics
from raytac.specs import PressScene, SensorSpec, TaskScene, load_sensor, with_lights
from raytac.specs.sensor import AUTO
from raytac.warp_messages import quiet_warp

FROM_SCRATCH = "12,8,9"
"""Numbers of LEDs of the Mini's main figures in docs/accuracy.md.

Priors hold a fit to its start, and the shipped sensors' own lights were fitted to photographs: begun from these, presses that are
held out would not be new to it."""
OWN_LEDS = "own"


def named(names: Iterable[str]) -> object:
    """Names as the help shows the values of an option: ``{rigid,ipc}``."""
    return tyro.conf.arg(metavar="{" + ",".join(names) + "}")


def print_paths(paths: Iterable[Path]) -> int:
    """Print the files written, one a line; returns the exit code of success."""
    for path in paths:
        print(path)
    return 0


def read_data(
    data: Path, sensor_name: str, ball_diameter_mm: float | None, sides: str, split: int = 1, device: str = "auto"
) -> tuple[SensorSpec, RealPresses, Photographs, list[str]]:
    """The sensor, its fully visible presses as read and as floats, and names of doubtful ones.

    A press is doubtful if its circle was found in the image without a clear step of colour. ``sides`` as of ``leds_at_walls``, or
    ``OWN_LEDS``, each of which then is ``split`` into so many. ``device``: where an exposure of ``AUTO`` is found, under the
    sensor's own lights.

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
class FitOptions(CommonOptions):
    """Options of a command that fits models to photographs."""

    ball_diameter_mm: float | None = None
    """Needed by a dataPack.npz, which does not say it."""
    sides: str = FROM_SCRATCH
    """Numbers of red, green, blue LEDs at their walls, joined by commas; or `own`, the sensor's.

    Where those were fitted to photographs that are tested on, errors are not of held-out presses."""
    split: int = 1
    """With `--sides own`: LEDs that each is split into, side by side over 1.5 times its width.

    LEDs behind a diffuser light like a row."""
    starts: int = 3
    """Starts of a fit of direct light; the best goes on."""
    rounds: int = 3
    """Rounds with the ray tracer after direct light."""
    prior: str = INNER
    """Strength of the LEDs' priors: free, tied, tied-dark, tied-darkest (docs/real-images.md).

    Or `inner`, which chooses by cross-validation between halves of the pad within the presses that are fitted to."""

    @property
    def chosen_prior(self) -> str | None:
        """``--prior``; None is ``INNER``. Raises ``InputError`` for no name of ``STRENGTHS``."""
        return None if check_known("prior", self.prior, (INNER, *STRENGTHS)) == INNER else self.prior

    def read(self, data: Path, sensor: str) -> tuple[SensorSpec, RealPresses, Photographs]:
        """As ``read_data``; doubtful circles are printed."""
        spec, presses, shots, doubtful = read_data(data, sensor, self.ball_diameter_mm, self.sides, self.split, self.device)
        for name in doubtful:
            print(f"the circle of press {name} is doubtful")
        return spec, presses, shots


def chosen_physics(physics: str | None, level: str | None, scene: PressScene | TaskScene) -> PhysicsConfig:
    """Physics that ``--physics`` and ``--level`` name.

    With a level alone ``ipc``, with neither as the scene says, else ``rigid``.

    Raises ``InputError``: an unknown name, or a level of a physics that has none. SpecError: an unknown name in the scene.
    """
    if physics is None and level is None:
        return scene_physics(None, scene)
    return scene_physics(PHYSICS.config(physics or "ipc", **({} if level is None else {"level": level})), scene)


@dataclass(frozen=True, kw_only=True)
class SolverOptions(CommonOptions):
    """Options of a command that computes contacts."""

    verbose: bool = False
    """Let Warp, in which contacts are computed, list devices and the kernels that it loads."""

    def prepare_warp(self) -> None:
        """Call before contacts are first computed."""
        if not self.verbose:
            quiet_warp()


@dataclass(frozen=True, kw_only=True)
class ShadowOptions:
    """Options of a command that renders: shadows, whatever the sensor file says."""

    shadows: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Cast shadows, of a sensor whose file says otherwise too."""
    no_shadows: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Cast none; as the sensor file says ([optics] shadows) if neither is given."""

    def chosen_shadows(self) -> dict[str, bool]:
        """``{"shadows": …}``; empty if the sensor decides. Raises ``InputError`` for both flags."""
        if self.shadows and self.no_shadows:
            raise InputError("shadows, no_shadows", value=(True, True), rule="contradict each other: give one")
        return {"shadows": self.shadows} if self.shadows or self.no_shadows else {}
