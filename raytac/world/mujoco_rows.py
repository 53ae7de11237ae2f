"""Contacts of gels among MuJoCo's own: put there between ``mj_step1`` and ``mj_step2``, and read after it, for all environments at once."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any

import mujoco
import numpy as np
import warp as wp

from raytac.errors import InputError
from raytac.physics.rigid.gel_contact import GelContact
from raytac.physics.rigid.world_kernels import ROWS
from raytac.warp_runtime import Recorded
from raytac.world.implicit_damping import ImplicitDamping
from raytac.world.mujoco_kernels import (
    Memory,
    correct_lifts,
    read_constraint,
    read_frames,
    write_contacts,
    write_references,
    write_regularisation,
)
from raytac.world.mujoco_memory import checked_layouts


class MujocoRows:
    """Kernels on the states of B environments, and MuJoCo's calls between them."""

    def __init__(
        self,
        model: mujoco.MjModel,
        contact: GelContact,
        *,
        sites: np.ndarray,
        bodies: np.ndarray,
        geoms: np.ndarray,
        hard: np.ndarray,
    ) -> None:
        """Prepare the kernels; ``bind`` names the states.

        Args:
            model: any of the environments'.
            contact: the gels' contacts.
            sites: at the pads' frames, (pads,).
            bodies: that carry the pads, then those that they touch.
            geoms: of the bodies that pads touch, then of the gels.
            hard: geoms with the law of ``hard_contacts``, (ngeom,), bool.
        """
        num_envs, pads = contact.wrenches.shape
        state, one = checked_layouts()
        assert contact.views is not None  # they are on the CPU
        self._views, self._blank, self._damping = contact.views, _blank(), ImplicitDamping(model)
        self._address, self._sparse = np.zeros(num_envs, np.uint64), np.zeros(1, np.int32)
        self._datas: list[mujoco.MjData] = []
        self._models: list[mujoco.MjModel] = []
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
        steps, slots = contact.steps, contact.slots
        roots, last = model.body_rootid[bodies], np.array([_last_dof(model, body) for body in bodies.tolist()])
        indices = [_array(values) for values in (sites, bodies, roots, last, model.dof_parentid)]
        gels, others = _array(geoms[len(geoms) - pads :]), _array(geoms)
        launch = partial(wp.launch, device="cpu")
        frames = [memory, steps, *indices, contact.frames]
        read = partial(launch, read_frames, dim=(num_envs, len(bodies)), inputs=frames)
        forces = [memory, slots, steps, contact.force, contact.velocity]
        self._begin = [Recorded(read, partial(contact.begin, whole=whole)) for whole in (False, True)]
        self._move = Recorded(read, contact.move)
        self._end = Recorded(partial(launch, read_constraint, dim=num_envs, inputs=forces), contact.end)
        self._write, self._regularise, self._refer, self._correct = (
            Recorded(partial(launch, kernel, dim=num_envs, inputs=[memory, steps, slots, *more]))
            for kernel, more in (
                (write_contacts, [gels, others]),
                (write_regularisation, []),
                (write_references, [_array(hard)]),
                (correct_lifts, []),
            )
        )

    def bind(self, models: Sequence[mujoco.MjModel], datas: Sequence[mujoco.MjData]) -> None:
        """Name the states, and their models, that the next calls work on."""
        if not _same(datas, self._datas):
            self._datas = list(datas)
            self._address[:] = [data._address for data in datas]
        if not _same(models, self._models):
            self._models = list(models)
            self._options = [model.opt for model in models]
        self._sparse[0] = mujoco.mj_isSparse(models[0])

    def check_options(self, timestep: float) -> None:
        """Raise ``InputError`` where a model has another timestep than ``timestep`` [s], or a cone in which pads cannot act."""
        options = self._options[0]
        if options.timestep != timestep:
            rule = f"must stay {timestep!r} s, with which the pads were made"
            raise InputError("model.opt.timestep", value=options.timestep, rule=rule)
        if options.cone != mujoco.mjtCone.mjCONE_ELLIPTIC:
            raise InputError("model.opt.cone", value="pyramidal", rule="must stay elliptic, since a gel sticks by its shear")

    def first_half(self, envs: Sequence[int]) -> None:
        """``mj_step1``."""
        for b in envs:
            mujoco.mj_step1(self._models[b], self._datas[b])

    def counts(self, envs: Sequence[int]) -> list[tuple[int, int]]:
        """Contacts and rows that MuJoCo has, of each environment."""
        return [(self._datas[b].ncon, self._datas[b].nefc) for b in envs]

    def accelerate(self, envs: Sequence[int]) -> None:
        """Accelerations that everything but contacts and other constraints would give, by the controls; ``mj_step2`` finds the same."""
        for b in envs:
            mujoco.mj_fwdActuation(self._models[b], self._datas[b])
            mujoco.mj_fwdAcceleration(self._models[b], self._datas[b])

    def choose(self, envs: np.ndarray, done: np.ndarray | int) -> None:
        """Name the environments of this step, which have done these ticks of the scene's."""
        views, count = self._views, len(envs)
        views.envs[:count], views.envs[count:] = envs, -1
        views.done[:count] = done

    def begin(self, *, whole: bool = False) -> None:
        """``GelContact.begin`` with the present frames, after ``choose`` and ``accelerate``."""
        self._begin[whole]()

    def move(self) -> None:
        """``GelContact.move`` with the present frames, after ``choose``."""
        self._move()

    def put(self, envs: Sequence[int], *, own_step: bool) -> None:
        """Put the contacts that ``GelContact.begin`` found after MuJoCo's own.

        An environment whose memory for contacts is full is lost, with a ``RuntimeWarning``. ``own_step``: ``second_half`` follows, not
        somebody else's ``mj_step2``.
        """
        self._damping.clear()
        count, blank, views = len(envs), self._blank, self._views
        lost, rows = views.lost[:count].tolist(), []
        for i, number in enumerate(views.contacts[:count].tolist()):
            if not number or lost[i]:
                continue
            model, data = self._models[envs[i]], self._datas[envs[i]]
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
        """Solve where a slide may begin or end, until its lift fits the speed at the end of the step."""
        for _ in range(_SOLVES):
            some = np.flatnonzero(slides & (lost == 0)).tolist()
            if not some:
                return
            for i in some:
                mujoco.mj_fwdConstraint(self._models[envs[i]], self._datas[envs[i]])
            self._correct()

    def second_half(self, envs: Sequence[int], timestep: float) -> None:
        """``mj_step2`` of the length of each environment's step, if it is not lost; afterwards the models have ``timestep`` [s] again."""
        models, datas, options, views = self._models, self._datas, self._options, self._views
        lengths, lost = views.length[: len(envs)].tolist(), views.lost[: len(envs)].tolist()
        for row, b in enumerate(envs):
            if lost[row]:
                continue
            options[b].timestep = lengths[row]
            try:
                if not self._damping.step(b, models[b], datas[b]):
                    mujoco.mj_step2(models[b], datas[b])
            except mujoco.FatalError:
                self._lose(b, row)
            finally:
                options[b].timestep = timestep

    def _lose(self, env: int, row: int) -> None:
        if self._views.lost[row]:
            return
        self._views.lost[row] = 1
        rule = 'MuJoCo has no memory left for its contacts: raise memory of <size memory="..."/>, or spec.memory'
        warnings.warn(f"environment {env} failed: {rule}", RuntimeWarning, stacklevel=2)

    def end(self) -> None:
        """``GelContact.end`` with the forces and velocities of the rows; environments that broke down are lost."""
        self._end()


_SOLVES = 5
"""Solves of MuJoCo's at most for the lift of a slide that begins or ends."""


def _last_dof(model: mujoco.MjModel, body: int) -> int:
    """Last degree of freedom that moves a body; −1 of one that stands still."""
    while body and not model.body_dofnum[body]:
        body = int(model.body_parentid[body])
    return int(model.body_dofadr[body] + model.body_dofnum[body]) - 1 if body else -1


def _same(one: Sequence[Any], other: Sequence[Any]) -> bool:
    return len(one) == len(other) and all(a is b for a, b in zip(one, other, strict=True))


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
    "qacc_warmstart", "efc_J_rownnz", "efc_J_rowadr", "efc_J_colind", "efc_J", "efc_D", "efc_R", "efc_vel", "efc_aref", "efc_force",
)  # fmt: skip
_DOUBLES = ("dist", "pos", "frame", "friction", "mu")
_INTEGERS = ("dim", "geom1", "geom2", "geom", "efc_address")
