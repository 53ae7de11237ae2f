"""Kernels on the memory of MuJoCo's states: frames, contacts of gels, rows, forces.

One thread works on one environment's arena, in which contacts and rows lie one after the other.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.lift_kernels import LEAST_FRICTION
from raytac.physics.rigid.motion_kernels import Frames
from raytac.physics.rigid.world_kernels import ROWS, Slots, Steps
from raytac.world.engine.gap_kernels import closing, is_among, is_box, is_open, passes
from raytac.world.world_state import LARGEST_SPEED

wp.set_module_options({"enable_backward": False, "fast_math": False})

_ROWS = wp.constant(wp.int32(ROWS))
_SLIPPERY = wp.constant(wp.float64(1e-5))
"""Factor of the friction across a gap that stays open.

It is that of all coefficients and of the cone, so that they fit each other.
"""
_SLOWEST = wp.constant(wp.float64(1e-9))
"""Least speed by which a gap is divided [m/s]."""
_LARGEST_SPEED = wp.constant(wp.float64(LARGEST_SPEED))
_MANY = wp.constant(wp.int32(0x7FFFFFFF))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))


@wp.struct
class Memory:
    """Addresses of B states, and offsets of pointers [8 byte] and numbers [4 byte] in them."""

    states: wp.array(dtype=wp.uint64)
    nq: wp.int32
    nv: wp.int32
    sparse: wp.array(dtype=wp.int32)
    """1 where MuJoCo keeps the Jacobian of constraints sparse."""
    ncon: wp.int32
    nefc: wp.int32
    contact: wp.int32
    qpos: wp.int32
    qvel: wp.int32
    xpos: wp.int32
    xmat: wp.int32
    site_xpos: wp.int32
    site_xmat: wp.int32
    subtree_com: wp.int32
    cvel: wp.int32
    cdof: wp.int32
    qacc_smooth: wp.int32
    qacc: wp.int32
    qacc_warmstart: wp.int32
    M: wp.int32
    efc_J_rownnz: wp.int32
    efc_J_rowadr: wp.int32
    efc_J_colind: wp.int32
    efc_J: wp.int32
    efc_D: wp.int32
    efc_R: wp.int32
    efc_vel: wp.int32
    efc_aref: wp.int32
    efc_force: wp.int32
    efc_state: wp.int32
    efc_id: wp.int32
    geom_xpos: wp.int32
    geom_xmat: wp.int32
    # Of a contact: its size and its members, [8 byte] and [4 byte].
    size: wp.int32
    dist: wp.int32
    pos: wp.int32
    frame: wp.int32
    friction: wp.int32
    mu: wp.int32
    dim: wp.int32
    geom1: wp.int32
    geom2: wp.int32
    geom: wp.int32
    efc_address: wp.int32


@wp.func
def doubles(memory: Memory, env: wp.int32, member: wp.int32):
    """Array that a pointer in a state's structure points to."""
    many = wp.int32(_MANY)
    pointers = wp.array(ptr=memory.states[env], shape=(many,), dtype=wp.uint64)
    return wp.array(ptr=pointers[member], shape=(many,), dtype=wp.float64)


@wp.func
def integers(memory: Memory, env: wp.int32, member: wp.int32):
    many = wp.int32(_MANY)
    pointers = wp.array(ptr=memory.states[env], shape=(many,), dtype=wp.uint64)
    return wp.array(ptr=pointers[member], shape=(many,), dtype=wp.int32)


@wp.func
def vector_at(values: wp.array(dtype=wp.float64), first: wp.int32) -> wp.vec3d:
    return wp.vec3d(values[first], values[first + 1], values[first + 2])


@wp.func
def vector(values: wp.array(dtype=wp.float64), index: wp.int32) -> wp.vec3d:
    return vector_at(values, 3 * index)


@wp.func
def matrix_at(values: wp.array(dtype=wp.float64), first: wp.int32) -> wp.mat33d:
    return wp.matrix_from_rows(vector_at(values, first), vector_at(values, first + 3), vector_at(values, first + 6))


@wp.func
def matrix(values: wp.array(dtype=wp.float64), index: wp.int32) -> wp.mat33d:
    return matrix_at(values, 9 * index)


@wp.func
def number(memory: Memory, env: wp.int32, member: wp.int32) -> wp.int32:
    """A number of a state's structure."""
    many = wp.int32(_MANY)
    numbers = wp.array(ptr=memory.states[env], shape=(many,), dtype=wp.int32)
    return numbers[member]


