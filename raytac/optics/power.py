"""Powers of positive numbers on the device."""

from __future__ import annotations

from typing import Any

import drjit as dr

_LOG2 = (
    1.4426950216,
    -0.7213473320,
    0.4809106290,
    -0.3607036769,
    0.2879162431,
    -0.2389449477,
    0.2157158405,
    -0.2072689384,
    0.1258353740,
)
"""Coefficients of log₂(1 + t) / t for t from √½ − 1 to √2 − 1; relative error 3e-8."""
_EXP2 = 1.0, 0.6931471825, 0.2402264625, 0.0555032864, 0.0096184891, 0.0013399931, 0.0001534581
"""The same of 2ᶠ for f from −½ to ½; 2e-9."""
_ROOT_HALF = 0x3F3504F3
"""Bits of √½ as float32."""


def power(x: Any, exponent: Any) -> Any:
    """xⁿ of a Dr.Jit Float in [0, 1] for n > 0, to the rounding of float32.

    What is below 2⁻¹²⁶ may be 2⁻¹²⁶. On the CPU it takes fewer operations than ``dr.power``, which knows every number. On CUDA that
    is two instructions.
    """
    if dr.backend_v(x) != dr.JitBackend.LLVM:
        return dr.power(x, exponent)
    whole: Any = dr.int32_array_t(type(x))
    real: Any = type(x)
    bits: Any = dr.reinterpret_array(whole, x)
    bits = bits - _ROOT_HALF
    twos = bits >> 23  # x = 2^twos (1 + t)
    t: Any = dr.reinterpret_array(real, bits - (twos << 23) + _ROOT_HALF)
    t = t - 1
    y = exponent * dr.fma(t, _polynomial(_LOG2, t), real(twos))
    y = dr.select(y > -126, y, -126)
    nearest = dr.round(y)
    return _polynomial(_EXP2, y - nearest) * dr.reinterpret_array(real, (whole(nearest) + 127) << 23)


def _polynomial(coefficients: tuple[float, ...], x: Any) -> Any:
    """Value by Horner's rule; the constant is first."""
    value: Any = coefficients[-1]
    for one in coefficients[-2::-1]:
        value = dr.fma(value, x, one)
    return value
