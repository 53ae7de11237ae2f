"""Writes ``scenes/meshes/gear.stl``: a small spur gear with hub, recessed web and bore, the mesh of ``scenes/press/mesh.toml``.

The teeth are involutes: half a tooth at radius r subtends the angle π/(2z) + inv α − inv α_r, with inv φ = tan φ − φ and
cos α_r = r_b / r, where r_b = (m z / 2) cos α is the base radius (ISO 21771). The solid is a
closed ring of closed rings of equally many vertices, so that it is watertight by construction.

It generates data: nothing in it is random, and it computes on the CPU whatever ``--device`` says.

    python experiments/make_gear_mesh.py && cp runs/make_gear_mesh/gear.stl scenes/meshes/
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from experiments.running import recorded, run
from raytac.errors import InputError
from raytac.io import CommonOptions

FEWEST_TEETH = 12
"""With fewer, the roots of the teeth would cut into the face, whose outer edge has radius 4.3 m."""


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Write a spur gear as an STL file, in millimetres."""

    teeth: int = 12
    """Number of teeth z, 12 to 200."""
    module_mm: float = 1.0
    """Module m [mm]: the pitch circle has diameter m z."""
    width_mm: float = 4.0
    """Width of the rim [mm], more than 1.5 m."""
    quick: bool = False
    """Changes nothing: it takes a moment."""

    def check(self) -> None:
        """Raises ``InputError`` for a gear that cannot be."""
        if not FEWEST_TEETH <= self.teeth <= 200:
            raise InputError("teeth", value=self.teeth, rule=f"must be a whole number in [{FEWEST_TEETH}, 200]")
        if not 0.0 < self.module_mm < math.inf:
            raise InputError("module_mm", value=self.module_mm, rule="must be finite and > 0")
        if not 1.5 * self.module_mm < self.width_mm < math.inf:
            raise InputError("width_mm", value=self.width_mm, rule="must be finite and more than 1.5 modules")


def outline(teeth: int, module: float, pressure_angle: float = math.radians(20.0)) -> np.ndarray:
    """Corners of the tooth profile in the unit of ``module``, shape (8 z, 2), counter-clockwise."""
    pitch_radius = 0.5 * module * teeth
    base, tip, root = pitch_radius * math.cos(pressure_angle), pitch_radius + module, pitch_radius - 1.25 * module
    involute = math.tan(pressure_angle) - pressure_angle

    def half_angle(radius: float) -> float:
        alpha = math.acos(min(base / radius, 1.0))
        return 0.5 * math.pi / teeth + involute - (math.tan(alpha) - alpha)

    flank = [(radius, half_angle(radius)) for radius in (max(base, root), pitch_radius, tip)]
    foot = (root, 0.5 * (half_angle(max(base, root)) + math.pi / teeth))
    tooth = [(r, -a) for r, a in (foot, *flank)] + [(r, a) for r, a in (*reversed(flank), foot)]
    corners = [(r, a + 2.0 * math.pi * k / teeth) for k in range(teeth) for r, a in tooth]
    return np.array([(r * math.cos(a), r * math.sin(a)) for r, a in corners])


def solid(teeth: int, module: float, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and outward faces (F, 3) of the gear, axis z, centred, in the unit of ``module``."""
    teeth_xy = outline(teeth, module)
    angle = np.arctan2(teeth_xy[:, 1], teeth_xy[:, 0])
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    tip, half, m = 0.5 * module * teeth + module, 0.5 * width, module

    def profile(inset: float, z: float) -> np.ndarray:
        return np.column_stack([teeth_xy * (1.0 - inset / tip), np.full(len(angle), z)])

    def circle(radius: float, z: float) -> np.ndarray:
        return np.column_stack([around * radius, np.full(len(angle), z)])

    # From the upper chamfer of the teeth inwards over the face, down the bore, and back over the lower face.
    face = [(4.3, 0.0), (4.1, 0.5), (3.3, 0.5), (3.1, -0.2), (2.2, -0.2), (2.0, 0.0)]
    upper = [circle(r * m, half - sink * m) for r, sink in face]
    lower = [circle(r * m, sink * m - half) for r, sink in reversed(face)]
    chamfer = 0.25 * m
    rings = [
        profile(0.0, half - chamfer),
        profile(chamfer, half),
        *upper,
        *lower,
        profile(chamfer, -half),
        profile(0.0, chamfer - half),
    ]
    n, levels = len(angle), len(rings)
    i, j = np.meshgrid(np.arange(levels), np.arange(n), indexing="ij")
    a, b = i * n + j, i * n + (j + 1) % n
    c, d = (i + 1) % levels * n + j, (i + 1) % levels * n + (j + 1) % n
    quads = np.stack([a, b, d, c], axis=-1).reshape(-1, 4)
    return np.concatenate(rings), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def main(args: Args) -> None:
    import trimesh

    from raytac.specs import load_mesh

    args.check()
    vertices, faces = solid(args.teeth, args.module_mm, args.width_mm)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    with recorded(args, "make_gear_mesh", device="cpu", owned=("gear.stl",)) as (folder, metrics):
        path = folder / "gear.stl"
        mesh.export(path)
        read_vertices, read_faces = load_mesh(path, 0.001)
        metrics |= {
            "mesh.vertices": len(read_vertices),
            "mesh.faces": len(read_faces),
            "mesh.volume_mm3": float(mesh.volume),
            "mesh.bytes": path.stat().st_size,
        }
        print(f"gear.stl: {len(read_vertices)} vertices, {len(read_faces)} faces, {metrics['mesh.bytes']} bytes")


if __name__ == "__main__":
    run(main, Args)
