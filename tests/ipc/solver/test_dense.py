"""Dense factors and products of one environment by one block of threads, against NumPy."""

# pyright: reportInvalidTypeForm=false, reportArgumentType=false, reportIndexIssue=false, reportAssignmentType=false
# pyright: reportGeneralTypeIssues=false

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from ipc.arrays import FloatArray3d, IntArray
from ipc.solver.preconditioners.dense import PANEL, factor, gram, solve, solve_identity

DEVICES = [
    "cpu",
    pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")]),
]


@wp.kernel(enable_backward=False)
def correct(a: FloatArray3d, b: FloatArray3d, y: FloatArray3d, size: IntArray, inverts: wp.bool, lanes: wp.int32, good: IntArray):
    """a = b − b a⁻¹ b, or a⁻¹."""
    env, lane = wp.tid()
    n = size[env]
    if factor(a, env, n, lane, lanes):
        if inverts:
            solve_identity(a, y, env, n, lane, lanes)
        else:
            solve(a, b, y, env, n, lane, lanes)
        gram(b, y, inverts, a, env, n, lane, lanes)
        good[env] = 1


def run(a: np.ndarray, b: np.ndarray, size: np.ndarray, inverts: bool, device: str) -> tuple[np.ndarray, np.ndarray]:
    lanes = 256 if device == "cuda" else 1
    arrays = [wp.array(v, dtype=wp.float64, device=device) for v in (a, b, np.full_like(a, np.nan))]
    sizes, good = wp.array(size, dtype=wp.int32, device=device), wp.zeros(len(a), dtype=wp.int32, device=device)
    inputs = [*arrays, sizes, inverts, lanes, good]
    wp.launch(correct, dim=(len(a), lanes), inputs=inputs, device=device, block_dim=256)
    return arrays[0].numpy(), good.numpy()


def matrices(rng: np.random.Generator, sizes: list[int], room: int) -> tuple[np.ndarray, np.ndarray]:
    """Positive definite and symmetric matrices in the corners of larger arrays."""
    a, b = np.full((2, len(sizes), room, room), np.nan)
    for k, n in enumerate(sizes):
        root, other = rng.normal(size=(2, n, n))
        a[k, :n, :n], b[k, :n, :n] = root @ root.T + np.eye(n), other + other.T
    return a, b


@pytest.mark.parametrize("device", DEVICES)
def test_corrections_and_inverses(device: str, rng: np.random.Generator) -> None:
    sizes = [PANEL, 2 * PANEL, 42, 66, 138, 600 if device == "cuda" else 240]
    a, b = matrices(rng, sizes, max(sizes))
    for inverts in (False, True):
        result, good = run(a, b, np.array(sizes), inverts, device)
        assert good.all()
        for k, n in enumerate(sizes):
            inverse, one = np.linalg.inv(a[k, :n, :n]), b[k, :n, :n]
            expected = inverse if inverts else one - one @ inverse @ one
            part = result[k, :n, :n]
            np.testing.assert_allclose(part, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
            np.testing.assert_array_equal(part, part.T)


@pytest.mark.parametrize("device", DEVICES)
def test_a_matrix_that_is_not_positive_is_refused(device: str, rng: np.random.Generator) -> None:
    """And the others are not affected."""
    a, b = matrices(rng, [42] * 4, 42)
    a[1, 30, 30], a[2, 0, 0] = -1.0, np.nan
    result, good = run(a, b, np.full(4, 42), True, device)
    assert good.tolist() == [1, 0, 0, 1]
    np.testing.assert_allclose(result[3], np.linalg.inv(a[3]), rtol=0, atol=1e-9 * np.abs(result[3]).max())
