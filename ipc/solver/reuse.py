"""Elastic blocks of an earlier Newton iteration, while no element has deformed much since.

Only in the worlds of :mod:`ipc.solver.halves` without grips and affine bodies. The rows of volume blocks, which carry most of λ, are those
of the state as it is. A step begins with new blocks, so that it is a function of its start alone.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false

from __future__ import annotations

import warp as wp

from ipc.arrays import IntArray, MatArray2d

wp.set_module_options({"enable_backward": False})

DEFORMED = wp.constant(wp.float64(0.04))
"""Change of F (Frobenius norm) of an element from which the blocks are computed anew [-]."""
NONE = wp.constant(-1)
"""Value of ``filled`` in an environment without blocks."""


@wp.kernel
def choose_stale(F: MatArray2d, project: IntArray, active: IntArray, filled_F: MatArray2d, filled: IntArray, stale: IntArray):
    """Mark the active environments (B,) whose blocks have to be computed, and keep their F.

    ``filled`` (B,): ``project`` at the last time, or ``NONE``. Only where threads run one after the other, as on a CPU.
    """
    env = wp.tid()
    stale[env] = 0
    if active[env] == 0:
        return
    most = wp.float64(0.0)
    if filled[env] != project[env]:
        most = wp.float64(wp.inf)
    for e in range(F.shape[1]):
        if not (most <= DEFORMED * DEFORMED):  # greater or not a number
            break
        change = F[env, e] - filled_F[env, e]
        most = wp.ddot(change, change)
    if not (most <= DEFORMED * DEFORMED):
        stale[env] = 1
        filled[env] = project[env]
        for e in range(F.shape[1]):
            filled_F[env, e] = F[env, e]
