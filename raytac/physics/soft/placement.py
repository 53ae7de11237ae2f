"""Placement of a press: poses of object and case from first touch, shear and turn.

A turn (…, 3) [rad] is a tilt along x and y, then a twist about z (``turn_rotations``).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import PadGrid
from raytac.physics.press import TURNS, PressTargets, turn_rotations
from raytac.physics.rigid.load_law import LoadLaw, first_touch, gap_at_touch, too_deep
from raytac.shapes.part import Part
from raytac.specs.press import PressScene, StageSpec
from raytac.specs.sensor import GelpadSpec


class PressPlacement:
    """Poses of one scene's object over one pad, for B environments with their own offsets."""

    def __init__(
        self, scene: PressScene, parts: Sequence[Part], gelpad: GelpadSpec, grid: PadGrid, targets: PressTargets
    ) -> None:
        """Find the first touch of every environment; lost ones are put at the pad's centre.

        Raises:
            SpecError: an object that does not start over the pad, is sheared or turned off it, or is driven past the bonded face; names the
                scene's file and key.
            InputError: the same by an environment's own target; names both.
        """
        self._targets, self._parts, self._gelpad, self._grid = targets, parts, gelpad, grid
        self._rotations = targets.rotations
        self._touches: dict[bytes, tuple[float, float, float]] = {}
        self._gives_way = scene.object.dynamics == "soft"
        start = np.asarray(scene.object.position[:2])
        centres = np.where(targets.lost[:, None], 0.0, start + targets.offsets)
        self.origin = np.zeros((len(centres), 3))
        """Object's origin at first touch, zero shear and turn, shape (B, 3) [m]."""
        self.lever = np.zeros(len(centres))
        """Height of the origin over the gel that is touched there, (B,) [m]."""
        for b, (x, y) in enumerate(centres.tolist()):
            try:
                touch, _, self.lever[b] = self._touch(b, x, y, np.zeros(3))
                self.origin[b] = x, y, touch
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
        return np.array([origin[2] - self._touch(b, x, y, own)[0] for b, (origin, (x, y), own) in enumerate(places)])

    def stiffness(self, b: int, turn: np.ndarray, force: float) -> float:
        """Force over depth [N/m] by the bonded layer's law at ``force`` [N]: a first guess."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn_rotations(turn) @ self._rotations[b], self.origin[b]
        law = LoadLaw(gap_at_touch(self._parts, pose, self._grid), self._grid.x, self._grid.y, self._gelpad)
        return law.secant_stiffness(law.depth_at(min(max(force, 1e-3), law.greatest)))

    def end_of(
        self, index: int, stage: StageSpec, depth: np.ndarray, shear: np.ndarray, turn: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Depth, shear and turn at the end of a stage from those at its start, (B,), (B, 2), (B, 3).

        A depth is that which is prescribed [m], NaN where none is. ``index``: number of the stage in the scene, or −1. Raises
        ``PressTargets.stage_error`` for an end off the pad, or a rigid object past the gel's bonded face.
        """
        targets = self._targets
        if stage.kind == "shear":
            shear = targets.shear(stage)
        elif stage.kind in TURNS:
            turn = targets.turn(stage, turn)
        else:
            depth = np.full(len(depth), np.nan) if stage.depth is None else targets.depth(stage)
        for b in np.flatnonzero(~targets.lost).tolist() if stage.kind != "release" else ():
            x, y = self.origin[b, :2] + shear[b]
            try:
                touch, deepest, _ = self._touch(b, x, y, turn[b])
                deepest += self.origin[b, 2] - touch
                if depth[b] > deepest and not self._gives_way:
                    raise too_deep(depth[b], deepest)
            except InputError as error:
                raise targets.stage_error(index, targets.stage(stage, b), b, error) from error
        return depth, shear, turn

    def _check_stages(self, scene: PressScene) -> None:
        """Refuse stages as ``end_of``."""
        batch = len(self.origin)
        state = np.full(batch, np.nan), np.zeros((batch, 2)), np.zeros((batch, 3))
        for index, stage in enumerate(scene.trajectory):
            state = self.end_of(index, stage, *state)

    def _touch(self, b: int, x: float, y: float, turn: np.ndarray) -> tuple[float, float, float]:
        """Height, travel to the bonded face and lever of ``FirstTouch`` [m]; cached."""
        pose = np.eye(4)
        pose[:3, :3] = turn_rotations(turn) @ self._rotations[b]
        pose[:2, 3] = x, y
        key = pose.tobytes()
        if key not in self._touches:
            touch = first_touch(self._parts, pose, self._gelpad, self._grid)
            self._touches[key] = touch.z, min(touch.deepest, self._gelpad.thickness), touch.lever
        return self._touches[key]
