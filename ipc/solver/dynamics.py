"""Inertia, drag and drives of the nodes, and the energy and gradient that they add.

Backward Euler minimises ½‖x − x̃‖²_M/h² + potentials with x̃ = x_n + h v_n + h² a. A frame's rotation keeps lengths, so the same energy holds
in frame coordinates with ỹ = Rᵀ(x̃ − t): there are no fictitious forces, and a bonded vertex is a constant.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from typing import Any

import warp as wp

from ipc.solver.frames import VertexMap

__all__ = [
    "Masses",
    "advance_nodes",
    "aim_bodies",
    "difference",
    "inertia_change",
    "inertia_target",
    "kinetic_energy",
    "lengths",
    "new_velocity",
    "node_gradient",
    "predict",
    "restart",
    "slope_of",
    "take",
]

wp.set_module_options({"enable_backward": False})


@wp.struct
class Masses:
    """Mass matrix [kg] in the block pattern, ``inertia`` with drives [kg], ``drag`` [kg/s²]."""

    row_start: wp.array(dtype=wp.int32)
    col: wp.array(dtype=wp.int32)
    mass: wp.array(dtype=wp.float64)
    inertia: wp.array(dtype=wp.float64)
    drag: wp.array(dtype=wp.float64)


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
    """Adds inertia, drag and contact to the elastic gradient.

    The residual is its negative on the unknowns, zero on bonded nodes.
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
    """Change of the inertial and drag energy [J], (y1 − y0)·M((y1 + y0)/2 − ỹ)/h² by node."""
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
def aim_bodies(
    goal_q: wp.array2d(dtype=wp.quatd),
    goal_p: wp.array2d(dtype=wp.vec3d),
    node_drive: wp.array(dtype=wp.float64),
    node_aim: wp.array(dtype=wp.int32),
    aim_local: wp.array(dtype=wp.vec3d),
    # outputs
    target: wp.array2d(dtype=wp.vec3d),
):
    """x̃ ← (x̃ + s x_aim)/(1 + s), the target of inertia and a drive of strength s together."""
    env, i = wp.tid()
    frame = node_aim[i]
    if frame >= 0:
        aim = wp.quat_rotate(goal_q[env, frame], aim_local[i]) + goal_p[env, frame]
        target[env, i] = (target[env, i] + node_drive[i] * aim) / (wp.float64(1.0) + node_drive[i])


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
