"""Rigid pads in a MuJoCo world: contact by geometry and load law, as in a press, given to MuJoCo as one compliant contact a body.

MuJoCo's own collision uses a convex hull of the body, and its number of contact points sets the stiffness. Here contact is computed as in
``RigidPad``, from the overlap of the resting gel with the body's underside. That overlap, as an elastic foundation, gives one contact
among MuJoCo's own:

- depth δ: the greatest overlap;
- position: the overlap's centroid, so that a tilted flat face is pushed back at the edge that is deepest;
- normal: that of the gel at this position. Its line goes through the centre of a ball anywhere on the dome;
- stiffness: F(δ) / δ of the load law of this body at this place, by ``solref`` in direct form;
- friction: Coulomb's; torsional 3π/16 μ a with a the contact's radius (Hertz contact that slips as a whole, as in a press); rolling
  3/16 α a (J. A. Greenwood, H. Minshall, D. Tabor, Hysteresis losses in rolling and sliding friction, Proc. R. Soc. A 259,
  1961) with α the share of energy that the gel loses.

MuJoCo's friction is a rate law: the gel's shear stiffness is not in it, a pad carries a tangential force without shearing first.

All environments step together: in every step of MuJoCo their contacts are computed at once, and MuJoCo is called for one after the other,
since its share of the time is small (docs/rl.md, Speed).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from raytac.errors import OverlapError
from raytac.gel.pierced import without_pierced
from raytac.gel.pyramid import ElasticSurround
from raytac.gel.surface import GelSurface, PadGrid
from raytac.gel.traction import foundation_traction
from raytac.physics.base import PadReading
from raytac.physics.rigid.load_law import LoadLaw
from raytac.robots.frames import body_poses, site_poses
from raytac.robots.mount import MountedSensor
from raytac.shapes.underside import object_height, object_radius
from raytac.specs.sensor import SensorSpec
from raytac.world.environment_models import EnvironmentModels
from raytac.world.forbidden_overlap import BondedFace
from raytac.world.pad_overlap import PadOverlap, Touches
from raytac.world.world_model import WorldModel
from raytac.world.world_state import Drive, lost

__all__ = ["RigidPads"]

_HYSTERESIS = 0.1
"""α, share of the energy that the gel loses in a cycle: a guess; silicone elastomers lose some per cent to some tens of per cent."""
_RATE = 0.2
"""Greatest ω Δt of a contact: ω = √s with s the direct form's stiffness. A stiffer contact gets a smaller impedance d, which keeps the
force at rest: K = s / ((1 − d) A)."""
_SLIP_RATE = 0.5
"""Rate at which friction takes away sliding, per step of MuJoCo."""

_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])
"""Axes of a cross product; NumPy's own takes ten times as long for one pair."""


class _Pad:
    """Pad of one sensor, with the geometry of its contact search."""

    def __init__(self, mounted: MountedSensor, spec: SensorSpec, model: mujoco.MjModel) -> None:
        self.mounted, self.spec = mounted, spec
        self.site, self.body = int(model.site(mounted.site).id), int(model.body(mounted.body).id)
        self.gel = int(model.geom(mounted.gel).id)
        self.overlap, self.face = PadOverlap(spec.gelpad), BondedFace(spec.gelpad)
        self.highest = self.overlap.highest
        self.reach = 0.5 * np.asarray(spec.gelpad.size)


_PadPoses = tuple[str, _Pad, np.ndarray, np.ndarray]
"""A pad with ``world_from_pad`` (n, 4, 4) and ``pad_from_body`` (n, bodies, 4, 4)."""


@dataclass(frozen=True)
class _Contact:
    """Contact of a pad among MuJoCo's."""

    env: int
    sensor: str
    index: int


