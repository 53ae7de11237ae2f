"""Closest points, barrier, mollifier and friction functions against ipctk, and ACCD against what it promises."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportReturnType=false, reportAssignmentType=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import ipctk
import numpy as np
import pytest
import warp as wp

from ipc import barrier, ccd, friction
from ipc.distance import edge_edge_coefficients, point_triangle_coefficients, separation

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
def advance(x: wp.array2d(dtype=wp.vec3d), d: wp.array2d(dtype=wp.vec3d), slack: wp.float64, out: wp.array2d(dtype=wp.float64)):
    i = wp.tid()
    one, zero = wp.float64(1.0), wp.float64(0.0)
    out[i, 0] = ccd.additive_ccd(False, x[i, 0], x[i, 1], x[i, 2], x[i, 3], d[i, 0], d[i, 1], d[i, 2], d[i, 3], slack, zero, one)
    out[i, 1] = ccd.additive_ccd(True, x[i, 0], x[i, 1], x[i, 2], x[i, 3], d[i, 0], d[i, 1], d[i, 2], d[i, 3], slack, zero, one)


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
    """No distance on the way falls below the slack; a stencil that is stopped came close to it; ipctk agrees that the way is free."""
    x = rng.standard_normal((300, 4, 3))
    d = 3 * rng.standard_normal((300, 4, 3))
    out = wp.zeros((300, 2), dtype=wp.float64, device="cpu")
    arrays = [wp.array(a, dtype=wp.vec3d, device="cpu") for a in (x, d)]
    wp.launch(advance, dim=300, inputs=[*arrays, 0.1], outputs=[out], device="cpu")
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
    wp.launch(advance, dim=300, inputs=[*arrays, 0.1], outputs=[out], device="cpu")
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
