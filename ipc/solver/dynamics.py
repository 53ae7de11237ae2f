"""Inertia, drag and drives of the nodes, and the energy and gradient that they add.

Backward Euler minimises ½‖x − x̃‖²_M/h² + potentials with x̃ = x_n + h v_n + h² a. A frame's rotation keeps lengths, so the same energy holds
in frame coordinates with ỹ = Rᵀ(x̃ − t): there are no fictitious forces, and a bonded vertex is a constant.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, FloatArray2d, IntArray, MatArray2d, QuatArray2d, VecArray, VecArray2d
from ipc.solver.frames import VertexMap

wp.set_module_options({"enable_backward": False})


@wp.struct
class Masses:
    """Mass matrix [kg] in the block pattern, ``inertia`` with drives [kg], ``drag`` [kg/s].

    Its blocks that are not 0: those of row i are ``block`` from ``row_start[i]`` on.
    """

    row_start: IntArray
    block: IntArray
    col: IntArray
    mass: FloatArray
    inertia: FloatArray
    drag: FloatArray


@wp.kernel
def predict(xw: VecArray2d, v: VecArray2d, acceleration: VecArray, dt: FloatArray, target: VecArray2d):
    """x̃ of the nodes, world frame."""
    env, i = wp.tid()
    h = dt[env] + wp.float64(0.0)
    target[env, i] = xw[env, i] + h * v[env, i] + h * h * acceleration[env]


@wp.kernel
def inertia_target(
    target: VecArray2d,
    xw: VecArray2d,
    R: MatArray2d,
    t: VecArray2d,
    node_body: IntArray,
    # outputs
    local_target: VecArray2d,
    local_start: VecArray2d,
):
    """ỹ and the start position of the nodes in the frames as they are now."""
    env, i = wp.tid()
    Rt = wp.transpose(R[env, node_body[i]])
    local_target[env, i] = Rt * (target[env, i] - t[env, node_body[i]])
    local_start[env, i] = Rt * (xw[env, i] - t[env, node_body[i]])


@wp.kernel
def sum_followers(
    vert_gradient: VecArray2d, verts: VertexMap, nodes: IntArray, active: IntArray, threads: wp.int32, out: FloatArray2d
):
    """Contact gradient of nodes that many vertices follow, three numbers each.

    A block of ``threads`` adds up that of an environment and a node.
    """
    env, k, lane = wp.tid()
    g = wp.vec3d()
    if active[env] != 0:
        for f in range(verts.follower_start[nodes[k]] + lane, verts.follower_start[nodes[k] + 1], threads):
            g += verts.follower_weight[f] * vert_gradient[env, verts.follower[f]]
    wp.tile_store(out[env], wp.tile_sum(wp.tile(g[0])), offset=3 * k)
    wp.tile_store(out[env], wp.tile_sum(wp.tile(g[1])), offset=3 * k + 1)
    wp.tile_store(out[env], wp.tile_sum(wp.tile(g[2])), offset=3 * k + 2)


@wp.kernel
def node_gradient(
    y: VecArray2d,
    local_target: VecArray2d,
    local_start: VecArray2d,
    masses: Masses,
    dt: FloatArray,
    vert_gradient: VecArray2d,
    summed_place: IntArray,
    summed: FloatArray2d,
    R: MatArray2d,
    node_body: IntArray,
    node_free: IntArray,
    verts: VertexMap,
    active: IntArray,
    # outputs
    gradient: VecArray2d,
    residual: VecArray2d,
    force_size: FloatArray2d,
):
    """Add inertia, drag and contact to the elastic gradient.

    The residual is the negative gradient on the unknowns, zero on bonded nodes. ``summed_place`` (N,) is a node's place in ``summed``
    (:func:`sum_followers`), or −1. ``force_size`` is the sum of the sizes of elastic and contact force [N], which scales the rounding of
    energies.
    """
    env, i = wp.tid()
    if active[env] == 0:
        return
    h = dt[env] + wp.float64(0.0)
    inertia_scale = wp.float64(1.0) / (h * h)
    g = gradient[env, i]
    elastic = wp.length(g)
    for m in range(masses.row_start[i], masses.row_start[i + 1]):
        k = masses.block[m]
        j = masses.col[k]
        pull = (masses.inertia[k] * inertia_scale) * (y[env, j] - local_target[env, j])
        g += pull + (masses.drag[k] / h) * (y[env, j] - local_start[env, j])
    contact, place = wp.vec3d(), 3 * summed_place[i]
    if place >= 0:
        contact = wp.vec3d(summed[env, place], summed[env, place + 1], summed[env, place + 2])
    else:
        for k in range(verts.follower_start[i], verts.follower_start[i + 1]):
            contact += verts.follower_weight[k] * vert_gradient[env, verts.follower[k]]
    g += wp.transpose(R[env, node_body[i]]) * contact
    force_size[env, i] = elastic + wp.length(contact)
    gradient[env, i] = g
    if node_free[i] != 0:
        residual[env, i] = -g
    else:
        residual[env, i] = wp.vec3d()


@wp.kernel
def inertia_change(
    y0: VecArray2d,
    y1: VecArray2d,
    local_target: VecArray2d,
    local_start: VecArray2d,
    masses: Masses,
    dt: FloatArray,
    active: IntArray,
    # outputs
    change: FloatArray2d,
):
    """Change of the inertial and drag energy [J], (y1 − y0)·M((y1 + y0)/2 − ỹ)/h² by node."""
    env, i = wp.tid()
    if active[env] == 0:
        return
    half = wp.float64(0.5)
    h = dt[env] + wp.float64(0.0)
    inertia_scale = wp.float64(1.0) / (h * h)
    f = wp.vec3d()
    for m in range(masses.row_start[i], masses.row_start[i + 1]):
        k = masses.block[m]
        j = masses.col[k]
        mean = half * (y0[env, j] + y1[env, j])
        pull = (masses.inertia[k] * inertia_scale) * (mean - local_target[env, j])
        f += pull + (masses.drag[k] / h) * (mean - local_start[env, j])
    change[env, i] = wp.dot(y1[env, i] - y0[env, i], f)


@wp.kernel
def new_velocity(xw_new: VecArray2d, xw: VecArray2d, dt: FloatArray, active: IntArray, v: VecArray2d):
    """Velocities at the end of the step, world frame."""
    env, i = wp.tid()
    if active[env] != 0:
        v[env, i] = (xw_new[env, i] - xw[env, i]) / dt[env]


@wp.kernel
def kinetic_energy(v: VecArray2d, masses: Masses, energy: FloatArray2d):
    """½ v·M v node by node [J]."""
    env, i = wp.tid()
    f = wp.vec3d()
    for m in range(masses.row_start[i], masses.row_start[i + 1]):
        k = masses.block[m]
        f += masses.mass[k] * v[env, masses.col[k]]
    energy[env, i] = wp.float64(0.5) * wp.dot(v[env, i], f)


@wp.kernel
def advance_nodes(y: VecArray2d, p: VecArray2d, alpha: FloatArray, y1: VecArray2d):
    """y1 = y + alpha p."""
    env, i = wp.tid()
    y1[env, i] = y[env, i] + alpha[env] * p[env, i]


@wp.kernel
def aim_bodies(
    goal_q: QuatArray2d, goal_p: VecArray2d, node_drive: FloatArray, node_aim: IntArray, aim_local: VecArray, target: VecArray2d
):
    """x̃ ← (x̃ + s x_aim)/(1 + s), the target of inertia and a drive of strength s together."""
    env, i = wp.tid()
    frame = node_aim[i]
    if frame >= 0:
        aim = wp.quat_rotate(goal_q[env, frame], aim_local[i]) + goal_p[env, frame]
        target[env, i] = (target[env, i] + node_drive[i] * aim) / (wp.float64(1.0) + node_drive[i])


@wp.kernel
def clear(active: IntArray, values: FloatArray):
    """Set the values of the active environments to 0."""
    env = wp.tid()
    if active[env] != 0:
        values[env] = wp.float64(0.0)


@wp.kernel
def lengths(p: VecArray2d, residual: VecArray2d, size: FloatArray2d):
    """‖p‖ node by node [m]; 1e300 where p or the residual is not finite."""
    env, i = wp.tid()
    length = wp.length(p[env, i])
    if not (length < wp.float64(1.0e100)) or not (wp.length(residual[env, i]) < wp.float64(1.0e100)):
        length = wp.float64(1.0e300)
    size[env, i] = length


@wp.kernel
def restart(right_side: VecArray2d, again: IntArray, residual: VecArray2d, p: VecArray2d):
    """Restore the right-hand side and clear the solution."""
    env, i = wp.tid()
    if again[env] != 0:
        residual[env, i] = right_side[env, i]
        p[env, i] = wp.vec3d()


@wp.kernel
def slope_of(p: VecArray2d, gradient: VecArray2d, slope: FloatArray2d):
    """g·p node by node [J]; p is zero on bonded nodes."""
    env, i = wp.tid()
    slope[env, i] = wp.dot(p[env, i], gradient[env, i])


# Not one generic kernel: a recording on a CPU tells kernels apart by name (Warp 1.19), and would run either form for both types.
@wp.kernel
def take_vectors(y1: VecArray2d, mask: IntArray, y: VecArray2d):
    """y = y1 where the mask is set."""
    env, i = wp.tid()
    if mask[env] != 0:
        y[env, i] = y1[env, i]


@wp.kernel
def take_matrices(R1: MatArray2d, mask: IntArray, R: MatArray2d):
    """R = R1 where the mask is set."""
    env, i = wp.tid()
    if mask[env] != 0:
        R[env, i] = R1[env, i]


@wp.kernel
def difference(a: VecArray2d, b: VecArray2d, out: VecArray2d):
    """out = a − b."""
    env, i = wp.tid()
    out[env, i] = a[env, i] - b[env, i]
