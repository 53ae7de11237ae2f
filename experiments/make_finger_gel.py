"""Writes ``scenes/meshes/finger_gel.stl``: the gel of ``scenes/sensors/finger_example.toml``, round across and at its tip.

The outer surface is a cylinder of 30 mm radius along y that ends, towards −y, in a sphere of the same radius: z = √(R² − x² − t²) − R with
t = min(y − y₀, 0). No product of arcs, so no ``dome_radius_mm``, describes it. The solid goes down to the bonded face.

It generates data: nothing in it is random, and it computes on the CPU whatever ``--device`` says.

    python experiments/make_finger_gel.py && cp runs/make_finger_gel/finger_gel.stl scenes/meshes/
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.running import recorded, run
from raytac.errors import InputError
from raytac.io import CommonOptions


@dataclass(frozen=True, kw_only=True)
class Args(CommonOptions):
    """Write the gel of a finger as an STL file, in millimetres."""

    radius_mm: float = 30.0
    """Radius R of cylinder and tip [mm]."""
    tip_mm: float = 0.0
    """y₀ where the tip begins [mm]."""
    thickness_mm: float = 6.0
    """From the bonded face to the middle of the outer surface [mm]."""
    quick: bool = False
    """Changes nothing: it takes a moment."""


def solid(radius: float, tip: float, thickness: float, half: tuple[int, int] = (12, 10)) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and outward faces (F, 3), in the unit of ``radius``, a node each unit."""
    x, y = np.meshgrid(*(np.arange(-side, side + 1, dtype=float) for side in half))
    square = radius**2 - x**2 - np.minimum(y - tip, 0.0) ** 2
    if square.min() <= 0.0 or (z := np.sqrt(np.maximum(square, 0.0)) - radius).min() <= -thickness:
        raise InputError(
            "radius_mm", value=radius, rule="must be so large that the surface stays above the bonded face at the corners"
        )
    rows, columns = x.shape
    top, back = np.stack([x, y, z], -1).reshape(-1, 3), np.stack([x, y, 0 * x - thickness], -1).reshape(-1, 3)
    node = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (node[j, i].ravel() for j in (slice(-1), slice(1, None)) for i in (slice(-1), slice(1, None)))
    up = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    rim = np.concatenate([node[0, :-1], node[:-1, -1], node[-1, :0:-1], node[:0:-1, 0]])
    after, below = np.roll(rim, -1), rows * columns
    walls = np.concatenate([np.stack([rim, rim + below, after + below], 1), np.stack([rim, after + below, after], 1)])
    return np.concatenate([top, back]), np.concatenate([up, up[:, ::-1] + below, walls])


def main(args: Args) -> None:
    import trimesh

    from raytac.specs import load_mesh

    vertices, faces = solid(args.radius_mm, args.tip_mm, args.thickness_mm)
    with recorded(args, "make_finger_gel", device="cpu", owned=("finger_gel.stl",)) as (folder, metrics):
        path = folder / "finger_gel.stl"
        trimesh.Trimesh(vertices, faces, process=False).export(path)
        read_vertices, read_faces = load_mesh(path, 0.001)
        metrics |= {"mesh.vertices": len(read_vertices), "mesh.faces": len(read_faces), "mesh.bytes": path.stat().st_size}
        print(f"finger_gel.stl: {len(read_vertices)} vertices, {len(read_faces)} faces, {metrics['mesh.bytes']} bytes")


if __name__ == "__main__":
    run(main, Args)
