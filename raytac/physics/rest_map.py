"""Resting surfaces that are maps of heights, in Warp; ``HeightMap`` is the same in NumPy."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from raytac.specs.sensor import GelpadSpec

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_4 = wp.constant(wp.float64(4.0))
_5 = wp.constant(wp.float64(5.0))
_HALF = wp.constant(wp.float64(0.5))
_THREE_HALVES = wp.constant(wp.float64(1.5))
_FIVE_HALVES = wp.constant(wp.float64(2.5))
_NINE_HALVES = wp.constant(wp.float64(4.5))


@wp.struct
class RestMaps:
    """Maps of all pads, one after the other; lengths [m]."""

    heights: wp.array(dtype=wp.float64)
    """``HeightMap.padded``, row by row."""
    first: wp.array(dtype=wp.int32)
    """Index in ``heights`` of a pad's first node; −1 of a pad with a dome."""
    columns: wp.array(dtype=wp.int32)
    """Nodes along x, without padding."""
    rows: wp.array(dtype=wp.int32)
    half: wp.array(dtype=wp.vec2d)
    """Half extents along x and y."""
    spacing: wp.array(dtype=wp.vec2d)


def rest_maps(gelpads: Sequence[GelpadSpec], device: wp.Device) -> Any:
    """``RestMaps`` of some pads."""
    surfaces = [gelpad.surface for gelpad in gelpads]
    sizes = np.array([0 if surface is None else surface.padded.size for surface in surfaces])
    first = np.where(sizes > 0, np.cumsum(sizes) - sizes, -1)
    shapes = np.array([(0, 0) if surface is None else surface.heights.shape for surface in surfaces])
    pairs = {"half": [(0.0, 0.0) if surface is None else surface.half for surface in surfaces]}
    pairs["spacing"] = [(1.0, 1.0) if surface is None else surface.spacing for surface in surfaces]
    maps: Any = RestMaps()
    heights = np.concatenate([np.zeros(1), *(surface.padded.ravel() for surface in surfaces if surface is not None)])
    maps.heights = wp.array(heights[1:] if len(heights) > 1 else heights, dtype=wp.float64, device=device)
    for name, values in (("first", first), ("rows", shapes[:, 0]), ("columns", shapes[:, 1])):
        setattr(maps, name, wp.array(values.astype(np.int32), dtype=wp.int32, device=device))
    for name, values in pairs.items():
        setattr(maps, name, wp.array(np.array(values), dtype=wp.vec2d, device=device))
    return maps


@wp.func
def cubic_weights(t: wp.float64) -> wp.vec4d:
    """Weights of nodes −1, 0, 1, 2 at a share ``t`` between 0 and 1."""
    return wp.vec4d(
        t * (-_HALF + t * (_1 - _HALF * t)),
        _1 + t * t * (-_FIVE_HALVES + _THREE_HALVES * t),
        t * (_HALF + t * (_2 - _THREE_HALVES * t)),
        t * t * (-_HALF + _HALF * t),
    )


@wp.func
def cubic_rises(t: wp.float64) -> wp.vec4d:
    """Derivatives of ``cubic_weights`` by ``t``."""
    return wp.vec4d(
        -_HALF + t * (_2 - _THREE_HALVES * t),
        t * (-_5 + _NINE_HALVES * t),
        _HALF + t * (_4 - _NINE_HALVES * t),
        t * (-_1 + _THREE_HALVES * t),
    )


@wp.func
def rest_on_map(maps: RestMaps, pad: wp.int32, x: wp.float64, y: wp.float64) -> wp.vec3d:
    """z [m], ∂z/∂x and ∂z/∂y of a pad's map; beyond its last nodes those at the edge."""
    half, step = maps.half[pad], maps.spacing[pad]
    u = wp.clamp((x + half[0]) / step[0], _0, wp.float64(maps.columns[pad] - 1))
    v = wp.clamp((y + half[1]) / step[1], _0, wp.float64(maps.rows[pad] - 1))
    i, j = wp.min(wp.int32(u), maps.columns[pad] - 2), wp.min(wp.int32(v), maps.rows[pad] - 2)
    wide = maps.columns[pad] + 2
    s, t = u - wp.float64(i), v - wp.float64(j)
    wx, wy, rx, ry = cubic_weights(s), cubic_weights(t), cubic_rises(s), cubic_rises(t)
    result, m = wp.vec3d(), wp.int32(0)
    while m < 4:  # a loop that is not unrolled: the compiler's time goes by the code
        k = maps.first[pad] + (j + m) * wide + i
        row = wp.vec4d(maps.heights[k], maps.heights[k + 1], maps.heights[k + 2], maps.heights[k + 3])
        across = wp.dot(wx, row)
        result += wp.vec3d(wy[m] * across, wy[m] * wp.dot(rx, row), ry[m] * across)
        m += 1
    return wp.vec3d(result[0], result[1] / step[0], result[2] / step[1])
