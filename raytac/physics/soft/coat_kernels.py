"""Kernels of ``CoatSurface``: splines through vertices, and material points at places."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

from raytac.physics.rest_map import RestMaps, rest_on_map

wp.set_module_options({"enable_backward": False, "fast_math": False})

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_SIXTH = wp.constant(wp.float64(1.0 / 6.0))
_ITERATIONS = wp.constant(wp.int32(8))
"""Most steps of the search for the material point at a place."""
_TOLERANCE = wp.constant(wp.float64(1e-8))
"""Step below which that search has converged [m]."""


@wp.struct
class Coat:
    """The mesh of a coat and the places of its lattice; lengths [m]."""

    lines_x: wp.array(dtype=wp.float64)
    lines_y: wp.array(dtype=wp.float64)
    rest: wp.array(dtype=wp.vec3d)
    """Vertices, row by row, (V,)."""
    area: wp.array(dtype=wp.float64)
    """Area of each vertex [m²], (V,)."""
    bending_x: wp.array2d(dtype=wp.float64)
    """Second derivatives along x from values, as of ``SplineAxis``."""
    bending_y: wp.array2d(dtype=wp.float64)
    lattice_x: wp.array(dtype=wp.float64)
    lattice_y: wp.array(dtype=wp.float64)
    dome: wp.vec2d
    """Radii of the dome along x and y."""
    maps: RestMaps
    """The one map of heights in place of a dome, if there is one."""


@wp.struct
class Places:
    """Material points at the P places of the lattice, (B, P)."""

    sag: wp.array2d(dtype=wp.float64)
    """Rest height at the material point less that at the place [m]."""
    corner: wp.array2d(dtype=wp.int32)
    """Vertex of the lower corner of the point's cell."""
    along_x: wp.array2d(dtype=wp.vec4d)
    """Spline weights in the cell, as ``SplineAxis.weights`` gives them."""
    along_y: wp.array2d(dtype=wp.vec4d)


@wp.func
def sagitta(u: wp.float64, radius: wp.float64) -> wp.float64:
    """Depth of an arc [m] below its middle at ``u`` [m] from there; 0 for an infinite radius."""
    return u * u / (radius + wp.sqrt(radius * radius - u * u))


@wp.func
def rest_at(coat: Coat, x: wp.float64, y: wp.float64) -> wp.float64:
    """Rest surface z [m]."""
    if coat.maps.first[0] >= 0:
        return rest_on_map(coat.maps, 0, x, y)[0]
    return -(sagitta(x, coat.dome[0]) + sagitta(y, coat.dome[1]))


@wp.func
def cell_of(lines: wp.array(dtype=wp.float64), t: wp.float64) -> wp.int32:
    """Cell between ``lines`` that holds ``t``; the first or the last beyond the ends."""
    low, high = wp.int32(0), lines.shape[0] - 2
    while low < high:
        middle = (low + high + 1) // 2
        if lines[middle] <= t:
            low = middle
        else:
            high = middle - 1
    return low


@wp.func
def spline_weights(lines: wp.array(dtype=wp.float64), cell: wp.int32, t: wp.float64) -> wp.vec4d:
    """Weights of value and second derivative at both ends of a cell; see ``SplineAxis``."""
    h = lines[cell + 1] - lines[cell]
    b = (t - lines[cell]) / h
    a = _1 - b
    return wp.vec4d(a, b, (a * a * a - a) * h * h * _SIXTH, (b * b * b - b) * h * h * _SIXTH)


@wp.func
def on_pad(lines: wp.array(dtype=wp.float64), t: wp.float64) -> wp.float64:
    return wp.clamp(t, lines[0], lines[lines.shape[0] - 1])


