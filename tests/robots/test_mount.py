"""A sensor on any MJCF robot: where its pad frame comes to lie, what it weighs, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest

from raytac.errors import InputError, SpecError
from raytac.robots.mount import case_depth, mount, mounted_sensors, standing_on
from raytac.se3 import pose, pose_error, quaternion, rotation_vector
from raytac.specs.sensor_file import load_sensor

ROBOT = """
<mujoco><worldbody><body name="base" pos="0.1 0.2 0.3" euler="10 20 30"><joint name="turn" axis="0 1 0"/>
<geom name="rod" type="capsule" size="0.02" fromto="0 0 0 0 0 0.2" mass="0.5"/>
<body name="tool" pos="0 0 0.2" euler="0 45 0"><joint name="bend" axis="1 0 0"/><geom size="0.01" mass="0.1"/>
<frame pos="0.01 0 0" euler="0 0 90"><site name="tip" pos="0 0.02 0.03" euler="90 0 0"/></frame>
<site name="tool" pos="0 0 0.05"/></body></body></worldbody></mujoco>
"""


def rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else q[:, [1, 0, 2]]


def world_from(data: mujoco.MjData, element) -> np.ndarray:
    return pose(element.xmat.reshape(3, 3), element.xpos)


@pytest.mark.parametrize(("at", "kind"), [("base", "body"), ("tip", "site"), ("tool", "body"), ("tool", "site")])
def test_the_pad_frame_lies_where_it_was_put(at, kind):
    spec = mujoco.MjSpec.from_string(ROBOT)
    placed = pose(rotation(3), np.array([0.01, -0.02, 0.05]))
    mounted = mount(spec, "gelsight_mini", pose=placed, **{kind: at})
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = 0.3, -0.7
    mujoco.mj_forward(model, data)
    anchor = data.site(at) if kind == "site" else data.body(at)
    expected = world_from(data, anchor) @ placed
    np.testing.assert_allclose(mounted.world_from_pad(data), expected, atol=1e-9)
    np.testing.assert_allclose(world_from(data, data.body(mounted.body)), expected, atol=1e-9)
    np.testing.assert_allclose(world_from(data, data.site(mounted.nominal)), expected, atol=1e-9)
    assert model.site(mounted.nominal).bodyid != model.body(mounted.body).id


def test_case_and_gel_have_the_sensors_size_and_weight():
    """The Mini: 32 × 28 mm outside (gsrobotics CAD), gel 25.25 × 20.75 × 4 mm."""
    sensor, spec = load_sensor("gelsight_mini"), mujoco.MjSpec.from_string(ROBOT)
    before = spec.compile().body_mass.sum()
    spec = mujoco.MjSpec.from_string(ROBOT)
    mounted = mount(spec, sensor, body="base")
    model = spec.compile()
    case, gel = model.geom(mounted.case), model.geom(mounted.gel)
    np.testing.assert_allclose(2 * case.size[:2], (0.032, 0.028), atol=1e-12)
    np.testing.assert_allclose(2 * gel.size, (0.02525, 0.02075, 0.004), atol=1e-12)
    assert gel.pos[2] + gel.size[2] == pytest.approx(0.0, abs=1e-12)
    assert case.pos[2] + case.size[2] == pytest.approx(-0.004)
    assert case.pos[2] - case.size[2] == pytest.approx(-case_depth(sensor))
    assert gel.contype == gel.conaffinity == 0 and case.contype == 1
    expected = 0.032 * 0.028 * (case_depth(sensor) - 0.004) * 1000 + 0.02525 * 0.02075 * 0.004 * 1000
    assert model.body_mass.sum() - before == pytest.approx(expected, rel=1e-9)
    spec = mujoco.MjSpec.from_string(ROBOT)
    mount(spec, sensor, body="base", mass=0.05)
    assert spec.compile().body_mass.sum() - before == pytest.approx(0.05, rel=1e-9)


def test_walls_and_density_of_the_case_are_the_sensors_own():
    mini = load_sensor("gelsight_mini")
    sensor = replace(mini, case=replace(mini.case, wall=2e-3, density=2000.0))
    spec = mujoco.MjSpec.from_string(ROBOT)
    before = spec.compile().body_mass.sum()
    mounted = mount(spec, sensor, body="base")
    model = spec.compile()
    size = np.array([0.0344, 0.0304, 0.0285 + 2e-3 - 0.004])
    np.testing.assert_allclose(2 * model.geom(mounted.case).size, size, atol=1e-12)
    assert model.body_mass.sum() - before == pytest.approx(size.prod() * 2000 + 0.02525 * 0.02075 * 0.004 * 1000, rel=1e-9)
    np.testing.assert_allclose(standing_on(sensor)[2, 3], 0.0305, atol=1e-12)


def test_a_sensor_stands_on_its_mount_by_default():
    sensor, spec = load_sensor("gelsight_mini"), mujoco.MjSpec.from_string(ROBOT)
    mounted = mount(spec, sensor, body="base")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(
        mounted.world_from_pad(data), world_from(data, data.body("base")) @ standing_on(sensor), atol=1e-12
    )


def test_several_sensors_of_several_kinds_share_a_robot():
    spec = mujoco.MjSpec.from_string(ROBOT)
    first = mount(spec, "gelsight_mini", site="tip", name="left")
    second = mount(spec, load_sensor("gelsight_dome"), body="base", name="right")
    model = spec.compile()
    names = [getattr(s, f) for s in (first, second) for f in ("body", "site", "case", "gel")]
    assert len(set(names)) == 8
    assert model.body(first.body).parentid != model.body(second.body).parentid
    with pytest.raises(InputError, match="name = 'left': must be new: the robot has a body 'left_body'"):
        mount(spec, "gelsight_mini", body="base", name="left")


def test_what_cannot_be_mounted_is_refused():
    def put(**options: Any) -> None:
        mount(mujoco.MjSpec.from_string(ROBOT), "gelsight_mini", **{"body": "base", **options})

    with pytest.raises(InputError, match=r"site = 'tpi': must be the name of a site.*did you mean 'tip'\?.*tip, tool"):
        put(site="tpi", body=None)
    with pytest.raises(InputError, match=r"body = 'tip': must be the name of a body of the robot.*base, tool"):
        put(body="tip")
    for both in ({"site": "tip"}, {"body": None}):
        with pytest.raises(InputError, match=r"one of the two"):
            put(**both)
    with pytest.raises(InputError, match=r"pose .*shape \(4, 4\)"):
        put(pose=np.eye(3))
    with pytest.raises(InputError, match=r"pose .*determinant"):
        put(pose=np.diag([1.0, 1.0, -1.0, 1.0]))
    with pytest.raises(InputError, match=r"pose .*finite"):
        put(pose=np.full((4, 4), np.nan))
    with pytest.raises(InputError, match=r"pose .*last row"):
        put(pose=np.ones((4, 4)))
    with pytest.raises(InputError, match=r"name = ''"):
        put(name="")
    with pytest.raises(InputError, match=r"collide = 1"):
        put(collide=1)
    for mass in (0.0, -1.0, 1e-4, np.inf, np.nan):
        with pytest.raises(InputError, match=r"mass = "):
            put(mass=mass)
    with pytest.raises(SpecError, match=r"gelsight_mni.*did you mean 'gelsight_mini'"):
        mount(mujoco.MjSpec.from_string(ROBOT), "gelsight_mni", body="base")
    with pytest.raises(InputError, match=r"must be a mujoco.MjSpec"):
        mount(mujoco.MjModel.from_xml_string(ROBOT), "gelsight_mini", body="base")


def test_a_compiled_model_knows_its_sensors_through_xml_and_prefixes():
    hand, dome = mujoco.MjSpec.from_string(ROBOT), load_sensor("gelsight_dome")
    left = mount(hand, "gelsight_mini_9x11", site="tip", name="left")
    right = mount(hand, dome, body="base", name="right")
    model = mujoco.MjModel.from_xml_string(hand.to_xml())
    assert mounted_sensors(model, ["left"]) == (left,) and mounted_sensors(model, [right]) == (right,)
    assert mounted_sensors(model, {"right": "gelsight_dome", "left": left.spec}) == (right, left)
    arm = mujoco.MjSpec.from_string("<mujoco><worldbody><body name='flange'/></worldbody></mujoco>")
    arm.attach(hand, prefix="hand/", frame=arm.body("flange").add_frame())
    attached = arm.compile()
    (found_left,) = mounted_sensors(attached, ["hand/left"])
    assert found_left.gel == "hand/left_gel" and found_left.spec == left.spec
    for given, text in (
        (None, r"'right'.*was mounted as a specification.*say sensors=\{'right': specification\}"),
        (["lift"], "must be a sensor of the model; did you mean 'left'"),
        (["left", left], "must not name a sensor twice"),
        ("left", "must be names"),
        ([3], "must be a name or a result of mount"),
        ([], "one sensor or more.*choose from: left, right"),
        ({"middle": "gelsight_mini"}, "has no body 'middle_body'"),
    ):
        with pytest.raises(InputError, match=text):
            mounted_sensors(model, given)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"put some on the MjSpec with raytac\.mount"):
        mounted_sensors(mujoco.MjModel.from_xml_string(ROBOT))


def test_a_gel_that_collides_carries_a_ball_about_as_deep_as_the_gel():
    """A ball of 50 g, one contact point, in MuJoCo alone: m g / (2 E* a) to a factor of two, and the gel's friction."""
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body pos='0 0 0.005'><freejoint/><geom size='.005' mass='.05'/></body></worldbody></mujoco>"
    )
    sensor = load_sensor("gelsight_mini_9x11")
    mounted = mount(spec, sensor, body="world", pose=np.eye(4), collide=True)
    model = spec.compile()
    data = mujoco.MjData(model)
    for _ in range(1000):
        mujoco.mj_step(model, data)
    gelpad = sensor.gelpad
    expected = 0.05 * 9.81 / (2.0 * gelpad.youngs_modulus / (1.0 - gelpad.poisson_ratio**2) * 3e-3)
    assert 0.5 * expected < 0.005 - data.qpos[2] < 2.0 * expected
    assert data.ncon == 1 and model.geom(mounted.gel).id in data.contact.geom
    np.testing.assert_allclose(data.contact.friction[:, 0], gelpad.friction)


