"""A world of a user's own MuJoCo model: its dynamics stay its own, bodies are touched in their true shape; what cannot be is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from raytac import InputError, PadStepper, TactileReader, TactileWorld, mount
from raytac.se3 import pose
from raytac.specs import load_sensor
from raytac.world import Variation
from tests.world.arm6 import arm6, with_sensors

G = 9.81
LEFT, RIGHT = 6, 7


def sensed(spec: mujoco.MjSpec, **options: Any) -> TactileWorld:
    with_sensors(spec)
    return TactileWorld(spec, **{"outputs": ("wrench",), **options})


def grasp(data: mujoco.MjData, time: float) -> None:
    closed = min(time / 0.2, 1.0)
    data.ctrl[LEFT], data.ctrl[RIGHT] = -0.014 * closed, -0.014 * closed
    data.ctrl[2] = -0.1 * np.clip((time - 0.3) / 0.3, 0.0, 1.0)


def test_two_sensors_leave_a_model_its_own_dynamics_to_the_bit() -> None:
    """The arm swings, the cube slides on the table, and the fingers close to just before it; MuJoCo alone does the same."""
    spec = arm6()
    world = sensed(spec, num_envs=2, control_timestep=0.01)
    model = spec.compile()
    data = mujoco.MjData(model)
    for state in (data, *world.data):
        state.qvel[model.body("cube").dofadr[0] + np.arange(2)] = 0.2, 0.02

    def drive(data: mujoco.MjData, time: float) -> None:
        data.ctrl[:6] = 0.3 * np.sin(5.0 * time + np.arange(6))
        data.ctrl[6:] = 0.01

    for _ in range(20):
        state = world.step(drive)
        for _ in range(5):
            drive(data, data.time)
            mujoco.mj_step(model, data)
    assert not state.failed.any() and not any(wrench.any() for wrench in state.wrench.values())
    assert data.ncon and np.abs(data.qpos[:6]).max() > 0.1
    for name in ("qpos", "qvel", "act", "time", "qacc_warmstart"):
        for own in world.data:
            np.testing.assert_array_equal(getattr(own, name), getattr(data, name), err_msg=name)


def test_two_different_sensors_grasp_and_lift_a_cube_and_show_it() -> None:
    world = sensed(arm6(), control_timestep=0.02, outputs=("wrench", "height"), pitch=0.4e-3)
    start = world.state()
    assert world.sensor_names == ("left", "right") and list(start.world_from_body) == ["cube", "bracket"] and start.joints is None
    for _ in range(35):
        state = world.step(grasp)
    assert not state.failed.any() and state.world_from_body["cube"][0, 2, 3] > 0.275
    frames = world.observe()
    for name, pad in (("left", "gelsight_mini_9x11"), ("right", "gelsight_dome")):
        gelpad = load_sensor(pad).gelpad
        assert frames[name].surface.grid.rest.min() == pytest.approx(-gelpad.sag(*(0.5 * np.array(gelpad.size))), rel=1e-6)
        assert frames[name].force[0, 2] < -2.0 and 5e-5 < frames[name].surface.indentation.max() < 2e-3
    for _ in range(20):  # held still
        state = world.step()
    np.testing.assert_array_equal(world.data[0].ctrl[LEFT], -0.014)
    up = np.sum([state.world_from_pad[name][0, :3, :3] @ state.wrench[name][0, :3] for name in ("left", "right")], axis=0)
    assert up[2] == pytest.approx(-0.05 * G, rel=0.2)
    again = world.reset()
    for name in ("left", "right"):
        np.testing.assert_array_equal(again.world_from_pad[name], start.world_from_pad[name])


def test_a_keyframe_is_a_start_with_speeds_controls_and_mocap_bodies() -> None:
    spec = arm6(
        '<body name="ball" pos="0 0 2"><freejoint/><geom size=".01"/></body><body name="hand" mocap="true"><geom size=".01"/></body>'
    )
    model = spec.compile()
    qpos, qvel = model.qpos0.copy(), np.zeros(model.nv)
    qpos[0], qvel[0] = 0.5, 0.3
    key = spec.add_key(name="home", qpos=qpos, qvel=qvel, ctrl=np.arange(8.0) / 100, mpos=[0.1, 0.2, 0.3])
    assert key.name == "home"
    with pytest.warns(RuntimeWarning, match=r"^'hand' moves as a mocap body"):
        world = sensed(spec, keyframe="home", touches=["ball", "hand"], num_envs=2)
    for _ in range(3):
        world.step()
    placed = pose(np.eye(3), np.array([0.0, 0.5, 0.5]))
    world.reset([1], bodies={"hand": placed[None]})
    data = world.data[1]
    assert data.qpos[0] == 0.5 and data.qvel[0] == 0.3 and data.time == 0.0
    np.testing.assert_array_equal(data.ctrl, np.arange(8.0) / 100)
    np.testing.assert_array_equal(world.state().world_from_body["hand"][:, :3, 3], [[0.1, 0.2, 0.3], [0.0, 0.5, 0.5]])
    assert world.composed.control_timestep == 0.002 and world.data[0].time == pytest.approx(0.006)


UPWARD = """<mujoco><option cone="elliptic" integrator="implicitfast"/><asset>
<mesh name="tetra" vertex="-.006 -.006 0  .012 -.006 0  -.006 .012 0  -.006 -.006 .012" face="0 2 1  0 1 3  0 3 2  1 2 3"/>
<hfield name="hills" nrow="3" ncol="3" size=".02 .02 .002 .01" elevation="0 0 0 0 1 0 0 0 0"/></asset>
<worldbody>{}</worldbody></mujoco>"""
"""A world for a sensor that lies on its back, pad frame and world frame one."""


@pytest.mark.parametrize(
    ("geom", "height"),
    [
        ('type="sphere" size=".005"', 0.005),
        ('type="capsule" size=".004 .005" euler="90 0 0"', 0.004),
        ('type="cylinder" size=".005 .004"', 0.004),
        ('type="ellipsoid" size=".006 .005 .004"', 0.004),
        ('type="box" size=".006 .005 .004"', 0.004),
        ('type="mesh" mesh="tetra"', 0.0),
    ],
    ids=lambda value: value.split('"')[1] if isinstance(value, str) else "",
)
def test_any_shape_rests_on_a_pad_with_its_weight(geom: str, height: float) -> None:
    body = f'<body name="it" pos="0 0 {height + 2e-4}"><freejoint/><geom {geom} mass=".02"/></body>'
    spec = mujoco.MjSpec.from_string(UPWARD.format(body))
    mount(spec, "gelsight_mini_9x11", body="world", pose=np.eye(4))
    world = TactileWorld(spec, outputs=("wrench",), control_timestep=0.01)
    for _ in range(40):
        state = world.step()
    rocks = "mesh" in geom  # its centre of mass is not over its middle
    assert state.wrench["sensor"][0, 2] == pytest.approx(-0.02 * G, rel=0.05 if rocks else 0.01)


@pytest.mark.parametrize(
    ("geom", "name", "top"),
    [
        ('<geom name="hill" type="hfield" hfield="hills" pos="0 0 -.03"/>', "hill", -0.028),
        (
            '<geom type="box" size=".1 .1 .1" pos="1 0 0"/><geom name="floor" type="plane" size="1 1 1" pos="0 0 -.03"/>',
            "floor",
            -0.03,
        ),
    ],
)
def test_a_sensor_stands_on_what_is_fixed(geom: str, name: str, top: float) -> None:
    """A sensor that may only slide down comes to rest on a height field, or on a half-space off its body's origin, with its weight."""
    joint = '<joint type="slide" axis="0 0 1" damping="3"/>'
    slide = f'<body name="hand" pos="0 0 -.02">{joint}<geom size=".001" pos="0 0 .05" mass=".01"/></body>'
    spec = mujoco.MjSpec.from_string(UPWARD.format(geom + slide))
    mount(spec, "gelsight_mini_9x11", body="hand", pose=pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3)), mass=0.09)
    world = TactileWorld(spec, touches=[name], outputs=("wrench",), control_timestep=0.02)
    assert world.state().world_from_pad["sensor"][0, 2, 3] == pytest.approx(-0.02)
    for _ in range(40):
        state = world.step()
    assert state.wrench["sensor"][0, 2] == pytest.approx(-0.1 * G, rel=1e-2)
    assert 0.0 < top - state.world_from_pad["sensor"][0, 2, 3] < 1e-3


