"""Kernels on the state of MuJoCo Warp: frames, contacts of gels, rows, forces.

MuJoCo Warp keeps the states of all environments in arrays of float32, and their contacts in one list. Its cone has one ratio of
regularisations for all contacts, R₁/R₀ = 1/impratio. A gel's contact has its own. With the second and third axis of the contact's frame
multiplied by t, t² = R₀ / (impratio R₁), its rows along them (two tangents, two of rolling) are multiplied by t too. Regularisation t² R
and friction μ/t then give the same cone, with the forces divided by t. Rows of the first axis, normal and spin, stay as they are.
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

vec5 = wp.types.vector(length=5, dtype=wp.float32)

_ROWS = wp.constant(wp.int32(ROWS))
_SLIPPERY = wp.constant(wp.float32(1e-5))
"""Factor of the friction across a gap that stays open."""
_SLOWEST = wp.constant(wp.float32(1e-6))
"""Least speed by which a gap is divided [m/s]."""
_LARGEST_SPEED = wp.constant(wp.float32(LARGEST_SPEED))
_IMPEDANCE = wp.constant(wp.float32(0.9))
_CONSTRAINT = wp.constant(wp.int32(1))
"""Type of a contact that the solver takes."""
_MANY = wp.constant(0x7FFFFFFF)
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))


@wp.struct
class Worlds:
    """Arrays of MuJoCo Warp's model and data that kernels read and write, by its names."""

    sparse: wp.int32
    """1 where it keeps the Jacobian of constraints sparse."""
    nv: wp.int32
    body_rootid: wp.array(dtype=wp.int32)
    dof_parentid: wp.array(dtype=wp.int32)
    impratio_invsqrt: wp.array(dtype=wp.float32)
    time: wp.array(dtype=wp.float32)
    qpos: wp.array2d(dtype=wp.float32)
    qvel: wp.array2d(dtype=wp.float32)
    act: wp.array2d(dtype=wp.float32)
    ctrl: wp.array2d(dtype=wp.float32)
    qacc: wp.array2d(dtype=wp.float32)
    qacc_smooth: wp.array2d(dtype=wp.float32)
    qacc_warmstart: wp.array2d(dtype=wp.float32)
    M: wp.array2d(dtype=wp.float32)
    xpos: wp.array2d(dtype=wp.vec3)
    xmat: wp.array2d(dtype=wp.mat33)
    site_xpos: wp.array2d(dtype=wp.vec3)
    site_xmat: wp.array2d(dtype=wp.mat33)
    geom_xpos: wp.array2d(dtype=wp.vec3)
    geom_xmat: wp.array2d(dtype=wp.mat33)
    subtree_com: wp.array2d(dtype=wp.vec3)
    cvel: wp.array2d(dtype=wp.spatial_vector)
    cdof: wp.array2d(dtype=wp.spatial_vector)
    nacon: wp.array(dtype=wp.int32)
    ncollision: wp.array(dtype=wp.int32)
    nefc: wp.array(dtype=wp.int32)
    overflow: wp.array(dtype=wp.int32)
    # Contacts.
    dist: wp.array(dtype=wp.float32)
    pos: wp.array(dtype=wp.vec3)
    frame: wp.array(dtype=wp.mat33)
    includemargin: wp.array(dtype=wp.float32)
    friction: wp.array(dtype=vec5)
    solref: wp.array(dtype=wp.vec2)
    solreffriction: wp.array(dtype=wp.vec2)
    solimp: wp.array(dtype=vec5)
    dim: wp.array(dtype=wp.int32)
    geom: wp.array(dtype=wp.vec2i)
    flex: wp.array(dtype=wp.vec2i)
    efc_address: wp.array2d(dtype=wp.int32)
    worldid: wp.array(dtype=wp.int32)
    type: wp.array(dtype=wp.int32)
    geomcollisionid: wp.array(dtype=wp.int32)
    adhesion: wp.array(dtype=wp.float32)
    surfacevel: wp.array(dtype=wp.vec3)
    # Constraint rows.
    rownnz: wp.array2d(dtype=wp.int32)
    rowadr: wp.array2d(dtype=wp.int32)
    colind: wp.array3d(dtype=wp.int32)
    J: wp.array3d(dtype=wp.float32)
    state: wp.array2d(dtype=wp.int32)
    id: wp.array2d(dtype=wp.int32)
    row_type: wp.array2d(dtype=wp.int32)
    D: wp.array2d(dtype=wp.float32)
    vel: wp.array2d(dtype=wp.float32)
    aref: wp.array2d(dtype=wp.float32)
    force: wp.array2d(dtype=wp.float32)


