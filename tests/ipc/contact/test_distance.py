"""Closest points against rational arithmetic; these, barrier, mollifier and friction against ipctk; ACCD against what it promises."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import math
from fractions import Fraction

import ipctk
import numpy as np
import pytest
import warp as wp

from ipc.contact import barrier, ccd, friction
from ipc.contact.distance import edge_edge_coefficients, point_triangle_coefficients, separation
from ipc.contact.overlap import orientation
from tests.ipc.conftest import turns

wp.set_module_options({"enable_backward": False})


@wp.kernel
def both(
    x: wp.array2d(dtype=wp.vec3d), pt: wp.array(dtype=wp.vec4d), ee: wp.array(dtype=wp.vec4d), t: wp.array2d(dtype=wp.vec3d)
):
    i = wp.tid()
    a, b, c, d = x[i, 0], x[i, 1], x[i, 2], x[i, 3]
    pt[i] = point_triangle_coefficients(a, b, c, d)
    ee[i] = edge_edge_coefficients(a, b, c, d)
    t[i, 0] = separation(pt[i], a, b, c, d)
    t[i, 1] = separation(ee[i], a, b, c, d)


@wp.kernel
def scalars(x: wp.array(dtype=wp.float64), top: wp.float64, out: wp.array2d(dtype=wp.float64)):
    i = wp.tid()
    out[i, 0] = barrier.barrier(x[i], top)
    out[i, 1] = barrier.barrier_first(x[i], top)
    out[i, 2] = barrier.barrier_second(x[i], top)
    out[i, 3] = barrier.mollifier(x[i], top)
    out[i, 4] = barrier.mollifier_first(x[i], top)
    out[i, 5] = barrier.mollifier_second(x[i], top)
    out[i, 6] = friction.friction_potential(x[i], top)
    out[i, 7] = friction.friction_slope_ratio(x[i], top)
    out[i, 8] = friction.friction_curvature(x[i], top)


@wp.kernel
def advance(
    x: wp.array2d(dtype=wp.vec3d),
    d: wp.array2d(dtype=wp.vec3d),
    slack: wp.float64,
    least: wp.float64,
    out: wp.array2d(dtype=wp.float64),
):
    i = wp.tid()
    one, zero = wp.float64(1.0), wp.float64(0.0)
    for k in range(2):
        out[i, k] = ccd.additive_ccd(
            k == 1, x[i, 0], x[i, 1], x[i, 2], x[i, 3], d[i, 0], d[i, 1], d[i, 2], d[i, 3], slack, zero, least, one
        )


def coefficients(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = len(x)
    pt, ee, t = (
        wp.zeros(n, dtype=wp.vec4d, device="cpu"),
        wp.zeros(n, dtype=wp.vec4d, device="cpu"),
        wp.zeros((n, 2), dtype=wp.vec3d, device="cpu"),
    )
    wp.launch(both, dim=n, inputs=[wp.array(x, dtype=wp.vec3d, device="cpu")], outputs=[pt, ee, t], device="cpu")
    return pt.numpy(), ee.numpy(), t.numpy()


def degenerate(rng: np.random.Generator) -> np.ndarray:
    """Random stencils, and those with exact alignments: parallel and coincident directions, points above edges and corners."""
    x = rng.standard_normal((400, 4, 3))
    special = np.round(rng.standard_normal((400, 4, 3)) * 2) / 2
    size = np.linalg.norm(np.cross(special[:, 2] - special[:, 1], special[:, 3] - special[:, 1]), axis=1)
    edges = np.minimum(
        np.linalg.norm(special[:, 1] - special[:, 0], axis=1), np.linalg.norm(special[:, 3] - special[:, 2], axis=1)
    )
    return np.concatenate([x, special[(size > 0.1) & (edges > 0.1)]])


def test_distances_and_gradients_match_ipctk(rng: np.random.Generator) -> None:
    x = degenerate(rng)
    pt, ee, t = coefficients(x)
    assert np.abs(pt.sum(axis=1)).max() < 1e-14 and np.abs(ee.sum(axis=1)).max() < 1e-14
    worst = 0.0
    for i, stencil in enumerate(x):
        for c, vector, function, gradient in (
            (pt[i], t[i, 0], ipctk.point_triangle_distance, ipctk.point_triangle_distance_gradient),
            (ee[i], t[i, 1], ipctk.edge_edge_distance, ipctk.edge_edge_distance_gradient),
        ):
            expected = function(*stencil)
            worst = max(worst, abs(vector @ vector - expected) / max(expected, 1.0))
            # At exact alignments the closest points need not be unique, so gradients are compared on general stencils only.
            if i < 400:
                g = (2 * c[:, None] * vector).ravel()
                assert np.linalg.norm(g) > 1e-8
                assert np.abs(g - gradient(*stencil)).max() < 1e-10 * max(1.0, np.abs(g).max())
    assert worst < 1e-10, f"squared distances differ by {worst:.3g}"


def test_barrier_mollifier_and_friction_functions_match_ipctk() -> None:
    top = 0.37
    x = np.concatenate([np.geomspace(1e-6, 0.999, 60) * top, [top, 1.5 * top]])
    out = wp.zeros((len(x), 9), dtype=wp.float64, device="cpu")
    wp.launch(scalars, dim=len(x), inputs=[wp.array(x, dtype=wp.float64, device="cpu"), top], outputs=[out], device="cpu")
    b = ipctk.ClampedLogBarrier()
    for row, value in zip(out.numpy(), x, strict=True):
        expected = [
            b(value, top),
            b.first_derivative(value, top),
            b.second_derivative(value, top),
            ipctk.edge_edge_mollifier(value, top),
            ipctk.edge_edge_mollifier_gradient(value, top),
            -2 / top**2 if value < top else 0.0,
            ipctk.smooth_friction_f0(value, top),
            ipctk.smooth_friction_f1_over_x(value, top),
            ipctk.smooth_friction_f2(value, top),
        ]
        assert row == pytest.approx(expected, rel=1e-10, abs=1e-14)


def test_ccd_never_passes_and_rarely_stops_early(rng: np.random.Generator) -> None:
    """No distance on the path falls below the slack; a stencil that is stopped came close to it; ipctk agrees that the path is free."""
    x = rng.standard_normal((300, 4, 3))
    d = 3 * rng.standard_normal((300, 4, 3))
    out = wp.zeros((300, 2), dtype=wp.float64, device="cpu")
    arrays = [wp.array(a, dtype=wp.vec3d, device="cpu") for a in (x, d)]
    wp.launch(advance, dim=300, inputs=[*arrays, 0.1, 0.0], outputs=[out], device="cpu")
    stopped = 0
    oracle = ipctk.TightInclusionCCD()
    for kind, check in ((0, oracle.point_triangle_ccd), (1, oracle.edge_edge_ccd)):
        alpha = out.numpy()[:, kind]
        start = np.linalg.norm(coefficients(x)[2][:, kind], axis=-1)
        ways = np.linspace(0, 1, 101)[None, :, None, None] * alpha[:, None, None, None]
        along = np.linalg.norm(coefficients((x[:, None] + ways * d[:, None]).reshape(-1, 4, 3))[2][:, kind], axis=-1).reshape(
            300, 101
        )
        assert (along.min(axis=1) >= 0.1 * start * (1 - 1e-9)).all()
        ended = alpha < 1
        stopped += ended.sum()
        assert (along[ended, -1] <= 0.11 * start[ended]).all()
        for i in range(0, 300, 5):
            hit, _ = check(*x[i], *(x[i] + alpha[i] * d[i]))
            assert not hit
    assert stopped > 50


def test_ccd_stops_what_ipctk_stops(rng: np.random.Generator) -> None:
    """The same stencils as ipctk's additive CCD with the same slack, no earlier than it, and before the impact it finds without slack."""
    x = rng.standard_normal((300, 4, 3))
    d = 3 * rng.standard_normal((300, 4, 3))
    out = wp.zeros((300, 2), dtype=wp.float64, device="cpu")
    arrays = [wp.array(a, dtype=wp.vec3d, device="cpu") for a in (x, d)]
    wp.launch(advance, dim=300, inputs=[*arrays, 0.1, 0.0], outputs=[out], device="cpu")
    slack, exact = ipctk.AdditiveCCD(10_000, 0.9), ipctk.AdditiveCCD(10_000, 0.999)
    stopped = 0
    for kind in (0, 1):
        for i, alpha in enumerate(out.numpy()[:, kind]):
            ways = x[i], x[i] + d[i]
            (hit, early), (_, late) = (
                (oracle.edge_edge_ccd if kind else oracle.point_triangle_ccd)(*ways[0], *ways[1]) for oracle in (slack, exact)
            )
            assert hit == (alpha < 1)
            if hit:
                stopped += 1
                assert early <= alpha <= late * (1 + 1e-9)
    assert stopped > 50


