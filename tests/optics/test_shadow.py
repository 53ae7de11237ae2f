"""The shadow of a plateau: where the plane through the LED and the edge meets the pad, with a penumbra as wide as the LED makes it."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.optics.trace.tracer import Tracer, total
from raytac.specs.sensor import CameraSpec, SensorSpec
from tests.optics.conftest import Build
from tests.optics.scenes import SMALL, at_rest, grid_of, led, plateau, sensor, surface

PITCH = 0.1e-3
EDGE = -2.0e-3
STRIP = (320, 8)
VIEW = 9.6e-3
"""Width of the strip across the edge that the camera sees [m]."""
FAST = {"bounce": False}
FINE = {"bounce": False, "led_points": 4}
REFERENCE = {"integrator": "reference", "max_depth": 1, "spp": 64}
MODES = pytest.mark.parametrize("options", [FAST, REFERENCE], ids=["fast", "reference"])


def strip_sensor(position: tuple[float, float, float] = (-13e-3, 0.0, -6e-3), size: tuple[float, float] = SMALL) -> SensorSpec:
    camera = CameraSpec(STRIP, (VIEW / STRIP[0], VIEW / STRIP[0]), (0.0, 0.0, -28e-3), (STRIP[0] / 2, STRIP[1] / 2))
    return sensor([led("one", position, size=size)], camera=camera)


def edge_node(spec: SensorSpec) -> float:
    x = grid_of(spec, PITCH).x
    return float(x[np.abs(x - EDGE).argmin()])


def tip(spec: SensorSpec, height: float, across: float = 0.0) -> float:
    """x [m] where the line from the LED over the plateau's edge meets z = 0; ``across`` in [−1, 1] picks the LED's point."""
    lamp = spec.lights.leds[0]
    source = np.asarray(lamp.position) + 0.5 * across * lamp.size[1] * np.array(lamp.edges[1])
    return edge_node(spec) + height * (edge_node(spec) - source[0]) / (-source[2] - height)


def share(mode: Tracer, spec: SensorSpec, height: float) -> tuple[np.ndarray, np.ndarray]:
    """x [m] of the pixels right of the plateau and how much of the light at rest reaches each."""
    grid = grid_of(spec, PITCH)
    lit, rest = (
        total(mode.render_layers(s))[0].mean(axis=(0, 2)).astype(float)
        for s in (surface(grid, plateau(grid, height, edge_node(spec))), at_rest(grid))
    )
    x, _ = mode.camera.pixel_centres_on_plane()
    beside = x > edge_node(spec) + 2.5 * PITCH  # nearer, normals are still bent by the wall
    return x[beside], lit[beside] / rest[beside]


def crossing(x: np.ndarray, values: np.ndarray, level: float) -> float:
    """First x where ``values`` rise through ``level``."""
    above = int(np.argmax(values > level))
    assert above > 0, f"no shadow: {values[:8]} from {x[0]}"
    return float(np.interp(level, values[above - 1 : above + 1], x[above - 1 : above + 1]))


@MODES
@pytest.mark.parametrize("low", [False, True], ids=["high_led", "low_led"])
@pytest.mark.parametrize("height", [0.2e-3, 0.4e-3, 0.8e-3])
def test_shadow_ends_where_geometry_says(tracer: Build, options: dict, low: bool, height: float) -> None:
    # The low LED casts the highest plateau's shadow over more than 5 mm.
    spec = strip_sensor((-13e-3, 0.0, -2.5e-3) if low else (-13e-3, 0.0, -6e-3))
    x, lit = share(tracer(spec, pitch=PITCH, resolution=STRIP, **options), spec, height)
    end, expected = crossing(x, lit, 0.5), tip(spec, height)
    # The mesh has its edge at the node; the walk on the height field finds it to within a step of one cell.
    pixel = VIEW / STRIP[0]
    limit = pixel if options is REFERENCE else PITCH * (1 + (expected - edge_node(spec)) / (13e-3 + edge_node(spec))) + pixel
    assert abs(end - expected) < limit, f"ends at {1e3 * end:.3f} mm instead of {1e3 * expected:.3f} mm"
    assert lit[x < expected - 2 * PITCH].max(initial=0) < 0.02, "light inside the shadow"
    assert lit[x > expected + 2 * PITCH].min() > 0.98, "shadow beyond its end"


@MODES
def test_there_is_no_shadow_on_the_side_of_the_light(tracer: Build, options: dict) -> None:
    spec = strip_sensor((13e-3, 0.0, -6e-3))
    _, lit = share(tracer(spec, pitch=PITCH, resolution=STRIP, **options), spec, 0.8e-3)
    assert lit.min() > 0.98


@pytest.mark.parametrize("size", [1e-3, 2e-3])
@pytest.mark.parametrize("options", [FAST, FINE, {**REFERENCE, "spp": 128}], ids=["fast", "fine", "reference"])
def test_the_penumbra_is_as_wide_as_the_led_makes_it(tracer: Build, options: dict, size: float) -> None:
    height = 0.8e-3
    spec = strip_sensor(size=(SMALL[0], size))
    x, lit = share(tracer(spec, pitch=PITCH, resolution=STRIP, **options), spec, height)
    width = crossing(x, lit, 0.9) - crossing(x, lit, 0.1)
    expected = 0.8 * abs(tip(spec, height, 1.0) - tip(spec, height, -1.0))
    assert width == pytest.approx(expected, rel=0.1), f"{1e3 * width:.3f} mm instead of {1e3 * expected:.3f} mm"
