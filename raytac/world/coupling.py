"""Two-way coupling of MuJoCo and a contact solver by forces that stay stable and passive.

MuJoCo moves links and bodies, the solver moves gels (and bodies of its own). Once every interval T the solver computes the wrench w₀ on
each of MuJoCo's bodies at its present pose. If w₀ were constant over T, a light finger on a stiff contact would oscillate: staggered
exchange is stable only while k T² / m is about 1 or less. So within the interval MuJoCo's steps apply

    w = w₀ − K Δ

for every contact between two bodies: Δ is their relative displacement since w₀ was computed, and K is not less than the contact's true
stiffness. At the end the solver computes w₀ again, so that K has no part in a state at rest.

*Passive*: let U be the contact's potential energy, with curvature of at most K. Then −w₀ Δ + ½ Δ K Δ ≥ U(x₀ + Δ) − U(x₀): in each
interval MuJoCo spends at least the energy that the contact stores, whatever T is, and the sum of both energies cannot grow. The excess of
K over the true stiffness k dissipates ½ Δ (K − k) Δ an interval, like a drag. The energy of a contact in the interval in which it begins
is not balanced: with a step h of MuJoCo between the last state without and the first with contact, that is up to ½ k (v h)².

*Bodies that the solver moves* would be dragged along in the same way if they stood still in this law. So each is represented for the
interval by a rigid body of its mass and velocity, on which w₀, gravity and the other side of each K act.

*In time* the law is taken at the end of MuJoCo's step (backward Euler), for all contacts at once, with the inertia of the whole robot:
with

    v⁺ = v_free + h M⁻¹ Jᵀ c,    c = −K (Δ + h J v⁺)    follows    (1 + h² K A) c = −K (Δ + h J v_free),    A = J M⁻¹ Jᵀ,

so stiffness times mass ratio sets no limit to h. ``xfrc_applied`` carries w₀ + c.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from raytac.errors import InputError
from raytac.se3 import rotation_vector, rotations, shifted_wrench

if TYPE_CHECKING:
    from raytac.physics.soft.scene import SoftScene

STIFFENING = 2.0
"""Stiffness assumed of a bonded soft body over that at rest.

It stiffens as it is stretched, twisted or sheared (docs/coupling.md)."""
_HARD = 2e5
"""Stiffness of contact between bodies without gel [N/m]: a gel's whole face (a guess)."""


@dataclass(frozen=True)
class SolverBody:
    """Body that the solver moves, at the beginning of an interval; world frame."""

    mass: float
    """Mass [kg]."""
    inertia: np.ndarray
    """Inertia about the centre of mass [kg m²], (3, 3)."""
    centre: np.ndarray
    """Centre of mass [m], (3,)."""
    velocity: np.ndarray
    """Velocity of the centre of mass [m/s] and angular velocity [rad/s], (6,)."""
    wrench: np.ndarray
    """Sum of forces, with gravity [N], and of torques about the centre of mass [N m], (6,)."""


@dataclass(frozen=True)
class CoupledContact:
    """One contact between two bodies, of which at least one can move."""

    body: int | str
    """Body of MuJoCo by its number, or a ``SolverBody`` by its name."""
    stiffness: np.ndarray
    """K (6, 6), symmetric and positive semi-definite, about ``point``, world axes.

    It is for displacements [m] and rotations [rad]."""
    point: np.ndarray
    """Reference point of K [m], world frame, (3,)."""
    other: int | str | None = None
    """The other side, likewise; None: it stands still."""
    normal_force: np.ndarray | None = None
    """Normal force on ``body`` in w₀ [N], world frame, (3,); opens below 0; None: never opens."""
    wrench: np.ndarray | None = None
    """Share of this contact in w₀ [N], [N m], (6,); None: ``normal_force`` alone.

    Normal force and friction on ``body`` and their torque about ``point``. It vanishes when the contact opens. It is removed at the
    displaced point with the torque unchanged: the error is force × displacement, of second order in an interval."""

    @property
    def released(self) -> np.ndarray:
        """Change of w₀ when the contact opens, (6,)."""
        if self.wrench is not None:
            return -self.wrench
        return np.concatenate([np.zeros(3) if self.normal_force is None else -self.normal_force, np.zeros(3)])


CouplingInput = tuple[np.ndarray, list[CoupledContact], dict[str, SolverBody]]
"""Wrenches (n, 6), contacts and solver bodies of one environment, for ``Coupling.update``."""


