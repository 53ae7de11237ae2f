"""Rows of the contacts of gels in one step in NumPy: oracle of ``row_kernels``, which has the physics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from raytac.physics.rigid.contacts import LoadTables, PadContacts
from raytac.physics.rigid.load_law import shear_stiffness, twist_stiffness
from raytac.specs.sensor import GelpadSpec
from tests.physics.rigid.oracle_motion import PadMotion, cross
from tests.physics.rigid.oracle_shear import ShearOracle
from tests.physics.rigid.oracle_spring import NormalSpring

_EDGE = 0.7
"""Greatest distance of the centre of pressure from the middle of a flat contact over the contact's radius, for its row of tilt."""
ROWS = 6
"""Rows of a contact: normal, two tangents, spin, two of rolling."""
_LEAST = 1e-6
"""Least coefficient of friction, which MuJoCo wants positive."""


@dataclass(frozen=True)
class PadRows:
    """Rows of n contacts of one step."""

    position: np.ndarray
    """Place, world frame [m], (n, 3)."""
    frame: np.ndarray
    """Rows normal from gel to body, and two tangents, world frame, (n, 9)."""
    friction: np.ndarray
    """MuJoCo's coefficients: two tangents, spin [m], rolling about both tangents [m], (n, 5)."""
    force: np.ndarray
    """f₀ [N, N m], (n, 6)."""
    damping: np.ndarray
    """G [N s/m, N m s] of normal and tangents, (n, 2)."""
    step: np.ndarray
    """Δt [s], (n,)."""
    slides: np.ndarray
    """True (n,) where a slide may begin or end in the step."""
    bend: np.ndarray
    """Share of the torque of rolling that builds up per angle about each tangent, (n, 2)."""

    def regularisation(self) -> np.ndarray:
        """R, (n, 6): those of spin and rolling follow from the cone's levers."""
        friction = np.maximum(self.friction, _LEAST)
        result = np.empty((len(self.step), ROWS))
        result[:, 0] = 1.0 / (self.damping[:, 0] * self.step)
        result[:, 1:] = (1.0 / (self.damping[:, 1] * self.step))[:, None] * (friction[:, :1] / friction) ** 2
        return result


