"""Ray tracers are built once a session: a build compiles kernels and Mitsuba scenes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from raytac.optics import RayTraced
from raytac.specs.sensor import SensorSpec
from tests.optics.scenes import built as make

Build = Callable[..., Any]


@pytest.fixture(scope="session")
def tracer() -> Build:
    """``tracer(spec, **options)``: a ray tracer on the CPU, the same object for the same arguments (hence: one grid for each)."""
    built: dict[Any, Any] = {}

    def build(spec: SensorSpec, *, pitch: float | None = None, **options: Any) -> Any:
        key = (spec, pitch, tuple(sorted(options.items())))
        if key not in built:
            built[key] = make(RayTraced, spec, **options)
        return built[key]

    return build
