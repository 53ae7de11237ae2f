"""The Panda against its published tables, and against what a real one reported."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from raytac.assets import asset_root
from raytac.errors import InputError
from raytac.robots.arm import Arm
from raytac.robots.panda import JOINTS, MAX_TORQUE, READY, one_sensor_panda, two_finger_panda
from tests.robots.conftest import (
    BASE_MASS,
    HIGH,
    LINKS,
    LOW,
    REAL_Q,
    REAL_TCP,
    REAL_TORQUE,
    Rig,
    flange_pose,
    link_poses,
    potential_energy,
)


def bare_arm() -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_path(str(asset_root("scenes") / "robots" / "panda.xml"))
    return model, mujoco.MjData(model)


def arm_with_hand() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """As delivered: the hand with its own finger tips, turned by −45° on the flange."""
    folder = asset_root("scenes") / "robots"
    spec = mujoco.MjSpec.from_file(str(folder / "panda.xml"))
    frame = spec.body("link7").add_frame(pos=(0, 0, 0.107), quat=(np.cos(np.pi / 8), 0, 0, -np.sin(np.pi / 8)))
    spec.attach(mujoco.MjSpec.from_file(str(folder / "panda_hand.xml")), prefix="hand/", frame=frame)
    model = spec.compile()
    return model, mujoco.MjData(model)


def test_forward_kinematics_is_the_published_chain():
    model, data = bare_arm()
    rng = np.random.default_rng(0)
    for q in [np.zeros(7), np.array(READY), LOW, HIGH, *rng.uniform(LOW, HIGH, (50, 7))]:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for i, expected in enumerate(link_poses(q), start=1):
            body = data.body(f"link{i}")
            np.testing.assert_allclose(body.xpos, expected[:3, 3], atol=1e-9)
            np.testing.assert_allclose(body.xmat.reshape(3, 3), expected[:3, :3], atol=1e-9)
        flange = flange_pose(q)
        np.testing.assert_allclose(data.site("flange").xpos, flange[:3, 3], atol=1e-9)
        np.testing.assert_allclose(data.site("flange").xmat.reshape(3, 3), flange[:3, :3], atol=1e-9)


def test_a_real_arm_reported_this_pose_and_these_torques():
    model, data = arm_with_hand()
    data.qpos[:7] = REAL_Q
    mujoco.mj_forward(model, data)
    tcp = data.site("hand/tcp")
    np.testing.assert_allclose(tcp.xpos, REAL_TCP[:3, 3], atol=2e-6)  # printed to 1 µm
    np.testing.assert_allclose(tcp.xmat.reshape(3, 3), REAL_TCP[:3, :3], atol=2e-5)  # the report's columns are 1e-5 short
    # The robot itself put 0.7 N·m of joint 2 and 0.4 N·m of joint 3 down to something outside (tau_ext_hat_filtered).
    np.testing.assert_allclose(data.qfrc_bias[:7], REAL_TORQUE, atol=0.7)
    assert abs(data.qfrc_bias[3]) > 20.0


def test_joint_limits_and_motors_are_the_published_ones():
    model, _ = bare_arm()
    arm = Arm(model, "flange", JOINTS)
    np.testing.assert_array_equal(arm.range, np.stack([LOW, HIGH], axis=1))
    assert arm.torque_limit is not None
    np.testing.assert_array_equal(arm.torque_limit, np.stack([-np.array(MAX_TORQUE), MAX_TORQUE], axis=1))


def test_masses_are_the_published_ones():
    model, _ = bare_arm()
    assert model.body_mass.sum() == pytest.approx(BASE_MASS + sum(mass for mass, _ in LINKS), abs=1e-12)
    assert arm_with_hand()[0].body_mass.sum() == pytest.approx(model.body_mass.sum() + 0.73 + 2 * 0.015, abs=1e-12)
    # Inertias of a body that can exist: each principal moment at most the sum of the others.
    for inertia in model.body_inertia[1:]:
        assert inertia.min() > 0.0 and 2 * inertia.max() <= inertia.sum()


def test_gravity_torque_is_the_slope_of_the_potential_energy():
    model, data = bare_arm()
    rng, h = np.random.default_rng(1), 1e-5
    for q in rng.uniform(LOW, HIGH, (10, 7)):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        gravity = -model.opt.gravity[2]
        slope = [(potential_energy(q + step, gravity) - potential_energy(q - step, gravity)) / (2 * h) for step in h * np.eye(7)]
        np.testing.assert_allclose(data.qfrc_bias, slope, atol=1e-7)
        assert np.linalg.norm(slope) > 1.0


@pytest.mark.parametrize(
    ("q2", "torque"),
    [
        (0.0, (0.0, -3.4819, 0.0, -3.2061, 0.0, 1.6859, 0.0)),
        (np.pi / 2, (0.0, -46.6145, 0.9897, 16.1886, 0.7604, -0.6640, -0.0048)),
    ],
)
def test_gravity_torque_is_near_the_identified_coefficients(q2, torque):
    """Gaz et al. publish g(q) by dynamic coefficients too, fitted before the masses were retrieved from them; g = 9.80665 m/s²."""
    model, data = bare_arm()
    model.opt.gravity[2] = -9.80665
    data.qpos[1] = q2
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qfrc_bias, torque, atol=0.08)


def test_gravity_compensation_holds_the_arm_still(one: Rig, two: Rig):
    for rig in (one, two):
        rig.run(500, lambda rig=rig: rig.arm.bias(rig.data))
        np.testing.assert_allclose(rig.data.qpos[rig.arm.qpos], READY, atol=1e-6)
        rig.place(np.array(READY))
        rig.run(100, lambda: np.zeros(7))
        assert np.abs(rig.data.qpos[rig.arm.qpos] - READY).max() > 0.01  # without it, the arm falls


def test_an_unforced_arm_keeps_its_energy(one: Rig):
    one.model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    one.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    one.model.dof_damping[:] = 0.0
    one.place(np.array(READY))
    start = one.data.energy.sum()
    for _ in range(75):
        mujoco.mj_step(one.model, one.data)
        assert one.data.nefc == 0  # no joint at its stop
    assert one.data.energy[1] > 1.0  # it moves
    assert one.data.energy.sum() == pytest.approx(start, abs=1e-4)


def test_the_sensor_stands_on_the_flange(one: Rig):
    """The case's back is on the flange: 28.5 mm floor, 0.8 mm back; axes parallel."""
    expected = flange_pose(np.array(READY)) @ np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.0293], [0, 0, 0, 1.0]])
    (sensor,) = one.robot.sensors
    np.testing.assert_allclose(sensor.world_from_pad(one.data), expected, atol=1e-9)
    np.testing.assert_allclose(one.arm.world_from_site(one.data), expected, atol=1e-9)