# --- nearly parallel edges and thin triangles ------------------------------------------------------------------------------------


def rational_distance(x: np.ndarray, edges: bool) -> float:
    """Exact least distance of a stencil (4, 3), rounded once: over vertices, edges and the inside by their normal equations."""
    points = [[Fraction(float(c)) for c in point] for point in x]

    def minus(a: list[Fraction], b: list[Fraction]) -> list[Fraction]:
        return [p - q for p, q in zip(a, b, strict=True)]

    def dot(a: list[Fraction], b: list[Fraction]) -> Fraction:
        return sum((p * q for p, q in zip(a, b, strict=True)), Fraction(0))

    def square(r: list[Fraction], s: Fraction, u: list[Fraction], t: Fraction, v: list[Fraction]) -> Fraction:
        rest = [a - s * b - t * c for a, b, c in zip(r, u, v, strict=True)]
        return dot(rest, rest)

    def to_segment(p: list[Fraction], a: list[Fraction], b: list[Fraction]) -> Fraction:
        r, u = minus(p, a), minus(b, a)
        return square(r, min(max(dot(r, u) / dot(u, u), Fraction(0)), Fraction(1)), u, Fraction(0), u)

    p, a, b, c = points
    if edges:
        best = min(to_segment(p, b, c), to_segment(a, b, c), to_segment(b, p, a), to_segment(c, p, a))
        r, u, v = minus(b, p), minus(a, p), minus(b, c)  # r − s u − t v, with the second edge from b to c
    else:
        best = min(to_segment(p, a, b), to_segment(p, b, c), to_segment(p, c, a))
        r, u, v = minus(p, a), minus(b, a), minus(c, a)
    uu, uv, vv, ru, rv = dot(u, u), dot(u, v), dot(v, v), dot(r, u), dot(r, v)
    if uu * vv != uv * uv:
        s, t = (ru * vv - rv * uv) / (uu * vv - uv * uv), (rv * uu - ru * uv) / (uu * vv - uv * uv)
        if s >= 0 and t >= 0 and (s <= 1 and t <= 1 if edges else s + t <= 1):
            best = min(best, square(r, s, u, t, v))
    digits = 2 ** (2 * max(0, 70 - (best.numerator.bit_length() - best.denominator.bit_length()) // 2))
    return math.isqrt(best.numerator * digits // best.denominator) / math.sqrt(digits)


def crossing_edges(rng: np.random.Generator, angle: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Edges at an ``angle`` [rad] that cross in the projection, a ``gap`` apart, (n, 4, 3); lengths 0.1 to 10, any attitude and place."""
    n = len(angle)
    length, share = 10 ** rng.uniform(-1, 1, (n, 2)), rng.uniform(-0.1, 1.1, (n, 2))
    first = np.array([1.0, 0.0, 0.0]) * length[:, :1]
    second = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) * length[:, 1:]
    lift = np.stack([0 * gap, 0 * gap, gap], axis=1)
    x = np.stack([-share[:, :1] * first, (1 - share[:, :1]) * first, -share[:, 1:] * second, (1 - share[:, 1:]) * second], axis=1)
    x[:, 2:] += lift[:, None]
    return np.einsum("nij,nkj->nki", turns(rng, n), x) + rng.choice([0.0, 1.0], (n, 1, 1)) * rng.standard_normal((n, 1, 3))


def points_over_slivers(rng: np.random.Generator, height: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Triangles of a ``height`` over a side of length 0.1 to 10, and points a ``gap`` above their inside or beside it, (n, 4, 3)."""
    n = len(height)
    triangle = np.zeros((n, 3, 3))
    triangle[:, 1, 0] = 1.0
    triangle[:, 2, 0], triangle[:, 2, 1] = rng.uniform(-0.2, 1.2, n), height
    weights = rng.dirichlet([1, 1, 1], n)
    beside = rng.random(n) < 0.3
    weights[beside] += rng.normal(0, 0.3, (beside.sum(), 3))
    weights /= weights.sum(axis=1, keepdims=True)
    point = (weights[:, :, None] * triangle).sum(axis=1) + np.stack([0 * gap, 0 * gap, gap], axis=1)
    order = np.argsort(rng.random((n, 3)), axis=1)
    x = np.concatenate([point[:, None], np.take_along_axis(triangle, order[:, :, None], axis=1)], axis=1)
    x *= 10 ** rng.uniform(-1, 1, (n, 1, 1))
    return np.einsum("nij,nkj->nki", turns(rng, n), x) + rng.choice([0.0, 1.0], (n, 1, 1)) * rng.standard_normal((n, 1, 3))


THIN = np.array([0.0, 1e-15, 1e-12, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 5e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1.0])
"""Angles [rad] of edges, and heights of triangles over their longest side."""


@pytest.mark.parametrize("edges", [True, False], ids=["edge-edge", "point-triangle"])
def test_distances_keep_their_digits_at_every_angle(rng: np.random.Generator, edges: bool) -> None:
    """The error is that of rounding the coordinates, a few 1e-16 of the largest, whatever the angle and the gap (exact: fractions)."""
    thin, gap = np.repeat(THIN, 70), 10 ** rng.uniform(-12, 0, 70 * len(THIN))
    x = crossing_edges(rng, thin, gap) if edges else points_over_slivers(rng, np.maximum(thin, 1e-15), gap)
    pt, ee, t = coefficients(x)
    c, vector = (ee, t[:, 1]) if edges else (pt, t[:, 0])
    expected = np.array([rational_distance(s, edges) for s in x])
    error = np.abs(np.linalg.norm(vector, axis=1) - expected) / np.abs(x).max(axis=(1, 2))
    worst = int(np.argmax(error))
    assert error[worst] < 1e-15, f"off by {error[worst]:.3g} of the coordinates at {thin[worst]:.3g}, gap {expected[worst]:.3g} m"
    # The coefficients are those of two points on the primitives, and t is what lies between them.
    weights = np.abs(c[:, [0, 1]].sum(axis=1) - 1) if edges else np.abs(c[:, 0] - 1)
    assert weights.max() < 1e-15 and np.abs(c.sum(axis=1)).max() < 1e-15
    assert (c[:, : 2 if edges else 1] > -1e-15).all() and (c[:, 2 if edges else 1 :] < 1e-15).all()
    between = (c[:, :, None] * (x - x.mean(axis=1, keepdims=True))).sum(axis=1)
    assert (np.abs(between - vector).max(axis=1) < 1e-14 * np.abs(x).max(axis=(1, 2))).all()


def test_steps_never_put_surfaces_through_each_other(rng: np.random.Generator) -> None:
    """Pairs pushed together again and again come to rest apart, on the side where they were, by the exact sign of their volume.

    Without a least distance the gap falls below what rounding moves a point.
    """
    n = 600
    angle, gap = np.repeat([1e-9, 1e-7, 1e-6, 1e-5, 1e-3, 1e-1], n // 6), 10 ** rng.uniform(-9, -2, n)
    for edges in (True, False):
        start = crossing_edges(rng, angle, gap) if edges else points_over_slivers(rng, angle, gap)
        c, normal = coefficients(start)[int(edges)], coefficients(start)[2][:, int(edges)]
        met = (np.abs(c if edges else c[:, 1:]) > 0.02).all(axis=1)  # the insides of both, so that no path leads around
        start, normal, reach = start[met], normal[met], float(np.abs(start).max())
        assert met.sum() > n // 4
        push = np.zeros_like(start)
        push[:, : 2 if edges else 1] = -3 * normal[:, None]
        sides = orientation(*(start[:, k] for k in range(4)))
        assert (sides != 0).all()
        for least in (1e-13 * reach, 0.0):
            x, out = start.copy(), wp.zeros((len(start), 2), dtype=wp.float64, device="cpu")
            for _ in range(25):
                arrays = [wp.array(a, dtype=wp.vec3d, device="cpu") for a in (x, push)]
                wp.launch(advance, dim=len(x), inputs=[*arrays, 0.1, least], outputs=[out], device="cpu")
                x += out.numpy()[:, int(edges), None, None] * push
            gaps = np.linalg.norm(coefficients(x)[2][:, int(edges)], axis=1)
            if least > 0:
                assert (orientation(*(x[:, k] for k in range(4))) == sides).all()
                assert (gaps > 0.99 * least).all()
            else:
                assert gaps.min() < 1e-15 * reach


def test_surfaces_a_hair_apart_may_part() -> None:
    """Two triangles' edges 1e-9 to 1e-12 apart: a step that opens the gap is not cut short, one that closes it is."""
    gap = np.array([1e-9, 1e-11, 1e-12])
    x = np.zeros((3, 4, 3))
    x[:, 0], x[:, 1], x[:, 2], x[:, 3] = [-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0]
    x[:, :2, 2] += gap[:, None]
    for sign, expected in ((1.0, 1.0), (-1.0, 0.0)):
        d, out = np.zeros_like(x), wp.zeros((3, 2), dtype=wp.float64, device="cpu")
        d[:, :2, 2] = sign * 1e-3
        arrays = [wp.array(a, dtype=wp.vec3d, device="cpu") for a in (x, d)]
        wp.launch(advance, dim=3, inputs=[*arrays, 0.1, 1e-13], outputs=[out], device="cpu")
        assert out.numpy()[:, 1] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("edges", [True, False], ids=["edge-edge", "point-triangle"])
def test_what_slides_and_turns_in_a_narrow_gap_is_stopped_only_where_the_gap_closes(
    rng: np.random.Generator, edges: bool
) -> None:
    """Pairs 1e-10 to 1e-5 m apart slide by up to a tenth and turn about the contact: the path keeps a tenth of the gap, and is used up.

    Bounds that ask for the speed alone advance by a gap at a time, and give up on the way.
    """
    angle, gap = np.repeat([1e-7, 1e-5, 1e-2, 1.0], 100), 10 ** rng.uniform(-10, -5, 400)
    x = crossing_edges(rng, angle, gap) if edges else points_over_slivers(rng, np.maximum(angle, 1e-3), gap)
    c, normal = coefficients(x)[int(edges)], coefficients(x)[2][:, int(edges)]
    met = (np.abs(c if edges else c[:, 1:]) > 0.05).all(axis=1)
    x, c, normal = x[met], c[met], normal[met]
    assert met.sum() > 100
    n, start = len(x), np.linalg.norm(normal, axis=1)
    normal = normal / start[:, None]
    slide = 10 ** rng.uniform(-4, -1, (n, 1)) * np.cross(normal, rng.standard_normal((n, 3)))
    turned = 0.02 * rng.standard_normal((n, 4))
    turned -= (turned * c).sum(axis=1, keepdims=True) / (c * c).sum(axis=1, keepdims=True) * c  # the gap itself stays, at first
    d = turned[:, :, None] * normal[:, None]
    d[:, : 2 if edges else 1] += slide[:, None]
    out = wp.zeros((n, 2), dtype=wp.float64, device="cpu")
    arrays = [wp.array(a, dtype=wp.vec3d, device="cpu") for a in (x, d)]
    wp.launch(advance, dim=n, inputs=[*arrays, 0.1, 0.0], outputs=[out], device="cpu")
    alpha, samples = (
        out.numpy()[:, int(edges)],
        np.concatenate([np.linspace(0, 1, 1000), 1 - np.geomspace(1e-8, 1e-3, 1000)[::-1]]),
    )
    paths = x[:, None] + (samples * alpha[:, None])[:, :, None, None] * d[:, None]
    pt, ee, t = coefficients(paths.reshape(-1, 4, 3))
    weights, path = (
        (ee if edges else pt).reshape(n, -1, 4),
        np.linalg.norm(t[:, int(edges)], axis=1).reshape(n, -1) / start[:, None],
    )
    rounding = 1e-15 * np.abs(x).max(axis=(1, 2)) / start
    assert (path.min(axis=1) > 0.1 - rounding).all()
    assert 0.2 < (alpha < 1).mean() < 0.98
    early = (alpha < 1) & (path[:, -1] > 0.2) & (alpha > 1e-5)  # an advance of less than 1e-6 is the last
    assert not early.any(), f"stopped {path[early, -1]} of the gap apart at {alpha[early]}"
    # The insides of both were closest all along, so no path leads around: they are on the sides where they were, by exact signs.
    # Edges that turn through parallel ones change the sign without a touch.
    inside = (np.abs(weights if edges else weights[..., 1:]) > 0.01).all(axis=(1, 2)) & (angle[met] > 1e-3)
    ends = x + alpha[:, None, None] * d
    sides = [orientation(*(a[inside, k] for k in range(4))) for a in (x, ends)]
    assert inside.sum() > 50 and (sides[0] == sides[1]).all()
