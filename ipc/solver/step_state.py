"""The state of a step: the decisions of each environment, and flags made from them."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

__all__ = ["Decisions", "Flags", "StepState"]

wp.set_module_options({"enable_backward": False})


@wp.struct
class Decisions:
    """Arrays (B,), one element an environment. Masks and marks are 0 or 1."""

    alive: wp.array(dtype=wp.int32)  # takes part in this step
    active: wp.array(dtype=wp.int32)  # is being minimised
    pending: wp.array(dtype=wp.int32)  # came to rest, or begins: its friction is to be lagged
    lagging: wp.array(dtype=wp.int32)  # its friction is lagged now
    advancing: wp.array(dtype=wp.int32)  # its frames advance in this iteration
    plain: wp.array(dtype=wp.int32)  # takes an ordinary Newton step in this iteration
    again: wp.array(dtype=wp.int32)  # solves again with a definite matrix
    shorten: wp.array(dtype=wp.int32)  # still looks for the length of its advance
    attempts: wp.array(dtype=wp.int32)  # at that length
    searching: wp.array(dtype=wp.int32)  # still looks for the length of its Newton step
    trials: wp.array(dtype=wp.int32)  # of that length
    accepted: wp.array(dtype=wp.int32)  # changes state now
    pcg_iterations: wp.array(dtype=wp.int32)  # in this Newton iteration
    poor: wp.array(dtype=wp.int32)  # its frames hardly advanced: plain iterations until the unknowns rest, then one more try
    rested: wp.array(dtype=wp.int32)  # its unknowns came to rest since the last advance
    ready: wp.array(dtype=wp.int32)  # took a plain step since the last advance
    since_lag: wp.array(dtype=wp.int32)  # iterations since friction was lagged
    good: wp.array(dtype=wp.int32)  # ends the step with a new state
    failed: wp.array(dtype=wp.int32)
    converged: wp.array(dtype=wp.int32)
    stalled: wp.array(dtype=wp.int32)
    newton: wp.array(dtype=wp.int32)
    linear: wp.array(dtype=wp.int32)
    line_search: wp.array(dtype=wp.int32)
    relags: wp.array(dtype=wp.int32)  # −1 before friction was lagged for the first time
    project: wp.array(dtype=wp.int32)  # its Hessian is made definite
    progress: wp.array(dtype=wp.float64)  # share of the frames' motion that is done
    trial_progress: wp.array(dtype=wp.float64)  # where the advance that is tried would end
    length: wp.array(dtype=wp.float64)  # of an advance, as a share of what remains
    alpha: wp.array(dtype=wp.float64)  # length of the step that is tried
    allowed: wp.array(dtype=wp.float64)  # by continuous collision detection
    slope: wp.array(dtype=wp.float64)
    change: wp.array(dtype=wp.float64)  # of the energy
    noise: wp.array(dtype=wp.float64)  # of the energy, by rounding
    trial_det: wp.array(dtype=wp.float64)  # least det F of the step that is tried
    size: wp.array(dtype=wp.float64)  # of the Newton step
    slack: wp.array(dtype=wp.float64)  # share of a gap that has to stay
    floor: wp.array(dtype=wp.float64)  # gap that has to stay
    changed: wp.array(dtype=wp.float64)  # share of the friction forces that the last lag changed
    speed: wp.array(dtype=wp.float64)
    ccd: wp.array(dtype=wp.float64)
    min_gap: wp.array(dtype=wp.float64)
    min_det: wp.array(dtype=wp.float64)


@wp.struct
class Flags:
    """Arrays of one element each."""

    halt: wp.array(dtype=wp.int32)
    go: wp.array(dtype=wp.int32)
    pending: wp.array(dtype=wp.int32)
    advance: wp.array(dtype=wp.int32)
    again: wp.array(dtype=wp.int32)
    shorten: wp.array(dtype=wp.int32)
    plain: wp.array(dtype=wp.int32)
    search: wp.array(dtype=wp.int32)
    done: wp.array(dtype=wp.int32)


class StepState:
    """The decisions and flags of a batch; each type lies in one array, read in one copy.

    Args:
        batch: environments, B.
        project: mask of environments whose Hessian is made definite (B,).
        halt: flag that stops everything until buffers have grown.
        device: Warp device.
    """

    def __init__(self, batch: int, project: wp.array, halt: wp.array, device: wp.Device) -> None:
        self.batch, self.device = batch, device
        self.decisions, self.flags = Decisions(), Flags()
        self._arrays: list[tuple[list[str], wp.array]] = []
        for dtype in (wp.int32, wp.float64):
            names = [name for name, field in Decisions.vars.items() if field.type.dtype is dtype and name != "project"]
            rows = wp.zeros((len(names), batch), dtype=dtype, device=device)
            self._arrays.append((names, rows))
            for k, name in enumerate(names):
                setattr(self.decisions, name, rows[k])
        self.decisions.project = project
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

    def write_alive(self, alive: NDArray[np.bool_]) -> None:
        """Say which environments (B,) take part in the next step."""
        self.decisions.alive.assign(alive.astype(np.int32))
