"""``DeviceInk``: dots that markers print on the surface, without the host."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import numpy as np
import warp as wp

from raytac.gel.surface import PadGrid
from raytac.warp_runtime import start_warp

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.kernel
def print_dots(
    centres: wp.array2d(dtype=wp.vec2d),
    origin: wp.vec2d,
    pitch: wp.vec2d,
    reach: wp.vec2i,
    radius: wp.float32,
    # outputs
    ink: wp.array3d(dtype=wp.float32),
):
    """Shares of dots at nodes up to ``reach`` from each, of which the greatest counts."""
    env, marker = wp.tid()
    centre = centres[env, marker]
    if not (wp.isfinite(centre[0]) and wp.isfinite(centre[1])):
        return
    width = wp.float32(wp.max(pitch[0], pitch[1]))
    column = wp.int32(wp.rint((centre[0] - origin[0]) / pitch[0]))
    row = wp.int32(wp.rint((centre[1] - origin[1]) / pitch[1]))
    for j in range(wp.max(row - reach[1], 0), wp.min(row + reach[1] + 1, ink.shape[1])):
        for i in range(wp.max(column - reach[0], 0), wp.min(column + reach[0] + 1, ink.shape[2])):
            ex = wp.float32(origin[0] + wp.float64(i) * pitch[0] - centre[0])
            ey = wp.float32(origin[1] + wp.float64(j) * pitch[1] - centre[1])
            share = (radius - wp.sqrt(ex * ex + ey * ey)) / width + wp.float32(0.5)
            if share > wp.float32(0.0):
                wp.atomic_max(ink, env, j, i, wp.min(share, wp.float32(1.0)))


class DeviceInk:
    """Coverage of the surfaces of B pads by round dots, which ``dot_ink`` describes.

    Attributes:
        ink: shares (B, Ny, Nx), float32, of the last call.
    """

    def __init__(self, grid: PadGrid, radius: float, *, num_envs: int, device: str = "cpu") -> None:
        """``grid``: nodes of the pads; ``radius`` of a dot [m]."""
        start_warp()
        self.ink = wp.zeros((num_envs, *grid.shape), dtype=wp.float32, device=device)
        dx, dy = grid.pitch
        reach = wp.vec2i(*(int(np.ceil(radius / pitch)) + 1 for pitch in (dx, dy)))
        self._inputs = [wp.vec2d(float(grid.x[0]), float(grid.y[0])), wp.vec2d(dx, dy), reach, wp.float32(radius), self.ink]

    def __call__(self, centres: wp.array) -> wp.array:
        """``ink`` of dots at ``centres`` (B, M), vectors of float64 [m]."""
        self.ink.zero_()
        wp.launch(print_dots, dim=centres.shape, inputs=[centres, *self._inputs], device=self.ink.device)
        return self.ink