def test_a_pose_error_leads_from_one_pose_to_the_other():
    a, b = pose(rotation(1), np.array([1.0, 2.0, 3.0])), pose(rotation(2), np.array([0.5, 0.0, -1.0]))
    error = pose_error(a, b)
    turn = np.zeros(9)
    angle = np.linalg.norm(error[3:])
    q = np.array([np.cos(angle / 2), *(np.sin(angle / 2) * error[3:] / angle)])
    mujoco.mju_quat2Mat(turn, q)
    np.testing.assert_allclose(turn.reshape(3, 3) @ b[:3, :3], a[:3, :3], atol=1e-12)
    np.testing.assert_allclose(error[:3], (0.5, 2.0, 4.0))
    assert 0.1 < angle <= np.pi and np.abs(quaternion(np.eye(3)) - (1, 0, 0, 0)).max() == 0.0


def test_rotation_vectors_are_mujocos_at_every_angle():
    axes = np.random.default_rng(0).normal(size=(40, 3))
    axes[:3] = np.eye(3)
    angles = np.tile([0.0, 1e-9, 1e-4, 1.0, 2.5, np.pi - 1e-7, np.pi - 1e-3, 3.0], 5)
    turns = angles[:, None] * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    matrices = np.zeros((40, 9))
    for matrix, turn, angle in zip(matrices, turns, angles, strict=True):
        q = np.array([np.cos(angle / 2), *(np.sin(angle / 2) * turn / max(angle, 1e-300))])
        mujoco.mju_quat2Mat(matrix, q)
    found = rotation_vector(matrices.reshape(4, 10, 3, 3)).reshape(40, 3)
    np.testing.assert_allclose(found, turns, atol=1e-8)
    np.testing.assert_array_equal(found[7], rotation_vector(matrices[7].reshape(3, 3)))
