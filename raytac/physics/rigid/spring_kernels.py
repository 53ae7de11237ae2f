"""Normal contact as an implicit spring, linear in the speed at the end of a step.

It is stable at any step.
A contact of depth δ that closes at the speed w at the end of a step Δt carries

    f = F(δ) + C w,   C = c K

with K the incremental stiffness of the load law at the deeper end of the step and c >= Δt/2. At rest that is F(δ) exactly. A step takes
at least the work from the bodies that the gel stores (F is convex and K its greatest slope in the step), so that energy does not grow.
c is the gel's relaxation time τ (Kelvin and Voigt) where the step resolves the motion, and goes to Δt where it does not: backward Euler.

MuJoCo's constraint obeys R f = a* − a with a the acceleration that opens the contact, (v + Δt a) = −w: R = 1 / (C Δt),
a* = F(δ) / (C Δt) − v / Δt (``row_kernels``, docs/concepts/rigid-contact.md).
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rigid.contact_rows import Rows
from raytac.physics.rigid.table_kernels import Law, force_at

wp.set_module_options({"enable_backward": False, "fast_math": False})

_HALVINGS = wp.constant(wp.int32(12))
"""Bisections for the speed at a step's end; the upper bound is off by 1/4000 of the first."""
_SLOW = wp.constant(wp.float64(1e-7))
"""A contact that closes by no more than this in a step [m] is taken to close at its speed."""
_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_HALF = wp.constant(wp.float64(0.5))


@wp.struct
class Spring:
    """Normal force f = force + damping · w of one contact, w the closing speed at the end [m/s]."""

    force: wp.float64
    """[N]; negative of a gap that closes within the step."""
    damping: wp.float64
    """C [N s/m]; 0 where no contact is possible in this step."""
    deepest: wp.float64
    """Depth [m] to which a free pair would close in the step; at its speed alone if touching."""


@wp.func
def spring_time(stiffness: wp.float64, inverse_mass: wp.float64, step: wp.float64, relaxation: wp.float64) -> wp.float64:
    """c [s]: relaxation time, or at least Δt/2 of slow and Δt of unresolved contacts."""
    squared = stiffness * inverse_mass * step * step
    return wp.max(relaxation, step * (_HALF + _HALF * squared / (_1 + squared)))


@wp.func
def end_of_step(
    rows: Rows,
    law: Law,
    depth: wp.float64,
    quickest: wp.float64,
    start: wp.float64,
    inverse_mass: wp.float64,
    step: wp.float64,
    relaxation: wp.float64,
) -> wp.float64:
    """Depth [m] of free bodies after the step: m (v − w) / Δt = f(w), f rising from ``start``."""
    low, high = wp.float64(0.0), wp.max(quickest - step * inverse_mass * start, _0)
    if step * high <= _SLOW:
        return depth + step * high
    k = wp.int32(0)
    while k < _HALVINGS:
        middle = _HALF * (low + high)
        at = force_at(rows, law, depth + step * middle)
        force = at[0]
        if depth > _0:
            force = start + at[1] * spring_time(at[1], inverse_mass, step, relaxation) * middle
        if quickest - middle < step * inverse_mass * force:
            high = middle
        else:
            low = middle
        k += 1
    return depth + step * high


@wp.func
def normal_spring(
    rows: Rows,
    law: Law,
    depth: wp.float64,
    speed: wp.float64,
    inverse_mass: wp.float64,
    step: wp.float64,
    relaxation: wp.float64,
    push: wp.float64,
) -> Spring:
    """Spring of one step of a contact.

    Args:
        depth: δ [m]; negative is a gap.
        speed: speed [m/s] at which it closes at the start of the step.
        inverse_mass: 1/m of both bodies [1/kg].
        step: Δt [s].
        relaxation: τ [s] of the gel.
        push: acceleration [m/s²] that may close it faster, but for its own force.
    """
    start = force_at(rows, law, depth)
    quickest = speed + push * step
    end = depth + step * wp.max(quickest, _0)
    if end > wp.max(depth, _0) + _SLOW:
        end = end_of_step(rows, law, depth, quickest, start[0], inverse_mass, step, relaxation)
    at = force_at(rows, law, wp.max(end, _0))
    result = Spring()
    result.deepest = end
    if depth <= _0:
        if end > _0:
            secant = at[0] / end
            result.force = secant * depth
            result.damping = secant * step
    else:
        stiffness = wp.max(at[1], start[1])
        # What other contacts hold does not follow its push: at rest radius and friction are those of the present depth.
        if push > _0:
            result.deepest = depth
            if step * speed > _SLOW:
                result.deepest = end_of_step(rows, law, depth, speed, start[0], inverse_mass, step, relaxation)
        result.force = start[0]
        result.damping = stiffness * spring_time(stiffness, inverse_mass, step, relaxation)
    return result
