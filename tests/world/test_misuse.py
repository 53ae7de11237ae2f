"""Worlds and loops that are used as they must not be: a clear error or a failed environment, and nothing else is lost."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from raytac import InputError, PadStepper, TactileReader, TactileWorld, mount
from raytac.envs import LiftCubeVectorEnv
from tests.world.test_foreign_loop import BALL, lying

QUIET = {"outputs": ("wrench",), "pitch": 0.4e-3}


def beyond_add(pads: PadStepper, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """A step of which ``finish`` is forgotten, and the first half of the next one."""
    mujoco.mj_step1(model, data)
    pads.add(model, data)
    mujoco.mj_step2(model, data)
    mujoco.mj_step1(model, data)


@pytest.mark.parametrize("kilobytes", (12, 13, 14, 16, 17, 18, 20, 24, 28, 32))
def test_memory_that_is_full_fails_the_environment_and_says_what_to_raise(kilobytes: int) -> None:
    """Somewhere in this range contacts fit, and rows do not."""
    bodies = "".join(
        f'<body pos="{4e-3 * (k % 4) - 6e-3} {4e-3 * (k // 4) - 4e-3} .0014"><freejoint/><geom size=".0015" mass=".005"/></body>'
        for k in range(10)
    )
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><size memory="{kilobytes}K"/><option cone="elliptic"/><worldbody>{bodies}</worldbody></mujoco>'
    )
    mount(spec, "gelsight_mini", body="world", name="pad", pose=np.eye(4))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        world = TactileWorld(spec.compile(), **QUIET)
        for _ in range(3):
            state = world.step()
    said = [str(one.message) for one in caught if "memory" in str(one.message)]
    assert bool(said) == bool(state.failed[0])
    assert all("environment 0 failed" in one and "<size memory=" in one for one in said)
    assert state.failed[0] or state.wrench["pad"][0, 2] < -1e-3
    assert not state.failed[0] or kilobytes < 32


@pytest.mark.parametrize("change", [("timestep", 5e-4), ("cone", mujoco.mjtCone.mjCONE_PYRAMIDAL)])
def test_options_that_change_are_refused_before_a_step(change: tuple[str, float]) -> None:
    name, value = change
    model = lying()
    world, pads, data = TactileWorld(model, **QUIET), PadStepper(model, **QUIET), mujoco.MjData(model)
    setattr(model.opt, name, value)
    setattr(world.model.opt, name, value)
    mujoco.mj_step1(model, data)
    calls: list[Callable[[], object]] = [world.step, lambda: pads.step(model, data), lambda: pads.add(model, data)]
    for call in calls:
        with pytest.raises(InputError, match=f"model.opt.{name} = .*must stay"):
            call()
    assert getattr(model.opt, name) == value and data.time == 0.0


def test_a_mass_that_changes_is_that_of_the_contact() -> None:
    """A ball that is 40 times heavier comes to rest with its weight."""
    model = lying()
    pads, data = PadStepper(model, **QUIET), mujoco.MjData(model)
    pads.step(model, data)
    model.body_mass[1:] *= 4.0
    model.body_inertia[1:] *= 4.0
    mujoco.mj_setConst(model, data)
    for _ in range(500):
        pads.step(model, data)
    assert pads._models.inverse_weight[0, 1] == model.body_invweight0[1, 0]
    assert pads.wrench("sensor")[0, 2] == pytest.approx(-4.0 * 0.05 * 9.81, rel=1e-3)


@pytest.mark.parametrize("depth", ["force", "geometry"])
def test_a_reader_marks_a_body_beyond_the_gel_and_reads_the_others(depth: str) -> None:
    model = lying(collide=True)
    heights = (-1e-3, -4e-3, -6e-3, 4.9e-3)
    reader, datas = TactileReader(model, depth=depth, num_envs=4, **QUIET), [mujoco.MjData(model) for _ in heights]
    for data, z in zip(datas, heights, strict=True):
        data.qpos[2] = z
        mujoco.mj_forward(model, data)
    frame = reader.read(datas)["sensor"]
    np.testing.assert_array_equal(reader.failed, [True, True, True, False])
    np.testing.assert_array_equal(frame.failed, reader.failed)
    assert frame.force[3, 2] < 0.0


def test_a_number_that_is_not_finite_fails_its_own_environment() -> None:
    world = TactileWorld("push_cube", num_envs=3, **QUIET)
    world.step()
    world.data[1].qpos[0] = np.nan
    state = world.step()
    np.testing.assert_array_equal(state.failed, [False, True, False])
    assert np.isfinite(state.wrench["sensor"][[0, 2]]).all()


SERVO = '<body name="ball" pos="0 0 .0052"><joint name="z" type="slide" axis="0 0 1"/><geom size=".005" mass=".05"/></body>'


def test_a_controller_that_writes_nan_is_an_error_that_names_the_environment() -> None:
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><option cone="elliptic"/><worldbody>{SERVO}</worldbody><actuator><motor joint="z"/></actuator></mujoco>'
    )
    mount(spec, "gelsight_mini", body="world", name="sensor", pose=np.eye(4))
    model = spec.compile()

    def still(data: mujoco.MjData, time: float) -> None:
        data.ctrl[:] = 0.0

    def wrong(data: mujoco.MjData, time: float) -> None:
        data.ctrl[0] = np.nan

    world = TactileWorld(model, touches=["ball"], num_envs=2, **QUIET)
    with pytest.raises(InputError, match=r"control\[0\] = nan: must be finite in environment 1"):
        world.step([still, wrong])
    pads, data = PadStepper(model, touches=["ball"], **QUIET), mujoco.MjData(model)
    data.ctrl[0] = np.inf
    with pytest.raises(InputError, match=r"control\[0\] = inf: must be finite in environment 0"):
        pads.step(model, data)


def test_contacts_that_are_gone_are_not_read() -> None:
    model = lying()
    pads, data = PadStepper(model, **QUIET), mujoco.MjData(model)
    for _ in range(30):
        pads.step(model, data)
    beyond_add(pads, model, data)
    with pytest.raises(InputError, match="add = 'again'"):
        pads.add(model, data)
    with pytest.raises(InputError, match="MuJoCo has other contacts now"):
        pads.finish(model, data)
    pads.reset()
    for _ in range(30):
        pads.step(model, data)
    assert pads.wrench("sensor")[0, 2] == pytest.approx(-0.05 * 9.81, rel=0.05) and not pads.failed[0]


def test_two_threads_step_two_worlds_and_not_one() -> None:
    def world() -> TactileWorld:
        return TactileWorld(lying(BALL.format(0.00495, "")), num_envs=8, **QUIET)

    def run(one: TactileWorld) -> None:
        try:
            for _ in range(60):
                one.step()
        except InputError as error:
            errors.append(str(error))

    def together(worlds: list[TactileWorld]) -> None:
        threads = [threading.Thread(target=run, args=(one,)) for one in worlds]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    alone, errors = world(), []
    run(alone)
    two = [world(), world()]
    together(two)
    assert not errors
    for one in two:
        np.testing.assert_array_equal(one.state().wrench["sensor"], alone.state().wrench["sensor"])
    inside: list[str] = []

    def nested(data: mujoco.MjData, time: float) -> None:
        with pytest.raises(InputError, match="one thread at a time") as caught:
            alone.step()
        inside.append(str(caught.value))

    alone.step(nested)
    assert inside


def test_a_rigid_pad_acts_both_ways() -> None:
    with pytest.raises(InputError, match="coupling = 'one_way': is for soft pads"):
        TactileWorld("ball_rolling", coupling="one_way", **QUIET)
    assert TactileWorld("ball_rolling", **QUIET).coupling == "two_way"


def test_an_environment_that_failed_keeps_a_sound_observation() -> None:
    env = LiftCubeVectorEnv(num_envs=2, tactile=("wrench",))
    before, _ = env.reset(seed=0)
    for data in env.batch.world.data[:1]:
        data.qvel[:] = 1e6
    after, _, _, truncated, _ = env.step(np.zeros((2, env.batch.control.size), np.float32))
    assert truncated[0]
    for name, values in after.items():
        assert np.isfinite(values).all(), name
        assert np.abs(values[0]).max() < 50.0, name
    assert set(after) == set(before)
    env.close()
