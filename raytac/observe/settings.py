"""Settings of a tactile sensor's observation: names, sizes and units, checked at once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from raytac.checks import check_mapping, check_names, check_truth, check_whole, is_number, is_whole
from raytac.errors import InputError
from raytac.io.options import parse_resolution
from raytac.markers.base import MarkersConfig
from raytac.markers.registry import markers_config
from raytac.optics.base import OpticalMode, OpticsConfig
from raytac.optics.registry import chosen_optics
from raytac.sensor.options import LARGEST_SIDE, checked_resolution
from raytac.specs.sensor import SensorSpec

MODALITIES = ("rgb", "markers", "marker_visible", "height", "indentation", "contact", "traction", "wrench")
"""Names that ``modalities`` accepts:

- ``rgb``: the camera's image, uint8, (H, W, 3);
- ``markers``: displacement of every marker along x and y of the pad, (M, 2); 0 where a marker is lost;
- ``marker_visible``: 1 where the tracker sees the marker, else 0, (M,);
- ``height``: height of the surface over the pad frame's origin, (rows, columns);
- ``indentation``: height at rest minus height, (rows, columns); negative where the gel bulges;
- ``contact``: share of a cell that is in contact, (rows, columns), 0 to 1;
- ``traction``: force on the pad per area of a cell, pad frame, (rows, columns, 3);
- ``wrench``: force on the pad and torque about the pad frame's origin, pad frame, (6,).
"""
SCALES: Mapping[str, float | tuple[float, ...]] = {
    "markers": 1e-3,
    "height": 1e-3,
    "indentation": 1e-3,
    "traction": 1e4,
    "wrench": (10.0, 10.0, 10.0, 0.1, 0.1, 0.1),
}
"""Divisors that bring values to the order of 1: [m], [Pa], [N] and [N m]."""


@dataclass(frozen=True)
class ObservationSettings:
    """Choices of one sensor's observation.

    Optical mode, marker model and pad physics change values, never shapes.
    """

    modalities: tuple[str, ...] = ("markers",)
    """Names of ``MODALITIES``; nothing else is computed."""
    resolution: tuple[int, int] | str | None = None
    """(width, height) of ``rgb`` [px], or text as ``"64x48"``; None is the sensor's own."""
    crop: str | tuple[int, int, int, int] = "centre"
    """Crop of the rendered image: ``"centre"`` or (left, top, right, bottom).

    ``"centre"`` keeps the pixels square and takes the largest centred part that fits. Four numbers remove that many pixels of the observed
    size, and the view is scaled to the observed shape."""
    downscale: int = 1
    """The image is rendered this many times as large along both sides and averaged."""
    difference: bool = False
    """Make ``rgb`` (255 + image − image at rest) // 2: 127 where nothing changed, no overflow."""
    map_shape: tuple[int, int] = (32, 32)
    """(rows, columns) of maps: ``height``, ``contact`` and so on; at most the grid's nodes."""
    stack: int = 1
    """Number of last observations that are stacked, oldest first.

    Images are stacked in the channels, all else along a new first axis. After a reset all are the first one."""
    normalise: bool = True
    """Divide by ``SCALES``; else SI units. Images stay 8-bit and contact a ratio."""
    scales: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)
    """In place of those of ``SCALES``, by modality."""
    optics: str | OpticsConfig[OpticalMode] = "taxim"
    """As of ``TactileSensor``: a name, or a configuration."""
    markers: str | MarkersConfig = "fots"
    """As of ``TactileSensor``."""
    noise: bool = False
    """True adds the camera's own grain to ``rgb``, as of ``TactileSensor``; the rest has none."""

    def __post_init__(self) -> None:
        given = check_names("modalities", self.modalities, MODALITIES)
        if not given or len(set(given)) != len(given):
            raise InputError("modalities", value=given, rule="must name one or more, none twice", choices=MODALITIES)
        object.__setattr__(self, "modalities", tuple(m for m in MODALITIES if m in given))
        if isinstance(self.resolution, str):
            object.__setattr__(self, "resolution", parse_resolution(self.resolution))
        object.__setattr__(self, "resolution", checked_resolution(self.resolution))
        for name in ("downscale", "stack"):
            check_whole(name, getattr(self, name))
        if not isinstance(self.map_shape, (tuple, list)) or len(self.map_shape) != 2:
            raise InputError("map_shape", value=self.map_shape, rule="must be (rows, columns)")
        for count in self.map_shape:
            check_whole("map_shape", count)
        if not isinstance(self.crop, str) or self.crop != "centre":
            sides = self.crop
            if not isinstance(sides, (tuple, list)) or len(sides) != 4 or not all(is_whole(n) and n >= 0 for n in sides):
                rule = "must be 'centre', or pixels cut off at left, top, right and bottom, each 0 or more"
                raise InputError("crop", value=sides, rule=rule)
        for name in ("difference", "normalise", "noise"):
            check_truth(name, getattr(self, name))
        chosen_optics(self.optics)
        markers_config(self.markers)
        check_mapping("scales", self.scales)
        for name in ("difference", "noise"):
            if getattr(self, name) and "rgb" not in self.modalities:
                raise InputError(name, value=True, rule="is of images: modalities must have 'rgb'")
        for name, scale in self.scales.items():
            if name not in SCALES:
                raise InputError("scales", value=name, rule="must be a modality that has a unit", choices=tuple(SCALES))
            values = scale if isinstance(scale, (tuple, list)) else (scale,)
            count = (1, 6) if name == "wrench" else (1,)
            if len(values) not in count or not all(is_number(v) and 0.0 < v < math.inf for v in values):
                raise InputError(f"scales[{name!r}]", value=scale, rule="must be positive and finite: one, or six of a wrench")

    def scale(self, modality: str) -> float | tuple[float, ...]:
        """Divisor of a modality."""
        return self.scales.get(modality, SCALES[modality]) if self.normalise else 1.0

    @property
    def needs_markers(self) -> bool:
        return "markers" in self.modalities or "marker_visible" in self.modalities

    @property
    def needs_frames(self) -> bool:
        """True if more than the wrench is observed, so that the pad's surface is needed."""
        return self.modalities != ("wrench",)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Outputs of a ``TactileSensor`` that are needed besides the surface, which is always there."""
        return tuple(name for name in ("rgb", "traction", "wrench") if name in self.modalities)


@dataclass(frozen=True)
class Layout:
    """Crop of an observed image from a rendered one; sizes are (width, height) [px]."""

    observed: tuple[int, int]
    rendered: tuple[int, int]
    crop_x: int
    """Pixels of the observed size that are removed at the left."""
    crop_y: int
    """Pixels of the observed size that are removed at the top."""
    downscale: int

    @property
    def crop(self) -> tuple[int, int, int, int] | None:
        """Observed piece of the rendered image, (left, top, width, height) [px]; None is all of it."""
        k, (width, height) = self.downscale, self.observed
        piece = k * self.crop_x, k * self.crop_y, k * width, k * height
        return None if piece[2:] == self.rendered else piece


def image_layout(sensor: SensorSpec, settings: ObservationSettings) -> Layout:
    """Sizes of rendered and observed image. Raises ``InputError`` if they are too large."""
    resolution = settings.resolution
    assert not isinstance(resolution, str)
    observed = sensor.camera.resolution if resolution is None else resolution
    width, height = observed
    if settings.crop == "centre":
        native = sensor.camera.resolution
        scale = max(width / native[0], height / native[1])
        whole = max(width, round(native[0] * scale)), max(height, round(native[1] * scale))
        crop_x, crop_y = (whole[0] - width) // 2, (whole[1] - height) // 2
    else:
        crop_x, crop_y, right, bottom = (int(n) for n in settings.crop)
        whole = width + crop_x + right, height + crop_y + bottom
    rendered = whole[0] * settings.downscale, whole[1] * settings.downscale
    if max(rendered) > LARGEST_SIDE:
        rule = f"with crop and downscale the rendered image is {rendered[0]}x{rendered[1]}; at most {LARGEST_SIDE} px a side"
        raise InputError("resolution", value=observed, rule=rule)
    return Layout(observed, rendered, crop_x, crop_y, settings.downscale)
