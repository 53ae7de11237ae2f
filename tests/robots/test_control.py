"""Inverse kinematics and impedance control of the Panda."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from raytac.errors import InputError
from raytac.robots.arm import Arm
from raytac.robots.ik import DifferentialIk
from raytac.robots.impedance import CartesianImpedance, JointImpedance
from raytac.robots.panda import MAX_VELOCITY, READY
from raytac.se3 import pose_error
from tests.robots.conftest import HIGH, LOW, Rig, flange_pose


def pad_pose(q: np.ndarray) -> np.ndarray:
    """world_from_pad of the one-sensor arm by the published chain alone."""
    return flange_pose(q) @ np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.0293], [0, 0, 0, 1.0]])


def test_reach_finds_random_reachable_poses_within_the_limits(one: Rig):
    ik = DifferentialIk(one.arm, max_velocity=np.array(MAX_VELOCITY))
    for q in np.random.default_rng(0).uniform(LOW, HIGH, (40, 7)):
        target = pad_pose(q)
        found = ik.reach(one.data.qpos, target)
        error = pose_error(target, pad_pose(found.joints))
        assert found.reached
        assert np.linalg.norm(error[:3]) <= 1e-4 and np.linalg.norm(error[3:]) <= 1e-3
        assert (found.joints >= LOW).all() and (found.joints <= HIGH).all()


def test_reach_says_so_when_a_pose_is_out_of_reach(one: Rig):
    target = pad_pose(np.array(READY))
    target[0, 3] = 2.0
    found = DifferentialIk(one.arm).reach(one.data.qpos, target, steps=30, restarts=2)
    assert not found.reached and found.position_error > 0.5
    assert (found.joints >= LOW).all() and (found.joints <= HIGH).all()


def test_velocities_keep_to_position_and_speed_limits(one: Rig):
    """A far target, from the ready position to a corner: every step binds some limit, and none is passed."""
    limit = np.array(MAX_VELOCITY)
    ik, q, dt = DifferentialIk(one.arm, max_velocity=limit), np.array(READY), 0.02
    target = pad_pose(np.array([2.8, 1.7, 2.8, -0.1, 2.8, 3.7, 2.8]))
    bound = False
    for _ in range(300):
        velocity = ik.velocity(q, target, dt)
        assert (np.abs(velocity) <= limit + 1e-6).all()
        bound |= bool((np.abs(velocity) > limit - 1e-6).any())
        q = q + dt * velocity
        assert (q >= LOW - 1e-9).all() and (q <= HIGH + 1e-9).all()
    assert bound


def test_a_joint_beyond_its_range_is_brought_back(one: Rig):
    q = np.array(READY)
    q[3] = HIGH[3] + 0.01
    velocity = DifferentialIk(one.arm, max_velocity=1.0).velocity(q, pad_pose(q), 0.005)
    assert velocity[3] == pytest.approx(-1.0, abs=1e-6)  # 0.01 rad back would take 0.01 s


def test_a_redundant_arm_leans_to_its_posture_without_leaving_the_pose(one: Rig):
    posture = np.array(READY) + np.eye(7)[0] * 0.3
    ik = DifferentialIk(one.arm, posture=posture, posture_weight=1e-2)
    q, target = np.array(READY), pad_pose(np.array(READY))
    for _ in range(300):
        q = q + 0.02 * ik.velocity(q, target, 0.02)
    error = pose_error(target, pad_pose(q))
    assert np.linalg.norm(error[:3]) < 2e-4 and np.linalg.norm(error[3:]) < 1e-3
    assert np.linalg.norm(q - posture) < np.linalg.norm(np.array(READY) - posture) - 0.01


def test_other_joints_of_the_scene_stay_and_do_not_hinder(two: Rig):
    """The fingers lie a little beyond their stops, as soft limits leave them."""
    q = two.data.qpos.copy()
    q[7:] = 0.0401
    target = two.arm.world_from_site(two.data)
    target[:3, 3] += 0.05
    found = DifferentialIk(two.arm).reach(q, target)
    assert found.reached and found.joints.shape == (7,)


def test_joint_impedance_carries_out_the_velocities(one: Rig):
    """A line of 10 cm in one second, followed to a millimetre."""
    ik = DifferentialIk(one.arm, max_velocity=np.array(MAX_VELOCITY), posture=np.array(READY))
    servo = JointImpedance(one.arm, frequency=60.0)
    start, dt = one.arm.world_from_site(one.data), one.model.opt.timestep
    goal, worst = np.array(READY), 0.0
    for i in range(600):
        target = start.copy()
        target[:3, 3] += np.array([0.0, 0.1, 0.0]) * min(i * dt / 0.5, 1.0)
        full = one.data.qpos.copy()
        full[one.arm.qpos] = goal
        velocity = ik.velocity(full, target, dt)
        goal = goal + dt * velocity
        one.run(1, lambda goal=goal, velocity=velocity: servo.torque(one.data, goal, velocity).torque)
        worst = max(worst, float(np.linalg.norm(one.arm.world_from_site(one.data)[:3, 3] - target[:3, 3])))
    assert worst < 2e-3
    np.testing.assert_allclose(one.arm.world_from_site(one.data), target, atol=1e-4)


def test_an_impedance_is_a_spring(one: Rig):
    """At rest K e balances what pulls: 5 N on 500 N/m is 10 mm, 0.5 N·m on 50 N·m/rad is 0.01 rad; to 0.3 %."""
    target = one.arm.world_from_site(one.data)
    law = CartesianImpedance(one.arm, stiffness=500.0, rotational_stiffness=50.0, posture=np.array(READY))
    body = one.model.body(one.robot.sensors[0].body).id
    lever = target[:3, 3] - one.data.xipos[body]
    for force, moment in (((3.0, 0.0, 4.0), (0.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (0.3, 0.4, 0.0))):
        one.place(np.array(READY))
        # At the site, not at the centre of mass, where xfrc_applied acts.
        one.data.xfrc_applied[body] = [*force, *(np.array(moment) + np.cross(lever, force))]
        one.run(2000, lambda: law.torque(one.data, target).torque)
        error = pose_error(one.arm.world_from_site(one.data), target)
        np.testing.assert_allclose(error[:3], np.array(force) / 500.0, atol=3e-5)
        np.testing.assert_allclose(error[3:], np.array(moment) / 50.0, atol=3e-5)
        assert np.abs(one.data.qvel).max() < 1e-6


def test_an_impedance_gives_the_wrench_that_is_asked_for(one: Rig):
    """Without springs and at rest the torques are J^T w and gravity, and the null space is left alone."""
    law = CartesianImpedance(one.arm, stiffness=0.0, rotational_stiffness=0.0)
    wrench = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3])
    got = law.torque(one.data, one.arm.world_from_site(one.data), wrench).torque - one.arm.bias(one.data)
    np.testing.assert_allclose(got, one.arm.jacobian(one.data).T @ wrench, atol=1e-9)


def test_an_impedance_does_not_overshoot(one: Rig):
    """Damping ratio 1 in every mode of (Λ, K): a step of 5 cm is approached from one side."""
    target = one.arm.world_from_site(one.data)
    target[2, 3] += 0.05
    law = CartesianImpedance(one.arm, posture=np.array(READY))
    heights = []

    def torque() -> np.ndarray:
        heights.append(one.arm.world_from_site(one.data)[2, 3])
        return law.torque(one.data, target).torque

    one.run(1500, torque)
    assert heights[-1] == pytest.approx(target[2, 3], abs=2e-4)
    assert max(heights) < target[2, 3] + 5e-4


def test_posture_torques_do_not_accelerate_the_site(one: Rig):
    target, q = one.arm.world_from_site(one.data), np.array(READY)
    free = CartesianImpedance(one.arm)
    leaning = CartesianImpedance(one.arm, posture=q + 0.3 * (np.eye(7)[0] - np.eye(7)[2]))
    extra = leaning.torque(one.data, target).torque - free.torque(one.data, target).torque
    jacobian, mass = one.arm.jacobian(one.data), one.arm.mass_matrix(one.data)
    moved = np.linalg.norm(jacobian @ np.linalg.solve(mass, extra))
    assert np.linalg.norm(extra) > 0.1
    assert moved < 0.02 * np.linalg.norm(np.linalg.solve(mass, extra))


def test_saturation_is_told(one: Rig):
    target = one.arm.world_from_site(one.data)
    law = CartesianImpedance(one.arm)
    assert not law.torque(one.data, target).saturated.any()
    assert law.torque(one.data, target, np.array([0.0, 0.0, 500.0, 0.0, 0.0, 0.0])).saturated.any()


def test_the_jacobian_is_the_slope_of_the_pose(one: Rig):
    q = np.random.default_rng(4).uniform(LOW, HIGH)
    one.place(q)
    h = 1e-6
    slope = np.stack([pose_error(pad_pose(q + s), pad_pose(q - s)) / (2 * h) for s in h * np.eye(7)], axis=1)
    np.testing.assert_allclose(one.arm.jacobian(one.data), slope, atol=1e-7)
    assert np.linalg.norm(slope) > 1.0


def test_bad_input_is_refused(one: Rig):
    model, data, arm = one.model, one.data, one.arm
    target, nan = arm.world_from_site(data), np.full(7, np.nan)
    with pytest.raises(InputError, match=r"site = 'flagne'.*did you mean 'flange'"):
        Arm(model, "flagne", one.robot.joints)
    with pytest.raises(InputError, match=r"joints = 'joint8'.*choose from: joint1"):
        Arm(model, "flange", ["joint8"])
    for joints in ([], ["joint1", "joint1"]):
        with pytest.raises(InputError, match="none twice"):
            Arm(model, "flange", joints)
    loose = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="a"><freejoint name="f"/><geom size=".1"/><site name="s"/></body>'
        '<body name="b"><joint name="h"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(InputError, match="joints = 'f': must be a hinge or a slide"):
        Arm(loose, "s", ["f"])
    with pytest.raises(InputError, match="joints = 'h': must carry the site 's'"):
        Arm(loose, "s", ["h"])
    with pytest.raises(InputError, match="torque = "):
        arm.drive(data, nan)
    ik = DifferentialIk(arm)
    with pytest.raises(InputError, match="duration = 0"):
        ik.velocity(data.qpos, target, 0.0)
    with pytest.raises(InputError, match="qpos = "):
        ik.velocity(nan, target, 0.01)
    with pytest.raises(InputError, match="world_from_target = "):
        ik.velocity(data.qpos, np.zeros((4, 4)), 0.01)
    with pytest.raises(InputError, match=r"posture\[3\] = 1.0: must be within joint4's \[-3.0718, -0.0698\]"):
        DifferentialIk(arm, posture=np.ones(7))
    with pytest.raises(InputError, match="max_velocity = "):
        DifferentialIk(arm, max_velocity=0.0)
    with pytest.raises(InputError, match="damping = -1"):
        DifferentialIk(arm, damping=-1.0)
    with pytest.raises(InputError, match="stiffness = -1"):
        CartesianImpedance(arm, stiffness=-1.0)
    with pytest.raises(InputError, match="wrench = "):
        CartesianImpedance(arm).torque(data, target, np.ones(3))
    with pytest.raises(InputError, match="frequency = nan"):
        JointImpedance(arm, frequency=np.nan)
    with pytest.raises(InputError, match="joints = "):
        JointImpedance(arm).torque(data, nan)


def test_an_arm_without_torque_motors_cannot_be_driven():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="j"/><geom size=".1"/><site name="s"/></body></worldbody>'
        '<actuator><position joint="j" kp="10"/></actuator></mujoco>'
    )
    arm = Arm(model, "s", ["j"])
    assert arm.motors is None and arm.torque_limit is None
    with pytest.raises(InputError, match="must all have a torque motor"):
        arm.drive(mujoco.MjData(model), np.zeros(1))
