"""Geometry below all optical modes: the coat's height field, camera rays, normals.

The reference integrator traces the triangles of this surface. The fast one needs no acceleration structure for it: the surface is
a height field over a regular grid, camera rays are near the grid's normal and shadow rays leave the thin slab of the imprint after
a few cells. Rebuilding a bounding volume hierarchy each frame costs more than all of its rays (docs/measurements/image-modes.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.optics.camera import Pinhole

TILE = 0.5e-3
"""Edge of a tile of the bounds map [m].
Its bounds hold two beyond: a camera ray of slope t may be that over t off its tile's height, 2.8 mm for the Mini's steepest ray."""
LOOK_UP_Z = -1.0e-3
"""Height at which a camera ray looks up its tile [m]: between rest and a deep press."""
_TALL = 2.5e-3
"""Depth of a gel at rest beyond which bounds of tiles are not relied upon [m]."""
_BULGE = 0.2
"""Height of a bulge over the gel's thickness up to which what is in view is known."""
_RAYS = 33
"""Camera rays along a side of the image that tell which nodes are in view."""


def clipped(x: Any, most: float) -> Any:
    """``x`` within [0, most] by comparisons, which take less than minima that keep NaN."""
    x = dr.select(x > 0, x, 0)
    return dr.select(x < most, x, most)


def bilinear(corners: Sequence[Any], wx: Any, wy: Any) -> Any:
    """Bilinear mean of a cell's ``corners`` at the shares ``wx`` and ``wy`` of its sides."""
    a, b, c, d = corners
    return dr.lerp(dr.lerp(a, b, wx), dr.lerp(c, d, wx), wy)


