"""Balls that a pad's physics presses until the edge of its imprint is as wide as a circle.

The circle of a photograph is where colour changes most (``circles``). Colour follows the coat's normal, so on a pad it is where the normal
changes most, ``edge_radius``: some per cent outside the contact, ``GelSurface.contact``, since gel leaves a ball smoothly. The depth of
a press is the one at which that is the circle's radius: it is solved for, and no image is fitted. The overlap of ball and resting gel is
as wide as the circle at a smaller depth, ``overlap_depth``, since the gel around a contact is drawn down.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from raytac.calibrate.imprint import rims_on_pad
from raytac.gel.interpolate import sampled
from raytac.gel.surface import GelSurface
from raytac.physics.base import PhysicsConfig
from raytac.specs.press import ObjectSpec, PressScene, StageSpec
from raytac.specs.sensor import SensorSpec

EDGE = 0.05
"""Half the width of the step that ``edge_radius`` looks for, over the radius.

Circles of ``find_circles`` with it are labels' own in the mean, those with its 8 % are 2 % wider (docs/concepts/calibration.md)."""
_ANGLES = 96
_RADII = 400
_TOLERANCE = 0.002
"""Tolerance of the edge's radius, over the circle's."""
_MOST_STAGES = 12
_DEEPEST = 0.95
"""Share of the gel's thickness, or of the ball's radius, that a press may reach."""


@dataclass(frozen=True)
class PressedBall:
    """One ball pressed by the physics of a pad."""

    overlap_depth: float
    """Depth at which ball and resting flat gel overlap in a disc of the circle's radius [m]."""
    at_overlap: GelSurface
    """Surface at that depth."""
    depth: float
    """Depth at which the imprint's edge has the circle's radius [m]; NaN if none has."""
    surface: GelSurface | None
    """Surface at that depth; None if there is none."""


def overlap_depth(contact_radius: float, ball_radius: float) -> float:
    """Depth R − √(R² − a²) at which a ball cuts a plane in a disc of radius a.

    It has the unit of both radii.
    """
    return ball_radius - float(np.sqrt(ball_radius**2 - contact_radius**2))


def contact_radius(surface: GelSurface) -> float:
    """Radius of the disc as large as the contact of the first environment [m]."""
    return float(np.sqrt(surface.contact[0].sum() * np.prod(surface.grid.pitch) / np.pi))


def edge_radius(surface: GelSurface, at: tuple[float, float], widest: float) -> float:
    """Radius [m], up to ``widest``, of the circle about ``at`` [m] where normals change most.

    As circles are found in images: the mean over angles of the step of the normal from ``EDGE`` inside to ``EDGE`` outside is greatest. Of
    the first environment, less the pad's dome. 0 without a step.
    """
    grid = surface.grid
    slopes = np.gradient(surface.height[0].astype(float) - grid.rest, grid.y, grid.x)
    normal = np.array(slopes) / np.sqrt(1.0 + slopes[0] ** 2 + slopes[1] ** 2)
    angle = 2.0 * np.pi * np.arange(_ANGLES) / _ANGLES
    radii = np.linspace(0.0, widest, _RADII + 1)[1:]

    def along(factor: float) -> np.ndarray:
        r = factor * radii[:, None]
        return sampled(normal, grid.x, grid.y, at[0] + r * np.cos(angle), at[1] + r * np.sin(angle))

    step = np.sqrt(((along(1.0 - EDGE) - along(1.0 + EDGE)) ** 2).sum(axis=0)).mean(axis=1)
    k = int(step.argmax())
    if step[k] <= 0.0 or k in (0, _RADII - 1):
        return float(radii[k]) if step[k] > 0.0 else 0.0
    below, peak, above = step[k - 1 : k + 2]
    return float(radii[k] + 0.5 * (below - above) / (below - 2.0 * peak + above) * (radii[1] - radii[0]))


def pressed_balls(
    sensor: SensorSpec,
    circles: np.ndarray,
    ball_radius: np.ndarray,
    physics: PhysicsConfig,
    *,
    pitch: float,
    device: str = "auto",
) -> Iterator[PressedBall]:
    """The pad under every ball, as ``physics`` has it.

    ``circles`` (N, 3) [px of the sensor's resolution], ``ball_radius`` (N,) [m]; ``pitch`` of the surfaces' grid [m]; ``device``:
    that of a solver. Each press goes on from stage to stage, the depths of which are those of the secant through the last two.

    Raises ``InputError``: a circle as wide as its ball; else as ``PhysicsConfig.build``.
    """
    for (x, y, a), radius in zip(rims_on_pad(sensor, circles, ball_radius), ball_radius, strict=True):
        yield _pressed(sensor, (float(x), float(y)), float(a), float(radius), physics, pitch, device)


def _pressed(
    sensor: SensorSpec, at: tuple[float, float], a: float, radius: float, physics: PhysicsConfig, pitch: float, device: str
) -> PressedBall:
    start = overlap_depth(a, radius)
    thinnest = sensor.gelpad.thickness - float(sensor.gelpad.sag(*at))
    deepest = max(_DEEPEST * min(thinnest, radius), start)
    ball = ObjectSpec("sphere", {"radius": radius}, (*at, 0.0), (1.0, 0.0, 0.0, 0.0), 0.1)
    scene = PressScene("ball", ball, (StageSpec("indent", depth=deepest),))
    pad = physics.build(sensor, scene, pitch=pitch, num_envs=1, device=device)

    def share(surface: GelSurface) -> float:
        return (edge_radius(surface, at, 1.5 * a) / a) ** 2

    # The edge grows about as the square root of the depth: that is the first step's slope.
    (reading,) = pad.follow(StageSpec("indent", depth=start))
    first, depths, shares = reading.surface, [0.0, start], [0.0, share(reading.surface)]
    for _ in range(_MOST_STAGES):
        if reading.failed.any() or not shares[-1] > 0.0:
            break
        if abs(shares[-1] - 1.0) <= 2.0 * _TOLERANCE:
            return PressedBall(start, first, depths[-1], reading.surface)
        growth = (shares[-1] - shares[-2]) / (depths[-1] - depths[-2])
        if depths[-1] >= deepest or not growth > 0.0:
            break
        depth = float(np.clip(depths[-1] + (1.0 - shares[-1]) / growth, 0.5 * depths[-1], deepest))
        (reading,) = pad.follow(StageSpec("indent", depth=depth))
        depths.append(depth)
        shares.append(share(reading.surface))
    return PressedBall(start, first, float("nan"), None)
