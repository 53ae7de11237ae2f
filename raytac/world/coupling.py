"""Two-way coupling of MuJoCo and a contact solver that takes turns: forces that stay stable and passive between the solver's steps.

MuJoCo moves links and bodies, the solver moves gels (and bodies of its own). Once every interval T the solver says which wrench w₀ each
of MuJoCo's bodies bears where it is then. If w₀ were simply held for T, a light finger on a stiff contact would be thrown back and forth:
staggered exchange is stable only while k T² / m is about 1 or less. So within the interval MuJoCo's steps feel

    w = w₀ − K Δ

for every contact between two bodies: Δ is their relative displacement since w₀ was taken, and K is not less than the contact's true
stiffness. At the end the solver says anew what w₀ is, so K has no part in the state that is settled in.

*Passive*: let U be the contact's potential energy, with curvature of at most K. Then −w₀ Δ + ½ Δ K Δ ≥ U(x₀ + Δ) − U(x₀): in each interval
MuJoCo spends at least what the contact stores, whatever T is, and the sum of both energies cannot grow. What K is too large by is lost,
½ Δ (K − k) Δ an interval, like a drag. What a contact stores in the interval in which it is first made is not paid for: with a step h of
MuJoCo between the last state without and the first with contact, that is up to ½ k (v h)².

*Bodies that the solver moves* would be dragged along in the same way if they stood still in this law. So each has a stand-in for the
interval: a rigid body of its mass with its velocity, that feels w₀, gravity, and the other side of each K.

*In time* the law is taken at the end of MuJoCo's step (backward Euler), for all contacts at once, with the inertia of the whole robot: with

    v⁺ = v_free + h M⁻¹ Jᵀ c,    c = −K (Δ + h J v⁺)    follows    (1 + h² K A) c = −K (Δ + h J v_free),    A = J M⁻¹ Jᵀ,

so stiffness times mass ratio sets no limit to h. ``xfrc_applied`` carries w₀ + c.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from raytac.errors import InputError
from raytac.se3 import rotation_vector, rotations

__all__ = ["Coupling", "FreePartner", "Touching"]


@dataclass(frozen=True)
class FreePartner:
    """A body that the solver moves, as it is at the beginning of an interval; world frame."""

    mass: float
    """[kg]."""
    inertia: np.ndarray
    """About its centre of mass [kg m²], (3, 3)."""
    centre: np.ndarray
    """Centre of mass [m], (3,)."""
    velocity: np.ndarray
    """Of the centre of mass [m/s] and about it [rad/s], (6,)."""
    wrench: np.ndarray
    """All that acts on it, gravity too [N], and the torque about the centre of mass [N m], (6,)."""


@dataclass(frozen=True)
class Touching:
    """One contact between two bodies that can move, or one that can and one that stands still."""

    body: int | str
    """A body of MuJoCo's by number, or a ``FreePartner`` by name."""
    stiffness: np.ndarray
    """K (6, 6), symmetric and positive semi-definite, world axes, for displacements [m] and turns [rad] about ``point``."""
    point: np.ndarray
    """Place that K is about [m], world frame, (3,)."""
    other: int | str | None = None
    """The other side: likewise, or None for what stands still."""
    push: np.ndarray | None = None
    """Normal force on ``body`` that w₀ has [N], world frame, (3,): where K would make it pull, the contact opens. None: it never does."""
    wrench: np.ndarray | None = None
    """All that w₀ has of this contact, normal force and friction [N] on ``body`` and their torque about ``point`` [N m], (6,): what an open
    contact takes with it. None: ``push`` alone. It is taken off at the point as it has moved by then, with the torque unchanged: wrong by
    force × way, of second order in an interval."""

    @property
    def released(self) -> np.ndarray:
        """What an open contact takes off w₀, (6,)."""
        if self.wrench is not None:
            return -self.wrench
        return np.concatenate([np.zeros(3) if self.push is None else -self.push, np.zeros(3)])


@dataclass
class _Interval:
    """One environment between two answers of the solver."""

    wrench: np.ndarray
    contacts: Sequence[Touching] = ()
    partners: dict[str, FreePartner] = field(default_factory=dict)
    anchors: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    """Of each contact: its point in the frame of its body and of the other one (or the world)."""
    turns: list[np.ndarray] = field(default_factory=list)
    """Of each contact: rotation of the body as seen from the other one."""
    moved: dict[str, np.ndarray] = field(default_factory=dict)
    """Of each partner: displacement and turn since the beginning, (6,)."""
    speed: dict[str, np.ndarray] = field(default_factory=dict)


