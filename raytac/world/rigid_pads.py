"""Rigid pads in a MuJoCo world: contact by geometry and load law, as in a press, handed to MuJoCo as one compliant contact a body.

MuJoCo's own collision would meet the gel with a convex hull of what touches it and with a number of points that sets the stiffness. Here
contact is found as ``RigidPad`` finds it: from the overlap of the resting gel with the body's underside. Of that overlap, seen as an
elastic foundation, one contact is made and put among MuJoCo's own:

- depth δ: the greatest overlap;
- place: the overlap's centroid, so that a flat face that tilts is pushed back by the edge that sinks in;
- normal: the gel's there. Its line goes through the centre of a ball wherever on the dome the ball lies;
- stiffness: F(δ) / δ of the load law of this body at this place, by ``solref`` in direct form;
- friction: Coulomb's; about the normal 3π/16 μ a with a the contact's radius (Hertz contact that slips as a whole, as in a press); against
  rolling 3/16 α a (J. A. Greenwood, H. Minshall, D. Tabor, Hysteresis losses in rolling and sliding friction, Proc. R. Soc. A 259,
  1961) with α the share of energy that the gel loses.

MuJoCo's friction is a rate law: the gel's shear stiffness is not in it, a pad carries a tangential force without shearing first.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module names its types at run time.)

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from raytac.gel.elastic import ElasticSurround
from raytac.gel.object_height import object_bounds, object_height
from raytac.gel.surface import GelSurface, PadGrid
from raytac.gel.traction import foundation_traction
from raytac.physics.load_law import LoadLaw
from raytac.physics.pad_reading import PadReading
from raytac.robots.mount import MountedSensor
from raytac.robots.pose import pose, world_from_site
from raytac.specs.sensor import SensorSpec
from raytac.world.compose import ComposedBody, ComposedScene
from raytac.world.pad_overlap import PadOverlap, Touch
from raytac.world.state import Controller, is_lost

__all__ = ["RigidPads"]

_HYSTERESIS = 0.1
"""α, share of the energy that the gel loses in a cycle: a guess; silicone elastomers lose some per cent to some tens of per cent."""
_RATE = 0.2
"""Greatest ω Δt of a contact: ω = √s with s the direct form's stiffness. What the true contact has beyond it is taken off by the
impedance d, which keeps the force at rest: K = s / ((1 − d) A)."""
_SLIP_RATE = 0.5
"""Rate at which friction takes away sliding, per step of MuJoCo."""


class _Pad:
    """One sensor's pad: where contact is looked for, and where it is shown."""

    def __init__(self, mounted: MountedSensor, spec: SensorSpec, model: mujoco.MjModel) -> None:
        self.mounted, self.spec = mounted, spec
        self.site, self.body = int(model.site(mounted.site).id), int(model.body(mounted.body).id)
        self.gel = int(model.geom(mounted.gel).id)
        self.overlap = PadOverlap(spec.gelpad)
        self.highest = self.overlap.highest
        self.reach = 0.5 * np.asarray(spec.gelpad.size)


