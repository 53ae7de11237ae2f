"""Placement of a press: poses of object and case from first touch, shear and turn.

A turn (…, 3) [rad] is a tilt along x and y, then a twist about z (``turn_rotations``).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import PadGrid
from raytac.physics.press import TURNS, PressTargets, turn_rotations
from raytac.physics.rigid.load_law import LoadLaw, first_touch_z, gap_at_touch
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
            SpecError: an object that does not start over the pad, or is sheared or turned off it; names the scene's file and key.
            InputError: the same by an environment's own offset, rotation, shear or twist; names both.
        """
        self._targets, self._parts, self._gelpad, self._grid = targets, parts, gelpad, grid
        self._rotations = targets.rotations
        self._touches: dict[bytes, float] = {}
        start = np.asarray(scene.object.position[:2])
        centres = np.where(targets.lost[:, None], 0.0, start + targets.offsets)
        self.origin = np.zeros((len(centres), 3))
        """Object's origin at first touch, zero shear and turn, shape (B, 3) [m]."""
        for b, (x, y) in enumerate(centres.tolist()):
            try:
                self.origin[b] = x, y, self._touch(b, x, y, np.zeros(3))
            except InputError as error:
                raise targets.start_error(b, error) from error
        self._check_stages(scene)

    def poses(self, height: np.ndarray, shear: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """``pad_from_object`` (B, 4, 4): ``height`` [m] above touch, after ``shear`` and ``turn``."""
        poses = np.tile(np.eye(4), (len(height), 1, 1))
        poses[:, :3, :3] = turn_rotations(turn) @ self._rotations
        poses[:, :3, 3] = self.origin
        poses[:, :2, 3] += shear
        poses[:, 2, 3] += height
        return poses

    def case(self, height: np.ndarray, shear: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """``world_from_pad`` (B, 4, 4) of a case that moves; the object stays at first touch."""
        poses = np.tile(np.eye(4), (len(height), 1, 1))
        poses[:, :3, :3] = turn_rotations(turn).transpose(0, 2, 1)
        moved = np.column_stack([shear, height]) + self.origin
        poses[:, :3, 3] = self.origin - (poses[:, :3, :3] @ moved[:, :, None])[..., 0]
        return poses

    def touch_drop(self, shear: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """Height of the first touch at the start less that after a shear and turn [m], shape (B,)."""
        places = zip(self.origin, self.origin[:, :2] + shear, turn, strict=True)
        return np.array([origin[2] - self._touch(b, x, y, own) for b, (origin, (x, y), own) in enumerate(places)])

    def stiffness(self, b: int, turn: np.ndarray, force: float) -> float:
        """Force over depth [N/m] by the bonded layer's law at ``force`` [N]: a first guess."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn_rotations(turn) @ self._rotations[b], self.origin[b]
        law = LoadLaw(gap_at_touch(self._parts, pose, self._grid), self._grid.x, self._grid.y, self._gelpad)
        return law.secant_stiffness(law.depth_at(min(max(force, 1e-3), law.greatest)))

    def _check_stages(self, scene: PressScene) -> None:
        """Refuse shears, twists and tilts that end off the pad."""
        targets, shear, turn = self._targets, np.zeros((len(self.origin), 2)), np.zeros((len(self.origin), 3))
        for index, stage in enumerate(scene.trajectory):
            if stage.kind == "shear":
                shear = targets.shear(stage)
            elif stage.kind in TURNS:
                turn = targets.turn(stage, turn)
            else:
                continue
            for b in np.flatnonzero(~targets.lost).tolist():
                x, y = self.origin[b, :2] + shear[b]
                try:
                    self._touch(b, x, y, turn[b])
                except InputError as error:
                    raise targets.stage_error(index, targets.stage(stage, b), b, error) from error

    def _touch(self, b: int, x: float, y: float, turn: np.ndarray) -> float:
        """Height of the object's origin at first touch [m]; cached, since environments share poses."""
        pose = np.eye(4)
        pose[:3, :3] = turn_rotations(turn) @ self._rotations[b]
        pose[:2, 3] = x, y
        key = pose.tobytes()
        if key not in self._touches:
            self._touches[key] = first_touch_z(self._parts, pose, self._gelpad, self._grid)
        return self._touches[key]
