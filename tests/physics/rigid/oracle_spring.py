"""Normal contact as an implicit spring in NumPy: oracle of ``spring_kernels``, which has the physics."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from raytac.physics.rigid.contacts import LoadTables

_HALVINGS = 12
"""Bisections for the speed at the end of a step: its upper bound is taken, off by a 4000th of the speed at the start."""


@dataclass(frozen=True)
class NormalSpring:
    """Normal forces f = force + damping · w of n contacts in one step, w the speed [m/s] at its end at which they close."""

    force: np.ndarray
    """[N], (n,); negative of a gap that closes within the step."""
    damping: np.ndarray
    """C [N s/m], (n,); 0 where no contact is possible in this step."""
    deepest: np.ndarray
    """Depth [m] to which a free pair of bodies would close in the step, (n,)."""


def contact_rate(stiffness: np.ndarray, inverse_mass: np.ndarray) -> np.ndarray:
    """Angular frequency [1/s] of two bodies on the spring between them; ``inverse_mass`` [1/kg] is the sum of both."""
    return np.sqrt(stiffness * inverse_mass)


def normal_spring(
    law: LoadTables,
    depth: np.ndarray,
    speed: np.ndarray,
    inverse_mass: np.ndarray,
    step: np.ndarray,
    relaxation: np.ndarray,
    push: np.ndarray,
) -> NormalSpring:
    """Spring of one step of n contacts.

    Args:
        law: load laws.
        depth: δ [m]; negative is a gap.
        speed: speed [m/s] at which contacts close at the start of the step.
        inverse_mass: 1/m of both bodies [1/kg].
        step: Δt [s].
        relaxation: τ [s] of the gel.
        push: acceleration [m/s²] that may close it faster, but for its own force.
    """
    gap = depth <= 0.0
    start, slope = law.force(depth)
    end, slow = (_reached(law, depth, quick, start, inverse_mass, step, relaxation) for quick in (speed + push * step, speed))
    deepest = np.where(gap, end, np.where(push > 0.0, np.where(step * speed > 1e-7, slow, depth), end))
    force, stiffness = law.force(np.maximum(end, 0.0))
    secant = force / np.where(end > 0.0, end, 1.0)
    stiffness = np.maximum(stiffness, slope)
    touching = stiffness * _time(stiffness, inverse_mass, step, relaxation)
    closing = np.where(end > 0.0, secant * step, 0.0)
    return NormalSpring(np.where(gap, secant * depth, start), np.where(gap, closing, touching), deepest)


def _reached(
    law: LoadTables,
    depth: np.ndarray,
    quickest: np.ndarray,
    start: np.ndarray,
    inverse_mass: np.ndarray,
    step: np.ndarray,
    relaxation: np.ndarray,
) -> np.ndarray:
    """Depths (n,) [m] at the end of the step of contacts that close at speeds ``quickest`` (n,) but for their own force."""
    end = depth + step * np.maximum(quickest, 0.0)
    some = np.flatnonzero(end > np.maximum(depth, 0.0) + 1e-7)
    if len(some):
        end[some] = _end(
            law_of(law, some), depth[some], quickest[some], start[some], inverse_mass[some], step[some], relaxation[some]
        )
    return end


def _end(
    law: LoadTables,
    depth: np.ndarray,
    quickest: np.ndarray,
    start: np.ndarray,
    inverse_mass: np.ndarray,
    step: np.ndarray,
    relaxation: np.ndarray,
) -> np.ndarray:
    """Depths (n,) [m] to which free bodies close in the step: m (v − w) / Δt = f(w) by bisection, f rising in w."""
    gap, low, high = depth <= 0.0, np.zeros_like(depth), np.maximum(quickest - step * inverse_mass * start, 0.0)
    slow, most = step * high <= 1e-7, high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        force, stiffness = law.force(depth + step * middle)
        force = np.where(gap, force, start + stiffness * _time(stiffness, inverse_mass, step, relaxation) * middle)
        above = (quickest - middle) < step * inverse_mass * force
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return depth + step * np.where(slow, most, high)


def _time(stiffness: np.ndarray, inverse_mass: np.ndarray, step: np.ndarray, relaxation: np.ndarray) -> np.ndarray:
    """c [s]: the relaxation time, at least between Δt/2 of slow contacts and Δt of those whose own motion a step does not resolve."""
    squared = stiffness * inverse_mass * step * step
    return np.maximum(relaxation, step * (0.5 + 0.5 * squared / (1.0 + squared)))


def law_of(law: LoadTables, rows: np.ndarray) -> LoadTables:
    """The laws of some contacts, by their indices."""
    some = copy(law)
    for name, values in vars(law).items():
        setattr(some, name, values[rows])
    some._rows = np.arange(len(rows))
    return some
