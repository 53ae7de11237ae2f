"""Kernels of ``SoftReader``: state of a solver's world for one pad, and what is shown of it."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.soft.clearance_kernels import Hats, between_vertices
from raytac.physics.soft.coat_kernels import Coat, on_pad, rest_at
from raytac.physics.soft.correction.plane_kernels import Lines, sampled

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_NAN = wp.constant(wp.float64(float("nan")))
_NAN32 = wp.constant(wp.float32(float("nan")))
_INF = wp.constant(wp.float64(float("inf")))


@wp.func
def is_finite(v: wp.vec3d):
    return wp.isfinite(v[0]) and wp.isfinite(v[1]) and wp.isfinite(v[2])


@wp.kernel
def find_sound(
    failed: wp.array(dtype=wp.bool), vertices: wp.array2d(dtype=wp.vec3d), forces: wp.array2d(dtype=wp.vec3d),
    poses: wp.array2d(dtype=wp.mat44d),
    # outputs
    sound: wp.array(dtype=wp.int32),
):  # fmt: skip
    """1 in environments that have not failed and in which every number is finite."""
    env = wp.tid()
    mark = wp.int32(1)
    if failed[env]:
        mark = wp.int32(0)
    for v in range(vertices.shape[1]):
        if not is_finite(vertices[env, v]) or not is_finite(forces[env, v]):
            mark = wp.int32(0)
    for k in range(poses.shape[1]):
        pose = poses[env, k]
        for i in range(4):
            for j in range(4):
                if not wp.isfinite(pose[i, j]):
                    mark = wp.int32(0)
    sound[env] = mark


@wp.kernel
def find_sound_surfaces(vertices: wp.array2d(dtype=wp.vec3d), sound: wp.array(dtype=wp.int32)):
    """0 in environments in which a vertex is not finite, by (environment, vertex)."""
    env, v = wp.tid()
    if not is_finite(vertices[env, v]):
        sound[env] = 0


@wp.kernel
def choose_plain(
    clearance: wp.array(dtype=wp.float64), touching: wp.array2d(dtype=wp.bool),
    # outputs
    plain: wp.array(dtype=wp.int32),
):  # fmt: skip
    """1 where the plain height counts: out of contact, or below several objects."""
    env = wp.tid()
    count = wp.int32(0)
    for k in range(touching.shape[1]):
        if touching[env, k]:
            count += 1
    plain[env] = wp.where(wp.isfinite(clearance[env]) and count < 2, 0, 1)


@wp.kernel
def show_plain(
    hats: Hats, columns: wp.int32, d_hat: wp.float64, load: wp.array2d(dtype=wp.float64), clearance: wp.array(dtype=wp.float64),
    rest: wp.array2d(dtype=wp.float64), rise: wp.array3d(dtype=wp.float32), under: wp.array3d(dtype=wp.float64),
    # outputs
    height: wp.array3d(dtype=wp.float32),
    contact: wp.array3d(dtype=wp.uint8),
    sound: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Height without correction along a row, and contact where loaded vertices are near.

    An environment with a height that is not finite is not ``sound``.
    """
    env, row = wp.tid()
    touched = wp.isfinite(clearance[env])
    i, end = wp.int32(0), height.shape[2]
    while i < end:
        z = wp.float32(rest[row, i] + wp.float64(rise[env, row, i]))
        height[env, row, i] = z
        if not wp.isfinite(z):
            sound[env] = 0
        mark = wp.uint8(0)
        bears = between_vertices(hats, columns, load, env, row, i) > _0
        if touched and bears and under[env, row, i] - wp.float64(z) < d_hat:
            mark = wp.uint8(1)
        contact[env, row, i] = mark
        i += 1