@pytest.mark.parametrize("opening", [0.0, 0.01, 0.04])
def test_finger_pads_face_each_other_at_the_joints_distance(two: Rig, opening):
    two.data.qpos[[two.model.joint(f"hand/finger_joint{i}").qposadr[0] for i in (1, 2)]] = opening
    mujoco.mj_kinematics(two.model, two.data)
    left, right = (sensor.world_from_pad(two.data) for sensor in two.robot.sensors)
    np.testing.assert_allclose(left[:3, 2], -right[:3, 2], atol=1e-12)
    np.testing.assert_allclose(right[:3, 3] - left[:3, 3], 2 * opening * left[:3, 2], atol=1e-12)
    middle = two.data.site(two.robot.site)
    np.testing.assert_allclose((left[:3, 3] + right[:3, 3]) / 2, middle.xpos, atol=1e-12)
    # Image down (+y) is towards the end of the finger.
    np.testing.assert_allclose(left[:3, 1], middle.xmat.reshape(3, 3)[:, 2], atol=1e-12)


def test_the_opening_servo_opens_and_squeezes(two: Rig):
    assert two.robot.opening is not None
    servo = two.model.actuator(two.robot.opening).id
    two.data.ctrl[servo] = 0.06
    two.run(600, lambda: two.arm.bias(two.data))
    fingers = [two.data.joint(f"hand/finger_joint{i}").qpos[0] for i in (1, 2)]
    np.testing.assert_allclose(fingers, 0.03, atol=2e-4)
    assert abs(two.data.actuator_force[servo]) <= 70.0


def test_only_touching_things_touch_in_ordinary_poses(one: Rig, two: Rig):
    for rig in (one, two):
        for joints in (READY, (0, 0, 0, -1.5707, 0, 1.5707, -0.7853), REAL_Q):
            rig.place(np.array(joints))
            rig.data.qpos[7:] = 0.02
            mujoco.mj_forward(rig.model, rig.data)
            assert rig.data.ncon == 0


