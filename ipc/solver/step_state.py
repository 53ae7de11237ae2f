"""The state of a step: the decisions of each environment, and flags made from them."""

# pyright: reportInvalidTypeForm=false

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ipc.arrays import FloatArray, IntArray

wp.set_module_options({"enable_backward": False})


@wp.struct
class Decisions:
    """Arrays (B,), one element an environment. Masks and marks are 0 or 1."""

    alive: IntArray  # takes part in this step
    active: IntArray  # is being minimised
    pending: IntArray  # came to rest, or begins: its friction is to be lagged
    touching: IntArray  # is either: its contacts are wanted
    lagging: IntArray  # its friction is lagged now
    advancing: IntArray  # its frames advance in this iteration
    plain: IntArray  # takes an ordinary Newton step in this iteration
    again: IntArray  # solves again with a definite matrix
    tightening: IntArray  # solves on, to the final tolerance
    shorten: IntArray  # still looks for the length of its advance
    attempts: IntArray  # at that length
    searching: IntArray  # still looks for the length of its Newton step
    trials: IntArray  # of that length
    accepted: IntArray  # changes state now
    pcg_iterations: IntArray  # in this Newton iteration
    poor: IntArray  # its frames hardly advanced: plain iterations until the unknowns rest, then one more try
    rested: IntArray  # its unknowns came to rest since the last advance
    ready: IntArray  # took a plain step since the last advance
    since_lag: IntArray  # iterations since friction was lagged
    renewed: IntArray  # times that friction was renewed within the first solve, where it was calm
    keep: IntArray  # keeps the state that it has come to, also if it has not converged
    good: IntArray  # ends the step with a new state
    failed: IntArray
    converged: IntArray
    stalled: IntArray
    newton: IntArray
    linear: IntArray
    line_search: IntArray
    relags: IntArray  # −1 before friction was lagged for the first time
    project: IntArray  # its Hessian is made definite in this Newton iteration
    projected: IntArray  # it was in any
    progress: FloatArray  # share of the frames' motion that is done
    trial_progress: FloatArray  # where the advance that is tried would end
    length: FloatArray  # of an advance, as a share of what remains
    alpha: FloatArray  # length of the step that is tried
    allowed: FloatArray  # by continuous collision detection
    slope: FloatArray
    change: FloatArray  # of the energy
    noise: FloatArray  # of the energy, by rounding
    trial_det: FloatArray  # least det F of the step that is tried
    size: FloatArray  # of the Newton step
    last: FloatArray  # size of the Newton step before; 0 in a step's first
    slack: FloatArray  # share of a gap that has to stay
    floor: FloatArray  # gap that has to stay
    changed: FloatArray  # share of the friction forces that the last lag changed
    last_changed: FloatArray  # and the one before
    worst_changed: FloatArray  # share of the friction forces on a body that the last lag changed, of the body where it is largest
    sum_changed: FloatArray  # by how much the last lag changed the sum of the limits, as a share of it
    share: FloatArray  # of the last lag in the friction forces, the rest being those before it
    averaging: IntArray  # that share is not 1
    settled: IntArray  # keeps the friction from before the last lag
    speed: FloatArray
    ccd: FloatArray
    min_gap: FloatArray
    min_det: FloatArray


@wp.struct
class Flags:
    """Arrays of one element each."""

    halt: IntArray
    go: IntArray
    pending: IntArray
    average: IntArray
    settled: IntArray
    advance: IntArray
    again: IntArray
    tighten: IntArray
    shorten: IntArray
    plain: IntArray
    search: IntArray
    done: IntArray


class StepState:
    """The decisions and flags of a batch; each type lies in one array, read in one copy.

    Args:
        project: mask of environments whose Hessian is made definite (B,).
        last: largest displacement of a node in the last Newton step (B,) [m]; 0 before the first, and where bodies are free.
        halt: flag that stops everything until buffers have grown.
    """

    def __init__(self, batch: int, project: wp.array, last: wp.array, halt: wp.array, device: wp.Device) -> None:
        self.batch, self.device, self._keep = batch, device, False
        self.decisions, self.flags = Decisions(), Flags()
        self._arrays: list[tuple[list[str], wp.array]] = []
        for dtype in (wp.int32, wp.float64):
            names = [
                name for name, field in Decisions.vars.items() if field.type.dtype is dtype and name not in ("project", "last")
            ]
            rows = wp.zeros((len(names), batch), dtype=dtype, device=device)
            self._arrays.append((names, rows))
            for k, name in enumerate(names):
                setattr(self.decisions, name, rows[k])
        self.decisions.project, self.decisions.last = project, last
        names = [name for name in Flags.vars if name != "halt"]
        self._flags = wp.zeros(len(names), dtype=wp.int32, device=device)
        for k, name in enumerate(names):
            setattr(self.flags, name, self._flags[k : k + 1])
        self.flags.halt = halt

    def clear_flags(self) -> None:
        """Set all flags but ``halt`` to 0."""
        self._flags.zero_()

    def launch(self, kernel: Any, *inputs: object) -> None:
        """Launch a kernel of :mod:`ipc.solver.decisions`; decisions and flags come last."""
        wp.launch(kernel, dim=self.batch, inputs=[*inputs, self.decisions, self.flags], device=self.device)

    def read(self) -> dict[str, NDArray]:
        """All decisions on the host, by name, each (B,); waits for the device."""
        return {name: row.copy() for names, rows in self._arrays for name, row in zip(names, rows.numpy(), strict=True)}

    def write_alive(self, alive: NDArray[np.bool_], keep: bool) -> None:
        """Say which environments (B,) take part in the next step.

        ``keep``: they keep its state if it does not converge.
        """
        self.decisions.alive.assign(alive.astype(np.int32))
        if keep != self._keep:
            self._keep = keep
            self.decisions.keep.fill_(int(keep))
