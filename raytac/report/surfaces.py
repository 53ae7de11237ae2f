"""The gel surfaces that reports render: presses at their peak, the same for every optical mode."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from raytac.gel.surface import GelSurface
from raytac.sensor import TactileSensor
from raytac.specs.sensor import SensorSpec

__all__ = ["press_peaks"]


def press_peaks(
    sensor: str | Path | SensorSpec, scenes: Sequence[str | Path], size: tuple[int, int], seed: int = 0
) -> tuple[SensorSpec, dict[str, GelSurface]]:
    """The sensor's specification, and the surface (B = 1) at the peak of each press scene by its name.

    The grid's pitch is that of a pixel of ``size`` (width, height) on the pad, at most 0.1 mm.

    Raises:
        SpecError: an unknown sensor or scene, or a file that breaks a rule.
    """
    pressed = TactileSensor(sensor, outputs=("height",), resolution=size, device="cpu", seed=seed)
    return pressed.spec, {Path(scene).stem: pressed.press(scene).surface for scene in scenes}
