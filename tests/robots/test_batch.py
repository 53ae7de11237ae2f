"""Arms of many states at once: numbers of MuJoCo's states, springs, inverse kinematics and differences of poses, by kernels."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from raytac.errors import InputError
from raytac.robots.arm import Arm
from raytac.robots.frames import body_poses, site_poses
from raytac.robots.ik import PoseServo
from raytac.robots.impedance import JointImpedance
from raytac.robots.panda import MAX_VELOCITY, READY, two_finger_panda
from raytac.robots.pose_errors import PoseErrors
from raytac.robots.states import NumberWriter, StateReader, body_pose, numbers, site_pose
from raytac.se3 import pose_error, rotations

MIXED = """<mujoco><worldbody><body name="a"><joint name="h" axis="0 1 0.2"/><geom size=".1" pos=".2 0 .1"/>
<body name="b" pos=".3 0 0" quat=".9 .1 .3 0"><joint name="s" type="slide" axis="1 0 0.3"/><geom size=".1"/>
<body name="c" pos=".1 .2 0"><joint name="t" axis="0 0 1"/><geom size=".05" pos="0 .1 0"/><site name="tip" pos="0 .2 .1"/></body>
<body name="d"><joint name="u" axis="1 0 0"/><geom size=".05" pos="0 0 .1"/></body></body></body></worldbody>
<actuator><motor name="h" joint="h"/><motor name="s" joint="s"/>
<position name="u" joint="u"/><motor name="t" joint="t"/></actuator></mujoco>"""
"""A hinge, a slide and a hinge that carry a site, and another joint on a branch of its own."""


def panda(count: int) -> tuple[Arm, list[mujoco.MjData]]:
    robot = two_finger_panda()
    model = robot.spec.compile()
    return _moving(Arm(model, robot.site, robot.joints), np.array(READY), count)


def mixed(count: int) -> tuple[Arm, list[mujoco.MjData]]:
    return _moving(Arm(mujoco.MjModel.from_xml_string(MIXED), "tip", ["h", "s", "t"]), np.zeros(3), count)


def _moving(arm: Arm, start: np.ndarray, count: int) -> tuple[Arm, list[mujoco.MjData]]:
    """States about ``start``, random and fast, as ``mj_step1`` leaves them."""
    rng, datas = np.random.default_rng(0), [mujoco.MjData(arm.model) for _ in range(count)]
    for data in datas:
        data.qpos[:] = rng.normal(0.0, 0.02, arm.model.nq)
        data.qpos[arm.qpos] = start + rng.normal(0.0, 0.3, len(arm))
        data.qvel[:] = rng.normal(0.0, 1.0, arm.model.nv)
        mujoco.mj_step1(arm.model, data)
    return arm, datas


def test_numbers_are_those_that_mujoco_has_now() -> None:
    arm, datas = panda(3)
    site, body = arm.site, arm.model.body("hand/hand").id
    reader = StateReader(
        datas,
        {
            "q": numbers("qpos", np.array([[2, 0], [-1, 1]])),
            "site": site_pose(site),
            "body": body_pose(body),
            "sites": site_pose(np.array([site, 0])),
            "bodies": body_pose(np.array([0, body])),
            "none": numbers("qpos", np.zeros(0)),
            "time": numbers("time", np.array(0)),
        },
    )
    assert reader.reads(datas) and not reader.reads(datas[:2]) and not reader.reads([datas[0], datas[0], datas[2]])
    for _ in range(2):
        now = reader.values()
        np.testing.assert_array_equal(now["q"], [[[d.qpos[2], d.qpos[0]], [0.0, d.qpos[1]]] for d in datas])
        np.testing.assert_array_equal(now["time"], [data.time for data in datas])
        np.testing.assert_array_equal(now["site"], site_poses(datas, site))
        np.testing.assert_array_equal(now["body"], body_poses(datas, body))
        np.testing.assert_array_equal(now["sites"], site_poses(datas, np.array([site, 0])))
        np.testing.assert_array_equal(now["bodies"], body_poses(datas, np.array([0, body])))
        assert now["none"].shape == (3, 0)
        for data in datas:
            mujoco.mj_step(arm.model, data)
            data.time *= 1.1
    assert not np.array_equal(now["site"], reader.values()["site"]), "the states have moved"
    for wrong in (
        numbers("qpos", np.array([arm.model.nq])),
        numbers("efc_type", np.zeros(1, int)),
        numbers("contact", np.zeros(1, int)),
    ):
        with pytest.raises(InputError, match=r"numbers = .*must be of float64 members"):
            StateReader(datas, {"wrong": wrong})


def test_controls_are_written_for_those_that_are_named_and_none_that_are_not_finite() -> None:
    _, datas = mixed(3)
    writer = NumberWriter(datas, "ctrl", [3, 0])
    writer.array.numpy()[:] = np.arange(6.0).reshape(3, 2) + 1.0
    assert writer.write(np.array([0, 2])) is None
    assert [data.ctrl.tolist() for data in datas] == [[2.0, 0, 0, 1.0], [0, 0, 0, 0], [6.0, 0, 0, 5.0]]
    writer.array.numpy()[1] = np.nan
    wrong = writer.write([0, 1, 2])
    assert wrong is not None and np.isnan(wrong).all() and (datas[1].ctrl == 0.0).all()
    assert writer.write([2]) is None, "the first two are not asked for"


@pytest.mark.parametrize("make", [panda, mixed])
def test_springs_are_those_of_mujocos_inertia(make) -> None:
    """τ = M q̈ + C q̇ + g, with M q̈ by MuJoCo's own product."""
    arm, datas = make(5)
    rng = np.random.default_rng(1)
    joints, velocity = rng.normal(0.0, 1.0, (2, 5, len(arm)))
    law = JointImpedance(arm, frequency=20.0, damping_ratio=0.7)
    expected = []
    for data, target, speed in zip(datas, joints, velocity, strict=True):
        acceleration, product = np.zeros(arm.model.nv), np.zeros(arm.model.nv)
        acceleration[arm.dof] = 400.0 * (target - data.qpos[arm.qpos]) + 28.0 * (speed - data.qvel[arm.dof])
        mujoco.mj_mulM(arm.model, data, product, acceleration)
        expected.append((product + data.qfrc_bias)[arm.dof])
    torque = law.torques(datas, joints, velocity).torque
    np.testing.assert_allclose(torque, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(law.torque(datas[3], joints[3], velocity[3]).torque, torque[3])
    assert np.abs(torque).min() > 0.0 and law.torques(datas, joints).torque[0, 0] != torque[0, 0]


def test_driven_springs_follow_a_target_that_moves() -> None:
    arm, datas = mixed(2)
    assert arm.motors is not None
    joints, speed = np.random.default_rng(2).normal(0.0, 1.0, (2, 2, 3))
    law = JointImpedance(arm)
    springs = law.springs(datas, [2])
    springs.aim(joints, speed, np.array([-0.1, 0.0]), np.array([[0.3], [0.4]]))
    datas[1].time = 0.2
    springs.drive([0, 1])
    for b, (later, other) in enumerate([(0.1, 0.3), (0.2, 0.4)]):
        expected = law.torque(datas[b], joints[b] + later * speed[b], speed[b]).torque
        np.testing.assert_allclose(datas[b].ctrl[arm.motors], expected, rtol=1e-12)
        assert datas[b].ctrl[2] == other
    datas[1].qvel[0] = np.nan
    before = datas[0].ctrl.copy()
    with pytest.raises(InputError, match=r"torque = .*nan.*must be 4 finite numbers"):
        springs.drive([0, 1])
    np.testing.assert_array_equal(datas[0].ctrl, before)
    springs.drive([0])  # the other has failed


@pytest.mark.parametrize(("make", "damping"), [(panda, 0.02), (mixed, 0.1)])
def test_the_servo_is_damped_least_squares(make, damping: float) -> None:
    """By NumPy's solver and MuJoCo's Jacobian."""
    arm, datas = make(6)
    rng, n, duration = np.random.default_rng(3), len(arm), 0.02
    fastest, posture = np.full(n, 2.0), rng.normal(0.0, 0.1, n)
    target = site_poses(datas, arm.site)
    target[:, :3, 3] += rng.normal(0.0, 0.01, (6, 3))
    target[:, :3, :3] = rotations(rng.normal(0.0, 0.02, (6, 3))) @ target[:, :3, :3]
    twist = rng.normal(0.0, 0.3, (6, 6))
    step, velocity = [], []
    for data, pose, speed in zip(datas, target, twist, strict=True):
        jacobian, q = arm.jacobian(data), data.qpos[arm.qpos]
        gram = jacobian @ jacobian.T + damping**2 * np.eye(6)
        back = 0.1 * (posture - q)
        moved = back + jacobian.T @ np.linalg.solve(gram, pose_error(pose, site_poses([data], arm.site)[0]) - jacobian @ back)
        moving = jacobian.T @ np.linalg.solve(gram, speed)
        moved /= max(np.abs(moved).max() / (2.0 * duration), 1.0)
        step.append(np.clip(q + moved, arm.range[:, 0], arm.range[:, 1]))
        velocity.append(moving / max(np.abs(moving).max() / 2.0, 1.0))
    servo = PoseServo(arm, max_velocity=fastest, posture=posture, damping=damping)
    found = servo.targets(datas, target, twist, duration)
    np.testing.assert_allclose(found[0], step, atol=1e-11)
    np.testing.assert_allclose(found[1], velocity, atol=1e-11)
    alone = servo.targets(datas[4:5], target[4:5], twist[4:5], duration)
    np.testing.assert_array_equal([alone[0][0], alone[1][0]], [found[0][4], found[1][4]])


def test_the_servo_needs_no_more_than_kinematics() -> None:
    """After ``mj_kinematics`` alone, as a world's step ends, the Jacobian is that of the present joints."""
    arm, (moved, fresh) = panda(2)
    servo = PoseServo(arm, max_velocity=np.array(MAX_VELOCITY), posture=np.array(READY))
    fresh.qpos[:] = moved.qpos[:] = moved.qpos + 0.05
    mujoco.mj_kinematics(arm.model, moved)
    mujoco.mj_forward(arm.model, fresh)
    target, twist = site_poses([fresh], arm.site), np.full((1, 6), 0.05)
    velocities = [servo.targets([data], target, twist, 0.02)[1] for data in (moved, fresh)]
    np.testing.assert_array_equal(velocities[0], velocities[1])


def test_differences_of_poses_are_those_of_se3() -> None:
    """At turns of any size, half a turn about each axis among them."""
    rng = np.random.default_rng(4)
    vectors = rng.normal(0.0, 1.5, (40, 3))
    vectors[:3], vectors[3:6], vectors[6] = np.pi * np.eye(3), 1e-9 * np.eye(3), 0.0
    a = np.repeat(np.eye(4)[None], 40, axis=0)
    a[:, :3, :3], a[:, :3, 3] = rotations(vectors), rng.normal(0.0, 1.0, (40, 3))
    b = a[::-1].copy()
    errors = PoseErrors(40, 2)
    found = errors((a, b), (a, np.eye(4)))
    np.testing.assert_allclose(found, [pose_error(a, b), pose_error(a, np.eye(4))], atol=1e-14)
    assert np.linalg.norm(found[1, :3, 3:], axis=1) == pytest.approx(np.pi)
