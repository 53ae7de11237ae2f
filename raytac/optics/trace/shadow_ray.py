"""Shadow rays: walks over the coat's height field that skip what cannot block them.

The resting gel is concave, or has a concave cover, so the clearance of a ray from it grows at least linearly from the place p to the light,
and only indentation deeper than that can block the ray. ``Depths`` bounds the indentation in windows, which rule out most of the walk.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from raytac.optics.geometry import CoatField, CoatLayout, clipped

TILE = 0.25e-3
"""Edge of a tile [m], about: a ray looks at or skips a stretch of that length."""
MOST_CELLS = 8
"""Most cells along an edge of a tile."""
BLOCK = 4
"""Tiles along each side of a block (``Occluders``)."""


@dataclass(frozen=True)
class DepthTiling:
    """Tiles and blocks over the pad's grid."""

    layout: CoatLayout
    margin: float
    """Width [m] about a block that counts for its shallowest place."""

    @property
    def cells(self) -> int:
        """Cells along each side of a tile."""
        return int(np.clip(round(TILE / max(self.layout.dx, self.layout.dy)), 1, MOST_CELLS))

    @property
    def tiles(self) -> tuple[int, int]:
        """Columns and rows of tiles."""
        return -(-self.layout.nx // self.cells), -(-self.layout.ny // self.cells)

    @property
    def blocks(self) -> tuple[int, int]:
        """Columns and rows of blocks."""
        columns, rows = self.tiles
        return -(-columns // BLOCK), -(-rows // BLOCK)

    @property
    def block_edges(self) -> tuple[float, float]:
        """Width and height of a block [m]."""
        return BLOCK * self.cells * self.layout.dx, BLOCK * self.cells * self.layout.dy

    @property
    def memory_per_env(self) -> int:
        """Bytes of the depths of one surface."""
        return 12 * int(np.prod(self.tiles)) + 8 * int(np.prod(self.blocks))

    def block(self, mi: Any, env: Any, x: Any, y: Any) -> Any:
        """Number, B·blocks, of the block over (x, y) [m]."""
        g, (columns, rows), (width, height) = self.layout, self.blocks, self.block_edges
        ix, iy = (
            dr.minimum(mi.UInt32(dr.maximum((at - first) * (1 / edge), 0)), count - 1)
            for at, first, edge, count in ((x, g.x0, width, columns), (y, g.y0, height, rows))
        )
        return (env * rows + iy) * columns + ix


class Depths:
    """Indentation of B coats from the gel at rest, by tiles and blocks; device arrays."""

    def __init__(self, mi: Any, field: CoatField, tiling: DepthTiling, envs: int) -> None:
        self.mi, self.field, self.tiling = mi, field, tiling
        own = self._of_tiles(envs)
        dr.eval(own)
        columns, rows = tiling.tiles
        i = dr.arange(mi.UInt32, envs * (columns * rows))
        ix, iy = i % columns, (i // columns) % rows
        right, down = dr.select(ix < columns - 1, 1, 0), dr.select(iy < rows - 1, columns, 0)
        deepest = mi.Float(-np.inf)
        for offset in (mi.UInt32(0), right, down, right + down):
            deepest = dr.maximum(deepest, dr.gather(mi.Vector2f, own, i + offset).x)
        self.windows = deepest
        """Largest depth of a tile and of those right of it, below, and right below, B·tiles."""
        self.blocks = self._of_blocks(own, envs)
        """Largest depth of a block, and least of it with its margin, packets, B·blocks."""
        dr.eval(self.windows, self.blocks)
        self.deepest = dr.block_reduce(dr.ReduceOp.Max, self.windows, columns * rows)
        """Largest depth of each coat, (B,)."""
        dr.eval(self.deepest)

    def _of_tiles(self, envs: int) -> Any:
        """Packets (largest, least) depth [m] of the nodes of every tile and the next ones."""
        mi, g, t = self.mi, self.tiling.layout, self.tiling
        columns, rows = t.tiles
        i = dr.arange(mi.UInt32, envs * (columns * rows))
        ix, iy, env = t.cells * (i % columns), t.cells * ((i // columns) % rows), i // (columns * rows)
        deep, flat = mi.Float(-np.inf), mi.Float(np.inf)
        for b in range(t.cells + 1):
            line = dr.minimum(iy + b, g.ny - 1) * g.nx
            for a in range(t.cells + 1):
                k = line + dr.minimum(ix + a, g.nx - 1)
                depth = dr.gather(mi.Float, self.field.rest, k) - dr.gather(mi.Float, self.field.height, env * (g.nx * g.ny) + k)
                deep, flat = dr.maximum(deep, depth), dr.minimum(flat, depth)
        return dr.ravel(mi.Vector2f(deep, flat))

    def _of_blocks(self, own: Any, envs: int) -> Any:
        mi, g, t = self.mi, self.tiling.layout, self.tiling
        (columns, rows), (width, height) = t.tiles, t.blocks
        beside = int(np.ceil(t.margin / (t.cells * min(g.dx, g.dy))))
        i = dr.arange(mi.UInt32, envs * (width * height))
        ix, iy, env = mi.Int32(i % width) * BLOCK, mi.Int32((i // width) % height) * BLOCK, i // (width * height)
        deep, flat = mi.Float(-np.inf), mi.Float(np.inf)
        for b in range(-beside, BLOCK + beside):
            for a in range(-beside, BLOCK + beside):
                x, y = mi.UInt32(dr.clip(ix + a, 0, columns - 1)), mi.UInt32(dr.clip(iy + b, 0, rows - 1))
                depth = dr.gather(mi.Vector2f, own, (env * rows + y) * columns + x)
                flat = dr.minimum(flat, depth.y)
                if 0 <= a < BLOCK and 0 <= b < BLOCK:
                    deep = dr.maximum(deep, depth.x)
        return dr.ravel(mi.Vector2f(deep, flat))

    def visibility(self, env: Any, p: Any, light: Any, tan_half: Any, active: Any, span: Any) -> Any:
        """Share of an emitter at ``light`` seen from ``p`` past the surface itself, in [0, 1].

        Walks the shadow ray cell by cell and keeps the smallest clearance angle. ``tan_half`` is half the emitter's extent seen
        from ``p`` across the ray in the vertical plane: between −tan_half and +tan_half the share grows linearly, which is exact for
        a rectangle cut by a straight horizon. Where the windows say that a stretch is not deep enough to block the ray, the walk skips it;
        where all that may block it (``span``, as of ``Occluders.spans``) is not, the walk ends.
        """
        mi, g, field, cells, (columns, rows) = self.mi, self.tiling.layout, self.field, self.tiling.cells, self.tiling.tiles
        d = light - p
        square = d.x * d.x + d.y * d.y
        inverse = dr.rsqrt(square)
        reach, ux, uy, rise = square * inverse, d.x * inverse, d.y * inverse, -d.z * inverse
        # Clearance of the ray's lower edge above the resting surface: at least above_p + gain · s, which the coat must exceed to block.
        above_p = self._rest(p.x, p.y) - p.z
        gain = (self._rest(light.x, light.y) - light.z - above_p) * inverse - tan_half
        step = min(g.dx, g.dy)
        edge = cells * step
        end = dr.minimum(dr.select(gain > 0, (span.z - above_p) / gain, reach), dr.minimum(span.y, reach))
        # In columns and rows of nodes; and the corner of every stretch that is first in the grid, in those of tiles.
        x, y, vx, vy = (p.x - g.x0) * (1 / g.dx), (p.y - g.y0) * (1 / g.dy), ux * (1 / g.dx), uy * (1 / g.dy)
        first_x, first_y = (x + dr.minimum(vx, 0) * edge) * (1 / cells), (y + dr.minimum(vy, 0) * edge) * (1 / cells)
        own = env * (columns * rows)

        def inside(s: Any, least: Any) -> Any:
            return active & (s < end) & (least > -tan_half)

        def look(s: Any, least: Any) -> tuple[Any]:
            for k in range(cells):
                at = s + k * step
                at = dr.select(at < reach, at, reach)
                clearance = field.z_in(g.cell_at(mi, env, x + at * vx, y + at * vy)) - (p.z - at * rise)
                angle = clearance * dr.rcp(at)
                least = dr.select(angle < least, angle, least)
            return (least,)

        def near(s: Any, least: Any) -> Any:
            tx = mi.UInt32(clipped(first_x + s * (vx * (1 / cells)), columns - 1))
            ty = mi.UInt32(clipped(first_y + s * (vy * (1 / cells)), rows - 1))
            bound = dr.gather(mi.Float, self.windows, own + (ty * columns + tx))
            steeper = gain + (tan_half - least)  # only what is steeper than the least so far counts
            return above_p + steeper * dr.select(steeper > 0, s, s + edge) <= bound

        def walk(s: Any, least: Any) -> tuple[Any, Any]:
            (least,) = dr.if_stmt((s, least), near(s, least), look, lambda s, least: (least,), label="stretch", mode="symbolic")
            return s + edge, least

        # Nothing in the way means a clearance of tan_half or more; a start of 1 would shade what lies right under an LED.
        start = step * dr.maximum(dr.floor(span.x * (1 / step)), 1)
        _, least = dr.while_loop((start, mi.Float(tan_half)), inside, walk, label="shadow ray")
        return dr.clip(0.5 + 0.5 * least / tan_half, 0, 1)

    def _rest(self, x: Any, y: Any) -> Any:
        """z of the cover of the gel at rest [m] at the node nearest to (x, y)."""
        mi, g = self.mi, self.tiling.layout
        ix = mi.UInt32(dr.clip((x - g.x0) / g.dx + 0.5, 0, g.nx - 1))
        iy = mi.UInt32(dr.clip((y - g.y0) / g.dy + 0.5, 0, g.ny - 1))
        return dr.gather(mi.Float, self.field.rest, iy * g.nx + ix)