@dataclass(frozen=True)
class NodeGrid:
    """Nodes over the pad, row by row: numbers, first place, spacing [m]; B times in arrays."""

    nx: int
    ny: int
    x0: float
    y0: float
    dx: float
    dy: float

    def cell(self, mi: Any, env: Any, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """First corner of the cell under (x, y) [m], and the shares of its sides at that place."""
        return self.cell_at(mi, env, (x - self.x0) * (1 / self.dx), (y - self.y0) * (1 / self.dy))

    def cell_at(self, mi: Any, env: Any, fx: Any, fy: Any) -> tuple[Any, Any, Any]:
        """The same of a place in columns and rows from the first node."""
        fx, fy = (clipped(f, n - 1.001) for f, n in ((fx, self.nx), (fy, self.ny)))
        ix, iy = mi.UInt32(fx), mi.UInt32(fy)
        return env * (self.ny * self.nx) + (iy * self.nx + ix), fx - mi.Float(ix), fy - mi.Float(iy)

    def corners(self, kind: Any, values: Any, i: Any) -> list[Any]:
        """``values``, packets of type ``kind``, at the corners of the cells that start at ``i``."""
        return [dr.gather(kind, values, i + offset) for offset in (0, 1, self.nx, self.nx + 1)]

    def slopes(self, mi: Any, z: Any, i: Any, ix: Any, iy: Any) -> tuple[Any, Any]:
        """(∂z/∂x, ∂z/∂y) at node ``i`` (column ``ix``, row ``iy``); one-sided on the rim."""
        nx = self.nx
        x_minus, x_plus = dr.select(ix > 0, i - 1, i), dr.select(ix < nx - 1, i + 1, i)
        y_minus, y_plus = dr.select(iy > 0, i - nx, i), dr.select(iy < self.ny - 1, i + nx, i)
        zx = (dr.gather(mi.Float, z, x_plus) - dr.gather(mi.Float, z, x_minus)) / (mi.Float(x_plus - x_minus) * self.dx)
        rise = dr.gather(mi.Float, z, y_plus) - dr.gather(mi.Float, z, y_minus)
        return zx, rise / (mi.Float((y_plus - y_minus) // nx) * self.dy)


def nodes_in_view(g: NodeGrid, camera: Pinhole, thickness: float) -> tuple[int, int, int, int]:
    """First column, first row, columns, rows of nodes in view of gel as thick [m] at most."""
    left, top, width, height = camera.piece
    u, v = np.meshgrid(np.linspace(left, left + width, _RAYS), np.linspace(top, top + height, _RAYS))
    origin, slope = camera.ray(u, v)
    z = thickness * np.array([-1.0, _BULGE])[:, None, None] - origin[2]
    spans = []
    for k, (first, step, count) in enumerate(((g.x0, g.dx, g.nx), (g.y0, g.dy, g.ny))):
        seen = (origin[k] + z * slope[k] - first) / step
        start = int(np.clip(np.floor(seen.min()) - 1, 0, count - 2))
        stop = int(np.clip(np.ceil(seen.max()) + 2, start + 2, count))
        spans.append((start, stop - start))
    return spans[0][0], spans[1][0], spans[0][1], spans[1][1]


def concave_cover(grid: PadGrid) -> np.ndarray:
    """A concave surface on or above the resting gel [m], (Ny, Nx), for ``CoatField``.

    A function of x plus one of y, the upper hulls of what the gel has at most along each: a dome, and any other such sum that is concave,
    is its own.
    """
    over_x = _upper_hull(grid.x, grid.rest.max(axis=0))
    over_y = _upper_hull(grid.y, (grid.rest - over_x).max(axis=1))
    cover = over_x[None, :] + over_y[:, None]
    return grid.rest if np.abs(cover - grid.rest).max() < 1e-9 else cover


def _upper_hull(at: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Least concave function over ``values`` at rising places, (N,) (A. M. Andrew, 1979)."""
    hull: list[int] = []
    for k in range(len(at)):
        while len(hull) > 1 and (values[hull[-1]] - values[hull[-2]]) * (at[k] - at[hull[-1]]) <= (
            values[k] - values[hull[-1]]
        ) * (at[hull[-1]] - at[hull[-2]]):
            hull.pop()
        hull.append(k)
    return np.interp(at, at[hull], values[hull])


@dataclass(frozen=True)
class CoatLayout(NodeGrid):
    """Constants of all frames: the pad's grid and its tiling."""

    tile_x: int
    tile_y: int
    tiles_x: int
    tiles_y: int
    tall: bool = False
    """True where the gel at rest is so deep that a ray may miss its tile's bounds."""

    @classmethod
    def from_grid(cls, grid: PadGrid) -> CoatLayout:
        (ny, nx), (dx, dy) = grid.shape, grid.pitch
        tile_x, tile_y = max(1, round(TILE / dx)), max(1, round(TILE / dy))
        tiles = -(-nx // tile_x), -(-ny // tile_y)
        tall = bool(grid.rest.min() < -_TALL)
        return cls(nx, ny, float(grid.x[0]), float(grid.y[0]), dx, dy, tile_x, tile_y, *tiles, tall)


class CoatField:
    """B coat surfaces as device arrays, computed each frame from heights.

    ``slopes`` holds (∂z/∂x, ∂z/∂y) a node, so that one packet gather brings its normal, and ``cells`` the heights at the four corners of a
    cell, for the walks. Normals point to the camera side (n_z < 0), as the vertex normals of the reference's mesh do.
    """

    def __init__(self, mi: Any, layout: CoatLayout, rest: Any, height: Any) -> None:
        """``rest`` (Ny·Nx) and ``height`` (B·Ny·Nx): device Floats [m].

        ``rest``: the gel at rest, or a concave surface above it, as of ``concave_cover``.
        """
        self.mi, self.layout, self.rest, self.height = mi, layout, rest, height
        self.slopes, self.cells = dr.ravel(pack_slopes(mi, layout, height)), dr.ravel(pack_cells(mi, layout, height))
        dr.eval(self.slopes, self.cells)
        self.lowest, self.highest = bounds_map(mi, layout, height)
        dr.eval(self.lowest, self.highest)

    def _pad_bounds(self) -> tuple[Any, Any]:
        """Lowest and highest z of every pad [m], (B,) each."""
        tiles = self.layout.tiles_x * self.layout.tiles_y
        bounds = dr.block_reduce(dr.ReduceOp.Min, self.lowest, tiles), dr.block_reduce(dr.ReduceOp.Max, self.highest, tiles)
        dr.eval(*bounds)
        return bounds

    @staticmethod
    def memory_per_env(layout: CoatLayout) -> int:
        """Bytes of one surface: slopes and corners of every node, and the tiles' bounds."""
        g = layout
        return 24 * g.nx * g.ny + 8 * g.ny * g.tiles_x + 16 * g.tiles_x * g.tiles_y

    def z(self, env: Any, x: Any, y: Any, active: Any = True) -> Any:
        """Bilinear height [m] at (x, y) [m]."""
        return self.z_in(self.layout.cell(self.mi, env, x, y), active)

    def z_in(self, cell: tuple[Any, Any, Any], active: Any = True) -> Any:
        """Bilinear height [m] in a cell, as ``NodeGrid.cell`` gives it."""
        i, wx, wy = cell
        c = dr.gather(self.mi.Vector4f, self.cells, i, active)
        return bilinear((c.x, c.y, c.z, c.w), wx, wy)

    def normal(self, env: Any, x: Any, y: Any) -> Any:
        """The unit normal at (x, y) [m], interpolated between nodes."""
        mi, g = self.mi, self.layout
        i, wx, wy = g.cell(mi, env, x, y)
        n = bilinear([_normal(mi, corner) for corner in g.corners(mi.Vector2f, self.slopes, i)], wx, wy)
        return dr.normalize(mi.Normal3f(n))

    def tile(self, env: Any, x: Any, y: Any) -> Any:
        """Index into the bounds map of the tile under (x, y)."""
        mi, g = self.mi, self.layout
        tx = dr.minimum(mi.UInt32(dr.clip((x - g.x0) / g.dx, 0, g.nx - 1.001)) // g.tile_x, g.tiles_x - 1)
        ty = dr.minimum(mi.UInt32(dr.clip((y - g.y0) / g.dy, 0, g.ny - 1.001)) // g.tile_y, g.tiles_y - 1)
        return (env * g.tiles_y + ty) * g.tiles_x + tx

    def camera_hit(self, env: Any, origin: tuple[Any, Any, Any], tx: Any, ty: Any, *, oblique: bool = False) -> Any:
        """First point of the ray origin + s (tx, ty, 1) on the surface; origins may differ by pixel.

        The tile's bounds bracket the hit, or those of the whole pad for rays too ``oblique`` to stay over a tile; the bracket is walked
        in steps of one cell until the ray is behind the surface, then refined by the secant rule (bilinear patches are nearly linear along
        so short a distance).
        """
        mi, g = self.mi, self.layout
        ox, oy, oz = origin
        tile = self.tile(env, ox + (LOOK_UP_Z - oz) * tx, oy + (LOOK_UP_Z - oz) * ty)
        lo, hi = dr.gather(mi.Float, self.lowest, tile), dr.gather(mi.Float, self.highest, tile)
        if oblique:
            lo, hi = (dr.gather(mi.Float, bound, env) for bound in self._pad_bounds())
        lo, hi = lo - 1e-6, hi + 1e-6
        steps = dr.ceil((hi - lo) * dr.sqrt(tx * tx + ty * ty) / min(g.dx, g.dy)) + 1
        dz = (hi - lo) / steps

        def gap(z: Any, active: Any = True) -> Any:
            """Height of the surface above the ray's point at ``z``: positive before the hit."""
            return self.z(env, ox + (z - oz) * tx, oy + (z - oz) * ty, active) - z

        def before(za: Any, ga: Any, zb: Any, gb: Any) -> Any:
            return (gb > 0) & (zb < hi)

        def walk(za: Any, ga: Any, zb: Any, gb: Any) -> tuple[Any, ...]:
            zn = zb + dz
            return zb, gb, zn, gap(zn)

        z1 = lo + dz
        za, ga, zb, gb = dr.while_loop((lo, gap(lo), z1, gap(z1)), before, walk, label="camera hit")
        for _ in range(2):
            z = za + (zb - za) * dr.clip(ga / dr.maximum(ga - gb, 1e-12), 0, 1)
            gz = gap(z)
            is_before = gz > 0
            za, ga = dr.select(is_before, z, za), dr.select(is_before, gz, ga)
            zb, gb = dr.select(is_before, zb, z), dr.select(is_before, gb, gz)
        z = za + (zb - za) * dr.clip(ga / dr.maximum(ga - gb, 1e-12), 0, 1)
        return mi.Point3f(ox + (z - oz) * tx, oy + (z - oz) * ty, z)


def pack_slopes(mi: Any, g: CoatLayout, height: Any) -> Any:
    """(∂z/∂x, ∂z/∂y) at nodes of ``height`` (B·Ny·Nx); one-sided differences on the rim."""
    i = dr.arange(mi.UInt32, dr.width(height))
    return mi.Vector2f(*g.slopes(mi, height, i, i % g.nx, (i // g.nx) % g.ny))


def _normal(mi: Any, slopes: Any) -> Any:
    inv = dr.rsqrt(slopes.x * slopes.x + slopes.y * slopes.y + 1)
    return mi.Vector3f(slopes.x * inv, slopes.y * inv, -inv)


def pack_cells(mi: Any, g: CoatLayout, height: Any) -> Any:
    """Four corners of the cell right of and below every node, for one gather instead of four."""
    i = dr.arange(mi.UInt32, dr.width(height))
    ix, iy = i % g.nx, (i // g.nx) % g.ny
    # Named as in ``slopes``, so that Dr.Jit gathers them once.
    right, down = dr.select(ix < g.nx - 1, i + 1, i), dr.select(iy < g.ny - 1, i + g.nx, i)
    across = dr.select(iy < g.ny - 1, right + g.nx, right)
    return mi.Vector4f(height, *(dr.gather(mi.Float, height, corner) for corner in (right, down, across)))


def bounds_map(mi: Any, g: CoatLayout, height: Any) -> tuple[Any, Any]:
    """Lowest and highest z of 5 × 5 tiles, each (B·tiles_y·tiles_x) [m]."""
    envs = dr.width(height) // (g.nx * g.ny)
    rows = dr.arange(mi.UInt32, envs * g.ny * g.tiles_x)
    tx, row = rows % g.tiles_x, rows // g.tiles_x
    lo, hi = mi.Float(np.inf), mi.Float(-np.inf)
    for k in range(-1, g.tile_x + 1):
        ix = mi.UInt32(dr.clip(mi.Int32(tx * g.tile_x) + k, 0, g.nx - 1))
        z = dr.gather(mi.Float, height, row * g.nx + ix)
        lo, hi = dr.minimum(lo, z), dr.maximum(hi, z)
    dr.eval(lo, hi)
    tiles = dr.arange(mi.UInt32, envs * g.tiles_y * g.tiles_x)
    tx, ty, env = tiles % g.tiles_x, (tiles // g.tiles_x) % g.tiles_y, tiles // (g.tiles_x * g.tiles_y)
    lo2, hi2 = mi.Float(np.inf), mi.Float(-np.inf)
    for k in range(-1, g.tile_y + 1):
        iy = mi.UInt32(dr.clip(mi.Int32(ty * g.tile_y) + k, 0, g.ny - 1))
        i = (env * g.ny + iy) * g.tiles_x + tx
        lo2, hi2 = dr.minimum(lo2, dr.gather(mi.Float, lo, i)), dr.maximum(hi2, dr.gather(mi.Float, hi, i))
    dr.eval(lo2, hi2)
    lo3, hi3 = lo2, hi2
    for sx in range(-2, 3):
        for sy in range(-2, 3):
            nx = mi.UInt32(dr.clip(mi.Int32(tx) + sx, 0, g.tiles_x - 1))
            ny = mi.UInt32(dr.clip(mi.Int32(ty) + sy, 0, g.tiles_y - 1))
            i = (env * g.tiles_y + ny) * g.tiles_x + nx
            lo3, hi3 = dr.minimum(lo3, dr.gather(mi.Float, lo2, i)), dr.maximum(hi3, dr.gather(mi.Float, hi2, i))
    return lo3, hi3


@dataclass(frozen=True)
class PixelSample:
    """Camera ray hit of every pixel, pad frame: environment, point, normal, direction back."""

    env: Any
    p: Any
    n: Any
    wo: Any
    exit: Any = None
    """Radiance that leaves the slab per radiance at p, T / n²; None without a slab."""


def see(mi: Any, field: CoatField, camera: Pinhole, envs: int, jitter: tuple[float, float] = (0.5, 0.5)) -> PixelSample:
    """Trace one ray through every pixel of ``envs`` images, at ``jitter`` inside the pixel."""
    width, height = camera.size
    i = dr.arange(mi.UInt32, envs * width * height)
    env = i // (width * height)
    column, row = camera.pixel(i - env * (width * height))
    u, v = mi.Float(column) + jitter[0], mi.Float(row) + jitter[1]
    origin, (tx, ty) = camera.ray(u, v)
    p = field.camera_hit(env, origin, tx, ty, oblique=camera.lens.tilts or field.layout.tall)
    n = field.normal(env, p.x, p.y)
    leaving = None
    if camera.slab is not None:
        ax, ay = camera.slope(u, v)
        leaving = camera.slab.transmittance(mi, dr.rsqrt(1 + ax * ax + ay * ay)) / camera.slab.ior**2
    return PixelSample(env, p, n, dr.normalize(mi.Vector3f(-tx, -ty, -1)), leaving)


def seen_images(p: Any, n: Any, surface: GelSurface, camera: Pinhole, outputs: Sequence[str]) -> dict[str, np.ndarray]:
    """Contact, and as ``outputs`` say normals, positions and depth, of points and normals."""
    width, height = camera.size
    shape, grid = (surface.batch, height, width), surface.grid
    points = np.array(p).T.reshape(*shape, 3)
    ix = np.clip(np.rint((points[..., 0] - grid.x[0]) / grid.pitch[0]).astype(int), 0, len(grid.x) - 1)
    iy = np.clip(np.rint((points[..., 1] - grid.y[0]) / grid.pitch[1]).astype(int), 0, len(grid.y) - 1)
    images = {"contact": surface.contact[np.arange(shape[0])[:, None, None], iy, ix]}
    if "normals" in outputs:
        images["normals"] = np.ascontiguousarray(np.array(n).T.reshape(*shape, 3))
        images["position"] = np.ascontiguousarray(points)
    if "depth" in outputs:
        images["depth"] = camera.depth(points).astype(np.float32)
    return images


def check_view(camera: Pinhole, grid: PadGrid) -> None:
    """Raise InputError if the camera sees beyond the pad's edge on the plane z = 0."""
    # A slab bends oblique rays more, so a side of the image reaches farthest where it is closest to the optical axis.
    width, height = camera.resolution
    cx, cy = camera.principal
    if not camera.lens.is_plain:  # sides of the image are curved, or oblique, on the plane
        along = np.linspace(0, 1, _RAYS)
        u = width * np.concatenate([along, along, 0 * along, 0 * along + 1])
        v = height * np.concatenate([0 * along, 0 * along + 1, along, along])
        origin, slope = camera.ray(u, v)
        _check_extent([origin[k] - slope[k] * origin[2] for k in (0, 1)], grid)
        return
    views = camera.ray(np.array([0.0, width]), cy), camera.ray(cx, np.array([0.0, height]))
    _check_extent([origin[k] - slope[k] * origin[2] for k, (origin, slope) in enumerate(views)], grid)


def _check_extent(seen: Sequence[np.ndarray], grid: PadGrid) -> None:
    """Raise InputError if x or y [m] of ``seen`` lie beyond the grid."""
    for axis, nodes, at in zip("xy", (grid.x, grid.y), seen, strict=True):
        if at.min() < nodes[0] - 1e-6 or at.max() > nodes[-1] + 1e-6:
            rule = f"the camera sees {axis} from {1e3 * at.min():.2f} to {1e3 * at.max():.2f} mm, beyond the pad's edge"
            raise InputError(f"grid.{axis}", value=(float(nodes[0]), float(nodes[-1])), rule=rule)
