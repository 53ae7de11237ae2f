"""Rigid pads in a MuJoCo world: geometry and load law as one contact a body.

MuJoCo's own collision uses a convex hull of the body, and its number of contact points sets the stiffness. Here contact is computed as in
``RigidPad``, from the overlap of the resting gel with the body's underside (``PadSearch``):

- place and normal: the overlap's centroid, and the resting gel's normal there. Its line goes through the centre of a ball anywhere on the
  dome;
- normal force: the load law of this body at this place, as an implicit spring (``normal_spring``);
- friction: the gel shears first and slips from the edge of the contact inwards (``ShearState``), within Coulomb's cone; torsional
  3π/16 μ a with a the contact's radius (Hertz contact that slips as a whole, as in a press); rolling 3/16 α a (J. A. Greenwood,
  H. Minshall, D. Tabor, Hysteresis losses in rolling and sliding friction, Proc. R. Soc. A 259, 1961) with α the gel's hysteresis.

What a step does before its contact is known is foreseen: controls are written before contacts are put in, and MuJoCo's acceleration
without constraints says which gap may close, and which slide begin, within the step.

All environments step together, on an ``Engine``: in every step their contacts are computed at once. Where something moves fast near a
pad, that environment takes shorter steps (``choose_steps``): half of the scene's, a quarter …
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from raytac.errors import InputError
from raytac.physics.rigid.gel_contact import GelContact, HostViews
from raytac.warp_runtime import Recorded
from raytac.world.engine.base import Engine
from raytac.world.engine.c_mujoco import CMujoco
from raytac.world.environment_models import EnvironmentModels
from raytac.world.gel_pairs import GelPairs
from raytac.world.pad_contact import PadIndices, gel_contact
from raytac.world.rigid_readings import RigidReadings
from raytac.world.world_model import WorldModel
from raytac.world.world_state import Drive


def rigid_pads(composed: WorldModel, models: EnvironmentModels, datas: Sequence[Any], **_: object) -> RigidPads:
    """Pads on C MuJoCo; ``models``, ``datas`` of every environment; the rest does not matter."""
    return pads_on_c_mujoco(composed, models, datas)[0]


def pads_on_c_mujoco(composed: WorldModel, models: EnvironmentModels, datas: Sequence[Any]) -> tuple[RigidPads, CMujoco]:
    """Pads of ``composed``, and their engine; ``models``, ``datas`` of every environment."""
    pads, gels = PadIndices.of(composed), tuple(spec.gelpad for spec in composed.sensor_specs)
    pairs = GelPairs(gels, pads.carriers, len(datas))
    contact = gel_contact(composed, models, pairs.pairs, num_envs=len(datas))
    engine = CMujoco(contact, pads, models, datas, timestep=composed.timestep)
    return RigidPads(composed, contact, pairs, engine), engine


class RigidPads(RigidReadings):
    """All pads of a world in B environments, on an engine: the order of a step."""

    def __init__(self, composed: WorldModel, contact: GelContact, pairs: GelPairs, engine: Engine) -> None:
        """Pads of ``composed``; ``contact``: of their gels; ``pairs``: gels that may touch.

        Raises ``InputError`` for an engine that does not divide steps.
        """
        if not engine.divides:
            raise InputError(
                "engine", value=type(engine).__name__, rule="must divide steps: others have the order of a step themselves"
            )
        super().__init__(composed, contact, pairs, engine)
        self._views = HostViews(contact)
        self._begin = [Recorded(engine.read_frames, partial(contact.begin, whole=whole)) for whole in (False, True)]
        self._move = Recorded(engine.read_frames, contact.move)
        self._end = Recorded(engine.read_rows, contact.end)

    def reset(self, envs: Sequence[int], bodies: Mapping[str, np.ndarray] | None = None) -> None:
        """Forget what environments went through; where bodies start, the engine knows.

        Raises ``OverlapError``: a body starts beyond a pad's bonded face.
        """
        self.check_beyond(envs, self._pad_from_body()[np.asarray(envs, int)])
        self.clear(envs)

    def clear(self, envs: Sequence[int]) -> None:
        """Forget what environments went through."""
        self.contact.vary()
        self.contact.clear(envs)
        self.surfaces.reset(np.asarray(envs, int))

    def advance(self, drive: Drive, failed: np.ndarray) -> None:
        """One control step of all environments; failures are marked in ``failed`` (B,).

        Those that break down, or in which a body goes through a pad all the same, stand still.
        """
        scene, ticks = self.composed, self.contact.ticks
        self.engine.prepare()
        failed |= self.engine.invalid()
        self._views.before[:] = np.nan
        # No environment waits for those that take shorter steps.
        total, done = ticks * round(scene.control_timestep / scene.timestep), np.zeros(len(failed), int)
        while len(envs := (~failed & (done < total)).nonzero()[0]):
            done[envs] += self._step(envs, drive, done[envs] % ticks, failed)
        if len(sound := (~failed).nonzero()[0]):
            self.contact.choose(sound, 0)
            self.engine.update_poses()  # so that they are those of the end of the step
            self._move()
            self._mark_lost(sound, failed)

    def _step(self, envs: np.ndarray, drive: Drive, done: np.ndarray, failed: np.ndarray) -> np.ndarray:
        """One step of ``envs``, each of its own length; returns the ticks of each, (n,)."""
        self.contact.choose(envs, done)
        self.engine.begin_step()
        drive(envs)
        self._insert()
        self.engine.end_step()
        self._end()
        self._mark_lost(envs, failed)
        return self._views.ticks[: len(envs)]

    def add(self, failed: np.ndarray) -> np.ndarray:
        """Put the pads' contacts into states that somebody else steps.

        It comes between the halves of a step, with their controls.
        The result is for ``finish``, after the second half. A step is as long as the model's: it is not divided where something moves
        fast.
        """
        self.engine.prepare()
        envs = np.flatnonzero(~failed)
        self.contact.choose(envs, 0)
        if len(envs):
            self._insert(whole=True)
            self._mark_lost(envs, failed)
        return envs

    def finish(self, envs: np.ndarray, failed: np.ndarray) -> None:
        """Read the forces of ``add``'s contacts and shear the gels, after the step's second half."""
        self.engine.prepare()
        if len(envs):
            self._end()
            self._mark_lost(envs, failed)

    def _insert(self, *, whole: bool = False) -> None:
        """Put the pads' contacts among MuJoCo's, with the controls; ``whole``: of an undivided step."""
        self.engine.free_acceleration()
        self._begin[whole]()
        self.engine.put_contacts(own_step=not whole)

    def _mark_lost(self, envs: np.ndarray, failed: np.ndarray) -> None:
        """Mark environments that broke down in ``failed`` (B,)."""
        lost = self._views.lost[: len(envs)]
        if np.count_nonzero(lost):
            failed[envs[lost != 0]] = True
