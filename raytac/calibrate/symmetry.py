"""What is believed of the LEDs of one side before any photograph: they are of one kind, and stand mirrored about the middle of their wall.

A press tells of the light that reaches it, so that LEDs far from all presses are known badly; these beliefs carry over from those near by.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from raytac.calibrate.light_parameters import CHANNELS, SIDES, LightParameters

__all__ = ["Ties", "side_ties"]

PLACE, AIM, LOBE, POWER = 1.0, 0.2, 1.0, 0.2
"""How far LEDs are believed to be from mirrored places [mm] and aims [rad], and from the lobe and power [full scales] next to them."""


@dataclass(frozen=True)
class Ties:
    """Beliefs about a fit's vector x: ``matrix`` x is about ``offset``, (T, n) and (T,), in standard deviations."""

    matrix: np.ndarray
    offset: np.ndarray

    def off(self, x: np.ndarray) -> np.ndarray:
        """Standard deviations by which x (n,) is off, (T,)."""
        return self.matrix @ x - self.offset


def side_ties(p: LightParameters, size: int) -> Ties:
    """Ties of LEDs that stand along walls, as ``leds_at_walls`` names and orders them; ``size`` is the vector's length, whose first
    entries are ``p.leds`` and ``p.power``."""
    rows: list[np.ndarray] = []
    offsets: list[float] = []

    def tie(sigma: float, offset: float, *terms: tuple[int, float]) -> None:
        row = np.zeros(size)
        for place, factor in terms:
            row[place] += factor / sigma
        rows.append(row)
        offsets.append(offset / sigma)

    for layer in range(len(CHANNELS)):
        own = np.flatnonzero(p.layer == layer)
        along = 1 if SIDES[CHANNELS[layer]][0] else 0  # the coordinate that changes sign: y on the walls at ±x
        for a, b in zip(own, own[::-1], strict=True):
            if a > b:
                continue
            first, second = 6 * a, 6 * b
            tie(PLACE, 0.0, (first + along, 1), (second + along, 1))
            # Mirrored, an azimuth A becomes π − A (x changes sign) or −A (y does), up to whole turns.
            turn = 0.0 if along else np.pi
            total = p.leds[a, 3] + p.leds[b, 3]
            tie(AIM, turn + 2 * np.pi * round((total - turn) / (2 * np.pi)), (first + 3, 1), (second + 3, 1))
            if a < b:
                for k in (1 - along, 2):
                    tie(PLACE, 0.0, (first + k, 1), (second + k, -1))
                tie(AIM, 0.0, (first + 4, 1), (second + 4, -1))
        for a, b in itertools.pairwise(own):
            tie(LOBE, 0.0, (6 * a + 5, 1), (6 * b + 5, -1))
            for c in range(3):
                first = p.leds.size + c
                tie(POWER, 0.0, (first + 3 * a, 1), (first + 3 * b, -1))
    return Ties(np.array(rows).reshape(len(rows), size), np.array(offsets))
