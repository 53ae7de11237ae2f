"""Dense inverses and solutions of one environment by one block of threads, against NumPy."""

# pyright: reportInvalidTypeForm=false, reportArgumentType=false, reportIndexIssue=false, reportAssignmentType=false
# pyright: reportGeneralTypeIssues=false

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from ipc.arrays import FloatArray2d, FloatArray3d, IntArray
from ipc.solver.preconditioners.dense import PAIR, factor, invert, solve

DEVICES = [
    "cpu",
    pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")]),
]


@wp.kernel(enable_backward=False)
def inverses(a: FloatArray3d, y: FloatArray3d, size: IntArray, lanes: wp.int32, good: IntArray):
    """a⁻¹ in the place of a."""
    env, lane = wp.tid()
    if invert(a, y, env, size[env], lane, lanes):
        good[env] = 1


@wp.kernel(enable_backward=False)
def solutions(a: FloatArray3d, b: FloatArray2d, y: FloatArray2d, size: IntArray, lanes: wp.int32, good: IntArray):
    """a⁻¹ b in the place of b."""
    env, lane = wp.tid()
    if factor(a, env, size[env], lane, lanes):
        solve(a, b, y, env, size[env], lane, lanes)
        good[env] = 1


def run(a: np.ndarray, size: np.ndarray, device: str) -> tuple[np.ndarray, np.ndarray]:
    lanes = 256 if device == "cuda" else 1
    arrays = [wp.array(v, dtype=wp.float64, device=device) for v in (a, np.full_like(a, np.nan))]
    sizes, good = wp.array(size, dtype=wp.int32, device=device), wp.zeros(len(a), dtype=wp.int32, device=device)
    wp.launch(inverses, dim=(len(a), lanes), inputs=[*arrays, sizes, lanes, good], device=device, block_dim=256)
    return arrays[0].numpy(), good.numpy()


def matrices(rng: np.random.Generator, sizes: list[int], room: int) -> np.ndarray:
    """Positive definite matrices in the corners of larger arrays."""
    a = np.full((len(sizes), room, room), np.nan)
    for k, n in enumerate(sizes):
        root = rng.normal(size=(n, n))
        a[k, :n, :n] = root @ root.T + np.eye(n)
    return a


@pytest.mark.parametrize("device", DEVICES)
def test_inverses(device: str, rng: np.random.Generator) -> None:
    sizes = [PAIR, 2 * PAIR, 36, 60, 132, 600 if device == "cuda" else 240]
    a = matrices(rng, sizes, max(sizes))
    lower = np.tri(max(sizes), k=-1, dtype=bool)
    result, good = run(np.where(lower, np.nan, a), np.array(sizes), device)
    assert good.all()
    for k, n in enumerate(sizes):
        expected, part = np.linalg.inv(a[k, :n, :n]), result[k, :n, :n]
        np.testing.assert_allclose(part, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
        np.testing.assert_array_equal(part, part.T)


@pytest.mark.parametrize("device", DEVICES)
def test_solutions(device: str, rng: np.random.Generator) -> None:
    sizes = [PAIR, 5 * PAIR, 600 if device == "cuda" else 240]
    a, lanes = matrices(rng, sizes, max(sizes)), 256 if device == "cuda" else 1
    b = rng.normal(size=(len(sizes), max(sizes)))
    lower = np.tri(max(sizes), k=-1, dtype=bool)
    arrays = [wp.array(v, dtype=wp.float64, device=device) for v in (np.where(lower, np.nan, a), b, np.full_like(b, np.nan))]
    counts, good = wp.array(sizes, dtype=wp.int32, device=device), wp.zeros(len(a), dtype=wp.int32, device=device)
    wp.launch(solutions, dim=(len(a), lanes), inputs=[*arrays, counts, lanes, good], device=device, block_dim=256)
    assert good.numpy().all()
    for k, n in enumerate(sizes):
        expected = np.linalg.solve(a[k, :n, :n], b[k, :n])
        np.testing.assert_allclose(arrays[1].numpy()[k, :n], expected, rtol=0, atol=1e-9 * np.abs(expected).max())
        np.testing.assert_array_equal(arrays[1].numpy()[k, n:], b[k, n:])


@pytest.mark.parametrize("device", DEVICES)
def test_a_matrix_that_is_not_positive_is_refused(device: str, rng: np.random.Generator) -> None:
    """And the others are not affected."""
    a = matrices(rng, [48] * 4, 48)
    a[1, 30, 30], a[2, 0, 0] = -1.0, np.nan
    result, good = run(a, np.full(4, 48), device)
    assert good.tolist() == [1, 0, 0, 1]
    np.testing.assert_allclose(result[3], np.linalg.inv(a[3]), rtol=0, atol=1e-9 * np.abs(result[3]).max())
