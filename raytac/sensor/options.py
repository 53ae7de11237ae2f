"""Checks of a sensor's options, made before anything is computed."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from raytac.checks import check_names, check_number, check_numbers, check_whole
from raytac.errors import InputError
from raytac.frame import OUTPUTS
from raytac.io.options import parse_resolution
from raytac.markers.base import MarkersConfig
from raytac.markers.registry import MARKERS, markers_config, models_without_coat
from raytac.optics.base import OPTICAL_OUTPUTS
from raytac.optics.registry import OPTICS
from raytac.physics.base import TargetArrays
from raytac.specs import PressScene, load_press

if TYPE_CHECKING:
    from raytac.optics.base import OpticalMode, OpticsConfig
    from raytac.physics.base import PhysicsConfig

LARGEST_SIDE = 8192
"""Longest side of an image [px], as in sensor files."""
SHAPE_TOLERANCE = 0.02
"""Largest deviation from the aspect ratio without a warning: rounding to whole pixels."""


class EnvironmentTargets(TargetArrays, total=False):
    """Targets and seeds of the B environments of a press, as ``TactileSensor.load`` says."""

    seeds: Sequence[int] | None


class SensorSettings(TypedDict, total=False):
    """Keyword arguments of ``TactileSensor`` that a model's sensors take, all of them the same."""

    outputs: Sequence[str] | str
    markers: str | MarkersConfig | None
    optics: str | OpticsConfig[OpticalMode] | OpticalMode
    resolution: tuple[int, int] | str | None
    device: str
    pitch: float | None
    noise: bool


def sensor_outputs(optics: str | OpticsConfig[OpticalMode] | type[OpticsConfig[OpticalMode]]) -> tuple[str, ...]:
    """Outputs of a sensor with an optical mode: all but those that only other modes make."""
    made = (OPTICS.config_class(optics) if isinstance(optics, str) else optics).outputs
    return tuple(name for name in OUTPUTS if name not in OPTICAL_OUTPUTS or name in made)


def checked_outputs(outputs: Sequence[str] | str, optics: OpticsConfig[OpticalMode]) -> tuple[str, ...]:
    """Names in the order of ``OUTPUTS``; ``InputError`` if unknown, or not made by ``optics``."""
    several = outputs if isinstance(outputs, (list, tuple)) else ()
    names = [outputs] if isinstance(outputs, str) else [name for name in several if isinstance(name, str)]
    if "markers" in names:
        raise InputError("outputs", value=outputs, rule="markers are asked for by the argument markers, as in markers='fots'")
    if "force" in names:
        raise InputError("outputs", value=outputs, rule="frame.force always comes, without asking; 'wrench' adds its torque")
    outputs, offered = check_names("outputs", outputs, OUTPUTS), sensor_outputs(optics)
    for name in outputs:
        if name not in offered:
            raise InputError("outputs", value=name, rule=f"must be an output of optics={optics.label!r}", choices=offered)
    return tuple(name for name in OUTPUTS if name in outputs)


def checked_markers(markers: str | MarkersConfig | None, physics: PhysicsConfig | None) -> MarkersConfig | None:
    """Configuration of the marker model; ``InputError`` if unknown, or not for this physics."""
    config = None if markers is None else markers_config(markers)
    if config is not None and config.needs_coat and physics is not None and not physics.is_simulated:
        rule = f"tracks the surface of a soft pad; physics={physics.label!r} has none"
        raise InputError("markers", value=MARKERS.name_of(config), rule=rule, choices=models_without_coat())
    return config


def checked_resolution(resolution: tuple[int, int] | str | None) -> tuple[int, int] | None:
    """(width, height) [px]. Raises ``InputError`` for what cannot be read or is out of range."""
    if resolution is None:
        return None
    if isinstance(resolution, str):
        resolution = parse_resolution(resolution)
    if not isinstance(resolution, (tuple, list)) or len(resolution) != 2:
        raise InputError("resolution", value=resolution, rule="must be (width, height) in pixels, as in (320, 240) or '320x240'")
    for side in resolution:
        check_whole("resolution", side, 1, LARGEST_SIDE)
    return int(resolution[0]), int(resolution[1])


def check_maps(name: str, values: ArrayLike, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """Maps (B, rows, columns), float64, of one or several; ``InputError`` for anything else.

    ``shape``: that of other maps, whose mask this is.
    """
    given = np.asarray(values)
    if shape is not None and given.dtype.kind == "b":
        given = given.astype(float)
    given = given[None] if given.ndim == 2 else given
    if given.dtype.kind in "iuf" and (given.ndim != 3 or min(given.shape) < 1 or min(given.shape[1:]) < 2):
        rule = "must have shape (rows, columns) or (B, rows, columns), with 2 rows and columns at least"
        raise InputError(name, value=np.shape(values), rule=rule)
    return check_numbers(name, given, shape or (None, None, None), finite=True)


def checked_pitch(pitch: float | tuple[float, float]) -> tuple[float, float]:
    """Spacing (x, y) [m] of a map. Raises ``InputError`` for what is not one or two lengths."""
    pair = tuple(pitch) if isinstance(pitch, (tuple, list)) else (pitch, pitch)
    if len(pair) != 2:
        raise InputError("pitch", value=pitch, rule="must be one length or two, (x, y), in metres")
    x, y = (check_number("pitch", one, "(0, 0.01]", "m") for one in pair)
    return x, y


def press_scene(scene: str | Path | PressScene) -> PressScene:
    """The scene itself, or that of a name or file; raises ``InputError`` or ``SpecError``."""
    if not isinstance(scene, (str, Path, PressScene)):
        raise InputError("scene", value=scene, rule=f"must be a name, a path or a PressScene, not {type(scene).__name__}")
    return scene if isinstance(scene, PressScene) else load_press(scene)


def warn_of_other_shape(resolution: tuple[int, int], native: tuple[int, int]) -> None:
    """Warn of an image of another shape than the sensor's view: its pixels are not square."""
    (width, height), (native_width, native_height) = resolution, native
    stretch = (width / native_width) / (height / native_height)
    if abs(stretch - 1.0) > SHAPE_TOLERANCE:
        warnings.warn(
            f"resolution {width}x{height} squeezes the sensor's view of {native_width}x{native_height}: against the sensor's pixels "
            f"these are {max(stretch, 1 / stretch):.3g} times as {'high as wide' if stretch > 1 else 'wide as high'}; "
            f"{width}x{max(round(width * native_height / native_width), 1)} keeps their shape",
            stacklevel=3,
        )
