"""Kernel of ``CouplingInputs``.

Wrenches, contacts and solver bodies of an interval from the solver's sums.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.world.coupling_kernels import NOTHING, Contacts, SolverBodies

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_HARD = wp.constant(wp.float64(2e5))
"""Stiffness of contact between bodies without gel [N/m]: a gel's whole face (a guess)."""


@wp.struct
class Sums:
    """Members of ``ipc.sums.StepSums``."""

    force: wp.array2d(dtype=wp.vec3d)
    torque: wp.array2d(dtype=wp.vec3d)
    area: wp.array2d(dtype=wp.float64)
    rotation: wp.array2d(dtype=wp.mat33d)
    position: wp.array2d(dtype=wp.vec3d)
    centre: wp.array2d(dtype=wp.vec3d)
    velocity: wp.array2d(dtype=wp.vec3d)
    spin: wp.array2d(dtype=wp.vec3d)
    inertia: wp.array2d(dtype=wp.mat33d)
    pair_normal: wp.array2d(dtype=wp.vec3d)
    pair_place: wp.array2d(dtype=wp.vec3d)
    pair_force: wp.array2d(dtype=wp.vec3d)
    pair_torque: wp.array2d(dtype=wp.vec3d)


@wp.struct
class Names:
    """Roles of the solver's bodies and pairs in the coupling."""

    felt: wp.array(dtype=wp.int32)
    """Solver's number of each coupled body, (n,)."""
    free: wp.array(dtype=wp.int32)
    """Solver's number of each body that it moves, (F,)."""
    free_mass: wp.array(dtype=wp.float64)
    gravity: wp.array(dtype=wp.vec3d)
    """Of each environment [m/s²], (B,)."""
    side: wp.array2d(dtype=wp.int32)
    """Sides of each pair, (P, 2), as of ``Contacts.side``."""
    body: wp.array2d(dtype=wp.int32)
    """Solver's numbers of the two, (P, 2)."""
    terms: wp.array3d(dtype=wp.float64)
    """``pad_stiffness_terms`` of each of the solver's bodies, (bodies, 4, 2).

    0 of one that is no pad.
    """


@wp.struct
class Patches:
    """Bonded soft bodies that are touched, H an environment.

    They follow the free ones among the solver's bodies.
    """

    touched: wp.array2d(dtype=wp.int32)
    mass: wp.array2d(dtype=wp.float64)
    inertia: wp.array2d(dtype=wp.mat33d)
    centre: wp.array2d(dtype=wp.vec3d)
    velocity: wp.array2d(dtype=wp.vec3d)
    spin: wp.array2d(dtype=wp.vec3d)
    stiffness: wp.array4d(dtype=wp.float64)
    """(B, H, 6, 6)."""


@wp.func
def stiffness_of(names: Names, body: wp.int32, area: wp.float64) -> wp.vec4d:
    """Bound of a pad's stiffness: tangential, normal, rocking, twisting."""
    a, t = wp.sqrt(area / wp.float64(3.141592653589793)), names.terms
    square = a * a
    return wp.vec4d(
        t[body, 0, 0] * a + t[body, 0, 1] * square,
        t[body, 1, 0] * a + t[body, 1, 1] * square,
        a * square * (t[body, 2, 0] + t[body, 2, 1] * a),
        a * square * (t[body, 3, 0] + t[body, 3, 1] * a),
    )


@wp.func
def is_pad(names: Names, body: wp.int32) -> wp.bool:
    return names.terms[body, 0, 0] > _0


@wp.func
def side_now(names: Names, patches: Patches, env: wp.int32, pair: wp.int32, end: wp.int32) -> wp.int32:
    """Side of a pair; ``NOTHING`` for a bonded body whose patch does not move."""
    side = names.side[pair, end] + 0
    free = names.free.shape[0]
    if side <= -2 - free:  # noqa: SIM102  (`and` evaluates both sides)
        if patches.touched[env, -2 - side - free] == 0:
            side = NOTHING
    return side


