"""How do I add a physics of my own? Here a Winkler foundation: each point of the gel yields by itself. `python examples/own_pad.py`"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

import raytac
from raytac.physics import CLEARANCE, PadReading, PressPad, register
from raytac.shapes import object_height


class WinklerPad(PressPad):
    """The gel takes the object's underside wherever it is below rest; pressure = stiffness * depth. No friction, no force control."""

    def __init__(self, stiffness, spec, scene, **settings):
        super().__init__(spec, scene, **settings)
        self.stiffness, self.pose = stiffness, np.tile(np.eye(4), (self.num_envs, 1, 1))
        self.nodes = np.stack(np.broadcast_arrays(self.grid.x, self.grid.y[:, None], self.grid.rest), axis=-1)
        self.pose[:, :3, :3] = self.targets.rotations
        self.pose[:, :2, 3] = np.asarray(scene.object.position[:2]) + self.targets.offsets
        self.touch = (self.grid.rest - object_height(self.parts, self.pose, self.grid.x, self.grid.y)).max(axis=(1, 2))

    def reset(self):
        self.depth = np.full(self.num_envs, -CLEARANCE)

    def begin(self, index, stage, steps):
        if stage.force is not None:
            raise raytac.InputError("force", value=stage.force, rule="cannot be prescribed here: press to a depth")
        depths = {"indent": self.targets.depth, "release": lambda _: -CLEARANCE}
        self.before, self.end = self.depth, depths.get(stage.kind, lambda _: self.depth)(stage)

    def advance(self, stage, fraction):
        self.depth = self.before + fraction * (self.end - self.before)

    def read(self):
        pose, rest = self.pose.copy(), self.grid.rest
        pose[:, 2, 3] = self.touch - self.depth
        height = np.minimum(object_height(self.parts, pose, self.grid.x, self.grid.y), rest)
        load = self.stiffness * (height - rest)[..., None] * (0.0, 0.0, 1.0)  # [Pa]
        force, torque = (v.sum(axis=(1, 2)) * np.prod(self.grid.pitch) for v in (load, np.cross(self.nodes, load)))
        with np.errstate(invalid="ignore"):  # no centre without contact
            centre = np.stack([-torque[:, 1], torque[:, 0]], axis=1) / force[:, 2:]
        surface = raytac.GelSurface(self.grid, height.astype(np.float32), height < rest, centre, pad_from_object=pose)
        return PadReading(surface, np.hstack([force, torque]), self.targets.lost, load, pad_from_object=pose, depth=self.depth)


@register("winkler")
@dataclass(frozen=True)
class Winkler:
    stiffness: float = 1e8  # [Pa/m]
    is_simulated: ClassVar[bool] = False
    label: ClassVar[str] = "winkler"

    def build(self, spec, press, *, device="auto", **settings):
        return WinklerPad(self.stiffness, spec, press, **settings)


if __name__ == "__main__":
    print(raytac.TactileSensor("gelsight_mini", physics="winkler", outputs=("height", "wrench")).press("torus"))