class Coupling:
    """What a contact solver does to MuJoCo's bodies between two of its steps.

    .. code-block:: python

        coupling = Coupling(model, [finger_body], num_envs=1)
        coupling.update(data, 0, wrench, contacts)         # after each step of the solver
        for _ in range(10):                                # MuJoCo's steps until the next one
            mujoco.mj_step1(model, data)
            control(data)
            coupling.apply(data, 0)
            mujoco.mj_step2(model, data)
    """

    def __init__(self, model: mujoco.MjModel, bodies: Sequence[int], num_envs: int = 1) -> None:
        """``bodies``: n bodies of the model that the solver acts on.

        Raises:
            InputError: a body that is not the model's, or is named twice.
        """
        wrong = [int(body) for body in bodies if not 0 < body < model.nbody]
        if wrong or len(set(bodies)) < len(bodies):
            raise InputError("bodies", value=list(bodies), rule=f"must be different bodies of the model, 1 to {model.nbody - 1}")
        self.model, self.bodies = model, tuple(int(body) for body in bodies)
        self._intervals = [_Interval(np.zeros((len(bodies), 6))) for _ in range(num_envs)]

    def reset(self, b: int, data: mujoco.MjData | None = None) -> None:
        """No forces in environment ``b``; takes away what ``data`` still holds."""
        self._intervals[b] = _Interval(np.zeros((len(self.bodies), 6)))
        if data is not None:
            data.xfrc_applied[list(self.bodies)] = 0.0

    def update(
        self,
        data: mujoco.MjData,
        b: int,
        wrench: np.ndarray,
        contacts: Sequence[Touching] = (),
        partners: dict[str, FreePartner] | None = None,
    ) -> None:
        """Begin an interval of environment ``b`` with the solver's answer at ``data``'s present poses (after ``mj_kinematics``).

        Args:
            wrench: w₀ on each body [N], [N m] about the body's frame origin, world axes, (n, 6).
            contacts: what K acts between.
            partners: the bodies that ``contacts`` name.

        Raises:
            InputError: a wrench of the wrong shape or not finite, or a contact whose sides are not known.
        """
        if np.shape(wrench) != (len(self.bodies), 6) or not np.isfinite(wrench).all():
            raise InputError(
                "wrench", value=np.asarray(wrench).tolist(), rule=f"must be finite, of shape {(len(self.bodies), 6)}"
            )
        partners = partners or {}
        interval = _Interval(np.array(wrench, float), tuple(contacts), dict(partners))
        for contact in contacts:
            for side in (contact.body, contact.other):
                if isinstance(side, int) and side not in self.bodies:
                    raise InputError("contacts", value=side, rule="must be between bodies that are coupled", choices=self.bodies)
                if isinstance(side, str) and side not in partners:
                    raise InputError("contacts", value=side, rule="must be the name of a partner", choices=partners)
            turn, origin = self._frame(data, interval, contact.body)
            turn2, origin2 = self._frame(data, interval, contact.other)
            interval.anchors.append((turn.T @ (contact.point - origin), turn2.T @ (contact.point - origin2)))
            interval.turns.append(turn2.T @ turn)
        for name, partner in partners.items():
            interval.moved[name], interval.speed[name] = np.zeros(6), partner.velocity.copy()
        self._intervals[b] = interval

    def apply(self, data: mujoco.MjData, b: int) -> None:
        """Write ``xfrc_applied`` for the coming ``mj_step2``; after ``mj_step1`` and with the controls set."""
        interval, model = self._intervals[b], self.model
        held = list(self.bodies)
        data.xfrc_applied[held] = self._at_centre(data, interval.wrench)
        if not interval.contacts:
            return
        h = model.opt.timestep
        mujoco.mj_fwdActuation(model, data)
        mujoco.mj_fwdAcceleration(model, data)
        free = data.qvel + h * data.qacc_smooth
        names = list(interval.partners)
        inertia = [_inertia(partner) for partner in interval.partners.values()]
        free_speed = [
            interval.speed[name] + h * np.linalg.solve(mass, interval.partners[name].wrench)
            for name, mass in zip(names, inertia, strict=True)
        ]
        count = len(interval.contacts)
        jacobian, stand_in = np.zeros((6 * count, model.nv)), np.zeros((6 * count, 6 * len(names)))
        away, stiffness, points = np.zeros(6 * count), np.zeros((6 * count, 6 * count)), []
        for k, contact in enumerate(interval.contacts):
            rows = slice(6 * k, 6 * k + 6)
            points.append(self._point(data, interval, k))
            for side, sign in ((contact.body, 1.0), (contact.other, -1.0)):
                if isinstance(side, int):
                    jacobian[rows] += sign * self._jacobian(data, side, points[-1])
                elif side is not None:
                    at = 6 * names.index(side)
                    stand_in[rows, at : at + 6] += sign * _lever(points[-1] - self._centre(interval, side))
            away[rows] = self._displacement(data, interval, k)
            stiffness[rows, rows] = contact.stiffness
        solved = np.zeros((6 * count, model.nv))
        mujoco.mj_solveM(model, data, solved, jacobian)
        mobility, relative = jacobian @ solved.T, jacobian @ free
        for at, mass in enumerate(inertia):
            block = stand_in[:, 6 * at : 6 * at + 6]
            mobility = mobility + block @ np.linalg.solve(mass, block.T)
            relative = relative + block @ free_speed[at]
        c = _solve(interval.contacts, stiffness, mobility, away, relative, h)
        extra = np.zeros((len(held), 6))
        for k, contact in enumerate(interval.contacts):
            for side, sign in ((contact.body, 1.0), (contact.other, -1.0)):
                if isinstance(side, int):
                    extra[held.index(side)] += sign * _moved_to(c[6 * k : 6 * k + 6], points[k], data.xpos[side])
        data.xfrc_applied[held] = self._at_centre(data, interval.wrench + extra)
        for at, (name, mass) in enumerate(zip(names, inertia, strict=True)):
            interval.speed[name] = free_speed[at] + h * np.linalg.solve(mass, stand_in[:, 6 * at : 6 * at + 6].T @ c)
            interval.moved[name] = interval.moved[name] + h * interval.speed[name]

    def _at_centre(self, data: mujoco.MjData, wrench: np.ndarray) -> np.ndarray:
        """Wrenches (n, 6) about the bodies' origins, as MuJoCo takes them: about their centres of mass."""
        arm = data.xpos[list(self.bodies)] - data.xipos[list(self.bodies)]
        return np.concatenate([wrench[:, :3], wrench[:, 3:] + np.cross(arm, wrench[:, :3])], axis=1)

    @staticmethod
    def _frame(data: mujoco.MjData, interval: _Interval, side: int | str | None) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (3, 3) and origin (3,) of a side as it is now: of a partner, with its own axes along the world's at the beginning."""
        if isinstance(side, int):
            return data.xmat[side].reshape(3, 3), data.xpos[side]
        if side is None:
            return np.eye(3), np.zeros(3)
        moved = interval.moved.get(side, np.zeros(6))
        return rotations(moved[None, 3:])[0], interval.partners[side].centre + moved[:3]

    def _point(self, data: mujoco.MjData, interval: _Interval, k: int) -> np.ndarray:
        turn, origin = self._frame(data, interval, interval.contacts[k].body)
        return origin + turn @ interval.anchors[k][0]

    def _displacement(self, data: mujoco.MjData, interval: _Interval, k: int) -> np.ndarray:
        """Of the body against the other side since the beginning, at the contact's point, world axes (6,)."""
        contact = interval.contacts[k]
        turn, _ = self._frame(data, interval, contact.body)
        turn2, origin2 = self._frame(data, interval, contact.other)
        way = self._point(data, interval, k) - (origin2 + turn2 @ interval.anchors[k][1])
        return np.concatenate([way, turn2 @ rotation_vector(turn2.T @ turn @ interval.turns[k].T)])

    def _jacobian(self, data: mujoco.MjData, body: int, point: np.ndarray) -> np.ndarray:
        found = np.zeros((6, self.model.nv))
        mujoco.mj_jac(self.model, data, found[:3], found[3:], point, body)
        return found

    @staticmethod
    def _centre(interval: _Interval, name: str) -> np.ndarray:
        return interval.partners[name].centre + interval.moved[name][:3]


