"""Decisions of a step, taken on the device, one thread an environment.

Flags of one element say whether any environment needs a branch; they are the conditions of the graph's ``if`` and ``while`` nodes. While
``halt`` is set (a buffer was too small) nothing is decided and no state changes, so that the iteration can be repeated.
"""

# pyright: reportGeneralTypeIssues=false, reportInvalidTypeForm=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, IntArray
from ipc.solver.step_state import Decisions, Flags

wp.set_module_options({"enable_backward": False})

ENOUGH = wp.constant(1 << 20)
"""Renewals within a first solve after which there are no more."""
BAD = 1e100
"""Sizes of steps above this are not finite numbers."""
SLOW = wp.constant(wp.float64(0.505))
"""Share of the last change of friction above which friction is averaged: half, and rounding."""


@wp.kernel
def start_step(friction: wp.int32, d: Decisions, f: Flags):
    """Reset everything for a step, for which ``alive`` and ``progress`` are set already."""
    env = wp.tid()
    zero = wp.float64(0.0)
    alive = d.alive[env]
    d.pending[env] = alive * friction
    d.active[env] = alive * (1 - friction)
    d.relags[env] = -friction
    if alive == 0:
        d.progress[env] = zero
    d.poor[env] = 0
    d.rested[env] = 0
    d.ready[env] = 1
    d.since_lag[env] = 0
    d.renewed[env] = 0
    d.good[env] = 0
    d.failed[env] = 0
    d.converged[env] = 0
    d.stalled[env] = 0
    d.newton[env] = 0
    d.linear[env] = 0
    d.line_search[env] = 0
    d.project[env] = 0
    d.projected[env] = 0
    d.speed[env] = zero
    d.last[env] = zero
    d.ccd[env] = wp.float64(1.0)
    d.min_gap[env] = wp.float64(wp.inf)
    d.min_det[env] = wp.float64(wp.inf)


@wp.kernel
def set_flags(d: Decisions, f: Flags):
    """Say whether anything remains to be done; flags were cleared."""
    env = wp.tid()
    d.touching[env] = wp.max(d.active[env], d.pending[env])
    if f.halt[0] == 0:
        if d.touching[env] != 0:
            f.go[0] = 1
        if d.pending[env] != 0:
            f.pending[0] = 1


@wp.kernel
def set_done(f: Flags):
    """Set ``done`` unless halted."""
    f.done[0] = 1 - f.halt[0]


@wp.kernel
def choose_lagging(d: Decisions, f: Flags):
    """Lag the friction of environments in which that is pending."""
    env = wp.tid()
    d.lagging[env] = d.pending[env] * (1 - f.halt[0])


@wp.kernel
def after_lag(tolerance: wp.float64, max_relags: wp.int32, still: wp.float64, d: Decisions, f: Flags):
    """Minimise (again) where friction is new or changed by more than the tolerance.

    From half of all renewals on only the sum of the limits has to settle: Newton's tolerance may leave open how a light contact divides it
    among vertices.

    Where the change is more than half of the last one, the next forces are the mean of the new and the old ones. Otherwise normal forces
    that friction has changed, and friction that they bound, would chase each other. A mean alone halves a change; that is no reason for
    another mean.

    An environment that ends here keeps the friction that Newton's method balanced: its forces are those that moved it.
    """
    env = wp.tid()
    d.averaging[env] = 0
    d.settled[env] = d.lagging[env]
    if d.lagging[env] == 0:
        return
    d.pending[env] = 0
    if d.active[env] != 0:  # within the first solve, whose end is judged
        d.settled[env] = 0
        if d.changed[env] <= tolerance and d.worst_changed[env] <= tolerance:
            d.renewed[env] = ENOUGH
        return
    f.settled[0] = 1
    # Renewed where it was only calm, friction of a light body may be off by more than a share of the sum of all forces says.
    # So the forces on every body have to hold, and the last step has to be short against the slip (``still``, in m), or there is another
    # solve.
    holds = d.renewed[env] == 0 or (d.worst_changed[env] <= tolerance and d.size[env] <= still)
    if d.relags[env] > 0 or (d.relags[env] == 0 and holds):
        if d.changed[env] <= tolerance or (2 * d.relags[env] >= max_relags and d.sum_changed[env] <= tolerance):
            return
    if d.relags[env] >= max_relags:
        d.converged[env] = 0
        return
    d.share[env] = wp.float64(1.0)
    if d.relags[env] > 0 and d.changed[env] > SLOW * d.last_changed[env]:
        d.share[env] = wp.float64(0.5)
        d.averaging[env] = 1
        f.average[0] = 1
    d.last_changed[env] = d.changed[env]
    d.settled[env] = 0
    d.relags[env] = d.relags[env] + 1
    d.active[env] = 1
    d.converged[env] = 0
    d.since_lag[env] = 0
    d.poor[env] = 0
    d.rested[env] = 0
    d.ready[env] = 1