def test_a_geom_is_touched_in_its_true_shape_with_its_own_friction() -> None:
    """The bracket's hull has no notch; its mesh, which MuJoCo never collides, does."""
    world = sensed(arm6(), touches={"bracket_shown": 0.3, "cube": None})
    bracket, cube = world.composed.touched
    assert bracket.friction == 0.3 and cube.friction is None and bracket.index == world.model.body("bracket").id
    np.testing.assert_array_equal(world.models.friction_on_gel, [[0.3, np.nan]])
    assert bracket.qpos == world.model.joint(world.model.body("bracket").jntadr[0]).qposadr[0]
    surface, faces = world.mesh("bracket_shown")
    a, b, c = (surface[0, faces[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0
    assert volume == pytest.approx(0.02 * (0.04 * 0.01 + 0.012 * 0.02), rel=1e-5)


ATTACHED = """<mujoco><option cone="elliptic"/><worldbody><body name="lamp" pos="1 0 0"><freejoint/>
<geom size=".01" contype="0" conaffinity="0" mass=".1"/></body></worldbody></mujoco>"""
"""A free body that nothing can touch."""


def attached(collide: bool = False) -> mujoco.MjModel:
    """A free body without geoms of its own, on which an object of another file stands a little aside and turned."""
    ball = '<body name="ball" pos="0 0 .001"><geom name="shape" type="capsule" size=".005 .001" mass=".05"/></body>'
    object_, spec = (
        mujoco.MjSpec.from_string(f"<mujoco><worldbody>{ball}</worldbody></mujoco>"),
        mujoco.MjSpec.from_string(ATTACHED),
    )
    thing = spec.worldbody.add_body(name="thing", pos=(0.001, 0.0, 0.004))
    thing.add_freejoint()
    spec.attach(object_, prefix="own_", frame=thing.add_frame(pos=(-0.001, 0.0, 0.0), euler=(90, 0, 0)))
    mount(spec, "gelsight_mini_9x11", body="world", pose=np.eye(4), collide=collide)
    return spec.compile()


def test_an_object_that_was_attached_to_a_free_body_is_touched_with_it() -> None:
    world = TactileWorld(attached(), outputs=("wrench",), control_timestep=0.02, num_envs=2)
    assert list(world.composed.bodies) == ["thing"]
    world.reset(variation=Variation(mass={"thing": np.array([1.0, 2.0])}))
    for _ in range(40):
        state = world.step()
    np.testing.assert_allclose(state.wrench["sensor"][:, 2], [-0.05 * G, -0.1 * G], rtol=0.01)
    named = TactileWorld(attached(), touches=["own_ball"], outputs=())
    np.testing.assert_allclose(named.state().world_from_body["own_ball"][0, :3, 3], [0.0, -0.001, 0.004], atol=1e-12)
    model = attached(collide=True)
    data, readers = mujoco.MjData(model), [TactileReader(model, touches=[n], outputs=("height",)) for n in ("thing", "own_ball")]
    for _ in range(400):
        mujoco.mj_step(model, data)
    one, other = (reader.read(data)["sensor"].surface for reader in readers)
    assert one.indentation.max() > 1e-4
    np.testing.assert_allclose(one.height, other.height, atol=1e-9)


DRAGGED = """<mujoco><option cone="elliptic"/><worldbody><geom type="plane" size="1 1 .1" friction=".05"/>
<body name="mocap" mocap="true" pos="0 0 .05"/>
<body name="hand" pos="0 0 .05" gravcomp="1"><freejoint/><geom size=".002" mass=".1" contype="0" conaffinity="0"/></body>
<body name="block" pos="0 0 .01"><freejoint/><geom type="box" size=".02 .02 .01" mass=".05" friction=".05"/></body></worldbody>
<equality><weld body1="mocap" body2="hand" solref=".004 1"/></equality></mujoco>"""


def test_a_gel_welded_to_a_mocap_body_drags_and_one_that_is_fixed_to_it_is_warned_of() -> None:
    def drag(data: mujoco.MjData, time: float) -> None:
        data.mocap_pos[0] = 0.02 * np.clip((time - 0.2) / 0.3, 0.0, 1.0), 0.0, 0.05 - 0.0305 * min(time / 0.1, 1.0)

    def mounted(body: str) -> mujoco.MjSpec:
        spec = mujoco.MjSpec.from_string(DRAGGED)
        mount(spec, "gelsight_mini", body=body, pose=np.diag([1.0, -1.0, -1.0, 1.0]), mass=0.1)
        return spec

    world = TactileWorld(mounted("hand"), touches=["block"], outputs=("wrench",), control_timestep=0.02)
    for _ in range(25):
        state = world.step(drag)
    assert state.world_from_body["block"][0, 0, 3] == pytest.approx(0.02, abs=1e-3)
    assert state.wrench["sensor"][0, 0] < -0.1 and state.wrench["sensor"][0, 2] < -1.0
    with pytest.warns(RuntimeWarning, match=r"^'sensor' moves as a mocap body, which has no velocity.*welded to the mocap body"):
        TactileWorld(mounted("mocap"), touches=["block"], outputs=())


def test_a_mounting_error_moves_the_pad_and_no_site_of_the_robot(tmp_path: Path) -> None:
    shift = {"left": pose(np.eye(3), np.array([1e-3, 0.0, 0.0]))[None]}
    world = sensed(arm6())
    sites = ("tool", "left_tip", "left_nominal", "right_nominal", "right_pad")
    before = {name: world.data[0].site(name).xpos.copy() for name in sites}
    pad = world.data[0].site("left_pad").xpos.copy()
    world.reset(variation=Variation(mounting=shift))
    for name in sites:
        np.testing.assert_array_equal(world.data[0].site(name).xpos, before[name], err_msg=name)
    assert np.linalg.norm(world.data[0].site("left_pad").xpos - pad) == pytest.approx(1e-3)
    # The arm of a scene's robot is steered by where the pad is by the drawing.
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body name="link"><joint name="j"/><geom size="0.01" mass="1"/></body></worldbody></mujoco>', "utf-8"
    )
    (tmp_path / "scene.toml").write_text(
        '[robot]\nmodel = "arm.xml"\narm_joints = "j"\n[[robot.mount]]\nname = "left"\nat = "link"\n', "utf-8"
    )
    scene = TactileWorld(tmp_path / "scene.toml", outputs=())
    assert scene.arm is not None
    site = scene.arm.world_from_site(scene.data[0])
    np.testing.assert_allclose(site, scene.state().world_from_pad["left"][0], atol=1e-12)
    scene.reset(variation=Variation(mounting=shift))
    np.testing.assert_array_equal(scene.arm.world_from_site(scene.data[0]), site)
    assert scene.state().world_from_pad["left"][0, 0, 3] == pytest.approx(site[0, 3] + 1e-3)


def with_option(**options: Any) -> mujoco.MjSpec:
    spec = arm6()
    for name, value in options.items():
        setattr(spec.option, name, value)
    return spec


SLEEP, NO_CONTACT = int(mujoco.mjtEnableBit.mjENBL_SLEEP), int(mujoco.mjtDisableBit.mjDSBL_CONTACT)


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (arm6, {"touches": ["cub"]}, r"touches = 'cub': must be the name of a body or a geom.*did you mean 'cube'"),
        (arm6, {"touches": "cube"}, "must be names of bodies or geoms"),
        (arm6, {"touches": [3]}, "must be the name of a body or a geom"),
        (arm6, {"touches": ["left_body"]}, "must not be part of the sensor 'left' or of what carries it"),
        (arm6, {"touches": ["right_bar"]}, "must not be part of the sensor 'right'"),
        (arm6, {"touches": ["cube", "cube"]}, "has a geom that 'cube' has already"),
        (arm6, {"touches": {"cube": -1.0}}, r"touches\['cube'\] = -1.0"),
        (arm6, {"touches": ["world"]}, "has a half-space among other geoms: name the geoms; choose from: floor, table"),
        (lambda: arm6("<body name='b'><geom type='mesh' mesh='open' contype='0' conaffinity='0' mass='1'/></body>"),
         {"touches": ["b"]}, "has no geom that collides: name the geoms"),
        (lambda: arm6("<body name='b' pos='0 0 1'><freejoint/><geom name='shell' type='mesh' mesh='open' mass='1'/></body>"),
         {}, r"touches = 'b': its geom 'shell' is a mesh that is not closed.*Mend the mesh"),
        (lambda: arm6(""), {}, "the model has no body with a free joint and a geom that collides"),
        (lambda: arm6("<body name='b' pos='0 0 1'><freejoint/><geom size='.01' contype='0' conaffinity='0'/></body>"),
         {}, "the model has no body with a free joint and a geom that collides"),
        (arm6, {"sensors": ["middle"]}, r"sensors = 'middle': must be a sensor of the model.*left, right"),
        (arm6, {"control_timestep": 0.003}, r"control_timestep = 0.003: must be a whole multiple of the model's timestep of 0.002 s"),
        (arm6, {"keyframe": "home"}, r"keyframe = 'home': must be a keyframe of the model, which has none"),
        (arm6, {"allow_overlap": ["finger"]}, r"allow_overlap = 'finger': must be the name of a geom"),
        (lambda: with_option(noslip_iterations=3), {}, r"noslip_iterations = 3: must be 0 \(spec.option.noslip_iterations = 0\)"),
        (arm6, {"physics": "ipc"}, r"physics = 'ipc': needs a task scene"),
        (lambda: with_option(cone=mujoco.mjtCone.mjCONE_PYRAMIDAL), {}, r"model.opt.cone = 'pyramidal'.*cone='elliptic'"),
        (lambda: with_option(integrator=mujoco.mjtIntegrator.mjINT_RK4), {}, r"model.opt.integrator = 'RK4'.*implicitfast"),
        (lambda: with_option(disableflags=NO_CONTACT), {}, "must not be disabled: the pads' contacts need it"),
        (lambda: with_option(enableflags=SLEEP), {}, "must not be enabled: it lets bodies on pads sleep"),
    ],
)  # fmt: skip
def test_what_cannot_be_a_world_is_refused_by_name(make: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        sensed(make(), **options)


def test_a_model_without_sensors_and_one_that_mujoco_refuses() -> None:
    with pytest.raises(
        InputError, match=r"sensors = \(\): must be one sensor or more: put some on the MjSpec with raytac\.mount"
    ):
        TactileWorld(arm6().compile())
    spec = arm6()
    spec.body("cube").add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="nothing")
    with pytest.raises(InputError, match=r"spec = 'arm6': MuJoCo refuses it.*nothing"):
        sensed(spec)
    with pytest.raises(InputError, match=r"touches .*is for a MjSpec or MjModel: a task scene says this itself"):
        TactileWorld("push_cube", touches=["cube"])
    spec = arm6()
    with_sensors(spec, collide=True)
    with pytest.raises(InputError, match=r"gel = 'left_gel': collides in MuJoCo.*mount the sensor with collide=False"):
        TactileWorld(spec)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("arm.xml", r"scene = 'arm.xml': is no task scene.*mujoco.MjSpec.from_file"),
        (Path("arm.urdf"), r"scene = .*arm.urdf.*mujoco.MjSpec.from_file"),
        (3, r"scene = 'int': must be a task scene, its name or path, a mujoco.MjSpec or a mujoco.MjModel"),
    ],
)
def test_what_is_no_model_and_no_scene_is_refused_with_what_is(given: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        TactileWorld(given, touches=["cube"])
    for reader in (TactileReader, PadStepper):
        with pytest.raises(InputError, match=r"model = 'MjSpec': must be a mujoco.MjModel.*spec.compile\(\)"):
            reader(arm6())  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match=r"spec = 'MjModel': must be a mujoco.MjSpec, such as mujoco.MjSpec.from_file\(path\)"):
        mount(arm6().compile(), "gelsight_mini", site="left_tip")  # pyright: ignore[reportArgumentType]


