"""Lifts of slides that begin or end, of all contacts of an environment at once.

A lift ℓ fits if MuJoCo's convex cone gives back the normal force N of the law: ℓ = μ r (T − μ N), r = G / G_t the ratio of the dampings,
N and the friction T of the rows without a cone, at MuJoCo's speeds for the end of the step. Contacts of one body feel each other.

Each solve of MuJoCo's gives velocities v and forces p of the rows. Their response W to other forces is known (``response_kernels``), so
the law of all contacts is solved with v − W p + W q for the velocities under forces q:

    N = max(f₀ − G v_n, 0),   |q_t| ≤ μ N,   q_t = f₀ − G_t v_t  unless that is beyond the cone,

by Gauss and Seidel's method over contacts, in each the normal force before friction (M. Jean, The non-smooth contact dynamics method,
Comput. Methods Appl. Mech. Eng. 177, 1999). The lifts follow from its velocities. With them MuJoCo's next solve has the law's forces,
unless other constraints change their state meanwhile: then one more solve follows.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.response_kernels import Response, add_force, factorise, mat66d, own_response, vec6d, velocity_by
from raytac.physics.rigid.world_kernels import ROWS, Slots, Steps

wp.set_module_options({"enable_backward": False, "fast_math": False})

TOGETHER = 16
"""Most contacts of an environment whose lifts are corrected.

Others keep that of the start of the step.
"""

_FITS = wp.constant(wp.float64(0.005))
"""Error of a lift over the normal force at which it fits."""
_FALLS = wp.constant(wp.float64(0.5))
"""Share to which the error must have fallen for lifts that no solve checks."""
_SWEEPS = wp.constant(wp.int32(300))
"""Most sweeps over the contacts; some thirty suffice for two pads."""
_INNER = wp.constant(wp.int32(3))
"""Most steps for one contact in a sweep, where there are others."""
_SETTLED = wp.constant(wp.float64(2e-7))
"""Change of a force, over the greatest normal force, at which steps and sweeps end."""
LEAST_FRICTION = wp.constant(wp.float64(1e-6))
"""Least coefficient of friction, which MuJoCo wants positive."""
_ROWS = wp.constant(wp.int32(ROWS))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_HALF = wp.constant(wp.float64(0.5))


@wp.struct
class Lifts:
    """Search for the lifts of n environments, each of up to K contacts."""

    solves: wp.int32
    """Most solves of MuJoCo's before that of the step."""
    least: wp.array(dtype=wp.float64)
    """Least error of all lifts so far [N], (n,)."""
    slot: wp.array2d(dtype=wp.vec2i)
    """Pad and body of each contact, (n, K)."""
    best: wp.array2d(dtype=wp.float64)
    """Lifts of the solve of least error [N], (n, K)."""
    free: wp.array2d(dtype=wp.float64)
    """Velocities of the rows at the end of the step without their forces, (n, 6 K)."""
    force: wp.array2d(dtype=wp.float64)
    """Of the rows, (n, 6 K)."""
    response: Response


@wp.func
def law_at(slots: Slots, step: wp.float64, i: wp.int32, slot: wp.vec2i, velocity: vec6d) -> vec6d:
    """Forces of a contact's rows without a cone at velocities for the end of the step.

    The normal force is 0 at least. Friction is over the ratio of each coefficient to μ, so that its length counts in the cone.
    """
    pad, body = slot[0], slot[1]
    result, friction = vec6d(), wp.max(slots.friction[i, pad, body, 0], LEAST_FRICTION)
    for m in range(_ROWS):
        value = slots.force[i, pad, body, m] - velocity[m] / (slots.regularisation[i, pad, body, m] * step)
        if m == 0:
            value = wp.max(value + slots.lift[i, pad, body], _0)
        else:
            value *= friction / wp.max(slots.friction[i, pad, body, m - 1], LEAST_FRICTION)
        result[m] = value
    return result