@wp.kernel
def choose_advancing(d: Decisions, f: Flags):
    """Advance frames that have not arrived; poor ones wait until the unknowns rest."""
    env = wp.tid()
    d.pcg_iterations[env] = 0
    go = 0
    if d.active[env] != 0 and d.progress[env] < wp.float64(1.0) and d.ready[env] != 0:
        if d.poor[env] == 0 or d.rested[env] != 0:
            go = 1
            f.advance[0] = 1
    d.advancing[env] = go
    d.trial_progress[env] = d.progress[env]
    if go != 0:
        d.trial_progress[env] = wp.float64(1.0)


@wp.kernel
def after_solve(iterations: IntArray, negative: IntArray, mask: IntArray, d: Decisions, f: Flags):
    """Count iterations and ask for a definite matrix after negative curvature."""
    env = wp.tid()
    again = 0
    if mask[env] != 0 and f.halt[0] == 0:
        d.pcg_iterations[env] = d.pcg_iterations[env] + iterations[env]
        if negative[env] != 0 and d.project[env] == 0:
            d.project[env] = 1
            d.projected[env] = 1
            again = 1
            f.again[0] = 1
    d.again[env] = again


@wp.kernel
def choose_tightening(tolerance: wp.float64, dt: FloatArray, d: Decisions, f: Flags):
    """Solve on where a loosely solved step is so small that it may be the last."""
    env = wp.tid()
    go = 0
    if d.active[env] != 0 and d.advancing[env] == 0 and f.halt[0] == 0:
        if d.size[env] <= tolerance * dt[env]:
            go = 1
            f.tighten[0] = 1
    d.tightening[env] = go


@wp.kernel
def judge_direction(dt: FloatArray, d: Decisions, f: Flags):
    """Drop environments that are not finite; others advance frames or take a plain step."""
    env = wp.tid()
    d.plain[env] = 0
    if f.halt[0] != 0:
        d.advancing[env] = 0
        return
    if d.active[env] == 0:
        return
    if not (d.size[env] < wp.float64(BAD)):
        d.failed[env] = 1
        d.active[env] = 0
        d.advancing[env] = 0
        return
    d.speed[env] = d.size[env] / dt[env]
    if d.advancing[env] == 0:
        d.plain[env] = 1
        f.plain[0] = 1


@wp.kernel
def start_advance(d: Decisions, f: Flags):
    """Begin with the whole of what remains of the frames' motion."""
    env = wp.tid()
    d.shorten[env] = d.advancing[env]
    d.attempts[env] = 0
    d.length[env] = wp.float64(d.advancing[env])
    if d.advancing[env] != 0:
        f.shorten[0] = 1


