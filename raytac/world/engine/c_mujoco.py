"""C MuJoCo under rigid pads: one ``MjData`` an environment.

Kernels read and write its memory for all environments at once. Contacts of gels are put among MuJoCo's own between ``mj_step1`` and
``mj_step2``.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any

import mujoco
import numpy as np
import warp as wp

from raytac.errors import InputError
from raytac.physics.rigid.gel_contact import GelContact, HostViews
from raytac.physics.rigid.world_kernels import ROWS
from raytac.robots.mujoco_memory import checked_layouts, same_states
from raytac.robots.states import StateReader, body_pose, numbers, site_pose
from raytac.warp_runtime import Recorded
from raytac.world.engine.c_kernels import (
    Memory,
    read_constraint,
    read_frames,
    write_contacts,
    write_references,
    write_regularisation,
)
from raytac.world.engine.c_lift_kernels import correct_lifts
from raytac.world.environment_models import EnvironmentModels
from raytac.world.hard_contacts import box_sizes
from raytac.world.implicit_damping import ImplicitDamping
from raytac.world.pad_contact import PadIndices, last_dofs
from raytac.world.world_state import lost


class CMujoco:
    """States of B environments that C MuJoCo steps, each by its own step; see ``Engine``.

    Attributes:
        divides, device: as of ``Engine``.
    """

    divides = True

    def __init__(
        self,
        contact: GelContact,
        pads: PadIndices,
        models: EnvironmentModels,
        datas: Sequence[mujoco.MjData],
        *,
        timestep: float,
    ) -> None:
        """Prepare the kernels.

        Args:
            pads: what the models call pads and what they touch.
            models: of the environments; a variation may replace one.
            datas: their states; ``bind`` names others.
            timestep: of the models [s], as the pads know it.
        """
        model, num_envs = models[0], len(datas)
        self.device = contact.device
        state, one = checked_layouts()
        self._models_now, self._pads, self._timestep = models, pads, timestep
        self._contact, self._views, self._blank, self._damping = contact, HostViews(contact), _blank(), ImplicitDamping(model)
        self._hard = np.append(pads.hard, False)
        self._slows, self._slows_geom = self._damping.matters and bool(pads.hard.any()), self._damping.geoms
        self._address, self._sparse = np.zeros(num_envs, np.uint64), np.zeros(1, np.int32)
        self._datas: list[mujoco.MjData] = []
        self._models: list[mujoco.MjModel] = []
        self._reader: StateReader | None = None
        self._options: list[Any] = []
        memory: Any = Memory()
        memory.states = wp.array(self._address, dtype=wp.uint64, device="cpu", copy=False)
        memory.sparse = wp.array(self._sparse, dtype=wp.int32, device="cpu", copy=False)
        memory.nq, memory.nv, memory.size = model.nq, model.nv, one.size // 8
        for name in _POINTERS:
            setattr(memory, name, state.offset[name] // 8)
        for name in ("ncon", "nefc"):
            setattr(memory, name, state.offset[name] // 4)
        for name in _DOUBLES:
            setattr(memory, name, one.offset[name] // 8)
        for name in _INTEGERS:
            setattr(memory, name, one.offset[name] // 4)
        steps, slots, bodies = contact.steps, contact.slots, np.concatenate([pads.carriers, pads.bodies])
        roots, last = model.body_rootid[bodies], last_dofs(model, bodies)
        indices = [_array(values) for values in (pads.sites, bodies, roots, last, model.dof_parentid)]
        gels, others = _array(pads.geoms[len(pads.bodies) :]), _array(pads.geoms)
        mass = [_array(values) for values in (model.M_rownnz, model.M_rowadr, model.M_colind)]
        launch = partial(wp.launch, device="cpu")
        contact.expect_lifts(_SOLVES, model.nv)
        frames = [memory, steps, *indices, wp.array(self._damping.share, dtype=wp.float64, device="cpu"), contact.frames]
        forces = [memory, slots, steps, contact.force, contact.velocity]
        self.read_frames = partial(launch, read_frames, dim=(num_envs, len(bodies)), inputs=frames)
        self.read_rows = partial(launch, read_constraint, dim=num_envs, inputs=forces)
        self._write, self._regularise, self._refer, self._correct = (
            Recorded(partial(launch, kernel, dim=num_envs, inputs=[memory, steps, slots, *more]))
            for kernel, more in (
                (write_contacts, [gels, others]),
                (write_regularisation, []),
                (write_references, [_array(pads.hard), wp.array(box_sizes(model), dtype=wp.vec3d, device="cpu")]),
                (correct_lifts, [*mass, contact.velocity, contact.lifts]),
            )
        )
        self.bind(datas)

    def bind(self, datas: Sequence[mujoco.MjData]) -> None:
        """Name the states that the next calls work on."""
        if not same_states(datas, self._datas):
            self._datas = list(datas)
            self._address[:] = [data._address for data in datas]
            self._reader = None

    def prepare(self) -> None:
        """Take over models that were replaced.

        Raises ``InputError``: a model has another timestep than at first, or a cone in which pads cannot act.
        """
        models = [self._models_now[b] for b in range(len(self._datas))]
        if not same_states(models, self._models):
            self._models = models
            self._options = [model.opt for model in models]
        self._sparse[0] = mujoco.mj_isSparse(models[0])
        options = self._options[0]
        if options.timestep != self._timestep:
            rule = f"must stay {self._timestep!r} s, with which the pads were made"
            raise InputError("model.opt.timestep", value=options.timestep, rule=rule)
        if options.cone != _ELLIPTIC:
            raise InputError("model.opt.cone", value="pyramidal", rule="must stay elliptic, since a gel sticks by its shear")

    def invalid(self) -> np.ndarray:
        """As of ``Engine``."""
        now = self._read()
        return lost(now["speed"], now["position"])

    def begin_step(self) -> None:
        """``mj_step1``."""
        models, datas = self._models, self._datas
        for b in self._envs():
            mujoco.mj_step1(models[b], datas[b])

    def counts(self, envs: Sequence[int] | np.ndarray) -> list[tuple[int, int]]:
        """Contacts and rows that MuJoCo has, of each environment."""
        return [(self._datas[b].ncon, self._datas[b].nefc) for b in envs]

    def free_acceleration(self) -> None:
        """As of ``Engine``; ``mj_step2`` gives the same."""
        models, datas = self._models, self._datas
        for b in self._envs():
            mujoco.mj_fwdActuation(models[b], datas[b])
            mujoco.mj_fwdAcceleration(models[b], datas[b])

    def update_poses(self) -> None:
        """``mj_kinematics``."""
        for b in self._envs():
            mujoco.mj_kinematics(self._models[b], self._datas[b])

    def read_poses(self) -> tuple[np.ndarray, np.ndarray]:
        """``world_from_pad`` and ``world_from_body`` of the last step or ``update_poses``."""
        now = self._read()
        return now["pads"], now["bodies"]

    def _read(self) -> dict[str, np.ndarray]:
        """Poses, ``speed`` qvel and ``position`` qpos of all states."""
        if self._reader is None:
            speed, position = (numbers(name, np.arange(getattr(self._datas[0], name).size)) for name in ("qvel", "qpos"))
            poses = {"pads": site_pose(self._pads.sites), "bodies": body_pose(self._pads.bodies)}
            self._reader = StateReader(self._datas, {**poses, "speed": speed, "position": position})
        return self._reader.values()

    def _envs(self) -> list[int]:
        """Environments of this step."""
        return self._contact.chosen

    def put_contacts(self, *, own_step: bool = True) -> None:
        """As of ``Engine``; where memory is full an environment is lost with a ``RuntimeWarning``."""
        self._damping.clear()
        envs, blank, views = self._envs(), self._blank, self._views
        count = len(envs)
        lost, rows = views.lost[:count].tolist(), []
        for i, number in enumerate(views.contacts[:count].tolist()):
            if lost[i]:
                continue
            model, data = self._models[envs[i]], self._datas[envs[i]]
            if not number:
                # Otherwise a finger on a stiff servo would seem to slide so fast that MuJoCo's cone acts across a gap.
                if (
                    own_step
                    and self._slows
                    and (self._slows_geom[data.contact.geom] & np.any(self._hard[data.contact.geom], axis=1, keepdims=True)).any()
                ):
                    self._damping.add(envs[i], model, data, float(views.length[i]))
                continue
            for _ in range(number):
                if mujoco.mj_addContact(model, data, blank) != 0:
                    self._lose(envs[i], i)
                    break
            else:
                if own_step and self._damping.matters:
                    self._damping.add(envs[i], model, data, float(views.length[i]))
                rows.append((i, model, data))
        if rows:
            self._write()
            for i, model, data in rows:
                # The contacts come after MuJoCo's own collision, so what it has built on those is built again.
                try:
                    mujoco.mj_makeConstraint(model, data)
                except mujoco.FatalError:
                    self._lose(envs[i], i)
                if not data.nefc:
                    self._lose(envs[i], i)
            self._regularise()
            for i, model, data in rows:
                if views.lost[i]:
                    continue
                mujoco.mj_island(model, data)
                mujoco.mj_projectConstraint(model, data)
                mujoco.mj_referenceConstraint(model, data)
        self._refer()
        self._foresee_slides(envs, views.slides[:count], views.lost[:count])

    def _foresee_slides(self, envs: Sequence[int], slides: np.ndarray, lost: np.ndarray) -> None:
        """Solve where a slide may begin or end, until its lift fits the step's last speed."""
        for _ in range(_SOLVES):
            some = (slides & (lost == 0)).nonzero()[0].tolist()
            if not some:
                return
            for i in some:
                mujoco.mj_fwdConstraint(self._models[envs[i]], self._datas[envs[i]])
            self._correct()

    def end_step(self) -> None:
        """``mj_step2`` by each environment's step, unless it is lost.

        Afterwards the models have their timestep again.
        """
        envs, timestep, damping = self._envs(), self._timestep, self._damping
        models, datas, options, views = self._models, self._datas, self._options, self._views
        lengths, lost = views.length[: len(envs)].tolist(), views.lost[: len(envs)].tolist()
        for row, b in enumerate(envs):
            if lost[row]:
                continue
            is_shorter = lengths[row] != timestep
            if is_shorter:
                options[b].timestep = lengths[row]
            try:
                if not (damping.matters and damping.step(b, models[b], datas[b])):
                    mujoco.mj_step2(models[b], datas[b])
            except mujoco.FatalError:
                self._lose(b, row)
            finally:
                if is_shorter:
                    options[b].timestep = timestep

    def _lose(self, env: int, row: int) -> None:
        if self._views.lost[row]:
            return
        self._views.lost[row] = 1
        rule = 'MuJoCo has no memory left for its contacts: raise memory of <size memory="..."/>, or spec.memory'
        warnings.warn(f"environment {env} failed: {rule}", RuntimeWarning, stacklevel=2)


