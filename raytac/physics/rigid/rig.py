"""The press rig in MuJoCo: object and case, one of them driven, and a compliant contact."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

IMPEDANCE = 0.5
"""Constant impedance d (solimp = d, d, …): R = A (1 − d) / d equals the contact's own A."""
_TIME_STEP = 1e-3
_STIFFEST = 1e4
"""Greatest −solref[0] [1/s²] at this time step: ω Δt = 0.1."""
_FOOT = 5e-3
_SLAB = 1.0
"""Half edge of the slab that stands for the pad [m]."""
_SETTLED = 1e-4
_RUNAWAY = 1.0
"""Distance [m] at which the driven side counts as lost, before MuJoCo logs huge numbers."""
_PATIENCE = 20_000
"""Steps that a force may take to settle after its ramp."""


def contact_solref(stiffness: float, mass: float, impedance: float = IMPEDANCE) -> tuple[float, float]:
    """MuJoCo's direct ``solref`` (−s, −b) of a contact of stiffness K [N/m] on a ``mass`` [kg].

    MuJoCo's soft constraint obeys a₁ + d (b v + k r) = (1 − d) a₀ with the direct form b = B / d, k = s / d (for a constant
    impedance, d = dmax), r the penetration and a₀ the acceleration without the contact. At rest, with a force F on a mass m,
    this is s r = (1 − d) F / m, so the contact is a spring of K = s m / (1 − d), hence s = K (1 − d) / m. B = 2 √s damps it
    critically.
    """
    s = stiffness * (1.0 - impedance) / mass
    return -s, -2.0 * s**0.5