@wp.kernel
def try_advance(slack: wp.float64, floor: wp.float64, d: Decisions, f: Flags):
    """Set the end of an advance of the present length, and what must stay of the gaps.

    A shortened motion ends where a gap is about used up. It is checked again, since the path of a turning frame is no straight line, and
    with half the limit, or rounding would refuse what was just allowed.
    """
    env = wp.tid()
    one = wp.float64(1.0)
    length, share = d.length[env], d.progress[env]
    d.trial_progress[env] = share + length * (one - share)
    if d.advancing[env] != 0 and length == one:
        d.trial_progress[env] = one
    d.alpha[env] = length
    ease = one
    if d.attempts[env] > 0:
        ease = wp.float64(0.5)
    d.slack[env] = ease * slack
    d.floor[env] = ease * floor
    d.trial_det[env] = wp.float64(wp.inf)


@wp.kernel
def judge_advance(most: wp.int32, d: Decisions, f: Flags):
    """Shorten the advance where a gap would close or an element invert."""
    env = wp.tid()
    if d.shorten[env] == 0:
        return
    one = wp.float64(1.0)
    if f.halt[0] != 0:
        d.shorten[env] = 0
        return
    alpha = d.alpha[env]
    if not (d.trial_det[env] > wp.float64(0.0)):
        alpha = wp.float64(0.5) * alpha
    d.attempts[env] = d.attempts[env] + 1
    if alpha >= one:
        d.shorten[env] = 0
        return
    if d.attempts[env] > most - 2:
        alpha = wp.float64(0.0)
    d.length[env] = d.length[env] * alpha * (one - wp.float64(1.0e-9))
    if d.attempts[env] >= most:
        d.shorten[env] = 0
    else:
        f.shorten[0] = 1


@wp.kernel
def conclude_advance(blocked: wp.float64, poor: wp.float64, d: Decisions, f: Flags):
    """Accept the advance; frames that hardly move after the unknowns rested are blocked."""
    env = wp.tid()
    d.accepted[env] = 0
    if f.halt[0] != 0 or d.advancing[env] == 0:
        return
    d.accepted[env] = 1
    advance = d.trial_progress[env] - d.progress[env]
    d.progress[env] = d.trial_progress[env]
    if d.poor[env] != 0 and advance < blocked:
        d.active[env] = 0
        d.converged[env] = 1
    d.poor[env] = 0
    if d.length[env] < poor:
        d.poor[env] = 1
    d.rested[env] = 0
    d.ready[env] = 0


@wp.kernel
def start_limit(slack: wp.float64, d: Decisions, f: Flags):
    """Begin with the whole Newton step, of which ``slack`` of every gap must stay."""
    env = wp.tid()
    d.slack[env] = slack
    d.floor[env] = wp.float64(0.0)
    d.alpha[env] = wp.float64(1.0)


@wp.kernel
def start_search(reach: FloatArray, d: Decisions, f: Flags):
    """Start the line search, which allows for rounding of positions by force × size × 1e-15."""
    env = wp.tid()
    d.trials[env] = 0
    d.searching[env] = 0
    if d.plain[env] == 0 or f.halt[0] != 0:
        return
    d.searching[env] = 1
    f.search[0] = 1
    d.allowed[env] = d.alpha[env]
    d.ccd[env] = wp.min(d.ccd[env], d.alpha[env])
    d.noise[env] = wp.float64(1.0e-15) * reach[env] * d.noise[env]


@wp.kernel
def clear_det(d: Decisions, f: Flags):
    """Forget the determinants of the last trial."""
    d.trial_det[wp.tid()] = wp.float64(wp.inf)


@wp.kernel
def judge_energy(armijo: wp.float64, most: wp.int32, d: Decisions, f: Flags):
    """End the search where the energy fell enough (Armijo), else halve the step."""
    env = wp.tid()
    if d.searching[env] == 0:
        return
    d.trials[env] = d.trials[env] + 1
    bound = armijo * d.alpha[env] * d.slope[env] + d.noise[env]
    if d.change[env] <= bound and d.trial_det[env] > wp.float64(0.0):
        d.searching[env] = 0
    else:
        d.alpha[env] = wp.float64(0.5) * d.alpha[env]
        if d.trials[env] < most:
            f.search[0] = 1


