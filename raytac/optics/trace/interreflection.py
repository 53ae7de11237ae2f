"""Inter-reflection for the ``fast`` integrator: two smooth fields in place of paths.

Light that reaches the coat after at least one reflection comes from two places, and each has a cheap, deterministic model:

1. **From the case** (walls, floor, and all that they got from the coat): it hardly changes when a small part of the pad moves by a
   millimetre. ``CaseLight`` path-traces it once per sensor at rest and fits the irradiance E(x, y, n) by a polynomial: cubic in the
   place on the pad, linear in the normal.
2. **From the coat to itself**, on the flanks of an imprint, where one slope lights another. ``BounceField`` computes the coat's direct
   radiosity B on a coarse grid and gathers it once over the neighbourhood (radiosity with one bounce, Goral et al. 1984):
   V(p) = Σ_j B_j / π · max(0, cos θ_j) ΔA_j / r² · ω_j as a vector, so that a pixel's own normal gives E = max(0, n · V).

Left out: occlusion between coat patches, second and later bounces within the coat, the change of the case's light with the imprint, and
the shape of the specular lobe (indirect light meets the albedo (1 − s) ρ + s). docs/concepts/optics.md states the error that remains.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from raytac.gel.surface import PadGrid
from raytac.io.arrays import npy_bytes
from raytac.io.cache import cache_folder, keep_cached, read_cached
from raytac.io.code_digest import code_digest
from raytac.optics.camera import Pinhole
from raytac.optics.geometry import CoatField, CoatLayout, NodeGrid, PixelSample, bilinear, nodes_in_view
from raytac.optics.trace.led import Lamp
from raytac.optics.trace.reference import OFFSET, connect, trace
from raytac.optics.trace.scene import UNIT, SensorScene
from raytac.specs.sensor import SensorSpec

SAMPLES = 1 << 18
"""Paths that the fit of the case's light uses."""
DEGREE = 3
"""Polynomial degree over the pad."""
PATCH = 0.4e-3
"""Pitch of the coarse grid [m]."""
REACH = 7
"""Radius of the neighbourhood that lights a patch [patches]."""
TILT = 1.2
"""Largest tangent of a normal's tilt in the fit."""
_MOST_FITS = 64
"""Fits that a process keeps."""
_fits: dict[tuple[Any, ...], CaseLight] = {}
"""Last fits of this process, by all that they depend on."""


def _monomials(u: Any, v: Any) -> list[Any]:
    return [u**i * v**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]


def _cache_file(basis: tuple[Any, ...]) -> Path | None:
    """File of the fit that depends on ``basis``; None for a user without a home folder."""
    folder = cache_folder("case_light")
    return None if folder is None else folder / f"{hashlib.sha256(repr(basis).encode()).hexdigest()[:24]}.npy"