def tangents(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit tangents (n, 3) of a gel: along the pad's x as nearly as can be, and that turned by 90° about the normal (n, 3)."""
    first = -normal[:, :1] * normal
    first[:, 0] += 1.0
    first /= np.sqrt(np.vecdot(first, first))[:, None]
    return first, cross(normal, first)


def gel_rows(
    contacts: PadContacts,
    law: LoadTables,
    spring: NormalSpring,
    motion: PadMotion,
    row: np.ndarray,
    step: np.ndarray,
    *,
    shear: ShearOracle,
    gels: Sequence[GelpadSpec],
    softer: np.ndarray,
    friction: np.ndarray,
    mass_centre: np.ndarray,
    gain: np.ndarray,
    compliance: np.ndarray,
    rolling: np.ndarray,
) -> tuple[PadRows, np.ndarray]:
    """Rows of n contacts, and the matrices (n, 2, 2) from their tangents to the pad's (``tangents``).

    Args:
        contacts, law, spring: the contacts, their load laws and normal springs.
        motion: of bodies relative to pads; ``row`` (n,): row of each contact's environment in it.
        step: Δt [s], (n,).
        shear: state of the contacts, which the step begins with.
        gels: of the pads.
        softer: factors of the gels' moduli, (n,).
        friction: Coulomb's coefficients, (n,).
        mass_centre: of what is touched, in its frame [m], (bodies, 3).
        gain: free acceleration of the body over the gel where they touch, and its angular one, pad frame, (n, 6).
        compliance: 1/m of both bodies [1/kg], (n,).
        rolling: torques of rolling over their bounds, about the pad's tangents, (n, 2).
    """
    at = contacts.env, contacts.pad, contacts.body
    deepest = np.maximum(spring.deepest, 0.0)
    radius, load = law.radius(deepest), law.force(deepest)[0]
    stiffness = np.ones((len(contacts), 2))
    hysteresis = np.zeros(len(contacts))
    for k, gel in enumerate(gels):
        some = contacts.pad == k
        size = radius[some]
        stiffness[some] = np.stack([shear_stiffness(size, gel), twist_stiffness(size, gel)], axis=1)
        hysteresis[some] = gel.hysteresis
    stiffness = np.maximum(stiffness * softer[:, None], 1e-12)
    pull = shear.begin(at, stiffness, contacts.centre)
    moving = _Moving.of(contacts, spring, motion, row)
    slip_lever, limit = slip_levers(radius), friction * moving.load
    slip = np.append(moving.slip(), moving.turning()[:, None], axis=1) * step[:, None]
    sticks = shear.share_that_sticks(at, slip, np.stack([limit, limit * slip_lever], axis=1))
    ratio = stiffness[:, 1] / stiffness[:, 0]
    lever = np.where(sticks > 0.0, np.sqrt(ratio), slip_lever)
    damping = step * stiffness[:, 0] * np.where(sticks > 0.0, np.maximum(sticks, 0.5), np.maximum(ratio / slip_lever**2, 1.0))
    spread, height, turn = _tilt(contacts, motion, row, mass_centre)
    metacentric = np.maximum(spread - height[:, None], 0.0)
    # Of the load under which the contact would stick: MuJoCo's cone cuts tilt and rolling as it cuts friction.
    held_load = np.maximum(load, _trial(moving, lever, damping, pull) / np.maximum(friction, 1e-6))
    per_square = (held_load * step / damping)[:, None]
    tilt = friction[:, None] * np.sqrt(per_square * metacentric)
    # The cone must not cut this row before the centre of pressure is near the edge.
    tilt = np.maximum(tilt, _EDGE * radius[:, None] * metacentric / (metacentric + np.abs(height)[:, None] + 1e-9))
    arm = np.minimum(spread, np.abs(height)[:, None])
    plastic = 3.0 / 16.0 * hysteresis[:, None]
    whole = np.maximum(tilt, friction[:, None] * np.sqrt(per_square * (metacentric + 8.0 * plastic * arm)))
    whole = np.maximum(whole, 4.0 * plastic * radius[:, None])
    force = np.zeros((len(contacts), ROWS))
    lift, slides = _lift(moving, spring, step, friction, lever, damping, pull, gain, compliance)
    force[:, 0] = spring.force - lift
    force[:, 1:3] = -(pull[:, None, :2] @ turn)[:, 0]
    force[:, 3] = -pull[:, 2]
    axes = row_axes(contacts.normal, turn)
    spin = (axes[:, 1:] @ motion.spin[at_rows(contacts, row)][..., None])[..., 0]
    bend = 8.0 * arm / np.maximum(radius, 1e-6)[:, None]
    share = rolled_on((rolling[:, None] @ turn)[:, 0], step[:, None] * bend * spin)
    force[:, 4:] = (damping / friction**2)[:, None] * (whole**2 - tilt**2) * spin - plastic * (radius * held_load)[
        :, None
    ] * share * arm / np.maximum(spread, 1e-6)
    rotation, origin = motion.world_from_pad[row, contacts.pad, :3, :3], motion.world_from_pad[row, contacts.pad, :3, 3]
    return PadRows(
        (rotation @ contacts.centre[..., None])[..., 0] + origin,
        (axes @ np.swapaxes(rotation, 1, 2)).reshape(-1, 9),
        np.stack([friction, friction, friction * lever, whole[:, 0], whole[:, 1]], axis=1),
        force,
        np.stack([spring.damping, damping], axis=1),
        step,
        slides,
        bend,
    ), turn


def at_rows(contacts: PadContacts, row: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Entries of contacts in the arrays of motion."""
    return row, contacts.pad, contacts.body


def rolled_on(share: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Torques (n, 2) of rolling over their bounds after rotations (n, 2), over the angle in which they build up: Dahl's law."""
    size = np.linalg.norm(angle, axis=1)[:, None]
    along = angle / np.maximum(size, 1e-30)
    return along + np.exp(-size) * (share - along)


def row_axes(normal: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Normal (n, 3) and tangents of rows, which ``turn`` (n, 2, 2) brings to the pad's, as rows of matrices (n, 3, 3)."""
    first, second = tangents(normal)
    one = turn[:, :1, 0] * first + turn[:, 1:, 0] * second
    return np.stack([normal, one, cross(normal, one)], axis=1)


@dataclass(frozen=True)
class _Moving:
    """Motion of bodies over gels where they touch, pad frame, and the load [N], at the start of the step."""

    velocity: np.ndarray
    spin: np.ndarray
    normal: np.ndarray
    load: np.ndarray

    @staticmethod
    def of(contacts: PadContacts, spring: NormalSpring, motion: PadMotion, row: np.ndarray) -> _Moving:
        at = row, contacts.pad, contacts.body
        velocity = motion.velocity[at] + cross(motion.spin[at], contacts.centre - motion.pad_from_body[at][:, :3, 3])
        load = np.maximum(spring.force + spring.damping * -np.vecdot(velocity, contacts.normal), 0.0)
        return _Moving(velocity, motion.spin[at], contacts.normal, load)

    def after(self, gain: np.ndarray) -> _Moving:
        return _Moving(self.velocity + gain[:, :3], self.spin + gain[:, 3:], self.normal, self.load)

    def slip(self) -> np.ndarray:
        """Speeds (n, 2) along both tangents."""
        return np.stack([np.vecdot(self.velocity, tangent) for tangent in tangents(self.normal)], axis=1)

    def turning(self) -> np.ndarray:
        """Speeds (n,) about the normal."""
        return np.vecdot(self.spin, self.normal)


def slip_levers(radius: np.ndarray) -> np.ndarray:
    """Torque over force [m] at which contacts slip."""
    return 3.0 * np.pi / 16.0 * np.maximum(radius, 1e-6)


def _trial(moving: _Moving, lever: np.ndarray, damping: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """Friction (n,) of contacts without a bound, the torque about the normal over ``lever`` among it."""
    tangential = pull[:, :2] + damping[:, None] * moving.slip()
    torque = pull[:, 2] / lever + damping * moving.turning() * lever
    return np.sqrt(np.vecdot(tangential, tangential) + torque**2)


def _lift(
    moving: _Moving,
    spring: NormalSpring,
    step: np.ndarray,
    friction: np.ndarray,
    lever: np.ndarray,
    damping: np.ndarray,
    pull: np.ndarray,
    gain: np.ndarray,
    compliance: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Normal force (n,) that MuJoCo's convex cone adds to contacts that slip, at the speed at the start of the step; and whether the
    free acceleration changes it by more than a hundredth of the load.

    Beyond the cone, the force without it, (F, T), is projected to F + μ r (T − μF) / (1 + μ² r) with r the ratio of the dampings.
    """

    def excess(moving: _Moving, share: np.ndarray) -> np.ndarray:
        over = _trial(moving, lever, damping, pull) - share * friction * moving.load
        return np.where(spring.force > 0.0, friction * spring.damping / damping * np.maximum(over, 0.0), 0.0)

    lift = excess(moving, np.ones_like(step))
    free = excess(moving.after(step[:, None] * gain), 1.0 + damping * step * compliance)
    return lift, np.abs(free - lift) > 0.01 * np.maximum(spring.force, 0.0)


def _tilt(
    contacts: PadContacts, motion: PadMotion, row: np.ndarray, mass_centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Spreads (n, 2) [m] for rotations about two principal tangents, the height of the centre of mass (n,), and these
    tangents by the pad's, (n, 2, 2).

    The centre of pressure of a body that turns about its centre of mass moves by the spread of the overlap per radian, less the
    height of that centre over the gel: by nothing at all for a ball.
    """
    pose = motion.pad_from_body[row, contacts.pad, contacts.body]
    middle = (pose[:, :3, :3] @ mass_centre[contacts.body][..., None])[..., 0] + pose[:, :3, 3]
    height = np.vecdot(middle - contacts.centre, contacts.normal)
    xx, xy, yy = contacts.spread.T
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    mean, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.stack([np.stack([cos, -sin], axis=1), np.stack([sin, cos], axis=1)], axis=1)
    # A rotation about one tangent moves the centre along the other.
    spread = np.maximum(np.stack([mean - half, mean + half], axis=1), 0.0)
    return spread, height, turn
