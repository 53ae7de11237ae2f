"""Contact forces that know of the damping that MuJoCo's integrator adds at a step's end.

MuJoCo solves for the forces of constraints with the mass matrix M, as if velocities changed by Δt M⁻¹ f. Its integrator then divides by
M + Δt D with D the damping of joints, tendons and servos. Where Δt D is not small against M, as at a finger of 50 g on a servo with
100 N s/m, the velocity that a contact counts on does not come: the finger is many times heavier for the contact than it is. With M + Δt D
in both, forces and velocities at the end of a step fit each other.
"""

from __future__ import annotations

import mujoco
import numpy as np

_MATTERS = 0.1
"""Least share of Δt D in M, on the diagonal, that counts."""


class ImplicitDamping:
    """Steps of environments of one model; models may differ in all but damping.

    Attributes:
        matters: whether there is damping that a step of the model's timestep does not resolve. If not, steps are MuJoCo's own.
        share: of a joint's acceleration, in which MuJoCo's forces give it at rest, that comes within a step of the model's timestep:
            M / (M + Δt D) on the diagonal, (nv,); 1 where damping does not matter.
        body_share: the least of those of the degrees of freedom that move a body, (nbody,).
        geoms: True for geoms that a joint moves whose damping matters, (ngeom + 1,); the last one, of no geom, is False.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._is_euler = model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
        self._diagonal = model.M_rowadr + model.M_rownnz - 1
        self._of_joints = np.zeros_like(model.dof_damping)
        if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP:
            self._of_joints = model.dof_damping.copy()
        self._of_mass = model.mapD2M
        self._mass: dict[int, np.ndarray] = {}
        self._scratch = start = mujoco.MjData(model)
        mujoco.mj_forward(model, start)
        mass = start.M[self._diagonal].copy()
        damping = self._damping(model, start)[self._diagonal]
        step = model.opt.timestep
        self.matters = bool((step * damping > _MATTERS * mass).any())
        self.share = mass / (mass + step * damping) if self.matters else np.ones(model.nv)
        slowed = self.share < 1.0 / (1.0 + _MATTERS)
        bodies = [_degrees_of_freedom(model, body) for body in range(model.nbody)]
        self.body_share = np.array([self.share[chain].min(initial=1.0) for chain in bodies])
        moved_slowly = np.array([bool(slowed[chain].any()) for chain in bodies])
        self.geoms = np.append(moved_slowly[model.geom_bodyid], False)

    def clear(self) -> None:
        """Forget environments that were not stepped."""
        self._mass.clear()

    def add(self, env: int, model: mujoco.MjModel, data: mujoco.MjData, step: float) -> None:
        """Add a step's [s] damping to the mass matrix, after actuation, before constraints."""
        self._mass[env] = data.M.copy()
        data.M[:] += step * self._damping(model, data)
        mujoco.mj_factorM(model, data)
        mujoco.mj_fwdAcceleration(model, data)

    def step(self, env: int, model: mujoco.MjModel, data: mujoco.MjData) -> bool:
        """``mj_step2`` where damping was added, restoring the mass matrix; False elsewhere."""
        mass = self._mass.pop(env, None)
        if mass is None:
            return False
        mujoco.mj_fwdActuation(model, data)
        mujoco.mj_fwdAcceleration(model, data)
        mujoco.mj_fwdConstraint(model, data)
        mujoco.mj_sensorAcc(model, data)
        mujoco.mj_checkAcc(model, data)
        data.M[:] = mass
        mujoco.mj_factorM(model, data)
        if self._is_euler:
            mujoco.mj_Euler(model, data)
        else:
            mujoco.mj_implicit(model, data)
        return True

    def _damping(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
        """D in the order of the mass matrix's entries [N s/m, N m s]."""
        if self._is_euler:
            result = np.zeros_like(data.M)
            result[self._diagonal] = self._of_joints
            return result
        # MuJoCo finds it in the integrator alone. A servo whose force is cut at its bound has none.
        if data is not self._scratch:
            mujoco.mj_copyData(self._scratch, model, data)
        mujoco.mj_implicit(model, self._scratch)
        return -self._scratch.qDeriv[self._of_mass]


def _degrees_of_freedom(model: mujoco.MjModel, body: int) -> list[int]:
    """Degrees of freedom that move a body."""
    result: list[int] = []
    while body:
        first = int(model.body_dofadr[body])
        result += range(first, first + int(model.body_dofnum[body]))
        body = int(model.body_parentid[body])
    return result
