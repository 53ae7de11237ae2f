"""Kernel of ``FotsKernel``: displacements by packets of a row of samples.

One thread computes one marker.
A processor has vector registers for packets, and the Gaussians of a row are computed once for all of its samples.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.markers.fots_kernels import Cells, Constants, Drag, dragged, within_reach

wp.set_module_options({"enable_backward": False, "fast_math": False})

PACKET = 16
"""Samples of a row that are summed together: as many as a vector register holds."""
packet = wp.types.vector(length=PACKET, dtype=wp.float32)


@wp.func
def dilated(
    place: wp.vec2f,
    b: wp.int32,
    i: wp.int32,
    box: wp.vec4i,
    depth: wp.array3d(dtype=packet),
    cells: Cells,
    lam: wp.float32,
    weights: wp.array3d(dtype=wp.vec2f),
) -> wp.vec2f:
    """Σ Δh (M − C) exp(−λ ‖M − C‖²) over samples of the contact's box within a marker's reach.

    ``box``: columns from, to and rows from, to. Samples beyond the box are 0, so whole packets are read. From one sample to the next a
    Gaussian changes by a factor, and that by a constant one; in double precision this keeps float32's over a whole pad.
    """
    dx, dy = cells.pitch[0], cells.pitch[1]
    at_x, at_y, c0, c1, r0, r1 = within_reach(place, box, cells, lam)
    sx, sy = packet(), packet()
    if c0 < c1 and r0 < r1:
        p0, p1 = c0 // PACKET, (c1 - 1) // PACKET + 1
        rate, hx, hy = wp.float64(lam), wp.float64(dx), wp.float64(dy)
        ex = (wp.float64(at_x) - wp.float64(p0 * PACKET)) * hx
        ey = (wp.float64(at_y) - wp.float64(r0)) * hy
        two = wp.float64(2.0)
        g, g_factor, g_change = wp.exp(-rate * ex * ex), wp.exp(rate * hx * (two * ex - hx)), wp.exp(-two * rate * hx * hx)
        u, u_factor, u_change = wp.exp(-rate * ey * ey), wp.exp(rate * hy * (two * ey - hy)), wp.exp(-two * rate * hy * hy)
        for r in range(r0, r1):
            weights[b, i, r] = wp.vec2f(wp.float32(u), wp.float32(u * ey))
            u = u * u_factor
            u_factor = u_factor * u_change
            ey = ey - hy
        for p in range(p0, p1):
            along_x, along_y = packet(), packet()
            for r in range(r0, r1):
                h, weight = depth[b, r, p], weights[b, i, r]
                along_x += weight[0] * h
                along_y += weight[1] * h
            for n in range(PACKET):
                along_x[n] = along_x[n] * wp.float32(g * ex)
                along_y[n] = along_y[n] * wp.float32(g)
                g = g * g_factor
                g_factor = g_factor * g_change
                ex = ex - hx
            sx += along_x
            sy += along_y
    x, y = wp.float32(0.0), wp.float32(0.0)
    for n in range(PACKET):
        x += sx[n]
        y += sy[n]
    return wp.vec2f(x, y)


@wp.kernel
def displace(
    xy: wp.array2d(dtype=wp.vec2f),
    drags: wp.array2d(dtype=Drag),
    boxes: wp.array(dtype=wp.vec4i),
    depth: wp.array3d(dtype=packet),
    cells: Cells,
    motion: Constants,
    weights: wp.array3d(dtype=wp.vec2f),
    moved: wp.array2d(dtype=wp.vec2f),
):
    """Displacements (B, M) [m] of markers at ``xy``; ``weights`` (B, M, ny): working memory."""
    b, i = wp.tid()
    box = boxes[b]
    m = motion
    place = xy[b, i]
    drag, free = dragged(place, b, drags, m)
    gain = free * m.dilate_gain * cells.pitch[0] * cells.pitch[1]
    if gain > 0.0:
        drag += gain * dilated(place + drag, b, i, box, depth, cells, m.dilate_lambda, weights)
    moved[b, i] = drag
