"""Kernels of ``CoatTraction`` and ``CoatMarkers``: values of a coat's vertices at points of it."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.struct
class Points:
    """Points of triangles of a coat, P of them."""

    corner: wp.array(dtype=wp.vec3i)
    """Vertices of the triangle."""
    weight: wp.array(dtype=wp.vec3d)
    """Barycentric weights."""


@wp.struct
class Rows:
    """A sparse matrix over the vertices, by rows."""

    start: wp.array(dtype=wp.int32)
    column: wp.array(dtype=wp.int32)
    weight: wp.array(dtype=wp.float64)


@wp.kernel
def smooth(rows: Rows, forces: wp.array2d(dtype=wp.vec3d), out: wp.array2d(dtype=wp.vec3d)):
    """Matrix times forces (B, V), by (environment, vertex)."""
    env, v = wp.tid()
    total = wp.vec3d()
    for k in range(rows.start[v], rows.start[v + 1]):
        total += rows.weight[k] * forces[env, rows.column[k]]
    out[env, v] = total


@wp.func
def at_point(points: Points, values: wp.array2d(dtype=wp.vec3d), env: wp.int32, i: wp.int32) -> wp.vec3d:
    corner, weight = points.corner[i], points.weight[i]
    return weight[0] * values[env, corner[0]] + weight[1] * values[env, corner[1]] + weight[2] * values[env, corner[2]]


@wp.kernel
def spread(points: Points, values: wp.array2d(dtype=wp.vec3d), out: wp.array3d(dtype=wp.vec3f)):
    """Values of vertices (B, V) at the nodes of a grid, by (environment, row)."""
    env, row = wp.tid()
    for i in range(out.shape[2]):
        value = at_point(points, values, env, row * out.shape[2] + i)
        out[env, row, i] = wp.vec3f(wp.float32(value[0]), wp.float32(value[1]), wp.float32(value[2]))


@wp.kernel
def follow(points: Points, rest: wp.array2d(dtype=wp.vec3d), coat: wp.array2d(dtype=wp.vec3d), out: wp.array2d(dtype=wp.vec2f)):
    """Displacements along x and y of points of a coat, by (environment, point); ``rest``: (1, V)."""
    env, i = wp.tid()
    moved = at_point(points, coat, env, i) - at_point(points, rest, 0, i)
    out[env, i] = wp.vec2f(wp.float32(moved[0]), wp.float32(moved[1]))
