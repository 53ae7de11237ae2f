"""Time of a frame: warm calls over surfaces that change, as in a control loop."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from raytac.gel.surface import GelSurface

__all__ = ["moving", "once", "timed", "timed_within"]


def moving(surfaces: Sequence[GelSurface], batch: int, count: int) -> list[GelSurface]:
    """``count`` batches that take turns among ``surfaces`` (B = 1, one grid), each environment at 70 to 100 % of the indentation.

    No two frames are alike, so that nothing is measured that a cache of the last frame would save.
    """
    batches = []
    for k in range(count):
        picks = [surfaces[(k * batch + b) % len(surfaces)] for b in range(batch)]
        share = 0.7 + 0.3 * (0.618034 * (k * batch + np.arange(batch, dtype=np.float32)) % 1)
        rest = picks[0].grid.rest.astype(np.float32)
        height = rest + share[:, None, None].astype(np.float32) * (np.concatenate([s.height for s in picks]) - rest)
        contact, centre = (np.concatenate([getattr(s, a) for s in picks]) for a in ("contact", "contact_centre"))
        batches.append(GelSurface(picks[0].grid, height, contact, centre))
    return batches


def once(call: Callable[[Any], object], value: Any) -> float:
    """Milliseconds of one call, which must return only when its work is done."""
    start = time.perf_counter()
    call(value)
    return 1e3 * (time.perf_counter() - start)


def timed(call: Callable[[Any], object], inputs: Sequence[Any], frames: int) -> np.ndarray:
    """Milliseconds of ``frames`` warm calls with ``inputs`` in turn; each input is called once before, to warm up."""
    for value in inputs:
        call(value)
    return np.array([once(call, inputs[k % len(inputs)]) for k in range(frames)])


def timed_within(call: Callable[[Any], object], inputs: Sequence[Any], frames: int, budget_s: float) -> np.ndarray:
    """As ``timed``, with fewer calls (at least three) where ``frames`` of them would take longer than ``budget_s`` seconds.

    A slow call is warmed up once only, by the first input.
    """
    call(inputs[0])
    first = once(call, inputs[1 % len(inputs)])
    if frames * first <= 1e3 * budget_s:
        return timed(call, inputs, frames)
    count = min(frames, max(3, int(1e3 * budget_s / first)))
    return np.array([first, *(once(call, inputs[k % len(inputs)]) for k in range(2, count + 1))])
