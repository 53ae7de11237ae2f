"""MuJoCo Warp under pads does what C MuJoCo does, world by world, and loses no contact silently."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from copy import copy
from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
import warp as wp

from raytac import PadStepper, mount
from raytac.errors import InputError
from raytac.robots.frames import body_poses, site_poses
from raytac.specs import load_task
from raytac.world.compose import compose
from raytac.world.environment_models import EnvironmentModels, Variation
from raytac.world.gel_pairs import GelPairs
from raytac.world.pad_contact import PadIndices, gel_contact
from raytac.world.world_model import WorldModel, own_world_model
from tests.world.beside import POSES, SPEED, free_fall, scene
from tests.world.test_implicit_damping import plunger

mujoco_warp = pytest.importorskip("mujoco_warp")
from raytac.world.engine.mjwarp import MujocoWarp  # noqa: E402

pytestmark = pytest.mark.timeout(1200)  # the first test compiles MuJoCo Warp for the CPU: minutes

G, RADIUS = 9.81, 5e-3
MASSES = 0.05, 0.02
TOUCHES = {"ball": 0.3}


@cache
def ball_on_pad(mass: float = MASSES[0], timestep: float = 1e-3, jacobian: str = "dense") -> mujoco.MjModel:
    """A pad that lies on its back, and a ball on the middle of it."""
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep, option.impratio, option.tolerance = timestep, 10.0, 1e-10
    option.cone, option.integrator = mujoco.mjtCone.mjCONE_ELLIPTIC, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.jacobian = getattr(mujoco.mjtJacobian, f"mjJAC_{jacobian.upper()}")
    mount(spec, "gelsight_mini", body="world", name="pad", pose=np.eye(4))
    ball = spec.worldbody.add_body(name="ball", pos=(0.0, 0.0, RADIUS - 1e-4))
    ball.add_freejoint()
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(RADIUS, 0.0, 0.0), mass=mass)
    return spec.compile()


class Models(EnvironmentModels):
    """Models that are given."""

    def __init__(self, composed: WorldModel, models: Sequence[mujoco.MjModel]) -> None:
        super().__init__(composed, len(models))
        self._given = list(models)
        self.inverse_weight[:] = [model.body_invweight0[:, 0] for model in models]

    def __getitem__(self, env: int) -> mujoco.MjModel:
        return self._given[env]


class Warped:
    """Worlds on MuJoCo Warp with all that a step needs."""

    def __init__(self, models: Sequence[mujoco.MjModel], composed: WorldModel, device: str = "cpu", **options: Any) -> None:
        count, pads = len(models), PadIndices.of(composed)
        numbers = Models(composed, models)
        pairs = GelPairs([spec.gelpad for spec in composed.sensor_specs], pads.carriers, count, device=device).pairs
        self.contact = gel_contact(composed, numbers, pairs, num_envs=count, device=device)
        self.engine = MujocoWarp(self.contact, pads, numbers, **options)
        start, ctrl = (np.repeat(values[None], count, axis=0) for values in (composed.start, composed.ctrl))
        self._start = [wp.array(values, dtype=wp.float32, device=device) for values in (start, ctrl)]
        self.reset(self.engine.active)
        self.data, self.step = self.engine.data, self.engine.advance

    @classmethod
    def balls(
        cls,
        masses: Sequence[float] = MASSES,
        device: str = "cpu",
        *,
        timestep: float = 1e-3,
        jacobian: str = "dense",
        **options: Any,
    ) -> Warped:
        models = [ball_on_pad(mass, timestep, jacobian) for mass in masses]
        return cls(models, own_world_model(models[0], touches=TOUCHES), device, **options)

    def reset(self, chosen: wp.array) -> None:
        self.engine.reset(chosen, *self._start)

    def apply(self, force: np.ndarray) -> None:
        """Forces and torques (B, 6) on the last body."""
        values = np.zeros_like(self.data.xfrc_applied.numpy())
        values[:, -1] = force
        self.data.xfrc_applied.assign(values)

    def lift(self, env: int, height: float) -> None:
        """Put one ball above the pad."""
        qpos = self.data.qpos.numpy().copy()
        qpos[env, 2] += height
        self.data.qpos.assign(qpos)

    def state(self) -> np.ndarray:
        return np.concatenate([self.data.qpos.numpy(), self.data.qvel.numpy()], axis=1).astype(float)

    def wrench(self) -> np.ndarray:
        return self.contact.wrenches.numpy()[:, 0]


def drag(step: int, mass: float) -> np.ndarray:
    """Press the ball for 40 steps, then drag it with a torque by which it slides, then let go."""
    force, weight = np.zeros(6), mass * G
    force[2] = -min(step / 40, 1.0) * weight
    if 40 <= step < 80:
        force[0], force[4] = 0.7 * weight, -0.6 * weight * RADIUS
    return force


@pytest.mark.parametrize(
    ("device", "jacobian"),
    [
        ("cpu", "dense"),
        pytest.param("cpu", "sparse", marks=pytest.mark.slow),
        pytest.param("cuda", "dense", marks=pytest.mark.gpu),
    ],
)
def test_balls_that_are_pressed_and_dragged_move_as_in_c_mujoco(device: str, jacobian: str) -> None:
    """Two masses; the gel sticks, slips and sticks again."""
    warped, slides, touched = Warped.balls(device=device, jacobian=jacobian), 0, 0
    worlds = [(model, mujoco.MjData(model), PadStepper(model, touches=TOUCHES)) for model in map(ball_on_pad, MASSES)]
    for step in range(120):
        forces = np.array([drag(step, mass) for mass in MASSES])
        warped.apply(forces)
        warped.step()
        slides += int(warped.contact.steps.solves.numpy().any())
        for b, (model, data, pads) in enumerate(worlds):
            mujoco.mj_step1(model, data)
            data.xfrc_applied[-1] = forces[b]
            pads.add(model, data)
            mujoco.mj_step2(model, data)
            pads.finish(model, data)
        wanted = np.array([pads.wrench("pad")[0] for _, _, pads in worlds])
        np.testing.assert_allclose(warped.state()[:, :3], [data.qpos[:3] for _, data, _ in worlds], atol=1e-5)
        size = np.linalg.norm(wanted[:, :3], axis=1)
        off = np.linalg.norm((warped.wrench() - wanted)[:, :3], axis=1)
        assert (off <= 0.01 * size).all(), step
        np.testing.assert_array_equal(warped.wrench().any(axis=1), size > 0.0)
        touched += np.count_nonzero(size)
    warped.engine.check_overflow()
    assert slides > 0 and touched > 200  # lifts were corrected
    assert np.abs(warped.state()[:, 0]).min() > 1e-4


@pytest.mark.parametrize(("launches", "fits"), [(1, False), (16, True)])
def test_a_step_is_divided_where_a_ball_falls_onto_a_pad(launches: int, *, fits: bool) -> None:
    """One ball hits the pad in the second step, one falls all the time; each is as in C MuJoCo, which divides as it needs."""
    warped, model = Warped.balls((MASSES[0],) * 2, timestep=4e-3), ball_on_pad(MASSES[0], 4e-3)
    datas, pads = [mujoco.MjData(model) for _ in range(2)], PadStepper(model, touches=TOUCHES, num_envs=2)
    for b, height in enumerate((1e-3, 30e-3)):
        warped.lift(b, height)
        datas[b].qpos[2] += height
        datas[b].qvel[2] = -0.1
    warped.data.qvel.assign(np.array([data.qvel for data in datas]))
    off = []
    for _ in range(8):
        pads.step(model, datas)
        warped.step(launches=launches)
        off.append(warped.state()[:, 2] - [data.qpos[2] for data in datas])
        assert warped.wrench().any(axis=1).tolist() == pads.wrench("pad").any(axis=1).tolist()
    assert pads.wrench("pad").any(axis=1).tolist() == [True, False]
    np.testing.assert_allclose(warped.data.time.numpy(), 32e-3, rtol=1e-6)
    assert np.abs(off)[:, 1].max() < 1e-6 and (np.abs(off)[:, 0].max() < 1e-5) == fits


@pytest.mark.parametrize("kind", ["joint", "servo"])
def test_forces_know_of_the_damping_of_a_step(kind: str) -> None:
    """A ball on a damper that a step does not resolve, which a force pushes into a gel; C MuJoCo with pads does the same."""
    world = plunger("implicitfast", 10e-3, kind)
    warped, forces = Warped([world.model], world.composed), []
    for _ in range(4):
        wanted = world.step().wrench["pad"][0]
        warped.step(launches=48)  # as many as C MuJoCo may need
        np.testing.assert_allclose(warped.state()[:, 0], world.data[0].qpos[0], atol=1e-7)
        np.testing.assert_allclose(warped.wrench()[:, 2], wanted[2], atol=1e-3)
        forces.append(wanted[2])
    assert forces[-1] < -1.0


def test_a_world_without_touch_moves_as_mujoco_warp_alone() -> None:
    """Also if a world beside it touches, and to the bit."""
    warped = Warped.balls()
    warped.lift(1, 0.01)
    model = copy(ball_on_pad())
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    alone, data = mujoco_warp.put_model(model), mujoco_warp.make_data(model, nworld=2)
    data.qpos.assign(warped.data.qpos.numpy())
    for _ in range(20):
        warped.step()
        mujoco_warp.step(alone, data)
    assert warped.wrench()[0].any() and not warped.wrench()[1].any()
    np.testing.assert_array_equal(warped.data.qpos.numpy()[1], data.qpos.numpy()[1])
    np.testing.assert_array_equal(warped.data.qvel.numpy()[1], data.qvel.numpy()[1])


def test_a_world_that_breaks_down_stands_still_and_leaves_the_others_to_the_bit() -> None:
    sound, broken = Warped.balls(), Warped.balls()
    for _ in range(5):
        sound.step()
        broken.step()
    before, force = broken.state(), np.zeros((2, 6))
    force[1, 0] = np.inf
    broken.apply(force)
    broken.step()
    sound.step()
    assert broken.contact.steps.lost.numpy().tolist() == [0, 1]
    np.testing.assert_array_equal(broken.state()[1], before[1])
    broken.apply(np.zeros((2, 6)))
    assert broken.engine.active.numpy().tolist() == [True, False]
    for _ in range(3):
        broken.step()
        sound.step()
    np.testing.assert_array_equal(broken.state(), [sound.state()[0], before[1]])
    assert broken.data.time.numpy()[1] < sound.data.time.numpy()[1]


def test_a_reset_of_some_worlds_leaves_the_others_to_the_bit() -> None:
    one, other, fresh = Warped.balls(), Warped.balls(), Warped.balls()
    for step in range(30):
        force = np.array([drag(step, mass) for mass in MASSES])
        for warped in (one, other):
            warped.apply(force)
            warped.step()
    one.reset(wp.array([False, True], dtype=wp.bool))
    one.contact.clear(np.array([1]))
    np.testing.assert_array_equal(one.state()[1], fresh.state()[1])
    for step in range(20):
        force = np.array([drag(30 + step, MASSES[0]), drag(step, MASSES[1])])
        for warped, rows in ((one, (0, 1)), (other, (0, 0)), (fresh, (1, 1))):
            warped.apply(force[list(rows)])
            warped.step()
    np.testing.assert_array_equal(one.state(), [other.state()[0], fresh.state()[1]])
    np.testing.assert_array_equal(one.wrench(), [other.wrench()[0], fresh.wrench()[1]])


def test_a_body_beyond_a_bonded_face_ends_its_world() -> None:
    warped = Warped.balls()
    warped.lift(1, -4e-3)
    before = warped.state()
    warped.step()
    assert warped.engine.active.numpy().tolist() == [True, False]
    np.testing.assert_array_equal(warped.state()[1], before[1])
    assert warped.wrench()[0].any() and not warped.wrench()[1].any()


@pytest.mark.parametrize(
    ("options", "name"),
    [({"contacts": 0, "rows": 64}, "contacts"), ({"rows": 5}, "rows")],
)
def test_memory_that_is_too_small_is_an_error_that_names_the_number(options: dict[str, Any], name: str) -> None:
    warped = Warped.balls(**options)
    warped.engine.check_overflow()
    for _ in range(3):
        warped.step()
    assert not warped.engine.active.numpy().all()
    warped.reset(wp.array([True, True], dtype=wp.bool))  # which does not hide it
    with pytest.raises(InputError, match="or more") as error:
        warped.engine.check_overflow()
    assert error.value.name == name
    least = int(str(error.value.rule).split()[2])
    enough = Warped.balls(**{**options, name: least})
    enough.step()
    enough.engine.check_overflow()
    assert enough.wrench().any(axis=1).all()


def test_an_option_with_which_pads_cannot_act_is_refused() -> None:
    model, composed = copy(ball_on_pad()), own_world_model(ball_on_pad(), touches=TOUCHES)
    for option, value in (("cone", mujoco.mjtCone.mjCONE_PYRAMIDAL), ("integrator", mujoco.mjtIntegrator.mjINT_EULER)):
        wrong = copy(model)
        setattr(wrong.opt, option, value)
        with pytest.raises(InputError, match=f"model.opt.{option}"):
            Warped([wrong], composed)


@pytest.mark.parametrize("timestep", [2e-3, 1e-2])
def test_boxes_fall_freely_beside_a_case(timestep: float) -> None:
    """As on C MuJoCo; one world for each pose."""
    composed = compose(scene(timestep), "rigid")
    worlds = Warped([composed.model] * len(POSES), composed)
    worlds.data.qpos.assign(np.array(list(POSES.values()), np.float32))
    velocity = np.zeros((len(POSES), 6), np.float32)
    velocity[:, 2] = -SPEED
    worlds.data.qvel.assign(velocity)
    for k in range(round(0.05 / timestep)):
        worlds.step()
        expected = np.tile(free_fall(timestep * (k + 1)), (len(POSES), 1))
        np.testing.assert_allclose(worlds.data.qvel.numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("task", ["push_cube", "balance_pole", "lift_cube", "roll_ball"])
def test_models_of_the_tasks_are_taken(task: str) -> None:
    composed = compose(load_task(task), "rigid")
    engine = Warped([composed.model] * 2, composed).engine
    assert engine.data.qpos.shape == (2, composed.model.nq) and engine.model.nmaxcondim == 6
    engine.update_poses()
    state = mujoco.MjData(composed.model)
    composed.reset(composed.model, state)
    mujoco.mj_kinematics(composed.model, state)
    pads, bodies = engine.read_poses()
    for found, site in zip(pads[1], PadIndices.of(composed).sites.tolist(), strict=True):
        np.testing.assert_allclose(found, site_poses([state], site)[0], atol=1e-6)
    for found, body in zip(bodies[1], composed.touched, strict=True):
        np.testing.assert_allclose(found, body_poses([state], body.index)[0], atol=1e-6)
    assert not engine.invalid().any()


@pytest.mark.parametrize(("task", "body"), [("push_cube", "cube"), ("lift_cube", "object")])
def test_a_variation_reaches_all_that_mujoco_derives_from_it(task: str, body: str) -> None:
    composed = compose(load_task(task), "rigid")
    models, pads = EnvironmentModels(composed, 2), PadIndices.of(composed)
    contact = gel_contact(composed, models, [], num_envs=2)
    engine = MujocoWarp(contact, pads, models)
    sensor, shift = composed.sensors[0].name, np.eye(4)
    shift[:3, 3] = 1e-3, -2e-3, 0.5e-3
    factors = {body: np.array([1.7])}
    models.vary([1], Variation(mass=factors, friction=factors, mounting={sensor: shift[None]}))
    engine.prepare()
    fields = [f.name for f in dataclasses.fields(engine.model) if isinstance(getattr(engine.model, f.name), wp.array)]
    shared = [name for name in fields if isinstance(getattr(models[0], name, None), np.ndarray)]
    assert {"body_mass", "geom_friction", "body_pos", "dof_invweight0"} <= set(shared)
    for name in shared:
        one, two = (np.asarray(getattr(models[b], name), np.float32).ravel() for b in range(2))
        if not np.array_equal(one, two):
            found = getattr(engine.model, name).numpy().reshape(2, -1)
            np.testing.assert_array_equal(found, [one, two], err_msg=name)
    engine.reset(engine.active, *(wp.array(np.stack([v, v]), dtype=wp.float32) for v in (composed.start, composed.ctrl)))
    engine.update_poses()
    state = mujoco.MjData(models[1])
    composed.reset(models[1], state)
    mujoco.mj_kinematics(models[1], state)
    np.testing.assert_allclose(engine.read_poses()[0][1, 0], site_poses([state], int(pads.sites[0]))[0], atol=1e-6)


@pytest.mark.gpu
def test_a_recorded_step_is_the_step() -> None:
    one, two = (Warped.balls(device="cuda") for _ in range(2))
    again = two.engine.capture(two.step)
    one.step()
    for _ in range(40):
        one.step()
        again()
    np.testing.assert_allclose(one.state(), two.state(), rtol=0.0, atol=1e-6)