@wp.func
def spline_at(
    fields: wp.array4d(dtype=wp.float64),
    env: wp.int32,
    c: wp.int32,
    corner: wp.int32,
    columns: wp.int32,
    x: wp.vec4d,
    y: wp.vec4d,
) -> wp.float64:
    """Value of component ``c`` of ``bend_columns`` in the cell of ``corner``."""
    total = wp.float64(0.0)
    for k in range(4):  # value and second derivative at the lower and the upper row
        for m in range(4):
            vertex = corner + (k % 2) * columns + m % 2
            total += y[k] * x[m] * fields[env, c, 2 * (k // 2) + m // 2, vertex]
    return total


@wp.kernel
def displacements(
    coat: Coat, sound: wp.array(dtype=wp.int32), vertices: wp.array2d(dtype=wp.vec3d), out: wp.array3d(dtype=wp.float64)
):
    """Displacement of the vertices from rest (B, 3, V) [m]; 0 where not ``sound``."""
    env, v = wp.tid()
    d = wp.vec3d()
    if sound[env] != 0:
        d = vertices[env, v] - coat.rest[v]
    for c in range(3):
        out[env, c, v] = d[c]


@wp.kernel
def bend_rows(coat: Coat, values: wp.array3d(dtype=wp.float64), fields: wp.array4d(dtype=wp.float64)):
    """Values (B, C, V) and second derivatives along x, to ``fields`` (B, C, 4, V), 0 and 1."""
    env, c, v = wp.tid()
    columns = coat.lines_x.shape[0]
    first, i = (v // columns) * columns, v % columns
    total = wp.float64(0.0)
    m = wp.int32(0)
    while m < columns:
        total += values[env, c, first + m] * coat.bending_x[i, m]
        m += 1
    fields[env, c, 0, v] = values[env, c, v]
    fields[env, c, 1, v] = total


@wp.kernel
def bend_columns(coat: Coat, fields: wp.array4d(dtype=wp.float64)):
    """Second derivatives of ``bend_rows`` along y, to ``fields`` 2 and 3."""
    env, c, v = wp.tid()
    columns, rows = coat.lines_x.shape[0], coat.lines_y.shape[0]
    j, i = v // columns, v % columns
    value, bent = wp.float64(0.0), wp.float64(0.0)
    m = wp.int32(0)
    while m < rows:
        w = coat.bending_y[j, m]
        value += w * fields[env, c, 0, m * columns + i]
        bent += w * fields[env, c, 1, m * columns + i]
        m += 1
    fields[env, c, 2, v] = value
    fields[env, c, 3, v] = bent


@wp.kernel
def find_places(coat: Coat, fields: wp.array4d(dtype=wp.float64), places: Places):
    """Material point that has come to each place of the lattice, by (environment, place).

    (u, v) ← (x, y) − d(u, v), d of components 0 and 1, until it moves less than the tolerance.
    """
    env, p = wp.tid()
    columns = coat.lines_x.shape[0]
    x = coat.lattice_x[p % coat.lattice_x.shape[0]]
    y = coat.lattice_y[p // coat.lattice_x.shape[0]]
    u, v, done = x + _0, y + _0, wp.int32(0)
    corner, along_x, along_y = wp.int32(0), wp.vec4d(), wp.vec4d()
    for it in range(_ITERATIONS + 1):
        a, b = on_pad(coat.lines_x, u), on_pad(coat.lines_y, v)
        column, row = cell_of(coat.lines_x, a), cell_of(coat.lines_y, b)
        corner = row * columns + column
        along_x, along_y = spline_weights(coat.lines_x, column, a), spline_weights(coat.lines_y, row, b)
        if done == 0 and it < _ITERATIONS:
            step_u = x - spline_at(fields, env, 0, corner, columns, along_x, along_y) - u
            step_v = y - spline_at(fields, env, 1, corner, columns, along_x, along_y) - v
            u += step_u
            v += step_v
            if wp.max(wp.abs(step_u), wp.abs(step_v)) < _TOLERANCE:
                done = wp.int32(1)
        else:
            break
    places.sag[env, p] = rest_at(coat, on_pad(coat.lines_x, u), on_pad(coat.lines_y, v)) - rest_at(coat, x, y)
    places.corner[env, p] = corner
    places.along_x[env, p] = along_x
    places.along_y[env, p] = along_y


@wp.kernel
def rise(coat: Coat, places: Places, fields: wp.array4d(dtype=wp.float64), c: wp.int32, out: wp.array3d(dtype=wp.float32)):
    """Height over rest on the lattice [m], of a displacement along z in component ``c``."""
    env, p = wp.tid()
    columns, wide = coat.lines_x.shape[0], coat.lattice_x.shape[0]
    d = spline_at(fields, env, c, places.corner[env, p], columns, places.along_x[env, p], places.along_y[env, p])
    out[env, p // wide, p % wide] = wp.float32(places.sag[env, p] + d)
