"""Balls that a pad's physics presses until its contact is as wide as a circle.

The circle of a photograph is the rim of the contact. So the depth of a press is the one at which the pad's own contact,
``GelSurface.contact``, has the circle's radius: it is solved for, and no image is fitted. The overlap of ball and resting gel is
as wide as the circle at a smaller depth, ``overlap_depth``, since the gel around a contact is drawn down.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from raytac.calibrate.imprint import rims_on_pad
from raytac.gel.surface import GelSurface
from raytac.physics.base import PhysicsConfig
from raytac.specs.press import ObjectSpec, PressScene, StageSpec
from raytac.specs.sensor import SensorSpec

_TOLERANCE = 0.004
"""Tolerance of the contact's radius, over the circle's: twice the rounding to nodes."""
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
    """Depth at which the contact has the circle's radius [m]; NaN if none has."""
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
    # Contact grows about as the square root of the depth: that is the first step's slope.
    (reading,) = pad.follow(StageSpec("indent", depth=start))
    first, depths, squares = reading.surface, [0.0, start], [0.0, (contact_radius(reading.surface) / a) ** 2]
    for _ in range(_MOST_STAGES):
        if reading.failed.any() or not squares[-1] > 0.0:
            break
        if abs(squares[-1] - 1.0) <= 2.0 * _TOLERANCE:
            return PressedBall(start, first, depths[-1], reading.surface)
        growth = (squares[-1] - squares[-2]) / (depths[-1] - depths[-2])
        if depths[-1] >= deepest or not growth > 0.0:
            break
        depth = float(np.clip(depths[-1] + (1.0 - squares[-1]) / growth, 0.5 * depths[-1], deepest))
        (reading,) = pad.follow(StageSpec("indent", depth=depth))
        depths.append(depth)
        squares.append((contact_radius(reading.surface) / a) ** 2)
    return PressedBall(start, first, float("nan"), None)
