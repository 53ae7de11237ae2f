"""A sensor on any MJCF robot: where its pad frame comes to lie, what it weighs, and what is refused."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from raytac.errors import InputError
from raytac.robots.mount import case_depth, mount_sensor, standing_on
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


@pytest.mark.parametrize(("at", "kind"), [("base", None), ("tip", None), ("tool", "body"), ("tool", "site")])
def test_the_pad_frame_lies_where_it_was_put(at, kind):
    sensor, spec = load_sensor("gelsight_mini"), mujoco.MjSpec.from_string(ROBOT)
    placed = pose(rotation(3), np.array([0.01, -0.02, 0.05]))
    mounted = mount_sensor(spec, sensor, at, placed, kind=kind)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = 0.3, -0.7
    mujoco.mj_forward(model, data)
    anchor = data.site(at) if kind == "site" or at == "tip" else data.body(at)
    expected = world_from(data, anchor) @ placed
    np.testing.assert_allclose(mounted.world_from_pad(data), expected, atol=1e-9)
    np.testing.assert_allclose(world_from(data, data.body(mounted.body)), expected, atol=1e-9)


def test_case_and_gel_have_the_sensors_size_and_weight():
    """The Mini: 32 × 28 mm outside (gsrobotics CAD), gel 25.25 × 20.75 × 4 mm."""
    sensor, spec = load_sensor("gelsight_mini"), mujoco.MjSpec.from_string(ROBOT)
    before = spec.compile().body_mass.sum()
    spec = mujoco.MjSpec.from_string(ROBOT)
    mounted = mount_sensor(spec, sensor, "base")
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
    mount_sensor(spec, sensor, "base", mass=0.05)
    assert spec.compile().body_mass.sum() - before == pytest.approx(0.05, rel=1e-9)


def test_a_sensor_stands_on_its_mount_by_default():
    sensor, spec = load_sensor("gelsight_mini"), mujoco.MjSpec.from_string(ROBOT)
    mounted = mount_sensor(spec, sensor, "base")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(
        mounted.world_from_pad(data), world_from(data, data.body("base")) @ standing_on(sensor), atol=1e-12
    )


def test_several_sensors_of_several_kinds_share_a_robot():
    spec = mujoco.MjSpec.from_string(ROBOT)
    first = mount_sensor(spec, load_sensor("gelsight_mini"), "tip", name="left")
    second = mount_sensor(spec, load_sensor("gelsight_dome"), "base", name="right")
    model = spec.compile()
    names = [getattr(s, f) for s in (first, second) for f in ("body", "site", "case", "gel")]
    assert len(set(names)) == 8
    assert model.body(first.body).parentid != model.body(second.body).parentid
    with pytest.raises(InputError, match="name = 'left': must be new: the robot has a body 'left_body'"):
        mount_sensor(spec, load_sensor("gelsight_mini"), "base", name="left")


def test_what_cannot_be_mounted_is_refused():
    sensor = load_sensor("gelsight_mini")

    def mount(at="base", *arguments, **options):
        mount_sensor(mujoco.MjSpec.from_string(ROBOT), sensor, at, *arguments, **options)

    with pytest.raises(InputError, match=r"at = 'tpi': must be the name of a body or site.*did you mean 'tip'\?.*base.*tool"):
        mount("tpi")
    with pytest.raises(InputError, match=r"must be the name of a body of the robot"):
        mount("tip", kind="body")
    with pytest.raises(InputError, match=r"at = 'tool': is the name of a body and of a site"):
        mount("tool")
    with pytest.raises(InputError, match=r"kind = 'geom'"):
        mount(kind="geom")
    with pytest.raises(InputError, match=r"mount_from_pad .*shape \(4, 4\)"):
        mount("base", np.eye(3))
    with pytest.raises(InputError, match=r"mount_from_pad .*determinant"):
        mount("base", np.diag([1.0, 1.0, -1.0, 1.0]))
    with pytest.raises(InputError, match=r"mount_from_pad .*finite"):
        mount("base", np.full((4, 4), np.nan))
    with pytest.raises(InputError, match=r"mount_from_pad .*last row"):
        mount("base", np.ones((4, 4)))
    with pytest.raises(InputError, match=r"name = ''"):
        mount(name="")
    for mass in (0.0, -1.0, 1e-4, np.inf, np.nan):
        with pytest.raises(InputError, match=r"mass = "):
            mount(mass=mass)
    with pytest.raises(InputError, match=r"must be a mujoco.MjSpec"):
        mount_sensor(mujoco.MjModel.from_xml_string(ROBOT), sensor, "base")


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