@wp.func
def write_stiffness(names: Names, sums: Sums, env: wp.int32, pair: wp.int32, k: wp.int32, contacts: Contacts):
    """K of a pair: two pads in contact are springs in series.

    So that the bound of either holds for both.
    """
    for i in range(6):
        for j in range(6):
            contacts.stiffness[env, k, i, j] = _0
    best, least = wp.int32(-1), wp.float64(wp.inf)
    for end in range(2):
        body = names.body[pair, end] + 0
        if is_pad(names, body):
            bound = stiffness_of(names, body, sums.area[env, body])
            trace = wp.float64(2.0) * (bound[0] + bound[2]) + bound[1] + bound[3]
            if trace < least:
                best, least = wp.int32(body), trace
    if best < 0:
        for i in range(3):
            contacts.stiffness[env, k, i, i] = _HARD
        return
    stiff, turn = stiffness_of(names, best, sums.area[env, best]), sums.rotation[env, best]
    shift = turn * wp.diag(wp.vec3d(stiff[0], stiff[0], stiff[1])) * wp.transpose(turn)
    twist = turn * wp.diag(wp.vec3d(stiff[2], stiff[2], stiff[3])) * wp.transpose(turn)
    for i in range(3):
        for j in range(3):
            contacts.stiffness[env, k, i, j] = shift[i, j]
            contacts.stiffness[env, k, 3 + i, 3 + j] = twist[i, j]


@wp.kernel
def gather_inputs(
    chosen: wp.array(dtype=wp.int32), names: Names, sums: Sums, patches: Patches,
    # outputs
    wrench: wp.array3d(dtype=wp.float64), contacts: Contacts, bodies: SolverBodies,
):  # fmt: skip
    """Everything that an interval begins with, in the environments ``chosen`` (B,)."""
    env = wp.tid()
    if chosen[env] == 0:
        return
    for n in range(names.felt.shape[0]):
        body = names.felt[n] + 0
        for i in range(3):
            wrench[env, n, i] = sums.force[env, body][i]
            wrench[env, n, 3 + i] = sums.torque[env, body][i]
    free = names.free.shape[0]
    for s in range(free):
        body = names.free[s] + 0
        bodies.mass[env, s] = names.free_mass[s]
        bodies.inertia[env, s] = sums.inertia[env, body]
        bodies.centre[env, s] = sums.centre[env, body]
        bodies.velocity[env, s] = sums.velocity[env, body]
        bodies.spin[env, s] = sums.spin[env, body]
        bodies.force[env, s] = sums.force[env, body] + names.free_mass[s] * names.gravity[env]
        arm = sums.position[env, body] - sums.centre[env, body]
        bodies.torque[env, s] = sums.torque[env, body] + wp.cross(arm, sums.force[env, body])
    k = wp.int32(0)
    for p in range(patches.touched.shape[1]):
        if patches.touched[env, p] != 0:
            # A rigid body on a spring, the soft one's stiffness there; its forces balance but for inertia.
            s = free + p
            bodies.mass[env, s] = patches.mass[env, p]
            bodies.inertia[env, s] = patches.inertia[env, p]
            bodies.centre[env, s] = patches.centre[env, p]
            bodies.velocity[env, s] = patches.velocity[env, p]
            bodies.spin[env, s] = patches.spin[env, p]
            bodies.force[env, s] = wp.vec3d()
            bodies.torque[env, s] = wp.vec3d()
            contacts.side[env, k, 0] = -2 - s
            contacts.side[env, k, 1] = NOTHING
            contacts.opens[env, k] = 0
            contacts.place[env, k] = patches.centre[env, p]
            for i in range(6):
                for j in range(6):
                    contacts.stiffness[env, k, i, j] = patches.stiffness[env, p, i, j]
            k += 1
    for pair in range(names.side.shape[0]):
        one, two = side_now(names, patches, env, pair, 0), side_now(names, patches, env, pair, 1)
        moves = one != two and wp.length_sq(sums.pair_normal[env, pair]) > _0
        # What rests on a bonded body without moving is not there for the law.
        bonded = (one <= -2 - free and two == NOTHING) or (two <= -2 - free and one == NOTHING)
        if moves and not bonded:
            sign = wp.float64(1.0)
            first, other = wp.int32(one), wp.int32(two)
            if one == NOTHING:
                sign = wp.float64(-1.0)
                first, other = wp.int32(two), wp.int32(one)
            contacts.side[env, k, 0] = first
            contacts.side[env, k, 1] = other
            contacts.opens[env, k] = 1
            contacts.place[env, k] = sums.pair_place[env, pair]
            contacts.normal[env, k] = sign * sums.pair_normal[env, pair]
            contacts.force[env, k] = sign * sums.pair_force[env, pair]
            contacts.torque[env, k] = sign * sums.pair_torque[env, pair]
            write_stiffness(names, sums, env, pair, k, contacts)
            k += 1
    contacts.count[env] = k
