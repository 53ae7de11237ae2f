"""Bodies that nothing touches: where inertia and gravity alone hold them, without a solve.

A bonded soft body that nothing touches is bent by its own mass only. With C = K⁻¹ M·1, the displacement of its nodes for a uniform unit
acceleration along each axis, K being the stiffness at rest, a node at rest place r lies at

    y = r + C(r) Rᵀ (a − ((x₁ − x₀)/h − v)/h),    x = R r + t,

at the end of a step from x₀ to x₁: the stationary point of backward Euler's energy where the acceleration varies slowly over the
thickness of the body. The rest of the inertia, that of its vibration, is a share of 1/(ω h)² of that for a lowest frequency ω, about
10⁻³ for a gel of 4 mm in steps of 10 ms, and the change of stiffness a share of the strain, 10⁻⁴.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ipc.arrays import FloatArray, FloatArray2d, IntArray, MatArray2d, QuatArray2d, VecArray, VecArray2d
from ipc.bodies.layout import Layout
from ipc.reduce import MAX
from ipc.settings import Settings
from ipc.solver.potential import Potential
from ipc.solver.preconditioners.rest_stiffness import bonded_bodies, couplings, free_nodes, rest_blocks

wp.set_module_options({"enable_backward": False})

Floats = NDArray[np.float64]

_STATIC = 1e3
"""A step so long [s] that inertia has no part in the matrix."""
_TOLERANCE, _MOST = 1e-6, 5000
"""Relative residual and most iterations of the solve for C."""


@wp.struct
class RestNodes:
    """By node: place at rest, C [s²], gradient for unit acceleration [kg], body; if bonded."""

    rest: VecArray
    compliance: wp.array(dtype=wp.mat33d)
    reaction: wp.array(dtype=wp.mat33d)
    body: IntArray
    bonded: IntArray


@wp.kernel
def expect(
    nodes: RestNodes,
    R: MatArray2d,
    t: VecArray2d,
    goal_q: QuatArray2d,
    goal_p: VecArray2d,
    v: VecArray2d,
    acceleration: VecArray,
    dt: FloatArray,
    mask: IntArray,
    # outputs
    expected: VecArray2d,
    load: VecArray2d,
):
    """Places of the nodes of bonded bodies after a step to the goals, and loads, body frame."""
    env, i = wp.tid()
    if mask[env] == 0 or nodes.bonded[i] == 0:
        return
    b = nodes.body[i] + 0
    h = dt[env] + wp.float64(0.0)
    turn = wp.quat_to_matrix(goal_q[env, b])
    moved = (turn - R[env, b]) * nodes.rest[i] + (goal_p[env, b] - t[env, b])
    load[env, i] = wp.transpose(turn) * (acceleration[env] - (moved / h - v[env, i]) / h)
    expected[env, i] = nodes.rest[i] + nodes.compliance[i] * load[env, i]


@wp.kernel
def distance(
    nodes: RestNodes, y: VecArray2d, v: VecArray2d, expected: VecArray2d, dt: FloatArray, mask: IntArray, out: FloatArray2d
):
    """Distance from there; of other nodes, the length of the last step's displacement."""
    env, i = wp.tid()
    if mask[env] != 0:
        if nodes.bonded[i] != 0:
            out[env, i] = wp.length(y[env, i] - expected[env, i])
        else:
            out[env, i] = wp.length(v[env, i]) * dt[env]


@wp.kernel
def carry_nodes(
    nodes: RestNodes,
    R: MatArray2d,
    t: VecArray2d,
    goal_q: QuatArray2d,
    goal_p: VecArray2d,
    expected: VecArray2d,
    load: VecArray2d,
    dt: FloatArray,
    mask: IntArray,
    # outputs
    y: VecArray2d,
    v: VecArray2d,
    gradient: VecArray2d,
):
    """Take bonded bodies along to the goals; others stay and stand still."""
    env, i = wp.tid()
    if mask[env] == 0:
        return
    if nodes.bonded[i] == 0:
        v[env, i] = wp.vec3d()
        return
    b = nodes.body[i] + 0
    before = R[env, b] * y[env, i] + t[env, b]
    y[env, i] = expected[env, i]
    v[env, i] = (wp.quat_to_matrix(goal_q[env, b]) * expected[env, i] + goal_p[env, b] - before) / dt[env]
    gradient[env, i] = nodes.reaction[i] * load[env, i]


@wp.kernel
def carry_frames(
    goal_q: QuatArray2d,
    goal_p: VecArray2d,
    mask: IntArray,
    # outputs
    frame_q: QuatArray2d,
    frame_p: VecArray2d,
    R: MatArray2d,
    t: VecArray2d,
):
    """Frames at their goals."""
    env, b = wp.tid()
    if mask[env] != 0:
        frame_q[env, b] = goal_q[env, b]
        frame_p[env, b] = goal_p[env, b]
        R[env, b] = wp.quat_to_matrix(goal_q[env, b])
        t[env, b] = goal_p[env, b]


