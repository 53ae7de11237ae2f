"""Solver of a press: one pad and one object in a soft scene, in the pad frame."""

from __future__ import annotations

import numpy as np

import ipc
from raytac.errors import OverlapError, RaytacError
from raytac.physics.soft.bodies import OBJECT, PAD, SceneBody, ScenePad
from raytac.physics.soft.coat_state import CoatState, ContactObject
from raytac.physics.soft.mesh import PadMesh
from raytac.physics.soft.scene import SoftScene
from raytac.physics.soft.scene_state import SceneReport
from raytac.physics.soft.settings import PressControl
from raytac.se3 import inverse
from raytac.specs.sensor import SensorSpec

GRAVITY = 9.81
"""Acceleration that makes a free body's mass its weight [m/s²]."""


class PressSolver:
    """B copies of a bonded pad and one object; pad frame unless a name says otherwise."""

    def __init__(
        self, sensor: SensorSpec, mesh: PadMesh, body: SceneBody, start: np.ndarray, device: str, control: PressControl
    ) -> None:
        """Put pad and object into a scene; ``start`` (B, 4, 4). ``RaytacError`` if they overlap."""
        self.body, self.control, self._friction = body, control, sensor.gelpad.friction
        settings = ipc.Settings(
            dt=control.time_step,
            d_hat=mesh.d_hat,
            velocity_tolerance=control.tolerance / control.time_step,
            friction_slip=control.slip,
            friction_tolerance=control.friction_tolerance,
        )
        identity = np.tile(np.eye(4), (len(start), 1, 1))
        pads = [ScenePad(PAD, sensor, mesh)]
        try:
            self.scene = SoftScene(pads, [body], identity[:, None], {OBJECT: start}, settings=settings, device=device)
        except OverlapError as error:
            raise RaytacError(f"the object overlaps the pad where it starts, 1 mm above the first touch: {error}") from error
        self._world_from_pad = identity
        self._state: CoatState | None = None
        self.converged: np.ndarray = np.ones(len(start), bool)
        """True where the last step of an environment met its tolerance, shape (B,)."""
        self.unconverged: np.ndarray = np.zeros(len(start), int)
        """Steps of each environment that did not, shape (B,); ``reset`` does not clear it."""

    @property
    def world(self) -> ipc.World:
        """The solver's world."""
        return self.scene.world

    def reset(self) -> None:
        """Return to the start, without history."""
        self.scene.reset()
        self.converged[:] = True
        self._world_from_pad = np.tile(np.eye(4), (len(self._world_from_pad), 1, 1))

    def fail(self, envs: np.ndarray) -> None:
        """Freeze the environments of a mask (B,) until the next ``reset``; they cost nothing then."""
        new = envs & ~self.scene.failed
        if new.any():
            self.scene.fail(new)

    def step(self, pad_from_object: np.ndarray, world_from_pad: np.ndarray | None = None) -> np.ndarray:
        """Move a driven object, and if given the case, to poses (B, 4, 4) in one step.

        Where a contact jams, the barrier is stiffened and the step repeated. Returns the mask (B,) of environments that failed.
        """
        if world_from_pad is not None:
            self._world_from_pad = world_from_pad.copy()
        driven = {OBJECT: self._world_from_pad @ pad_from_object} if self.body.is_driven else {}
        report = self._advance(driven)
        failed = report.failed
        for _ in range(self.control.stiffenings):
            jammed = ~failed & (report.blocked > self.control.blocked)
            if not jammed.any():
                return failed
            state = self.world.save()
            state.kappa[jammed] *= self.control.stiffer
            self.world.restore(state, jammed)  # the others keep their forces, which bound friction in the next step
            report = self._advance(driven)
            failed = failed | report.failed
        return failed | (report.blocked > self.control.blocked)

    def _advance(self, driven: dict[str, np.ndarray]) -> SceneReport:
        report = self.scene.advance(self._world_from_pad[:, None], driven)
        self.converged = report.last_converged
        self.unconverged = self.unconverged + report.unconverged
        return report

    def set_gravity(self, share: float) -> None:
        """Let gravity act with a ``share`` of its strength, towards −z of the world."""
        self.world.set_gravity((0.0, 0.0, -share * GRAVITY))

    def speed(self) -> np.ndarray:
        """Greatest speed of any point of a free object [m/s], shape (B,)."""
        return np.linalg.norm(self.world.velocities(OBJECT), axis=-1).max(axis=-1)

    def forces(self) -> np.ndarray:
        """Force of the object on each vertex of the coat [N], shape (B, V, 3)."""
        return self.scene.coat_forces(PAD)

    def normal_force(self) -> np.ndarray:
        """Normal force of the object on the pad [N], shape (B,)."""
        return -self.forces()[:, :, 2].sum(axis=1)

    def coat_state(self, driven: np.ndarray) -> CoatState:
        """Coat, forces and object for a reader; ``driven``: ``pad_from_object`` (B, 4, 4) or None.

        The next call overwrites it.
        """
        free = not self.body.is_driven
        pose = inverse(self._world_from_pad) @ self.scene.pose(OBJECT) if free else driven
        surface = self.scene.skin(OBJECT, PAD) if self.body.is_soft else None
        if self._state is None:
            touched = ContactObject(self.body.parts, pose, surface, None, self._friction)
            self._state = CoatState.of(self.scene.coat(PAD), self.forces(), (touched,), self.world.device)
        else:
            self._state.update(self.scene.coat(PAD), self.forces(), pose, None if surface is None else surface[0])
        return self._state