@wp.kernel
def place_coat(
    coat: Coat, clearance: wp.array(dtype=wp.float64), sideways: wp.array2d(dtype=wp.float64), lines: Lines,
    height: wp.array3d(dtype=wp.float32), rest: wp.array3d(dtype=wp.float32), vertices: wp.array2d(dtype=wp.vec3d),
    # outputs
    out: wp.array2d(dtype=wp.vec3d),
):  # fmt: skip
    """Vertices of the coat on the height that is shown, after the correction of a contact."""
    env, v = wp.tid()
    if not wp.isfinite(clearance[env]):
        out[env, v] = vertices[env, v]
        return
    count = coat.rest.shape[0]
    x, y = coat.rest[v][0] + sideways[env, v], coat.rest[v][1] + sideways[env, count + v]
    # Beyond the pad's edge the height is that at the edge.
    at = wp.vec2d(on_pad(coat.lines_x, x), on_pad(coat.lines_y, y))
    rise = sampled(height, env, lines, at) - sampled(rest, 0, lines, at)
    out[env, v] = wp.vec3d(x, y, rest_at(coat, at[0], at[1]) + rise)


@wp.kernel
def find_centres(
    sound: wp.array(dtype=wp.int32), clearance: wp.array(dtype=wp.float64), forces: wp.array2d(dtype=wp.vec3d),
    vertices: wp.array2d(dtype=wp.vec3d),
    # outputs
    centre: wp.array(dtype=wp.vec2d),
):  # fmt: skip
    """Mean place of the normal load [m], NaN out of contact."""
    env = wp.tid()
    centre[env] = wp.vec2d(_NAN, _NAN)
    if sound[env] == 0 or not wp.isfinite(clearance[env]):
        return
    total, middle = wp.float64(0.0), wp.vec2d()
    for v in range(forces.shape[1]):
        load = wp.max(-forces[env, v][2], _0)
        total += load
        middle += load * wp.vec2d(vertices[env, v][0], vertices[env, v][1])
    centre[env] = middle / total


@wp.kernel
def hide_nodes(
    sound: wp.array(dtype=wp.int32),
    # outputs
    height: wp.array3d(dtype=wp.float32),
    contact: wp.array3d(dtype=wp.uint8),
    under: wp.array3d(dtype=wp.float64),
):  # fmt: skip
    """NaN and no contact where an environment is not sound, along a row."""
    env, row = wp.tid()
    if sound[env] == 0:
        for i in range(height.shape[2]):
            height[env, row, i] = _NAN32
            contact[env, row, i] = wp.uint8(0)
            under[env, row, i] = _INF


@wp.kernel
def hide_coats(
    sound: wp.array(dtype=wp.int32), solved: wp.array(dtype=wp.float64),
    # outputs
    coat: wp.array2d(dtype=wp.vec3d),
    clearance: wp.array(dtype=wp.float64),
    centre: wp.array(dtype=wp.vec2d),
    residual: wp.array(dtype=wp.float64),
    failed: wp.array(dtype=wp.bool),
):  # fmt: skip
    """NaN where an environment is not sound, and the residual of those in contact."""
    env = wp.tid()
    failed[env] = sound[env] == 0
    residual[env] = _NAN
    if sound[env] == 0:
        for v in range(coat.shape[1]):
            coat[env, v] = wp.vec3d(_NAN, _NAN, _NAN)
        clearance[env] = _NAN
        centre[env] = wp.vec2d(_NAN, _NAN)
    elif wp.isfinite(clearance[env]) and solved.shape[0] > 0:
        residual[env] = solved[env]
        if residual[env] > wp.float64(1e200):
            residual[env] = _0  # nothing was near enough to be searched


@wp.kernel
def read_coat(
    nodes: wp.array2d(dtype=wp.vec3d), node: wp.array(dtype=wp.int32), surface_forces: wp.array2d(dtype=wp.vec3d),
    vertex: wp.array(dtype=wp.int32), rotation: wp.array(dtype=wp.mat33d),
    # outputs
    vertices: wp.array2d(dtype=wp.vec3d),
    forces: wp.array2d(dtype=wp.vec3d),
):  # fmt: skip
    """Vertices of a coat and forces on them in the pad's frame, from the solver's arrays."""
    env, v = wp.tid()
    vertices[env, v] = nodes[env, node[v]]
    forces[env, v] = wp.transpose(rotation[env]) * surface_forces[env, vertex[v]]


