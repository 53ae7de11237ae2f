"""Cast shadows of extended lights: the share of every LED that each place of the coat sees.

A strip of light casts no edge but a penumbra as wide as the strip. Its visible share at a place p of the coat is an integral,

    V(p) = ∫ g(φ) S(φ) dφ / ∫ g(φ) dφ,

over the angle φ at which p sees the points of the strip's longer edge. g is the light that p would get from there, S the share of the
shorter edge above the horizon in that direction (``Depths.visibility``). Equal steps of φ put the nodes where the light comes from
(equi-angular sampling; Kulla and Fajardo, Importance sampling techniques for path tracing in participating media, EGSR 2012, section 4).

V is computed on a grid over the pad, not for each pixel, and interpolated. Neighbours of a 2 × 2 block take nodes a quarter of a step apart
(interleaved sampling; Keller and Heidrich, EGWR 2001), and a binomial filter of 3 × 3 nodes, which has no response at the block's period,
gives each of them all four sets. So a strip of N directions is integrated over 4 N, and no shadow falls apart into those of single points.
Most nodes see all of an LED: only those that ``Occluders`` does not rule out look for shadows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import or_
from typing import Any

import drjit as dr
import numpy as np

from raytac.optics.camera import Pinhole
from raytac.optics.geometry import CoatField, CoatLayout, NodeGrid, PixelSample, bilinear, nodes_in_view
from raytac.optics.refraction import Slab
from raytac.optics.trace.direct import arrival
from raytac.optics.trace.led import Lamp
from raytac.optics.trace.occluders import Occluders
from raytac.optics.trace.shadow_ray import Depths, DepthTiling
from raytac.specs.sensor import LedSpec

COARSER = 1.3
"""Spacing of the grid's nodes over that of the pad's, if an LED is extended."""
BLOCK = 2
"""Nodes of a block along each side, likewise; each takes its own part of the directions."""
EXTENDED = np.deg2rad(12.0)
"""Angle from which an LED, seen from the pad's middle, is extended; others cast edges."""
STEP = np.deg2rad(40.0)
"""Most of such an angle that a node takes in one step."""
SQUARE = 4
"""Nodes along each side of a square, whose rays take much the same path."""
MARGIN = 4e-3
"""Width [m] about a crop whose shadows count too, by light from coat to coat."""


_BINOMIAL = ((-1, 0.25), (0, 0.5), (1, 0.25))
_FILTER = {1: ((0, 0, 1.0),), BLOCK: tuple((a, b, wa * wb) for a, wa in _BINOMIAL for b, wb in _BINOMIAL)}
"""Rows, columns and weights of the filter, by the side of a block."""


def angle(led: LedSpec) -> float:
    """Angle [rad] that the longer edge of ``led`` spans at most, seen from the pad's middle."""
    return 2 * float(np.arctan2(max(led.size) / 2, np.linalg.norm(led.position)))