@wp.func
def lift_of(slots: Slots, i: wp.int32, slot: wp.vec2i, law: vec6d) -> wp.float64:
    """Lift [N] that fits to forces of ``law_at``."""
    pad, body, square = slot[0], slot[1], wp.float64(0.0)
    for m in range(1, _ROWS):
        square += law[m] * law[m]
    friction = wp.max(slots.friction[i, pad, body, 0], LEAST_FRICTION)
    ratio = slots.regularisation[i, pad, body, 1] / slots.regularisation[i, pad, body, 0]
    return friction * ratio * wp.max(wp.sqrt(square) - friction * law[0], _0)


@wp.func
def settle_contact(slots: Slots, step: wp.float64, lifts: Lifts, i: wp.int32, k: wp.int32, most: wp.int32) -> wp.float64:
    """Solve the law of one contact under the forces of the others, by up to ``most`` steps.

    Returns the greatest change of a force [N]. The numbers of the contact stay in registers: a step reads no memory.
    """
    slot, greatest = lifts.slot[i, k], wp.float64(0.0)
    pad, body, first = slot[0], slot[1], _ROWS * k
    friction = wp.max(slots.friction[i, pad, body, 0], LEAST_FRICTION)
    own = lifts.response.own[i, k] + mat66d()
    before, free, stiff, scale, wanted, give = vec6d(), vec6d(), vec6d(), vec6d(), vec6d(), wp.float64(0.0)
    for m in range(_ROWS):
        before[m] = lifts.force[i, first + m]
        free[m] = lifts.free[i, first + m] + velocity_by(lifts.response, i, first + m)
        stiff[m] = _1 / (slots.regularisation[i, pad, body, m] * step)
        wanted[m] = slots.force[i, pad, body, m]
        scale[m] = _1
        if m == 0:
            wanted[m] = wanted[m] + slots.lift[i, pad, body]
        else:
            scale[m] = friction / wp.max(slots.friction[i, pad, body, m - 1], LEAST_FRICTION)
            give = wp.max(give, own[m, m] * stiff[m])
    free -= own * before  # of the forces of others
    force, n = before + vec6d(), wp.int32(0)
    while n < most:
        n += 1
        speed = free[0]
        for m in range(_ROWS):
            speed += own[0, m] * force[m]
        more = (wanted[0] - stiff[0] * speed - force[0]) / (_1 + stiff[0] * own[0, 0])
        normal = wp.max(force[0] + more, _0)
        change = wp.abs(normal - force[0])
        force[0] = normal
        velocity, law, square = free + own * force, vec6d(), wp.float64(0.0)
        for m in range(1, _ROWS):
            now = scale[m] * force[m]
            law[m] = now + (scale[m] * (wanted[m] - stiff[m] * velocity[m]) - now) / (_1 + give)
            square += law[m] * law[m]
        share = wp.min(friction * normal / wp.max(wp.sqrt(square), wp.float64(1e-30)), _1)
        for m in range(1, _ROWS):
            new = share * law[m] / scale[m]
            change = wp.max(change, scale[m] * wp.abs(new - force[m]))
            force[m] = new
        greatest = wp.max(greatest, change)
        if change <= _SETTLED * normal:
            n = most
    for m in range(_ROWS):
        lifts.force[i, first + m] = force[m]
        add_force(lifts.response, i, first + m, force[m] - before[m])
    return greatest


@wp.func
def settle(slots: Slots, step: wp.float64, lifts: Lifts, i: wp.int32, count: wp.int32):
    """Solve the law of all contacts, from the velocities ``free`` with the forces of MuJoCo's."""
    for m in range(lifts.response.state.shape[1]):
        lifts.response.state[i, m] = _0
    for row in range(_ROWS * count):
        add_force(lifts.response, i, row, lifts.force[i, row])
    for row in range(_ROWS * count):
        lifts.free[i, row] = lifts.free[i, row] - velocity_by(lifts.response, i, row)
    for k in range(count):
        lifts.response.own[i, k] = own_response(lifts.response, i, _ROWS * k)
    # A lone contact waits for no other.
    sweep, sweeps, most = wp.int32(0), wp.where(count == 1, 1, _SWEEPS), wp.where(count == 1, _SWEEPS * _INNER, _INNER)
    while sweep < sweeps:
        change, largest = wp.float64(0.0), wp.float64(0.0)
        for k in range(count):
            change = wp.max(change, settle_contact(slots, step, lifts, i, k, most))
            largest = wp.max(largest, lifts.force[i, _ROWS * k])
        sweep += 1
        if change <= _SETTLED * largest:
            sweep = wp.int32(_SWEEPS)