_ELLIPTIC = int(mujoco.mjtCone.mjCONE_ELLIPTIC)
_SOLVES = 20
"""Solves of MuJoCo's at most for the lift of a slide that begins or ends."""


def _array(values: np.ndarray) -> wp.array:
    return wp.array(np.asarray(values, np.int32), dtype=wp.int32, device="cpu")


def _blank() -> mujoco.MjContact:
    """A contact without place; what MuJoCo computes from its parameters is written over."""
    contact = mujoco.MjContact()
    contact.dist, contact.includemargin, contact.dim, contact.exclude = -1e-6, 0.0, ROWS, 0
    contact.solref[:], contact.solimp[:] = (0.02, 1.0), (0.9, 0.9, 1e-3, 0.5, 2.0)
    contact.solreffriction[:] = 0.0
    contact.flex[:] = contact.elem[:] = contact.vert[:] = -1
    return contact


_POINTERS = (
    "contact", "qpos", "qvel", "xpos", "xmat", "site_xpos", "site_xmat", "subtree_com", "cvel", "cdof", "qacc_smooth", "qacc",
    "qacc_warmstart", "M", "efc_J_rownnz", "efc_J_rowadr", "efc_J_colind", "efc_J", "efc_D", "efc_R", "efc_vel", "efc_aref", "efc_force",
    "efc_state", "efc_id",
    "geom_xpos", "geom_xmat",
)  # fmt: skip
_DOUBLES = ("dist", "pos", "frame", "friction", "mu")
_INTEGERS = ("dim", "geom1", "geom2", "geom", "efc_address")
