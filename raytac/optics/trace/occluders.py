"""Bounds on the parts of the coat that can stand between a block of the pad and an LED.

They spare most shadow rays their walk.

A place p of a block with at least the depth D₀ below the gel at rest sends a ray towards an LED. After s its clearance from the resting
surface is at least D₀ + g s, where g is the least slope of such a ray (``Depths.visibility``). So a block whose deepest point is less deep
than that cannot stand in its way, and neither can one outside of the wedge between p and the two ends of the LED. ``Occluders.spans``
says for each block and LED at which distances such blocks lie; where there are none, all places of the block see all of the LED.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from raytac.optics.geometry import CoatLayout, PixelSample
from raytac.optics.refraction import Slab
from raytac.optics.trace.direct import arrival
from raytac.optics.trace.led import Lamp
from raytac.optics.trace.shadow_ray import Depths, DepthTiling

_LOW = 1.0e-3
"""Indentation [m] at which slopes are taken too; deeper places count as if they were there."""
_SURE = 0.05
"""Share of a slope, or of a distance, by which it may differ between the samples of a block."""
_SLACK = 1.25
"""Largest half angle of a piece of an LED over that of the samples of a block."""
_NEAR = 1e-5
"""Least distance of an LED that counts [m]."""
_FAR = 1e3
"""Distance of a blocker that does not exist [m]."""


@dataclass(frozen=True)
class Occluders:
    """Slopes of rays from all blocks to all LEDs."""

    tiling: DepthTiling
    slopes: list[Any]
    """(slope from the gel at rest, its fall by indentation [1/m], largest distance [m], 0).

    Of blocks, an array an LED; the distance is that of the LED."""

    @classmethod
    def build(
        cls,
        mi: Any,
        tiling: DepthTiling,
        rest: np.ndarray,
        lamps: Sequence[Lamp],
        counts: Sequence[int],
        parts: int,
        slab: Slab | None,
    ) -> Occluders:
        """Bounds for rays to ``counts`` × ``parts`` places on the longer edge of each of ``lamps``.

        ``rest``: heights [m] of the concave cover of the gel at rest, (Ny, Nx).
        """
        x, y, z = _places(tiling, rest)
        slopes, (width, height) = [], tiling.block_edges
        spacing = float(np.hypot(width / 2 + tiling.margin, height / 2 + tiling.margin))
        for lamp, count in zip(lamps, counts, strict=True):
            least, reach, nearest = np.full((2, *x.shape), np.inf), np.zeros(x.shape), np.full(x.shape, np.inf)
            seen = [_seen(mi, x, y, z - depth) for depth in (0.0, _LOW)]
            for k in range(count * parts):
                lights = []
                for here in seen:
                    u, density = lamp.sight(mi, here.p).at((k + 0.5) / (count * parts))
                    lights.append((arrival(mi, here, lamp, lamp.point(u, 0), slab), density / (count * parts)))
                half = np.max([np.resize(np.array(light.tangent(lamp, share)), x.shape) for light, share in lights], axis=0)
                for n, (light, _) in enumerate(lights):
                    to_x, to_y, to_z = (np.resize(np.array(v, float), x.shape) for v in light.target)
                    distance = np.maximum(np.hypot(to_x - x, to_y - y), _NEAR)
                    slope = (_nearest(tiling.layout, rest, to_x, to_y) - to_z - n * _LOW) / distance
                    least[n] = np.minimum(least[n], slope - _SURE * np.abs(slope) - _SLACK * half)
                    reach, nearest = np.maximum(reach, distance), np.minimum(nearest, distance)
            least[:, nearest.min(axis=1) < spacing] = -_FAR  # right under the LED samples are too few
            flat, deep = least.min(axis=2)
            # Of each ray it falls in proportion to depth. So the least of all is concave: above its chord.
            bounds = [flat, (flat - deep) / _LOW, (1 + _SURE) * reach.max(axis=1), 0 * flat]
            slopes.append(mi.Float(np.stack(bounds, axis=-1).astype(np.float32).ravel()))
        return cls(tiling, slopes)

    def spans(self, mi: Any, depths: Depths, lamps: Sequence[Lamp]) -> list[Any]:
        """(least distance, largest distance, deepest point, 0) [m] of all that may block rays.

        A packet for each block, B·blocks, an array for each of ``lamps``. The least distance exceeds the largest where nothing does.
        """
        t, g = self.tiling, self.tiling.layout
        columns, rows, (width, height) = *t.blocks, t.block_edges
        i = dr.arange(mi.UInt32, dr.width(depths.blocks) // 2)
        block, env = i % (columns * rows), i // (columns * rows)
        ix, iy = mi.Int32(block % columns), mi.Int32(block // columns)
        x, y = g.x0 + (mi.Float(ix) + 0.5) * width, g.y0 + (mi.Float(iy) + 0.5) * height
        shallow = dr.minimum(dr.gather(mi.Vector2f, depths.blocks, i).y, _LOW)
        deepest = dr.gather(mi.Float, depths.deepest, env)
        own = float(np.hypot(width / 2 + t.margin, height / 2 + t.margin))
        both = own + float(np.hypot(width, height)) / 2
        # Displacements between places of two blocks fill a rectangle with these half edges about that of their centres.
        half_x, half_y = width + t.margin, height + t.margin
        result = []
        for lamp, slopes in zip(lamps, self.slopes, strict=True):
            bound = dr.gather(mi.Vector4f, slopes, block)
            gain = bound.x - dr.maximum(shallow, 0) * bound.y
            wedge = Wedge.of(mi, lamp, x, y, own)
            # What is farther away is not deep enough, or beyond the LED.
            most = dr.minimum(dr.select(gain > 0, (deepest - shallow) / gain, _FAR), bound.z)
            x0, x1, y0, y1 = (mi.Int32(n) for n in wedge.box(most, both, width, height, columns, rows))
            y1 = dr.select(deepest > shallow, y1, y0 - 1)

            def look(ox: Any, oy: Any, first: Any, last: Any, deep: Any) -> tuple[Any, ...]:
                jx, jy = ix + ox, iy + oy
                is_block = (jx >= 0) & (jx < columns) & (jy >= 0) & (jy < rows)
                j = mi.UInt32((mi.Int32(env) * rows + jy) * columns + jx)
                depth = dr.gather(mi.Vector2f, depths.blocks, j, is_block).x
                dx, dy = mi.Float(ox) * width, mi.Float(oy) * height
                from_x, from_y = dr.maximum(dr.abs(dx) - half_x, 0), dr.maximum(dr.abs(dy) - half_y, 0)
                to_x, to_y = dr.abs(dx) + half_x, dr.abs(dy) + half_y
                near = dr.maximum(dr.sqrt(from_x * from_x + from_y * from_y), min(g.dx, g.dy))
                far = dr.sqrt(to_x * to_x + to_y * to_y)
                clearance = shallow + dr.minimum(gain * near, gain * far)  # noqa: B023
                blocks = is_block & wedge.has(dx, dy, half_x, half_y) & (depth > clearance)  # noqa: B023
                first = dr.select(blocks, dr.minimum(first, near), first)
                last, deep = (dr.select(blocks, dr.maximum(old, new), old) for old, new in ((last, far), (deep, depth)))
                ends = ox >= x1  # noqa: B023
                return dr.select(ends, x0, ox + 1), dr.select(ends, oy + 1, oy), first, last, deep  # noqa: B023

            start = (x0, y0, mi.Float(_FAR), mi.Float(0), mi.Float(-_FAR))
            *_, first, last, deep = dr.while_loop(start, lambda ox, oy, *_: oy <= y1, look, label="occluders")  # noqa: B023
            result.append(dr.ravel(mi.Vector4f(first, last, deep, 0)))
        dr.eval(result)
        return result


@dataclass(frozen=True)
class Wedge:
    """Directions from a place to all of an LED, between the unit vectors (ax, ay) and (bx, by)."""

    ax: Any
    ay: Any
    bx: Any
    """Left of the first, as y points up."""
    by: Any
    is_all: Any
    """True if the LED is over the place or nearly so: every direction."""

    @classmethod
    def of(cls, mi: Any, lamp: Lamp, x: Any, y: Any, radius: float) -> Wedge:
        """Wedge from (x, y) [m]; all directions within ``radius`` of the LED's middle line."""
        ax, ay, bx, by = (
            to for sign in (-1, 1) for to in (lamp.centre.x + sign * lamp.half_u.x - x, lamp.centre.y + sign * lamp.half_u.y - y)
        )
        swap = ax * by - ay * bx < 0
        ax, bx = dr.select(swap, bx, ax), dr.select(swap, ax, bx)
        ay, by = dr.select(swap, by, ay), dr.select(swap, ay, by)
        ux, uy = bx - ax, by - ay
        along = dr.clip(-(ax * ux + ay * uy) / dr.maximum(ux * ux + uy * uy, 1e-12), 0, 1)
        px, py = ax + along * ux, ay + along * uy
        a, b = (dr.rsqrt(dr.maximum(vx * vx + vy * vy, 1e-12)) for vx, vy in ((ax, ay), (bx, by)))
        return cls(ax * a, ay * a, bx * b, by * b, px * px + py * py <= radius * radius)

    def has(self, dx: Any, dy: Any, half_x: float, half_y: float) -> Any:
        """True if the wedge meets the rectangle about (dx, dy) [m], of these half edges [m]."""

        def reach(ux: Any, uy: Any) -> Any:
            return dr.abs(ux) * half_x + dr.abs(uy) * half_y

        cx, cy = self.ax + self.bx, self.ay + self.by
        is_left = self.ax * dy - self.ay * dx > -reach(self.ay, self.ax)
        is_right = self.bx * dy - self.by * dx < reach(self.by, self.bx)
        is_ahead = cx * dx + cy * dy > -reach(cx, cy)
        return self.is_all | (is_left & is_right & is_ahead)

    def box(self, most: Any, radius: float, width: float, height: float, columns: int, rows: int) -> list[Any]:
        """Least and largest column and row of blocks, ``most`` [m] along it and ``radius`` beside."""
        sides = []
        for edge, count, (ux, uy) in ((width, columns, (1.0, 0.0)), (height, rows, (0.0, 1.0))):
            for sign in (-1, 1):
                along = dr.maximum(sign * (self.ax * ux + self.ay * uy), sign * (self.bx * ux + self.by * uy))
                is_between = self.is_all | (
                    (sign * (self.ax * uy - self.ay * ux) >= 0) & (sign * (self.bx * uy - self.by * ux) <= 0)
                )
                reach = dr.select(is_between, 1, dr.maximum(along, 0)) * most + radius
                sides.append(sign * dr.minimum(dr.ceil(reach / edge), count))
        return sides


