"""What is believed of the LEDs of one side before any photograph: they are of one kind, and stand mirrored about the middle of their wall.

A press tells of the light that reaches it, so that LEDs far from all presses are known badly; these beliefs carry over from those near by.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from raytac.calibrate.light_parameters import CHANNELS, HEIGHT, LightParameters

__all__ = ["Ties", "side_ties"]

PLACE, AIM, LOBE, TALL, POWER = 1.0, 0.2, 1.0, 0.5, 0.2
"""How far LEDs are believed to be from mirrored places [mm] and aims [rad], and from the lobe, height [mm] and power [full scales] next to
them."""

LEAST = 1.0
"""How far [mm] the middle of a layer's LEDs must be from the pad's for them to be on one side of it."""


@dataclass(frozen=True)
class Ties:
    """Beliefs about a fit's vector x: ``matrix`` x is about ``offset``, (T, n) and (T,), in standard deviations."""

    matrix: np.ndarray
    offset: np.ndarray

    def off(self, x: np.ndarray) -> np.ndarray:
        """Standard deviations by which x (n,) is off, (T,)."""
        return self.matrix @ x - self.offset


def side_ties(p: LightParameters, size: int) -> Ties:
    """Ties of the LEDs of every layer, which stand on one side of the pad: mirrored about the line from the pad's middle to theirs.

    An LED is tied to that which lies nearest to its mirror image at the start, if that holds of both. ``size`` is the vector's length,
    whose first entries are ``p.leds`` and ``p.power``.
    """
    rows: list[np.ndarray] = []
    offsets: list[float] = []
    wide = p.leds.shape[1]

    def tie(sigma: float, offset: float, *terms: tuple[int, float]) -> None:
        row = np.zeros(size)
        for place, factor in terms:
            row[place] += factor / sigma
        rows.append(row)
        offsets.append(offset / sigma)

    for layer in range(len(CHANNELS)):
        own = [int(led) for led in np.flatnonzero(p.layer == layer)]
        if not own:
            continue
        middle = p.leds[own, :2].mean(0)
        if np.hypot(*middle) > LEAST:
            out = middle / np.hypot(*middle)
            across = np.array([-out[1], out[0]])
            mirrored = p.leds[own, :2] - 2 * np.outer(p.leds[own, :2] @ across, across)
            nearest = np.argmin(np.linalg.norm(mirrored[:, None] - p.leds[own, :2], axis=2), axis=1)
            for k in np.flatnonzero(nearest[nearest] == np.arange(len(own))):
                a, b = own[k], own[nearest[k]]
                if a > b:
                    continue
                tie(PLACE, 0.0, *((wide * led + axis, float(across[axis])) for led in (a, b) for axis in (0, 1)))
                # Mirrored, an azimuth A becomes 2 φ − A with φ that of ``out``, up to whole turns.
                turn, total = 2 * float(np.arctan2(out[1], out[0])), float(p.leds[a, 3] + p.leds[b, 3])
                tie(AIM, turn + 2 * np.pi * round((total - turn) / (2 * np.pi)), (wide * a + 3, 1), (wide * b + 3, 1))
                if a < b:
                    tie(
                        PLACE,
                        0.0,
                        *((wide * led + axis, float(sign * out[axis])) for led, sign in ((a, 1), (b, -1)) for axis in (0, 1)),
                    )
                    tie(PLACE, 0.0, (wide * a + 2, 1), (wide * b + 2, -1))
                    tie(AIM, 0.0, (wide * a + 4, 1), (wide * b + 4, -1))
        for a, b in itertools.pairwise(own):
            tie(LOBE, 0.0, (wide * a + 5, 1), (wide * b + 5, -1))
            tie(TALL, 0.0, (wide * a + HEIGHT, 1), (wide * b + HEIGHT, -1))
            for c in range(3):
                first = p.leds.size + c
                tie(POWER, 0.0, (first + 3 * a, 1), (first + 3 * b, -1))
    return Ties(np.array(rows).reshape(len(rows), size), np.array(offsets))
