"""Who takes part in a soft scene: its pads and bodies by name, and what may be asked of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from raytac.errors import InputError
from raytac.physics.batch_check import rigid_poses
from raytac.physics.soft_bodies import SceneBody
from raytac.physics.soft_mesh import PadMesh
from raytac.specs.sensor import SensorSpec

__all__ = ["Cast", "ScenePad"]


@dataclass(frozen=True)
class ScenePad:
    """One pad of a scene; its case goes where ``world_from_pad`` says."""

    name: str
    sensor: SensorSpec
    mesh: PadMesh
    pitch: float = 0.1e-3
    """Spacing of the grid that its surface is read on [m]."""


class Cast:
    """Pads and bodies of a scene with B environments."""

    def __init__(self, pads: Sequence[ScenePad], bodies: Sequence[SceneBody], num_envs: int) -> None:
        """Raises ``InputError`` where there is no pad, or a name repeats."""
        names = [thing.name for thing in (*pads, *bodies)]
        if not pads:
            raise InputError("pads", value=(), rule="must hold one pad or more")
        if len(set(names)) < len(names):
            raise InputError("names", value=names, rule="must be unique among pads and bodies")
        self.pads, self.bodies = {pad.name: pad for pad in pads}, {body.name: body for body in bodies}
        self.num_envs = num_envs

    def pad(self, name: str) -> ScenePad:
        if name not in self.pads:
            raise InputError("pad", value=name, rule="must be the name of a pad of this scene", choices=self.pads)
        return self.pads[name]

    def body(self, name: str) -> SceneBody:
        if name not in self.bodies:
            raise InputError("name", value=name, rule="must be the name of a body of this scene", choices=self.bodies)
        return self.bodies[name]

    def named(self, poses: Mapping[str, ArrayLike], free: bool = False) -> dict[str, np.ndarray]:
        """Poses (B, 4, 4) of some bodies by name; of ``free`` ones only where they may be given."""
        for name in poses:
            if not (self.body(name).is_driven or free):
                driven = [n for n, body in self.bodies.items() if body.is_driven]
                raise InputError("driven", value=name, rule="moves freely and takes no pose", choices=driven)
        return {name: rigid_poses(name, pose, self.num_envs) for name, pose in poses.items()}

    def starts(self, poses: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
        """Poses (B, 4, 4) of all bodies by name."""
        for name in poses:
            self.body(name)
        for name in self.bodies:
            if name not in poses:
                raise InputError("world_from_body", value=list(poses), rule=f"must say where {name!r} starts")
        return {name: rigid_poses(name, poses[name], self.num_envs) for name in self.bodies}

    def driven(self, poses: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Copies of the poses of those bodies that are driven."""
        return {name: poses[name].copy() for name, body in self.bodies.items() if body.is_driven}

    def friction(self) -> dict[tuple[str, str], float]:
        """μ by pair of names: with a pad, the body's own if it has one, else the pad's gel's; between bodies, the larger of theirs."""
        found = {}
        for pad in self.pads.values():
            for other in self.pads.values():
                if other.name > pad.name:
                    found[pad.name, other.name] = max(pad.sensor.gelpad.friction, other.sensor.gelpad.friction)
            for body in self.bodies.values():
                found[pad.name, body.name] = pad.sensor.gelpad.friction if body.friction is None else body.friction
        names = list(self.bodies.values())
        for k, one in enumerate(names):
            for two in names[k + 1 :]:
                found[one.name, two.name] = max(one.friction or 0.0, two.friction or 0.0)
        return found