@dataclass(frozen=True)
class ShadowGrid:
    """Nodes over the part of the pad in view, at which the shares of all LEDs are computed."""

    nodes: NodeGrid
    view: tuple[int, int, int, int]
    """Nodes in view: first column, first row, columns, rows."""
    counts: tuple[int, ...]
    """Directions a node and LED."""
    block: int
    """``BLOCK``, or 1 if no LED is extended."""

    @classmethod
    def build(cls, layout: CoatLayout, camera: Pinhole, thickness: float, leds: Sequence[LedSpec], refinement: int) -> ShadowGrid:
        """Grid over a pad of ``thickness`` [m], for ``refinement`` times the usual directions."""
        extended = any(angle(led) > EXTENDED for led in leds)
        nx, ny = (max(2, round((n - 1) / (COARSER if extended else 1)) + 1) for n in (layout.nx, layout.ny))
        dx, dy = (layout.nx - 1) * layout.dx / (nx - 1), (layout.ny - 1) * layout.dy / (ny - 1)
        nodes = NodeGrid(nx, ny, layout.x0, layout.y0, dx, dy)
        counts = tuple(refinement * max(1, int(np.ceil(angle(led) / STEP))) for led in leds)
        return cls(nodes, _window(nodes, camera, thickness), counts, BLOCK if extended else 1)

    def memory_per_env(self, layout: CoatLayout) -> int:
        """Bytes of one environment's shares while they are filtered."""
        tiling, (columns, rows) = self._tiling(layout), self._squares
        spans = 16 * len(self.counts) * int(np.prod(tiling.blocks))
        return 3 * 16 * -(-len(self.counts) // 4) * SQUARE**2 * columns * rows + tiling.memory_per_env + spans

    @property
    def _squares(self) -> tuple[int, int]:
        """Columns and rows of squares of ``SQUARE`` × ``SQUARE`` nodes over those in view."""
        return -(-self.view[2] // SQUARE), -(-self.view[3] // SQUARE)

    def _place(self, mi: Any, i: Any) -> tuple[Any, Any, Any]:
        """Environment, column and row in view of node ``i``; those of a square follow each other."""
        columns, rows = self._squares
        square, inside = i // SQUARE**2, i % SQUARE**2
        column, row = SQUARE * (square % columns) + inside % SQUARE, SQUARE * ((square // columns) % rows) + inside // SQUARE
        return square // (columns * rows), column, row

    def _number(self, env: Any, column: Any, row: Any) -> Any:
        """Inverse of ``_place``."""
        columns, rows = self._squares
        square = (env * rows + row // SQUARE) * columns + column // SQUARE
        return square * SQUARE**2 + (row % SQUARE) * SQUARE + column % SQUARE

    def _tiling(self, layout: CoatLayout) -> DepthTiling:
        """Tiles with a margin as wide as the neighbours of a node, and theirs."""
        return DepthTiling(layout, 2 * (self.block > 1) * max(self.nodes.dx, self.nodes.dy))

    def occluders(self, mi: Any, layout: CoatLayout, rest: np.ndarray, lamps: Sequence[Lamp], slab: Slab | None) -> Occluders:
        """Bounds on what can cast shadows on the nodes; ``rest``: cover [m] of the gel, (Ny, Nx)."""
        return Occluders.build(mi, self._tiling(layout), rest, lamps, self.counts, self.block**2, slab)

    def shares(
        self, mi: Any, field: CoatField, occluders: Occluders, lamps: Sequence[Lamp], envs: int, slab: Slab | None
    ) -> list[Any]:
        """Visible shares of ``lamps`` at the nodes in view, four LEDs a packet, by ``_number``."""
        g, (left, top, columns, rows), squares = self.nodes, self.view, self._squares
        depths = Depths(mi, field, occluders.tiling, envs)
        spans = occluders.spans(mi, depths, lamps)
        env, column, row = self._place(mi, dr.arange(mi.UInt32, envs * (squares[0] * squares[1] * SQUARE**2)))
        ix, iy = column + left, row + top
        x, y = g.x0 + g.dx * mi.Float(ix), g.y0 + g.dy * mi.Float(iy)
        block = occluders.tiling.block(mi, env, x, y)
        own = [dr.gather(mi.Vector4f, span, block) for span in spans]
        is_shaded = [span.x <= span.y for span in own]
        p = mi.Point3f(x, y, field.z(env, x, y))
        here = PixelSample(env, p, field.normal(env, x, y), mi.Vector3f(0, 0, -1))
        part = (mi.Float(_part(self.block, ix, iy)) + 0.5) / self.block**2
        sums = []
        for lamp, count, span, shaded in zip(lamps, self.counts, own, is_shaded, strict=True):
            seen = partial(self._seen, mi, depths, here, lamp, count, part, slab, span)
            sums.append(
                dr.if_stmt((), shaded, seen, lambda: (mi.Float(1), mi.Float(1)), label="shadow of an LED", mode="symbolic")
            )
        packets = [_packets(mi, [pair[k] for pair in sums]) for k in (0, 1)]
        dr.eval(packets)

        def filtered() -> list[Any]:
            """Shares of all LEDs, four a packet."""
            sums_of = [[mi.Vector4f(0) for _ in kind] for kind in packets]
            for a, b, weight in _FILTER[self.block]:
                beside, above = (
                    mi.UInt32(dr.clip(mi.Int32(k) + step, 0, count - 1))
                    for k, step, count in ((column, b, columns), (row, a, rows))
                )
                at = self._number(env, beside, above)
                for kind, total in zip(packets, sums_of, strict=True):
                    for k, packet in enumerate(kind):
                        total[k] += weight * dr.gather(mi.Vector4f, packet, at)
            # A node that faces away from an LED has no share of it; neighbours then count alone.
            return [dr.select(whole > 0, seen / whole, 1) for seen, whole in zip(*sums_of, strict=True)]

        # Where no neighbour has a shadow, the mean of those that were left out would be 1 as well.
        any_shaded = reduce(or_, is_shaded)
        lit = [mi.Vector4f(1) for _ in packets[0]]
        shares = dr.if_stmt((), any_shaded, filtered, lambda: lit, label="filter of shadows", mode="symbolic")
        result = [
            dr.ravel(mi.Vector4f(*(dr.select(one, share, 1) for one, share in zip(four, packet, strict=False))))
            for packet, four in (
                (shares[k], [*is_shaded[4 * k : 4 * k + 4], *[mi.Bool(False)] * 3][:4]) for k in range(len(shares))
            )
        ]
        dr.eval(result)
        return result

    def _seen(
        self, mi: Any, depths: Depths, here: PixelSample, lamp: Lamp, count: int, part: Any, slab: Slab | None, span: Any
    ) -> tuple[Any, Any]:
        """(light with shadows, light without) of one LED at the nodes, for unit power.

        ``span``: what may block it, as of ``Occluders.spans``.
        """
        seen, whole, sight = mi.Float(0), mi.Float(0), lamp.sight(mi, here.p)
        for k in range(count):
            u, density = sight.at((k + part) / count)
            light = arrival(mi, here, lamp, lamp.point(u, 0), slab)
            gain = light.gain * density
            # Its own part of the longer edge, and the whole shorter one, across the ray in the vertical plane.
            tangent = light.tangent(lamp, density / (count * self.block**2))
            seen += gain * depths.visibility(here.env, here.p, light.target, tangent, gain > 0, span)
            whole += gain
        return seen, whole

    def at(self, mi: Any, shares: list[Any], seen: PixelSample) -> list[Any]:
        """Share of every LED at the points of ``seen``, by bilinear interpolation."""
        g, (left, top, columns, rows) = self.nodes, self.view
        k, wx, wy = g.cell(mi, 0, seen.p.x, seen.p.y)
        ix, iy = (
            mi.UInt32(dr.clip(mi.Int32(at) - first, 0, count - 2))
            for at, first, count in ((k % g.nx, left, columns), (k // g.nx, top, rows))
        )
        corners = [self._number(seen.env, ix + a, iy + b) for b in (0, 1) for a in (0, 1)]
        packets = [bilinear([dr.gather(mi.Vector4f, packet, i) for i in corners], wx, wy) for packet in shares]
        return [packets[n // 4][n % 4] for n in range(len(self.counts))]


def _part(block: int, ix: Any, iy: Any) -> Any:
    """Quarter of the directions of node (ix, iy), or 0 in blocks of one node.

    Rows of a block take 0 and 3, and 1 and 2: with the same mean, they leave the least behind after the filter.
    """
    a, b = ix % block, iy % block
    return b + a * (3 - 2 * b)


def _window(nodes: NodeGrid, camera: Pinhole, thickness: float) -> tuple[int, int, int, int]:
    """Nodes that the image needs: those in view, and about a crop those whose light reaches it."""
    left, top, columns, rows = nodes_in_view(nodes, replace(camera, crop=None), thickness)
    if camera.crop is None:
        return left, top, columns, rows
    x, y, width, height = nodes_in_view(nodes, camera, thickness)
    beside, above = (int(np.ceil(MARGIN / d)) for d in (nodes.dx, nodes.dy))
    first, upper = max(left, x - beside), max(top, y - above)
    last, lower = min(left + columns, x + width + beside), min(top + rows, y + height + above)
    return first, upper, last - first, lower - upper


def _packets(mi: Any, values: Sequence[Any]) -> list[Any]:
    """``values``, four a packet, so that one gather brings them."""
    padded = [*values, *[mi.Float(0)] * (-len(values) % 4)]
    return [dr.ravel(mi.Vector4f(*padded[k : k + 4])) for k in range(0, len(padded), 4)]
