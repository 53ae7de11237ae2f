"""Ray tracers are built once: a build compiles kernels and Mitsuba scenes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from raytac.optics import RayTraced
from raytac.optics.trace.tracer import Tracer
from raytac.specs.sensor import SensorSpec
from tests.optics.scenes import built as make

Build = Callable[..., Any]
ASKS_FOR_EXPOSURE = ("test_colour_matrix.py", "test_exposure.py")
"""Files whose tests expect the warning of an image at rest that is largely white."""


@pytest.fixture(autouse=True)
def _unchecked_exposure(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tracers that render nothing to warn of their exposure: a quarter of the time of these tests, whose sensors are too bright."""
    if request.path.name not in ASKS_FOR_EXPOSURE:
        monkeypatch.setattr(Tracer, "_warn_if_saturated", lambda self, grid: None)


@pytest.fixture(scope="session")
def without_scene() -> dict[Any, Any]:
    """Tracers of the session by their arguments: those of ``fast``, which hold no Mitsuba scene."""
    return {}


@pytest.fixture(scope="module")
def tracer(without_scene: dict[Any, Any]) -> Build:
    """``tracer(spec, **options)``: a ray tracer on the CPU, the same object for the same arguments (hence: one grid for each).

    Tracers with a Mitsuba scene are those of one file. Dr.Jit's virtual calls go over the objects of all scenes alive, so every scene that
    stays makes later ones slower, and compiles their kernels again.
    """
    with_scene: dict[Any, Any] = {}

    def build(spec: SensorSpec, *, pitch: float | None = None, **options: Any) -> Any:
        key = (spec, pitch, tuple(sorted(options.items())))
        built = without_scene if options.get("integrator", "fast") == "fast" else with_scene
        if key not in built:
            built[key] = make(RayTraced, spec, **options)
        return built[key]

    return build
