"""The contact of a press: one pad and one object in a soft scene, seen from the pad."""

from __future__ import annotations

import numpy as np

import ipc
from raytac.errors import OverlapError, RaytacError
from raytac.physics.soft.bodies import OBJECT, PAD, SceneBody
from raytac.physics.soft.mesh import PadMesh
from raytac.physics.soft.reading import CoatState, ContactObject
from raytac.physics.soft.scene import ScenePad, SoftScene
from raytac.physics.soft.substeps import SceneReport
from raytac.se3 import inverse
from raytac.specs.sensor import SensorSpec

__all__ = ["GRAVITY", "SoftContact"]

GRAVITY = 9.81
"""Acceleration that makes a free body's mass its weight [m/s²]."""
_TIME_STEP = 0.01
_CLOSE = 5e-7
"""A step is solved when no vertex would move further than this [m]."""
_CREEP = 1e-6
"""What sticks may creep by so much a step [m]."""
_BLOCKED = 1e-3
"""Share of a step's motion that may be left undone."""
_STIFFER, _STIFFENINGS = 4.0, 4
"""The barrier is made so many times as stiff, at most so often in one step, where a contact so sharp (a cone's tip on one facet of the
coat) jams: the pressure that a barrier can bear is bounded as long as surfaces keep apart, and the force is borne by few small facets."""
_UNSETTLED, _SETTLINGS = 0.01, 60
"""Friction has settled when the coat's forces change by less than this share in a step; so many steps are tried."""
_SLIGHT = 1e-5
"""A force too small to be judged [N]."""


