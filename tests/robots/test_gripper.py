"""The floating gripper: its mass lies where its joints are, wherever it stands."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from raytac.robots.gripper import GripperSettings, floating_gripper
from raytac.robots.panda import two_finger_panda


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


def test_mechanics_are_settings() -> None:
    settings = GripperSettings(mass=0.7, opening=0.06, finger_mass=0.03, servo=(2e4, 100.0, 50.0))
    model, plain = (floating_gripper(settings=one).spec.compile() for one in (settings, None))
    assert model.body("gripper").mass[0] == 0.7 and plain.body("gripper").mass[0] == GripperSettings().mass == 0.5
    assert model.body("left_finger").mass[0] - plain.body("left_finger").mass[0] == pytest.approx(0.01)
    opening = model.actuator("opening")
    assert (
        opening.ctrlrange.tolist() == [0.0, 0.06] and opening.forcerange.tolist() == [-50.0, 50.0] and opening.gainprm[0] == 2e4
    )


@pytest.mark.parametrize("make", [floating_gripper, two_finger_panda])
def test_an_opening_that_is_driven_at_10_ms_follows_its_target(make) -> None:
    robot = make("gelsight_mini")
    robot.spec.option.timestep, robot.spec.option.integrator = 0.01, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    robot.spec.option.gravity = (0.0, 0.0, 0.0)
    model = robot.spec.compile()
    data, opening = mujoco.MjData(model), model.actuator(robot.opening).id
    fastest = 0.0
    for target in (0.05, 0.02, 0.08, 0.049):
        data.ctrl[opening] = target
        for _ in range(100):
            mujoco.mj_step(model, data)
            fastest = max(fastest, abs(float(data.actuator_velocity[opening])))
        assert data.actuator_length[opening] == pytest.approx(target, abs=2e-4)
    assert fastest < 1.0  # the bound of force, 70 N, over the damping, 100 N s/m, and what the step adds
