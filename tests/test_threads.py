"""Threads that launch kernels beside each other: none changes what another records or computes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import warp as wp

import ipc
from raytac.warp_runtime import Recorded
from tests.ipc.conftest import bonded_pad, small_pad

RADIUS = 4e-3
LONG = 20.0
"""No test waits so long [s]; what should happen in a thread has not, then."""


@wp.kernel
def count_launches(values: wp.array(dtype=wp.float64)):  # pyright: ignore[reportInvalidTypeForm]
    values[wp.tid()] += wp.float64(1.0)


def counter() -> tuple[wp.array, Callable[[], Any]]:
    """Numbers, and a launch that adds 1 to each."""
    values = wp.zeros(3, dtype=wp.float64, device="cpu")
    return values, partial(wp.launch, count_launches, dim=3, inputs=[values], device="cpu")


def counted() -> np.ndarray:
    """Numbers after a launch that is recorded and run."""
    values, launch = counter()
    Recorded(launch)()
    return values.numpy()


def soft_world() -> ipc.World:
    ball = ipc.KinematicBody("ball", ipc.icosphere(RADIUS, 2), ipc.Pose((0.0, 0.0, RADIUS + 1.2e-4)))
    settings = ipc.Settings(dt=0.01, d_hat=1e-4, friction=0.5)
    return ipc.World([bonded_pad(small_pad()), ball], settings, num_envs=2, device="cpu")


def pressed(world: ipc.World) -> np.ndarray:
    """Positions of the pad after steps of 0.1 mm."""
    start = world.frame("ball")[1]
    for k in range(1, 5):
        world.set_target("ball", start - [0.0, 0.0, 1e-4 * k])
        world.step()
    return world.positions("pad")


@pytest.mark.parametrize("work", [lambda: pressed(soft_world()), counted], ids=["soft world", "recording"])
def test_work_waits_for_another_threads_recording(work: Callable[[], np.ndarray]) -> None:
    """Else a soft step's loops become part of the recording, and do not run; and Warp refuses a second recording."""
    alone = work()
    recording, release = threading.Event(), threading.Event()
    values, launch = counter()
    recorded: list[Recorded] = []

    def record() -> None:
        recording.set()
        release.wait(LONG)
        launch()

    other = threading.Thread(target=lambda: recorded.append(Recorded(record)))
    other.start()
    threading.Timer(0.2, release.set).start()
    try:
        assert recording.wait(LONG)
        np.testing.assert_array_equal(work(), alone)
    finally:
        release.set()
        other.join()
    recorded[0]()
    np.testing.assert_array_equal(values.numpy(), np.ones(3))


def test_two_threads_build_and_step_soft_worlds() -> None:
    alone, results = pressed(soft_world()), []
    threads = [threading.Thread(target=lambda: results.append(pressed(soft_world()))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 2
    for result in results:
        np.testing.assert_array_equal(result, alone)