@dataclass(frozen=True)
class CaseLight:
    """Irradiance from the case: ``coefficients`` (3·G, terms, 4) of x, y and (1, n_x, n_y, n_z)."""

    coefficients: np.ndarray
    half: tuple[float, float]

    @classmethod
    def of(cls, mi: Any, sensor: SensorSpec, grid: PadGrid, lamps: list[Lamp], groups: list[int], seed: int) -> CaseLight:
        """The fit of a sensor at rest, with ``SAMPLES`` paths; made once for sensors of one kind.

        It does not depend on camera and response. So both sensors of a gripper share a fit, and no second Mitsuba scene is built, which
        would leave memory behind. The user's cache keeps it: its paths take as long as half of all the rest of a press in a new process.
        """
        parts = sensor.gelpad, sensor.coat, sensor.case, sensor.refraction, sensor.lights.leds, sensor.markers.rows > 0
        nodes = tuple(values.tobytes() for values in (grid.x, grid.y, grid.rest))
        key = parts, nodes, tuple(groups), seed, SAMPLES, mi.variant()
        if key not in _fits:
            path = _cache_file((*key, mi.__version__, code_digest(__name__)))
            kept = read_cached(path)
            if kept is None:
                light = cls.fit(SensorScene(mi, sensor, grid), lamps, groups, seed, SAMPLES)
                keep_cached(path, npy_bytes(light.coefficients))
            else:
                light = cls(np.load(io.BytesIO(kept), allow_pickle=False), (float(grid.x[-1]), float(grid.y[-1])))
            while len(_fits) >= _MOST_FITS:
                del _fits[next(iter(_fits))]
            _fits[key] = light
        return _fits[key]

    @classmethod
    def fit(cls, scene: SensorScene, lamps: list[Lamp], groups: list[int], seed: int, samples: int) -> CaseLight:
        """Path-trace from random points of the coat at rest, and fit by least squares.

        Directions are cosine-distributed about random normals, so a path's π L estimates E; directions into the pad's plane count as
        dark here, because ``BounceField`` brings the coat's own light.
        """
        mi, grid = scene.mi, scene.grid
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, samples)
        place, tilt, square = sampler.next_2d(), sampler.next_2d(), sampler.next_2d()
        half = float(grid.x[-1]), float(grid.y[-1])
        u, v = 2 * place.x - 1, 2 * place.y - 1
        disk = mi.warp.square_to_uniform_disk(tilt) * TILT
        n = dr.normalize(mi.Vector3f(disk.x, disk.y, -1))
        d = mi.Frame3f(n).to_world(mi.warp.square_to_cosine_hemisphere(square))
        x, y = UNIT * u * half[0], UNIT * v * half[1]
        p = mi.Point3f(x, y, scene.height_at(x, y) - 20 * OFFSET)
        incoming = trace(mi, scene, sampler, mi.Ray3f(p, d), lamps, groups, -1, seen=False)
        irradiance = [dr.select(d.z < 0, r * dr.pi, 0) for r in incoming]
        for lamp, group in zip(lamps, groups, strict=True):
            w, arriving = connect(mi, scene, sampler, p, n, lamp, True)
            for c in range(3):
                irradiance[3 * group + c] += arriving[c] * dr.dot(w, n)
        basis = [m * c for m in _monomials(u, v) for c in (mi.Float(1), n.x, n.y, n.z)]
        # All in one kernel: each conversion below would otherwise evaluate its own channel, and with it trace every path again.
        dr.eval(irradiance, basis)
        design = np.empty((len(basis), samples))
        for row, values in zip(design, basis, strict=True):
            row[:] = np.array(values)
        target = np.stack([np.array(e) for e in irradiance], axis=1)
        # Normal equations: the basis is well conditioned (some 10²), and half of the digits of float64 would do.
        solution = np.linalg.solve(design @ design.T, design @ target)
        terms = len(basis) // 4
        return cls(solution.T.reshape(len(irradiance), terms, 4).astype(np.float32), half)

    def on(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(e, v_x, v_y, v_z) of E(n) at the places x, y [m], shape (channels, N, 4), float32."""
        monomials = np.stack(_monomials(x / self.half[0], y / self.half[1]), axis=-1)
        return np.einsum("nm,cmk->cnk", monomials, self.coefficients).astype(np.float32)


def patches_of(layout: CoatLayout) -> NodeGrid:
    """The coarse grid over the pad."""
    nx, ny = (max(2, round((n - 1) * d / PATCH) + 1) for n, d in ((layout.nx, layout.dx), (layout.ny, layout.dy)))
    dx, dy = (layout.nx - 1) * layout.dx / (nx - 1), (layout.ny - 1) * layout.dy / (ny - 1)
    return NodeGrid(nx, ny, layout.x0, layout.y0, dx, dy)


@dataclass(frozen=True)
class BounceField:
    """E(n) = max(0, e + n · v) of all indirect light on a coarse grid over the pad, by frame.

    (e, v) of the case is fixed; the coat's own light is added to v. A pixel reads both by bilinear interpolation and its own normal. It is
    gathered for the patches in view and the channels that have light: LEDs of one colour leave the others of their layer dark.
    """

    patches: NodeGrid
    view: tuple[int, int, int, int]
    """Patches for which light is gathered: first column, first row, columns and rows."""
    lit: tuple[int, ...]
    """Channels with light, of all layers."""
    case: list[Any]
    """Packed (e, v_x, v_y, v_z) of every node, one array a lit channel."""

    @classmethod
    def build(
        cls, mi: Any, layout: CoatLayout, case: CaseLight, camera: Pinhole, thickness: float, lit: Sequence[int]
    ) -> BounceField:
        """Lay the grid over a pad of ``thickness`` [m]; evaluate the case's light, channels ``lit``."""
        g = patches_of(layout)
        x, y = np.meshgrid(g.x0 + g.dx * np.arange(g.nx), g.y0 + g.dy * np.arange(g.ny))
        on_nodes = case.on(x.ravel(), y.ravel())
        return cls(g, nodes_in_view(g, camera, thickness), tuple(lit), [mi.Float(on_nodes[k].ravel()) for k in lit])

    @staticmethod
    def memory_per_env(layout: CoatLayout, camera: Pinhole, thickness: float, lit: Sequence[int]) -> int:
        """Bytes of the grid while it is filled: results, patches, their light and heights."""
        g = patches_of(layout)
        _, _, columns, rows = nodes_in_view(g, camera, thickness)
        return 16 * len(lit) * columns * rows + g.nx * g.ny * (16 + 16 * -(-len(lit) // 4) + 4)

    def parts(self, by_layer: bool) -> list[tuple[int, list[int]]]:
        """Channels that are gathered, and places in ``lit`` of those that each sums.

        Those of all layers, or sums over layers: three at most, channels of the first layer then.
        """
        if by_layer:
            return [(k, [place]) for place, k in enumerate(self.lit)]
        of_camera = [(c, [place for place, k in enumerate(self.lit) if k % 3 == c]) for c in range(3)]
        return [(c, places) for c, places in of_camera if places]

    def gather_light(
        self, mi: Any, field: CoatField, radiosity: Callable[[PixelSample], list[Any]], envs: Any, by_layer: bool = True
    ) -> list[Any]:
        """(e, v_x, v_y, v_z) of the patches in view, an array of each part, by ``radiosity`` B."""
        g, parts = self.patches, self.parts(by_layer)
        i = dr.arange(mi.UInt32, envs * (g.nx * g.ny))
        env, ix, iy = i // (g.nx * g.ny), i % g.nx, (i // g.nx) % g.ny
        x, y = g.x0 + g.dx * mi.Float(ix), g.y0 + g.dy * mi.Float(iy)
        z = mi.Float(0)
        for a in (-1, 0, 1):
            for b in (-1, 0, 1):
                z += field.z(env, x + a * g.dx / 3, y + b * g.dy / 3) / 9
        dr.eval(z)
        n = dr.normalize(mi.Normal3f(*g.slopes(mi, z, i, ix, iy), -1))
        b = radiosity(PixelSample(env, mi.Point3f(x, y, z), n, mi.Vector3f(0, 0, -1)))
        patches = dr.ravel(mi.Vector4f(z, n.x, n.y, n.z))
        # Four channels a packet, so that one gather brings them.
        lit = [sum((b[self.lit[place]] for place in places), mi.Float(0)) for _, places in parts]
        packets = [dr.ravel(mi.Vector4f(*lit[k : k + 4], *[0] * (4 - len(lit[k : k + 4])))) for k in range(0, len(lit), 4)]
        dr.eval(patches, packets)
        left, top, columns, rows = self.view
        w = dr.arange(mi.UInt32, envs * (columns * rows))
        env, ix, iy = w // (columns * rows), w % columns + left, (w // columns) % rows + top
        i = (env * g.ny + iy) * g.nx + ix
        here = dr.gather(mi.Vector4f, patches, i)
        z, n = here.x, mi.Vector3f(here.y, here.z, here.w)
        area = g.dx * g.dy / np.pi

        def add(oy: int, ox: Any, v: list[Any]) -> tuple[Any, list[Any]]:
            jx, jy = mi.Int32(ix) + ox, mi.Int32(iy) + oy
            ok = (jx >= 0) & (jx < g.nx) & (jy >= 0) & (jy < g.ny)
            j = mi.UInt32((mi.Int32(env) * g.ny + jy) * g.nx + jx)
            q = dr.gather(mi.Vector4f, patches, j, ok)
            d = mi.Vector3f(mi.Float(ox) * g.dx, oy * g.dy, q.x - z)
            r2 = dr.maximum(dr.squared_norm(d), 1e-12)
            cos_i = dr.dot(n, d)
            cos_j = -(q.y * d.x + q.z * d.y + q.w * d.z)
            # ΔA_j is the patch's area on the slope: its footprint over |n_z|.
            weight = dr.select(ok & (cos_i > 0) & (cos_j > 0), area * cos_j / (-q.w * r2 * r2), 0)
            out = list(v)
            for m, packet in enumerate(packets):
                light = dr.gather(mi.Vector4f, packet, j, ok)
                for c in range(len(out[4 * m : 4 * m + 4])):
                    out[4 * m + c] = out[4 * m + c] + d * (weight * light[c])
            return ox + 1, out

        # Row by row through a disc; the patch itself is among them and gives nothing.
        gathered = [dr.zeros(mi.Vector3f, dr.width(i)) for _ in parts]
        for oy in range(-REACH, REACH + 1):
            half = int(np.sqrt(REACH**2 - oy**2))
            row = partial(add, oy)
            _, gathered = dr.while_loop((mi.Int32(-half), gathered), partial(_up_to, half), row, label="coat bounce")
        node = i - env * (g.nx * g.ny)
        result = []
        for (_, places), v in zip(parts, gathered, strict=True):
            e: Any = sum((dr.gather(mi.Vector4f, self.case[place], node) for place in places), mi.Vector4f(0))
            result.append(dr.ravel(mi.Vector4f(e.x, e.y + v.x, e.z + v.y, e.w + v.z)))
        dr.eval(result)
        return result

    def irradiance(self, mi: Any, grids: list[Any], seen: PixelSample, by_layer: bool = True) -> list[tuple[int, Any]]:
        """(channel, E [radiance · sr]) of ``parts`` at the points and normals of ``seen``."""
        n, g, (left, top, columns, rows) = seen.n, self.patches, self.view
        k, wx, wy = g.cell(mi, 0, seen.p.x, seen.p.y)
        # Within the patches in view, whatever the ray has hit.
        ix, iy = (
            dr.clip(mi.Int32(at) - first, 0, count - 2)
            for at, first, count in ((k % g.nx, left, columns), (k // g.nx, top, rows))
        )
        view = replace(g, nx=columns, ny=rows)
        i = (seen.env * rows + mi.UInt32(iy)) * columns + mi.UInt32(ix)
        fields = (bilinear(view.corners(mi.Vector4f, grid, i), wx, wy) for grid in grids)
        channels = [channel for channel, _ in self.parts(by_layer)]
        return [(c, dr.maximum(e.x + n.x * e.y + n.y * e.z + n.z * e.w, 0)) for c, e in zip(channels, fields, strict=True)]


def _up_to(last: int, ox: Any, v: list[Any]) -> Any:
    return ox <= last