@wp.struct
class Own:
    """Contacts of gels in MuJoCo Warp's list, by slot (B, pads, bodies + pads)."""

    first: wp.array(dtype=wp.int32)
    """Index from which contacts are those of gels, (1,)."""
    contact: wp.array3d(dtype=wp.int32)
    """Index; −1 without a contact."""
    scale: wp.array3d(dtype=wp.float64)
    """t."""


@wp.struct
class Saved:
    """State to which an environment returns whose physics broke down in a step."""

    time: wp.array(dtype=wp.float32)
    qpos: wp.array2d(dtype=wp.float32)
    qvel: wp.array2d(dtype=wp.float32)
    act: wp.array2d(dtype=wp.float32)
    warmstart: wp.array2d(dtype=wp.float32)


@wp.kernel
def place_states(
    chosen: wp.array(dtype=wp.bool),
    qpos: wp.array2d(dtype=wp.float32),
    ctrl: wp.array2d(dtype=wp.float32),
    worlds: Worlds,
    active: wp.array(dtype=wp.bool),
):
    """Set positions (B, nq) and controls (B, nu) of ``chosen`` environments; now active."""
    i = wp.tid()
    if chosen[i]:
        active[i] = True
        for k in range(worlds.qpos.shape[1]):
            worlds.qpos[i, k] = qpos[i, k]
        for k in range(worlds.ctrl.shape[1]):
            worlds.ctrl[i, k] = ctrl[i, k]


@wp.func
def double3(value: wp.vec3) -> wp.vec3d:
    return wp.vec3d(wp.float64(value[0]), wp.float64(value[1]), wp.float64(value[2]))


@wp.func
def double33(value: wp.mat33) -> wp.mat33d:
    return wp.mat33d(
        wp.float64(value[0, 0]), wp.float64(value[0, 1]), wp.float64(value[0, 2]),
        wp.float64(value[1, 0]), wp.float64(value[1, 1]), wp.float64(value[1, 2]),
        wp.float64(value[2, 0]), wp.float64(value[2, 1]), wp.float64(value[2, 2]),
    )  # fmt: skip


@wp.func
def is_scaled(m: wp.int32) -> wp.bool:
    """True for a contact's rows along the second and third axis of its frame."""
    return m % 3 != 0


@wp.kernel
def save_states(worlds: Worlds, saved: Saved):
    """Keep the state at the start of a step."""
    i = wp.tid()
    saved.time[i] = worlds.time[i]
    for k in range(worlds.qpos.shape[1]):
        saved.qpos[i, k] = worlds.qpos[i, k]
    for k in range(worlds.qvel.shape[1]):
        saved.qvel[i, k] = worlds.qvel[i, k]
        saved.warmstart[i, k] = worlds.qacc_warmstart[i, k]
    for k in range(worlds.act.shape[1]):
        saved.act[i, k] = worlds.act[i, k]


@wp.kernel
def choose_worlds(
    active: wp.array(dtype=wp.bool),
    ticks: wp.int32,
    scene_steps: wp.int32,
    launched: wp.int32,
    launches: wp.int32,
    # outputs
    done: wp.array(dtype=wp.int32),
    steps: Steps,
):
    """Choose a step's environments: ``active`` ones that have steps of the scene to do.

    Every environment has its own row. ``ticks`` of each of the ``scene_steps``; ``launched``: steps before this one, of all ``launches``.
    """
    i = wp.tid()
    if launched == 0:
        done[i] = 0
    before = done[i] // ticks
    steps.envs[i] = wp.where(active[i] and before < scene_steps, i, -1)
    steps.done[i] = done[i] % ticks
    # The scene's later steps take one launch each, if they are not divided.
    steps.most[i] = launches - launched - (scene_steps - 1 - before)


@wp.kernel
def read_elapsed(done: wp.array(dtype=wp.int32), tick: wp.float64, elapsed: wp.array(dtype=wp.float64)):
    """Time [s] of the ticks behind each environment; ``tick``: length of one [s]."""
    i = wp.tid()
    elapsed[i] = wp.float64(done[i]) * tick


@wp.kernel
def end_worlds(steps: Steps, done: wp.array(dtype=wp.int32), active: wp.array(dtype=wp.bool)):
    """Count the ticks of a step; where physics broke down, clear ``active``."""
    i = wp.tid()
    if steps.envs[i] >= 0:
        done[i] = done[i] + steps.ticks[i]
        if steps.lost[i] != 0:
            active[i] = False