class SoftContact:
    """B copies of a bonded pad and one object. Every pose and vector here is in the pad frame unless it says otherwise."""

    def __init__(self, sensor: SensorSpec, mesh: PadMesh, body: SceneBody, starts: np.ndarray, device: str) -> None:
        """``starts``: ``pad_from_object`` of each environment, shape (B, 4, 4), clear of the pad; ``device``: ``cpu`` or ``cuda``.

        Raises:
            RaytacError: the object overlaps the pad where it starts; the message names the surfaces.
        """
        self.body, self._friction = body, sensor.gelpad.friction
        settings = ipc.Settings(
            dt=_TIME_STEP,
            d_hat=mesh.d_hat,
            velocity_tolerance=_CLOSE / _TIME_STEP,
            friction_velocity=_CREEP / _TIME_STEP,
            friction_relags=0,  # a loading in small steps stays within the cone; what unloads is followed by settle_friction
        )
        here = np.tile(np.eye(4), (len(starts), 1, 1))
        pads = [ScenePad(PAD, sensor, mesh)]
        try:
            self.scene = SoftScene(pads, [body], here[:, None], {OBJECT: starts}, settings=settings, device=device)
        except OverlapError as error:
            raise RaytacError(f"the object overlaps the pad where it starts, 1 mm above the first touch: {error}") from error
        self._world_from_pad = here
        self.converged: np.ndarray = np.ones(len(starts), bool)
        """Whether the last step of each environment met its tolerance, shape (B,)."""
        self.unconverged: np.ndarray = np.zeros(len(starts), int)
        """How many steps of each environment did not, shape (B,); ``reset`` leaves it as it is."""

    @property
    def world(self) -> ipc.World:
        """The solver's world."""
        return self.scene.world

    def reset(self) -> None:
        """Back to the start, without history."""
        self.scene.reset()
        self.converged[:] = True
        self._world_from_pad = np.tile(np.eye(4), (len(self._world_from_pad), 1, 1))

    def fail(self, envs: np.ndarray) -> None:
        """Step environments of a mask (B,) no more until the next ``reset``, so that they cost nothing and keep no other waiting."""
        new = envs & ~self.scene.failed
        if new.any():
            self.scene.fail(new)

    def drive(self, pad_from_object: np.ndarray, world_from_pad: np.ndarray | None = None) -> np.ndarray:
        """One step that takes the object to ``pad_from_object`` (B, 4, 4); the case moves if ``world_from_pad`` (B, 4, 4) is given.

        A free object is not driven. Returns which environments failed, shape (B,).
        """
        if world_from_pad is not None:
            self._world_from_pad = world_from_pad.copy()
        driven = {OBJECT: self._world_from_pad @ pad_from_object} if self.body.is_driven else {}
        report = self._advance(driven)
        failed = report.failed
        for _ in range(_STIFFENINGS):
            jammed = ~failed & (report.blocked > _BLOCKED)
            if not jammed.any():
                return failed
            state = self.world.save()
            state.kappa[jammed] *= _STIFFER
            self.world.restore(state, jammed)  # the others keep their forces, which bound friction in the next step
            report = self._advance(driven)
            failed = failed | report.failed
        return failed | (report.blocked > _BLOCKED)

    def _advance(self, driven: dict[str, np.ndarray]) -> SceneReport:
        report = self.scene.advance(self._world_from_pad[:, None], driven)
        self.converged = report.last_converged
        self.unconverged = self.unconverged + report.unconverged
        return report

    def settle_friction(self, pad_from_object: np.ndarray, world_from_pad: np.ndarray | None, failed: np.ndarray) -> np.ndarray:
        """Stand still until friction is that of the contacts there are; poses as for ``drive``.

        Friction is bounded by the normal forces with which a step begins. In an unloading those are too large, and some are of contacts
        that the step has opened: friction would pull on the pad where nothing touches it any more. Environments that ``failed``, (B,),
        are not waited for. Returns which failed meanwhile, (B,).
        """
        lost, forces = failed.copy(), self.forces()
        for _ in range(_SETTLINGS):
            if not forces[~lost].any():
                break
            self.fail(lost)
            lost |= self.drive(pad_from_object, world_from_pad)
            before, forces = forces, self.forces()
            changed, borne = (np.linalg.norm(f, axis=2).sum(axis=1) for f in (forces - before, forces))
            if (((changed <= _UNSETTLED * borne) & self.obeys_friction()) | lost).all():
                break
        return lost

    def obeys_friction(self) -> np.ndarray:
        """Whether friction is within its cone and no vertex is pulled, over-all and within a hundredth, shape (B,)."""
        forces = self.forces()
        total = forces.sum(axis=1)
        borne = np.maximum(-total[:, 2], 0.0)
        cone = (1.0 + _UNSETTLED) * self._friction * borne + _SLIGHT
        pulled = np.maximum(forces[:, :, 2], 0.0).sum(axis=1)
        return (np.linalg.norm(total[:, :2], axis=1) <= cone) & (pulled <= _UNSETTLED * borne + _SLIGHT)

    def weigh(self, share: float) -> None:
        """Let gravity act with ``share`` of its strength, towards −z of the world."""
        self.world.set_gravity((0.0, 0.0, -share * GRAVITY))

    def speed(self) -> np.ndarray:
        """Greatest speed of any point of a free object [m/s], shape (B,)."""
        return np.linalg.norm(self.world.velocities(OBJECT), axis=-1).max(axis=-1)

    def forces(self) -> np.ndarray:
        """What the object does to each vertex of the coat [N], shape (B, V, 3)."""
        return self.scene.coat_forces(PAD)

    def coat_state(self, driven: np.ndarray) -> CoatState:
        """Coat, forces and object, for a reader; ``driven``: ``pad_from_object`` (B, 4, 4) of an object that is not free."""
        free = not self.body.is_driven
        pose = inverse(self._world_from_pad) @ self.scene.pose(OBJECT) if free else driven
        surface = self.scene.skin(OBJECT, PAD) if self.body.is_soft else None
        return CoatState(
            self.scene.coat(PAD), self.forces(), (ContactObject(self.body.parts, pose, surface, None, self._friction),)
        )
