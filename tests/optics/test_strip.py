"""Extended LEDs: closed forms of lines and rectangles, penumbras, the limit of many points, shadows without petals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytac.gel.surface import PadGrid
from raytac.optics.trace.fast_tracer import total
from raytac.optics.trace.quadrature import quadrature
from raytac.specs.sensor import CameraSpec, LedSpec, LightsSpec, SensorSpec
from tests.optics.conftest import Build
from tests.optics.images import errors
from tests.optics.scenes import SMALL, at_rest, grid_of, led, sensor, surface

DIRECT = {"bounce": False}
PITCH = 0.07e-3
SEEN = (96, 72)
"""Pixels of the images that show shadows."""
ALBEDO = 0.5


def pixels(spec: SensorSpec, size: tuple[int, int]) -> np.ndarray:
    """Places (H, W, 3) [m] of pixel centres on the plane z = 0."""
    camera = spec.camera
    scale = [native / pixel for native, pixel in zip(camera.resolution, size, strict=True)]
    x, y = (
        camera.position[k] + ((np.arange(size[k]) + 0.5) * scale[k] - camera.principal_point[k]) * camera.pixel_pitch[k]
        for k in (0, 1)
    )
    return np.stack([*np.meshgrid(x, y), np.zeros((size[1], size[0]))], axis=-1)


def line_irradiance(lamp: LedSpec, p: np.ndarray) -> np.ndarray:
    """E of a Lambertian line of unit power at points ``p`` of the plane z = 0, in closed form.

    With x along the line from the foot of the perpendicular of length D, ∫ dx / (D² + x²)² = x / (2 D² (D² + x²)) + atan(x / D) / (2 D³).
    """
    along, to = np.array(lamp.edges[0]), p - np.array(lamp.position)
    foot = to @ along
    distance = np.linalg.norm(to - foot[..., None] * along, axis=-1)

    def integral(x: np.ndarray) -> np.ndarray:
        return x / (2 * distance**2 * (distance**2 + x**2)) + np.arctan(x / distance) / (2 * distance**3)

    half = lamp.size[0] / 2
    emitted = np.maximum(to @ np.array(lamp.axis), 0)
    return emitted * to[..., 2] / lamp.size[0] * (integral(half - foot) - integral(-half - foot))


def rectangle_irradiance(lamp: LedSpec, p: np.ndarray) -> np.ndarray:
    """E of a Lambertian rectangle of unit power at ``p`` by Lambert's formula for polygons.

    E = L / 2 Σ Γ_i n · (r_i × r_{i+1}) / |r_i × r_{i+1}|, Γ_i the angle between corners (Lambert, Photometria, 1760).
    """
    u, v = (0.5 * length * np.array(edge) for length, edge in zip(lamp.size, lamp.edges, strict=True))
    corners = [np.array(lamp.position) + a * u + b * v - p for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    e = np.zeros(p.shape[:-1])
    for one, two in zip(corners, corners[1:] + corners[:1], strict=True):
        across = np.cross(one, two)
        length = np.linalg.norm(across, axis=-1)
        e += np.arctan2(length, (one * two).sum(-1)) * across[..., 2] / length
    return np.abs(e) / 2 / (lamp.size[0] * lamp.size[1])


STRIP = led("strip", (-12.5e-3, 1e-3, -5.5e-3), (0.0, 1e-3, -3e-3), size=(18e-3, SMALL[1]))
PANEL = led("panel", (-12.5e-3, 0.0, -8e-3), (0.0, 0.0, -6e-3), size=(14e-3, 4e-3))


@pytest.mark.parametrize("options", [DIRECT, {"integrator": "reference", "max_depth": 1, "spp": 256}], ids=["fast", "reference"])
@pytest.mark.parametrize(
    ("lamp", "formula"), [(STRIP, line_irradiance), (PANEL, rectangle_irradiance)], ids=["line", "rectangle"]
)
def test_a_strip_over_a_flat_pad_is_its_closed_form(tracer: Build, options: dict, lamp: LedSpec, formula) -> None:
    spec = sensor([lamp])
    mode = tracer(spec, **options)
    image = total(mode.render_layers(at_rest(grid_of(spec))))[0][..., 0]
    expected = ALBEDO / np.pi * formula(lamp, pixels(spec, mode.camera.resolution))
    mean, largest = errors(image, expected)
    exact = options is DIRECT
    assert mean < (2e-3 if exact else 0.03) and largest < (0.01 if exact else 0.5), (mean, largest)
    assert image.mean() == pytest.approx(expected.mean(), rel=1e-3)
    # A point in its middle would not do.
    point = ALBEDO / np.pi * formula(replace(lamp, size=SMALL), pixels(spec, mode.camera.resolution))
    assert errors(point, expected)[0] > 0.1


EDGE, BEHIND, HEIGHT = -2.0e-3, 2.0e-3, 0.8e-3


def wall_sensor(length: float) -> SensorSpec:
    """A low strip along y on the left, seen by a camera over the line x = EDGE + BEHIND."""
    size, view = (8, 320), 9.6e-3
    pitch = view / size[1]
    camera = CameraSpec(size, (pitch, pitch), (EDGE + BEHIND, 0.0, -28e-3), (size[0] / 2, size[1] / 2))
    return sensor([led("one", (-13e-3, 0.0, -2.5e-3), (0.0, 0.0, -2.5e-3), size=(length, SMALL[1]))], camera=camera)


@pytest.mark.parametrize("options", [DIRECT, {"integrator": "reference", "max_depth": 1, "spp": 128}], ids=["fast", "reference"])
@pytest.mark.parametrize("length", [4e-3, 8e-3])
def test_the_penumbra_across_a_strip_has_its_geometric_width(tracer: Build, options: dict, length: float) -> None:
    """Behind the end of a wall the strip comes out bit by bit: over its length times d_behind / d_before."""
    spec = wall_sensor(length)
    grid = grid_of(spec, PITCH)
    edge = float(grid.x[np.abs(grid.x - EDGE).argmin()])
    wall = (np.abs(grid.x[None, :] - edge) < 1.5 * PITCH) & (grid.y[:, None] <= 1e-9)
    mode = tracer(spec, pitch=PITCH, resolution=spec.camera.resolution, **options)
    lit, rest = (
        total(mode.render_layers(s))[0].mean(axis=(1, 2)).astype(float) for s in (surface(grid, -HEIGHT * wall), at_rest(grid))
    )
    _, y = mode.camera.pixel_centres_on_plane()
    share, behind = lit / rest, EDGE + BEHIND - edge

    def crossing(level: float) -> float:
        above = int(np.argmax(share > level))
        assert above > 0, share[:8]
        return float(np.interp(level, share[above - 1 : above + 1], y[above - 1 : above + 1]))

    expected = length * behind / (edge + 13e-3)
    assert crossing(0.9) - crossing(0.1) == pytest.approx(0.8 * expected, rel=0.1)
    assert crossing(0.5) == pytest.approx(0, abs=1.5 * PITCH)
    assert share[y < -expected / 2 - 3 * PITCH].max() < 0.02 and share[y > expected / 2 + 3 * PITCH].min() > 0.98


def pin(grid: PadGrid, radius: float = 0.5e-3, flank: float = 0.3e-3) -> np.ndarray:
    """Height of a pin of ``HEIGHT`` at the middle, with a flank as wide as ``flank`` [m]."""
    r = np.hypot(grid.x[None, :], grid.y[:, None])
    return -HEIGHT * np.clip((radius + flank - r) / flank, 0, 1)


def ring(each: int, length: float) -> tuple[LedSpec, ...]:
    """``each`` LEDs on each of four sides of a square about the pad, side by side and ``length`` long."""
    leds = []
    for k in range(4):
        turn = np.array([[np.cos(k * np.pi / 2), -np.sin(k * np.pi / 2)], [np.sin(k * np.pi / 2), np.cos(k * np.pi / 2)]])
        for m in range(each):
            x, y = turn @ [-10e-3, 20e-3 * ((m + 0.5) / each - 0.5)]
            out = turn @ [1.0, 0.0]
            aim = (x + out[0], y + out[1], -2.5e-3)
            leds.append(
                led(f"l{k}{m}", (float(x), float(y), -2.5e-3), aim, size=(length, SMALL[1]), power=(1 / each, 1 / each, 1 / each))
            )
    return tuple(replace(lamp, layer="all") for lamp in leds)


def low_sensor(leds: tuple[LedSpec, ...]) -> SensorSpec:
    pitch = 6e-3 / SEEN[0]
    camera = CameraSpec(SEEN, (pitch, pitch), (0.0, 0.0, -28e-3), (SEEN[0] / 2, SEEN[1] / 2))
    return sensor(leds, camera=camera)


def shadow_image(tracer: Build, leds: tuple[LedSpec, ...], **options) -> np.ndarray:
    """Light (H, W) about the pin over that at rest."""
    spec = low_sensor(leds)
    grid = grid_of(spec, PITCH)
    mode = tracer(spec, pitch=PITCH, resolution=SEEN, **options)
    lit, rest = (total(mode.render_layers(s))[0][..., 0].astype(float) for s in (surface(grid, pin(grid)), at_rest(grid)))
    return lit / rest


def petals(share: np.ndarray, radius: float = 1.5e-3) -> float:
    """RMS of the harmonics above the twelfth on a circle about the pin; a square of strips has low ones."""
    turn = 2 * np.pi * np.arange(256) / 256
    pitch = 6e-3 / SEEN[0]
    column, row = (SEEN[k] / 2 + radius / pitch * f(turn) - 0.5 for k, f in ((0, np.cos), (1, np.sin)))
    i, j = np.floor(row).astype(int), np.floor(column).astype(int)
    a, b = row - i, column - j
    ring = (1 - a) * ((1 - b) * share[i, j] + b * share[i, j + 1]) + a * ((1 - b) * share[i + 1, j] + b * share[i + 1, j + 1])
    return float(np.sqrt(2) * np.linalg.norm(np.fft.rfft(ring)[13:64]) / len(turn))


def beside(share: np.ndarray) -> np.ndarray:
    """Pixels of ``share`` off the pin and its flank, where light changes from one node to the next."""
    x, y = (6e-3 / SEEN[0] * (np.arange(n) + 0.5 - n / 2) for n in SEEN)
    return share[np.hypot(x[None, :], y[:, None]) > 1.0e-3]


def test_a_pin_among_strips_has_a_shadow_without_petals(tracer: Build) -> None:
    soft, hard = (petals(shadow_image(tracer, leds, **DIRECT)) for leds in (ring(1, 20e-3), ring(6, SMALL[0])))
    assert soft < 2.8e-3 < 7e-3 < hard, (soft, hard)


def test_a_strip_is_the_limit_of_many_points(tracer: Build) -> None:
    strip = shadow_image(tracer, ring(1, 20e-3)[:1], **DIRECT)
    assert strip.min() < 0.5, "no shadow"

    def points(count: int) -> np.ndarray:
        """Mean over the images of ``count`` points, eight to an image."""
        leds = [replace(lamp, layer="all") for lamp in ring(count, SMALL[0])[:count]]
        spec, shares, weights = low_sensor(()), np.zeros(()), np.zeros(())
        grid = grid_of(spec, PITCH)
        for k in range(0, count, 8):
            mode = tracer(replace(spec, lights=LightsSpec(tuple(leds[k : k + 8]))), pitch=PITCH, resolution=SEEN, **DIRECT)
            shares = shares + total(mode.render_layers(surface(grid, pin(grid))))[0][..., 0].astype(float)
            weights = weights + total(mode.render_layers(at_rest(grid)))[0][..., 0].astype(float)
        return shares / weights

    few, many = (errors(beside(strip), beside(points(count)))[0] for count in (8, 32))
    assert many < 0.01 and many < 0.6 * few, (few, many)


def test_fast_and_reference_agree_on_shadows_of_strips(tracer: Build) -> None:
    leds = ring(1, 20e-3)[:2]
    fast, sampled = (
        shadow_image(tracer, leds, **options) for options in (DIRECT, {"integrator": "reference", "max_depth": 1, "spp": 256})
    )
    mean, largest = errors(beside(fast), beside(sampled))
    assert mean < 0.02 and largest < 0.3, (mean, largest)
    assert beside(fast).mean() == pytest.approx(beside(sampled).mean(), rel=2e-3)


def test_each_edge_has_the_points_that_it_needs() -> None:
    """A strip of 22 mm three along; a tall LED whose height the camera sees foreshortened has its points over the height."""
    assert quadrature(led("strip", (0.0, -12e-3, -6e-3), (0.0, 0.0, -4e-3), size=(22e-3, 1e-3))).by_edge == (3, 1)
    for aim, upright in (((0.0, 0.0, -6e-3), False), ((0.0, -9e-3, 0.0), True)):
        points = quadrature(led("tall", (0.0, -12e-3, -6e-3), aim, size=(2e-3, 6e-3)))
        assert points.by_edge == (1, 2) and points.upright is upright
        assert (points.along, points.across) == ((2, 1) if upright else (1, 2))
