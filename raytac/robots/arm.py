"""Arm in a MuJoCo model: indices, limits and motors of the joints that move one site."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from raytac.errors import InputError
from raytac.robots.actuators import force_limits, torque_motors
from raytac.robots.frames import world_from_site
from raytac.robots.states import Numbers, numbers, site_pose


class Arm:
    """``n`` hinge or slide joints and the site that they carry; indices only, no state.

    Attributes:
        model: the compiled model.
        site: index of the site.
        joints: names of the joints, in order.
        qpos, dof: indices (n,) into ``data.qpos`` and ``data.qvel``.
        range: limits (n, 2) of the joints [rad or m]; ±inf where MuJoCo has none.
        motors: indices (n,) of the actuators that apply a torque to these joints, or None if some joint has none; ``ctrl`` is then
            the torque [N·m] or force [N].
        slides: True (n,) for slides.
        torque_limit: least and greatest output (n, 2) of these actuators; None if ``motors`` is None.
    """

    def __init__(self, model: mujoco.MjModel, site: str, joints: Sequence[str]) -> None:
        """Look the names up.

        Raises:
            InputError: an unknown site or joint (with the known names), a joint that is no hinge or slide or that is named twice, no
                joints, or a site that the joints do not move.
        """
        self.model = model
        self.site = _index(model, mujoco.mjtObj.mjOBJ_SITE, "site", site)
        if not joints or len(set(joints)) != len(joints):
            raise InputError("joints", value=tuple(joints), rule="must name one joint or more, none twice")
        ids = np.array([_index(model, mujoco.mjtObj.mjOBJ_JOINT, "joints", name) for name in joints])
        self.joints, self._ids = tuple(joints), ids
        for name, kind in zip(joints, model.jnt_type[ids], strict=True):
            if kind not in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
                raise InputError("joints", value=name, rule="must be a hinge or a slide")
        ancestors = _ancestors(model, int(model.site_bodyid[self.site]))
        for name, body in zip(joints, model.jnt_bodyid[ids], strict=True):
            if body not in ancestors:
                raise InputError(
                    "joints", value=name, rule=f"must carry the site {site!r}, which is not on its branch of the robot"
                )
        self.qpos, self.dof = model.jnt_qposadr[ids].copy(), model.jnt_dofadr[ids].copy()
        self.range = np.where(model.jnt_limited[ids, None] == 1, model.jnt_range[ids], (-np.inf, np.inf))
        self.slides = model.jnt_type[ids] == int(mujoco.mjtJoint.mjJNT_SLIDE)
        self.motors = torque_motors(model, ids)
        self.torque_limit = None if self.motors is None else force_limits(model, self.motors)

    def __len__(self) -> int:
        return len(self.joints)

    def world_from_site(self, data: mujoco.MjData) -> np.ndarray:
        """Pose (4, 4) of the site after the last ``mj_kinematics`` or ``mj_step``."""
        return world_from_site(data, self.site)

    def jacobian(self, data: mujoco.MjData) -> np.ndarray:
        """J (6, n), world axes: the site's velocity [m/s] above its angular velocity [rad/s]."""
        full = np.zeros((6, self.model.nv))
        mujoco.mj_jacSite(self.model, data, full[:3], full[3:], self.site)
        return full[:, self.dof]

    def mass_matrix(self, data: mujoco.MjData) -> np.ndarray:
        """Joint-space inertia M (n, n) [kg·m²], rows and columns of these joints only."""
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, data, full)
        return full[np.ix_(self.dof, self.dof)]

    def numbers(self) -> dict[str, Numbers]:
        """Numbers of this arm in a state, for a ``StateReader``.

        ``time`` (), ``joints``, ``speed``, ``bias`` (n,), ``mass`` (n, n), ``anchor``, ``axis`` (n, 3) of the joints, world axes, and
        ``site`` (4, 4).
        """
        vectors = 3 * self._ids[:, None] + np.arange(3)
        return {
            "time": numbers("time", np.array(0)),
            "joints": numbers("qpos", self.qpos),
            "speed": numbers("qvel", self.dof),
            "bias": numbers("qfrc_bias", self.dof),
            "mass": numbers("M", self._mass_index()),
            "anchor": numbers("xanchor", vectors),
            "axis": numbers("xaxis", vectors),
            "site": site_pose(self.site),
        }

    def _mass_index(self) -> np.ndarray:
        """Index (n, n) into ``data.M``, the inertia's lower triangle by rows; −1 across branches."""
        model, index = self.model, np.full((len(self), len(self)), -1)
        for i, row in enumerate(self.dof):
            start = int(model.M_rowadr[row])
            columns = model.M_colind[start : start + int(model.M_rownnz[row])].tolist()
            for k, column in enumerate(self.dof.tolist()):
                if column in columns:
                    index[i, k] = index[k, i] = start + columns.index(column)
        return index

    def bias(self, data: mujoco.MjData) -> np.ndarray:
        """C(q, q̇) q̇ + g(q) (n,) [N·m]: at rest, the torques that balance gravity."""
        return data.qfrc_bias[self.dof]

    def drive(self, data: mujoco.MjData, torque: np.ndarray) -> None:
        """Command ``torque`` (n,) [N·m] within limits; ``InputError`` without motors, or not finite."""
        self.check_motors()
        if np.shape(torque) != (len(self),) or not np.isfinite(torque).all():
            raise InputError("torque", value=np.asarray(torque).tolist(), rule=f"must be {len(self)} finite numbers")
        data.ctrl[self.motors] = torque

    def check_motors(self) -> None:
        """Raise ``InputError`` if a joint has no torque motor."""
        if self.motors is None:
            raise InputError("joints", value=self.joints, rule="must all have a torque motor (<motor joint=…>) to be driven")


def _index(model: mujoco.MjModel, kind: mujoco.mjtObj, argument: str, name: str) -> int:
    index = mujoco.mj_name2id(model, kind, name)
    if index < 0:
        count = model.nsite if kind == mujoco.mjtObj.mjOBJ_SITE else model.njnt
        names = (mujoco.mj_id2name(model, kind, i) for i in range(count))
        rule = f"must be the name of a {'site' if kind == mujoco.mjtObj.mjOBJ_SITE else 'joint'} of the model"
        raise InputError(argument, value=name, rule=rule, choices=[n for n in names if n])
    return index


def _ancestors(model: mujoco.MjModel, body: int) -> set[int]:
    ancestors = {body}
    while body > 0:
        body = int(model.body_parentid[body])
        ancestors.add(body)
    return ancestors
