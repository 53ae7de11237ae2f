"""The press rig in MuJoCo: a carriage that holds the object over a rigid pad with a compliant contact."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module names its types at run time.)

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

__all__ = ["IMPEDANCE", "PressRig", "contact_solref"]

IMPEDANCE = 0.5
"""Constant impedance d of the contact (solimp = d, d, …): regularisation R = A (1 − d) / d equals the contact's own A."""
_TIME_STEP = 1e-3
_STIFFEST = 1e4
"""Greatest −solref[0] [1/s²] at this time step: ω Δt = 0.1."""
_FOOT = 5e-3
_SETTLED = 1e-4
_RUNAWAY = 1.0
"""Distance from the pad [m] at which a carriage counts as lost; before MuJoCo sees a huge number and writes a log file."""
_PATIENCE = 20_000
"""Steps that a force may take to settle after its ramp."""


def contact_solref(stiffness: float, mass: float, impedance: float = IMPEDANCE) -> tuple[float, float]:
    """MuJoCo's ``solref`` in direct form, (−s, −b), of a contact with normal stiffness K [N/m] on a body of ``mass`` [kg].

    MuJoCo's soft constraint obeys a₁ + d (b v + k r) = (1 − d) a₀ with the direct form b = B / d, k = s / d (for a constant
    impedance, d = dmax), r the penetration and a₀ the acceleration without the contact. At rest, with a force F on a mass m,
    this is s r = (1 − d) F / m, so the contact is a spring of K = s m / (1 − d), hence s = K (1 − d) / m. B = 2 √s damps it
    critically.
    """
    s = stiffness * (1.0 - impedance) / mass
    return -s, -2.0 * s**0.5


class PressRig:
    """One environment: carriage with slides x, y, z and a hinge about z, a rigid plane for the pad, and one compliant contact.

    The contact is between a foot under the carriage and the plane. The foot reaches the plane exactly when the object touches
    the domed gel (by geometry), and the contact's solref is set at every step so that its force is the load law's. MuJoCo's own
    contacts are not used for the object: a mesh collides as its convex hull (a coin has no relief, a torus no hole), with at
    most a few points, whose number would set the stiffness. There is no gravity: a force is what the drive applies.
    """

    def __init__(self, mass: float, stiffest: float) -> None:
        """``mass`` [kg] of the object; ``stiffest`` [N/m] incremental stiffness that a press may meet: the carriage gets the mass
        that keeps it stable at the time step of 1 ms (equilibria do not depend on it)."""
        self.mass = max(mass, stiffest * (1.0 - IMPEDANCE) / _STIFFEST)
        spec = mujoco.MjSpec()
        spec.option.gravity = (0.0, 0.0, 0.0)
        spec.option.timestep = _TIME_STEP
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        spec.worldbody.add_geom(name="pad", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0.02, 0.02, 0.01), contype=0, conaffinity=0)
        carriage = spec.worldbody.add_body(name="carriage")
        for name, kind, axis in (
            ("x", mujoco.mjtJoint.mjJNT_SLIDE, (1, 0, 0)),
            ("y", mujoco.mjtJoint.mjJNT_SLIDE, (0, 1, 0)),
            ("z", mujoco.mjtJoint.mjJNT_SLIDE, (0, 0, 1)),
            ("twist", mujoco.mjtJoint.mjJNT_HINGE, (0, 0, 1)),
        ):
            carriage.add_joint(name=name, type=kind, axis=axis)
        carriage.mass, carriage.inertia, carriage.explicitinertial = self.mass, np.full(3, self.mass * 1e-4), True
        # Off the body's origin already here: MuJoCo notes at compile time when the two coincide, and then ignores geom_pos.
        foot = carriage.add_geom(name="foot", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(_FOOT, 0.0, 0.0), pos=(0.0, 0.0, _FOOT))
        foot.contype, foot.conaffinity, foot.mass = 0, 0, 0.0
        solimp = (IMPEDANCE, IMPEDANCE, 1e-3, 0.5, 2.0)
        spec.add_pair(name="contact", geomname1="pad", geomname2="foot", condim=1, solimp=solimp)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._carriage, self._foot = self.model.body("carriage").id, self.model.geom("foot").id

    def place(self, origin: np.ndarray, touch_z: float) -> None:
        """Put the rig's zero at ``origin`` (3,) [m]; the foot touches when the carriage is at z = ``touch_z`` [m]."""
        self.model.body_pos[self._carriage] = origin
        self.model.geom_pos[self._foot] = 0.0, 0.0, _FOOT - touch_z
        self._below = float(origin[2]) - touch_z

    @property
    def pose(self) -> np.ndarray:
        """Pose of the carriage in the pad frame (4, 4)."""
        pose = np.eye(4)
        pose[:3, :3] = self.data.xmat[self._carriage].reshape(3, 3)
        pose[:3, 3] = self.data.xpos[self._carriage]
        return pose

    @property
    def depth(self) -> float:
        """How far the foot is below the plane [m]; negative when clear of it."""
        return -(self._below + float(self.data.qpos[2]))

    def hold(self, joints: np.ndarray, secant: Callable[[float], float]) -> float:
        """Hold the carriage at ``joints`` (x, y, z [m], twist [rad]); return the normal force [N] that it takes.

        Position control without error: the pose is prescribed and MuJoCo's inverse dynamics gives the contact's force at rest.
        ``secant``: F / δ [N/m] of the load law at a depth [m].
        """
        self.data.qpos[:] = joints
        self.data.qvel[:] = 0.0
        self.data.qacc[:] = 0.0
        self._stiffen(secant)
        mujoco.mj_inverse(self.model, self.data)
        return max(-float(self.data.qfrc_inverse[2]), 0.0) if self.depth > 0.0 else 0.0

    def load(self, start: float, end: float, duration: float, secant: Callable[[float], float]) -> bool:
        """Ramp the drive's normal force from ``start`` to ``end`` [N] over ``duration`` [s] and let it settle.

        x, y and twist stay where they are. Returns whether the contact's force settled within 1e-4 of ``end``.
        """
        if not np.isfinite([start, end]).all():
            return False
        data, held = self.data, self.data.qpos.copy()
        data.qvel[:] = 0.0
        steps = max(round(duration / _TIME_STEP), 1)
        for step in range(1, steps + _PATIENCE):
            data.qfrc_applied[2] = -(start + (end - start) * min(step / steps, 1.0))
            self._stiffen(secant)
            mujoco.mj_step(self.model, data)
            data.qpos[[0, 1, 3]] = held[[0, 1, 3]]
            if not abs(self.depth) < _RUNAWAY:
                break
            carried = secant(self.depth) * max(self.depth, 0.0)
            rate = abs(float(data.qvel[2])) * secant(self.depth) * 0.01
            if step >= steps and abs(carried - end) <= _SETTLED * end and rate <= _SETTLED * end:
                data.qfrc_applied[2] = 0.0
                return True
        data.qfrc_applied[2] = 0.0
        return False

    def _stiffen(self, secant: Callable[[float], float]) -> None:
        self.model.pair_solref[0] = contact_solref(secant(max(self.depth, 0.0)), self.mass)
