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

All environments take the law at once, in kernels of one device: MuJoCo's states are read into arrays by whoever steps them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import warp as wp

from raytac.errors import InputError
from raytac.robots.states import Numbers, numbers
from raytac.world import coupling_kernels as kernels

_VECTORS = {"place": "xpos", "centre": "xipos"}


def coupling_numbers(model: mujoco.MjModel, bodies: Sequence[int]) -> dict[str, Numbers]:
    """Numbers that ``Coupling`` needs of a state of MuJoCo, for a reader of many of them."""
    n, dofs = np.array(bodies, int), np.arange(model.nv)
    vectors = 3 * n[:, None] + np.arange(3)
    result = {name: numbers(member, vectors) for name, member in _VECTORS.items()}
    result["turn"] = numbers("xmat", 9 * n[:, None, None] + np.arange(9).reshape(3, 3))
    result["root"] = numbers("subtree_com", 3 * model.body_rootid[n][:, None] + np.arange(3))
    result["motion"] = numbers("cdof", 6 * dofs[:, None] + np.arange(6))
    result["speed"], result["free"] = numbers("qvel", dofs), numbers("qacc_smooth", dofs)
    return result | {"mass": numbers("M", _mass_index(model))}


def _mass_index(model: mujoco.MjModel) -> np.ndarray:
    """Index (nv, nv) of the inertia's lower triangle in ``data.M``; −1 across branches."""
    index = np.full((model.nv, model.nv), -1)
    for i in range(model.nv):
        start = int(model.M_rowadr[i])
        columns = model.M_colind[start : start + int(model.M_rownnz[i])]
        index[i, columns] = start + np.arange(len(columns))
    return np.where(np.tril(np.ones_like(index)) > 0, index, -1)