@wp.func
def check_lifts(steps: Steps, slots: Slots, velocity: wp.array4d(dtype=wp.float64), lifts: Lifts, i: wp.int32) -> wp.bool:
    """Compare lifts with a solve of MuJoCo's; False if none is to be solved for.

    ``steps.slides`` is cleared if all fit. After the last solve lifts that do not fit are those of the best one, unless the error fell
    well. ``velocity``: of the rows at the end of the step, by that solve.
    """
    step = steps.length[i]
    count, solve, slides, error = wp.int32(0), steps.solves[i] + 1, wp.int32(0), wp.float64(0.0)
    for pad in range(slots.held.shape[1]):
        for body in range(slots.held.shape[2]):
            if slots.held[i, pad, body] != 0 and count < lifts.slot.shape[1]:
                slot, speeds = wp.vec2i(pad, body), vec6d()
                for m in range(_ROWS):
                    speeds[m] = velocity[i, pad, body, m]
                    lifts.free[i, _ROWS * count + m] = speeds[m]
                law = law_at(slots, step, i, slot, speeds)
                lacks = lift_of(slots, i, slot, law) - slots.lift[i, pad, body]
                if not wp.abs(lacks) <= _FITS * law[0]:
                    slides = wp.int32(1)
                error += wp.abs(lacks)
                lifts.slot[i, count] = slot
                count += 1
    steps.slides[i] = slides
    steps.solves[i] = solve
    if slides == 0 or (solve == 1 and not wp.isfinite(error)):
        steps.slides[i] = 0
        return False
    falls, better = solve == 1, solve == 1
    if solve > 1:
        falls, better = error < _FALLS * lifts.least[i], error < lifts.least[i]
    if better:
        lifts.least[i] = error
        for k in range(count):
            lifts.best[i, k] = slots.lift[i, lifts.slot[i, k][0], lifts.slot[i, k][1]]
        if falls or solve < lifts.solves:
            return True
    # Halfway back to the best lifts: the solution ahead of them was on the other side of a change that its response does not know.
    share = wp.where(solve < lifts.solves and wp.isfinite(error), _HALF, _0)
    for k in range(count):
        slot = lifts.slot[i, k]
        set_lift(slots, i, slot, lifts.best[i, k] + share * (slots.lift[i, slot[0], slot[1]] - lifts.best[i, k]))
    return False


@wp.func
def set_lift(slots: Slots, i: wp.int32, slot: wp.vec2i, lift: wp.float64):
    """Set a contact's lift, which f₀ of its normal row is less by."""
    more = lift - slots.lift[i, slot[0], slot[1]]
    slots.lift[i, slot[0], slot[1]] = lift
    slots.force[i, slot[0], slot[1], 0] = slots.force[i, slot[0], slot[1], 0] - more


@wp.func
def solve_lifts(steps: Steps, slots: Slots, lifts: Lifts, i: wp.int32, count: wp.int32):
    """Set the lifts of the first ``count`` contacts, and f₀ of their normal rows, by the law.

    ``lifts`` has the forces of a solve of MuJoCo's, after ``check_lifts``, and of ``response`` its mass and rows.
    """
    step = steps.length[i]
    if not factorise(lifts.response, i, _ROWS * count, step):
        return
    settle(slots, step, lifts, i, count)
    for k in range(count):
        speeds = vec6d()
        for m in range(_ROWS):
            row = _ROWS * k + m
            speeds[m] = lifts.free[i, row] + velocity_by(lifts.response, i, row)
        # Forces of all contacts are known now, so that one lift more does not change the velocities of the others.
        slot = lifts.slot[i, k]
        lift = lift_of(slots, i, slot, law_at(slots, step, i, slot, speeds))
        if wp.isfinite(lift):
            set_lift(slots, i, slot, lift)
