"""Response of gels' rows to forces, and lifts of slides, on states of C MuJoCo."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.lift_kernels import Lifts, check_lifts, solve_lifts
from raytac.physics.rigid.response_kernels import ACTIVE, ON_CONE, Response, add_cone, add_row, vec6d
from raytac.physics.rigid.world_kernels import ROWS, Slots, Steps
from raytac.world.engine.c_kernels import Memory, doubles, integers, number, row_times, write_gel_references

wp.set_module_options({"enable_backward": False, "fast_math": False})

_ROWS = wp.constant(wp.int32(ROWS))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))


@wp.func
def copy_row(memory: Memory, env: wp.int32, row: wp.int32, target: wp.array3d(dtype=wp.float64), i: wp.int32, place: wp.int32):
    """Copy a row of the constraint's Jacobian, which MuJoCo keeps sparse or dense.

    Entries that a sparse row does not have become 0.
    """
    jacobian = doubles(memory, env, memory.efc_J)
    if memory.sparse[0] != 0:
        for k in range(memory.nv):
            target[i, place, k] = _0
        column, start = integers(memory, env, memory.efc_J_colind), integers(memory, env, memory.efc_J_rowadr)[row]
        for k in range(start, start + integers(memory, env, memory.efc_J_rownnz)[row]):
            target[i, place, column[k]] = jacobian[k]
    else:
        for k in range(memory.nv):
            target[i, place, k] = jacobian[row * memory.nv + k]


@wp.func
def read_mass(
    memory: Memory,
    env: wp.int32,
    entries: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.int32),
    response: Response,
    i: wp.int32,
    first: wp.int32,
    last: wp.int32,
):
    """Mass matrix with the constraints of all other rows; see ``response_kernels``.

    Other than those from ``first`` to ``last``. ``entries``, ``starts``, ``columns``: of MuJoCo's sparse lower triangle.
    """
    mass = doubles(memory, env, memory.M)
    for m in range(memory.nv):
        for n in range(memory.nv):
            response.mass[i, m, n] = _0
        for k in range(starts[m], starts[m] + entries[m]):
            response.mass[i, m, columns[k]] = mass[k]
    states, indices = integers(memory, env, memory.efc_state), integers(memory, env, memory.efc_id)
    stiffness, reference = doubles(memory, env, memory.efc_D), doubles(memory, env, memory.efc_aref)
    acceleration, contact = doubles(memory, env, memory.qacc), doubles(memory, env, memory.contact)
    dimensions = integers(memory, env, memory.contact)
    row, end = wp.int32(0), number(memory, env, memory.nefc)
    while row < end:
        rows = wp.int32(1)
        if row < first or row >= last:
            if states[row] == ACTIVE:
                copy_row(memory, env, row, response.other, i, 0)
                add_row(response, i, stiffness[row], 0, 0)
            elif states[row] == ON_CONE:
                at = indices[row] * memory.size
                rows = dimensions[2 * at + memory.dim]
                friction, residual = vec6d(), vec6d()
                for m in range(rows):
                    copy_row(memory, env, row + m, response.other, i, m)
                    residual[m] = row_times(memory, env, row + m, acceleration) - reference[row + m]
                    if m > 0:
                        friction[m] = contact[at + memory.friction + m - 1]
                add_cone(response, i, rows, stiffness[row], contact[at + memory.mu], friction, residual)
        row += rows


@wp.kernel
def correct_lifts(
    memory: Memory,
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
    if steps.slides[i] == 0 or steps.lost[i] != 0:
        return
    env, step = steps.envs[i], steps.length[i]
    before, carried = doubles(memory, env, memory.efc_vel), doubles(memory, env, memory.efc_force)
    acceleration = doubles(memory, env, memory.qacc)
    first = number(memory, env, memory.nefc) - _ROWS * steps.contacts[i]
    row, sound = wp.int32(first), wp.bool(True)
    for pad in range(slots.held.shape[1]):
        for body in range(slots.held.shape[2]):
            if slots.held[i, pad, body] != 0:
                m = wp.int32(0)
                while m < _ROWS:
                    ahead = before[row] + step * row_times(memory, env, row, acceleration)
                    velocity[i, pad, body, m] = ahead
                    sound = sound and wp.isfinite(ahead)
                    row += 1
                    m += 1
    if sound:
        # The next solve, which differs by lifts, begins with this solution.
        guess = doubles(memory, env, memory.qacc_warmstart)
        for k in range(memory.nv):
            guess[k] = acceleration[k]
    if check_lifts(steps, slots, velocity, lifts, i):
        count = wp.min(steps.contacts[i] + 0, lifts.slot.shape[1])
        for k in range(_ROWS * count):
            copy_row(memory, env, first + k, lifts.response.rows, i, k)
            lifts.force[i, k] = carried[first + k]
        read_mass(memory, env, entries, starts, columns, lifts.response, i, first, first + _ROWS * count)
        solve_lifts(steps, slots, lifts, i, count)
    write_gel_references(memory, steps, slots, i)
