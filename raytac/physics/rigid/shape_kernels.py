"""First hit of vertical lines from below with bodies' parts, by ``raytac.shapes``, in Warp.

A line (x, y, c_z) + t e_z of the pad frame, c the part's origin, is o + t d in the part frame. Lengths are float64 on every device.
Triangles are searched in float32 by ``wp.mesh_query_ray``; the height on the one that is hit is that of its plane in float64.
"""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# pyright: reportAttributeAccessIssue=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, CONE, TORUS, MESH, RELIEF = (wp.constant(wp.int32(k)) for k in range(10))

_0 = wp.constant(wp.float64(0.0))
_1 = wp.constant(wp.float64(1.0))
_2 = wp.constant(wp.float64(2.0))
_3 = wp.constant(wp.float64(3.0))
_HALF = wp.constant(wp.float64(0.5))
_INF = wp.constant(wp.float64(float("inf")))
_PARALLEL = wp.constant(wp.float64(1e-14))
"""Component of d below which a line is parallel to a slab; its square for a quadric's axis."""
_SAME_ROOT = wp.constant(wp.float64(1e-15))
_THIRD_TURN = wp.constant(wp.float64(2.0943951023931953))
_BARELY_FLAT = wp.constant(wp.float64(1e-12))
_RELIEF_LIMIT = wp.constant(wp.float64(0.7))
_RELIEF_SAME = wp.constant(wp.float64(1e-10))


@wp.struct
class Shapes:
    """Parts of all bodies one after the other; lengths [m]."""

    first_part: wp.array(dtype=wp.int32)
    """(bodies + 1,)."""
    ball: wp.array(dtype=wp.float64)
    """Radius about each body's origin, inf for a half-space."""
    kind: wp.array(dtype=wp.int32)
    size: wp.array(dtype=wp.vec3d)
    rotation: wp.array(dtype=wp.mat33d)
    """Of ``body_from_part``."""
    offset: wp.array(dtype=wp.vec3d)
    centre: wp.array(dtype=wp.vec3d)
    """Of the box and the ball that hold the part, part frame."""
    half: wp.array(dtype=wp.vec3d)
    radius: wp.array(dtype=wp.float64)
    width: wp.array(dtype=wp.float64)
    """Of a torus that of its tube, else inf."""
    blunt: wp.array(dtype=wp.float64)
    """Least width of tips and tubes; inf if convex with edges of 90° or blunter."""
    max_slope: wp.array(dtype=wp.float64)
    mesh: wp.array(dtype=wp.uint64)
    """Triangles about ``centre``."""
    first_vertex: wp.array(dtype=wp.int32)
    first_face: wp.array(dtype=wp.int32)
    vertices: wp.array(dtype=wp.vec3d)
    faces: wp.array(dtype=wp.vec3i)
    first_sample: wp.array(dtype=wp.int32)
    samples: wp.array(dtype=wp.int32)
    """Samples along a side of a relief."""
    elevation: wp.array(dtype=wp.float64)


@wp.func
def infinity() -> wp.float64:
    """Infinity in a variable of its own: a name set to the constant would change the constant."""
    return _INF


@wp.func
def line_through(rotation: wp.mat33d, at: wp.vec3d, x: wp.float64, y: wp.float64) -> wp.vec3d:
    """Start o, part frame, of the vertical line at x, y."""
    dx, dy = x - at[0], y - at[1]
    return wp.vec3d(
        rotation[0, 0] * dx + rotation[1, 0] * dy,
        rotation[0, 1] * dx + rotation[1, 1] * dy,
        rotation[0, 2] * dx + rotation[1, 2] * dy,
    )


@wp.func
def direction_of(rotation: wp.mat33d) -> wp.vec3d:
    """Direction d of vertical lines, part frame."""
    return wp.vec3d(rotation[2, 0], rotation[2, 1], rotation[2, 2])


@wp.func
def quadric(a: wp.float64, b: wp.float64, c: wp.float64) -> wp.vec2d:
    """Interval of t with a t² + 2 b t + c <= 0, a >= 0; (inf, −inf) where it is empty."""
    if a < _PARALLEL:
        if c <= _0:
            return wp.vec2d(-_INF, _INF)
        return wp.vec2d(_INF, -_INF)
    disc = b * b - a * c
    if disc < _0:
        return wp.vec2d(_INF, -_INF)
    root = wp.sqrt(disc)
    return wp.vec2d((-b - root) / a, (-b + root) / a)


@wp.func
def slab(o: wp.float64, d: wp.float64, low: wp.float64, high: wp.float64) -> wp.vec2d:
    """Interval of t with low <= o + t d <= high."""
    if wp.abs(d) < _PARALLEL:
        if o >= low and o <= high:
            return wp.vec2d(-_INF, _INF)
        return wp.vec2d(_INF, -_INF)
    inverse = _1 / d
    start = wp.where(d > _0, low, high) * inverse - o * inverse
    return wp.vec2d(start, start + (high - low) * wp.abs(inverse))