def _seen(mi: Any, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> PixelSample:
    p = mi.Point3f(*(mi.Float(values.astype(np.float32).ravel()) for values in (x, y, z)))
    return PixelSample(mi.UInt32(0), p, mi.Normal3f(0, 0, -1), mi.Vector3f(0, 0, -1))


def _places(t: DepthTiling, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y, z [m] of 3 × 3 places over every block with its margin, each (blocks, 9)."""
    g, (columns, rows), (width, height) = t.layout, t.blocks, t.block_edges
    iy, ix = np.divmod(np.arange(columns * rows), columns)
    b, a = np.divmod(np.arange(9), 3) - np.ones((2, 1))
    x = g.x0 + (ix[:, None] + 0.5) * width + a * (width / 2 + t.margin)
    y = g.y0 + (iy[:, None] + 0.5) * height + b * (height / 2 + t.margin)
    return x, y, _nearest(g, rest, x, y)


def _nearest(g: CoatLayout, rest: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height at rest [m] of the nodes nearest to places (x, y) [m]."""
    ix = np.clip(np.rint((x - g.x0) / g.dx), 0, g.nx - 1).astype(int)
    iy = np.clip(np.rint((y - g.y0) / g.dy), 0, g.ny - 1).astype(int)
    return rest[iy, ix]
