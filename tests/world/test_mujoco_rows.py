"""Kernels on MuJoCo's memory: frames, contacts, constraint rows and forces are those that MuJoCo's own functions give."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from raytac.errors import BackendError
from raytac.robots import mujoco_memory
from raytac.robots.frames import body_poses, site_poses
from raytac.specs import BodySpec, RobotSpec, TaskScene, load_task
from raytac.world.engine.c_mujoco import CMujoco
from raytac.world.hard_contacts import is_hard
from raytac.world.pad_contact import PadIndices
from raytac.world.rigid_pads import RigidPads
from raytac.world.world import TactileWorld

CUBE = BodySpec("cube", "box", {"length": 0.012, "width": 0.012, "height": 0.01}, position=(0.0, 0.0, 0.0051), mass=0.05)
BALL = BodySpec("ball", "sphere", {"radius": 3e-3}, position=(0.0095, 0.0, 0.0032), mass=0.02, friction=0.3)


def pads_of(world: TactileWorld) -> RigidPads:
    assert isinstance(world._pads, RigidPads)
    return world._pads


def pressed(num_envs: int = 3) -> TactileWorld:
    """A cube and a ball that slide on one pad, differently in every environment."""
    scene = TaskScene("two", RobotSpec("fixed_sensor"), (CUBE, BALL))
    world = TactileWorld(replace(scene, timestep=2e-3, control_timestep=0.01), outputs=(), num_envs=num_envs)
    for b, data in enumerate(world.data):
        data.qvel[:] = np.random.default_rng(b).normal(0.0, 0.02, data.qvel.shape)
    return world


def half_a_step(world: TactileWorld) -> RigidPads:
    """Up to between MuJoCo's two halves."""
    pads, envs = pads_of(world), np.arange(world.num_envs)
    pads.engine.prepare()
    pads.contact.choose(envs, 0)
    pads.engine.begin_step()
    pads._insert()
    return pads


def test_frames_and_velocities_are_mujocos() -> None:
    world = TactileWorld("push_cube", outputs=(), num_envs=2)
    for b, data in enumerate(world.data):
        data.qvel[:] = np.random.default_rng(b).normal(0.0, 1.0, data.qvel.shape)
    pads = half_a_step(world)
    frames = {name: getattr(pads.contact.frames, name).numpy() for name in ("place", "turn", "velocity", "spin")}
    model, at = world.model, PadIndices.of(world.composed)
    site = int(at.sites[0])
    poses = [site_poses(world.data, site), *(body_poses(world.data, int(i)) for i in at.bodies)]
    for k, pose in enumerate(poses):
        np.testing.assert_array_equal(frames["place"][:, k], pose[:, :3, 3])
        np.testing.assert_array_equal(frames["turn"][:, k], pose[:, :3, :3])
    twist = np.zeros(6)
    for b, data in enumerate(world.data):
        objects = [(mujoco.mjtObj.mjOBJ_SITE, site), *((mujoco.mjtObj.mjOBJ_XBODY, int(i)) for i in at.bodies)]
        for k, (kind, index) in enumerate(objects):
            mujoco.mj_objectVelocity(model, data, kind, index, twist, 0)
            np.testing.assert_allclose(frames["spin"][b, k], twist[:3], atol=1e-12)
            np.testing.assert_allclose(frames["velocity"][b, k], twist[3:], atol=1e-12)