@wp.kernel
def read_touching(
    count: wp.array(dtype=wp.int32), pair: wp.array2d(dtype=wp.int32), object_of: wp.array(dtype=wp.int32),
    # outputs
    touching: wp.array2d(dtype=wp.bool),
):  # fmt: skip
    """Objects closer to a pad than d̂, by environment.

    ``object_of``: of each pair of bodies, −1 for none.
    """
    env = wp.tid()
    for k in range(touching.shape[1]):
        touching[env, k] = False
    for c in range(wp.min(count[env], pair.shape[1])):
        k = object_of[pair[env, c]]
        if k >= 0:
            touching[env, k] = True


@wp.func
def from_pad(rotation: wp.mat33d, position: wp.vec3d, turn: wp.mat33d, place: wp.vec3d) -> wp.mat44d:
    """Pose of a frame (``turn``, ``place``) in that of a pad (``rotation``, ``position``)."""
    R = wp.transpose(rotation) * turn
    p = wp.transpose(rotation) * (place - position)
    return wp.mat44d(
        R[0, 0], R[0, 1], R[0, 2], p[0],
        R[1, 0], R[1, 1], R[1, 2], p[1],
        R[2, 0], R[2, 1], R[2, 2], p[2],
        _0, _0, _0, wp.float64(1.0),
    )  # fmt: skip


@wp.kernel
def read_driven_pose(
    rotation: wp.array(dtype=wp.mat33d), position: wp.array(dtype=wp.vec3d), turn: wp.array(dtype=wp.mat33d),
    place: wp.array(dtype=wp.vec3d), k: wp.int32,
    # outputs
    poses: wp.array2d(dtype=wp.mat44d),
):  # fmt: skip
    """Pose of a driven body before a pad, to column ``k``."""
    env = wp.tid()
    poses[env, k] = from_pad(rotation[env], position[env], turn[env], place[env])


@wp.kernel
def read_affine_pose(
    rotation: wp.array(dtype=wp.mat33d), position: wp.array(dtype=wp.vec3d), nodes: wp.array2d(dtype=wp.vec3d),
    gradients: wp.array(dtype=wp.vec3d), first: wp.vec3d, k: wp.int32,
    # outputs
    poses: wp.array2d(dtype=wp.mat44d),
):  # fmt: skip
    """Pose of an affine body x = A X + p before a pad, to column ``k``.

    It is the rotation nearest to A, and p. ``gradients``: of the hat functions of its corners, (4,); ``first``: the first corner at
    rest, body frame.
    """
    env = wp.tid()
    A = wp.mat33d()
    for c in range(4):
        A += wp.outer(nodes[env, c], gradients[c])
    U, _s, V = wp.svd3(A)
    turn = U * wp.transpose(V)
    poses[env, k] = from_pad(rotation[env], position[env], turn, nodes[env, 0] - A * first)


@wp.kernel
def read_surface(
    rotation: wp.array(dtype=wp.mat33d), position: wp.array(dtype=wp.vec3d), world: wp.array2d(dtype=wp.vec3d),
    # outputs
    vertices: wp.array2d(dtype=wp.vec3d),
):  # fmt: skip
    """Points of the world in the frame of a pad, by (environment, vertex)."""
    env, v = wp.tid()
    vertices[env, v] = wp.transpose(rotation[env]) * (world[env, v] - position[env])


@wp.kernel
def read_skin(
    rotation: wp.array(dtype=wp.mat33d), position: wp.array(dtype=wp.vec3d), own_rotation: wp.array(dtype=wp.mat33d),
    own_position: wp.array(dtype=wp.vec3d), nodes: wp.array2d(dtype=wp.vec3d), node: wp.array2d(dtype=wp.int32),
    weight: wp.array2d(dtype=wp.float64),
    # outputs
    vertices: wp.array2d(dtype=wp.vec3d),
):  # fmt: skip
    """Points of a ``SoftSkin`` in the frame of a pad, of nodes in the frame of their body."""
    env, v = wp.tid()
    local = wp.vec3d()
    for k in range(node.shape[1]):
        local += weight[v, k] * nodes[env, node[v, k]]
    world = own_rotation[env] * local + own_position[env]
    vertices[env, v] = wp.transpose(rotation[env]) * (world - position[env])
