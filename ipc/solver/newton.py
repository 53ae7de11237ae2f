"""One time step: driven bodies advance, and Newton minimises the incremental potential.

A Newton iteration has four parts:
(i) While driven frames have not arrived, their motion enters the right-hand side, so that the unknowns make room for them in the same step.
Frames and unknowns then move together as far as gaps allow.
(ii) H p = −g is solved by PCG, with the exact Hessian first, and with a positive semi-definite one if negative curvature is met
(projection on demand, after Longva et al. 2023, "Pitfalls of Projection"), in each iteration anew: the definite one alone creeps. It is
solved loosely, as in inexact Newton methods (Dembo, Eisenstat, Steihaug 1982), and to the linear tolerance only where p is so small that
it may be the last.
(iii) Continuous collision detection limits the step.
(iv) The step is halved until the energy falls enough and no tetrahedron is inverted.

An environment is done when p is small and its frames have arrived, or are blocked. Its friction is then lagged again, as often as the
settings say. If it does not get done, it returns to the start of the step, which is repeated in two halves, and these likewise: with
Coulomb's friction a step may have no solution near, where a shorter one does. Environments never wait on or change each other's
arithmetic: every decision is a mask.

The loop itself is made of conditional nodes, so that a whole step is one graph launch without the host: on a CPU, Warp goes through what
was recorded in C++. If a buffer was too small, the step halts before anything changes, the host lets the buffer grow, and the step goes
on from there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ipc.bodies.layout import Layout
from ipc.errors import SolverError
from ipc.reduce import MIN
from ipc.settings import Settings
from ipc.solver import decisions, dynamics, frames
from ipc.solver.pcg import Pcg
from ipc.solver.potential import Potential
from ipc.solver.preconditioners import make_preconditioner
from ipc.solver.step_state import StepState

_RENEWALS = 20
"""Most renewals of friction within a step's first solve, where every body is held."""
_CALM, _CALM_RENEWALS = 10.0, 6
"""Longest Newton step [ε] before a renewal where a body is free, and most of these."""
_STILL = 0.1
"""Longest last Newton step [ε] of a solve whose forces are taken without another one."""


