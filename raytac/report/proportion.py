"""How sure a success rate is."""

from __future__ import annotations

import math

from raytac.errors import InputError

__all__ = ["wilson_interval"]


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's score interval of a proportion (J. Am. Stat. Assoc. 22, 1927): the p with (p̂ − p)² = z² p (1 − p) / n; z = 1.96 is 95 %.

    Unlike p̂ ± z √(p̂ (1 − p̂) / n) it stays within 0 and 1 and has a width at p̂ = 0 and 1. Raises ``InputError`` without trials.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise InputError(
            "successes", value=(successes, trials), rule="must be from 0 to the number of trials, which must be at least 1"
        )
    share, square = successes / trials, z * z / trials
    middle = share + 0.5 * square
    half = math.sqrt(share * (1.0 - share) * square + 0.25 * square * square)
    return max(0.0, (middle - half) / (1.0 + square)), min(1.0, (middle + half) / (1.0 + square))