def test_free_accelerations_are_those_of_mujoco_without_constraints() -> None:
    world = TactileWorld("push_cube", outputs=(), num_envs=2)
    for b, data in enumerate(world.data):
        rng = np.random.default_rng(b)
        data.qvel[:], data.ctrl[:] = rng.normal(0.0, 1.0, data.qvel.shape), rng.normal(0.0, 5.0, data.ctrl.shape)
        data.xfrc_applied[:] = rng.normal(0.0, 1.0, data.xfrc_applied.shape)
    pads = half_a_step(world)
    push, swing = (getattr(pads.contact.frames, name).numpy() for name in ("push", "swing"))
    at = PadIndices.of(world.composed)
    model, bodies = world.model, [int(at.carriers[0]), *at.bodies.tolist()]
    for b, data in enumerate(world.data):
        mujoco.mj_forward(model, data)
        places = [data.site_xpos[int(at.sites[0])], *(data.xpos[body] for body in bodies[1:])]
        for k, (body, place) in enumerate(zip(bodies, places, strict=True)):
            linear, angular = np.zeros((2, 3, model.nv))
            mujoco.mj_jac(model, data, linear, angular, place, body)
            np.testing.assert_allclose(push[b, k], linear @ data.qacc_smooth, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(swing[b, k], angular @ data.qacc_smooth, rtol=1e-9, atol=1e-9)
        assert np.abs(push[b]).max() > 1.0


@pytest.mark.parametrize("jacobian", ["dense", "sparse"])
def test_rows_are_written_where_mujoco_keeps_them_and_their_forces_are_read_there(jacobian: str) -> None:
    world = pressed()
    world.model.opt.jacobian = getattr(mujoco.mjtJacobian, f"mjJAC_{jacobian.upper()}")
    for _ in range(4):
        world.step()
    pads = half_a_step(world)
    slots, contact = pads.contact.slots, pads.contact
    steps = contact.steps.length.numpy().copy()
    for b, data in enumerate(world.data):
        held = np.argwhere(slots.held.numpy()[b])
        assert len(held) == contact.steps.contacts.numpy()[b] == 2
        for k, (pad, body) in enumerate(held.tolist()):
            one, rows = data.contact[data.ncon - 2 + k], slice(data.nefc - 12 + 6 * k, data.nefc - 6 + 6 * k)
            assert one.efc_address == rows.start and one.dim == 6
            geoms = [int(world.model.geom(world.composed.sensors[0].gel).id), world.composed.touched[body].geoms[0]]
            assert one.geom.tolist() == geoms == [one.geom1, one.geom2]
            np.testing.assert_array_equal(one.pos, slots.place.numpy()[b, pad, body])
            np.testing.assert_array_equal(one.frame, slots.frame.numpy()[b, pad, body].ravel())
            np.testing.assert_array_equal(one.friction, slots.friction.numpy()[b, pad, body])
            inverse, force = slots.regularisation.numpy()[b, pad, body], slots.force.numpy()[b, pad, body]
            np.testing.assert_array_equal(data.efc_R[rows], inverse)
            np.testing.assert_array_equal(data.efc_D[rows], 1.0 / inverse)
            assert one.mu == pytest.approx(one.friction[0] * np.sqrt(inverse[1] / inverse[0]), rel=1e-14)
            wanted = force * inverse - data.efc_vel[rows] / steps[b]
            np.testing.assert_allclose(data.efc_aref[rows], wanted, rtol=1e-13, atol=1e-13 * np.abs(wanted).max())
    pads.engine.end_step()
    pads.finish(np.arange(3), world._states.failed)
    for b, data in enumerate(world.data):
        moved = np.zeros(data.nefc)
        mujoco.mj_mulJacVec(world.model, data, moved, data.qvel)
        held = slots.held.numpy()[b] != 0
        np.testing.assert_array_equal(contact.force.numpy()[b][held].ravel(), data.efc_force[-12:])
        np.testing.assert_allclose(contact.velocity.numpy()[b][held].ravel(), moved[-12:], atol=1e-14)


def test_hard_contacts_close_their_gaps_in_a_step_and_take_a_penetration_back_slowly() -> None:
    world = TactileWorld(load_task("push_cube"), outputs=(), num_envs=3)
    cube = world.composed.bodies["cube"].qpos
    for b, data in enumerate(world.data):
        data.qpos[cube + 2] += [-0.5e-3, 0.5e-3, 1e-3][b]
        data.qvel[world.model.nv - 6 :] = 0.1 * (b + 1)
    pads, hard = half_a_step(world), is_hard(world.model)
    some = opens = 0
    for data, step in zip(world.data, pads.contact.steps.length.numpy(), strict=True):
        for one in data.contact[: data.ncon]:
            if not hard[one.geom].any():
                continue
            free = np.zeros(data.nefc)
            mujoco.mj_mulJacVec(world.model, data, free, data.qacc_smooth)
            rows, some = slice(one.efc_address, one.efc_address + 3), some + 1
            wanted = -data.efc_vel[rows] / step
            wanted[0] -= (one.dist if one.dist > 0.0 else 0.1 * one.dist) / step**2
            ahead = one.dist + step * (data.efc_vel[rows] + step * free[rows])[0]
            if min(one.dist, ahead) > 20e-6:  # it stays open, and has no friction
                opens += 1
            assert (one.friction.max() < 1e-4) == (min(one.dist, ahead) > 20e-6)
            np.testing.assert_allclose(
                one.mu * data.efc_R[rows][0] ** 0.5, one.friction[0] * data.efc_R[rows][1] ** 0.5, rtol=1e-9
            )
            np.testing.assert_allclose(data.efc_aref[rows], wanted, rtol=1e-13, atol=1e-12)
    assert some >= 9 and 0 < opens < some


def test_states_may_be_replaced_by_others() -> None:
    """The kernels follow the states that the engine is bound to; those of a world stay its own."""
    world, other = pressed(2), pressed(2)
    engine, datas = pads_of(other).engine, other.data
    assert isinstance(engine, CMujoco)
    for _ in range(3):
        before, datas = datas, tuple(copy(data) for data in datas)
        for data in before:
            data.qpos[:] = data.xpos[:] = data.cvel[:] = np.nan
        engine.bind(datas)
        world.step()
        other.step()
    for one, two in zip(world.data, datas, strict=True):
        np.testing.assert_array_equal(one.qpos, two.qpos)
    with pytest.raises(AttributeError):
        world.data = datas  # type: ignore[misc]


def test_a_mujoco_that_keeps_its_states_otherwise_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for cached in (mujoco_memory.layout, mujoco_memory.checked_layouts):
        cached.cache_clear()
    monkeypatch.setitem(mujoco_memory._SIZES, "mjtBool", 8)
    try:
        with pytest.raises(BackendError, match="elsewhere than it declares"):
            mujoco_memory.checked_layouts()
    finally:
        for cached in (mujoco_memory.layout, mujoco_memory.checked_layouts):
            cached.cache_clear()