@wp.kernel
def end_search(d: Decisions, f: Flags):
    """Accept the step of environments whose search has ended."""
    env = wp.tid()
    d.accepted[env] = 0
    if d.plain[env] != 0 and f.halt[0] == 0:
        d.line_search[env] = d.line_search[env] + d.trials[env]
        d.accepted[env] = 1 - d.searching[env]


@wp.kernel
def conclude(
    tolerance: wp.float64,
    max_newton: wp.int32,
    max_relags: wp.int32,
    renewals: wp.int32,
    calm_renewals: wp.int32,
    calm: wp.float64,
    friction: wp.int32,
    d: Decisions,
    f: Flags,
):
    """End an iteration: environments converge, give up, or have their friction lagged again.

    Friction is renewed within a step's first solve after each of its first ``renewals`` Newton iterations, and ``calm_renewals`` times
    after a plain one of at most ``calm`` [m] with all frames in place; the first says nothing, since friction's curvature at rest holds it
    back.
    """
    env = wp.tid()
    if f.halt[0] != 0:
        return
    was_active = d.advancing[env] + d.plain[env]
    if was_active != 0:
        d.newton[env] = d.newton[env] + 1
        d.since_lag[env] = d.since_lag[env] + 1
        d.linear[env] = d.linear[env] + d.pcg_iterations[env]
        if renewals > 0:
            d.last[env] = d.size[env]
    if d.plain[env] != 0:
        d.ready[env] = 1
        slow = d.speed[env] <= tolerance
        if d.searching[env] != 0:
            # Nothing lowered the energy: try again with a definite matrix; if it was definite, the search has stalled.
            if d.project[env] != 0 and not slow:
                d.stalled[env] = 1
                d.active[env] = 0
            d.project[env] = 1
            d.projected[env] = 1
        else:
            d.project[env] = 0
        # So small a step has converged, also where rounding of the energies kept it from being accepted.
        if slow and d.allowed[env] >= wp.float64(1.0):
            d.rested[env] = 1
            if d.progress[env] >= wp.float64(1.0) and d.active[env] != 0:
                d.converged[env] = 1
                d.active[env] = 0
    if was_active != 0 and d.since_lag[env] >= max_newton:
        d.active[env] = 0
    # Friction of a step's first solve follows its contacts: solved with that of the step's start, it would be solved for nothing.
    if friction != 0 and max_relags > 0 and was_active != 0 and d.active[env] != 0 and d.relags[env] == 0:
        if d.since_lag[env] <= renewals:
            d.pending[env] = 1
        elif d.plain[env] != 0 and d.size[env] <= calm and d.renewed[env] < calm_renewals and d.since_lag[env] > 1:
            if d.progress[env] >= wp.float64(1.0):
                d.pending[env] = 1
                d.renewed[env] = d.renewed[env] + 1
    # Where Newton gave up, forces are no better known after another lag; the first two may still help it on.
    if was_active != 0 and d.active[env] == 0 and friction != 0 and max_relags > 0:
        if d.converged[env] != 0 or (d.relags[env] < 2 and d.relags[env] < max_relags):
            d.pending[env] = 1


@wp.kernel
def choose_good(d: Decisions, f: Flags):
    """Return environments that failed, or must converge and did not, to the start of the step."""
    env = wp.tid()
    lost = d.failed[env]
    if d.alive[env] != 0 and d.converged[env] == 0 and d.keep[env] == 0:
        lost = 1
    d.good[env] = d.alive[env] * (1 - lost)
    d.converged[env] = d.converged[env] * d.good[env]
    d.accepted[env] = lost
    if lost != 0:
        d.progress[env] = wp.float64(0.0)