class Newton:
    """The step of a batch; it moves the state of ``potential``."""

    def __init__(self, potential: Potential, layout: Layout, settings: Settings) -> None:
        self.potential, self.settings = potential, settings
        self.batch, self.device = potential.batch, potential.device
        self.state = StepState(self.batch, potential.project, potential.last, potential.collision.overflow, self.device)
        nodes, lanes = len(layout.node_rest), potential.collision.lanes
        self.pcg = Pcg(self.batch, nodes, lanes, self.device)
        self.preconditioner = make_preconditioner(layout, settings, self.batch, lanes, self.device)
        # A free ball rests on a point: only sums that mirror each other keep it there, and those by halves do not.
        if not self.device.is_cuda and self.pcg.is_in_one_block(self.preconditioner) and _is_held(layout):
            potential.use_halves()
            self.preconditioner.use_lines(layout, potential.where)
            self.pcg.use_lines()
        self._still = wp.zeros_like(potential.x)
        self._friction = int(potential.collision.friction)
        self._renewals, self._calm_renewals = (_RENEWALS, 0) if _is_held(layout) else (0, _CALM_RENEWALS)
        self._loose = max(settings.linear_tolerance, settings.forcing)
        self._graphs: dict[str, Any] = {}
        """Recordings by name of what was recorded; None for what ran once as it stands."""
        self.timers: dict[str, float] = {}

    # --- timing and recording --------------------------------------------------------------------------------------------------

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        """Add a stage's time to ``timers``; a recorded step has no stages."""
        if self._recorded():
            yield
            return
        start = time.perf_counter()
        yield
        if self.device.is_cuda:
            wp.synchronize_device(self.device)
        self.timers[name] = self.timers.get(name, 0.0) + time.perf_counter() - start

    def _recorded(self) -> bool:
        return self.settings.graph and (self.device.is_cuda or not self.preconditioner.on_host)

    def _run(self, body: Callable[[], None]) -> None:
        """Run ``body`` from a recording, which is made at the first call and after buffers grow.

        On a CPU it is made at the second: a recording takes as long as two or three Newton iterations without it, and buffers often grow in
        the first steps of a world.
        """
        if not self._recorded():
            body()
            return
        key = body.__name__
        if not self.device.is_cuda and key not in self._graphs:
            self._graphs[key] = None
            body()
            return
        if self._graphs.get(key) is None:
            if self.device.is_cuda:
                wp.load_module("ipc", device=self.device, recursive=True)
            with wp.ScopedCapture(device=self.device) as capture:
                body()
            self._graphs[key] = capture.graph
        wp.capture_launch(self._graphs[key])

    def forget_recordings(self) -> None:
        """Record anew at the next step: buffers have grown."""
        self._graphs.clear()

    # --- the step --------------------------------------------------------------------------------------------------------------

    def step(self, alive: NDArray[np.bool_]) -> dict[str, NDArray]:
        """Advance ``alive`` (B,) by a step; returns decisions by name, and which are ``halved``."""
        most = self.settings.halvings
        total = self._attempt(alive, keep=most == 0)
        lost = _unconverged(total, alive) & (most > 0)
        total["halved"] = lost
        if lost.any():
            self._halve(total, lost)
        return total

    def _halve(self, total: dict[str, NDArray], lost: NDArray[np.bool_]) -> None:
        """Repeat a step in halves; after a smallest part that fails, the rest at once."""
        pot, most = self.potential, self.settings.halvings
        start, goal = [wp.clone(a) for a in (pot.frame_q, pot.frame_p)], [wp.clone(a) for a in (pot.goal_q, pot.goal_p)]
        dt, share = pot.dt.numpy().copy(), wp.zeros(self.batch, dtype=wp.float64, device=self.device)
        done, undone = np.zeros(self.batch), np.zeros(self.batch)
        fresh = {"min_gap": np.inf, "min_det": np.inf, "ccd": 1.0, "stalled": 0, "speed": 0.0, "converged": 1}
        for name, none in fresh.items():
            total[name][lost] = none

        def advance(envs: NDArray[np.bool_], end: float, depth: int) -> None:
            """To a share ``end`` of the motion and the time."""
            envs = envs & (total["failed"] == 0) & (total["converged"] == 1) & (done < end)
            if not envs.any():
                return
            part = np.where(envs, end - done, 1.0)
            share.fill_(end)
            pot.launch(frames.frames_at, pot.frame_q.shape, [*start, *goal, share], [pot.R1, pot.goal_p, pot.goal_q])
            pot.dt.assign(part * dt)
            values = self._attempt(envs, keep=depth == most)
            for name in ("newton", "linear", "line_search", "relags"):
                total[name][envs] += np.maximum(values[name][envs], 0)
            again = _unconverged(values, envs) & (depth < most)
            kept = envs & ~again
            for name in ("min_gap", "min_det", "ccd", "converged"):
                total[name][kept] = np.minimum(total[name][kept], values[name][kept])
            for name in ("failed", "stalled", "projected", "speed"):
                total[name][kept] = np.maximum(total[name][kept], values[name][kept])
            undone[kept] = (1.0 - values["progress"][kept]) * (part + undone)[kept]
            done[kept] = end
            advance(again, end - 0.5 ** (depth + 1), depth + 1)
            advance(again, end, depth + 1)

        try:
            advance(lost, 0.5, 1)
            advance(lost, 1.0, 1)
            settled, total["converged"] = total["converged"], np.ones_like(total["converged"])
            advance(lost, 1.0, most)
        finally:  # also after an error, the goals and the time step are those of the whole step
            wp.copy(pot.goal_q, goal[0])
            wp.copy(pot.goal_p, goal[1])
            pot.dt.assign(dt)
        total["converged"] = np.minimum(total["converged"], settled)
        total["progress"][lost] = np.where(total["failed"] == 0, 1.0 - undone, 0.0)[lost]

    def _attempt(self, alive: NDArray[np.bool_], keep: bool) -> dict[str, NDArray]:
        """Advance ``alive`` (B,); a step is taken back unless it converges or ``keep``."""
        since = time.perf_counter()
        self.state.write_alive(alive, keep)
        self._run(self._whole)
        values = self.state.read()
        for _ in range(64):
            if not self.potential.collision.overflow.numpy()[0]:
                break
            self.potential.collision.grow()
            self.forget_recordings()
            self._run(self._rest)
            values = self.state.read()
        else:
            raise SolverError("contact buffers grew 64 times in one step and are still too small")
        self.timers["step"] = self.timers.get("step", 0.0) + time.perf_counter() - since
        return values

    def _whole(self) -> None:
        with self._stage("begin"):
            self._begin()
        self._rest()

    def _rest(self) -> None:
        """Everything after the preparation; repeated once buffers have grown."""
        pot, state = self.potential, self.state
        with self._stage("broad"):
            pot.collision.refresh(pot.x, self._still, state.decisions.alive)
        self._set_flags()
        wp.capture_while(state.flags.go, self._iterate)
        wp.launch(decisions.set_done, dim=1, inputs=[state.flags], device=self.device)
        wp.capture_if(state.flags.done, self._assemble_end)
        wp.launch(decisions.set_done, dim=1, inputs=[state.flags], device=self.device)
        wp.capture_if(state.flags.done, self._end)

    def _begin(self) -> None:
        pot, state = self.potential, self.state
        inputs = [pot.frame_q, pot.frame_p, pot.goal_q, pot.goal_p, pot.frame_moves]
        pot.launch(frames.compare_frames, self.batch, inputs, [state.decisions.progress])
        state.launch(decisions.start_step, self._friction)
        pot.set_frames(state.decisions.progress, pot.R, pot.t)
        pot.place_grips(pot.y, pot.R, pot.t)
        pot.place_vertices(pot.y, pot.R, pot.t, pot.x)
        wp.copy(pot.x_start, pot.x)
        wp.copy(pot.y_start, pot.y)
        pot.place_nodes(pot.xw)
        pot.aim()
        pot.aim_inertia(pot.R, pot.t)
        pot.measure_reach()
        pot.forget_matrix()

    def _set_flags(self) -> None:
        self.state.clear_flags()
        self.state.launch(decisions.set_flags)

    def _note_extremes(self, mask: wp.array) -> None:
        """Least gap and determinant of the state just assembled."""
        pot, d = self.potential, self.state.decisions
        contacts = pot.collision.contacts
        pot.reduce(contacts.gap, mask, MIN, d.min_gap, contacts.count)
        pot.reduce(pot.el_J, mask, MIN, d.min_det)

    def _iterate(self) -> None:
        """One Newton iteration of every active environment."""
        pot, state, settings = self.potential, self.state, self.settings
        d, f = state.decisions, state.flags
        with self._stage("forces"):
            pot.touch(d.touching)
        if self._friction:
            wp.capture_if(f.pending, self._lag)
        state.launch(decisions.choose_advancing)
        wp.capture_if(f.advance, pot.prescribe, progress=d.trial_progress)
        with self._stage("forces"):
            pot.assemble(d.active, touched=True)
            self._note_extremes(d.active)
        with self._stage("matrix"):
            pot.fill_matrix(d.active)
            wp.capture_if(f.advance, pot.push_prescribed, mask=d.advancing)
        self._solve()
        pot.size_of_step(d.active, d.size)
        if self._loose > settings.linear_tolerance:
            state.launch(decisions.choose_tightening, settings.velocity_tolerance, pot.dt)
            wp.capture_if(f.tighten, self._tighten)
        state.launch(decisions.judge_direction, pot.dt)
        with self._stage("advance"):
            wp.capture_if(f.advance, self._advance)
        wp.capture_if(f.plain, self._line_search)
        tolerance = settings.velocity_tolerance
        calm = _CALM * settings.friction_slip
        limits = settings.max_newton, settings.friction_relags, self._renewals, self._calm_renewals, calm
        state.launch(decisions.conclude, tolerance, *limits, self._friction)
        self._set_flags()

    def _lag(self) -> None:
        """Friction of the environments that rest, or begin, from their contacts as they are."""
        pot, state = self.potential, self.state
        with self._stage("lag"):
            state.launch(decisions.choose_lagging)
            d = state.decisions
            changes = d.changed, d.worst_changed, d.sum_changed
            pot.collision.lag(d.relags, d.lagging, changes, guarded=self._calm_renewals > 0)
            settings = self.settings
            still = _STILL * settings.friction_slip
            state.launch(decisions.after_lag, settings.friction_tolerance, settings.friction_relags, still)
            wp.capture_if(state.flags.average, pot.collision.average, share=d.share, active=d.averaging)
            wp.capture_if(state.flags.settled, pot.collision.undo_lag, active=d.settled)

    def _solve(self) -> None:
        """p for the active environments; with a definite matrix where negative curvature was met."""
        pot, state = self.potential, self.state
        pot.p.zero_()
        wp.copy(pot.right_side, pot.residual)
        self._update_preconditioner(state.decisions.active)
        self._iterate_linear(state.decisions.active, self._loose)
        wp.capture_if(state.flags.again, self._solve_again, tolerance=self._loose)

    def _tighten(self) -> None:
        """Continue the solves of steps that may be the last, and measure these again."""
        pot, d = self.potential, self.state.decisions
        tolerance = self.settings.linear_tolerance
        self.state.flags.again.zero_()
        self._iterate_linear(d.tightening, tolerance / self._loose)
        wp.capture_if(self.state.flags.again, self._solve_again, tolerance=tolerance)
        pot.size_of_step(d.tightening, d.size)

    def _update_preconditioner(self, mask: wp.array) -> None:
        pot, contacts = self.potential, self.potential.collision.contacts
        with self._stage("preconditioner"):
            pot.turn_rows(mask)
            self.preconditioner.update(pot.system, contacts, contacts.row.shape[1], mask)
            pot.fold_rows(mask)

    def _iterate_linear(self, mask: wp.array, tolerance: float) -> None:
        """Improve p by conjugate gradients until a share ``tolerance`` of the residual remains."""
        pot, s = self.potential, self.pcg.scalars
        with self._stage("pcg"):
            self.pcg.solve(
                *(pot.system, pot.collision.contacts, self.preconditioner, pot.residual, pot.p),
                *(tolerance, self.settings.max_linear, mask),
            )
        self.state.launch(decisions.after_solve, s.iterations, s.negative, mask)

    def _solve_again(self, tolerance: float) -> None:
        pot, again = self.potential, self.state.decisions.again
        pot.evaluate_elements(again)
        pot.fill_matrix(again)
        pot.launch(dynamics.restart, pot.p.shape, [pot.right_side, again], [pot.residual, pot.p])
        self._update_preconditioner(again)
        self._iterate_linear(again, tolerance)

    def _advance(self) -> None:
        """Move frames and unknowns together as far as gaps allow."""
        pot, state = self.potential, self.state
        d = state.decisions
        state.launch(decisions.start_advance)
        wp.capture_while(state.flags.shorten, self._try_advance)
        state.launch(decisions.conclude_advance, self.settings.blocked_advance, self.settings.poor_advance)
        for old, new in ((pot.y, pot.y1), (pot.x, pot.x1), (pot.t, pot.t1)):
            pot.launch(dynamics.take_vectors, old.shape, [new, d.accepted], [old])
        pot.launch(dynamics.take_matrices, pot.R.shape, [pot.R1, d.accepted], [pot.R])
        pot.aim_inertia(pot.R, pot.t)

    def _try_advance(self) -> None:
        pot, state = self.potential, self.state
        d = state.decisions
        slack, floor = 1.0 - self.settings.motion_fraction, self.settings.gap_floor * pot.collision.d_hat
        state.launch(decisions.try_advance, slack, floor)
        pot.set_frames(d.trial_progress, pot.R1, pot.t1)
        pot.launch(dynamics.advance_nodes, pot.y.shape, [pot.y, pot.p, d.alpha, pot.y1])
        pot.place_grips(pot.y1, pot.R1, pot.t1)
        pot.place_vertices(pot.y1, pot.R1, pot.t1, pot.x1)
        pot.launch(dynamics.difference, pot.x.shape, [pot.x1, pot.x], [pot.dx])
        pot.collision.refresh(pot.x, pot.dx, d.shorten)
        d.alpha.fill_(1.0)
        pot.collision.limit_step(pot.x, pot.dx, (pot.R, pot.t), (pot.R1, pot.t1), d.slack, d.floor, pot.reach, d.shorten, d.alpha)
        pot.elastic_change(d.shorten, d.trial_det)
        state.flags.shorten.zero_()
        state.launch(decisions.judge_advance, self.settings.max_advance_attempts)

    def _line_search(self) -> None:
        """Take the step p as far as contacts, energy and inversion allow."""
        pot, state = self.potential, self.state
        d = state.decisions
        pot.launch(frames.vertex_motion, pot.x.shape, [pot.p, pot.R, pot.verts], [pot.dx])
        with self._stage("broad"):
            pot.collision.refresh(pot.x, pot.dx, d.plain)
        with self._stage("ccd"):
            state.launch(decisions.start_limit, self.settings.ccd_slack)
            Rt = (pot.R, pot.t)
            pot.collision.limit_step(pot.x, pot.dx, Rt, Rt, d.slack, d.floor, pot.reach, d.plain, d.alpha)
        with self._stage("line_search"):
            pot.slope(d.plain, d.slope, d.noise)
            state.launch(decisions.start_search, pot.reach)
            wp.capture_while(state.flags.search, self._try_step)
            state.launch(decisions.end_search)
            if self._friction and self._calm_renewals:
                pot.collision.guard_slips(pot.x, pot.dx, pot.x_start, d.plain, state.flags.halt)
            pot.launch(dynamics.take_vectors, pot.y.shape, [pot.y1, d.accepted], [pot.y])
            pot.launch(dynamics.take_vectors, pot.x.shape, [pot.x1, d.accepted], [pot.x])

    def _try_step(self) -> None:
        pot, state = self.potential, self.state
        d = state.decisions
        pot.try_step(d.alpha)
        state.launch(decisions.clear_det)
        pot.change(d.searching, d.change, d.trial_det)
        state.flags.search.zero_()
        state.launch(decisions.judge_energy, self.settings.armijo, self.settings.max_line_search)

    def _assemble_end(self) -> None:
        """Forces and contacts of the last state."""
        state = self.state
        state.launch(decisions.choose_good)
        with self._stage("forces"):
            self.potential.assemble(state.decisions.good)
            self._note_extremes(state.decisions.good)

    def _end(self) -> None:
        """Velocities and frames for the next step; failed environments return to their start."""
        pot, state = self.potential, self.state
        d = state.decisions
        with self._stage("end"):
            pot.launch(dynamics.take_vectors, pot.y.shape, [pot.y_start, d.accepted], [pot.y])
            pot.place_nodes(pot.xw1)
            pot.launch(dynamics.new_velocity, pot.xw.shape, [pot.xw1, pot.xw, pot.dt, d.good], [pot.v])
            pot.set_frames(d.progress, pot.R, pot.t)
            pot.place_vertices(pot.y, pot.R, pot.t, pot.x)
            if self._friction:
                pot.collision.remember(pot.x, pot.y, pot.R, self.settings.friction_slip, d.good)
            wp.copy(pot.frame_q, pot.now_q)
            wp.copy(pot.frame_p, pot.t)
            pot.energies()


def _unconverged(values: dict[str, NDArray], envs: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return envs & (values["converged"] == 0) & (values["failed"] == 0)


def _is_held(layout: Layout) -> bool:
    """True if no body is free: each that moves has bonded or gripped nodes, or a drive.

    A free body slides and lands by its inertia. Its normal forces before Newton's method has balanced them say little of its friction.
    """
    fixed = (layout.node_free == 0) | (layout.node_drive > 0)
    fixed[layout.grip_node] = True
    return np.isin(layout.node_body, layout.node_body[fixed]).all().item()