@wp.kernel
def set_timesteps(steps: Steps, timestep: wp.array(dtype=wp.float32)):
    """Give the solver the length of each environment's step; others keep theirs."""
    i = wp.tid()
    if steps.envs[i] >= 0:
        timestep[i] = wp.float32(steps.length[i])


@wp.kernel
def read_frames(
    worlds: Worlds,
    sites: wp.array(dtype=wp.int32),
    bodies: wp.array(dtype=wp.int32),
    last: wp.array(dtype=wp.int32),
    share: wp.array(dtype=wp.float64),
    # outputs
    frames: Frames,
):
    """Frames of pads, at their sites, and of bodies, with velocities and free accelerations.

    ``bodies``: those that carry the pads first; ``last``: last degree of freedom that moves each, −1 of none; ``share``: of the
    acceleration of each that comes, as damping is implicit (``ImplicitDamping``). As in a constraint row, the accelerations hold nothing
    of what velocities alone give.
    """
    i, k = wp.tid()
    body = bodies[k]
    place, turn = wp.vec3d(), wp.mat33d()
    if k < sites.shape[0]:
        place = double3(worlds.site_xpos[i, sites[k]])
        turn = double33(worlds.site_xmat[i, sites[k]])
    else:
        place = double3(worlds.xpos[i, body])
        turn = double33(worlds.xmat[i, body])
    # MuJoCo's velocities are about the centre of mass of the kinematic tree.
    arm = place - double3(worlds.subtree_com[i, worlds.body_rootid[body]])
    twist = worlds.cvel[i, body]
    spin = double3(wp.spatial_top(twist))
    frames.place[i, k] = place
    frames.turn[i, k] = turn
    frames.spin[i, k] = spin
    frames.velocity[i, k] = double3(wp.spatial_bottom(twist)) + wp.cross(spin, arm)
    swing, push = wp.vec3d(), wp.vec3d()
    dof = last[k]
    while dof >= 0:
        smooth, axis = share[dof] * wp.float64(worlds.qacc_smooth[i, dof]), worlds.cdof[i, dof]
        swing += smooth * double3(wp.spatial_top(axis))
        push += smooth * double3(wp.spatial_bottom(axis))
        dof = worlds.dof_parentid[dof]
    frames.swing[i, k] = swing
    frames.push[i, k] = push + wp.cross(swing, arm)


@wp.kernel
def append_contacts(
    worlds: Worlds, steps: Steps, slots: Slots, gels: wp.array(dtype=wp.int32), others: wp.array(dtype=wp.int32), own: Own
):
    """Put the contacts of the slots that are held after MuJoCo's own.

    ``gels``, ``others``: geoms of the pads and of all that they touch. What does not fit is counted in ``nacon`` all the same, and its
    environment is lost.
    """
    i, pad, body = wp.tid()
    own.contact[i, pad, body] = -1
    if steps.lost[i] != 0 or slots.held[i, pad, body] == 0:
        return
    k = wp.atomic_add(worlds.nacon, 0, 1)
    if k >= worlds.dist.shape[0]:
        steps.lost[i] = 1
        return
    own.contact[i, pad, body] = k
    # The solver's cone is that of the dual one with the rows scaled by √R.
    ratio = slots.regularisation[i, pad, body, 1] / slots.regularisation[i, pad, body, 0]
    t = wp.float64(worlds.impratio_invsqrt[i % worlds.impratio_invsqrt.shape[0]]) / wp.sqrt(ratio)
    own.scale[i, pad, body] = t
    place, frame = slots.place[i, pad, body], slots.frame[i, pad, body]
    axes, friction = wp.mat33(), vec5()
    for m in range(3):
        factor = wp.where(m == 0, _1, t)
        for n in range(3):
            axes[m, n] = wp.float32(factor * frame[m, n])
    for m in range(5):
        factor = wp.where(is_scaled(m + 1), t, _1)
        friction[m] = wp.float32(wp.max(slots.friction[i, pad, body, m], LEAST_FRICTION) / factor)
    worlds.pos[k] = wp.vec3(wp.float32(place[0]), wp.float32(place[1]), wp.float32(place[2]))
    worlds.frame[k] = axes
    worlds.friction[k] = friction
    worlds.geom[k] = wp.vec2i(gels[pad], others[body])
    worlds.worldid[k] = i
    worlds.dim[k] = _ROWS
    worlds.type[k] = _CONSTRAINT
    # What MuJoCo computes from the rest is written over.
    worlds.dist[k] = wp.float32(-1e-6)
    worlds.includemargin[k] = wp.float32(0.0)
    worlds.solref[k] = wp.vec2(0.02, 1.0)
    worlds.solreffriction[k] = wp.vec2(0.0, 0.0)
    worlds.solimp[k] = vec5(_IMPEDANCE, _IMPEDANCE, wp.float32(1e-3), wp.float32(0.5), wp.float32(2.0))
    worlds.adhesion[k] = wp.float32(0.0)
    worlds.surfacevel[k] = wp.vec3()
    worlds.geomcollisionid[k] = 0
    if k < worlds.flex.shape[0]:  # it has none without flexible bodies
        worlds.flex[k] = wp.vec2i(-1, -1)
    for m in range(worlds.efc_address.shape[1]):
        worlds.efc_address[k, m] = -1