def _solve(
    contacts: Sequence[Touching], stiffness: np.ndarray, mobility: np.ndarray, away: np.ndarray, relative: np.ndarray, h: float
) -> np.ndarray:
    """c of all contacts, (6 n,): those that would pull open, and lose what w₀ has of them too."""
    closed, fixed = np.ones(len(contacts), bool), np.zeros(6 * len(contacts))
    while True:
        shut = np.repeat(closed, 6)
        rows = stiffness * shut[:, None]
        c = np.linalg.solve(np.eye(len(fixed)) + h * h * rows @ mobility, fixed - rows @ (away + h * relative))
        pulls = [
            bool(closed[k]) and contact.push is not None and float((c[6 * k : 6 * k + 3] + contact.push) @ contact.push) < 0.0
            for k, contact in enumerate(contacts)
        ]
        if not any(pulls):
            return c
        for k in np.flatnonzero(pulls).tolist():
            closed[k] = False
            fixed[6 * k : 6 * k + 6] = contacts[k].released


def _inertia(partner: FreePartner) -> np.ndarray:
    found = np.zeros((6, 6))
    found[:3, :3], found[3:, 3:] = partner.mass * np.eye(3), partner.inertia
    return found


def _lever(arm: np.ndarray) -> np.ndarray:
    """Motion (6, 6) of a point at ``arm`` from the centre of a rigid body, from the body's: v + ω × arm, ω."""
    x, y, z = arm
    found = np.eye(6)
    found[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return found


def _moved_to(wrench: np.ndarray, point: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """A wrench (6,) about ``point``, about ``origin``."""
    return np.concatenate([wrench[:3], wrench[3:] + np.cross(point - origin, wrench[:3])])
