"""Loops that somebody else writes: pads that act in them as in a world, and readers that only look at their states."""

from __future__ import annotations

import warnings
from typing import Any

import mujoco
import numpy as np
import pytest

from raytac import InputError, PadStepper, TactileReader, TactileWorld, mount
from raytac.physics import Ipc
from raytac.physics.rigid.pad import RigidPad
from raytac.specs import ObjectSpec, PressScene, StageSpec, load_sensor
from tests.world.arm6 import arm6, with_sensors

G = 9.81
PAD = "gelsight_mini_9x11"
BALL = '<body name="ball" pos="0 0 {}"><freejoint/><geom name="shape" size=".005" mass=".05" {}/></body>'


def lying(bodies: str = BALL.format(0.0052, ""), *, collide: bool = False, option: str = 'cone="elliptic"') -> mujoco.MjModel:
    """A sensor on its back, pad frame and world frame one, and bodies over it."""
    spec = mujoco.MjSpec.from_string(f"<mujoco><option {option}/><worldbody>{bodies}</worldbody></mujoco>")
    mount(spec, PAD, body="world", pose=np.eye(4), collide=collide)
    return spec.compile()


def test_a_step_of_pads_is_a_step_of_a_world() -> None:
    model = lying()
    world = TactileWorld(model, outputs=("wrench", "height"), pitch=0.4e-3)
    pads, data = PadStepper(model, outputs=("wrench", "height"), pitch=0.4e-3), mujoco.MjData(model)
    for _ in range(30):
        world.step()
        pads.step(model, data)
    np.testing.assert_array_equal(data.qpos, world.data[0].qpos)
    np.testing.assert_array_equal(pads.wrench("sensor"), world.state().wrench["sensor"])
    assert pads.wrench("sensor")[0, 2] < -0.1
    one, other = pads.observe(data)["sensor"], world.observe()["sensor"]
    np.testing.assert_array_equal(one.surface.height, other.surface.height)
    np.testing.assert_array_equal(one.wrench, other.wrench)


def test_contacts_are_put_between_the_halves_of_several_states_steps() -> None:
    """Rest under the weight, as ``step`` does; what is beyond a gel is marked, and a state whose time goes back begins anew."""
    model = lying(BALL.format(0.0049, ""))
    pads, datas = PadStepper(model, num_envs=2, outputs=("wrench",)), [mujoco.MjData(model) for _ in range(2)]
    datas[1].qpos[2] = -0.004  # in the gel's bonded face
    for _ in range(150):
        for data in datas:
            mujoco.mj_step1(model, data)
        pads.add(model, datas)
        for data in datas:
            mujoco.mj_step2(model, data)
        pads.finish(model, datas)
    assert pads.failed.tolist() == [False, True] and np.isnan(pads.wrench("sensor")[1]).all()
    assert pads.wrench("sensor")[0, 2] == pytest.approx(-0.05 * G, rel=0.02)
    mujoco.mj_resetData(model, datas[1])
    for data in datas:
        mujoco.mj_step1(model, data)
    pads.add(model, datas)
    assert not pads.failed.any()
    with pytest.raises(InputError, match="must be followed by mj_step2 and finish"):
        pads.add(model, datas)
    pads.reset()
    with pytest.raises(InputError, match="must follow add and mj_step2"):
        pads.finish(model, datas)


@pytest.mark.parametrize("option", ['cone="pyramidal"', 'cone="elliptic" integrator="RK4"'])
def test_a_reader_shows_the_depth_at_which_the_gel_carries_mujocos_force(option: str) -> None:
    """Pushed by 0 to 3 N, a ball leaves the imprint of a press with that force, whatever MuJoCo's stiffness."""
    model = lying(BALL.format(0.005, ""), collide=True, option=option)
    datas, pushes = [mujoco.MjData(model) for _ in range(3)], np.array([0.0, 1.0, 3.0])
    for data, push in zip(datas, pushes, strict=True):
        data.xfrc_applied[model.body("ball").id, 2] = -push
        for _ in range(400):
            mujoco.mj_step(model, data)
    reader = TactileReader(model, num_envs=3, outputs=("wrench", "height"), pitch=0.1e-3)
    frame = reader.read(datas)["sensor"]
    force = pushes + 0.05 * G
    np.testing.assert_allclose(frame.wrench[:, 2], -force, rtol=2e-3)
    shape = ObjectSpec("sphere", {"radius": 0.005}, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.05)
    for b in range(3):
        press = PressScene("ball", shape, (StageSpec("indent", force=float(force[b])),))
        pad = RigidPad(load_sensor(PAD), press, pitch=0.1e-3)
        depth = float(pad.peak(pad.run()).depth[0])
        assert frame.surface.indentation[b].max() == pytest.approx(depth, rel=0.02)
    seen = TactileReader(model, num_envs=3, outputs=("height",), pitch=0.1e-3, depth="geometry").read(datas)["sensor"]
    sunk = [0.005 - data.body("ball").xpos[2] for data in datas]
    np.testing.assert_allclose(seen.surface.indentation.max(axis=(1, 2)), sunk, atol=3e-6)