@wp.kernel
def read_frames(
    memory: Memory,
    steps: Steps,
    sites: wp.array(dtype=wp.int32),
    bodies: wp.array(dtype=wp.int32),
    roots: wp.array(dtype=wp.int32),
    last: wp.array(dtype=wp.int32),
    parents: wp.array(dtype=wp.int32),
    share: wp.array(dtype=wp.float64),
    # outputs
    frames: Frames,
):
    """Frames of pads, at their sites, and of bodies, with velocities and free accelerations.

    ``bodies``: those that carry the pads first; ``roots``: of their kinematic trees; ``last``: last degree of freedom that moves each, −1
    of none; ``parents``: of the degrees of freedom; ``share``: of each one's acceleration that comes, as damping is implicit
    (``ImplicitDamping``). As in a constraint row, the accelerations hold nothing of what velocities alone give.
    """
    row, k = wp.tid()
    env, body = steps.envs[row], bodies[k]
    if env < 0:
        return
    place, turn = wp.vec3d(), wp.mat33d()
    if k < sites.shape[0]:
        place = vector(doubles(memory, env, memory.site_xpos), sites[k])
        turn = matrix(doubles(memory, env, memory.site_xmat), sites[k])
    else:
        place = vector(doubles(memory, env, memory.xpos), body)
        turn = matrix(doubles(memory, env, memory.xmat), body)
    twist = doubles(memory, env, memory.cvel)
    # MuJoCo's velocities are about the centre of mass of the kinematic tree.
    about = vector(doubles(memory, env, memory.subtree_com), roots[k])
    spin = vector(twist, 2 * body)
    frames.place[row, k] = place
    frames.turn[row, k] = turn
    frames.spin[row, k] = spin
    frames.velocity[row, k] = vector(twist, 2 * body + 1) + wp.cross(spin, place - about)
    axes, smooth = doubles(memory, env, memory.cdof), doubles(memory, env, memory.qacc_smooth)
    swing, push = wp.vec3d(), wp.vec3d()
    dof = last[k]
    while dof >= 0:
        value = share[dof] * smooth[dof]
        swing += value * vector(axes, 2 * dof)
        push += value * vector(axes, 2 * dof + 1)
        dof = parents[dof]
    frames.swing[row, k] = swing
    frames.push[row, k] = push + wp.cross(swing, place - about)


@wp.kernel
def write_contacts(memory: Memory, steps: Steps, slots: Slots, gels: wp.array(dtype=wp.int32), others: wp.array(dtype=wp.int32)):
    """Fill the last contacts with the slots'; ``gels``, ``others``: geoms of pads and bodies."""
    i = wp.tid()
    if steps.lost[i] != 0 or steps.contacts[i] == 0:
        return
    env = steps.envs[i]
    k = number(memory, env, memory.ncon) - steps.contacts[i]
    contact = doubles(memory, env, memory.contact)
    integer = integers(memory, env, memory.contact)
    for pad in range(slots.held.shape[1]):
        for body in range(slots.held.shape[2]):
            if slots.held[i, pad, body] != 0:
                first = k * memory.size
                place, frame = slots.place[i, pad, body], slots.frame[i, pad, body]
                m = wp.int32(0)
                while m < 3:
                    contact[first + memory.pos + m] = place[m]
                    n = wp.int32(0)
                    while n < 3:
                        contact[first + memory.frame + 3 * m + n] = frame[m, n]
                        n += 1
                    m += 1
                m = wp.int32(0)
                while m < _ROWS - 1:
                    contact[first + memory.friction + m] = wp.max(slots.friction[i, pad, body, m], LEAST_FRICTION)
                    m += 1
                integer[2 * first + memory.geom1] = gels[pad]
                integer[2 * first + memory.geom2] = others[body]
                integer[2 * first + memory.geom] = gels[pad]
                integer[2 * first + memory.geom + 1] = others[body]
                k += 1


@wp.kernel
def write_regularisation(memory: Memory, steps: Steps, slots: Slots):
    """Set R of the last rows, after ``mj_makeConstraint``."""
    i = wp.tid()
    count = steps.contacts[i]
    if steps.lost[i] != 0 or count == 0:
        return
    env = steps.envs[i]
    k = (number(memory, env, memory.ncon) - count) * memory.size
    row = number(memory, env, memory.nefc) - _ROWS * count
    contact = doubles(memory, env, memory.contact)
    inverse = doubles(memory, env, memory.efc_R)
    stiffness = doubles(memory, env, memory.efc_D)
    for pad in range(slots.held.shape[1]):
        for body in range(slots.held.shape[2]):
            if slots.held[i, pad, body] != 0:
                m = wp.int32(0)
                while m < _ROWS:
                    value = slots.regularisation[i, pad, body, m]
                    inverse[row] = value
                    stiffness[row] = _1 / value
                    row += 1
                    m += 1
                # The solver's cone is that of the dual one with the rows scaled by √R.
                ratio = slots.regularisation[i, pad, body, 1] / slots.regularisation[i, pad, body, 0]
                contact[k + memory.mu] = wp.max(slots.friction[i, pad, body, 0], LEAST_FRICTION) * wp.sqrt(ratio)
                k += memory.size


@wp.func
def row_times(memory: Memory, env: wp.int32, row: wp.int32, values: wp.array(dtype=wp.float64)) -> wp.float64:
    """A row of the constraint's Jacobian times a vector of the degrees of freedom."""
    jacobian = doubles(memory, env, memory.efc_J)
    result = wp.float64(0.0)
    if memory.sparse[0] != 0:
        column, start = integers(memory, env, memory.efc_J_colind), integers(memory, env, memory.efc_J_rowadr)[row]
        for k in range(start, start + integers(memory, env, memory.efc_J_rownnz)[row]):
            result += jacobian[k] * values[column[k]]
    else:
        for k in range(memory.nv):
            result += jacobian[row * memory.nv + k] * values[k]
    return result


