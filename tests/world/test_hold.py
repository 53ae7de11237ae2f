"""A world without a controller holds its robot, in all environments at once as in each alone."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.world import TactileWorld


@pytest.mark.parametrize("scene", ["ball_rolling", "lift_cube"])
def test_a_world_holds_as_its_controller_does(scene: str) -> None:
    """``hold`` of each environment by a call of its own; the arm starts off its target, so that the springs act."""
    worlds = [TactileWorld(scene, outputs=(), num_envs=2) for _ in range(3)]
    assert worlds[0].arm is not None
    joints = np.repeat(worlds[0].composed.start[worlds[0].arm.qpos][None], 2, axis=0)
    joints[1, 0] += 0.02
    for world in worlds:
        world.reset(joints=joints)
    for _ in range(3):
        states = [
            worlds[0].step(),
            worlds[1].step(worlds[1].hold),
            worlds[2].step(lambda data, time: worlds[2].hold(data, time)),
        ]
        for state, world in zip(states, worlds, strict=True):
            assert state.joints is not None and states[2].joints is not None
            np.testing.assert_allclose(state.joints, states[2].joints, atol=1e-12)
            assert state.joints[1, 0] < joints[1, 0] - 1e-4
            np.testing.assert_allclose([d.ctrl for d in world.data], [d.ctrl for d in worlds[2].data], rtol=1e-9, atol=1e-9)
    state, other = worlds[0].state(), worlds[0].state()
    for name, poses in state.world_from_body.items():
        body = worlds[0].composed.bodies[name].index
        np.testing.assert_array_equal(poses[:, :3, 3], [data.xpos[body] for data in worlds[0].data])
        np.testing.assert_array_equal(poses[:, :3, :3], [data.xmat[body].reshape(3, 3) for data in worlds[0].data])
    assert state.joints is not None and other.joints is not None and not np.shares_memory(state.joints, other.joints)
