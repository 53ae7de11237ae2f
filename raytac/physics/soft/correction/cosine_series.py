"""Cosine series on evenly spaced nodes."""

from __future__ import annotations

import numpy as np


class CosineSeries:
    """Cosine series through values at evenly spaced nodes, with zero slope at both edges."""

    def __init__(self, nodes: np.ndarray) -> None:
        """``nodes`` [m], shape (n,), evenly spaced from one edge to the other."""
        n = len(nodes)
        self._start, self._length = float(nodes[0]), float(nodes[-1] - nodes[0])
        self.wave_numbers = np.pi * np.arange(n) / self._length
        """[rad/m], shape (n,)."""
        half = np.ones(n)
        half[[0, -1]] = 0.5
        order = np.arange(n)
        self.analysis = 2.0 * half[:, None] * half * np.cos(np.pi * np.outer(order, order) / (n - 1)) / (n - 1)
        """Matrix from values at the nodes to amplitudes, shape (n, n)."""
        self.sine_analysis = 2.0 * np.sin(np.pi * np.outer(order, order) / (n - 1)) / (n - 1)
        """The same for sines, which are 0 at the ends, shape (n, n)."""

    def hats(self, order: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Wave numbers [rad/m] of orders (m,), 1 for half a wave, and amplitudes of hat functions.

        The hats are those of the nodes; the amplitudes (m,) are over those of the cosines through the same values.
        """
        return np.pi * order / self._length, np.sinc(0.5 * order / (len(self.wave_numbers) - 1)) ** 2

    def synthesis(self, t: np.ndarray) -> np.ndarray:
        """Matrix from amplitudes to values at ``t`` [m], shape (P, n)."""
        return np.cos(np.outer(np.asarray(t) - self._start, self.wave_numbers))

    def sines(self, t: np.ndarray) -> np.ndarray:
        """Sines of the same wave numbers at ``t`` [m], shape (P, n)."""
        return np.sin(np.outer(np.asarray(t) - self._start, self.wave_numbers))