class RestState:
    """Rest of the bodies of a batch; making it solves for C once for every different pad."""

    def __init__(self, layout: Layout, settings: Settings, potential: Potential) -> None:
        self._potential, device = potential, potential.device
        bonded = np.isin(layout.node_body, bonded_bodies(layout))
        self._nodes = RestNodes()
        self._nodes.rest = wp.array(layout.node_rest, dtype=wp.vec3d, device=device)
        compliance, reaction = responses(layout, settings)
        self._nodes.compliance = wp.array(compliance, dtype=wp.mat33d, device=device)
        self._nodes.reaction = wp.array(reaction, dtype=wp.mat33d, device=device)
        self._nodes.body = potential.node_body
        self._nodes.bonded = wp.array(bonded.astype(np.int32), dtype=wp.int32, device=device)
        self._expected, self._load = wp.zeros_like(potential.y), wp.zeros_like(potential.y)
        self._mask = wp.zeros(potential.batch, dtype=wp.int32, device=device)
        self._distance = wp.zeros(potential.batch, dtype=wp.float64, device=device)

    def expect(self, envs: NDArray[np.bool_]) -> None:
        """Find where the nodes of environments (B,) would be after a step to their goals."""
        pot, mask = self._potential, self._set(envs)
        inputs = [self._nodes, pot.R, pot.t, pot.goal_q, pot.goal_p, pot.v, pot.acceleration, pot.dt, mask]
        pot.launch(expect, pot.y.shape, inputs, [self._expected, self._load])

    def distance(self, envs: NDArray[np.bool_]) -> Floats:
        """Largest distance of a node from there after that step [m], (B,); 0 outside of ``envs``."""
        pot, mask = self._potential, self._set(envs)
        inputs = [self._nodes, pot.y, pot.v, self._expected, pot.dt, mask]
        pot.launch(distance, pot.y.shape, inputs, [pot.node_change])
        self._distance.zero_()
        pot.reduce(pot.node_change, mask, MAX, self._distance)
        return np.array(self._distance.numpy(), dtype=np.float64)

    def carry(self, envs: NDArray[np.bool_]) -> None:
        """Let a step to the goals pass in environments (B,) where nothing touches a bonded body."""
        self.expect(envs)
        pot = self._potential
        goals = [pot.goal_q, pot.goal_p]
        inputs = [self._nodes, pot.R, pot.t, *goals, self._expected, self._load, pot.dt, self._mask]
        pot.launch(carry_nodes, pot.y.shape, inputs, [pot.y, pot.v, pot.gradient])
        pot.launch(carry_frames, pot.R.shape, [*goals, self._mask], [pot.frame_q, pot.frame_p, pot.R, pot.t])
        pot.place_vertices(pot.y, pot.R, pot.t, pot.x)

    def _set(self, envs: NDArray[np.bool_]) -> wp.array:
        self._mask.assign(envs.astype(np.int32))
        return self._mask


def responses(layout: Layout, settings: Settings) -> tuple[Floats, Floats]:
    """C [s²] of every node, and the gradient K C − M 1 [kg] that its bond balances, (N, 3, 3).

    Both are for a unit acceleration along each axis; the gradient of free nodes is zero.
    """
    blocks = rest_blocks(layout, replace(settings, dt=_STATIC))
    rows, cols = couplings(layout)
    own = np.repeat(np.arange(len(layout.node_rest)), np.diff(layout.row_start))
    mass = np.bincount(own, weights=layout.mass, minlength=len(layout.node_rest))
    result = np.zeros((len(layout.node_rest), 3, 3))
    known: list[tuple[Floats, Floats, Floats]] = []
    for body in bonded_bodies(layout):
        nodes = free_nodes(layout, body)
        place = np.full(len(layout.node_rest), -1)
        place[nodes] = np.arange(len(nodes))
        inside = (place[rows] >= 0) & (place[cols] >= 0)
        matrix, load = blocks[inside], mass[nodes]
        for other, other_load, solved in known:  # pads of one robot are alike
            if np.array_equal(matrix, other) and np.array_equal(load, other_load):
                result[nodes] = solved
                break
        else:
            solved = _solve(matrix, place[rows[inside]], place[cols[inside]], load[:, None, None] * np.eye(3))
            known.append((matrix, load, solved))
            result[nodes] = solved
    forces = np.add.reduceat(blocks @ result[cols], np.searchsorted(rows, np.arange(len(mass))), axis=0)
    fixed = np.isin(layout.node_body, bonded_bodies(layout)) & (layout.node_free == 0)
    reaction: Floats = np.zeros_like(result)
    reaction[fixed] = forces[fixed] - mass[fixed, None, None] * np.eye(3)
    return result, reaction


def _solve(blocks: Floats, rows: NDArray, cols: NDArray, right: Floats) -> Floats:
    """x (n, 3, k) of K x = b by conjugate gradients with block-Jacobi, all columns at once.

    Blocks (K', 3, 3) are sorted by row.
    """
    start = np.searchsorted(rows, np.arange(len(right)))
    inverse = np.linalg.inv(blocks[rows == cols])
    x, r = np.zeros_like(right), right.copy()
    z = inverse @ r
    p, rho = z.copy(), (r * z).sum(axis=(0, 1))
    goal = _TOLERANCE**2 * rho
    for _ in range(_MOST):
        if (rho <= goal).all():
            break
        Ap = np.add.reduceat(blocks @ p[cols], start, axis=0)
        alpha = rho / np.maximum((p * Ap).sum(axis=(0, 1)), 1e-300)
        x, r = x + alpha * p, r - alpha * Ap
        z = inverse @ r
        rho, last = (r * z).sum(axis=(0, 1)), rho
        p = z + rho / np.maximum(last, 1e-300) * p
    return x
