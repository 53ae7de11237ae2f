"""Placement of a press: poses of object and case from first touch, shear and twist."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import PadGrid
from raytac.physics.press import PressTargets
from raytac.physics.rigid.load_law import LoadLaw, first_touch_z, gap_at_touch
from raytac.se3 import about_z
from raytac.shapes.part import Part
from raytac.specs.press import PressScene
from raytac.specs.sensor import GelpadSpec


class PressPlacement:
    """Poses of one scene's object over one pad, for B environments with their own offsets."""

    def __init__(
        self, scene: PressScene, parts: Sequence[Part], gelpad: GelpadSpec, grid: PadGrid, targets: PressTargets
    ) -> None:
        """Find the first touch of every environment; lost ones are put at the pad's centre.

        Raises:
            SpecError: an object that does not start over the pad, or is sheared or twisted off it; names the scene's file and key.
            InputError: the same by an environment's own offset, rotation, shear or twist; names both.
        """
        self._targets, self._parts, self._gelpad, self._grid = targets, parts, gelpad, grid
        self._rotations = targets.rotations
        self._touches: dict[bytes, float] = {}
        start = np.asarray(scene.object.position[:2])
        centres = np.where(targets.lost[:, None], 0.0, start + targets.offsets)
        self.origin = np.zeros((len(centres), 3))
        """Object's origin at first touch, zero shear and twist, shape (B, 3) [m]."""
        for b, (x, y) in enumerate(centres.tolist()):
            try:
                self.origin[b] = x, y, self._touch(b, x, y, 0.0)
            except InputError as error:
                raise targets.start_error(b, error) from error
        self._check_stages(scene)

    def poses(self, height: np.ndarray, shear: np.ndarray, twist: np.ndarray) -> np.ndarray:
        """``pad_from_object`` (B, 4, 4): ``height`` [m] above touch, after ``shear`` and ``twist``."""
        poses = np.tile(np.eye(4), (len(height), 1, 1))
        for b, angle in enumerate(twist):
            poses[b, :3, :3] = about_z(angle) @ self._rotations[b]
        poses[:, :3, 3] = self.origin
        poses[:, :2, 3] += shear
        poses[:, 2, 3] += height
        return poses

    def case(self, height: np.ndarray, shear: np.ndarray, twist: np.ndarray) -> np.ndarray:
        """``world_from_pad`` (B, 4, 4) of a case that moves; the object stays at first touch."""
        poses = np.tile(np.eye(4), (len(height), 1, 1))
        for b, angle in enumerate(twist):
            rotation = about_z(-angle)
            poses[b, :3, :3] = rotation
            poses[b, :3, 3] = self.origin[b] - rotation @ (np.array([*shear[b], height[b]]) + self.origin[b])
        return poses

    def touch_drop(self, shear: np.ndarray, twist: np.ndarray) -> np.ndarray:
        """Height of the first touch at the start less that after a shear and twist [m], shape (B,)."""
        places = zip(self.origin, self.origin[:, :2] + shear, twist, strict=True)
        return np.array([origin[2] - self._touch(b, x, y, angle) for b, (origin, (x, y), angle) in enumerate(places)])

    def stiffness(self, b: int, twist: float, force: float) -> float:
        """Force over depth [N/m] by the bonded layer's law at ``force`` [N]: a first guess."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = about_z(twist) @ self._rotations[b], self.origin[b]
        law = LoadLaw(gap_at_touch(self._parts, pose, self._grid), self._grid.x, self._grid.y, self._gelpad)
        return law.secant_stiffness(law.depth_at(min(max(force, 1e-3), law.greatest)))

    def _check_stages(self, scene: PressScene) -> None:
        """Refuse shears and twists that end off the pad."""
        targets, shear, twist = self._targets, np.zeros((len(self.origin), 2)), np.zeros(len(self.origin))
        for index, stage in enumerate(scene.trajectory):
            if stage.kind not in ("shear", "twist"):
                continue
            if stage.kind == "shear":
                shear = targets.shear(stage)
            else:
                twist = targets.twist(stage)
            for b in np.flatnonzero(~targets.lost).tolist():
                x, y = self.origin[b, :2] + shear[b]
                try:
                    self._touch(b, x, y, twist[b])
                except InputError as error:
                    raise targets.stage_error(index, targets.stage(stage, b), b, error) from error

    def _touch(self, b: int, x: float, y: float, twist: float) -> float:
        """Height of the object's origin at first touch [m]; cached, since environments share poses."""
        pose = np.eye(4)
        pose[:3, :3] = about_z(twist) @ self._rotations[b]
        pose[:2, 3] = x, y
        key = pose.tobytes()
        if key not in self._touches:
            self._touches[key] = first_touch_z(self._parts, pose, self._gelpad, self._grid)
        return self._touches[key]