@wp.func
def common(a: wp.vec2d, b: wp.vec2d) -> wp.vec2d:
    return wp.vec2d(wp.max(a[0], b[0]), wp.min(a[1], b[1]))


@wp.func
def start_of(interval: wp.vec2d) -> wp.float64:
    """Start of an interval, inf if it is empty."""
    if interval[0] > interval[1]:
        return _INF
    return interval[0]


@wp.func
def under_sphere(radius: wp.float64, at: wp.vec3d, x: wp.float64, y: wp.float64) -> wp.float64:
    dx, dy = x - at[0], y - at[1]
    square = radius * radius - dx * dx - dy * dy
    if square < _0:
        return _INF
    return at[2] - wp.sqrt(square)


@wp.func
def under_ellipsoid(size: wp.vec3d, o: wp.vec3d, d: wp.vec3d) -> wp.float64:
    p, q = wp.cw_div(o, size), wp.cw_div(d, size)
    return quadric(wp.dot(q, q), wp.dot(p, q), wp.dot(p, p) - _1)[0]


@wp.func
def under_cylinder(radius: wp.float64, half: wp.float64, o: wp.vec3d, d: wp.vec3d) -> wp.float64:
    side = quadric(d[0] * d[0] + d[1] * d[1], o[0] * d[0] + o[1] * d[1], o[0] * o[0] + o[1] * o[1] - radius * radius)
    return start_of(common(side, slab(o[2], d[2], -half, half)))


@wp.func
def under_box(size: wp.vec3d, o: wp.vec3d, d: wp.vec3d) -> wp.float64:
    sides = common(slab(o[0], d[0], -size[0], size[0]), slab(o[1], d[1], -size[1], size[1]))
    return start_of(common(sides, slab(o[2], d[2], -size[2], size[2])))


@wp.func
def under_cone(size: wp.vec3d, rotation: wp.mat33d, at: wp.vec3d, x: wp.float64, y: wp.float64) -> wp.float64:
    """Sphere at the tip, joined to a frustum; see ``raytac.shapes.primitives``."""
    base, height, tip = size[0], size[1], size[2]
    rho = wp.tan(wp.atan2(base, height - tip) - wp.asin(tip / wp.sqrt(base * base + (height - tip) * (height - tip))))
    slant = wp.sqrt(_1 + rho * rho)
    apex, tangent = tip - tip * slant / rho, tip - tip * rho / slant
    o, d = line_through(rotation, at, x, y), direction_of(rotation)
    above = o[2] - apex
    a = d[0] * d[0] + d[1] * d[1] - rho * rho * d[2] * d[2]
    if wp.abs(a) <= _BARELY_FLAT:
        a = _BARELY_FLAT
    b = o[0] * d[0] + o[1] * d[1] - rho * rho * above * d[2]
    c = o[0] * o[0] + o[1] * o[1] - rho * rho * above * above
    ends = slab(o[2], d[2], tangent, height)
    frustum = infinity()
    if a > _0:
        frustum = start_of(common(quadric(a, b, c), ends))
    else:
        # Steeper than the flank: inside before the first root (one nappe) and after the second (the other).
        root = wp.sqrt(wp.max(b * b - a * c, _0))
        before = start_of(common(wp.vec2d(-_INF, (-b + root) / a), ends))
        frustum = wp.min(before, start_of(common(wp.vec2d((-b - root) / a, _INF), ends)))
    axis = wp.vec3d(rotation[0, 2], rotation[1, 2], rotation[2, 2])
    return wp.min(at[2] + frustum, under_sphere(tip, at + tip * axis, x, y))


@wp.func
def cubic(p: wp.float64, q: wp.float64) -> wp.vec3d:
    """Real roots of t³ + p t + q, ascending, a single one three times (Viète, Cardano)."""
    third = p / _3
    rest = _HALF * q * _HALF * q + third * third * third
    if rest < _0:
        amplitude = wp.sqrt(-third)
        angle = wp.acos(wp.clamp(_HALF * q / (third * amplitude), -_1, _1)) / _3
        return wp.vec3d(
            _2 * amplitude * wp.cos(angle + _THIRD_TURN),
            _2 * amplitude * wp.cos(angle - _THIRD_TURN),
            _2 * amplitude * wp.cos(angle),
        )
    u = wp.cbrt(_HALF * wp.abs(q) + wp.sqrt(rest))
    if q >= _0:
        u = -u
    if u == _0:
        return wp.vec3d(_0, _0, _0)
    one = u - third / u
    return wp.vec3d(one, one, one)


