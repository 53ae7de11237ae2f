"""``CCoupling``: the coupling law on states of C MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import warp as wp

from raytac.robots.states import NumberWriter, StateReader
from raytac.world.coupling import Coupling, coupling_numbers
from raytac.world.environment_models import EnvironmentModels


class CCoupling:
    """``Coupling`` of B states of MuJoCo, on the CPU.

    .. code-block:: python

        coupled = CCoupling(models, datas, bodies, contacts=4)
        ...                         # fill coupled.law with the solver's result
        coupled.update(envs)        # after mj_kinematics and mj_comPos
        ...                         # mj_step1 and the controls of every environment
        coupled.apply(envs)
        ...                         # mj_step2 of every environment

    Attributes:
        law: the law, whose contacts and wrenches are to be written before ``update``.
    """

    def __init__(
        self,
        models: EnvironmentModels | Sequence[mujoco.MjModel],
        datas: Sequence[mujoco.MjData],
        bodies: Sequence[int],
        *,
        contacts: int,
        solver_bodies: int = 0,
    ) -> None:
        """``models``, ``datas``: of every environment; the others are as of ``Coupling``."""
        self._models, self._datas, model = models, tuple(datas), models[0]
        # Before the readers look for the bodies' numbers, the law checks that they are there.
        known = [body for body in bodies if 0 <= body < model.nbody]
        self._reader = StateReader(self._datas, coupling_numbers(model, known))
        self.law = Coupling(model, bodies, self._reader.arrays, contacts=contacts, solver_bodies=solver_bodies)
        entries = 6 * np.array(self.law.bodies)[:, None] + np.arange(6)
        self._writer = NumberWriter(self._datas, "xfrc_applied", entries.ravel())
        self._applied, self._count = self.law.applied.numpy(), self.law.contacts.count.numpy()
        self._chosen = wp.zeros(len(self._datas), dtype=wp.int32, device="cpu")
        self._mask = self._chosen.numpy()

    def reset(self, envs: Sequence[int]) -> None:
        """Remove all forces from environments, and from their states."""
        self._choose(envs)
        self.law.clear(self._chosen)
        self._write(envs)

    def update(self, envs: Sequence[int]) -> None:
        """Begin an interval of environments at their present poses."""
        self._choose(envs)
        self._reader.read()
        self.law.update(self._chosen)

    def apply(self, envs: Sequence[int]) -> None:
        """Write ``xfrc_applied`` for ``mj_step2``, after ``mj_step1`` and the controls."""
        self._reader.read()
        self.law.hold()
        self._write(envs)
        touched = [b for b in envs if self._count[b]]
        if not touched:
            return
        for b in touched:
            mujoco.mj_fwdActuation(self._models[b], self._datas[b])
            mujoco.mj_fwdAcceleration(self._models[b], self._datas[b])
        self._choose(touched)
        self._reader.read()
        self.law.apply(self._chosen)
        self._write(touched)

    def _choose(self, envs: Sequence[int]) -> None:
        self._mask[:] = 0
        self._mask[list(envs)] = 1

    def _write(self, envs: Sequence[int]) -> None:
        if len(envs):
            self._writer.values[:] = self._applied.reshape(len(self._datas), -1)
            self._writer.write(envs)
