"""Controller of a soft press: depth or normal force, shear, twist, tilt and release."""

from __future__ import annotations

import numpy as np

from raytac.io.progress import Progress
from raytac.physics.press import CLEARANCE, TURNS, PressTargets
from raytac.physics.soft.placement import PressPlacement
from raytac.physics.soft.press_solver import PressSolver
from raytac.physics.soft.reading import SoftReader
from raytac.specs.press import PressScene, StageSpec


class PressController:
    """Moves the object of a press through its stages, B environments together.

    A depth is that of the coat: the object is driven higher by the clearance that the barrier keeps, which is measured as the press
    goes on. A normal force is reached by a secant search of the depth, or by the weight of a free object.
    """

    def __init__(
        self, scene: PressScene, solver: PressSolver, reader: SoftReader, placement: PressPlacement, targets: PressTargets
    ) -> None:
        self._scene, self._solver, self._reader, self._placement = scene, solver, reader, placement
        self._targets, self.num_envs = targets, len(targets.lost)
        self._control, self._limits = solver.control, solver.control.substeps
        self._d_hat = reader.mesh.d_hat
        self._is_free = scene.object.dynamics == "affine"
        self._weight = max((stage.force or 0.0 for stage in scene.trajectory), default=0.0)
        self.bar = Progress(desc="press", show=False)
        """Counter of the solver's steps."""
        self._clear()

    def reset(self) -> None:
        """Return to the start: the pad at rest, the object above it."""
        self._clear()
        self._solver.reset()

    def begin(self, index: int, stage: StageSpec) -> None:
        """Begin a stage where the object is now, at the prescribed force, or else the present one.

        One that is none of the scene's (``index`` −1) was not checked before: errors as of ``PressPlacement.end_of``.
        """
        if index < 0:
            depth = np.where(np.isfinite(self._force), np.nan, self._depth)
            self._placement.end_of(index, stage, depth, self._shear, self._turn)
        present = np.maximum(np.nan_to_num(self._solver.normal_force()), 0.0)
        self._start = self._depth.copy(), self._shear.copy(), self._turn.copy()
        self._start_force = np.where(np.isfinite(self._force), self._force, present)

    def poses(self) -> np.ndarray:
        """Prescribed ``pad_from_object`` (B, 4, 4): higher than the depth by the clearance."""
        return self._placement.poses(self._clearance - self._depth, self._shear, self._turn)

    def case(self) -> np.ndarray | None:
        """``world_from_pad`` (B, 4, 4) if the case moves."""
        if self._scene.moves != "case":
            return None
        return self._placement.case(self._clearance - self._depth, self._shear, self._turn)

    def advance(self, stage: StageSpec, fraction: float) -> None:
        """Move from the present position to a ``fraction`` of the stage that was begun last."""
        depth, shear, turn = self._start
        if stage.kind in ("shear", *TURNS):
            if stage.kind == "shear":
                shear, turn = shear + fraction * (self._targets.shear(stage) - shear), self._turn
            else:
                shear, turn = self._shear, turn + fraction * (self._targets.turn(stage, turn) - turn)
            self._move(self._depth, shear, turn, follow=True)
            if not np.isfinite(self._force).any():
                self._settle_depth()  # a shear unloads what lies behind the object
        elif stage.kind == "release":
            self._force[:] = np.nan
            self._release(depth, fraction)
        elif stage.force is not None:
            self._force[:] = self._start_force + fraction * (stage.force - self._start_force)
            self._load()
        else:
            self._force[:] = np.nan
            depth = np.maximum(depth, 0.0)
            self._indent(depth + fraction * (self._targets.depth(stage) - depth), is_last=fraction == 1.0)
        self._converge()

    def _clear(self) -> None:
        batch = self.num_envs
        self._depth = np.full(batch, -CLEARANCE)
        self._shear, self._turn = np.zeros((batch, 2)), np.zeros((batch, 3))
        self._force = np.full(batch, np.nan)
        """Prescribed normal force [N]; NaN while a depth is prescribed."""
        self._clearance = np.full(batch, self._d_hat)
        """Clearance by which the object is raised [m]: the barrier's reach, then as measured."""
        self.measured = np.full(batch, np.nan)
        """Clearance in the last state read [m], (B,), set by the reader; NaN out of contact."""
        self._stiffness = np.full(batch, np.nan)
        self.failed: np.ndarray = self._targets.lost.copy()
        self._solver.unconverged[:] = 0

    def _indent(self, depth: np.ndarray, *, is_last: bool) -> None:
        """Drive the coat to a depth without overshoot; exactly there at the stage's end."""
        travel = depth - np.maximum(self._depth, -self._d_hat)
        # Follow the clearance, but never so fast that the object would stand still or turn back.
        error = np.nan_to_num(self.measured - self._clearance)
        self._clearance = self._clearance + np.clip(error, -self._d_hat, 0.5 * np.abs(travel))
        exact = np.full(self.num_envs, is_last) | np.isnan(self.measured)  # at the first touch no clearance is known yet
        margin = np.where(exact, np.clip(travel, 0.0, self._d_hat), 0.0)
        self._move(depth - margin, self._shear, self._turn)
        if exact.any():
            before = self._clearance
            self._clearance = before + np.nan_to_num(self._clearance_error())
            self._depth = depth
            self._step()
            self._settle_depth(np.minimum(before, self._clearance))

    def _move(
        self, depth: np.ndarray, shear: np.ndarray, turn: np.ndarray, stretch: float = 1.0, *, follow: bool = False
    ) -> None:
        """Move in a straight line, in steps of at most ``SubstepLimits.step`` times ``stretch``.

        A turn counts as the path of the surface that touches. A prescribed force is kept at each step; so is the depth if the controller
        is to ``follow`` the clearance.
        """
        limits = self._limits
        start = np.maximum(self._depth, -self._d_hat) if stretch == 1.0 else self._depth
        change, arm = turn - self._turn, limits.step / limits.turn
        # A twist is about the contact; a tilt about the object's origin, which may be far above it.
        by_twist = arm * np.abs(change[:, 2])
        by_tilt = np.maximum(arm, self._placement.lever) * np.linalg.norm(change[:, :2], axis=1)
        lengths = np.abs(depth - start), np.linalg.norm(shear - self._shear, axis=1), by_twist, by_tilt
        steps = max(int(np.ceil(max(length.max() for length in lengths) / (limits.step * stretch) - 1e-9)), 1)
        start_shear, start_turn = self._shear, self._turn
        for step in range(1, steps + 1):
            share = step / steps
            self._shear, self._turn = start_shear + share * (shear - start_shear), start_turn + share * (turn - start_turn)
            self._depth = start + share * (depth - start)
            self._step()
            if np.isfinite(self._force).any():
                self._load()
                start = depth = self._depth
            elif follow and step < steps:
                self._clearance = self._clearance + np.clip(np.nan_to_num(self._clearance_error()), -limits.step, limits.step)

    def _step(self) -> None:
        self._solver.fail(self.failed)
        if not self.failed.all():
            self.failed |= self._solver.step(self.poses(), self.case())
            self.bar.update()

    def _converge(self) -> None:
        """Repeat at rest a step that did not meet the tolerance; what never meets it has failed."""
        for _ in range(self._control.refinements):
            if (self._solver.converged | self.failed).all():
                return
            self._step()
            if np.isfinite(self._force).any():
                self._load()
            else:
                self._settle_depth()
        self.failed |= ~self._solver.converged

    def _clearance_error(self) -> np.ndarray:
        """Measured less applied clearance [m], (B,); NaN out of contact, 0 at a prescribed force."""
        clearance = self._reader.clearance(self._solver.coat_state(self.poses()))
        return np.where(self.failed | np.isfinite(self._force), 0.0, clearance - self._clearance)

    def _settle_depth(self, touching: np.ndarray | None = None) -> None:
        """Search the clearance at which the coat, not the barrier, is at the depth.

        ``touching``: a clearance (B,) at which the object is known to touch, so that one at which it does not is too large; without it,
        an object out of contact stays there. Between a clearance that is too small and one that is too large it goes by the secant.
        """
        low, high = np.full(self.num_envs, np.nan) if touching is None else touching, np.full(self.num_envs, np.nan)
        low_error, high_error = np.full(self.num_envs, np.nan), np.full(self.num_envs, np.nan)
        for _ in range(self._control.depth_steps):
            error = self._clearance_error()
            lost = np.isnan(error) & np.isfinite(low)
            error = np.nan_to_num(error)
            solved = (np.abs(error) < self._control.depth_tolerance) & ~lost
            if solved.all():
                return
            is_high = lost | (error < 0.0)
            low, low_error = (np.where(is_high, old, new) for old, new in ((low, self._clearance), (low_error, error)))
            high = np.where(is_high, self._clearance, high)
            high_error = np.where(is_high, np.where(lost, np.nan, error), high_error)
            share = np.clip(low_error / np.where(solved, 1.0, low_error - high_error), 0.1, 0.9)
            between = low + np.where(np.isfinite(share), share, 0.5) * (high - low)
            beyond = self._clearance + np.clip(error, -self._limits.step, self._limits.step)
            chosen = np.where(np.isfinite(between), between, beyond)
            self._clearance = np.where(solved, self._clearance, chosen)
            self._step()

    def _release(self, depth: np.ndarray, fraction: float) -> None:
        lift = self._placement.touch_drop(self._shear, self._turn)
        if self._is_free:
            if fraction == 1.0:
                self._solver.reset()
                self._depth = lift - CLEARANCE
            return
        self._move(depth + fraction * (lift - CLEARANCE - depth), self._shear, self._turn, self._control.release_stretch)

    def _load(self) -> None:
        """Reach the normal force: a free object by its weight, a driven one by a secant search."""
        if self._is_free:
            self._rest()
            return
        control, step = self._control, self._limits.step
        self._depth = np.maximum(self._depth, -self._d_hat)
        if not np.isfinite(self._stiffness).all():
            target = np.nan_to_num(self._force)
            self._stiffness = np.array([self._placement.stiffness(b, self._turn[b], target[b]) for b in range(self.num_envs)])
        force, drift = self._solver.normal_force(), np.zeros(self.num_envs)
        for _ in range(control.force_steps):
            error = self._force_error()
            if (np.abs(error) <= control.force_tolerance * np.nan_to_num(self._force)).all():
                return
            # The contact grows and stiffens on the way, a ball's as the cube root of its force.
            growth = np.clip(np.nan_to_num(self._force) / np.maximum(force, control.least_force), 1.0, control.growth)
            change = np.clip((error - drift) / (self._stiffness * 0.5 * (1.0 + np.cbrt(growth))), -step, step)
            self._depth = self._depth + change
            self._step()
            last, force = force, self._solver.normal_force()
            gain = force - last
            large = np.abs(self._stiffness * change) > control.stiffness_change * np.maximum(force, control.least_force)
            secant = gain / np.where(large, change, 1.0)
            self._stiffness = np.where(large & (secant > 0.3 * self._stiffness), secant, self._stiffness)
            drift = np.where(large, 0.0, gain - self._stiffness * change)
        self.failed |= np.abs(self._force_error()) > control.force_tolerance * np.nan_to_num(self._force)

    def _force_error(self) -> np.ndarray:
        """Prescribed normal force less the present one [N], (B,); 0 where none is prescribed."""
        return np.where(np.isfinite(self._force) & ~self.failed, self._force - self._solver.normal_force(), 0.0)

    def _rest(self) -> None:
        """Let a free object come to rest under its weight: slow at two steps in succession.

        At a turning point it is slow at one step."""
        assert self._weight > 0.0
        self._solver.set_gravity(float(self._force[0]) / self._weight)
        is_slow = is_at_rest = np.zeros(self.num_envs, bool)
        for _ in range(4 * self._control.force_steps):
            self._step()
            was_slow = is_slow
            is_slow = (self._solver.speed() < self._control.rest_speed) & (self._solver.normal_force() > 0.0)
            is_at_rest = was_slow & is_slow
            if (is_at_rest | self.failed).all():
                return
        self.failed |= ~is_at_rest
