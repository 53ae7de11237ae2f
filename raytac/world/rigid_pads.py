"""Rigid pads in a MuJoCo world: contact by geometry and load law, as in a press, given to MuJoCo as one contact a body.

MuJoCo's own collision uses a convex hull of the body, and its number of contact points sets the stiffness. Here contact is computed as in
``RigidPad``, from the overlap of the resting gel with the body's underside (``PadSearch``):

- place and normal: the overlap's centroid, and the resting gel's normal there. Its line goes through the centre of a ball anywhere on
  the dome;
- normal force: the load law of this body at this place, as an implicit spring (``normal_spring``);
- friction: the gel shears first and slips from the edge of the contact inwards (``ShearState``), within Coulomb's cone; torsional 3π/16 μ a
  with a the contact's radius (Hertz contact that slips as a whole, as in a press); rolling 3/16 α a (J. A. Greenwood, H. Minshall, D.
  Tabor, Hysteresis losses in rolling and sliding friction, Proc. R. Soc. A 259, 1961) with α the gel's hysteresis.

All environments step together: in every step of MuJoCo their contacts are computed at once, and MuJoCo is called for one after the other.
Where something moves fast near a pad, that environment takes shorter steps (``StepChoice``), each half as long as the scene's, a quarter …
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from raytac.errors import InputError, OverlapError
from raytac.gel.surface import PadGrid
from raytac.physics.base import PadReading
from raytac.physics.rigid.contacts import LoadTables, PadContacts
from raytac.physics.rigid.implicit_spring import NormalSpring, contact_rate, normal_spring
from raytac.physics.rigid.search import PadSearch
from raytac.physics.rigid.shear import ShearState
from raytac.robots.frames import body_poses, site_poses
from raytac.shapes.underside import object_radius
from raytac.world.environment_models import EnvironmentModels
from raytac.world.forbidden_overlap import BondedFaces
from raytac.world.gel_pairs import GelPairs
from raytac.world.gel_rows import gel_rows, row_axes
from raytac.world.hard_contacts import is_hard, write_hard_reference
from raytac.world.near_pads import half_spaces
from raytac.world.pad_motion import PadMotion, motion_of, relative, turned
from raytac.world.pad_rows import PadRows, cross, read_rows, write_rows
from raytac.world.pad_steps import StepChoice
from raytac.world.pad_surfaces import PadSurfaces
from raytac.world.world_model import WorldModel
from raytac.world.world_state import Drive, lost


@dataclass(frozen=True)
class _Put:
    """Contacts of one step that are among MuJoCo's."""

    contacts: PadContacts
    radius: np.ndarray
    """Of contact [m], (n,)."""
    rows: PadRows
    turn: np.ndarray
    """Matrices (n, 2, 2) from the rows' tangents to the pad's."""
    speed: np.ndarray
    """At which they close [m/s], (n,)."""
    pose: np.ndarray
    """``pad_from_body`` (n, 4, 4) at the beginning of the step."""


