"""Linear interpolation between the vertices of a coat and the nodes of a grid, on a device."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from raytac.gel.coat_mesh import CoatMesh
from raytac.gel.interpolate import SplineAxis
from raytac.physics.soft.clearance_kernels import Hats


def hat_arrays(mesh: CoatMesh, x: np.ndarray, y: np.ndarray, device: Any) -> Any:
    """Arrays of ``Hats`` for the lines ``x`` (Nx,), ``y`` (Ny,) [m] of a grid, evenly spaced."""
    hats: Any = Hats()
    for axis, lines, nodes in (("x", mesh.lines_x, x), ("y", mesh.lines_y, y)):
        cell, (_, share, _, _) = SplineAxis(lines).weights(nodes)
        used = (np.abs(np.arange(len(lines))[:, None] - cell - 0.5) < 1.0) & np.ones(len(nodes), bool)
        around = np.stack([used.argmax(axis=1), len(nodes) - used[:, ::-1].argmax(axis=1)], axis=1)
        around[~used.any(axis=1)] = 0
        length = np.full(len(nodes), nodes[1] - nodes[0])
        length[[0, -1]] *= 0.5
        for name, values, dtype in (
            ("cell", cell, wp.int32),
            ("share", share, wp.float64),
            ("around", around, wp.vec2i),
            ("area", length, wp.float64),
        ):
            setattr(hats, f"{name}_{axis}", wp.array(values, dtype=dtype, device=device))
    return hats