@wp.func
def write_gel_references(memory: Memory, steps: Steps, slots: Slots, i: wp.int32):
    """Set reference accelerations of the last rows."""
    env, step = steps.envs[i], steps.length[i]
    velocity, reference = doubles(memory, env, memory.efc_vel), doubles(memory, env, memory.efc_aref)
    row = number(memory, env, memory.nefc) - _ROWS * steps.contacts[i]
    for pad in range(slots.held.shape[1]):
        for body in range(slots.held.shape[2]):
            if slots.held[i, pad, body] != 0:
                m = wp.int32(0)
                while m < _ROWS:
                    wanted = slots.force[i, pad, body, m] * slots.regularisation[i, pad, body, m]
                    reference[row] = wanted - velocity[row] / step
                    row += 1
                    m += 1


@wp.kernel
def write_references(memory: Memory, steps: Steps, slots: Slots, hard: wp.array(dtype=wp.int32), boxes: wp.array(dtype=wp.vec3d)):
    """Set reference accelerations of the last rows and ``hard`` geoms, after MuJoCo's own.

    ``boxes``: half edges of geoms that are boxes, else 0.
    """
    i = wp.tid()
    if steps.lost[i] != 0:
        return
    env, step = steps.envs[i], steps.length[i]
    count = number(memory, env, memory.ncon) - steps.contacts[i]
    velocity = doubles(memory, env, memory.efc_vel)
    reference, smooth = doubles(memory, env, memory.efc_aref), doubles(memory, env, memory.qacc_smooth)
    contact = doubles(memory, env, memory.contact)
    integer = integers(memory, env, memory.contact)
    for k in range(count):
        at = 2 * k * memory.size
        one, two, first = integer[at + memory.geom], integer[at + memory.geom + 1], integer[at + memory.efc_address]
        if first >= 0 and integer[at + memory.dim] >= 3 and is_among(hard, one) + is_among(hard, two) > 0:
            n = k * memory.size
            gap = contact[n + memory.dist]
            open, passed = wp.bool(False), wp.bool(False)
            ahead = wp.vec3d()
            if gap > _0:
                for m in range(3):
                    ahead[m] = velocity[first + m] + step * row_times(memory, env, first + m, smooth)
                if is_box(boxes, one) and is_box(boxes, two):
                    turns, places = doubles(memory, env, memory.geom_xmat), doubles(memory, env, memory.geom_xpos)
                    passed = passes(
                        matrix(turns, one), vector(places, one), boxes[one],
                        matrix(turns, two), vector(places, two), boxes[two],
                        vector_at(contact, n + memory.pos), matrix_at(contact, n + memory.frame),
                        gap, ahead, wp.min(step, gap / wp.max(-ahead[0], _SLOWEST)),
                    )  # fmt: skip
                open = passed or is_open(gap, ahead[0], step)
            reference[first] = -(velocity[first] + closing(gap, passed) / step) / step
            for m in range(1, 3):
                reference[first + m] = -velocity[first + m] / step
            if open:
                # MuJoCo's cone acts across a gap that is smaller than the friction times the slide of the step.
                contact[n + memory.mu] *= _SLIPPERY
                for m in range(_ROWS - 1):
                    contact[n + memory.friction + m] *= _SLIPPERY
    write_gel_references(memory, steps, slots, i)


@wp.kernel
def read_constraint(
    memory: Memory,
    slots: Slots,
    # outputs
    steps: Steps,
    force: wp.array4d(dtype=wp.float64),
    velocity: wp.array4d(dtype=wp.float64),
):
    """Forces of the gels' rows and their velocities at the end of the step, after ``mj_step2``.

    An environment is lost if a number is not finite, or a joint is far too fast.
    """
    i = wp.tid()
    if steps.lost[i] != 0:
        return
    env = steps.envs[i]
    position = doubles(memory, env, memory.qpos)
    speed = doubles(memory, env, memory.qvel)
    sound, total = wp.bool(True), wp.float64(0.0)
    for k in range(memory.nv):
        if not wp.abs(speed[k]) < _LARGEST_SPEED:
            sound = wp.bool(False)
    for k in range(memory.nq):
        total += position[k]
    if not (sound and wp.isfinite(total)):
        steps.lost[i] = 1
        return
    if steps.contacts[i] == 0:
        return
    row = number(memory, env, memory.nefc) - _ROWS * steps.contacts[i]
    carried = doubles(memory, env, memory.efc_force)
    for pad in range(slots.held.shape[1]):
        for body in range(slots.held.shape[2]):
            if slots.held[i, pad, body] != 0:
                m = wp.int32(0)
                while m < _ROWS:
                    force[i, pad, body, m] = carried[row]
                    velocity[i, pad, body, m] = row_times(memory, env, row, speed)
                    row += 1
                    m += 1
