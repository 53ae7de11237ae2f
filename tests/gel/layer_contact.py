"""Contact without friction of rigid objects with a linear elastic layer bonded at its back: the surround's independent solution.

The layer's displacement under a pressure is a product in the Fourier domain, w = A p (``layer_compliance`` of the oracles of ``ipc``);
the pressure is that of the complementarity problem p >= 0, w >= u, p (w − u) = 0, by conjugate gradients on the nodes that press
(I. Polonsky and L. Keer, Wear 231, 1999, 206, here at a given depth).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.fft import irfft2, rfft2

from tests.ipc.oracles.closed_forms import layer_compliance

Overlap = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""u(x, y) [m]: overlap of an object and the flat gel at rest, well below 0 where it is not."""
ABSENT = -1.5e-3
"""Overlap where there is no object [m]."""


def ball(radius: float, depth: float) -> Overlap:
    def overlap(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        square = radius**2 - x**2 - y**2
        return np.where(square > 0, depth - radius + np.sqrt(np.maximum(square, 0.0)), ABSENT)

    return overlap


def cylinder(radius: float, half_length: float, depth: float) -> Overlap:
    """A lying cylinder along y with flat ends."""

    def overlap(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        square = radius**2 - x**2
        return np.where((square > 0) & (np.abs(y) < half_length), depth - radius + np.sqrt(np.maximum(square, 0.0)), ABSENT)

    return overlap


def cone(slope: float, depth: float) -> Overlap:
    return lambda x, y: np.maximum(depth - slope * np.hypot(x, y), ABSENT)


def punch(radius: float, depth: float) -> Overlap:
    return lambda x, y: np.where(np.hypot(x, y) < radius, depth, ABSENT)


@dataclass(frozen=True)
class Layer:
    """Square part of an infinite layer, continued periodically; E* = 1, lengths [m]."""

    nodes: int
    side: float
    thickness: float = 4e-3
    poisson: float = 0.48

    @property
    def pitch(self) -> float:
        return self.side / self.nodes

    @cached_property
    def lines(self) -> np.ndarray:
        """Coordinates of the nodes along x and along y, 0 among them, (n,)."""
        return (np.arange(self.nodes) - self.nodes // 2) * self.pitch

    @cached_property
    def wave_numbers(self) -> np.ndarray:
        """|k| [rad/m] of a real transform, (n, n/2 + 1)."""
        along = 2 * np.pi * np.fft.fftfreq(self.nodes, self.pitch)
        return np.hypot(along[:, None], 2 * np.pi * np.fft.rfftfreq(self.nodes, self.pitch))

    @cached_property
    def compliance(self) -> np.ndarray:
        """2 L(k h) / k [m], the uniform compression's at k = 0."""
        k = np.maximum(self.wave_numbers, 1e-3 / self.thickness)
        return 2 * layer_compliance(self.poisson, k * self.thickness) / k

    def filtered(self, gain: np.ndarray, field: np.ndarray) -> np.ndarray:
        """Fields (..., n, n) with every wave multiplied by its gain (n, n/2 + 1)."""
        return np.asarray(irfft2(gain * np.asarray(rfft2(field)), s=field.shape[-2:]))

    def overlap(self, of: Overlap) -> np.ndarray:
        """Overlap at the nodes, (n, n)."""
        return of(self.lines[None, :], self.lines[:, None])

    def press(self, u: np.ndarray, tolerance: float = 1e-5) -> tuple[np.ndarray, np.ndarray]:
        """Pressure over E* and displacement w [m] under the overlap ``u`` (n, n) [m].

        ``tolerance``: gap under pressure, over the deepest overlap.
        """
        p = np.where(u > 0, 1.0, 0.0)
        p *= (p * u).sum() / (p * self.filtered(self.compliance, p)).sum()
        direction, before, keeps = np.zeros_like(u), 1.0, 0.0
        for _ in range(400):
            gap = self.filtered(self.compliance, p) - u
            on = p > 0
            square = float((gap[on] ** 2).sum())
            direction = np.where(on, gap + keeps * square / before * direction, 0.0)
            before = square
            response = self.filtered(self.compliance, direction)
            step = (gap * direction)[on].sum() / (response * direction)[on].sum()
            p = np.maximum(p - step * direction, 0.0)
            opens = (p == 0) & (gap < 0)
            p[opens] -= step * gap[opens]
            keeps = float(not opens.any())
            if keeps and np.abs(gap[p > 0]).max() < tolerance * u.max():
                return p, self.filtered(self.compliance, p)
        raise AssertionError("the contact of the layer has not converged")


def slope_error(surface: np.ndarray, reference: np.ndarray, pitch: float, near: np.ndarray | None = None) -> float:
    """RMS difference of slopes over the reference's RMS slope, of the nodes ``near`` (None: all)."""
    ours, true = (np.array(np.gradient(np.asarray(w, float), pitch)) for w in (surface, reference))
    near = np.ones(surface.shape, bool) if near is None else near
    return float(np.sqrt(((ours - true) ** 2).sum(0)[near].mean() / (true**2).sum(0)[near].mean()))
