"""Lifts of slides that begin or end, of all contacts of an environment at once.

A lift ℓ fits if MuJoCo's convex cone gives back the normal force N of the law: ℓ = μ r (T − μ N), r = G / G_t the ratio of the dampings,
N and the friction T of the rows without a cone, at MuJoCo's speeds for the end of the step. Contacts of one body feel each other. A lift
that grows by Δℓ changes MuJoCo's normal forces by Δp, and these the speeds by Δt C d Δp, d the direction of normal force and friction
together:

    Δℓ = −P Δp,  P = D + Δt G d·C d,    D = 1 + μ² r
    Δ(μ r (T − μ N) − ℓ) = Q Δp,        Q = D (1 + Δt G n·C d)

with C the inverse mass and inertia that two contacts share, those of bodies alone. −Q P⁻¹ begins the Jacobian. Each solve of MuJoCo's then
corrects its rows by Schubert's update, in the columns that C couples (L. K. Schubert, Math. Comp. 24, 1970): of one contact that is the
secant method.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.world_kernels import ROWS, Differences, Slots, Steps

wp.set_module_options({"enable_backward": False, "fast_math": False})

TOGETHER = 16
"""Most contacts of an environment whose lifts are corrected.

Others keep that of the start of the step.
"""

_FITS = wp.constant(wp.float64(0.005))
"""Error of a lift over the normal force that is left."""
_FALLS = wp.constant(wp.float64(0.5))
"""Share to which the error must have fallen for a last step that no solve checks."""
_FARTHEST = wp.constant(wp.float64(2.0))
"""Longest change of a lift, over that of a contact alone with all error of the environment."""
LEAST_FRICTION = wp.constant(wp.float64(1e-6))
"""Least coefficient of friction, which MuJoCo wants positive."""
_LEAST_FORCE = wp.constant(wp.float64(1e-6))
"""Least force [N] that another is divided by."""
_ROWS = wp.constant(wp.int32(ROWS))
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))


@wp.struct
class Lifts:
    """Search for the lifts of n environments, each of up to K contacts."""

    solves: wp.int32
    """Most solves of MuJoCo's before that of the step."""
    least: wp.array(dtype=wp.float64)
    """Least error of all lifts so far [N], (n,)."""
    carrier: wp.array(dtype=wp.int32)
    """Body of the model that carries each pad, (pads,)."""
    share: wp.array(dtype=wp.float64)
    """Share of the acceleration of each body that comes.

    It is less than 1 as damping is implicit (``ImplicitDamping``).
    """
    turning: wp.array(dtype=wp.float64)
    """Mass over inertia of the bodies of the model that pads touch [1/m²], of others 0."""
    slot: wp.array2d(dtype=wp.vec2i)
    """Pad and body of each contact, (n, K)."""
    reach: wp.array2d(dtype=wp.float64)
    """Change of a contact's lift over its error, if it were alone."""
    lift: wp.array3d(dtype=wp.float64)
    """Of the best solve and of the present one [N], (n, 2, K)."""
    lacks: wp.array3d(dtype=wp.float64)
    """By how much it is too small [N], likewise."""
    jacobian: wp.array3d(dtype=wp.float64)
    """Changes of ``lacks`` over those of lifts, (n, K, K)."""
    work: wp.array3d(dtype=wp.float64)
    """(n, K, 2 K)."""


@wp.struct
class Slide:
    """A contact as it slides by the end of the step."""

    lacks: wp.float64
    """By how much the lift is too small [N]."""
    normal: wp.float64
    """Normal force of the law [N]."""
    push: wp.vec3d
    """Direction of normal force and friction over the normal force, world frame."""
    cone: wp.float64
    """D."""


@wp.func
def slide_of(slots: Slots, velocity: wp.array4d(dtype=wp.float64), step: wp.float64, i: wp.int32, slot: wp.vec2i) -> Slide:
    """``velocity``: of the rows at the end of the step."""
    pad, body = slot[0], slot[1]
    result, lift, frame = Slide(), slots.lift[i, pad, body], slots.frame[i, pad, body]
    regular, sheared = slots.regularisation[i, pad, body, 0], slots.regularisation[i, pad, body, 1]
    friction, ratio = wp.max(slots.friction[i, pad, body, 0], LEAST_FRICTION), sheared / regular
    result.normal = wp.max(slots.force[i, pad, body, 0] + lift - velocity[i, pad, body, 0] / (regular * step), _0)
    total, along = wp.float64(0.0), wp.vec3d()
    m = wp.int32(1)
    while m < _ROWS:
        part = slots.force[i, pad, body, m] - velocity[i, pad, body, m] / (slots.regularisation[i, pad, body, m] * step)
        part *= friction / wp.max(slots.friction[i, pad, body, m - 1], LEAST_FRICTION)
        total += part * part
        if m < 3:
            along += part * frame[m]
        m += 1
    size = wp.sqrt(total)
    wanted = friction * ratio * wp.max(size - friction * result.normal, _0)
    result.lacks = wanted - lift
    result.cone = _1
    result.push = frame[0]
    if wanted > _0 or lift > _0:
        result.cone = _1 + friction * friction * ratio
        result.push += friction / wp.max(size, _LEAST_FORCE) * along
    return result


