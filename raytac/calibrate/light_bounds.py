"""Where LEDs of a fit may lie, and how large they may be, for a sensor to accept them."""

from __future__ import annotations

import numpy as np

from raytac.calibrate.light_parameters import (
    CEILING,
    HEIGHT,
    HEIGHTS,
    LENGTH,
    SHORTEST,
    VIRTUAL_CEILING,
    LightParameters,
)
from raytac.specs import SensorSpec
from raytac.specs.sensor_check import view_edges

GAP = 0.02
"""Distance [mm] that an LED's corners keep from the case and the gel."""


def leds_inside(sensor: SensorSpec, p: LightParameters, *, lengths: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Rows of ``p.leds`` moved to what a sensor accepts, (L, 8).

    LEDs lie in the case and below gel and plate; virtual sources up to the coat, on that side of the view where they begin. Lengths and
    heights change where ``lengths`` and ``heights`` (L,) are true, and aims and lobes as far as they may.
    """
    leds = p.leds.copy()
    leds[:, 4], leds[:, 5] = np.clip(leds[:, 4], -1.4, 1.4), np.clip(leds[:, 5], 1.0, 15.0)
    leds[:, HEIGHT] = np.where(heights, np.clip(leds[:, HEIGHT], *HEIGHTS), leds[:, HEIGHT])
    u, v = _edges(leds)
    room = 1e3 * np.array(sensor.case.size) - 2 * GAP - leds[:, HEIGHT, None] * np.abs(v[:, :2])
    longest = np.maximum((room / np.maximum(np.abs(u[:, :2]), 1e-6)).min(1), SHORTEST)
    leds[:, LENGTH] = np.where(lengths, np.clip(leds[:, LENGTH], SHORTEST, longest), leds[:, LENGTH])
    reach = GAP + 0.5 * (leds[:, LENGTH, None] * np.abs(u) + leds[:, HEIGHT, None] * np.abs(v))
    low, high = _beside_view(sensor, p)
    leds[:, :2] = np.clip(leds[:, :2], reach[:, :2] + low, np.maximum(high - reach[:, :2], reach[:, :2] + low))
    pad, ceiling = sensor.gelpad, np.full(len(leds), CEILING)
    for k in np.flatnonzero(p.virtual):
        corner = np.minimum(1e-3 * (np.abs(leds[k, :2]) + reach[k, :2]), 0.5 * np.array(pad.size))
        ceiling[k] = VIRTUAL_CEILING - 1e3 * pad.sag(*corner)
    floor = 1e3 * sensor.case.floor_z + reach[:, 2]
    leds[:, 2] = np.clip(leds[:, 2], floor, np.maximum(ceiling - reach[:, 2], floor))
    return leds


def _beside_view(sensor: SensorSpec, p: LightParameters) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest x and y [mm] of what LEDs reach, (L, 2) each."""
    half = 5e2 * np.array(sensor.case.size)
    low, high = (np.tile(sign * half, (len(p.leds), 1)) for sign in (-1, 1))
    places = np.array([led.position for led in p.template.leds])
    x_edges, y_edges = view_edges(sensor)
    for k in np.flatnonzero(p.virtual):
        x, y = places[k, :2]
        beyond = [(x_edges[0] - x, 0, high, x_edges[0]), (x - x_edges[1], 0, low, x_edges[1])]
        beyond += [(y_edges[0] - y, 1, high, y_edges[0]), (y - y_edges[1], 1, low, y_edges[1])]
        _, axis, bound, edge = max(beyond, key=lambda side: side[0])
        bound[k, axis] = 1e3 * edge
    return low, high


def _edges(leds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors of every LED's edges (``LedSpec.edges``), (L, 3) each."""
    (sin_a, cos_a), (sin_e, cos_e) = ((np.sin(leds[:, k]), np.cos(leds[:, k])) for k in (3, 4))
    u = np.stack([-sin_a, cos_a, np.zeros(len(leds))], axis=1)
    return u, np.stack([-sin_e * cos_a, -sin_e * sin_a, cos_e], axis=1)
