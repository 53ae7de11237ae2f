"""What the environments of one press scene do each in their own way: where, how turned, how deep and how far sideways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from raytac.errors import InputError
from raytac.physics.press_plan import per_environment, rotation_matrix
from raytac.specs.press import PressScene, StageSpec

__all__ = ["PressTargets"]


class PressTargets:
    """Targets of B environments; a number that is not finite marks its environment as ``lost``: it fails from the start.

    Attributes:
        offsets: added to the object's x, y [m], (B, 2).
        rotations: ``pad_from_object`` at zero twist, (B, 3, 3); that of the scene in an environment that is lost.
        depths: of every indent to a depth in place of the scene's [m], (B,); None leaves the scene's.
        lost: (B,), bool.
    """

    def __init__(
        self,
        scene: PressScene,
        num_envs: int,
        *,
        offsets: np.ndarray | None = None,
        depths: np.ndarray | None = None,
        rotations: np.ndarray | None = None,
        shears: np.ndarray | None = None,
        twists: np.ndarray | None = None,
    ) -> None:
        """Check shapes.

        Args:
            scene: gives the object's own rotation, which comes first.
            num_envs: number of environments B, at least 1.
            offsets: added to the object's x, y [m], (B, 2); None is none.
            depths: of every indent to a depth [m], (B,); None leaves the scene's, as for the next three.
            rotations: turn of the object about its origin, axes of the pad frame, wxyz, of any length, (B, 4).
            shears: target of every ``shear`` stage along x, y [m], (B, 2).
            twists: target of every ``twist`` stage [rad], (B,).

        Raises:
            InputError: ``num_envs`` below 1, an argument of another shape, or a quaternion of zeros.
        """
        if num_envs < 1:
            raise InputError("num_envs", value=num_envs, rule="must be a whole number >= 1")
        self.offsets = per_environment("offsets", offsets, (num_envs, 2))
        self.depths = None if depths is None else per_environment("depths", depths, (num_envs,))
        self._shears = None if shears is None else per_environment("shears", shears, (num_envs, 2))
        self._twists = None if twists is None else per_environment("twists", twists, (num_envs,))
        turns = np.tile([1.0, 0.0, 0.0, 0.0], (num_envs, 1))
        if rotations is not None:
            turns = per_environment("rotations", rotations, (num_envs, 4))
        given = [a for a in (self.offsets, self.depths, self._shears, self._twists, turns) if a is not None]
        self.lost = ~np.all([np.isfinite(a.reshape(num_envs, -1)).all(axis=1) for a in given], axis=0)
        turns = np.where(self.lost[:, None], [1.0, 0.0, 0.0, 0.0], turns)
        zero = ~turns.any(axis=1)
        if zero.any():
            rule = f"must not be all 0, in environment {int(zero.argmax())}"
            raise InputError("rotations", value=turns[zero.argmax()].tolist(), rule=rule)
        own = rotation_matrix(scene.object.quaternion)
        self.rotations = own[None].repeat(num_envs, axis=0)
        if rotations is not None:
            self.rotations = np.stack([rotation_matrix(tuple(turn)) for turn in turns]) @ own

    def stage(self, stage: StageSpec, b: int) -> StageSpec:
        """A stage as environment ``b`` runs it."""
        if stage.kind == "indent" and stage.depth is not None and self.depths is not None:
            return replace(stage, depth=float(self.depths[b]))
        if stage.kind == "shear" and self._shears is not None:
            return replace(stage, shear=(float(self._shears[b, 0]), float(self._shears[b, 1])))
        if stage.kind == "twist" and self._twists is not None:
            return replace(stage, twist=float(self._twists[b]))
        return stage

    def depth(self, stage: StageSpec) -> np.ndarray:
        """Where an indent to a depth ends [m], (B,); 0 in an environment that is lost."""
        return self._sound(np.full(len(self.lost), stage.depth) if self.depths is None else self.depths)

    def shear(self, stage: StageSpec) -> np.ndarray:
        """Where a shear ends [m], (B, 2)."""
        return self._sound(np.tile(stage.shear, (len(self.lost), 1)) if self._shears is None else self._shears)

    def twist(self, stage: StageSpec) -> np.ndarray:
        """Where a twist ends [rad], (B,)."""
        return self._sound(np.full(len(self.lost), stage.twist) if self._twists is None else self._twists)

    def _sound(self, values: np.ndarray) -> np.ndarray:
        return np.where(self.lost if values.ndim == 1 else self.lost[:, None], 0.0, values)