class RigidPads:
    """All pads of a world, B environments; MuJoCo moves every body."""

    soft = None
    meshes: tuple[str, ...] = ()

    def __init__(self, composed: WorldModel, models: EnvironmentModels, datas: Sequence[mujoco.MjData], **_: object) -> None:
        """Pads of ``composed``; ``models``, ``datas``: MuJoCo's of every environment. Coupling and device do not matter here."""
        num_envs = len(datas)
        self.composed, self.model, self._models = composed, composed.model, models
        self.pads = {
            mounted.name: _Pad(mounted, spec, composed.model)
            for mounted, spec in zip(composed.sensors, composed.sensor_specs, strict=True)
        }
        self.bodies = composed.touched
        self._body_index = np.array([body.index for body in self.bodies], int)
        self._site_index = np.array([pad.site for pad in self.pads.values()], int)
        self._planes = np.flatnonzero([body.is_plane for body in self.bodies])
        frames = [body.parts[0].object_from_part if body.is_plane else np.eye(4) for body in self.bodies]
        self._frame = np.array(frames).reshape(-1, 4, 4)
        """Pose of a half-space in its body's frame; the identity of all else."""
        self._radius = np.array([object_radius(body.parts) for body in self.bodies])
        self._geom = [body.geoms[0] for body in self.bodies]
        self._wrench = {name: np.zeros((num_envs, 6)) for name in self.pads}
        self._laws: list[dict[tuple[str, int], tuple[LoadLaw, float]]] = [{} for _ in range(num_envs)]
        """By sensor and body, and the depth [m] up to which each is known."""
        self._pressed = {name: np.full(num_envs, -1) for name in self.pads}
        """Body that each pad showed deepest last; −1: none."""
        self._forms = {(name, i): self._form(name, i) for name in self.pads for i in range(len(self.bodies))}
        self._shown: dict[str, tuple[PadGrid, ElasticSurround, float]] = {}
        self.report: dict[str, np.ndarray] = {}

    def reset(self, envs: Sequence[int], datas: Sequence[mujoco.MjData], bodies: Mapping[str, np.ndarray] | None = None) -> None:
        """Forget what environments went through; where bodies start, MuJoCo knows.

        Raises:
            OverlapError: a body starts beyond a pad's bonded face.
        """
        for sensor, pad, _, pad_from_body in self._poses([datas[b] for b in envs]):
            for row, i in np.argwhere(self._pierced(pad, pad_from_body)).tolist():
                rule = f"{self.bodies[i].name!r} starts beyond the face that the gel of {sensor!r} is bonded to"
                raise OverlapError(f"environment {envs[row]}: {rule}")
        for b in envs:
            self._laws[b] = {}
            for wrench, pressed in zip(self._wrench.values(), self._pressed.values(), strict=True):
                wrench[b], pressed[b] = 0.0, -1

    def advance(self, datas: Sequence[mujoco.MjData], drive: Drive, failed: np.ndarray) -> None:
        """One control step of all environments; those that break down are marked in ``failed`` (B,) and stand still.

        So are those in which a body goes through a pad: its contact, a spring, gives way to what is too fast or too heavy for it.
        """
        models = self._models
        before = {name: np.full((len(datas), len(self.bodies), 4, 4), np.nan) for name in self.pads}
        sound, touching = np.flatnonzero(~failed), []
        for b in sound.tolist():
            self._laws[b] = {}  # they hold while bodies hardly roll or slide on the pad, so once a control step
        for _ in range(round(self.composed.control_timestep / self.composed.timestep)):
            if not len(sound):
                break
            for b in sound.tolist():
                mujoco.mj_step1(models[b], datas[b])
            poses = list(self._poses([datas[b] for b in sound.tolist()]))
            self._mark_pierced(poses, sound, before, failed)
            touching = self._add_contacts(poses, datas, sound, failed)
            sound = sound[~failed[sound]]
            if not len(sound):
                break
            for b in sorted({contact.env for contact in touching if not failed[contact.env]}):
                # The contacts come after MuJoCo's own collision, so what it has built on those is built again.
                mujoco.mj_makeConstraint(models[b], datas[b])
                mujoco.mj_island(models[b], datas[b])
                mujoco.mj_projectConstraint(models[b], datas[b])
                mujoco.mj_referenceConstraint(models[b], datas[b])
            drive(sound)
            for b in sound.tolist():
                mujoco.mj_step2(models[b], datas[b])
            failed[sound] = lost([datas[b] for b in sound.tolist()])
            sound = sound[~failed[sound]]
        self._read_forces(datas, sound, [contact for contact in touching if not failed[contact.env]])
        for b in sound.tolist():
            mujoco.mj_kinematics(models[b], datas[b])  # so that poses are those of the end of the step
        if len(sound):
            self._mark_pierced(list(self._poses([datas[b] for b in sound.tolist()])), sound, before, failed)

    def wrench(self, name: str) -> np.ndarray:
        """Wrench (B, 6) on a pad about its origin, pad frame, in the last step of MuJoCo."""
        return self._wrench[name].copy()

    def overlap(self, data: mujoco.MjData) -> list[tuple[str, str, float]]:
        """Sensor, body and depth [m] of every overlap at the present poses; inf for a body beyond a pad's bonded face."""
        overlaps = []
        for name, pad, _, pad_from_body in self._poses([data]):
            near = self._near(pad, pad_from_body)
            for i in np.flatnonzero(near[0]).tolist():
                if pad.face.pierced(self.bodies[i].parts, pad_from_body[:, i], float(self._radius[i]))[0]:
                    overlaps.append((name, self.bodies[i].name, np.inf))
                    continue
                touches = pad.overlap.touches(self.bodies[i].parts, pad_from_body[:, i], float(self._radius[i]))
                overlaps += [(name, self.bodies[i].name, float(depth)) for depth in touches.depth]
        return overlaps

    def reading(
        self, name: str, grid: PadGrid, datas: Sequence[mujoco.MjData], failed: np.ndarray, envs: Sequence[int] | None = None
    ) -> PadReading:
        """Surface and forces of one sensor on the nodes of ``grid``, for the environments named, one row each; None is all."""
        pad, rows = self.pads[name], np.arange(len(datas)) if envs is None else np.asarray(envs)
        datas, failed = [datas[b] for b in rows.tolist()], failed[rows]
        if name not in self._shown or self._shown[name][0] is not grid:
            self._shown[name] = grid, ElasticSurround(grid), float(grid.rest.max())
        height = np.full((len(datas), *grid.shape), np.inf)
        poses = np.full((len(datas), 4, 4), np.nan)
        deepest, pressed = np.zeros(len(datas)), np.full(len(datas), -1)
        highest = self._shown[name][2]
        pad_from_body = _relative(site_poses(datas, pad.site)[:, None], body_poses(datas, self._body_index))
        near = self._near(pad, pad_from_body) & ~failed[:, None]
        for i in np.flatnonzero(near.any(axis=0)).tolist():
            rows_near = np.flatnonzero(near[:, i])
            under = object_height(self.bodies[i].parts, pad_from_body[rows_near, i], grid.x, grid.y, below=highest)
            behind = under < -pad.spec.gelpad.thickness
            if behind.any():
                deep = np.flatnonzero(behind.any(axis=(1, 2)))
                deep = deep[pad.face.pierced(self.bodies[i].parts, pad_from_body[rows_near[deep], i], float(self._radius[i]))]
                under[behind] = np.inf
                under[deep] = np.nan
            depth = (grid.rest - under).max(axis=(1, 2))
            deeper = depth > deepest[rows_near]
            at = rows_near[deeper]
            deepest[at], pressed[at], poses[at] = depth[deeper], i, pad_from_body[at, i]
            if len(rows_near) == len(datas):
                height = np.minimum(height, under, out=under)
            else:
                height[rows_near] = np.minimum(height[rows_near], under)
        height[failed] = np.nan
        # From one body to another is no motion of either.
        before = self._pressed[name][rows]
        poses[(pressed != before) & (before >= 0) & ~failed] = np.nan
        self._pressed[name][rows] = np.where(failed, before, pressed)
        surface = without_pierced(self._shown[name][1].surface(height, poses), pad.spec.gelpad)
        failed = np.isnan(surface.height[:, 0, 0])
        wrench = np.where(failed[:, None], np.nan, self._wrench[name][rows])
        return PadReading(surface, wrench, failed, lambda surface: _traction(surface, wrench))

    def _poses(self, datas: Sequence[mujoco.MjData]) -> Iterator[_PadPoses]:
        """Every pad with ``world_from_pad`` (n, 4, 4) and ``pad_from_body`` (n, bodies, 4, 4) of the states given."""
        world_from_pad, world_from_body = site_poses(datas, self._site_index), body_poses(datas, self._body_index)
        for k, (name, pad) in enumerate(self.pads.items()):
            yield name, pad, world_from_pad[:, k], _relative(world_from_pad[:, k, None], world_from_body)

    def _near(self, pad: _Pad, pad_from_body: np.ndarray) -> np.ndarray:
        """True (n, bodies) where bodies at poses (n, bodies, 4, 4) may reach the pad's box."""
        at, radius = pad_from_body[..., :3, 3], self._radius
        near = (at[..., 2] - radius < pad.highest) & (np.abs(at[..., :2]) - radius[:, None] < pad.reach).all(axis=-1)
        if len(self._planes):
            # A plane reaches the pad's box where its lowest corner along the plane's normal lies below it.
            planes = pad_from_body[:, self._planes] @ self._frame[self._planes]
            normal, at = planes[..., :3, 2], planes[..., :3, 3]
            lowest = normal[..., 2] * pad.highest - np.abs(normal[..., :2]) @ pad.reach
            near[:, self._planes] = lowest < np.vecdot(normal, at)
        return near

    def _pierced(self, pad: _Pad, pad_from_body: np.ndarray) -> np.ndarray:
        """True (n, bodies) where bodies at poses (n, bodies, 4, 4) lie beyond the pad's bonded face."""
        result = self._near(pad, pad_from_body)
        for i, body in enumerate(self.bodies):
            rows = np.flatnonzero(result[:, i])
            if len(rows):
                result[rows, i] = pad.face.pierced(body.parts, pad_from_body[rows, i], float(self._radius[i]))
        return result

    def _mark_pierced(
        self, poses: Sequence[_PadPoses], envs: np.ndarray, before: dict[str, np.ndarray], failed: np.ndarray
    ) -> None:
        """Mark environments in which a body is beyond a pad's bonded face, or was on the path from ``before``, which is renewed."""
        for name, pad, _, pad_from_body in poses:
            was, beyond = before[name][envs], self._pierced(pad, pad_from_body)
            before[name][envs] = pad_from_body
            for i, body in enumerate(self.bodies):
                radius, now, pierced = float(self._radius[i]), pad_from_body[:, i], beyond[:, i]
                pieces = pad.face.pieces(was[:, i] @ self._frame[i], now @ self._frame[i], radius)
                for row in np.flatnonzero(pieces > 1).tolist():
                    path = pad.face.poses_between(was[row, i], now[row], int(pieces[row]))
                    path = path[self._near(pad, np.repeat(path[:, None], len(self.bodies), axis=1))[:, i]]
                    pierced[row] |= pad.face.pierced(body.parts, path, radius).any()
                failed[envs[pierced]] = True

    def _add_contacts(
        self, poses: Sequence[_PadPoses], datas: Sequence[mujoco.MjData], envs: np.ndarray, failed: np.ndarray
    ) -> list[_Contact]:
        """Put the pads' contacts among MuJoCo's; marks environments whose memory for contacts is full."""
        contacts, models = [], self._models
        weight = models.inverse_weight[envs]
        for sensor, (name, pad, world_from_pad, pad_from_body) in enumerate(poses):
            compliance = weight[:, pad.body, None] + weight[:, self._body_index]
            # Where the compliance is 0 neither moves.
            near = self._near(pad, pad_from_body) & (compliance > 0.0) & ~failed[envs][:, None]
            for i in np.flatnonzero(near.any(axis=0)).tolist():
                rows = np.flatnonzero(near[:, i])
                touches = pad.overlap.touches(self.bodies[i].parts, pad_from_body[rows, i], float(self._radius[i]))
                if not len(touches.env):
                    continue
                rows = rows[touches.env]
                rotation, origin = world_from_pad[rows, :3, :3], world_from_pad[rows, :3, 3]
                frames = _frames((rotation @ touches.normal[..., None])[..., 0], rotation[..., 0])
                places = (rotation @ touches.centre[..., None])[..., 0] + origin
                contact = self._forms[name, i]
                for k, (row, b) in enumerate(zip(rows.tolist(), envs[rows].tolist(), strict=True)):
                    contact.frame[:], contact.pos[:] = frames[k], places[k]
                    friction = float(models.friction_on_gel[b, i])
                    if np.isnan(friction):
                        friction = float(models.gel_friction[b, sensor])
                    depth, softer = float(touches.depth[k]), float(models.gel_stiffness[b, sensor])
                    law = self._law(b, name, i, touches, k)
                    self._load(contact, depth, law, softer, float(compliance[row, i]), friction)
                    if mujoco.mj_addContact(models[b], datas[b], contact) != 0:
                        failed[b] = True
                    else:
                        contacts.append(_Contact(b, name, int(datas[b].ncon) - 1))
        return contacts

    def _law(self, env: int, name: str, i: int, touches: Touches, k: int) -> LoadLaw:
        """Load law of a pad and a body, the k-th in contact; reused within a control step while it covers the depth."""
        known = self._laws[env].get((name, i))
        if known is None or touches.depth[k] > known[1]:
            known = self._laws[env][name, i] = self.pads[name].overlap.law(touches, k), touches.known_depth(k)
        return known[0]

    def _form(self, name: str, i: int) -> mujoco.MjContact:
        """Common part of all contacts between a pad and a body."""
        contact, gel = mujoco.MjContact(), self.pads[name].gel
        contact.includemargin, contact.dim, contact.exclude = 0.0, 6, 0
        contact.solreffriction[:] = 0.0, -_SLIP_RATE / float(self.model.opt.timestep)
        contact.geom1, contact.geom2 = gel, self._geom[i]
        contact.geom[:] = gel, self._geom[i]
        contact.flex[:] = contact.elem[:] = contact.vert[:] = -1
        return contact

    def _load(
        self, contact: mujoco.MjContact, depth: float, law: LoadLaw, factor: float, compliance: float, friction: float
    ) -> None:
        """Stiffness and friction of a contact, from gel to body; ``factor`` of the modulus, to which the law is proportional.

        A contact of the direct form, stiffness s, impedance d, on a compliance A (MuJoCo's estimate of J M⁻¹ Jᵀ) is at rest a spring of
        K = s / ((1 − d) A): see ``contact_solref``.
        """
        contact.dist = -depth
        natural = factor * law.secant_stiffness(depth) * compliance
        loss = min(max((_RATE / float(self.model.opt.timestep)) ** 2 / natural, 1e-3), 0.5)  # 1 − d
        stiffness = natural * loss
        contact.solimp[:] = 1.0 - loss, 1.0 - loss, 1e-3, 0.5, 2.0
        contact.solref[:] = -stiffness, -2.0 * stiffness**0.5
        radius = law.contact_radius(depth)
        least = 1e-6  # MuJoCo wants them positive
        rolling = max(3.0 / 16.0 * _HYSTERESIS * radius, least)
        spin = max(3.0 * np.pi / 16.0 * friction * radius, least)
        contact.friction[:] = max(friction, least), max(friction, least), spin, rolling, rolling

    def _read_forces(self, datas: Sequence[mujoco.MjData], envs: np.ndarray, touching: Sequence[_Contact]) -> None:
        for wrench in self._wrench.values():
            wrench[envs] = 0.0
        local = np.empty(6)
        for one in touching:
            data = datas[one.env]
            mujoco.mj_contactForce(self._models[one.env], data, one.index, local)
            contact = data.contact[one.index]
            to_world = contact.frame.reshape(3, 3).T
            # MuJoCo's force is on the second body; the pad gets the opposite.
            force, torque = -to_world @ local[:3], -to_world @ local[3:]
            site = self.pads[one.sensor].site
            # Place and force are of the start of this step, the site's too until the next step's kinematics.
            rotation, origin = data.site_xmat[site].reshape(3, 3), data.site_xpos[site]
            arm = contact.pos - origin
            torque = torque + arm[_NEXT] * force[_AFTER] - arm[_AFTER] * force[_NEXT]
            self._wrench[one.sensor][one.env] += np.concatenate([force @ rotation, torque @ rotation])


