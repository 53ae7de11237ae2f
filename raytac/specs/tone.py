"""Tone curve of a camera: what it does to levels after gamma.

Cameras brighten or darken their middle tones, so that one exponent does not describe their levels. With u = x^(1/γ), the level over 255
that gamma alone gives linear light x, the level is 255 S(u),

    S(u) = u + u (1 − u) Σ t_k P_k(2u − 1),

P_k: Legendre's polynomials. Black stays black and white white. Curves that do not rise are refused. All functions take floats, NumPy or
Dr.Jit arrays.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.polynomial import Legendre, Polynomial

LEAST_SLOPE = 0.1
"""Least slope of a tone curve: one that falls gives two lights the same level."""
MOST_COEFFICIENTS = 6
"""Of a sensor file.

Powers of u lose digits: in single precision curves of many more are wrong by whole levels."""
_HALVINGS, _NEWTON = 8, 4
"""Steps of the inverse: halvings of an interval, then Newton's."""


@dataclass(frozen=True)
class ToneCurve:
    """S by its coefficients t_k; none is a straight line."""

    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", tuple(map(float, self.coefficients)))

    @property
    def is_plain(self) -> bool:
        """True if it changes nothing."""
        return not any(self.coefficients)

    @cached_property
    def _powers(self) -> tuple[list[float], list[float]]:
        """Coefficients of S and of its slope by powers of u, the highest first."""
        bends = _bends(len(self.coefficients))
        curve = np.array(self.coefficients) @ bends
        curve[-2] += 1.0  # the straight line u
        return curve.tolist(), (curve[:-1] * np.arange(len(curve) - 1, 0, -1)).tolist()

    @property
    def least_slope(self) -> float:
        """Least slope between 0 and 1."""
        return float(np.min(_horner(self._powers[1], np.linspace(0, 1, 1001))))

    def bent(self, u: Any) -> Any:
        """S(u) for u in [0, 1]."""
        return u if self.is_plain else _horner(self._powers[0], u)

    def straight(self, level: Any) -> Any:
        """The u of [0, 1] whose S(u) is ``level``, in [0, 1]."""
        if self.is_plain:
            return level
        u, step = 0.5 + 0 * level, 0.25
        for _ in range(_HALVINGS):
            off = level - _horner(self._powers[0], u)
            u, step = u + step * off / (abs(off) + 1e-30), 0.5 * step
        for _ in range(_NEWTON):
            u = u + (level - _horner(self._powers[0], u)) / _horner(self._powers[1], u)
            u = 0.5 * (abs(u) - abs(u - 1) + 1)  # cut to [0, 1]
        return u

    def extended(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """S and its slope for any u: beyond black and white it goes on straight."""
        inside = np.clip(u, 0, 1)
        slope = _horner(self._powers[1], inside)
        return _horner(self._powers[0], inside) + slope * (u - inside), slope + 0 * u

    def extended_straight(self, level: np.ndarray) -> np.ndarray:
        """The u whose extended S(u) is ``level``."""
        inside = np.clip(level, 0, 1)
        u = self.straight(inside)
        return u + (level - inside) / _horner(self._powers[1], u)


@cache
def _bends(count: int) -> np.ndarray:
    """Coefficients of u (1 − u) P_k(2u − 1), k < ``count``, the highest power first."""
    u = Polynomial([0.0, 1.0])
    bends = np.zeros((count, count + 2))
    for k in range(count):
        coefficients = (u * (1 - u) * Legendre.basis(k).convert(kind=Polynomial)(2 * u - 1)).coef
        bends[k, : len(coefficients)] = coefficients
    return np.ascontiguousarray(bends[:, ::-1])


def _horner(coefficients: list[float], u: Any) -> Any:
    value: Any = coefficients[0]
    for c in coefficients[1:]:
        value = value * u + c
    return value


STRAIGHT = ToneCurve()
"""No curve: S(u) = u."""