class PressRig:
    """One environment: object and case, one driven, one on a mocap body, and their contact.

    The driven side hangs on slides x, y, z and a hinge about z; their values are always those of the object's displacement in the
    pad frame, whichever side moves, so that one trajectory serves both. With the object at T(o) T(q) R(θ) in the pad frame, a
    case that moves has to be at T(o) R(−θ) T(−q) T(−o) in the world: the same joints, negated and in the opposite order.

    The contact is between a foot under the object and a slab, the pad. The foot reaches the slab exactly when the object touches
    the domed gel (by geometry), and the contact's solref is set at every step so that its force is the load law's. MuJoCo's own
    contacts are not used for the object: a mesh collides as its convex hull (a coin has no relief, a torus no hole), with at
    most a few points, whose number would set the stiffness. There is no gravity: a force is what the drive applies.
    """

    def __init__(self, mass: float, stiffest: float, moves: str = "object") -> None:
        """``mass`` [kg] on the drive; ``stiffest`` [N/m]: incremental stiffness of a press.

        The driven side gets the mass that keeps it stable at the time step of 1 ms (equilibria do not depend on it). ``moves``:
        ``object`` or ``case``.
        """
        self.mass = max(mass, stiffest * (1.0 - IMPEDANCE) / _STIFFEST)
        self._case_moves = moves == "case"
        spec = mujoco.MjSpec()
        spec.option.gravity = (0.0, 0.0, 0.0)
        spec.option.timestep = _TIME_STEP
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        bodies = {name: spec.worldbody.add_body(name=name, mocap=name != moves) for name in ("case", "object")}
        slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
        joints = [("x", slide, (1, 0, 0)), ("y", slide, (0, 1, 0)), ("z", slide, (0, 0, 1)), ("twist", hinge, (0, 0, 1))]
        for name, kind, axis in reversed(joints) if self._case_moves else joints:
            sign = -1 if self._case_moves else 1
            bodies[moves].add_joint(name=name, type=kind, axis=tuple(sign * a for a in axis))
        driven = bodies[moves]
        driven.mass, driven.inertia, driven.explicitinertial = self.mass, np.full(3, self.mass * 1e-4), True
        # Off the body's origin already here: MuJoCo notes at compile time when the two coincide, and then ignores geom_pos.
        # A slab and not a plane, which MuJoCo lets no moving body have; it is larger than any press.
        slab, ball = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE
        geoms = (
            bodies["case"].add_geom(name="pad", type=slab, size=(_SLAB,) * 3, pos=(0.0, 0.0, -_SLAB)),
            bodies["object"].add_geom(name="foot", type=ball, size=(_FOOT, 0.0, 0.0), pos=(0.0, 0.0, _FOOT)),
        )
        for geom in geoms:
            geom.contype, geom.conaffinity, geom.mass = 0, 0, 0.0
        solimp = (IMPEDANCE, IMPEDANCE, 1e-3, 0.5, 2.0)
        spec.add_pair(name="contact", geomname1="pad", geomname2="foot", condim=1, solimp=solimp)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._case, self._object = self.model.body("case").id, self.model.body("object").id
        self._pad, self._foot = self.model.geom("pad").id, self.model.geom("foot").id
        self._joints = np.array([int(self.model.joint(name).qposadr[0]) for name, _, _ in joints])
        self._z = int(self._joints[2])
        self._pad_from_case, self._below = np.zeros(3), 0.0

    def place(self, origin: np.ndarray, touch_z: float) -> None:
        """Put the rig's zero at ``origin`` (3,) [m], pad frame.

        The foot touches when the object is at z = ``touch_z`` [m] there. With all joints at 0 pad frame and world are one.
        """
        if self._case_moves:
            self.data.mocap_pos[0] = origin
            self.model.body_pos[self._case] = origin
            self._pad_from_case = np.asarray(origin, float)
        else:
            self.model.body_pos[self._object] = origin
            self._pad_from_case = np.zeros(3)
        self.model.geom_pos[self._pad] = -self._pad_from_case - (0.0, 0.0, _SLAB)
        self.model.geom_pos[self._foot] = 0.0, 0.0, _FOOT - touch_z
        self._below = float(origin[2]) - touch_z

    @property
    def world_from_pad(self) -> np.ndarray:
        """Pose of the pad frame in the world (4, 4): the identity where the object moves."""
        pose = self._world_from(self._case)
        pose[:3, 3] -= pose[:3, :3] @ self._pad_from_case
        return pose

    @property
    def pad_from_object(self) -> np.ndarray:
        """Pose of the object's carriage in the pad frame (4, 4)."""
        pad, carriage = self.world_from_pad, self._world_from(self._object)
        pose = np.eye(4)
        pose[:3, :3] = pad[:3, :3].T @ carriage[:3, :3]
        pose[:3, 3] = pad[:3, :3].T @ (carriage[:3, 3] - pad[:3, 3])
        return pose

    def _world_from(self, body: int) -> np.ndarray:
        pose = np.eye(4)
        pose[:3, :3] = self.data.xmat[body].reshape(3, 3)
        pose[:3, 3] = self.data.xpos[body]
        return pose

    @property
    def depth(self) -> float:
        """Depth of the foot below the plane [m]; negative when clear of it."""
        return -(self._below + float(self.data.qpos[self._z]))

    @property
    def joints(self) -> np.ndarray:
        """Displacement of the object in the pad frame: x, y, z [m], twist [rad]."""
        return self.data.qpos[self._joints]

    @joints.setter
    def joints(self, values: np.ndarray) -> None:
        self.data.qpos[self._joints] = values

    def hold(self, joints: np.ndarray, secant: Callable[[float], float]) -> float:
        """Hold the rig at ``joints`` (x, y, z [m], twist [rad]); return its normal force [N].

        Position control without error: the pose is prescribed and MuJoCo's inverse dynamics gives the contact's force at rest.
        ``secant``: F / δ [N/m] of the load law at a depth [m].
        """
        self.joints = joints
        self.data.qvel[:] = 0.0
        self.data.qacc[:] = 0.0
        self._stiffen(secant)
        mujoco.mj_inverse(self.model, self.data)
        return max(-float(self.data.qfrc_inverse[self._z]), 0.0) if self.depth > 0.0 else 0.0

    def load(self, start: float, end: float, duration: float, secant: Callable[[float], float]) -> bool:
        """Ramp the normal force from ``start`` to ``end`` [N] over ``duration`` [s] and settle.

        x, y and twist stay where they are. Returns whether the contact's force settled within 1e-4 of ``end``.
        """
        if not np.isfinite([start, end]).all():
            return False
        data, z, joints = self.data, self._z, self.joints
        data.qvel[:] = 0.0
        steps = max(round(duration / _TIME_STEP), 1)
        for step in range(1, steps + _PATIENCE):
            data.qfrc_applied[z] = -(start + (end - start) * min(step / steps, 1.0))
            self._stiffen(secant)
            mujoco.mj_step(self.model, data)
            data.qpos[self._joints[[0, 1, 3]]] = joints[[0, 1, 3]]
            if not abs(self.depth) < _RUNAWAY:
                break
            carried = secant(self.depth) * max(self.depth, 0.0)
            rate = abs(float(data.qvel[z])) * secant(self.depth) * 0.01
            if step >= steps and abs(carried - end) <= _SETTLED * end and rate <= _SETTLED * end:
                data.qfrc_applied[z] = 0.0
                return True
        data.qfrc_applied[z] = 0.0
        return False

    def _stiffen(self, secant: Callable[[float], float]) -> None:
        self.model.pair_solref[0] = contact_solref(secant(max(self.depth, 0.0)), self.mass)
