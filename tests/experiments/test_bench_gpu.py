"""The benchmark of MuJoCo Warp steps the scene that C MuJoCo steps."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco_warp")
from experiments.bench_gpu import FREQUENCY, PRESS, Args, Follow, Worlds, record, scene_of
from raytac.robots.impedance import JointImpedance
from raytac.world import TactileWorld

STEPS = 50


@pytest.mark.slow
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_a_cube_is_pushed_as_by_c_mujoco(device: str) -> None:
    """Pressed on, then dragged, in two worlds whose cubes lie differently: 0.5 mm, 3 % of the force, contact on the same steps."""
    args = Args(worlds=2)
    scene = scene_of(args)
    with TactileWorld(scene, outputs=(), num_envs=2) as world:
        joints, speeds = record(TactileWorld(scene, outputs=()))
        worlds = Worlds(world.composed, args, device, joints, speeds)
        for data, qpos in zip(world.data, worlds.engine.data.qpos.numpy(), strict=True):
            data.qpos[:] = qpos
        assert world.arm is not None
        springs = JointImpedance(world.arm, frequency=FREQUENCY).springs(world.data)
        cube, off, wrenches = world.composed.bodies["cube"].qpos, [], []
        for k in range(STEPS):
            springs.aim(joints[k][None], speeds[k][None], np.array([data.time for data in world.data]))
            wanted = world.step(Follow(springs)).wrench["sensor"]
            worlds.control_step()
            wrenches.append((wanted[:, :3], worlds.contact.wrenches.numpy()[:, 0, :3].copy()))
            at = np.array([data.qpos for data in world.data]) - worlds.engine.data.qpos.numpy()
            off.append(np.abs(at[:, cube : cube + 3]).max())
    worlds.engine.check_overflow()
    ours, found = (np.array(values) for values in zip(*wrenches, strict=True))
    assert max(off) < 0.5e-3
    assert np.linalg.norm(found - ours) < 0.03 * np.linalg.norm(ours)
    np.testing.assert_array_equal(found.any(axis=2), ours.any(axis=2))
    assert (-ours[PRESS + 5 :, :, 2] > 1.0).all() and np.abs(at[:, :7]).max() < 1e-3