def test_an_arm_folded_into_its_base_collides(one: Rig):
    one.place(np.array([0.0, -1.2, 0.0, -3.0, 0.0, 0.5, 0.0]))
    bodies = {one.model.body(one.model.geom(g).bodyid[0]).name for c in one.data.contact for g in (c.geom1, c.geom2)}
    assert bodies & {"link5", "link6", "link7", "sensor_body"} and bodies & {"link0", "link1", "link2"}


def stand_in(folder: Path, *, hand: bool) -> Path:
    """A file with the names and actuators of the menagerie's Panda, on the same DH frames."""
    text, end = "", ""
    for i, (pos, quat) in enumerate(
        zip(
            ("0 0 .333", "0 0 0", "0 -.316 0", ".0825 0 0", "-.0825 .384 0", "0 0 0", ".088 0 0"),
            ("1 0 0 0", "1 -1 0 0", "1 1 0 0", "1 1 0 0", "1 -1 0 0", "1 1 0 0", "1 1 0 0"),
            strict=True,
        ),
        start=1,
    ):
        text += f'<body name="link{i}" pos="{pos}" quat="{quat}"><joint name="joint{i}" axis="0 0 1" range="-2.9 2.9"/>'
        text += '<geom size=".03" contype="0" conaffinity="0"/>'
        end += "</body>"
    fingers = "".join(
        f'<body name="{side}_finger" pos="0 0 .0584" quat="{quat}"><geom size=".005"/>'
        f'<joint name="finger_joint{i}" type="slide" axis="0 1 0" range="0 .04"/></body>'
        for i, side, quat in ((1, "left", "1 0 0 0"), (2, "right", "0 0 0 1"))
    )
    if hand:
        text += f'<body name="hand" pos="0 0 .107" quat="0.9238795 0 0 -0.3826834"><geom size=".02"/>{fingers}</body>'
    motors = "".join(f'<position name="actuator{i}" joint="joint{i}" kp="4500"/>' for i in range(1, 8))
    split = '<joint joint="finger_joint1" coef=".5"/><joint joint="finger_joint2" coef=".5"/>'
    tendon = f'<tendon><fixed name="split">{split}</fixed></tendon>' if hand else ""
    grip = '<position name="actuator8" tendon="split" kp="100"/>' if hand else ""
    qpos = " ".join(["0"] * (9 if hand else 7))
    path = folder / "panda.xml"
    path.write_text(
        f'<mujoco><compiler angle="radian"/><worldbody>{text}{end}</worldbody>{tendon}<actuator>{motors}{grip}</actuator>'
        f'<keyframe><key name="home" qpos="{qpos}"/></keyframe></mujoco>'
    )
    return path


def test_another_pandas_file_takes_the_sensors_alike(tmp_path: Path, one: Rig, two: Rig):
    for ours, make, hand in ((one, one_sensor_panda, False), (two, two_finger_panda, True)):
        theirs = Rig(make(model=stand_in(tmp_path, hand=hand)))
        assert theirs.arm.torque_limit is not None and theirs.model.nkey == 0
        np.testing.assert_array_equal(theirs.arm.torque_limit[:, 1], MAX_TORQUE)
        for a, b in zip(theirs.robot.sensors, ours.robot.sensors, strict=True):
            np.testing.assert_allclose(a.world_from_pad(theirs.data), b.world_from_pad(ours.data), atol=1e-6)
    servo = theirs.model.actuator(theirs.robot.opening)
    assert theirs.model.nu == 8 and servo.ctrlrange.tolist() == [0.0, 0.08]
    with pytest.raises(InputError, match=r"model = .*must be an arm without a hand"):
        one_sensor_panda(model=stand_in(tmp_path, hand=True))
    with pytest.raises(InputError, match=r"must have a body 'hand'"):
        two_finger_panda(model=stand_in(tmp_path, hand=False))


def test_a_file_that_is_no_panda_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="must be an MJCF file that exists"):
        one_sensor_panda(model=tmp_path / "none.xml")
    (tmp_path / "bad.xml").write_text("<mujoco><worldbody><nonsense/></worldbody></mujoco>")
    with pytest.raises(InputError, match="must be an MJCF file that MuJoCo reads"):
        one_sensor_panda(model=tmp_path / "bad.xml")
    (tmp_path / "box.xml").write_text('<mujoco><worldbody><body name="link7"><geom size=".1"/></body></worldbody></mujoco>')
    with pytest.raises(InputError, match="must have a joint 'joint1'"):
        one_sensor_panda(model=tmp_path / "box.xml")
