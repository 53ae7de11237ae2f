"""What every optical mode checks before it touches a surface: shapes, finite heights, and that the camera sees the pad only."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.optics.camera import Pinhole

__all__ = ["check_same_grid", "check_shapes", "check_view", "device_envs", "safe_heights"]


def check_shapes(surface: GelSurface) -> None:
    """Raise InputError for a surface without environments; the surface itself checks its shapes."""
    if surface.batch < 1:
        raise InputError("surface.height", value=surface.height.shape, rule="must have at least one environment")


def device_envs(nodes: int, heights: Any, **others: Any) -> int:
    """Number of environments B in device heights (B·``nodes``); raise InputError unless each of ``others`` has one value a node too."""
    width = dr.width(heights)
    if width == 0 or width % nodes:
        raise InputError("heights", value=width, rule=f"must hold a whole number of grids of {nodes} nodes")
    for name, array in others.items():
        if array is None or dr.width(array) != width:
            value = None if array is None else dr.width(array)
            raise InputError(name, value=value, rule=f"must have one value a node, {width} here")
    return width // nodes


def safe_heights(surface: GelSurface) -> tuple[np.ndarray, np.ndarray]:
    """Heights (B, Ny, Nx) float32 that are safe to trace, with failed environments at rest, and which those are (B,)."""
    heights = np.ascontiguousarray(surface.height, dtype=np.float32)
    # One NaN or infinity makes the sum of squares one, and no height is so large that it does: cheaper than asking every node.
    flat = heights.reshape(len(heights), -1)
    failed = ~np.isfinite(np.vecdot(flat, flat))
    # A NaN would become an index into device memory.
    if failed.any():
        heights = heights.copy()
        heights[failed] = surface.grid.rest
    return heights, failed


def check_same_grid(grid: PadGrid, first: PadGrid) -> None:
    """Raise InputError unless ``grid`` is the ``first`` one that the mode was given, in every node."""
    same = all(np.array_equal(getattr(grid, name), getattr(first, name)) for name in ("x", "y", "rest"))
    if grid is not first and not same:
        rule = f"one optical mode renders one grid and rest surface, the first that it was given, {first.shape} here"
        raise InputError("surface.grid", value=grid.shape, rule=rule)


def check_view(camera: Pinhole, grid: PadGrid) -> None:
    """Raise InputError if the camera sees beyond the pad's edge on the plane z = 0."""
    # A slab bends oblique rays more, so a side of the image reaches farthest where it is closest to the optical axis.
    width, height = camera.resolution
    cx, cy = camera.principal
    views = camera.ray(np.array([0.0, width]), cy), camera.ray(cx, np.array([0.0, height]))
    for k, (axis, nodes, (origin, slope)) in enumerate(zip("xy", (grid.x, grid.y), views, strict=True)):
        seen = origin[k] - slope[k] * origin[2]
        if seen[0] < nodes[0] - 1e-6 or seen[1] > nodes[-1] + 1e-6:
            rule = f"the camera sees {axis} from {1e3 * seen[0]:.2f} to {1e3 * seen[1]:.2f} mm, beyond the pad's edge"
            raise InputError(f"grid.{axis}", value=(float(nodes[0]), float(nodes[-1])), rule=rule)
