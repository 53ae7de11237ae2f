"""Rigid pads in a MuJoCo world: contact by geometry and load law, as in a press, given to MuJoCo as one contact a body.

MuJoCo's own collision uses a convex hull of the body, and its number of contact points sets the stiffness. Here contact is computed as in
``RigidPad``, from the overlap of the resting gel with the body's underside (``PadSearch``):

- place and normal: the overlap's centroid, and the resting gel's normal there. Its line goes through the centre of a ball anywhere on
  the dome;
- normal force: the load law of this body at this place, as an implicit spring (``normal_spring``);
- friction: the gel shears first and slips from the edge of the contact inwards (``ShearState``), within Coulomb's cone; torsional 3π/16 μ a
  with a the contact's radius (Hertz contact that slips as a whole, as in a press); rolling 3/16 α a (J. A. Greenwood, H. Minshall, D.
  Tabor, Hysteresis losses in rolling and sliding friction, Proc. R. Soc. A 259, 1961) with α the gel's hysteresis.

What a step does before its contact is known is foreseen: controls are written before contacts are put in, and MuJoCo's acceleration
without constraints says which gap may close, and which slide begin, within the step.

All environments step together: in every step of MuJoCo their contacts are computed at once, and MuJoCo is called for one after the other.
Where something moves fast near a pad, that environment takes shorter steps (``choose_steps``): half of the scene's, a quarter …
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from raytac.errors import InputError, OverlapError
from raytac.gel.surface import PadGrid
from raytac.physics.base import PadReading
from raytac.physics.rigid.gel_contact import Bodies, GelContact
from raytac.robots.frames import body_poses, site_poses
from raytac.robots.states import StateReader, body_pose, site_pose
from raytac.se3 import inverse
from raytac.world.environment_models import EnvironmentModels
from raytac.world.forbidden_overlap import BondedFaces
from raytac.world.gel_pairs import GelPairs
from raytac.world.hard_contacts import HARD_MARGIN, is_hard
from raytac.world.mujoco_rows import MujocoRows
from raytac.world.pad_surfaces import PadSurfaces
from raytac.world.world_model import WorldModel
from raytac.world.world_state import Drive, lost

_CASE_TRAVEL = 0.8 * HARD_MARGIN
"""Greatest travel of a body beside a case in a step [m]: less than the gap from which their contact is known."""


class RigidPads:
    """All pads of a world, B environments; MuJoCo moves every body."""

    soft = None
    meshes: tuple[str, ...] = ()

    def __init__(self, composed: WorldModel, models: EnvironmentModels, datas: Sequence[mujoco.MjData], **_: object) -> None:
        """Pads of ``composed``; ``models``, ``datas``: MuJoCo's of every environment. Physics and device do not matter here."""
        num_envs = len(datas)
        self.composed, self.model, self._models = composed, composed.model, models
        self._names = [mounted.name for mounted in composed.sensors]
        self.bodies = composed.touched
        self._body_index = np.array([body.index for body in self.bodies], int)
        self._site_index = np.array([composed.model.site(mounted.site).id for mounted in composed.sensors], int)
        self._pad_index = np.array([composed.model.body(mounted.body).id for mounted in composed.sensors], int)
        self._gels = tuple(spec.gelpad for spec in composed.sensor_specs)
        shapes = [body.parts for body in self.bodies]
        self._faces = BondedFaces(self._gels, shapes)
        # What pads may touch: the bodies, then the gels of the pads.
        geoms = [body.geoms[0] for body in self.bodies]
        geoms += [int(composed.model.geom(mounted.gel).id) for mounted in composed.sensors]
        self._gel_pairs = GelPairs(self._gels, self._pad_index, num_envs)
        cases = [int(composed.model.geom(mounted.case).id) for mounted in composed.sensors]
        touched = Bodies(
            shapes,
            self._body_index,
            self._pad_index,
            composed.model.body_ipos[np.concatenate([self._body_index, self._pad_index])],
            composed.model.geom_pos[cases],
            composed.model.geom_size[cases],
        )
        self._contact = GelContact(
            self._gels,
            touched,
            self._gel_pairs.pairs,
            {
                "inverse_weight": models.inverse_weight,
                "gel_stiffness": models.gel_stiffness,
                "gel_friction": models.gel_friction,
                "body_friction": models.friction_on_gel,
            },
            num_envs=num_envs,
            timestep=composed.timestep,
            case_travel=_CASE_TRAVEL,
        )
        assert self._contact.views is not None  # they are on the CPU
        self._shear, self._views = self._contact.shear, self._contact.views
        self._mujoco = MujocoRows(
            composed.model,
            self._contact,
            sites=self._site_index,
            bodies=np.concatenate([self._pad_index, self._body_index]),
            geoms=np.array(geoms, int),
            # A model of one's own keeps the contacts that it has.
            hard=is_hard(composed.model) if composed.scene is not None else np.zeros(composed.model.ngeom, bool),
        )
        self._surfaces = PadSurfaces(dict(zip(self._names, self._gels, strict=True)), shapes, num_envs)
        self._reader: StateReader | None = None
        self.report: dict[str, np.ndarray] = {}
        self._added: list[tuple[int, int]] = []

    def reset(self, envs: Sequence[int], datas: Sequence[mujoco.MjData], bodies: Mapping[str, np.ndarray] | None = None) -> None:
        """Forget what environments went through; where bodies start, MuJoCo knows.

        Raises:
            OverlapError: a body starts beyond a pad's bonded face.
        """
        pierced = self._faces.pierced(self._pad_from_body([datas[b] for b in envs]))
        for row, pad, i in np.argwhere(pierced).tolist():
            rule = f"{self.bodies[i].name!r} starts beyond the face that the gel of {self._names[pad]!r} is bonded to"
            raise OverlapError(f"environment {envs[row]}: {rule}")
        self.clear(envs)

    def clear(self, envs: Sequence[int]) -> None:
        """Forget what environments went through."""
        chosen = np.asarray(envs, int)
        self._contact.clear(chosen)
        self._surfaces.reset(chosen)

    def advance(self, datas: Sequence[mujoco.MjData], drive: Drive, failed: np.ndarray) -> None:
        """One control step of all environments; those that break down are marked in ``failed`` (B,) and stand still.

        So are those in which a body goes through a pad all the same.
        """
        scene, ticks = self.composed, self._contact.ticks
        self._bind(datas)
        failed |= lost(datas)
        self._views.before[:] = np.nan
        # No environment waits for those that take shorter steps.
        total, done = ticks * round(scene.control_timestep / scene.timestep), np.zeros(len(datas), int)
        while len(envs := np.flatnonzero(~failed & (done < total))):
            done[envs] += self._step(envs, drive, done[envs] % ticks, failed)
        sound = np.flatnonzero(~failed)
        for b in sound.tolist():
            mujoco.mj_kinematics(self._models[b], datas[b])  # so that poses are those of the end of the step
        if len(sound):
            self._mujoco.choose(sound, 0)
            self._mujoco.move()
            self._mark_pierced(sound)
            self._mark_lost(sound, failed)

    def _step(self, envs: np.ndarray, drive: Drive, done: np.ndarray, failed: np.ndarray) -> np.ndarray:
        """One step of MuJoCo in environments ``envs``, each of its own length; returns the ticks of each, (n,)."""
        self._mujoco.first_half(envs.tolist())
        drive(envs)
        self._insert(envs, done)
        self._mujoco.second_half(envs.tolist(), self.composed.timestep)
        self._finish(envs, failed)
        return self._views.ticks[: len(envs)]

    def add(self, datas: Sequence[mujoco.MjData], failed: np.ndarray) -> np.ndarray:
        """Put the pads' contacts into states that somebody else steps, between ``mj_step1`` and ``mj_step2``, with their controls.

        The result is for ``finish``, after ``mj_step2``. A step is as long as the model's: it is not divided where something moves fast.
        """
        envs = np.flatnonzero(~failed)
        self._bind(datas)
        if len(envs):
            self._insert(envs, 0, whole=True)
            self._mark_lost(envs, failed)
        self._added = self._mujoco.counts(envs.tolist())
        return envs

    def finish(self, datas: Sequence[mujoco.MjData], envs: np.ndarray, failed: np.ndarray) -> None:
        """Read the forces of contacts that ``add`` has put in, and let the gels shear, after ``mj_step2``.

        Raises ``InputError`` if these contacts are gone.
        """
        self._bind(datas)
        if self._mujoco.counts(envs.tolist()) != self._added:
            rule = "must follow the mj_step2 after add: MuJoCo has other contacts now, and those of add are lost; call reset"
            raise InputError("finish", value="after another mj_step1", rule=rule)
        if len(envs):
            self._finish(envs, failed)

    def _bind(self, datas: Sequence[mujoco.MjData]) -> None:
        self._mujoco.bind([self._models[b] for b in range(len(datas))], datas)
        self._mujoco.check_options(self.composed.timestep)

    def _insert(self, envs: np.ndarray, done: np.ndarray | int, *, whole: bool = False) -> None:
        """Put the pads' contacts among MuJoCo's, after ``mj_step1`` and with the controls of the step; ``whole``: it is not divided."""
        self._mujoco.accelerate(envs.tolist())
        self._mujoco.choose(envs, done)
        self._mujoco.begin(whole=whole)
        self._mark_pierced(envs)
        self._mujoco.put(envs.tolist(), own_step=not whole)

    def _mark_pierced(self, envs: np.ndarray) -> None:
        """Mark environments as lost in which a body is beyond a bonded face, or was on its path since the last step."""
        views, count = self._views, len(envs)
        suspects = views.suspect[:count]
        if np.count_nonzero(suspects):
            pierced = self._faces.pierced_on_path(views.poses[:count], views.poses_before[:count], suspects != 0)
            views.lost[:count][pierced.any(axis=(1, 2))] = 1

    def _finish(self, envs: np.ndarray, failed: np.ndarray) -> None:
        """Read forces, and let the gels shear by what bodies moved in the step."""
        self._mujoco.end()
        self._mark_lost(envs, failed)

    def _mark_lost(self, envs: np.ndarray, failed: np.ndarray) -> None:
        """Mark environments that broke down in ``failed`` (B,)."""
        lost = self._views.lost[: len(envs)]
        if np.count_nonzero(lost):
            failed[envs[lost != 0]] = True

    def wrench(self, name: str) -> np.ndarray:
        """Wrench (B, 6) on a pad about its origin, pad frame, in the last step of MuJoCo."""
        return self._views.wrench[:, self._names.index(name)].copy()

    def overlap(self, data: mujoco.MjData) -> list[tuple[str, str, float]]:
        """Sensor, body and depth [m] of every overlap at the present poses; inf for a body beyond a pad's bonded face."""
        poses = self._pad_from_body([data])
        contacts = self._contact.search.contacts(poses, np.zeros(1, int), 0.0)
        depth = np.zeros(poses.shape[1:3])
        depth[contacts.pad, contacts.body] = contacts.depth
        depth[self._faces.pierced(poses)[0]] = np.inf
        return [(self._names[k], self.bodies[i].name, float(depth[k, i])) for k, i in np.argwhere(depth > 0.0).tolist()]

    def reading(
        self, name: str, grid: PadGrid, datas: Sequence[mujoco.MjData], failed: np.ndarray, envs: Sequence[int] | None = None
    ) -> PadReading:
        """Surface and forces of one sensor on the nodes of ``grid``, for the environments named, one row each; None is all."""
        rows, index = np.arange(len(datas)) if envs is None else np.asarray(envs), self._names.index(name)
        if self._reader is None or not self._reader.reads(datas):
            self._reader = StateReader(datas, {"pads": site_pose(self._site_index), "bodies": body_pose(self._body_index)})
        poses, failed = self._reader.values(), failed[rows]
        world_from_pad, world_from_body = poses["pads"][rows], poses["bodies"][rows]
        return self._surfaces.reading(
            name,
            grid,
            inverse(world_from_pad[:, index])[:, None] @ world_from_body,
            self.wrench(name)[rows],
            failed,
            rows,
            press=lambda height: self._gel_pairs.press(index, height, grid, world_from_pad, failed),
            shear=lambda pressed: self._shear.of(rows, index, pressed),
        )

    def _pad_from_body(self, datas: Sequence[mujoco.MjData]) -> np.ndarray:
        """Poses (n, pads, bodies, 4, 4) of bodies in the states given."""
        return inverse(site_poses(datas, self._site_index))[:, :, None] @ body_poses(datas, self._body_index)[:, None]
