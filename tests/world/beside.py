"""A box that falls beside a pad's case, within the margin in which its contacts are foreseen, and does not touch it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from raytac.specs import BodySpec, RobotSpec, TaskScene

HALF, SPEED, GRAVITY = 0.01, 0.3, 9.81
POSES = {
    "sides that slide by, 0.2 mm apart": (0.0262, 0.0, 0.012, 1.0, 0.0, 0.0, 0.0),
    "faces that look at each other, none below the other": (0.0274, -0.0054, 0.0105, 0.9989, -0.0198, 0.0057, 0.0409),
    "the same, nearly level": (0.0271, 0.0193, 0.0129, 1.0, 0.0019, -0.0004, 0.002),
}
"""Place [m] and quaternion of the box; the case ends at x = 16 mm, y = 14 mm and z = −4 mm."""
OVER_THE_EDGE = 0.024, 0.0, 0.0075, 1.0, 0.0, 0.0, 0.0
"""As ``POSES``, 2 mm over the case."""


def scene(timestep: float) -> TaskScene:
    """A pad that looks up, and a box of 20 mm."""
    edge = 2.0 * HALF
    box = BodySpec(
        "box", "box", {"length": edge, "width": edge, "height": edge}, position=(0.05, 0.0, 0.02), mass=0.05, friction=0.5
    )
    return replace(TaskScene("beside", RobotSpec("fixed_sensor"), (box,)), timestep=timestep, control_timestep=0.01)


def free_fall(seconds: float) -> np.ndarray:
    """Velocity (6,) of the box after so long [m/s]."""
    return np.array([0.0, 0.0, -SPEED - GRAVITY * seconds, 0.0, 0.0, 0.0])