@wp.func
def shared_compliance(lifts: Lifts, vary: Differences, env: wp.int32, one: wp.vec2i, two: wp.vec2i) -> wp.float64:
    """1/m [1/kg] by which a force at a contact changes the speed at another.

    It is negative where it is on one's body and two's pad.
    """
    result = wp.float64(0.0)
    for m in range(2):
        for n in range(2):
            body = wp.where(m == 0, lifts.carrier[one[0]], vary.carrier[one[1]])
            if body == wp.where(n == 0, lifts.carrier[two[0]], vary.carrier[two[1]]):
                weight = lifts.share[body] * vary.inverse_weight[env, body]
                result += wp.where(m == n, weight, -weight)
    return result


@wp.func
def change_of_speed(
    slots: Slots,
    lifts: Lifts,
    vary: Differences,
    env: wp.int32,
    i: wp.int32,
    one: wp.vec2i,
    two: wp.vec2i,
    along: wp.vec3d,
    push: wp.vec3d,
) -> wp.float64:
    """a·C b [1/kg]: acceleration at contact one along a by a force b at contact two."""
    result, body = shared_compliance(lifts, vary, env, one, two) * wp.dot(along, push), vary.carrier[one[1]]
    if body == vary.carrier[two[1]]:
        turn = wp.dot(wp.cross(slots.arm[i, one[0], one[1]], along), wp.cross(slots.arm[i, two[0], two[1]], push))
        result += lifts.share[body] * lifts.turning[body] * vary.inverse_weight[env, body] * turn
    return result


@wp.func
def eliminate(work: wp.array3d(dtype=wp.float64), i: wp.int32, count: wp.int32, columns: wp.int32) -> wp.bool:
    """Solve for the ``columns`` after the first ``count`` in place; False if singular.

    The method is that of Gauss and Jordan.
    """
    for k in range(count):
        pivot = wp.int32(k)
        for j in range(k + 1, count):
            if wp.abs(work[i, j, k]) > wp.abs(work[i, pivot, k]):
                pivot = j
        largest = work[i, pivot, k]
        if not (wp.abs(largest) > _0 and wp.isfinite(largest)):
            return False
        for m in range(k, count + columns):
            value = work[i, pivot, m] / largest
            work[i, pivot, m] = work[i, k, m]
            work[i, k, m] = value
        for j in range(count):
            if j != k:
                factor = work[i, j, k]
                for m in range(k, count + columns):
                    work[i, j, m] = work[i, j, m] - factor * work[i, k, m]
    return True


@wp.func
def begin_jacobian(
    slots: Slots, velocity: wp.array4d(dtype=wp.float64), step: wp.float64, lifts: Lifts, vary: Differences, env: wp.int32, i: wp.int32,
    count: wp.int32,
):  # fmt: skip
    """−Q P⁻¹, of contacts that do not slide −1; see the module."""
    for j in range(count):
        slot = lifts.slot[i, j]
        regular, normal = slots.regularisation[i, slot[0], slot[1], 0], slots.frame[i, slot[0], slot[1]][0]
        slide = slide_of(slots, velocity, step, i, slot)
        for k in range(count):
            other = lifts.slot[i, k]
            push = slide_of(slots, velocity, step, i, other).push
            own = wp.where(j == k, slide.cone, _0)
            # Transposed, since P comes on the right.
            work = own + change_of_speed(slots, lifts, vary, env, i, slot, other, slide.push, push) / regular
            lifts.work[i, k, j] = work
            across = change_of_speed(slots, lifts, vary, env, i, slot, other, normal, push) / regular
            lifts.work[i, k, count + j] = -own - slide.cone * across
            if j == k:
                lifts.reach[i, j] = work / slide.cone
    sound = eliminate(lifts.work, i, count, count)
    for j in range(count):
        for k in range(count):
            lifts.jacobian[i, j, k] = lifts.work[i, k, count + j]
            if not sound:
                lifts.jacobian[i, j, k] = wp.where(j == k, -_1 / lifts.reach[i, j], _0)


