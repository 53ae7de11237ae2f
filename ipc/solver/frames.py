"""Driven frames; maps between nodes (unknowns, body frames) and vertices (surface, world)."""

# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportInvalidTypeForm=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, FloatArray2d, IntArray, IntArray2d, MatArray2d, QuatArray2d, VecArray, VecArray2d

wp.set_module_options({"enable_backward": False})


@wp.struct
class VertexMap:
    """Nodes that vertices follow, and the inverse; see :class:`ipc.bodies.layout.Layout`."""

    body: IntArray
    count: IntArray
    nodes: IntArray2d
    weight: FloatArray2d
    local: VecArray
    follower_start: IntArray
    follower: IntArray
    follower_weight: FloatArray


@wp.kernel
def frames_at(
    start_q: QuatArray2d,
    start_p: VecArray2d,
    end_q: QuatArray2d,
    end_p: VecArray2d,
    progress: FloatArray,
    # outputs
    R: MatArray2d,
    t: VecArray2d,
    now_q: QuatArray2d,
):
    """Frames at a share of the motion: positions on a line, rotations on the shorter arc."""
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
def compare_frames(
    frame_q: QuatArray2d, frame_p: VecArray2d, goal_q: QuatArray2d, goal_p: VecArray2d, moves: IntArray, progress: FloatArray
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
def vertex_positions(y: VecArray2d, R: MatArray2d, t: VecArray2d, verts: VertexMap, x: VecArray2d):
    """World positions of the vertices."""
    env, v = wp.tid()
    local = wp.vec3d()
    if verts.count[v] == 0:
        local = verts.local[v]
    for k in range(verts.count[v]):
        local += verts.weight[v, k] * y[env, verts.nodes[v, k]]
    x[env, v] = R[env, verts.body[v]] * local + t[env, verts.body[v]]


@wp.kernel
def vertex_motion(p: VecArray2d, R: MatArray2d, verts: VertexMap, dx: VecArray2d):
    """World displacements of the vertices for the node displacements p."""
    env, v = wp.tid()
    local = wp.vec3d()
    for k in range(verts.count[v]):
        local += verts.weight[v, k] * p[env, verts.nodes[v, k]]
    dx[env, v] = R[env, verts.body[v]] * local


@wp.kernel
def node_world(y: VecArray2d, R: MatArray2d, t: VecArray2d, node_body: IntArray, xw: VecArray2d):
    """World positions of the nodes."""
    env, i = wp.tid()
    xw[env, i] = R[env, node_body[i]] * y[env, i] + t[env, node_body[i]]


@wp.kernel
def place_grips(
    grip_node: IntArray,
    grip_frame: IntArray,
    grip_local: VecArray,
    node_body: IntArray,
    R: MatArray2d,
    t: VecArray2d,
    # outputs
    y: VecArray2d,
):
    """Positions y of gripped nodes, moved by their grip, in the frame of their body."""
    env, g = wp.tid()
    node, frame = grip_node[g], grip_frame[g]
    body = node_body[node]
    world = R[env, frame] * grip_local[g] + t[env, frame]
    y[env, node] = wp.transpose(R[env, body]) * (world - t[env, body])


@wp.kernel
def lift_grips(grip_node: IntArray, y: VecArray2d, y1: VecArray2d, lift: VecArray2d):
    """lift = y1 − y of the gripped nodes."""
    env, g = wp.tid()
    lift[env, grip_node[g]] = y1[env, grip_node[g]] - y[env, grip_node[g]]