@wp.kernel
def write_rows(worlds: Worlds, steps: Steps, slots: Slots, own: Own):
    """Set stiffness and reference acceleration of MuJoCo's rows of gels, scaled by t (module)."""
    i, pad, body = wp.tid()
    k = own.contact[i, pad, body]
    if k < 0:
        return
    step = steps.length[i]
    for m in range(_ROWS):
        row = worlds.efc_address[k, m]
        if row >= 0:
            t = wp.where(is_scaled(m), own.scale[i, pad, body], _1)
            value = slots.regularisation[i, pad, body, m]
            worlds.D[i, row] = wp.float32(_1 / (t * t * value))
            wanted = t * slots.force[i, pad, body, m] * value
            worlds.aref[i, row] = wp.float32(wanted - wp.float64(worlds.vel[i, row]) / step)


@wp.func
def row_times(worlds: Worlds, i: wp.int32, row: wp.int32, values: wp.array2d(dtype=wp.float32)) -> wp.float64:
    """A row of the constraint's Jacobian times a vector of the degrees of freedom."""
    result = wp.float64(0.0)
    if worlds.sparse != 0:
        start = worlds.rowadr[i, row] + 0
        for k in range(start, start + worlds.rownnz[i, row]):
            result += wp.float64(worlds.J[i, 0, k]) * wp.float64(values[i, worlds.colind[i, 0, k]])
    else:
        for k in range(worlds.nv):
            result += wp.float64(worlds.J[i, row, k]) * wp.float64(values[i, k])
    return result


@wp.kernel
def write_hard_references(
    worlds: Worlds, own: Own, hard: wp.array(dtype=wp.int32), boxes: wp.array(dtype=wp.vec3), timestep: wp.array(dtype=wp.float32)
):
    """Set the reference accelerations of MuJoCo's own contacts with geoms that are ``hard``.

    ``boxes``: half edges of geoms that are boxes, else 0.
    """
    k = wp.tid()
    if k >= wp.min(own.first[0], worlds.nacon[0]) or worlds.type[k] & _CONSTRAINT == 0 or worlds.dim[k] < 3:
        return
    geom, row = worlds.geom[k], worlds.efc_address[k, 0]
    if row < 0 or is_among(hard, geom[0]) + is_among(hard, geom[1]) == 0:
        return
    i = worlds.worldid[k]
    step, gap = timestep[i % timestep.shape[0]], worlds.dist[k]
    open, passed = wp.bool(False), wp.bool(False)
    ahead = wp.vec3()
    if gap > wp.float32(0.0):
        for m in range(3):
            other = worlds.efc_address[k, m]
            if other >= 0:
                ahead[m] = worlds.vel[i, other] + step * wp.float32(row_times(worlds, i, other, worlds.qacc_smooth))
        if is_box(boxes, geom[0]) and is_box(boxes, geom[1]):
            passed = passes(
                worlds.geom_xmat[i, geom[0]], worlds.geom_xpos[i, geom[0]], boxes[geom[0]],
                worlds.geom_xmat[i, geom[1]], worlds.geom_xpos[i, geom[1]], boxes[geom[1]],
                worlds.pos[k], worlds.frame[k], gap, ahead, wp.min(step, gap / wp.max(-ahead[0], _SLOWEST)),
            )  # fmt: skip
        open = passed or is_open(gap, ahead[0], step)
    worlds.aref[i, row] = -(worlds.vel[i, row] + closing(gap, passed) / step) / step
    for m in range(1, 3):
        other = worlds.efc_address[k, m]
        if other >= 0:
            worlds.aref[i, other] = -worlds.vel[i, other] / step
    if open:
        # MuJoCo's cone acts across a gap that is smaller than the friction times the slide of the step.
        worlds.friction[k] = _SLIPPERY * worlds.friction[k]