@wp.func
def solve_lifts(steps: Steps, slots: Slots, velocity: wp.array4d(dtype=wp.float64), lifts: Lifts, vary: Differences, i: wp.int32):
    """Set the lifts of an environment, and f₀ of its normal rows, after a solve of MuJoCo's.

    Clears ``steps.slides`` if all fit. Each step is from the best solve so far; one whose error is not less only corrects the Jacobian.
    The last lifts are those of the best solve, unless the error fell well.

    Args:
        velocity: of the rows at the end of the step, by that solve.
    """
    env, step = steps.envs[i], steps.length[i]
    count, solve, slides, error = wp.int32(0), steps.solves[i] + 1, wp.int32(0), wp.float64(0.0)
    for pad in range(slots.held.shape[1]):
        for body in range(slots.held.shape[2]):
            if slots.held[i, pad, body] != 0 and count < lifts.slot.shape[1]:
                slot = wp.vec2i(pad, body)
                slide = slide_of(slots, velocity, step, i, slot)
                if not wp.abs(slide.lacks) <= _FITS * slide.normal:
                    slides = wp.int32(1)
                error += wp.abs(slide.lacks)
                lifts.slot[i, count] = slot
                lifts.lift[i, 1, count] = slots.lift[i, pad, body]
                lifts.lacks[i, 1, count] = slide.lacks
                count += 1
    steps.slides[i] = slides
    steps.solves[i] = solve
    if slides == 0 or (solve == 1 and not wp.isfinite(error)):
        steps.slides[i] = 0
        return
    if solve == 1:
        begin_jacobian(slots, velocity, step, lifts, vary, env, i, count)
    elif wp.isfinite(error):
        for j in range(count):
            length, change = wp.float64(0.0), lifts.lacks[i, 1, j] - lifts.lacks[i, 0, j]
            for k in range(count):
                if j == k or shared_compliance(lifts, vary, env, lifts.slot[i, j], lifts.slot[i, k]) != _0:
                    moved = lifts.lift[i, 1, k] - lifts.lift[i, 0, k]
                    length += moved * moved
                    change -= lifts.jacobian[i, j, k] * moved
            for k in range(count):
                if length > _0 and (j == k or shared_compliance(lifts, vary, env, lifts.slot[i, j], lifts.slot[i, k]) != _0):
                    moved = lifts.lift[i, 1, k] - lifts.lift[i, 0, k]
                    lifts.jacobian[i, j, k] = lifts.jacobian[i, j, k] + change / length * moved
    falls = solve == 1 or error < _FALLS * lifts.least[i]
    if solve == 1 or error < lifts.least[i]:
        lifts.least[i] = error
        for j in range(count):
            lifts.lift[i, 0, j] = lifts.lift[i, 1, j]
            lifts.lacks[i, 0, j] = lifts.lacks[i, 1, j]
    goes_on = falls or solve < lifts.solves
    for j in range(count):
        lifts.work[i, j, count] = -lifts.lacks[i, 0, j]
        for k in range(count):
            lifts.work[i, j, k] = lifts.jacobian[i, j, k]
    sound = eliminate(lifts.work, i, count, 1)
    # A step that is too long is shortened as a whole: where one body slides on several pads, lifts fit only along a narrow valley.
    whole = wp.float64(_1)
    for j in range(count):
        if not (sound and wp.isfinite(lifts.work[i, j, count])):
            sound = wp.bool(False)
    for j in range(count):
        if not sound:
            lifts.work[i, j, count] = lifts.reach[i, j] * lifts.lacks[i, 0, j]
        farthest = _FARTHEST * lifts.reach[i, j] * lifts.least[i]
        whole = wp.min(whole, farthest / wp.max(wp.abs(lifts.work[i, j, count]), wp.float64(1e-30)))
    for j in range(count):
        slot = lifts.slot[i, j]
        lift = lifts.lift[i, 0, j] + wp.where(goes_on, whole, _0) * lifts.work[i, j, count]
        lift = wp.max(lift, _0)
        more = lift - lifts.lift[i, 1, j]
        slots.lift[i, slot[0], slot[1]] = lift
        slots.force[i, slot[0], slot[1], 0] = slots.force[i, slot[0], slot[1], 0] - more
