"""The contact barrier, its derivatives, and the mollifier of edge-edge pairs.

With D the squared distance, D̂ = d̂² and an area A, a pair stores the energy A κ d̂ b(D)/D̂², where

    b(D) = −(D − D̂)² ln(D / D̂) for D < D̂, else 0            (Li et al. 2020, eq. 6, of squared distances),

so that κ is a pressure [Pa] (Li et al. 2023, "Convergent Incremental Potential Contact", section 5).
"""

# pyright: reportReturnType=false

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def barrier(D: wp.float64, Dh: wp.float64) -> wp.float64:
    """b(D) [m⁴]."""
    if Dh <= D:
        return wp.float64(0.0)
    q = D - Dh
    return -q * q * wp.log(D / Dh)


@wp.func
def barrier_first(D: wp.float64, Dh: wp.float64) -> wp.float64:
    """b'(D) [m²]."""
    if Dh <= D:
        return wp.float64(0.0)
    q = D - Dh
    return -q * (wp.float64(2.0) * wp.log(D / Dh) + q / D)


@wp.func
def barrier_second(D: wp.float64, Dh: wp.float64) -> wp.float64:
    """b''(D) [-]."""
    if Dh <= D:
        return wp.float64(0.0)
    q = (D - Dh) / D
    return -wp.float64(2.0) * wp.log(D / Dh) - wp.float64(4.0) * q + q * q


@wp.func
def mollifier(c: wp.float64, eps: wp.float64) -> wp.float64:
    """m(c) of c = ‖(a1 − a0) × (b1 − b0)‖², 1 from c = eps on (Li et al. 2020, eq. 24)."""
    if c >= eps:
        return wp.float64(1.0)
    q = c / eps
    return (wp.float64(2.0) - q) * q


@wp.func
def mollifier_first(c: wp.float64, eps: wp.float64) -> wp.float64:
    """m'(c) [1/m⁴]."""
    if c >= eps:
        return wp.float64(0.0)
    return wp.float64(2.0) * (wp.float64(1.0) - c / eps) / eps


@wp.func
def mollifier_second(c: wp.float64, eps: wp.float64) -> wp.float64:
    """m''(c) [1/m⁸]."""
    if c >= eps:
        return wp.float64(0.0)
    return -wp.float64(2.0) / (eps * eps)
