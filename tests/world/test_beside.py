"""Contacts that are foreseen between a body and a case do not act while they stay open."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from raytac.world.world import TactileWorld
from tests.world.beside import HALF, OVER_THE_EDGE, POSES, SPEED, free_fall, scene


def falling(pose: Sequence[float], timestep: float) -> TactileWorld:
    world = TactileWorld(scene(timestep), outputs=(), num_envs=1)
    data = world.data[0]
    data.qpos[:], data.qvel[2] = pose, -SPEED
    return world


@pytest.mark.parametrize("timestep", [1e-3, 1e-2])
@pytest.mark.parametrize("pose", POSES.values(), ids=POSES)
def test_a_box_falls_freely_beside_a_case(pose: Sequence[float], timestep: float) -> None:
    world = falling(pose, timestep)
    for k in range(6):
        world.step(np.zeros(0))
        np.testing.assert_allclose(world.data[0].qvel, free_fall(0.01 * (k + 1)), atol=1e-9)
    assert world.data[0].qpos[2] < -HALF  # it went by


@pytest.mark.parametrize("timestep", [1e-3, 1e-2])
def test_a_box_over_the_edge_of_a_case_lands_on_it(timestep: float) -> None:
    world = falling(OVER_THE_EDGE, timestep)
    for _ in range(2):
        world.step(np.zeros(0))
    velocity = world.data[0].qvel
    # Its edge stands on the case's, and it turns about it.
    assert abs(velocity[2] + HALF * velocity[4]) < 0.25 * SPEED and abs(velocity[4]) > 5.0