@dataclass
class _Interval:
    """One environment between two steps of the solver."""

    wrench: np.ndarray
    contacts: Sequence[CoupledContact] = ()
    solver_bodies: dict[str, SolverBody] = field(default_factory=dict)
    anchors: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=list)
    """Point of each contact in its body and the other (or the world), and relative rotation."""
    displacement: dict[str, np.ndarray] = field(default_factory=dict)
    """Displacement and rotation of each solver body since the beginning, (6,)."""
    speed: dict[str, np.ndarray] = field(default_factory=dict)
    """Velocity of each solver body, (6,)."""


class Coupling:
    """Wrenches of a contact solver on MuJoCo's bodies between two of its steps.

    .. code-block:: python

        coupling = Coupling(model, [finger_body], num_envs=1)
        coupling.update(data, 0, wrench, contacts)         # after each step of the solver
        for _ in range(10):                                # MuJoCo's steps until the solver's next one
            mujoco.mj_step1(model, data)
            control(data)
            coupling.apply(data, 0)
            mujoco.mj_step2(model, data)
    """

    def __init__(self, model: mujoco.MjModel, bodies: Sequence[int], num_envs: int = 1) -> None:
        """``bodies``: n different bodies of the model that the solver acts on; else ``InputError``."""
        wrong = [int(body) for body in bodies if not 0 < body < model.nbody]
        if wrong or len(set(bodies)) < len(bodies):
            raise InputError("bodies", value=list(bodies), rule=f"must be different bodies of the model, 1 to {model.nbody - 1}")
        self.model, self.bodies = model, tuple(int(body) for body in bodies)
        self._intervals = [_Interval(np.zeros((len(bodies), 6))) for _ in range(num_envs)]

    def reset(self, b: int, data: mujoco.MjData | None = None) -> None:
        """Remove all forces from environment ``b``, and from ``data`` if given."""
        self._intervals[b] = _Interval(np.zeros((len(self.bodies), 6)))
        if data is not None:
            data.xfrc_applied[list(self.bodies)] = 0.0

    def update(
        self,
        data: mujoco.MjData,
        b: int,
        wrench: np.ndarray,
        contacts: Sequence[CoupledContact] = (),
        solver_bodies: dict[str, SolverBody] | None = None,
    ) -> None:
        """Begin an interval of environment ``b`` at ``data``'s present poses.

        It comes after ``mj_kinematics``, with the solver's result.

        Args:
            wrench: w₀ on each body [N], [N m] about the body's frame origin, world axes, (n, 6).
            contacts: contacts with their bounds K.
            solver_bodies: the solver's bodies that ``contacts`` name.

        Raises:
            InputError: a wrench of the wrong shape or not finite, or a contact whose sides are not known.
        """
        shape = len(self.bodies), 6
        if np.shape(wrench) != shape or not np.isfinite(wrench).all():
            raise InputError("wrench", value=np.asarray(wrench).tolist(), rule=f"must be finite, of shape {shape}")
        solver_bodies = solver_bodies or {}
        interval = _Interval(np.array(wrench, float), tuple(contacts), dict(solver_bodies))
        for contact in contacts:
            for side in (contact.body, contact.other):
                if isinstance(side, int) and side not in self.bodies:
                    raise InputError("contacts", value=side, rule="must be between bodies that are coupled", choices=self.bodies)
                if isinstance(side, str) and side not in solver_bodies:
                    raise InputError("contacts", value=side, rule="must be the name of a solver body", choices=solver_bodies)
            turn, origin = self._frame(data, interval, contact.body)
            turn2, origin2 = self._frame(data, interval, contact.other)
            interval.anchors.append((turn.T @ (contact.point - origin), turn2.T @ (contact.point - origin2), turn2.T @ turn))
        for name, body in solver_bodies.items():
            interval.displacement[name], interval.speed[name] = np.zeros(6), body.velocity.copy()
        self._intervals[b] = interval

    def apply(self, data: mujoco.MjData, b: int) -> None:
        """Write ``xfrc_applied`` for ``mj_step2``, after ``mj_step1`` and the controls."""
        interval, model = self._intervals[b], self.model
        bodies = list(self.bodies)
        data.xfrc_applied[bodies] = self._at_centre(data, interval.wrench)
        if not interval.contacts:
            return
        h = model.opt.timestep
        mujoco.mj_fwdActuation(model, data)
        mujoco.mj_fwdAcceleration(model, data)
        free = data.qvel + h * data.qacc_smooth
        names = list(interval.solver_bodies)
        inertia = [_inertia(body) for body in interval.solver_bodies.values()]
        free_speed = [
            interval.speed[name] + h * np.linalg.solve(mass, interval.solver_bodies[name].wrench)
            for name, mass in zip(names, inertia, strict=True)
        ]
        count = len(interval.contacts)
        jacobian, solver_jacobian = np.zeros((6 * count, model.nv)), np.zeros((6 * count, 6 * len(names)))
        displacement, stiffness, points, of_point = np.zeros(6 * count), np.zeros((6 * count,) * 2), [], np.zeros((6, model.nv))
        for k, contact in enumerate(interval.contacts):
            rows = slice(6 * k, 6 * k + 6)
            point, displacement[rows] = self._motion(data, interval, k)
            points.append(point)
            for side, sign in ((contact.body, 1.0), (contact.other, -1.0)):
                if isinstance(side, int):
                    mujoco.mj_jac(model, data, of_point[:3], of_point[3:], point, side)
                    jacobian[rows] += sign * of_point
                elif side is not None:
                    first, centre = 6 * names.index(side), self._frame(data, interval, side)[1]
                    solver_jacobian[rows, first : first + 6] += sign * _point_jacobian(point - centre)
            stiffness[rows, rows] = contact.stiffness
        solved = np.zeros((6 * count, model.nv))
        mujoco.mj_solveM(model, data, solved, jacobian)
        mobility, relative = jacobian @ solved.T, jacobian @ free
        for i, mass in enumerate(inertia):
            block = solver_jacobian[:, 6 * i : 6 * i + 6]
            mobility = mobility + block @ np.linalg.solve(mass, block.T)
            relative = relative + block @ free_speed[i]
        c = _solve(interval.contacts, stiffness, mobility, displacement, relative, h)
        correction = np.zeros((len(bodies), 6))
        for k, contact in enumerate(interval.contacts):
            for side, sign in ((contact.body, 1.0), (contact.other, -1.0)):
                if isinstance(side, int):
                    correction[bodies.index(side)] += sign * shifted_wrench(c[6 * k : 6 * k + 6], points[k] - data.xpos[side])
        data.xfrc_applied[bodies] = self._at_centre(data, interval.wrench + correction)
        for i, (name, mass) in enumerate(zip(names, inertia, strict=True)):
            interval.speed[name] = free_speed[i] + h * np.linalg.solve(mass, solver_jacobian[:, 6 * i : 6 * i + 6].T @ c)
            interval.displacement[name] = interval.displacement[name] + h * interval.speed[name]

    def _at_centre(self, data: mujoco.MjData, wrench: np.ndarray) -> np.ndarray:
        """Wrenches (n, 6) about centres of mass, as MuJoCo takes them, from those about origins."""
        arm = data.xpos[list(self.bodies)] - data.xipos[list(self.bodies)]
        return shifted_wrench(wrench, arm)

    @staticmethod
    def _frame(data: mujoco.MjData, interval: _Interval, side: int | str | None) -> tuple[np.ndarray, np.ndarray]:
        """Present rotation (3, 3) and origin (3,) of a side; a solver body began with world axes."""
        if isinstance(side, int):
            return data.xmat[side].reshape(3, 3), data.xpos[side]
        if side is None:
            return np.eye(3), np.zeros(3)
        displacement = interval.displacement.get(side, np.zeros(6))
        return rotations(displacement[3:]), interval.solver_bodies[side].centre + displacement[:3]

    def _motion(self, data: mujoco.MjData, interval: _Interval, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Contact's point (3,), and motion (6,) of body against other side since the beginning."""
        contact, (anchor, anchor2, rotation) = interval.contacts[k], interval.anchors[k]
        turn, origin = self._frame(data, interval, contact.body)
        turn2, origin2 = self._frame(data, interval, contact.other)
        point = origin + turn @ anchor
        turned = turn2 @ rotation_vector(turn2.T @ turn @ rotation.T)
        return point, np.concatenate([point - (origin2 + turn2 @ anchor2), turned])


def _solve(
    contacts: Sequence[CoupledContact],
    stiffness: np.ndarray,
    mobility: np.ndarray,
    displacement: np.ndarray,
    relative: np.ndarray,
    h: float,
) -> np.ndarray:
    """c of all contacts, (6 n,). A contact that would pull opens, and loses its share of w₀ too."""
    closed, fixed = np.ones(len(contacts), bool), np.zeros(6 * len(contacts))
    while True:
        rows = stiffness * np.repeat(closed, 6)[:, None]
        c = np.linalg.solve(np.eye(len(fixed)) + h * h * rows @ mobility, fixed - rows @ (displacement + h * relative))
        pulls = [bool(closed[k]) and _pulls(contact, c[6 * k : 6 * k + 3]) for k, contact in enumerate(contacts)]
        if not any(pulls):
            return c
        for k in np.flatnonzero(pulls).tolist():
            closed[k] = False
            fixed[6 * k : 6 * k + 6] = contacts[k].released


def _pulls(contact: CoupledContact, change: np.ndarray) -> bool:
    """True if the normal force, changed by a force (3,) [N], pulls."""
    normal_force = contact.normal_force
    return normal_force is not None and float((change + normal_force) @ normal_force) < 0.0


def _inertia(body: SolverBody) -> np.ndarray:
    matrix = np.zeros((6, 6))
    matrix[:3, :3], matrix[3:, 3:] = body.mass * np.eye(3), body.inertia
    return matrix


def _point_jacobian(arm: np.ndarray) -> np.ndarray:
    """Matrix (6, 6) from a body's velocity (v, ω) to a point's at ``arm``: (v + ω × arm, ω)."""
    x, y, z = arm
    matrix = np.eye(6)
    matrix[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return matrix


def coupling_inputs(scene: SoftScene, links: Mapping[str, int]) -> list[CouplingInput]:
    """Input of ``Coupling.update`` for every environment, after a step of ``scene``.

    Args:
        links: MuJoCo's body under the frame of every pad and driven body that MuJoCo moves, by name; the order is that of the
            wrenches. Driven bodies that are not named stand still.
    """
    wrench = np.stack([scene.wrench(name) if name in scene.pads else scene.body_wrench(name) for name in links], axis=1)
    pressing = scene.world.pressing()
    bounds = {name: scene.stiffness(name) for name in scene.pads if any(name in pair for pair in pressing)}
    touched = {name: body for name, body in scene.bodies.items() if any(name in pair for pair in pressing)}
    free = {name: _free_bodies(scene, name) for name, body in touched.items() if not body.is_driven}
    bonded = [name for name, body in touched.items() if body.is_driven and body.is_soft]
    inputs: list[CouplingInput] = []
    for b in range(scene.num_envs):
        contacts, solver_bodies = [], {name: motions[b] for name, motions in free.items()}
        for name in bonded:
            patch = scene.world.held_patch(name, b)
            if patch is not None:  # a rigid body on a spring, the body's stiffness there; its forces balance but for inertia
                solver_bodies[name] = SolverBody(patch.mass, patch.inertia, patch.centre, patch.velocity, np.zeros(6))
                contacts.append(CoupledContact(name, STIFFENING * patch.stiffness, patch.centre))
        for (one, two), contact in pressing.items():
            if one == two:  # folds of one gel
                continue
            sides = [links.get(name, name if name in solver_bodies else None) for name in (one, two)]
            if not contact.normal[b].any() or sides == [None, None] or (None in sides and any(side in bonded for side in sides)):
                continue
            (first, other), sign = (sides, 1.0) if sides[0] is not None else (sides[::-1], -1.0)
            pads = [bounds[name][b] for name in (one, two) if name in bounds]
            # Two pads in contact are springs in series, so the bound of either holds for both.
            stiffness = min(pads, key=np.trace) if pads else np.diag([_HARD] * 3 + [0.0] * 3)
            assert first is not None
            contacts.append(
                CoupledContact(first, stiffness, contact.place[b], other, sign * contact.normal[b], sign * contact.wrench[b])
            )
        inputs.append((wrench[b], contacts, solver_bodies))
    return inputs


def _free_bodies(scene: SoftScene, name: str) -> list[SolverBody]:
    """A free body of the solver in every environment."""
    motion, gravity = scene.world.rigid_motion(name), scene.gravity
    wrench = scene.body_wrench(name)
    force = wrench[:, :3] + motion.mass * gravity
    torque = wrench[:, 3:] + np.cross(scene.pose(name)[:, :3, 3] - motion.centre, wrench[:, :3])
    return [
        SolverBody(
            motion.mass,
            motion.inertia[b],
            motion.centre[b],
            np.concatenate([motion.velocity[b], motion.spin[b]]),
            np.concatenate([force[b], torque[b]]),
        )
        for b in range(scene.num_envs)
    ]