@wp.kernel
def add_damping(
    worlds: Worlds, steps: Steps, always: wp.int32, damped: wp.array2d(dtype=wp.float32), mass: wp.array2d(dtype=wp.float32)
):
    """Keep the mass matrix; add damping where gels touch or ``always`` (``implicit_damping``)."""
    i, k = wp.tid()
    mass[i, k] = worlds.M[i, k]
    if (always != 0 or steps.contacts[i] > 0) and steps.lost[i] == 0:
        worlds.M[i, k] = damped[i, k]


@wp.kernel
def end_states(worlds: Worlds, saved: Saved, steps: Steps, losses: wp.int32, peaks: wp.array(dtype=wp.int32)):
    """Mark environments whose physics broke down; put them and those left out back.

    They go to where the step began.
    A number is not finite then, a joint is far too fast, or MuJoCo Warp has lost contacts for want of memory, as one of the flags
    ``losses`` says: of the list that all share it cannot say whose.

    ``peaks``: most contacts of all environments, most pairs of MuJoCo's collision,
    most rows of one environment, and all of MuJoCo Warp's flags of overflow so far, which a reset clears there.
    """
    i = wp.tid()
    if i == 0:
        wp.atomic_max(peaks, 0, worlds.nacon[0])
        wp.atomic_max(peaks, 1, worlds.ncollision[0])
    wp.atomic_max(peaks, 2, worlds.nefc[i])
    if worlds.overflow[i] != 0:
        wp.atomic_or(peaks, 3, worlds.overflow[i])
        if (worlds.overflow[i] & losses) != 0:
            steps.lost[i] = 1
    total = wp.float32(0.0)
    for k in range(worlds.qvel.shape[1]):
        if not wp.abs(worlds.qvel[i, k]) < _LARGEST_SPEED:
            steps.lost[i] = 1
    for k in range(worlds.qpos.shape[1]):
        total += worlds.qpos[i, k]
    if not wp.isfinite(total):
        steps.lost[i] = 1
    if steps.lost[i] == 0:
        return
    worlds.time[i] = saved.time[i]
    for k in range(worlds.qpos.shape[1]):
        worlds.qpos[i, k] = saved.qpos[i, k]
    for k in range(worlds.qvel.shape[1]):
        worlds.qvel[i, k] = saved.qvel[i, k]
        worlds.qacc_warmstart[i, k] = saved.warmstart[i, k]
    for k in range(worlds.act.shape[1]):
        worlds.act[i, k] = saved.act[i, k]


@wp.kernel
def read_rows(
    worlds: Worlds,
    own: Own,
    steps: Steps,
    # outputs
    force: wp.array4d(dtype=wp.float64),
    velocity: wp.array4d(dtype=wp.float64),
):
    """Forces of the gels' rows and their velocities at the end of the step, without the scale t."""
    i, pad, body = wp.tid()
    k = own.contact[i, pad, body]
    if k < 0 or steps.lost[i] != 0:
        return
    for m in range(_ROWS):
        row = worlds.efc_address[k, m]
        if row >= 0:
            t = wp.where(is_scaled(m), own.scale[i, pad, body], _1)
            force[i, pad, body, m] = t * wp.float64(worlds.force[i, row])
            velocity[i, pad, body, m] = row_times(worlds, i, row, worlds.qvel) / t


@wp.struct
class Entries:
    """Places of numbers in the arrays of all environments, and in the result."""

    arrays: wp.array(dtype=wp.uint64)
    """Address of each array of float32 that is read, (members,)."""
    width: wp.array(dtype=wp.int32)
    """Its numbers of one environment."""
    member: wp.array(dtype=wp.int32)
    """Of every entry; negative: the index itself is the number."""
    index: wp.array(dtype=wp.int32)
    start: wp.array(dtype=wp.int32)
    stride: wp.array(dtype=wp.int32)
    """With ``start``, place of the entry of environment b: start + stride b."""
    values: wp.array(dtype=wp.float64)


@wp.kernel
def read_numbers(entries: Entries):
    """Copy entries of the arrays of B environments to ``values``."""
    i, k = wp.tid()
    value, member = wp.float64(entries.index[k]), entries.member[k] + 0
    if member >= 0:
        source = wp.array(ptr=entries.arrays[member], shape=(_MANY,), dtype=wp.float32)
        value = wp.float64(source[i * entries.width[member] + entries.index[k]])
    entries.values[entries.start[k] + i * entries.stride[k]] = value


@wp.kernel
def write_controls(index: wp.array(dtype=wp.int32), values: wp.array2d(dtype=wp.float64), ctrl: wp.array2d(dtype=wp.float32)):
    """Copy ``values`` (B, n) to the controls ``index`` (n,)."""
    i, k = wp.tid()
    ctrl[i, index[k]] = wp.float32(values[i, k])
