"""Rendering of a piece of the image alone, with any optical mode."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from raytac.errors import InputError
from raytac.frame import IMAGES
from raytac.gel.surface import GelSurface
from raytac.optics.base import OpticalMode, OpticsConfig, OpticsImages, start
from raytac.specs.sensor import SensorSpec


@dataclass(frozen=True)
class Cropped(OpticsConfig[OpticalMode]):
    """Another mode that renders a piece of its image, equal to that of the whole image.

    Modes that need all of the image, as for shadows of a table, and a user's modes render it and cut.
    """

    config: OpticsConfig[OpticalMode]
    """Of the mode."""
    crop: tuple[int, int, int, int]
    """Left, top, width and height [px] at the mode's resolution."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "outputs", self.config.outputs)

    @property
    def sampled(self) -> bool:
        return self.config.sampled

    @property
    def unbiased(self) -> bool:
        return self.config.unbiased

    @property
    def label(self) -> str:
        return self.config.label

    def check(self, spec: SensorSpec) -> None:
        self.config.check(spec)

    def bake(self, spec: SensorSpec, device: str) -> None:
        self.config.bake(spec, device)

    def build(self, spec: SensorSpec, *, resolution: tuple[int, int] | None = None, **options: Any) -> OpticalMode:
        """The mode. Raises as ``OpticsConfig.build``, and ``InputError`` for a crop too large."""
        whole = spec.camera.resolution if resolution is None else resolution
        left, top, width, height = self.crop
        inside = min(left, top) >= 0 and min(width, height) >= 1 and left + width <= whole[0] and top + height <= whole[1]
        if not inside:
            raise InputError(
                "crop", value=self.crop, rule=f"(left, top, width, height) must lie in the image of {whole[0]}x{whole[1]}"
            )
        mode = self.config.build(spec, resolution=resolution, **options)
        crop = getattr(mode, "crop", None)
        return mode if callable(crop) and crop(self.crop) is True else CutMode(mode, self.crop)


class CutMode:
    """A mode whose images are cut after they are rendered; all else is the mode's own."""

    label: str
    device: str

    def __init__(self, mode: OpticalMode, crop: tuple[int, int, int, int]) -> None:
        self._mode, self._crop = mode, crop
        self.label, self.device = mode.label, mode.device

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "_mode":
            raise AttributeError(name)
        return getattr(self._mode, name)

    def render(self, surface: GelSurface) -> OpticsImages:
        """Render every environment of ``surface`` and cut."""
        return self.start(surface)()

    def start(self, surface: GelSurface) -> Callable[[], OpticsImages]:
        """Begin ``render``, if the mode can."""
        images = start(self._mode, surface)
        return lambda: self._pieces(images())

    def _pieces(self, images: OpticsImages) -> OpticsImages:
        return OpticsImages(**{name: self._cut(getattr(images, name, None)) for name in IMAGES})

    def _cut(self, image: Any) -> Any:
        """Piece of images (B, H, W, …), or of each of a dictionary; what is not an image stays."""
        if isinstance(image, dict):
            return {name: self._cut(one) for name, one in image.items()}
        if not isinstance(image, np.ndarray) or image.ndim < 3:
            return image
        left, top, width, height = self._crop
        return np.ascontiguousarray(image[:, top : top + height, left : left + width])
