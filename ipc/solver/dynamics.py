"""Frames, inertia, and the maps between nodes (unknowns, in their body's frame) and vertices (surface points, in the world).

Backward Euler minimises ½‖x − x̃‖²_M/h² + potentials with x̃ = x_n + h v_n + h² a.
Because a frame's rotation keeps lengths, the same energy holds in frame coordinates with ỹ = Rᵀ(x̃ − t): no fictitious forces, and a
bonded vertex is a constant.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from typing import Any

import warp as wp

__all__ = [
    "Masses",
    "VertexMap",
    "advance_nodes",
    "aim_bodies",
    "compare_frames",
    "difference",
    "frames_at",
    "inertia_change",
    "inertia_target",
    "kinetic_energy",
    "lengths",
    "lift_grips",
    "new_velocity",
    "node_gradient",
    "node_world",
    "place_grips",
    "predict",
    "restart",
    "slope_of",
    "take",
    "vertex_motion",
    "vertex_positions",
]

wp.set_module_options({"enable_backward": False})


@wp.struct
class VertexMap:
    """Nodes that the vertices follow, and the vertices that follow a node; names as in :class:`ipc.bodies.layout.Layout`."""

    body: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)
    nodes: wp.array2d(dtype=wp.int32)
    weight: wp.array2d(dtype=wp.float64)
    local: wp.array(dtype=wp.vec3d)
    follower_start: wp.array(dtype=wp.int32)
    follower: wp.array(dtype=wp.int32)
    follower_weight: wp.array(dtype=wp.float64)


@wp.struct
class Masses:
    """Entries of the mass matrix in the block pattern: ``mass`` [kg], ``inertia`` with the drives on top [kg], ``drag`` [kg/s²]."""

    row_start: wp.array(dtype=wp.int32)
    col: wp.array(dtype=wp.int32)
    mass: wp.array(dtype=wp.float64)
    inertia: wp.array(dtype=wp.float64)
    drag: wp.array(dtype=wp.float64)


@wp.kernel
def frames_at(
    start_q: wp.array2d(dtype=wp.quatd),
    start_p: wp.array2d(dtype=wp.vec3d),
    end_q: wp.array2d(dtype=wp.quatd),
    end_p: wp.array2d(dtype=wp.vec3d),
    progress: wp.array(dtype=wp.float64),
    # outputs
    R: wp.array2d(dtype=wp.mat33d),
    t: wp.array2d(dtype=wp.vec3d),
    now_q: wp.array2d(dtype=wp.quatd),
):
    """Frames at a share of the motion from start to end: positions along a line, rotations along the shorter arc."""
    env, b = wp.tid()
    s = progress[env]
    q0 = start_q[env, b]
    sign = wp.float64(1.0)
    if wp.dot(q0, end_q[env, b]) < wp.float64(0.0):
        sign = wp.float64(-1.0)
    q1 = sign * end_q[env, b]
    q = sign * end_q[env, b]
    if s < wp.float64(1.0):
        if wp.dot(q0, q1) < wp.float64(0.99999999999999):
            q = wp.normalize(wp.quat_slerp(q0, q1, s))
        else:
            # A turn of less than 3e-7 rad, whose arc and chord are the same to rounding.
            q = wp.normalize((wp.float64(1.0) - s) * q0 + s * q1)
    now_q[env, b] = q
    R[env, b] = wp.quat_to_matrix(q)
    t[env, b] = start_p[env, b] + s * (end_p[env, b] - start_p[env, b])
    if s == wp.float64(1.0):
        t[env, b] = end_p[env, b]


@wp.kernel
def vertex_positions(
    y: wp.array2d(dtype=wp.vec3d),
    R: wp.array2d(dtype=wp.mat33d),
    t: wp.array2d(dtype=wp.vec3d),
    verts: VertexMap,
    # outputs
    x: wp.array2d(dtype=wp.vec3d),
):
    """World positions of the vertices."""
    env, v = wp.tid()
    local = wp.vec3d()
    if verts.count[v] == 0:
        local = verts.local[v]
    for k in range(verts.count[v]):
        local += verts.weight[v, k] * y[env, verts.nodes[v, k]]
    x[env, v] = R[env, verts.body[v]] * local + t[env, verts.body[v]]


@wp.kernel
def vertex_motion(
    p: wp.array2d(dtype=wp.vec3d),
    R: wp.array2d(dtype=wp.mat33d),
    verts: VertexMap,
    # outputs
    dx: wp.array2d(dtype=wp.vec3d),
):
    """World displacements of the vertices for the node displacements p."""
    env, v = wp.tid()
    local = wp.vec3d()
    for k in range(verts.count[v]):
        local += verts.weight[v, k] * p[env, verts.nodes[v, k]]
    dx[env, v] = R[env, verts.body[v]] * local


@wp.kernel
def node_world(
    y: wp.array2d(dtype=wp.vec3d),
    R: wp.array2d(dtype=wp.mat33d),
    t: wp.array2d(dtype=wp.vec3d),
    node_body: wp.array(dtype=wp.int32),
    # outputs
    xw: wp.array2d(dtype=wp.vec3d),
):
    """World positions of the nodes."""
    env, i = wp.tid()
    xw[env, i] = R[env, node_body[i]] * y[env, i] + t[env, node_body[i]]


@wp.kernel
def predict(
    xw: wp.array2d(dtype=wp.vec3d),
    v: wp.array2d(dtype=wp.vec3d),
    acceleration: wp.array(dtype=wp.vec3d),
    h: wp.float64,
    # outputs
    target: wp.array2d(dtype=wp.vec3d),
):
    """x̃ of the nodes, world frame."""
    env, i = wp.tid()
    target[env, i] = xw[env, i] + h * v[env, i] + h * h * acceleration[env]


@wp.kernel
def inertia_target(
    target: wp.array2d(dtype=wp.vec3d),
    xw: wp.array2d(dtype=wp.vec3d),
    R: wp.array2d(dtype=wp.mat33d),
    t: wp.array2d(dtype=wp.vec3d),
    node_body: wp.array(dtype=wp.int32),
    # outputs
    local_target: wp.array2d(dtype=wp.vec3d),
    local_start: wp.array2d(dtype=wp.vec3d),
):
    """ỹ and the start position of the nodes in the frames as they are now."""
    env, i = wp.tid()
    Rt = wp.transpose(R[env, node_body[i]])
    local_target[env, i] = Rt * (target[env, i] - t[env, node_body[i]])
    local_start[env, i] = Rt * (xw[env, i] - t[env, node_body[i]])


@wp.kernel
def node_gradient(
    y: wp.array2d(dtype=wp.vec3d),
    local_target: wp.array2d(dtype=wp.vec3d),
    local_start: wp.array2d(dtype=wp.vec3d),
    masses: Masses,
    inertia_scale: wp.float64,
    vert_gradient: wp.array2d(dtype=wp.vec3d),
    R: wp.array2d(dtype=wp.mat33d),
    node_body: wp.array(dtype=wp.int32),
    node_free: wp.array(dtype=wp.int32),
    verts: VertexMap,
    active: wp.array(dtype=wp.int32),
    # outputs
    gradient: wp.array2d(dtype=wp.vec3d),
    residual: wp.array2d(dtype=wp.vec3d),
    force_size: wp.array2d(dtype=wp.float64),
):
    """Adds inertia, drag and contact to the elastic gradient; the residual is its negative on the unknowns, zero on bonded nodes.

    ``force_size`` is the sum of the sizes of elastic and contact force [N], which scales the rounding of energies.
    """
    env, i = wp.tid()
    if active[env] == 0:
        return
    g = gradient[env, i]
    elastic = wp.length(g)
    for k in range(masses.row_start[i], masses.row_start[i + 1]):
        j = masses.col[k]
        if masses.inertia[k] != wp.float64(0.0):
            pull = (masses.inertia[k] * inertia_scale) * (y[env, j] - local_target[env, j])
            g += pull + masses.drag[k] * (y[env, j] - local_start[env, j])
    contact = wp.vec3d()
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
    y0: wp.array2d(dtype=wp.vec3d),
    y1: wp.array2d(dtype=wp.vec3d),
    local_target: wp.array2d(dtype=wp.vec3d),
    local_start: wp.array2d(dtype=wp.vec3d),
    masses: Masses,
    inertia_scale: wp.float64,
    active: wp.array(dtype=wp.int32),
    # outputs
    change: wp.array2d(dtype=wp.float64),
):
    """Change of the inertial and drag energy from y0 to y1 [J], (y1 − y0)·M((y1 + y0)/2 − ỹ)/h² node by node."""
    env, i = wp.tid()
    if active[env] == 0:
        return
    half = wp.float64(0.5)
    f = wp.vec3d()
    for k in range(masses.row_start[i], masses.row_start[i + 1]):
        j = masses.col[k]
        if masses.inertia[k] != wp.float64(0.0):
            mean = half * (y0[env, j] + y1[env, j])
            pull = (masses.inertia[k] * inertia_scale) * (mean - local_target[env, j])
            f += pull + masses.drag[k] * (mean - local_start[env, j])
    change[env, i] = wp.dot(y1[env, i] - y0[env, i], f)


@wp.kernel
def new_velocity(
    xw_new: wp.array2d(dtype=wp.vec3d),
    xw: wp.array2d(dtype=wp.vec3d),
    h: wp.float64,
    active: wp.array(dtype=wp.int32),
    # outputs
    v: wp.array2d(dtype=wp.vec3d),
):
    """Velocities at the end of the step, world frame."""
    env, i = wp.tid()
    if active[env] != 0:
        v[env, i] = (xw_new[env, i] - xw[env, i]) / h


@wp.kernel
def kinetic_energy(
    v: wp.array2d(dtype=wp.vec3d),
    masses: Masses,
    # outputs
    energy: wp.array2d(dtype=wp.float64),
):
    """½ v·M v node by node [J]."""
    env, i = wp.tid()
    f = wp.vec3d()
    for k in range(masses.row_start[i], masses.row_start[i + 1]):
        f += masses.mass[k] * v[env, masses.col[k]]
    energy[env, i] = wp.float64(0.5) * wp.dot(v[env, i], f)


@wp.kernel
def advance_nodes(
    y: wp.array2d(dtype=wp.vec3d),
    p: wp.array2d(dtype=wp.vec3d),
    alpha: wp.array(dtype=wp.float64),
    y1: wp.array2d(dtype=wp.vec3d),
):
    """y1 = y + alpha p."""
    env, i = wp.tid()
    y1[env, i] = y[env, i] + alpha[env] * p[env, i]


@wp.kernel
def compare_frames(
    frame_q: wp.array2d(dtype=wp.quatd),
    frame_p: wp.array2d(dtype=wp.vec3d),
    goal_q: wp.array2d(dtype=wp.quatd),
    goal_p: wp.array2d(dtype=wp.vec3d),
    moves: wp.array(dtype=wp.int32),
    # outputs
    progress: wp.array(dtype=wp.float64),
):
    """progress = 0 where a frame has to move, else 1."""
    env = wp.tid()
    progress[env] = wp.float64(1.0)
    for b in range(frame_q.shape[1]):
        if moves[b] != 0:
            p, q = frame_p[env, b], goal_p[env, b]
            r, s = frame_q[env, b], goal_q[env, b]
            if p[0] != q[0] or p[1] != q[1] or p[2] != q[2] or r[0] != s[0] or r[1] != s[1] or r[2] != s[2] or r[3] != s[3]:
                progress[env] = wp.float64(0.0)


@wp.kernel
def aim_bodies(
    goal_q: wp.array2d(dtype=wp.quatd),
    goal_p: wp.array2d(dtype=wp.vec3d),
    node_drive: wp.array(dtype=wp.float64),
    node_aim: wp.array(dtype=wp.int32),
    aim_local: wp.array(dtype=wp.vec3d),
    # outputs
    target: wp.array2d(dtype=wp.vec3d),
):
    """x̃ ← (x̃ + s x_aim)/(1 + s): inertia towards x̃ and a drive of strength s towards x_aim are one quadratic of 1 + s times the mass."""
    env, i = wp.tid()
    frame = node_aim[i]
    if frame >= 0:
        aim = wp.quat_rotate(goal_q[env, frame], aim_local[i]) + goal_p[env, frame]
        target[env, i] = (target[env, i] + node_drive[i] * aim) / (wp.float64(1.0) + node_drive[i])


@wp.kernel
def place_grips(
    grip_node: wp.array(dtype=wp.int32),
    grip_frame: wp.array(dtype=wp.int32),
    grip_local: wp.array(dtype=wp.vec3d),
    node_body: wp.array(dtype=wp.int32),
    R: wp.array2d(dtype=wp.mat33d),
    t: wp.array2d(dtype=wp.vec3d),
    # outputs
    y: wp.array2d(dtype=wp.vec3d),
):
    """Positions y of gripped nodes, which move with the frame of their grip, in the frame of their body."""
    env, g = wp.tid()
    node, frame = grip_node[g], grip_frame[g]
    body = node_body[node]
    world = R[env, frame] * grip_local[g] + t[env, frame]
    y[env, node] = wp.transpose(R[env, body]) * (world - t[env, body])


@wp.kernel
def lift_grips(
    grip_node: wp.array(dtype=wp.int32),
    y: wp.array2d(dtype=wp.vec3d),
    y1: wp.array2d(dtype=wp.vec3d),
    # outputs
    lift: wp.array2d(dtype=wp.vec3d),
):
    """lift = y1 − y of the gripped nodes."""
    env, g = wp.tid()
    lift[env, grip_node[g]] = y1[env, grip_node[g]] - y[env, grip_node[g]]


@wp.kernel
def lengths(p: wp.array2d(dtype=wp.vec3d), residual: wp.array2d(dtype=wp.vec3d), size: wp.array2d(dtype=wp.float64)):
    """‖p‖ node by node [m]; 1e300 where p or the residual is not finite."""
    env, i = wp.tid()
    length = wp.length(p[env, i])
    if not (length < wp.float64(1.0e100)) or not (wp.length(residual[env, i]) < wp.float64(1.0e100)):
        length = wp.float64(1.0e300)
    size[env, i] = length


@wp.kernel
def restart(
    right_side: wp.array2d(dtype=wp.vec3d),
    again: wp.array(dtype=wp.int32),
    residual: wp.array2d(dtype=wp.vec3d),
    p: wp.array2d(dtype=wp.vec3d),
):
    """Restores the right-hand side and clears the solution."""
    env, i = wp.tid()
    if again[env] != 0:
        residual[env, i] = right_side[env, i]
        p[env, i] = wp.vec3d()


@wp.kernel
def slope_of(p: wp.array2d(dtype=wp.vec3d), gradient: wp.array2d(dtype=wp.vec3d), slope: wp.array2d(dtype=wp.float64)):
    """g·p node by node [J]; p is zero on bonded nodes."""
    env, i = wp.tid()
    slope[env, i] = wp.dot(p[env, i], gradient[env, i])


@wp.kernel
def take(y1: wp.array2d(dtype=Any), mask: wp.array(dtype=wp.int32), y: wp.array2d(dtype=Any)):
    """y = y1 where the mask is set."""
    env, i = wp.tid()
    if mask[env] != 0:
        y[env, i] = y1[env, i]


# All types at once, so that the module is compiled only once.
for _type in (wp.vec3d, wp.mat33d):
    wp.overload(take, [wp.array2d(dtype=_type), wp.array(dtype=wp.int32), wp.array2d(dtype=_type)])


@wp.kernel
def difference(a: wp.array2d(dtype=wp.vec3d), b: wp.array2d(dtype=wp.vec3d), out: wp.array2d(dtype=wp.vec3d)):
    """out = a − b."""
    env, i = wp.tid()
    out[env, i] = a[env, i] - b[env, i]