class Coupling:
    """Wrenches of a contact solver on MuJoCo's bodies between two of its steps, B environments.

    .. code-block:: python

        reader = StateReader(datas, coupling_numbers(model, bodies))
        coupling = Coupling(model, bodies, reader.arrays, contacts=4)
        ...                                # fill coupling.wrench, .contacts and .solver_bodies with the solver's result
        reader.read()
        coupling.update(chosen)            # after each step of the solver
        for _ in range(10):                # MuJoCo's steps until the solver's next one
            ...                            # positions, velocities and controls; reader.read()
            coupling.hold()                # applied = w₀: give it to MuJoCo, let it find qacc_smooth; reader.read()
            coupling.apply(chosen)         # applied = w₀ + c: give it to MuJoCo, which steps

    ``CCoupling`` does this for states of C MuJoCo.

    Attributes:
        bodies: bodies of the model that the solver acts on, n.
        wrench: w₀ on each body [N], [N m] about its frame's origin, world axes, (B, n, 6), to write.
        contacts, solver_bodies: contacts with their bounds K, up to ``contacts`` an environment, and the bodies of the solver that they
            name, to write (``coupling_kernels.Contacts``, ``SolverBodies``).
        applied: wrench on each body about its centre of mass, as ``xfrc_applied`` takes it, (B, n, 6).
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        bodies: Sequence[int],
        state: Mapping[str, Any],
        *,
        contacts: int,
        solver_bodies: int = 0,
    ) -> None:
        """Make the arrays where those of the ``state`` are.

        Args:
            bodies: n different bodies of the model.
            state: arrays (B, …) of ``coupling_numbers``.
            contacts: most contacts of an environment.
            solver_bodies: number of bodies that the solver moves.

        Raises:
            InputError: bodies that are not different ones of the model.
        """
        wrong = [int(body) for body in bodies if not 0 < body < model.nbody]
        if wrong or len(set(bodies)) < len(bodies):
            raise InputError("bodies", value=list(bodies), rule=f"must be different bodies of the model, 1 to {model.nbody - 1}")
        self.bodies, self._timestep = tuple(int(body) for body in bodies), float(model.opt.timestep)
        self.device, self.num_envs = state["speed"].device, state["speed"].shape[0]
        count, n, dofs, rows, most = self.num_envs, len(self.bodies), model.nv, 6 * contacts, contacts
        self._robot: Any = kernels.Robot()
        for name in ("speed", "free", "mass", "motion"):
            setattr(self._robot, name, state[name])
        for name in ("place", "centre", "root", "turn"):
            kind = wp.mat33d if name == "turn" else wp.vec3d
            setattr(self._robot, name, wp.array(ptr=state[name].ptr, shape=(count, n), dtype=kind, device=self.device))
        self._state = dict(state)  # the structs hold addresses
        with wp.ScopedDevice(self.device):
            self._robot.moves = wp.array(_moves(model, self.bodies), dtype=wp.int32)
            vectors, matrices, integers = (_make(count, kind) for kind in (wp.vec3d, wp.mat33d, wp.int32))
            floats = _make(count, wp.float64)
            self.contacts: Any = kernels.Contacts()
            self.contacts.count = wp.zeros(count, dtype=wp.int32)
            self.contacts.side, self.contacts.opens = integers(most, 2), integers(most)
            self.contacts.stiffness = floats(most, 6, 6)
            for name in ("place", "normal", "force", "torque"):
                setattr(self.contacts, name, vectors(most))
            self.solver_bodies: Any = kernels.SolverBodies()
            self.solver_bodies.mass, self.solver_bodies.inertia = floats(solver_bodies), matrices(solver_bodies)
            for name in ("centre", "velocity", "spin", "force", "torque"):
                setattr(self.solver_bodies, name, vectors(solver_bodies))
            self._interval: Any = kernels.Interval()
            self._interval.wrench, self._interval.applied = floats(n, 6), floats(n, 6)
            self._interval.anchor, self._interval.rotation = vectors(most, 2), matrices(most)
            for name in ("shift", "swing", "velocity", "spin"):
                setattr(self._interval, name, vectors(solver_bodies))
            self._work: Any = kernels.Work()
            self._work.points, self._work.closed = vectors(most), integers(most)
            self._work.factor = floats(dofs, dofs)
            self._work.jacobian, self._work.solved = floats(rows, dofs), floats(rows, dofs)
            self._work.mobility, self._work.matrix = floats(rows, rows), floats(rows, rows)
            self._work.shift, self._work.fixed, self._work.c = floats(rows), floats(rows), floats(rows)
        self.wrench, self.applied = self._interval.wrench, self._interval.applied

    def clear(self, chosen: wp.array) -> None:
        """Remove all forces from the environments ``chosen`` (B,), int32."""
        self._launch(kernels.clear_interval, self.num_envs, [chosen, self.contacts, self._interval])

    def update(self, chosen: wp.array) -> None:
        """Begin an interval of the environments ``chosen`` (B,), int32, at the poses of the state."""
        self._launch(
            kernels.begin_interval, self.num_envs, [chosen, self._robot, self.contacts, self.solver_bodies, self._interval]
        )

    def hold(self) -> None:
        """Write w₀ to ``applied``, at the poses of the state."""
        self._launch(kernels.hold_wrenches, (self.num_envs, len(self.bodies)), [self._robot, self._interval])

    def apply(self, chosen: wp.array) -> None:
        """Add c to ``applied`` in the environments ``chosen`` (B,), int32, after ``hold``."""
        inputs = [chosen, self._robot, self.contacts, self.solver_bodies, self._timestep, self._interval, self._work]
        self._launch(kernels.apply_law, self.num_envs, inputs)

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device)


def _make(count: int, dtype: Any) -> Any:
    """Maker of arrays (B, …) of zeros; an empty axis has room for one, which is not used."""
    return lambda *shape: wp.zeros((count, *(max(size, 1) for size in shape)), dtype=dtype)


def _moves(model: mujoco.MjModel, bodies: Sequence[int]) -> np.ndarray:
    """1 where a degree of freedom moves a body, (n, nv)."""
    result = np.zeros((len(bodies), model.nv), np.int32)
    for k, body in enumerate(bodies):
        while body:
            first = int(model.body_dofadr[body])
            result[k, first : first + int(model.body_dofnum[body])] = 1
            body = int(model.body_parentid[body])
    return result
