"""Presses of the virtual calibration: balls all over the pad, with surround or bare.

A real calibration (Taxim's, some fifty presses of one ball) has steep slopes where the ball is and none elsewhere. Here the balls
differ in size and depth and follow a sequence that fills the space of place × size × depth evenly, so that every slope and direction
comes up all over the view. Most press with the gel around them yielding (``raytac.gel.pyramid``), as all presses of the rigid pad do;
the others are *bare* caps, which reach slopes that the surround would round off. Pins give the steep gel that no ball has around it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from raytac.gel.pyramid import ElasticSurround
from raytac.gel.surface import GelSurface, PadGrid, rest_height
from raytac.optics.camera import Pinhole
from raytac.optics.taxim.bake.settings import BakeSettings
from raytac.shapes.part import Part, primitive
from raytac.shapes.underside import object_height
from raytac.specs.sensor import GelpadSpec

_GAP = 1.5e-3
"""Least distance between the rims of two balls [m]; the widest Gaussian is 0.9 mm."""
_PIN_HALF_LENGTH = 2e-3
_TRIES = 24
"""Points of the sequence that an image may use up to place its balls."""


def even_sequence(dimensions: int, start: np.ndarray) -> Iterator[np.ndarray]:
    """Points (dimensions,) that fill the unit cube evenly at any length: xₙ = frac(start + n α).

    α_k = g^−k with g the positive root of g^(d+1) = g + 1 (M. Roberts, The unreasonable effectiveness of quasirandom sequences, 2018;
    for d = 1 the golden ratio).
    """
    g = 1.5
    for _ in range(64):
        g = (1 + g) ** (1 / (dimensions + 1))
    alpha = g ** -np.arange(1.0, dimensions + 1)
    n = 0
    while True:
        n += 1
        yield (start + n * alpha) % 1.0


def view_half(camera: Pinhole) -> np.ndarray:
    """Half the extent (x, y) [m] of the plane z = 0 in view, the smaller side if off centre."""
    return np.array([min(-nodes[0], nodes[-1]) for nodes in camera.pixel_centres_on_plane()])


def pressed(grid: PadGrid, parts: list[Part], surround: ElasticSurround | None) -> GelSurface:
    """Surface of one environment under placed parts; without ``surround`` the bare overlap."""
    under = object_height(parts, np.eye(4)[None], grid.x, grid.y, below=float(grid.rest.max()))
    if surround is not None:
        return surround.surface(under)
    height = np.minimum(under, grid.rest).astype(np.float32)
    return GelSurface(grid, height, under < grid.rest, np.full((1, 2), np.nan))


def ball_presses(
    gelpad: GelpadSpec, grid: PadGrid, camera: Pinhole, settings: BakeSettings, seed: int, *, bare: bool = False
) -> Iterator[GelSurface]:
    """Surfaces of one environment with up to ``settings.balls`` balls each.

    ``bare``: those without surround. Both kinds together are ``settings.images``. Radii are spread evenly in their logarithm, depths below the resting surface under the
    ball's centre evenly; a ball is never pressed beyond its equator, and its contact lies wholly in view.
    """
    points = even_sequence(4, np.random.default_rng([seed, 3] if bare else seed).uniform(size=4))
    caps = round(settings.images * settings.bare_share)
    surround = None if bare else ElasticSurround(grid, thickness=gelpad.thickness)
    for _ in range(caps if bare else settings.images - caps):
        yield pressed(grid, _crowd("sphere", points, gelpad, camera, settings), surround)


def punch_presses(gelpad: GelpadSpec, grid: PadGrid, camera: Pinhole, settings: BakeSettings, seed: int) -> Iterator[GelSurface]:
    """``settings.punches`` surfaces with up to ``settings.balls`` flat-ended pins each.

    Of all gel that no object touches, that at a pin is steepest. Places, radii and depths are spread as those of balls.
    """
    points = even_sequence(4, np.random.default_rng([seed, 2]).uniform(size=4))
    surround = ElasticSurround(grid, thickness=gelpad.thickness)
    for _ in range(settings.punches):
        yield pressed(grid, _crowd("cylinder", points, gelpad, camera, settings), surround)


def _crowd(kind: str, points: Iterator[np.ndarray], gelpad: GelpadSpec, camera: Pinhole, settings: BakeSettings) -> list[Part]:
    """Balls or pins of one image, apart from each other."""
    half, is_ball = view_half(camera), kind == "sphere"
    small, large = settings.radius if is_ball else settings.pin_radius
    shallow, deep = settings.depth_range(gelpad.thickness)
    contacts: list[tuple[np.ndarray, float]] = []
    parts: list[Part] = []
    for u in (next(points) for _ in range(_TRIES)):
        radius = small * (large / small) ** u[2]
        depth = shallow + (deep - shallow) * u[3]
        depth = min(depth, radius) if is_ball else depth
        reach = np.sqrt(radius**2 - (radius - depth) ** 2) if is_ball else radius
        centre = (2 * u[:2] - 1) * np.maximum(half - reach, 0.0)
        if any(np.hypot(*(centre - other)) < reach + size + _GAP for other, size in contacts):
            continue
        contacts.append((centre, reach))
        parts.append(_placed(kind, (radius,) if is_ball else (radius, _PIN_HALF_LENGTH), gelpad, centre, depth))
        if len(parts) == settings.balls:
            break
    return parts


def _placed(kind: str, size: tuple[float, ...], gelpad: GelpadSpec, centre: np.ndarray, depth: float) -> Part:
    """A primitive of half height ``size[-1]``, its end ``depth`` [m] below rest at ``centre``."""
    place = np.eye(4)
    place[:2, 3] = centre
    place[2, 3] = float(rest_height(gelpad, centre[0], centre[1])) + size[-1] - depth
    return primitive(kind, size, place)


def pin_presses(gelpad: GelpadSpec, grid: PadGrid, camera: Pinhole, settings: BakeSettings, seed: int) -> Iterator[GelSurface]:
    """``settings.pins`` surfaces, each with one flat-ended pin; depths rise in equal steps.

    Radii (evenly in their logarithm) and places follow the even sequence; the pin lies wholly in view.
    """
    points = even_sequence(3, np.random.default_rng([seed, 1]).uniform(size=3))
    surround = ElasticSurround(grid, thickness=gelpad.thickness)
    half = view_half(camera)
    (thin, thick), (_, deep) = settings.pin_radius, settings.depth_range(gelpad.thickness)
    for k in range(settings.pins):
        u = next(points)
        radius, depth = thin * (thick / thin) ** u[2], deep * (k + 1) / settings.pins
        centre = (2 * u[:2] - 1) * np.maximum(half - radius, 0.0)
        yield pressed(grid, [_placed("cylinder", (radius, _PIN_HALF_LENGTH), gelpad, centre, depth)], surround)