def test_a_gel_inside_the_robot_names_both_geoms_and_may_be_allowed() -> None:
    def mounted(depth: float) -> mujoco.MjSpec:
        spec = arm6()
        facing = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
        # The bar's side lies at −1 mm, the pad's gel reaches 4.25 mm behind the pad.
        at = pose(facing, np.array([0.0, -0.001 + 0.00425 - depth, 0.05]))
        mount(spec, load_sensor("gelsight_mini"), body="right_finger", pose=at, name="grip")
        return spec

    sensors = {"grip": "gelsight_mini"}
    gelpad = load_sensor("gelsight_mini").gelpad
    clear = 0.00425 - gelpad.thickness
    TactileWorld(mounted(clear + 0.5e-4), sensors=sensors, outputs=())
    with pytest.raises(
        InputError, match=r"gel and geom = \('grip_gel', 'right_bar'\): overlap by 0\.5 mm at the start.*allow_overlap"
    ):
        TactileWorld(mounted(clear + 0.5e-3), sensors=sensors, outputs=())
    TactileWorld(mounted(clear + 0.5e-3), sensors=sensors, outputs=(), allow_overlap=["right_bar"])


def test_a_body_beyond_a_gel_at_the_start_is_refused_and_one_in_contact_is_not() -> None:
    def started(height: float) -> TactileWorld:
        body = f'<body name="it" pos="0 0 {height}"><freejoint/><geom size=".005" mass=".02"/></body>'
        spec = mujoco.MjSpec.from_string(UPWARD.format(body))
        mount(spec, "gelsight_mini_9x11", body="world", pose=np.eye(4))
        return TactileWorld(spec, outputs=("wrench",))

    assert started(0.0045).step().wrench["sensor"][0, 2] < -0.1
    with pytest.raises(InputError, match=r"body = 'it': must not start beyond the face that the gel of 'sensor' is bonded to"):
        started(0.0)
