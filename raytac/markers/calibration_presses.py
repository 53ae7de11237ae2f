"""Presses of the soft pad that marker models are fitted to and tested on."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from raytac.errors import RaytacError
from raytac.gel.coat_mesh import DeformedCoat
from raytac.gel.surface import GelSurface
from raytac.specs.press import ObjectSpec, PressScene, StageSpec
from raytac.specs.sensor import SensorSpec

LOADS = ("normal", "shear", "twist", "combined")
"""Kinds of load that errors are given for."""
_PITCH = 0.1e-3
"""Spacing of the pad's grid [m], as that of a sensor at its own resolution."""
_STEPS = 4
"""States a stage; of a press with shear and twist, steps of each, in turn."""


@dataclass(frozen=True)
class Press:
    """Path of an object: pressed, then sheared or twisted, or a step of each in turn."""

    name: str
    kind: str
    params: dict[str, float | int | str]
    place: tuple[float, float]
    """Position of the object on the pad [m]."""
    depth: float
    """Depth of the indentation [m]."""
    shear: tuple[float, float] = (0.0, 0.0)
    """Shear after the indentation [m]."""
    twist: float = 0.0
    """Twist after the indentation [rad]."""
    turned: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Quaternion (w, x, y, z) that rotates the object before the press."""

    @property
    def is_combined(self) -> bool:
        return any(self.shear) and self.twist != 0.0

    def scene(self) -> PressScene:
        target = ObjectSpec(self.kind, self.params, (*self.place, 0.0), self.turned, 0.1)
        stages = [StageSpec("indent", depth=self.depth)]
        steps = _STEPS if self.is_combined else 1
        for k in range(1, steps + 1):
            if any(self.shear):
                stages.append(StageSpec("shear", shear=(k / steps * self.shear[0], k / steps * self.shear[1])))
            if self.twist:
                stages.append(StageSpec("twist", twist=k / steps * self.twist))
        return PressScene(self.name, target, tuple(stages))

    def __str__(self) -> str:
        sizes = " ".join(
            f"{key} {1e3 * value:g}" if isinstance(value, float) else f"{key} {value}" for key, value in self.params.items()
        )
        text = f"{self.kind} ({sizes}) mm at ({1e3 * self.place[0]:g}, {1e3 * self.place[1]:g}) mm, {1e3 * self.depth:g} mm deep"
        if any(self.shear):
            text += f", sheared ({1e3 * self.shear[0]:g}, {1e3 * self.shear[1]:g}) mm"
        if self.turned[0] != 1.0:
            text += ", turned by (" + " ".join(f"{v:.3g}" for v in self.turned) + ")"
        return text + (f", twisted {math.degrees(self.twist):g} deg" if self.twist else "")


def _both(
    name: str,
    kind: str,
    params: dict[str, float | int | str],
    place: tuple[float, float],
    depth: float,
    shear: tuple[float, float],
    twist_deg: float,
    turned: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
) -> Press:
    """An object sheared and twisted at once."""
    return Press(name, kind, params, place, depth, shear, math.radians(twist_deg), turned)


def _presses(name: str, *press: Any) -> tuple[Press, Press]:
    """The object of ``_both`` sheared, and the same twisted."""
    both = _both(name, *press)
    twisted = replace(both, name=f"{name}-twist", depth=0.8 * both.depth, shear=(0.0, 0.0))
    return replace(both, name=f"{name}-shear", twist=0.0), twisted


def _lying(angle_deg: float) -> tuple[float, float, float, float]:
    """Quaternion that lays a standing cylinder along x and turns it about z."""
    half = math.radians(angle_deg) / 2
    c, s = math.sqrt(0.5) * math.cos(half), math.sqrt(0.5) * math.sin(half)
    return c, -s, c, s


FIT = (
    *_presses("ball4", "sphere", {"radius": 4e-3}, (0.0, 0.0), 1.0e-3, (1.0e-3, 0.0), 30.0),
    *_presses("ball8", "sphere", {"radius": 8e-3}, (2.0e-3, -1.0e-3), 0.8e-3, (-0.5e-3, 0.7e-3), -25.0),
    *_presses("punch3", "cylinder", {"radius": 3e-3, "length": 6e-3}, (-1.0e-3, 1.0e-3), 0.7e-3, (0.0, -1.0e-3), 30.0),
    *_presses("ring", "torus", {"major_radius": 3e-3, "minor_radius": 1e-3}, (1.0e-3, 0.5e-3), 0.8e-3, (0.6e-3, 0.6e-3), 20.0),
    *_presses("ball4-slides", "sphere", {"radius": 4e-3}, (0.0, 0.0), 0.3e-3, (0.9e-3, 0.6e-3), 45.0),
    *_presses("punch3-slides", "cylinder", {"radius": 3e-3, "length": 6e-3}, (1.0e-3, 0.0), 0.2e-3, (-0.8e-3, 0.8e-3), 40.0),
)
"""Presses that models are fitted to; the light ones at the end slide and give the caps."""
HELD_OUT = (
    *_presses("ball6", "sphere", {"radius": 6e-3}, (-2.5e-3, 1.5e-3), 0.9e-3, (0.5e-3, -0.6e-3), 25.0),
    *_presses("punch2", "cylinder", {"radius": 2e-3, "length": 6e-3}, (3.0e-3, -1.5e-3), 0.8e-3, (-0.8e-3, 0.0), -30.0),
    *_presses(
        "cone", "cone", {"radius": 4e-3, "height": 3e-3, "tip_radius": 1.5e-3}, (0.5e-3, -2.0e-3), 0.9e-3, (0.0, 0.8e-3), 20.0
    ),
    *_presses(
        "bar", "cylinder", {"radius": 2.5e-3, "length": 8e-3}, (-0.5e-3, 0.5e-3), 0.8e-3, (0.3e-3, 0.7e-3), -20.0, _lying(30.0)
    ),
    *_presses("ball6-slides", "sphere", {"radius": 6e-3}, (1.5e-3, 1.0e-3), 0.3e-3, (-0.6e-3, -1.0e-3), -40.0),
    _both("ball6-both", "sphere", {"radius": 6e-3}, (1.5e-3, 1.0e-3), 0.35e-3, (-0.8e-3, 0.2e-3), 35.0),
    _both("punch2-both", "cylinder", {"radius": 2e-3, "length": 6e-3}, (2.0e-3, -1.0e-3), 0.3e-3, (0.2e-3, 0.7e-3), 45.0),
    _both("cone-both", "cone", {"radius": 4e-3, "height": 3e-3, "tip_radius": 1.5e-3}, (-2.0e-3, 1.0e-3), 0.4e-3, (0.4e-3, -0.5e-3), -35.0),
)  # fmt: skip
"""Presses that no fit uses: other objects, places and directions, sliding, both loads."""
QUICK_FIT, QUICK_HELD_OUT = FIT[:2], HELD_OUT[:2]
"""Few presses, for a quick run that shows that everything works."""


@dataclass(frozen=True)
class PressFrame:
    """One state of a press."""

    press: Press
    load: str
    """One of ``LOADS``; ``start`` before the touch."""
    surface: GelSurface
    """Surface of the rigid pad at the object's pose, with the soft pad's ``coat``."""


@dataclass(frozen=True)
class PressStates:
    """Result of the soft pad for one press, in N states: all that takes long to compute."""

    loads: tuple[str, ...]
    """Kind of load of each state, as in ``PressFrame``."""
    poses: np.ndarray
    """``pad_from_object``, shape (N, 4, 4)."""
    coat: DeformedCoat
    """Coat, with states in place of environments."""


def simulate_press(sensor: SensorSpec, press: Press, *, level: str, device: str = "cpu") -> PressStates:
    """Run a press on the soft pad of a ``level``.

    Raises:
        RaytacError: the press did not settle.
        SpecError: the press does not fit this sensor.
    """
    from raytac.physics.soft.pad import SoftPad

    soft = SoftPad(sensor, press.scene(), pitch=_PITCH, level=level, device=device)
    loads, poses, coats = [], [], []
    names = {"indent": "normal"} | ({"shear": "combined", "twist": "combined"} if press.is_combined else {})
    for state in soft.run(steps_per_stage=1 if press.is_combined else _STEPS):
        if state.failed.any():
            raise RaytacError(f"the press {press} did not settle")
        coat = state.surface.coat
        assert coat is not None
        loads.append(names.get(state.kind, state.kind))
        poses.append(np.asarray(state.pad_from_object)[0])
        coats.append(coat.positions[0])
    return PressStates(tuple(loads), np.stack(poses), DeformedCoat(coat.mesh, np.stack(coats)))


def press_frames(sensor: SensorSpec, press: Press, states: PressStates) -> list[PressFrame]:
    """States of a press with the rigid pad's surfaces there; errors as of ``simulate_press``."""
    from raytac.physics.rigid.pad import RigidPad

    rigid = RigidPad(sensor, press.scene(), pitch=_PITCH)
    frames = []
    for load, pose, positions in zip(states.loads, states.poses, states.coat.positions, strict=True):
        surface = rigid.surface_from_pose(pose[None])
        frames.append(PressFrame(press, load, replace(surface, coat=DeformedCoat(states.coat.mesh, positions[None]))))
    return frames
