"""Fits of the case's light that tests share: each takes about as long as all the rest of a small image."""

from __future__ import annotations

import functools
import sys
from dataclasses import replace
from typing import Any

from raytac.specs.sensor import SensorSpec

MEASURED = (
    "calibrate/",
    "optics/test_fast_against_reference.py",
    "optics/test_glow.py",
    "optics/test_layers.py",
    "regression/",
    "report/test_real.py",
)
"""Folders and files of ``tests`` that measure images: these fit with all paths, the others with ``FEW``."""
FEW = 1 << 15


def share(unseen: SensorSpec, *, few: bool) -> None:
    """Give ``CaseLight.fit``, once it is imported, a memory of the process: the same geometry, lights and seed, the same object.

    Camera and response, which the case's light does not depend on, are taken from ``unseen`` when sensors are compared. ``few``: fits of
    the test that begins now take ``FEW`` paths.
    """
    module: Any = sys.modules.get("raytac.optics.trace.interreflection")
    if module is None:
        return
    light = module.CaseLight
    if not hasattr(light.fit, "__wrapped__"):
        light.fit = staticmethod(_remembering(light.fit, unseen))
    shared: Any = light.fit
    shared.paths = FEW if few else module.SAMPLES


def _remembering(fit: Any, unseen: SensorSpec) -> Any:
    fits: dict[tuple[Any, ...], Any] = {}

    @functools.wraps(fit)
    def shared(scene: Any, lamps: Any, groups: list[int], seed: int = 0, samples: int | None = None) -> Any:
        paths: int = shared.paths if samples is None else samples  # type: ignore[attr-defined]
        sensor = replace(scene.sensor, name="", camera=unseen.camera, response=unseen.response)
        key = sensor, scene.grid.rest.tobytes(), tuple(groups), seed, paths, scene.mi.variant()
        if key not in fits:
            fits[key] = fit(scene, lamps, groups, seed, paths)
        return fits[key]

    return shared
