"""The floating gripper: its mass lies where its joints are, wherever it stands."""

from __future__ import annotations

import mujoco
import numpy as np

from raytac.robots.gripper import floating_gripper


def lifted(position: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions while the frame is driven upwards, fingers down, and the inertia about the six joints (6,)."""
    model = floating_gripper(position=position, quaternion=(0.0, 1.0, 0.0, 0.0)).spec.compile()
    data, inertia = mujoco.MjData(model), np.zeros(6)
    data.ctrl[model.actuator("opening").id] = 0.03
    seen = []
    for step in range(200):
        data.ctrl[model.actuator("z").id] = 2e-4 * min(step, 50)
        mujoco.mj_step(model, data)
        seen.append(data.qpos.copy())
    for k in range(6):
        unit, found = np.eye(model.nv)[k], np.zeros(model.nv)
        mujoco.mj_mulM(model, data, found, unit)
        inertia[k] = found[k]
    return np.array(seen), inertia


def test_where_the_gripper_stands_does_not_change_how_it_moves():
    here, inertia = lifted((0.0, 0.0, 0.0))
    there, inertia_there = lifted((0.45, -0.2, 0.1))
    np.testing.assert_allclose(there, here, atol=1e-9)
    np.testing.assert_allclose(inertia_there, inertia, rtol=1e-9)
    assert here[-1, 2] > 9e-3 and np.abs(here[:, [0, 4]]).max() < 1e-9  # lifted, without pitching or going aside