def _relative(world_from_pad: np.ndarray, world_from_body: np.ndarray) -> np.ndarray:
    """``pad_from_body`` (…, 4, 4) of poses that broadcast to the latter's shape."""
    away = world_from_body.copy()
    away[..., :3, 3] -= world_from_pad[..., :3, 3]
    back = np.swapaxes(world_from_pad[..., :3, :3], -1, -2)
    away[..., :3, :] = back @ away[..., :3, :]
    return away


def _frames(normal: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Rows of right-handed frames whose first is ``normal`` (n, 3) and whose second is near ``along``, (n, 9)."""
    second = along - np.vecdot(along, normal)[:, None] * normal
    second /= np.sqrt(np.vecdot(second, second))[:, None]
    third = normal[:, _NEXT] * second[:, _AFTER] - normal[:, _AFTER] * second[:, _NEXT]
    return np.concatenate([normal, second, third], axis=1)


def _traction(surface: GelSurface, wrench: np.ndarray) -> np.ndarray:
    """Total forces of the pads distributed over their contacts (see ``foundation_traction``)."""
    x, y = np.nan_to_num(surface.contact_centre).T
    twist = wrench[:, 5] - (x * wrench[:, 1] - y * wrench[:, 0])
    return foundation_traction(surface, wrench[:, :3], twist)
