"""What each environment of a batch does next: the decisions of a step, taken on the device, one thread an environment.

Flags of one element say whether any environment needs a branch; they are the conditions of the graph's ``if`` and ``while`` nodes. While
``halt`` is set (a buffer was too small) nothing is decided and no state changes, so that the iteration can be done again.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

__all__ = ["Flags", "StepState"]

wp.set_module_options({"enable_backward": False})

ARMIJO = 1e-4
CCD_SLACK = 0.1
"""A Newton step may use up nine tenths of any gap."""
GAP_FLOOR = 0.01
"""Driven bodies may not close a gap below this share of d̂; the soft side is given time to yield first."""
BLOCKED_ADVANCE = 1e-4
"""Frames that advance by less than this share of their motion although everything else had come to rest are blocked."""
POOR_ADVANCE = 0.05
"""Below this share of what was left, the unknowns get time to rest before the frames try again."""
TRAVEL_ATTEMPTS = 8
"""How often an advance of the frames is shortened; the last but one attempt stays where it is."""
BAD = 1e100

INTS = (
    *(
        "alive",
        "active",
        "pending",
        "lagging",
        "travelling",
        "plain",
        "again",
        "shorten",
        "attempts",
        "searching",
        "trials",
        "taken",
        "spent",
    ),
    *("poor", "rested", "ready", "used", "good"),
    *("failed", "converged", "stalled", "newton", "linear", "line_search", "relags"),
)
FLOATS = (
    *(
        "share",
        "share1",
        "length",
        "alpha",
        "allowed",
        "slope",
        "change",
        "noise",
        "trial_det",
        "size",
        "slack",
        "floor",
        "changed",
    ),
    *("speed", "ccd", "min_gap", "min_det"),
)


@wp.struct
class Decisions:
    """Per environment. Masks and marks are 0 or 1."""

    alive: wp.array(dtype=wp.int32)  # takes part in this step
    active: wp.array(dtype=wp.int32)  # is being minimised
    pending: wp.array(dtype=wp.int32)  # came to rest, or begins: its friction is to be lagged anew
    lagging: wp.array(dtype=wp.int32)
    travelling: wp.array(dtype=wp.int32)  # its frames advance in this iteration
    plain: wp.array(dtype=wp.int32)  # takes an ordinary Newton step in this iteration
    again: wp.array(dtype=wp.int32)  # solves again with a definite matrix
    shorten: wp.array(dtype=wp.int32)  # still looks for the length of its advance
    attempts: wp.array(dtype=wp.int32)
    searching: wp.array(dtype=wp.int32)  # still looks for the length of its Newton step
    trials: wp.array(dtype=wp.int32)
    taken: wp.array(dtype=wp.int32)  # changes state now
    spent: wp.array(dtype=wp.int32)  # PCG iterations in this iteration
    poor: wp.array(dtype=wp.int32)  # its frames hardly came ahead: plain iterations until the unknowns rest, then one more try
    rested: wp.array(dtype=wp.int32)
    ready: wp.array(dtype=wp.int32)
    used: wp.array(dtype=wp.int32)  # iterations since friction was lagged
    good: wp.array(dtype=wp.int32)  # ends the step with a new state
    failed: wp.array(dtype=wp.int32)
    converged: wp.array(dtype=wp.int32)
    stalled: wp.array(dtype=wp.int32)
    newton: wp.array(dtype=wp.int32)
    linear: wp.array(dtype=wp.int32)
    line_search: wp.array(dtype=wp.int32)
    relags: wp.array(dtype=wp.int32)  # −1 before friction was lagged for the first time
    project: wp.array(dtype=wp.int32)
    share: wp.array(dtype=wp.float64)  # of the frames' way that is behind them
    share1: wp.array(dtype=wp.float64)
    length: wp.array(dtype=wp.float64)  # of an advance, as a share of what is left
    alpha: wp.array(dtype=wp.float64)
    allowed: wp.array(dtype=wp.float64)  # by continuous collision detection
    slope: wp.array(dtype=wp.float64)
    change: wp.array(dtype=wp.float64)
    noise: wp.array(dtype=wp.float64)
    trial_det: wp.array(dtype=wp.float64)
    size: wp.array(dtype=wp.float64)
    slack: wp.array(dtype=wp.float64)
    floor: wp.array(dtype=wp.float64)
    changed: wp.array(dtype=wp.float64)
    speed: wp.array(dtype=wp.float64)
    ccd: wp.array(dtype=wp.float64)
    min_gap: wp.array(dtype=wp.float64)
    min_det: wp.array(dtype=wp.float64)


@wp.struct
class Flags:
    """One element each."""

    halt: wp.array(dtype=wp.int32)
    go: wp.array(dtype=wp.int32)
    pending: wp.array(dtype=wp.int32)
    travel: wp.array(dtype=wp.int32)
    again: wp.array(dtype=wp.int32)
    shorten: wp.array(dtype=wp.int32)
    plain: wp.array(dtype=wp.int32)
    search: wp.array(dtype=wp.int32)
    done: wp.array(dtype=wp.int32)


@wp.kernel
def start_step(friction: wp.int32, d: Decisions):
    """Everything as at the start of a step; ``alive`` and ``share`` are set."""
    env = wp.tid()
    zero = wp.float64(0.0)
    alive = d.alive[env]
    d.pending[env] = alive * friction
    d.active[env] = alive * (1 - friction)
    d.relags[env] = -friction
    if alive == 0:
        d.share[env] = zero
    d.poor[env] = 0
    d.rested[env] = 0
    d.ready[env] = 1
    d.used[env] = 0
    d.good[env] = 0
    d.failed[env] = 0
    d.converged[env] = 0
    d.stalled[env] = 0
    d.newton[env] = 0
    d.linear[env] = 0
    d.line_search[env] = 0
    d.project[env] = 0
    d.speed[env] = zero
    d.ccd[env] = wp.float64(1.0)
    d.min_gap[env] = wp.float64(wp.inf)
    d.min_det[env] = wp.float64(wp.inf)


@wp.kernel
def look(d: Decisions, f: Flags):
    """Whether anything is left to do; flags were cleared."""
    env = wp.tid()
    if f.halt[0] == 0:
        if d.active[env] != 0 or d.pending[env] != 0:
            f.go[0] = 1
        if d.pending[env] != 0:
            f.pending[0] = 1


@wp.kernel
def look_at_end(f: Flags):
    """done = 1 unless halted."""
    f.done[0] = 1 - f.halt[0]


@wp.kernel
def choose_lagging(d: Decisions, f: Flags):
    env = wp.tid()
    d.lagging[env] = d.pending[env] * (1 - f.halt[0])


@wp.kernel
def after_lag(tolerance: wp.float64, d: Decisions):
    """Minimise (again) where friction was lagged for the first time or changed by more than the tolerance."""
    env = wp.tid()
    if d.lagging[env] == 0:
        return
    d.pending[env] = 0
    if d.relags[env] < 0 or d.changed[env] > tolerance:
        d.relags[env] = d.relags[env] + 1
        d.active[env] = 1
        d.converged[env] = 0
        d.used[env] = 0
        d.poor[env] = 0
        d.rested[env] = 0
        d.ready[env] = 1


@wp.kernel
def choose_travelling(d: Decisions, f: Flags):
    """Frames on their way advance, unless the last advance was poor and the unknowns have not rested since."""
    env = wp.tid()
    d.spent[env] = 0
    go = 0
    if d.active[env] != 0 and d.share[env] < wp.float64(1.0) and d.ready[env] != 0:
        if d.poor[env] == 0 or d.rested[env] != 0:
            go = 1
            f.travel[0] = 1
    d.travelling[env] = go
    d.share1[env] = d.share[env]
    if go != 0:
        d.share1[env] = wp.float64(1.0)


@wp.kernel
def after_solve(
    iterations: wp.array(dtype=wp.int32),
    negative: wp.array(dtype=wp.int32),
    mask: wp.array(dtype=wp.int32),
    d: Decisions,
    f: Flags,
):
    """Counts iterations; environments that met negative curvature shall have a definite matrix."""
    env = wp.tid()
    again = 0
    if mask[env] != 0 and f.halt[0] == 0:
        d.spent[env] = d.spent[env] + iterations[env]
        if negative[env] != 0 and d.project[env] == 0:
            d.project[env] = 1
            again = 1
            f.again[0] = 1
    d.again[env] = again


@wp.kernel
def restart(
    right_side: wp.array2d(dtype=wp.vec3d),
    again: wp.array(dtype=wp.int32),
    residual: wp.array2d(dtype=wp.vec3d),
    p: wp.array2d(dtype=wp.vec3d),
):
    """The right-hand side once more, and no solution."""
    env, i = wp.tid()
    if again[env] != 0:
        residual[env, i] = right_side[env, i]
        p[env, i] = wp.vec3d()


@wp.kernel
def judge_direction(dt: wp.float64, d: Decisions, f: Flags):
    """Drops environments that are not finite; says who travels and who takes a plain step."""
    env = wp.tid()
    d.plain[env] = 0
    if f.halt[0] != 0:
        d.travelling[env] = 0
        return
    if d.active[env] == 0:
        return
    if not (d.size[env] < wp.float64(BAD)):
        d.failed[env] = 1
        d.active[env] = 0
        d.travelling[env] = 0
        return
    d.speed[env] = d.size[env] / dt
    if d.travelling[env] == 0:
        d.plain[env] = 1
        f.plain[0] = 1


@wp.kernel
def start_travel(d: Decisions, f: Flags):
    env = wp.tid()
    d.shorten[env] = d.travelling[env]
    d.attempts[env] = 0
    d.length[env] = wp.float64(d.travelling[env])
    if d.travelling[env] != 0:
        f.shorten[0] = 1


@wp.kernel
def try_travel(slack: wp.float64, floor: wp.float64, d: Decisions):
    """Where an advance of the present length ends, and what the gaps must keep.

    A shortened motion ends where a gap is about used up: it is looked at again (a turning frame's way is no straight line), with half the
    limit, or rounding would refuse what was just allowed.
    """
    env = wp.tid()
    one = wp.float64(1.0)
    length, share = d.length[env], d.share[env]
    d.share1[env] = share + length * (one - share)
    if d.travelling[env] != 0 and length == one:
        d.share1[env] = one
    d.alpha[env] = length
    ease = one
    if d.attempts[env] > 0:
        ease = wp.float64(0.5)
    d.slack[env] = ease * slack
    d.floor[env] = ease * floor
    d.trial_det[env] = wp.float64(wp.inf)


@wp.kernel
def judge_travel(d: Decisions, f: Flags):
    """Shortens the advance where a gap would close or an element invert. The energy is not asked: it is another one at the new frames."""
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
    if d.attempts[env] > TRAVEL_ATTEMPTS - 2:
        alpha = wp.float64(0.0)
    d.length[env] = d.length[env] * alpha * (one - wp.float64(1.0e-9))
    if d.attempts[env] >= TRAVEL_ATTEMPTS:
        d.shorten[env] = 0
    else:
        f.shorten[0] = 1


@wp.kernel
def conclude_travel(d: Decisions, f: Flags):
    """Takes the advance; frames that cannot come ahead although the unknowns had rested are blocked."""
    env = wp.tid()
    d.taken[env] = 0
    if f.halt[0] != 0 or d.travelling[env] == 0:
        return
    d.taken[env] = 1
    advance = d.share1[env] - d.share[env]
    d.share[env] = d.share1[env]
    if d.poor[env] != 0 and advance < wp.float64(BLOCKED_ADVANCE):
        d.active[env] = 0
        d.converged[env] = 1
    d.poor[env] = 0
    if d.length[env] < wp.float64(POOR_ADVANCE):
        d.poor[env] = 1
    d.rested[env] = 0
    d.ready[env] = 0


@wp.kernel
def start_limit(slack: wp.float64, d: Decisions):
    env = wp.tid()
    d.slack[env] = slack
    d.floor[env] = wp.float64(0.0)
    d.alpha[env] = wp.float64(1.0)


@wp.kernel
def start_search(reach: wp.array(dtype=wp.float64), d: Decisions, f: Flags):
    """Rounding of positions moves the energy by force × size × 1e-16: only steps of that effect are taken without a true decrease."""
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
def clear_det(d: Decisions):
    d.trial_det[wp.tid()] = wp.float64(wp.inf)


@wp.kernel
def judge_energy(most: wp.int32, d: Decisions, f: Flags):
    """Ends the search of an environment whose energy fell enough (Armijo), else halves its step."""
    env = wp.tid()
    if d.searching[env] == 0:
        return
    d.trials[env] = d.trials[env] + 1
    bound = wp.float64(ARMIJO) * d.alpha[env] * d.slope[env] + d.noise[env]
    if d.change[env] <= bound and d.trial_det[env] > wp.float64(0.0):
        d.searching[env] = 0
    else:
        d.alpha[env] = wp.float64(0.5) * d.alpha[env]
        if d.trials[env] < most:
            f.search[0] = 1


@wp.kernel
def end_search(d: Decisions, f: Flags):
    env = wp.tid()
    d.taken[env] = 0
    if d.plain[env] != 0 and f.halt[0] == 0:
        d.line_search[env] = d.line_search[env] + d.trials[env]
        d.taken[env] = 1 - d.searching[env]


@wp.kernel
def conclude(tolerance: wp.float64, max_newton: wp.int32, max_relags: wp.int32, friction: wp.int32, d: Decisions, f: Flags):
    """Who has arrived, who gives up, and whose friction is to be looked at again."""
    env = wp.tid()
    if f.halt[0] != 0:
        return
    was_active = d.travelling[env] + d.plain[env]
    if was_active != 0:
        d.newton[env] = d.newton[env] + 1
        d.used[env] = d.used[env] + 1
        d.linear[env] = d.linear[env] + d.spent[env]
    if d.plain[env] != 0:
        d.ready[env] = 1
        slow = d.speed[env] <= tolerance
        if d.searching[env] != 0:
            # Nothing lowered the energy: try again with a definite matrix; if it was definite, this is as far as it goes.
            if d.project[env] != 0 and not slow:
                d.stalled[env] = 1
                d.active[env] = 0
            d.project[env] = 1
        # A step this small has arrived, also where rounding of the energies kept it from being taken.
        if slow and d.allowed[env] >= wp.float64(1.0):
            d.rested[env] = 1
            if d.share[env] >= wp.float64(1.0) and d.active[env] != 0:
                d.converged[env] = 1
                d.active[env] = 0
    if was_active != 0 and d.used[env] >= max_newton:
        d.active[env] = 0
    if was_active != 0 and d.active[env] == 0 and friction != 0 and d.relags[env] < max_relags:
        d.pending[env] = 1


@wp.kernel
def choose_good(d: Decisions):
    """Environments that failed go back to where the step began, their frames too."""
    env = wp.tid()
    d.good[env] = d.alive[env] * (1 - d.failed[env])
    d.converged[env] = d.converged[env] * d.good[env]
    d.taken[env] = d.failed[env]
    if d.failed[env] != 0:
        d.share[env] = wp.float64(0.0)


class StepState:
    """The decisions of a batch and the flags made from them; each kind lies in one array, so that a step is read in one copy.

    Args:
        batch: environments, B.
        project: mask of environments whose Hessian is made definite (B,).
        halt: flag that stops everything until buffers have grown.
        device: Warp device.
    """

    def __init__(self, batch: int, project: wp.array, halt: wp.array, device: wp.Device) -> None:
        self.batch, self.device = batch, device
        self._ints = wp.zeros((len(INTS), batch), dtype=wp.int32, device=device)
        self._floats = wp.zeros((len(FLOATS), batch), dtype=wp.float64, device=device)
        self.decisions = Decisions()
        for names, store in ((INTS, self._ints), (FLOATS, self._floats)):
            for k, name in enumerate(names):
                setattr(self.decisions, name, store[k])
        self.decisions.project = project
        names = ("go", "pending", "travel", "again", "shorten", "plain", "search", "done")
        self._flags = wp.zeros(len(names), dtype=wp.int32, device=device)
        self.flags = Flags()
        self.flags.halt = halt
        for k, name in enumerate(names):
            setattr(self.flags, name, self._flags[k : k + 1])

    def clear_flags(self) -> None:
        """All flags but ``halt`` become 0."""
        self._flags.zero_()

    def launch(self, kernel: Any, *inputs: object) -> None:
        """Launch a kernel of this module, one thread an environment; decisions, and flags where it takes them, come last."""
        last: list = [self.decisions]
        if any(a.label == "f" for a in kernel.adj.args):
            last.append(self.flags)
        wp.launch(kernel, dim=self.batch, inputs=[*inputs, *last], device=self.device)

    def read(self) -> dict[str, NDArray]:
        """All numbers on the host, by name, each (B,); waits for the device."""
        ints, floats = self._ints.numpy(), self._floats.numpy()
        found: dict[str, NDArray] = {name: ints[k].copy() for k, name in enumerate(INTS)}
        return found | {name: floats[k].copy() for k, name in enumerate(FLOATS)}

    def write_alive(self, alive: NDArray[np.bool_]) -> None:
        """Say which environments (B,) take part in the next step."""
        self.decisions.alive.assign(alive.astype(np.int32))
