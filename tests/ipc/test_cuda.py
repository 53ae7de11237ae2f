"""The same press on the CPU and on CUDA."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import ipc
from tests.ipc.conftest import bonded_pad, small_pad

pytestmark = pytest.mark.gpu


def press(device: str, num_envs: int) -> ipc.World:
    radius = 4e-3
    ball = ipc.KinematicBody("ball", ipc.icosphere(radius, 2), ipc.Pose((1e-4, 2e-4, radius + 1.2e-4)))
    settings = ipc.Settings(d_hat=1e-4, friction=0.5, velocity_tolerance=1e-9, linear_tolerance=1e-8)
    world = ipc.World([bonded_pad(small_pad()), ball], settings, num_envs=num_envs, device=device)
    depth = np.linspace(0.3e-3, 0.6e-3, 4)[:num_envs]
    for k in range(1, 7):
        move = np.stack([0 * depth, 0 * depth, -depth * k / 6], axis=1)
        world.set_target("ball", world._start.frame_position[:, 1] + move)
        report = world.step()
        assert report.converged.all() and not report.failed.any()
    return world


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")
def test_cuda_agrees_with_the_cpu() -> None:
    one, other = press("cpu", 4), press("cuda", 4)
    difference = np.abs(one.positions("pad") - other.positions("pad")).max()
    assert difference <= 1e-6 * one.d_hat, f"positions differ by {difference:.3g} m"


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")
def test_batch_on_cuda_equals_a_single_world() -> None:
    batch, single = press("cuda", 4), press("cuda", 1)
    difference = np.abs(batch.positions("pad")[0] - single.positions("pad")[0]).max()
    assert difference <= 1e-9, f"positions differ by {difference:.3g} m"


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")
def test_a_recorded_step_equals_single_launches_and_survives_growth() -> None:
    """One graph, the same kernels launched one by one, and buffers that must grow under a recording."""
    results = []
    for graph, room in ((True, None), (False, None), (True, 1)):
        ball = ipc.KinematicBody("ball", ipc.icosphere(4e-3, 2), ipc.Pose((1e-4, 2e-4, 4e-3 + 1.2e-4)))
        settings = ipc.Settings(d_hat=1e-4, friction=0.5, velocity_tolerance=1e-8, linear_tolerance=1e-8, graph=graph)
        world = ipc.World([bonded_pad(small_pad()), ball], settings, num_envs=3, device="cuda")
        if room:
            world._potential.collision._size_candidates(room, room)
            world._potential.collision._size_contacts(room, room)
        for k in range(5):
            world.set_target("ball", (1e-4, 2e-4, 4e-3 + 1.2e-4 - 1e-4 * (k + 1)))
            assert world.step().converged.all()
        results.append(world.positions("pad"))
    for other in results[1:]:
        difference = np.abs(results[0] - other).max()
        assert difference < 1e-9, f"positions differ by {difference:.3g} m"


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")
def test_deterministic_mode_gives_the_same_bits_again_and_in_a_batch() -> None:
    depth = np.linspace(0.3e-3, 0.6e-3, 4)

    def run(envs: list[int]) -> np.ndarray:
        ball = ipc.KinematicBody("ball", ipc.icosphere(4e-3, 2), ipc.Pose((1e-4, 2e-4, 4e-3 + 1.2e-4)))
        settings = ipc.Settings(d_hat=1e-4, friction=0.5, deterministic=True)
        world = ipc.World([bonded_pad(small_pad()), ball], settings, num_envs=len(envs), device="cuda")
        for k in range(1, 6):
            where = np.tile([1e-4, 2e-4, 4e-3 + 1.2e-4], (len(envs), 1))
            where[:, 2] -= depth[envs] * k / 5
            world.set_target("ball", where)
            assert world.step().converged.all()
        return world.positions("pad")

    batch = run([0, 1, 2, 3])
    assert np.array_equal(batch, run([0, 1, 2, 3]))
    for env in range(4):
        assert np.array_equal(batch[env], run([env])[0]), f"environment {env} differs from a world of its own"