@wp.func
def torus_value(t: wp.float64, k: wp.float64, a: wp.float64, b: wp.float64, c: wp.float64) -> wp.float64:
    return (t * t + k) * (t * t + k) - wp.float64(4.0) * ((a * t + _2 * b) * t + c)


@wp.func
def under_torus(major: wp.float64, minor: wp.float64, o: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """t of the first root of g, else inf; g and stretches as in ``raytac.shapes.primitives``."""
    r = minor / major
    p = o / major
    middle = -wp.dot(p, d)
    p = p + middle * d
    square = wp.dot(p, p)
    if square > (_1 + r) * (_1 + r):
        return _INF
    k = square + _1 - r * r
    a = d[0] * d[0] + d[1] * d[1]
    b = p[0] * d[0] + p[1] * d[1]
    c = p[0] * p[0] + p[1] * p[1]
    turning = cubic(k - _2 * a, -_2 * b)  # g'/4 = t³ + (k − 2 a) t − 2 b
    low, high = -(_1 + r), turning[0]
    if torus_value(turning[0], k, a, b, c) > _0:
        if torus_value(turning[2], k, a, b, c) > _0:
            return _INF
        low, high = turning[1], turning[2]
    t = _HALF * (low + high)
    for _ in range(100):  # Newton's method, halving the stretch where it would leave it
        value = torus_value(t, k, a, b, c)
        slope = wp.float64(4.0) * (t * (t * t + k - _2 * a) - _2 * b)
        if value > _0:
            low = t
        else:
            high = t
        following = t - value / wp.min(slope, wp.float64(-1e-300))
        if not (following >= low and following <= high):
            following = _HALF * (low + high)
        done = wp.abs(following - t) <= _SAME_ROOT
        t = following
        if done:
            break
    return major * (middle + t)


@wp.func
def sideways(component: wp.float64) -> wp.float32:
    """Component of a ray's direction, never 0: the search divides by it."""
    if wp.abs(component) < wp.float64(1e-20):
        return wp.float32(1e-20)
    return wp.float32(component)


@wp.func
def under_triangles(
    shapes: Shapes, part: wp.int32, rotation: wp.mat33d, at: wp.vec3d, x: wp.float64, y: wp.float64
) -> wp.float64:
    """Lowest z of the part's triangles on the line."""
    d = direction_of(rotation)
    o = line_through(rotation, at, x, y) - shapes.centre[part]
    along = wp.dot(o, d)
    radius = shapes.radius[part]
    foot = o - along * d  # nearest to the centre
    if wp.dot(foot, foot) > radius * radius:
        return _INF
    start = foot - wp.float64(1.01) * radius * d
    origin = wp.vec3(wp.float32(start[0]), wp.float32(start[1]), wp.float32(start[2]))
    ray = wp.vec3(sideways(d[0]), sideways(d[1]), sideways(d[2]))
    hit = wp.mesh_query_ray(shapes.mesh[part], origin, ray, wp.float32(wp.float64(2.1) * radius))
    if not hit.result:
        return _INF
    face = shapes.faces[shapes.first_face[part] + hit.face]
    first = shapes.first_vertex[part]
    p = rotation * shapes.vertices[first + face[0]] + at
    q = rotation * shapes.vertices[first + face[1]] + at
    s = rotation * shapes.vertices[first + face[2]] + at
    e, f = q - p, s - p
    area = e[0] * f[1] - e[1] * f[0]
    if wp.abs(area) <= _BARELY_FLAT * (wp.dot(e, e) + wp.dot(f, f)):
        return at[2] - along + wp.float64(hit.t) - wp.float64(1.01) * radius
    slope_x = (e[2] * f[1] - f[2] * e[1]) / area
    slope_y = (f[2] * e[0] - e[2] * f[0]) / area
    z = p[2] + slope_x * (x - p[0]) + slope_y * (y - p[1])
    return wp.clamp(z, wp.min(p[2], wp.min(q[2], s[2])), wp.max(p[2], wp.max(q[2], s[2])))


@wp.func
def elevation_at(shapes: Shapes, part: wp.int32, x: wp.float64, y: wp.float64) -> wp.float64:
    """Elevation of a relief at part-frame x, y by bilinear interpolation, clamped to the square."""
    n, half = shapes.samples[part], shapes.size[part][0]
    scale = wp.float64(n - 1) / (_2 * half)
    most = wp.float64(n) - wp.float64(1.000001)
    column, row = wp.clamp((x + half) * scale, _0, most), wp.clamp((y + half) * scale, _0, most)
    i, j = wp.int32(column), wp.int32(row)
    u, v = column - wp.float64(i), row - wp.float64(j)
    k = shapes.first_sample[part] + j * n + i
    near = (_1 - u) * shapes.elevation[k] + u * shapes.elevation[k + 1]
    far = (_1 - u) * shapes.elevation[k + n] + u * shapes.elevation[k + n + 1]
    return (_1 - v) * near + v * far


@wp.func
def under_relief(shapes: Shapes, part: wp.int32, o: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """t of the underside of a relief that looks down, as in ``raytac.shapes.relief``."""
    t = -o[2] / d[2]
    height = wp.float64(0.0)
    for _ in range(60):
        height = elevation_at(shapes, part, o[0] + t * d[0], o[1] + t * d[1])
        change = -(o[2] + t * d[2] + height) / d[2]
        t = t + change
        if wp.abs(change) < _RELIEF_SAME or (d[0] == _0 and d[1] == _0):
            break
    beside = wp.max(wp.abs(o[0] + t * d[0]), wp.abs(o[1] + t * d[1]))
    if beside <= shapes.size[part][0] and height > _0:
        return t
    return _INF


@wp.func
def under_primitive(
    kind: wp.int32, size: wp.vec3d, rotation: wp.mat33d, at: wp.vec3d, x: wp.float64, y: wp.float64
) -> wp.float64:
    """Lowest z [m] of a primitive on the vertical line at x, y."""
    if kind == SPHERE:
        return under_sphere(size[0], at, x, y)
    if kind == PLANE:
        if rotation[2, 2] >= _0:  # only one that looks down has an underside
            return _INF
        return at[2] - (rotation[0, 2] * (x - at[0]) + rotation[1, 2] * (y - at[1])) / rotation[2, 2]
    if kind == CONE:
        return under_cone(size, rotation, at, x, y)
    o, d = line_through(rotation, at, x, y), direction_of(rotation)
    if kind == BOX:
        return at[2] + under_box(size, o, d)
    if kind == CYLINDER:
        return at[2] + under_cylinder(size[0], size[1], o, d)
    if kind == CAPSULE:
        axis = size[1] * wp.vec3d(rotation[0, 2], rotation[1, 2], rotation[2, 2])
        ends = wp.min(under_sphere(size[0], at - axis, x, y), under_sphere(size[0], at + axis, x, y))
        return wp.min(ends, at[2] + under_cylinder(size[0], size[1], o, d))
    if kind == ELLIPSOID:
        return at[2] + under_ellipsoid(size, o, d)
    return at[2] + under_torus(size[0], size[1], o, d)


@wp.func
def under_surface(shapes: Shapes, part: wp.int32, rotation: wp.mat33d, at: wp.vec3d, x: wp.float64, y: wp.float64) -> wp.float64:
    """Lowest z [m] of a mesh or relief on the vertical line at x, y."""
    if shapes.kind[part] == RELIEF:
        o, d = line_through(rotation, at, x, y), direction_of(rotation)
        tangent = wp.sqrt(d[0] * d[0] + d[1] * d[1])
        if d[2] > _0 and tangent * shapes.max_slope[part] <= _RELIEF_LIMIT * d[2]:
            return at[2] + under_relief(shapes, part, o, d)
    return under_triangles(shapes, part, rotation, at, x, y)


@wp.func
def first_hit(shapes: Shapes, part: wp.int32, rotation: wp.mat33d, at: wp.vec3d, x: wp.float64, y: wp.float64) -> wp.float64:
    """Lowest z [m] of a part on the vertical line at x, y, pad frame; inf where it misses."""
    if shapes.kind[part] < MESH:
        return under_primitive(shapes.kind[part], shapes.size[part], rotation, at, x, y)
    return under_surface(shapes, part, rotation, at, x, y)


@wp.func
def part_box(shapes: Shapes, part: wp.int32, rotation: wp.mat33d, at: wp.vec3d) -> wp.vec3d:
    """Half edges [m] of a box about the part's centre, pad axes; inf for a half-space."""
    kind, size, half, radius = shapes.kind[part], shapes.size[part], shapes.half[part], shapes.radius[part]
    if kind == PLANE:
        return wp.vec3d(_INF, _INF, _INF)
    result = wp.vec3d()
    for k in range(3):
        axis = rotation[k, 2]
        across = wp.sqrt(wp.max(_1 - axis * axis, _0))
        edge = wp.abs(rotation[k, 0]) * half[0] + wp.abs(rotation[k, 1]) * half[1] + wp.abs(axis) * half[2]
        edge = wp.min(edge, radius)
        if kind == CAPSULE:
            edge = size[0] + size[1] * wp.abs(axis)
        elif kind == CYLINDER:
            edge = size[0] * across + size[1] * wp.abs(axis)
        elif kind == TORUS:
            edge = size[0] * across + size[1]
        elif kind == ELLIPSOID:
            p = wp.vec3d(rotation[k, 0] * size[0], rotation[k, 1] * size[1], axis * size[2])
            edge = wp.length(p)
        result[k] = edge
    return result