class RigidPads:
    """All pads of a world, B environments; MuJoCo moves every body."""

    soft = None
    meshes: tuple[str, ...] = ()

    def __init__(self, composed: WorldModel, models: EnvironmentModels, datas: Sequence[mujoco.MjData], **_: object) -> None:
        """Pads of ``composed``; ``models``, ``datas``: MuJoCo's of every environment. Coupling and device do not matter here.

        Raises:
            InputError: the model has pyramidal friction cones, or a noslip pass, which would undo the gel's shear.
        """
        num_envs, option = len(datas), composed.model.opt
        if option.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
            raise InputError("option.cone", value="pyramidal", rule="must be elliptic with rigid pads", choices=("elliptic",))
        if option.noslip_iterations:
            rule = "must be 0 with rigid pads: the gel sticks by its shear, which a noslip pass would undo"
            raise InputError("option.noslip_iterations", value=int(option.noslip_iterations), rule=rule)
        self.composed, self.model, self._models = composed, composed.model, models
        self._names = [mounted.name for mounted in composed.sensors]
        self.bodies = composed.touched
        self._count = len(self.bodies)
        self._body_index = np.array([body.index for body in self.bodies], int)
        self._site_index = np.array([composed.model.site(mounted.site).id for mounted in composed.sensors], int)
        self._pad_index = np.array([composed.model.body(mounted.body).id for mounted in composed.sensors], int)
        self._gels = tuple(spec.gelpad for spec in composed.sensor_specs)
        shapes = [body.parts for body in self.bodies]
        self._planes, self._faces = half_spaces(shapes)[0], BondedFaces(self._gels, shapes)
        self._radius = np.array([object_radius(body.parts) for body in self.bodies])
        self._gel_geom = np.array([composed.model.geom(mounted.gel).id for mounted in composed.sensors], int)
        # What pads may touch: the bodies, then the gels of the pads.
        self._touched = np.concatenate([self._body_index, self._pad_index])
        geoms = [body.geoms[0] for body in self.bodies]
        self._geom = np.concatenate([np.array(geoms, int), self._gel_geom])
        self._mass_centre = composed.model.body_ipos[self._touched]
        self._gel_pairs = GelPairs(self._gels, self._pad_index, num_envs)
        cases = [int(composed.model.geom(mounted.case).id) for mounted in composed.sensors]
        self._case_centre, self._case_half = composed.model.geom_pos[cases], composed.model.geom_size[cases]
        # A model of one's own keeps the contacts that it has.
        self._hard = is_hard(composed.model) if composed.scene is not None else np.zeros(composed.model.ngeom, bool)
        self._fall = float(np.linalg.norm(option.gravity))
        self._search = PadSearch(self._gels, shapes, num_envs=num_envs)
        self._wrench = np.zeros((num_envs, len(self._names), 6))
        self._shear = ShearState(num_envs, len(self._names), len(self._touched))
        self._acceleration = np.zeros((num_envs, len(self._names), len(self._touched)))
        """At which contacts closed faster in their last step [m/s²]."""
        self._surfaces = PadSurfaces(dict(zip(self._names, self._gels, strict=True)), shapes, num_envs)
        self.report: dict[str, np.ndarray] = {}

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
        self._shear.clear(chosen)
        self._wrench[chosen] = self._acceleration[chosen] = 0.0
        self._surfaces.reset(chosen)

    def advance(self, datas: Sequence[mujoco.MjData], drive: Drive, failed: np.ndarray) -> None:
        """One control step of all environments; those that break down are marked in ``failed`` (B,) and stand still.

        So are those in which a body goes through a pad all the same.
        """
        scene = self.composed
        before = self.no_poses(len(datas))
        for _ in range(round(scene.control_timestep / scene.timestep)):
            choice, done = StepChoice(scene.timestep), np.zeros(len(datas), int)
            while len(envs := np.flatnonzero(~failed & (done < choice.ticks))):
                done[envs] += self._step(datas, envs, drive, choice, done[envs], before, failed)
        sound = np.flatnonzero(~failed)
        for b in sound.tolist():
            mujoco.mj_kinematics(self._models[b], datas[b])  # so that poses are those of the end of the step
        if len(sound):
            self._faces.mark(self._pad_from_body([datas[b] for b in sound.tolist()]), sound, before, failed)

    def _step(
        self,
        datas: Sequence[mujoco.MjData],
        envs: np.ndarray,
        drive: Drive,
        choice: StepChoice,
        done: np.ndarray,
        before: np.ndarray,
        failed: np.ndarray,
    ) -> np.ndarray:
        """One step of MuJoCo in environments ``envs``, each of its own length; returns the ticks of each, (n,)."""
        models, some = self._models, [datas[b] for b in envs.tolist()]
        for b, data in zip(envs.tolist(), some, strict=True):
            mujoco.mj_step1(models[b], data)
        put, ticks, step = self._insert(datas, envs, choice, done, before, failed)
        sound = envs[~failed[envs]]
        if len(sound):
            drive(sound)
        for b, length in zip(envs.tolist(), step.tolist(), strict=True):
            if failed[b]:
                continue
            models[b].opt.timestep = length
            mujoco.mj_step2(models[b], datas[b])
            models[b].opt.timestep = choice.timestep
        if len(sound):
            failed[sound] = lost([datas[b] for b in sound.tolist()])
        self._after(datas, envs, put, failed)
        return ticks

    def add(self, datas: Sequence[mujoco.MjData], before: np.ndarray, failed: np.ndarray) -> _Put:
        """Put the pads' contacts into states that somebody else steps, between ``mj_step1`` and ``mj_step2``.

        ``before``: ``pad_from_body`` as this method left it the last time, ``no_poses`` at first. The result is for ``finish``, after
        ``mj_step2``. A step is as long as the model's: it is not divided where something moves fast.
        """
        envs, choice = np.flatnonzero(~failed), StepChoice(self.composed.timestep)
        put, _, _ = self._insert(datas, envs, choice, np.zeros(len(envs), int), before, failed, whole=True)
        return put

    def finish(self, datas: Sequence[mujoco.MjData], put: _Put, failed: np.ndarray) -> None:
        """Read the forces of contacts that ``add`` has put in, and let the gels shear, after ``mj_step2``."""
        sound = np.flatnonzero(~failed)
        if len(sound):
            failed[sound] = lost([datas[b] for b in sound.tolist()])
        self._after(datas, sound, put, failed)

    def _insert(
        self,
        datas: Sequence[mujoco.MjData],
        envs: np.ndarray,
        choice: StepChoice,
        done: np.ndarray,
        before: np.ndarray,
        failed: np.ndarray,
        *,
        whole: bool = False,
    ) -> tuple[_Put, np.ndarray, np.ndarray]:
        """Put the pads' contacts among MuJoCo's, after ``mj_step1``; returns also the ticks and the length [s] of each step, (n,)."""
        models, some = self._models, [datas[b] for b in envs.tolist()]
        motion = motion_of(self.model, some, self._site_index, self._pad_index, self._body_index)
        self._faces.mark(motion.pad_from_body[:, :, : self._count], envs, before, failed)
        left = choice.timestep * (1.0 - done / choice.ticks)
        contacts = self._contacts(motion, envs, left)
        # What has no law has gone through the gel, as two gels that overlap by more than one of them.
        failed[contacts.env[np.isnan(contacts.deepest)]] = True
        row = np.searchsorted(envs, contacts.env)
        compliance = models.inverse_weight[contacts.env]
        at = np.arange(len(contacts))
        compliance = compliance[at, self._pad_index[contacts.pad]] + compliance[at, self._touched[contacts.body]]
        movable = (compliance > 0.0) & ~failed[contacts.env]  # where the compliance is 0 neither moves
        contacts, row, compliance = contacts.of(movable), row[movable], compliance[movable]
        speed = motion.closing(contacts, row)
        law = self._law(contacts)
        longest = np.minimum(self._beside_cases(choice, motion), choice.timestep)
        self._in_gels(choice, longest, contacts, row, compliance, speed, law, left)
        ticks = np.full(len(envs), choice.ticks) if whole else choice.rounded(longest, done)
        step = choice.timestep * ticks / choice.ticks
        tau = np.array([gel.relaxation_time for gel in self._gels])[contacts.pad]
        spring = normal_spring(law, contacts.depth, speed, compliance, step[row], tau, self._fall)
        held = spring.damping > 0.0
        contacts, row, speed = contacts.of(held), row[held], speed[held]
        spring = NormalSpring(spring.force[held], spring.damping[held], spring.deepest[held])
        law = self._law(contacts)
        self._forget_apart(envs, contacts)
        rows, turn = gel_rows(
            contacts,
            law,
            spring,
            motion,
            row,
            step[row],
            shear=self._shear,
            gels=self._gels,
            softer=self._softer(contacts),
            friction=self._friction(contacts),
            mass_centre=self._mass_centre,
        )
        geoms = np.stack([self._gel_geom[contacts.pad], self._geom[contacts.body]], axis=1)
        write_rows(models, datas, rows, contacts.env, geoms, failed)
        own = np.bincount(contacts.env, minlength=len(datas))
        for b, length in zip(envs.tolist(), step.tolist(), strict=True):
            count = datas[b].ncon - int(own[b])
            if count and not failed[b]:
                write_hard_reference(datas[b], self._hard, count, length)
        pose = motion.pad_from_body[row, contacts.pad, contacts.body]
        return _Put(contacts, law.radius(np.maximum(spring.deepest, 0.0)), rows, turn, speed, pose), ticks, step

    def _contacts(self, motion: PadMotion, envs: np.ndarray, left: np.ndarray) -> PadContacts:
        """Contacts of bodies and gels with pads, or what may come near them in the time ``left`` (n,) [s]."""
        bodies = self._search.contacts(motion.pad_from_body[:, :, : self._count], envs, self._reach(motion, left))
        reach = np.linalg.norm(motion.velocity[:, :, self._count :], axis=-1) * left[:, None, None]
        gels = self._gel_pairs.contacts(motion.pad_from_body[:, :, self._count :], envs, reach, self._count)
        return PadContacts.joined([bodies, *gels]) if gels else bodies

    def _reach(self, motion: PadMotion, left: np.ndarray) -> np.ndarray:
        """Distance (n, pads) [m] that the fastest body may come nearer to each pad in the time ``left`` (n,) [s]."""
        if not len(self.bodies):
            return np.zeros(motion.world_from_pad.shape[:2])
        return motion.greatest_speed(self._radius).max(axis=2) * left[:, None] + self._fall * left[:, None] ** 2

    def _law(self, contacts: PadContacts) -> LoadTables:
        return LoadTables(contacts, self._thickness(contacts), self._softer(contacts))

    def _thickness(self, contacts: PadContacts) -> np.ndarray:
        """Thickness (n,) [m] of the gel, or of both gels."""
        return self._gel_pairs.thickness(contacts, self._count)

    def _softer(self, contacts: PadContacts) -> np.ndarray:
        """Factors (n,) of the modulus of the pad's gel; with that of the other gel in series."""
        return self._gel_pairs.factor(contacts, self._count, self._models.gel_stiffness)

    def _beside_cases(self, choice: StepChoice, motion: PadMotion) -> np.ndarray:
        """Longest steps (n,) [s] in which no body's bounding ball enters a case far."""
        if not self._count:
            return np.full(len(motion.velocity), np.inf)
        apart = np.abs(motion.pad_from_body[:, :, : self._count, :3, 3] - self._case_centre[:, None]) - self._case_half[:, None]
        gap = np.linalg.norm(np.maximum(apart, 0.0), axis=-1) - self._radius
        longest = choice.beside_case(gap, motion.greatest_speed(self._radius))
        longest[..., self._planes] = np.inf
        return longest.min(axis=(1, 2))

    def _in_gels(
        self,
        choice: StepChoice,
        longest: np.ndarray,
        contacts: PadContacts,
        row: np.ndarray,
        compliance: np.ndarray,
        speed: np.ndarray,
        law: LoadTables,
        left: np.ndarray,
    ) -> None:
        """Shorten the ``longest`` steps (n,) [s] of environments to those that their contacts with gels allow."""
        thickness = self._thickness(contacts)
        deeper = contacts.depth + np.minimum(np.maximum(speed, 0.0) * left[row], 0.025 * thickness)
        _, stiffness = law.force(deeper)
        rate = contact_rate(stiffness, compliance)
        acceleration = self._acceleration[contacts.env, contacts.pad, contacts.body]
        np.minimum.at(longest, row, choice.longest(contacts.depth, speed, rate, acceleration, thickness))

    def _friction(self, contacts: PadContacts) -> np.ndarray:
        """Coefficients (n,) of friction: the body's own against gel, else the gel's."""
        models = self._models
        own = np.append(models.friction_on_gel, np.full_like(models.gel_friction, np.nan), axis=1)[contacts.env, contacts.body]
        return np.where(np.isnan(own), models.gel_friction[contacts.env, contacts.pad], own)

    def _forget_apart(self, envs: np.ndarray, contacts: PadContacts) -> None:
        """Clear the shear of contacts that have ended."""
        apart = np.zeros(self._acceleration.shape, bool)
        apart[envs] = True
        apart[contacts.env, contacts.pad, contacts.body] = False
        apart &= self._shear.stiffness[..., 0] > 0.0
        if apart.any():
            self._shear.clear(*np.nonzero(apart))
        self._acceleration[apart] = 0.0

    def _after(
        self,
        datas: Sequence[mujoco.MjData],
        envs: np.ndarray,
        put: _Put,
        failed: np.ndarray,
    ) -> None:
        """Read forces and let the gels shear by what bodies moved in the step."""
        contacts, rows, turn = put.contacts, put.rows, put.turn
        self._wrench[envs] = 0.0
        force, moved = read_rows(self._models, datas, contacts.env, failed)
        at = contacts.env, contacts.pad, contacts.body
        displacement = np.empty((len(contacts), 3))
        displacement[:, :2] = (turn @ moved[:, 1:3, None])[..., 0] * rows.step[:, None]
        displacement[:, 2] = moved[:, 3] * rows.step
        limit = force[:, :1] * rows.friction[:, [0, 2]]
        self._shear.move(at, displacement, limit, contacts.centre, put.radius)
        self._acceleration[at] = (-moved[:, 0] - put.speed) / rows.step
        axes = row_axes(contacts.normal, turn)
        # MuJoCo's force is on the second body; the pad gets the opposite.
        push = -(force[:, None, :3] @ axes)[:, 0]
        torque = -(force[:, None, 3:] @ axes)[:, 0] + cross(contacts.centre, push)
        np.add.at(self._wrench, (contacts.env, contacts.pad), np.concatenate([push, torque], axis=1))
        gel = np.flatnonzero(contacts.body >= self._count)
        if len(gel):
            # The other gel feels the opposite, about its own origin.
            pose = put.pose[gel]
            torque = -torque[gel] + cross(pose[:, :3, 3], push[gel])
            opposite = np.concatenate([turned(-push[gel], pose[:, :3, :3]), turned(torque, pose[:, :3, :3])], axis=1)
            np.add.at(self._wrench, (contacts.env[gel], contacts.body[gel] - self._count), opposite)

    def wrench(self, name: str) -> np.ndarray:
        """Wrench (B, 6) on a pad about its origin, pad frame, in the last step of MuJoCo."""
        return self._wrench[:, self._names.index(name)].copy()

    def overlap(self, data: mujoco.MjData) -> list[tuple[str, str, float]]:
        """Sensor, body and depth [m] of every overlap at the present poses; inf for a body beyond a pad's bonded face."""
        poses = self._pad_from_body([data])
        contacts = self._search.contacts(poses, np.zeros(1, int), 0.0)
        depth = np.zeros(poses.shape[1:3])
        depth[contacts.pad, contacts.body] = contacts.depth
        depth[self._faces.pierced(poses)[0]] = np.inf
        return [(self._names[k], self.bodies[i].name, float(depth[k, i])) for k, i in np.argwhere(depth > 0.0).tolist()]

    def reading(
        self, name: str, grid: PadGrid, datas: Sequence[mujoco.MjData], failed: np.ndarray, envs: Sequence[int] | None = None
    ) -> PadReading:
        """Surface and forces of one sensor on the nodes of ``grid``, for the environments named, one row each; None is all."""
        rows, index = np.arange(len(datas)) if envs is None else np.asarray(envs), self._names.index(name)
        some, failed = [datas[b] for b in rows.tolist()], failed[rows]
        world_from_pad = site_poses(some, self._site_index)
        return self._surfaces.reading(
            name,
            grid,
            relative(world_from_pad[:, index, None], body_poses(some, self._body_index)),
            self.wrench(name)[rows],
            failed,
            rows,
            press=lambda height: self._gel_pairs.press(index, height, grid, world_from_pad, failed),
            shear=lambda pressed: self._shear.of(rows, index, pressed),
        )

    def no_poses(self, num_envs: int) -> np.ndarray:
        """Poses that are not known: NaN, (B, pads, bodies, 4, 4)."""
        return np.full((num_envs, len(self._names), self._count, 4, 4), np.nan)

    def _pad_from_body(self, datas: Sequence[mujoco.MjData]) -> np.ndarray:
        """Poses (n, pads, bodies, 4, 4) of bodies in the states given."""
        return relative(site_poses(datas, self._site_index)[:, :, None], body_poses(datas, self._body_index)[:, None])
