"""What a sampled integrator must pay to reach a given error: interpolation between measured points, the Monte Carlo law beyond."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

__all__ = ["cost_at", "spp_for_error"]


def spp_for_error(spp: Sequence[int], errors: Sequence[float], target: float) -> float:
    """Samples a pixel at which path tracing has the error ``target``, at least the first of ``spp``.

    Between the measured points log error is linear in log spp; beyond the last, error falls as spp^−1/2.
    """
    if target < errors[-1]:
        return float(spp[-1] * (errors[-1] / target) ** 2)
    falling = np.maximum.accumulate(-np.log(errors))
    return float(np.exp(np.interp(-np.log(target), falling, np.log(spp))))


def cost_at(spp: Sequence[int], ms: Sequence[float], wanted: float) -> float:
    """Time [ms] at ``wanted`` samples: linear between the measured points, proportional beyond the last."""
    return float(ms[-1] * wanted / spp[-1]) if wanted > spp[-1] else float(np.interp(wanted, spp, ms))
