"""Length of an environment's steps in NumPy: oracle of ``step_kernels``."""

from __future__ import annotations

import numpy as np

from raytac.world.hard_contacts import HARD_MARGIN

_SHORTEST = 1e-6
"""Steps are not shorter than this, or half of it [s]."""
TRAVEL = 0.05
"""Greatest share of the gel's thickness by which any place of a contact closes or opens in a step."""
_SWING = 0.02
"""Share of the thickness from which a contact that swings on its own stiffness is resolved …"""
_PHASE = 0.1
"""… with this phase angle a step [rad]."""
_CASE_TRAVEL = 0.8 * HARD_MARGIN
"""Greatest travel of a body beside a case in a step [m]: less than the gap from which their contact is known."""


class StepChoice:
    """Steps Δt = T / 2^k of a scene's step T: a step of 2^k starts at a multiple of itself only, so that all end together at T."""

    def __init__(self, timestep: float) -> None:
        self.timestep = timestep
        self.ticks = 2 ** max(int(np.ceil(np.log2(timestep / _SHORTEST))), 0)
        """Parts of the scene's step."""

    def longest(
        self,
        depth: np.ndarray,
        speed: np.ndarray,
        tilting: np.ndarray,
        rate: np.ndarray,
        acceleration: np.ndarray,
        thickness: np.ndarray,
    ) -> np.ndarray:
        """Longest step (n,) [s] for n contacts.

        Args:
            depth: δ [m], negative is a gap.
            speed: at which they close [m/s].
            tilting: speed at which their rims close on one side and open on the other [m/s].
            rate: angular frequency of the contact [1/s] as deep as it goes in the scene's step.
            acceleration: of closing in the last step [m/s²].
            thickness: of the gel [m].
        """
        quick = np.maximum(np.abs(speed), 1e-12)
        travel = TRAVEL * thickness / (quick + tilting)
        swings = np.hypot(speed, acceleration / rate) / rate > _SWING * thickness
        inside = np.where(swings, np.minimum(travel, _PHASE / rate), travel)
        # Up to the gel in one step, into it in short ones.
        before = np.where(speed > 0.0, np.maximum(np.maximum(-depth, 0.0) / quick, inside), np.inf)
        return np.where(depth > 0.0, inside, before)

    @staticmethod
    def beside_case(gap: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Longest steps [s] of bodies at gaps [m] from cases, at speeds [m/s]: up to the case in one step, along it in short ones."""
        return np.maximum(gap, _CASE_TRAVEL) / np.maximum(speed, 1e-12)

    def rounded(self, longest: np.ndarray, done: np.ndarray) -> np.ndarray:
        """Ticks (n,) of the next step, not longer than ``longest`` (n,) [s], of environments that have done ``done`` (n,) ticks."""
        wanted = np.clip(longest / self.timestep * self.ticks * (1.0 + 1e-9), 1.0, self.ticks)
        power = 2 ** np.floor(np.log2(wanted)).astype(int)
        aligned = np.where(done == 0, self.ticks, done & -done)
        return np.minimum(power, aligned)
