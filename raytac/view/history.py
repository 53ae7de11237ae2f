"""``History``: the last states of a session, to look back at, to plot and to save."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from raytac.view.session import PadView, Snapshot

MOST_BYTES = 400_000_000
"""Memory of all states that are kept; the oldest go first."""
MOST_STATES = 2000
"""Of the timeline: a slider cannot show more."""


class History:
    """States in the order in which they were shown, as many as the memory allows."""

    def __init__(self, most_bytes: int = MOST_BYTES, most_states: int = MOST_STATES) -> None:
        """Begin empty; the limits are in bytes and in states."""
        self._most_bytes, self._most_states = most_bytes, most_states
        self.clear()

    def clear(self) -> None:
        """Forget all states."""
        self._states: deque[tuple[int, Snapshot, int]] = deque()
        self._bytes, self.dropped = 0, 0

    def __len__(self) -> int:
        return len(self._states)

    def __getitem__(self, place: int) -> Snapshot:
        return self._states[place][1]

    def __iter__(self) -> Any:
        return iter([snapshot for _, snapshot, _ in self._states])

    def add(self, number: int, snapshot: Snapshot) -> None:
        """Append a state; one with the number of the last replaces it."""
        if self._states and self._states[-1][0] == number:
            self._bytes -= self._states.pop()[2]
        size = _bytes(snapshot)
        self._states.append((number, snapshot, size))
        self._bytes += size
        while len(self._states) > 1 and (self._bytes > self._most_bytes or len(self._states) > self._most_states):
            self._bytes -= self._states.popleft()[2]
            self.dropped += 1

    @property
    def x(self) -> np.ndarray:
        """Simulated time [s] of every state (n,), or its number where there is no time."""
        times = [snapshot.time for _, snapshot, _ in self._states]
        if any(time is None for time in times):
            return np.array([number for number, _, _ in self._states], float)
        return np.array(times, float)

    @property
    def x_label(self) -> str:
        """Name of ``x``, with its unit."""
        return "state" if not self._states or self._states[-1][1].time is None else "time [s]"

    def forces(self, pad: str) -> np.ndarray:
        """Force on a pad [N] of every state, pad frame, (3, n); NaN where it is not known."""
        return np.array([_force(view) for view in self._views(pad)]).reshape(-1, 3).T

    def displacements(self, pad: str) -> np.ndarray:
        """Mean and greatest displacement of the markers of a pad [px], (2, n); NaN without."""
        return np.array([_displacement(view) for view in self._views(pad)]).reshape(-1, 2).T

    def _views(self, pad: str) -> Sequence[PadView | None]:
        return [snapshot.pads.get(pad) for _, snapshot, _ in self._states]


def _force(view: PadView | None) -> np.ndarray:
    return np.full(3, np.nan) if view is None or view.wrench is None else np.asarray(view.wrench[:3], float)


def _displacement(view: PadView | None) -> tuple[float, float]:
    if view is None or view.markers_px is None:
        return np.nan, np.nan
    length = np.linalg.norm(view.markers_px[1], axis=1)
    seen = length[np.isfinite(length)]
    return (float(seen.mean()), float(seen.max())) if len(seen) else (np.nan, np.nan)


def _bytes(value: Any) -> int:
    """Memory of the arrays in nested records."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, dict):
        return sum(_bytes(item) for item in value.values())
    if isinstance(value, tuple):
        return sum(_bytes(item) for item in value)
    if is_dataclass(value):
        return sum(_bytes(getattr(value, field.name)) for field in fields(value))
    return 0
