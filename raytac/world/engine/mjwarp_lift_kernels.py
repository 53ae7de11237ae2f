"""Response of gels' rows to forces, and lifts of slides, on states of MuJoCo Warp."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.lift_kernels import Lifts, check_lifts, solve_lifts
from raytac.physics.rigid.response_kernels import ACTIVE, ON_CONE, add_cone, add_row, vec6d
from raytac.physics.rigid.world_kernels import ROWS, Slots, Steps
from raytac.world.engine.mjwarp_kernels import Own, Worlds, is_scaled, row_times

wp.set_module_options({"enable_backward": False, "fast_math": False})

_ROWS = wp.constant(wp.int32(ROWS))
_CONTACT = wp.constant(wp.int32(5))
"""First type of constraint that is a contact, in MuJoCo's ``mjtConstraint``."""
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))


@wp.func
def copy_row(
    worlds: Worlds, i: wp.int32, row: wp.int32, factor: wp.float64, target: wp.array3d(dtype=wp.float64), place: wp.int32
):
    """Copy a row of the constraint's Jacobian times ``factor``."""
    if worlds.sparse != 0:
        for k in range(worlds.nv):
            target[i, place, k] = _0
        start = worlds.rowadr[i, row] + 0
        for k in range(start, start + worlds.rownnz[i, row]):
            target[i, place, worlds.colind[i, 0, k]] = factor * wp.float64(worlds.J[i, 0, k])
    else:
        for k in range(worlds.nv):
            target[i, place, k] = factor * wp.float64(worlds.J[i, row, k])


@wp.func
def read_mass(
    worlds: Worlds,
    own: Own,
    entries: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.int32),
    lifts: Lifts,
    i: wp.int32,
    count: wp.int32,
):
    """Mass matrix with the constraints of all other rows; see ``response_kernels``.

    Other than those of the first ``count`` contacts of gels. ``entries``, ``starts``, ``columns``: of MuJoCo Warp's sparse lower triangle.
    """
    response = lifts.response
    for m in range(worlds.nv):
        for n in range(worlds.nv):
            response.mass[i, m, n] = _0
        for k in range(starts[m], starts[m] + entries[m]):
            response.mass[i, m, columns[k]] = wp.float64(worlds.M[i, k])
    impratio = wp.float64(worlds.impratio_invsqrt[i % worlds.impratio_invsqrt.shape[0]])
    for row in range(worlds.nefc[i]):
        contact, searched = wp.int32(-1), wp.bool(False)
        if worlds.row_type[i, row] >= _CONTACT:
            contact = worlds.id[i, row] + 0
            if contact >= own.first[0]:
                for k in range(count):
                    searched = searched or own.contact[i, lifts.slot[i, k][0], lifts.slot[i, k][1]] == contact
        if not searched:
            if worlds.state[i, row] == ACTIVE:
                copy_row(worlds, i, row, _1, response.other, 0)
                add_row(response, i, wp.float64(worlds.D[i, row]), 0, 0)
            if worlds.state[i, row] == ON_CONE and row == worlds.efc_address[contact, 0]:
                friction, residual, rows = vec6d(), vec6d(), worlds.dim[contact] + 0
                for m in range(rows):
                    other = worlds.efc_address[contact, m] + 0
                    copy_row(worlds, i, other, _1, response.other, m)
                    residual[m] = row_times(worlds, i, other, worlds.qacc) - wp.float64(worlds.aref[i, other])
                    if m > 0:
                        friction[m] = wp.float64(worlds.friction[contact][m - 1])
                add_cone(response, i, rows, wp.float64(worlds.D[i, row]), friction[1] * impratio, friction, residual)


@wp.kernel
def correct_lifts(
    worlds: Worlds,
    own: Own,
    steps: Steps,
    slots: Slots,
    entries: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.int32),
    velocity: wp.array4d(dtype=wp.float64),
    lifts: Lifts,
):
    """Set the lifts of slides that begin or end; see ``lift_kernels``.

    They follow from MuJoCo's speeds for the end of the step. ``entries``, ``starts``, ``columns``: as of ``read_mass``.
    """
    i = wp.tid()
    sound = wp.bool(True)
    for k in range(worlds.nv):
        sound = sound and wp.isfinite(worlds.qacc[i, k])
    if sound:
        # The next solve, which may differ by lifts, begins with this solution.
        for k in range(worlds.nv):
            worlds.qacc_warmstart[i, k] = worlds.qacc[i, k]
    if steps.slides[i] == 0 or steps.lost[i] != 0:
        return
    step = steps.length[i]
    for pad in range(slots.held.shape[1]):
        for body in range(slots.held.shape[2]):
            k = own.contact[i, pad, body]
            if k >= 0:
                for m in range(_ROWS):
                    row = worlds.efc_address[k, m] + 0
                    if row < 0:
                        return
                    ahead = wp.float64(worlds.vel[i, row]) + step * row_times(worlds, i, row, worlds.qacc)
                    velocity[i, pad, body, m] = ahead / wp.where(is_scaled(m), own.scale[i, pad, body], _1)
    if check_lifts(steps, slots, velocity, lifts, i):
        count = wp.min(steps.contacts[i] + 0, lifts.slot.shape[1])
        for k in range(count):
            pad, body = lifts.slot[i, k][0], lifts.slot[i, k][1]
            for m in range(_ROWS):
                row = worlds.efc_address[own.contact[i, pad, body], m] + 0
                scale = wp.where(is_scaled(m), own.scale[i, pad, body], _1)
                copy_row(worlds, i, row, _1 / scale, lifts.response.rows, _ROWS * k + m)
                lifts.force[i, _ROWS * k + m] = scale * wp.float64(worlds.force[i, row])
        read_mass(worlds, own, entries, starts, columns, lifts, i, count)
        solve_lifts(steps, slots, lifts, i, count)
    for pad in range(slots.held.shape[1]):
        for body in range(slots.held.shape[2]):
            k = own.contact[i, pad, body]
            if k >= 0:
                row = worlds.efc_address[k, 0]
                wanted = slots.force[i, pad, body, 0] * slots.regularisation[i, pad, body, 0]
                worlds.aref[i, row] = wp.float32(wanted - wp.float64(worlds.vel[i, row]) / step)
