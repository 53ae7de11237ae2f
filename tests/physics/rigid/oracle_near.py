"""Coarse search: bodies that may come near a pad's box, by bounding balls and half-spaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from raytac.shapes.part import Part
from raytac.specs.sensor import GelpadSpec


def half_spaces(bodies: Sequence[Sequence[Part]]) -> tuple[np.ndarray, np.ndarray]:
    """Indices (n,) of the bodies that are half-spaces, and these' poses (n, 4, 4) in their bodies' frames."""
    some = [i for i, parts in enumerate(bodies) if any(part.kind == "plane" for part in parts)]
    return np.array(some, int), np.array([bodies[i][0].object_from_part for i in some]).reshape(-1, 4, 4)


def near_pad(
    gelpad: GelpadSpec,
    radius: np.ndarray,
    planes: tuple[np.ndarray, np.ndarray],
    poses: np.ndarray,
    reach: np.ndarray | float = 0.0,
) -> np.ndarray:
    """True (n, bodies) where bodies at poses (n, bodies, 4, 4) may come within ``reach`` [m], a number or (n,), of the pad's box.

    ``radius`` (bodies,) [m] of balls about the bodies' origins; ``planes``: see ``half_spaces``.
    """
    half, reach = 0.5 * np.asarray(gelpad.size), np.reshape(reach, (-1, 1))
    at = poses[..., :3, 3]
    near = (at[..., 2] - radius < reach) & (np.abs(at[..., :2]) - (radius + reach)[..., None] < half).all(axis=-1)
    if len(planes[0]):
        # A plane reaches the pad's box where its lowest corner along the plane's normal lies below it.
        placed = poses[:, planes[0]] @ planes[1]
        normal, at = placed[..., :3, 2], placed[..., :3, 3]
        lowest = -np.abs(normal[..., :2]) @ half - np.maximum(-normal[..., 2], 0.0) * gelpad.thickness
        near[:, planes[0]] = lowest < np.vecdot(normal, at) + reach
    return near