def test_a_body_that_overlaps_without_a_force_leaves_no_imprint() -> None:
    model = lying(BALL.format(0.0048, 'contype="0" conaffinity="0"'), collide=True)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    options: dict[str, Any] = {"touches": ["shape"], "outputs": ("height",), "pitch": 0.2e-3}
    assert TactileReader(model, **options).read(data)["sensor"].surface.indentation.max() < 1e-7
    assert TactileReader(model, **options, depth="geometry").read(data)["sensor"].surface.indentation.max() > 1e-4


def test_two_gels_in_one_grasp_each_have_their_own_depth_and_force() -> None:
    """Fingers that MuJoCo alone closes on a cube: opposite forces, and a soft gel's imprint that is deeper than MuJoCo's overlap."""
    spec = arm6()
    with_sensors(spec, collide=True)
    model = spec.compile()
    data = mujoco.MjData(model)
    reader = TactileReader(model, touches=["cube"], outputs=("wrench", "height"), pitch=0.4e-3)
    assert not reader.read(data)["left"].wrench.any()
    for step in range(300):
        data.ctrl[6:] = -0.014 * min(step / 150, 1.0)
        mujoco.mj_step(model, data)
    frames = reader.read(data)
    force = {name: -frame.force[0, 2] for name, frame in frames.items()}
    assert min(force.values()) > 2.0 and force["left"] == pytest.approx(force["right"], rel=0.1)
    for frame in frames.values():
        assert 5e-5 < frame.surface.indentation.max() < 2e-3
    data.qpos[0] = np.nan
    with pytest.warns(RuntimeWarning, match="environment 0 failed, as frame.failed says: .* beyond the bonded face of a gel"):
        assert reader.read(data)["left"].failed.all()
    with warnings.catch_warnings(action="error"):  # once is enough
        assert np.isnan(reader.read(data)["left"].wrench).all()


def test_what_a_foreign_loop_cannot_be_given() -> None:
    model, other = lying(), lying(collide=True)
    data = mujoco.MjData(model)
    with pytest.raises(InputError, match=r"gel = 'sensor_gel': must collide in MuJoCo.*collide=True"):
        TactileReader(model)
    with pytest.raises(InputError, match=r"gel = 'sensor_gel': collides in MuJoCo.*collide=False"):
        PadStepper(other)
    with pytest.raises(InputError, match=r"depth = 'forc'.*force, geometry"):
        TactileReader(other, depth="forc")
    pads, reader = PadStepper(model, outputs=()), TactileReader(other, num_envs=2, outputs=())
    with pytest.raises(InputError, match="must be the model that this was made for"):
        pads.step(other, data)
    with pytest.raises(InputError, match="must be 2 states, as num_envs says"):
        reader.read(data)
    with pytest.raises(InputError, match="must be a MjData of the model"):
        reader.read([data, mujoco.MjData(arm6().compile())])
    with pytest.raises(InputError, match=r"sensors = 'left': must be a sensor of the world"):
        reader.read([mujoco.MjData(other)] * 2, ["left"])
    with pytest.raises(InputError, match=r"name = 'left'.*choose from: sensor"):
        pads.wrench("left")
    with pytest.raises(InputError, match=r"model\.opt\.cone = 'pyramidal'"):
        PadStepper(lying(option='cone="pyramidal"'))


def test_soft_pads_are_refused_in_a_loop_that_steps_no_solver() -> None:
    for make, model in ((PadStepper, lying()), (TactileReader, lying(collide=True))):
        for physics in ("ipc", Ipc()):
            with pytest.raises(InputError, match=r"physics = .*must be rigid.*TactileWorld.*choose from: rigid"):
                make(model, outputs=(), physics=physics)
        with pytest.raises(InputError, match=r"physics = .*ipv"):
            make(model, outputs=(), physics="ipv")
        make(model, outputs=(), physics="rigid")


def test_some_states_are_read_as_all_of_them_are() -> None:
    """Rows in the order of the list, those that are not named keep what was said of them."""
    model = lying(collide=True)
    datas = [mujoco.MjData(model) for _ in range(3)]
    for depth, data in zip((0.1e-3, 0.2e-3, 0.4e-3), datas, strict=True):
        data.qpos[2] = 5e-3 - depth
        mujoco.mj_forward(model, data)
    outputs = {"outputs": ("wrench", "height"), "pitch": 0.4e-3, "num_envs": 3}
    reader, pads = TactileReader(model, **outputs), PadStepper(lying(), **outputs)
    for _ in range(2):
        pads.step(pads.model, datas := [*datas])
    whole, seen = TactileReader(model, **outputs).read(datas)["sensor"], pads.observe(datas)["sensor"]
    datas[0].qpos[0] = np.nan
    for frame, every in ((reader.read(datas, envs=[2, 1])["sensor"], whole), (pads.observe(datas, envs=[2, 1])["sensor"], seen)):
        assert frame.surface.height.shape[0] == 2
        np.testing.assert_array_equal(frame.surface.height, every.surface.height[[2, 1]])
        np.testing.assert_array_equal(frame.wrench, every.wrench[[2, 1]])
    assert not np.array_equal(whole.surface.height[1], whole.surface.height[2]) and not reader.failed.any()
    reader.read(datas, envs=np.array([True, False, False]))
    assert reader.failed.tolist() == [True, False, False]
    reader.read(datas, envs=[1])
    assert reader.failed.tolist() == [True, False, False]
    with pytest.raises(InputError, match="envs"):
        reader.read(datas, envs=[3])