class RigidPads:
    """All pads of a world, B environments; MuJoCo moves every body."""

    def __init__(self, composed: ComposedScene, num_envs: int) -> None:
        self.composed, self.model = composed, composed.model
        self.pads = {
            mounted.name: _Pad(mounted, spec, composed.model)
            for mounted, spec in zip(composed.sensors, composed.sensor_specs, strict=True)
        }
        self.bodies = tuple(composed.bodies.values())
        self._radius = [_radius(body) for body in self.bodies]
        self._geom = [int(composed.model.body_geomadr[body.index]) for body in self.bodies]
        # A body's friction against gel; None is the gel's own.
        self._friction = [body.spec.friction_on_gel for body in self.bodies]
        self._wrench = {name: np.zeros((num_envs, 6)) for name in self.pads}
        self._laws: list[dict[tuple[str, int], LoadLaw]] = [{} for _ in range(num_envs)]
        self._pressed = {name: np.full(num_envs, -1) for name in self.pads}
        """Body that each pad showed deepest last; −1: none."""
        self._contact = mujoco.MjContact()
        self._force = np.empty(6)
        self._shown: dict[str, tuple[PadGrid, ElasticSurround]] = {}
        self.report: dict[str, np.ndarray] = {}

    def reset(self, envs: Sequence[int], datas: Sequence[mujoco.MjData], bodies: Mapping[str, np.ndarray] | None = None) -> None:
        """Forget what environments went through; where bodies start, MuJoCo knows."""
        for b in envs:
            self._laws[b] = {}
            for wrench, pressed in zip(self._wrench.values(), self._pressed.values(), strict=True):
                wrench[b], pressed[b] = 0.0, -1

    def advance(self, datas: Sequence[mujoco.MjData], controllers: Sequence[Controller], failed: np.ndarray) -> None:
        """One control step of all environments; those that break down are marked in ``failed`` (B,) and stand still."""
        scene = self.composed.scene
        for b, (data, controller) in enumerate(zip(datas, controllers, strict=True)):
            if failed[b]:
                continue
            self._laws[b] = {}  # they hold while bodies hardly roll or slide on the pad, so once a control step
            for _ in range(round(scene.control_timestep / scene.timestep)):
                touching = self._step(data, b, controller)
                if touching is None:
                    failed[b] = True
                    break
            else:
                assert touching is not None
                self._read_forces(data, b, touching)
                mujoco.mj_kinematics(self.model, data)  # so that poses are those of the end of the step

    def _step(self, data: mujoco.MjData, b: int, control: Controller) -> list[tuple[str, int]] | None:
        """One step of MuJoCo with the pads' contacts, which are returned: sensor and index of the contact; None where it breaks down."""
        model = self.model
        mujoco.mj_step1(model, data)
        touching = self._add_contacts(data, b)
        if touching is None:
            return None
        if touching:
            # The contacts come after MuJoCo's own collision, so what it has built on those is built again.
            mujoco.mj_makeConstraint(model, data)
            mujoco.mj_island(model, data)
            mujoco.mj_projectConstraint(model, data)
            mujoco.mj_referenceConstraint(model, data)
        control(data, float(data.time))
        mujoco.mj_step2(model, data)
        return None if is_lost(data) else touching

    def wrench(self, name: str) -> np.ndarray:
        """Wrench (B, 6) on a pad about its origin, pad frame, in the last step of MuJoCo."""
        return self._wrench[name].copy()

    def overlap(self, data: mujoco.MjData) -> list[tuple[str, str, float]]:
        """Sensor, body and depth [m] of every overlap at the present poses."""
        found = []
        for name, pad in self.pads.items():
            for i, body in enumerate(self.bodies):
                touch = self._touch(data, pad, i)
                if touch is not None:
                    found.append((name, body.spec.name, touch.depth))
        return found

    def reading(self, name: str, grid: PadGrid, datas: Sequence[mujoco.MjData], failed: np.ndarray) -> PadReading:
        """Surface and forces of one sensor on the nodes of ``grid``, for all environments."""
        pad = self.pads[name]
        if name not in self._shown or self._shown[name][0] is not grid:
            self._shown[name] = grid, ElasticSurround(grid)
        height = np.full((len(datas), *grid.shape), np.inf)
        poses = np.full((len(datas), 4, 4), np.nan)
        highest = float(grid.rest.max())
        for b, data in enumerate(datas):
            if failed[b]:
                height[b] = np.nan
                continue
            world_from_pad = world_from_site(data, pad.site)
            deepest, pressed = 0.0, -1
            for i, body in enumerate(self.bodies):
                pad_from_body = _relative(world_from_pad, data, body.index)
                if not self._is_near(pad, pad_from_body, i):
                    continue
                under = object_height(body.parts, pad_from_body[None], grid.x, grid.y, below=highest)[0]
                depth = float((grid.rest - under).max())
                if depth > deepest:
                    deepest, pressed, poses[b] = depth, i, pad_from_body
                np.minimum(height[b], under, out=height[b])
            # From one body to another is no motion of either.
            if pressed != self._pressed[name][b] and self._pressed[name][b] >= 0:
                poses[b] = np.nan
            self._pressed[name][b] = pressed
        surface = self._shown[name][1].surface(height, poses)
        wrench = np.where(failed[:, None], np.nan, self._wrench[name])
        return PadReading(surface, wrench, failed.copy(), lambda: _traction(surface, wrench))

    def _is_near(self, pad: _Pad, pad_from_body: np.ndarray, i: int) -> bool:
        radius, at = self._radius[i], pad_from_body[:3, 3]
        if self.bodies[i].spec.kind == "plane":
            # The plane reaches the pad's box where its lowest corner along the plane's normal lies below it.
            normal = pad_from_body[:3, 2]
            return bool(normal[2] * pad.highest - np.abs(normal[:2]) @ pad.reach < normal @ at)
        return bool(at[2] - radius < pad.highest and (np.abs(at[:2]) - radius < pad.reach).all())

    def _touch(self, data: mujoco.MjData, pad: _Pad, i: int) -> Touch | None:
        pad_from_body = _relative(world_from_site(data, pad.site), data, self.bodies[i].index)
        near = self._is_near(pad, pad_from_body, i)
        return pad.overlap.touch(self.bodies[i].parts, pad_from_body, self._radius[i]) if near else None

    def _add_contacts(self, data: mujoco.MjData, b: int) -> list[tuple[str, int]] | None:
        """Put the pads' contacts among MuJoCo's; returns (sensor, index of the contact), None if its memory for contacts is full."""
        found, model = [], self.model
        for name, pad in self.pads.items():
            for i, body in enumerate(self.bodies):
                compliance = float(model.body_invweight0[pad.body, 0] + model.body_invweight0[body.index, 0])
                if compliance <= 0.0:
                    continue  # neither moves
                touch = self._touch(data, pad, i)
                if touch is None:
                    continue
                law = self._laws[b].get((name, i))
                if law is None:
                    law = self._laws[b][name, i] = pad.overlap.law(touch)
                self._fill(data, pad, i, touch, law, compliance)
                if mujoco.mj_addContact(model, data, self._contact) != 0:
                    return None
                found.append((name, int(data.ncon) - 1))
        return found

    def _fill(self, data: mujoco.MjData, pad: _Pad, i: int, touch: Touch, law: LoadLaw, compliance: float) -> None:
        """The contact between a pad and a body, from gel to body.

        A contact of the direct form, stiffness s, impedance d, on a compliance A (MuJoCo's estimate of J M⁻¹ Jᵀ) is at rest a spring of
        K = s / ((1 − d) A): see ``contact_solref``.
        """
        contact, step = self._contact, float(self.model.opt.timestep)
        rotation = data.site_xmat[pad.site].reshape(3, 3)
        normal = rotation @ touch.normal
        contact.frame[:] = _frame(normal, rotation[:, 0])
        contact.pos[:] = rotation @ touch.centre + data.site_xpos[pad.site]
        contact.dist, contact.includemargin, contact.dim, contact.exclude = -touch.depth, 0.0, 6, 0
        natural = law.secant_stiffness(touch.depth) * compliance
        loss = min(max((_RATE / step) ** 2 / natural, 1e-3), 0.5)  # 1 − d
        stiffness = natural * loss
        contact.solimp[:] = 1.0 - loss, 1.0 - loss, 1e-3, 0.5, 2.0
        contact.solref[:] = -stiffness, -2.0 * stiffness**0.5
        contact.solreffriction[:] = 0.0, -_SLIP_RATE / step
        friction, radius = self._friction[i], law.contact_radius(touch.depth)
        friction = pad.spec.gelpad.friction if friction is None else friction
        least = 1e-6  # MuJoCo wants them positive
        rolling = max(3.0 / 16.0 * _HYSTERESIS * radius, least)
        spin = max(3.0 * np.pi / 16.0 * friction * radius, least)
        contact.friction[:] = max(friction, least), max(friction, least), spin, rolling, rolling
        contact.geom1, contact.geom2 = pad.gel, self._geom[i]
        contact.geom[:] = pad.gel, self._geom[i]
        contact.flex[:] = contact.elem[:] = contact.vert[:] = -1

    def _read_forces(self, data: mujoco.MjData, b: int, touching: list[tuple[str, int]]) -> None:
        for wrench in self._wrench.values():
            wrench[b] = 0.0
        for name, index in touching:
            mujoco.mj_contactForce(self.model, data, index, self._force)
            contact = data.contact[index]
            to_world = contact.frame.reshape(3, 3).T
            # MuJoCo's force is on the second body; the pad gets the opposite.
            force, torque = -to_world @ self._force[:3], -to_world @ self._force[3:]
            site = self.pads[name].site
            # Place and force are of the start of this step, the site's too until the next step's kinematics.
            rotation, origin = data.site_xmat[site].reshape(3, 3), data.site_xpos[site]
            torque = torque + _cross(contact.pos - origin, force)
            self._wrench[name][b] += np.concatenate([force @ rotation, torque @ rotation])


def _radius(body: ComposedBody) -> float:
    """Of a ball about the body's origin that holds it [m]; inf for a half-space."""
    low, high = object_bounds(body.parts, np.eye(4))
    return float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high))))


def _relative(world_from_pad: np.ndarray, data: mujoco.MjData, body: int) -> np.ndarray:
    """``pad_from_body`` (4, 4)."""
    back = world_from_pad[:3, :3].T
    return pose(back @ data.xmat[body].reshape(3, 3), back @ (data.xpos[body] - world_from_pad[:3, 3]))


def _frame(normal: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Rows of a right-handed frame whose first is ``normal`` and whose second is near ``along``, (9,)."""
    second = along - (along @ normal) * normal
    second = second / math.sqrt(second @ second)
    return np.concatenate([normal, second, _cross(normal, second)])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a × b of two vectors; NumPy's own takes twenty times as long for one pair."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _traction(surface: GelSurface, wrench: np.ndarray) -> np.ndarray:
    """The pads' totals shared out over their contacts (see ``foundation_traction``)."""
    x, y = np.nan_to_num(surface.contact_centre).T
    twist = wrench[:, 5] - (x * wrench[:, 1] - y * wrench[:, 0])
    return foundation_traction(surface, wrench[:, :3], twist)
