"""Sums over bodies and pairs on the device, against loops in NumPy, and their copies to the host."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import ipc
from tests.ipc.conftest import bonded_pad, small_pad
from tests.ipc.oracles import sums as oracle

DEVICES = [
    "cpu",
    pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")]),
]


def rubbed(device: str) -> ipc.World:
    """A tilted affine cube that a pad drags over a floor, with friction; the second environment is pressed deeper."""
    rotation = (np.cos(0.2), 0.0, 0.0, np.sin(0.2))
    half = 1.5e-3
    cube = ipc.AffineBody(
        "cube",
        ipc.box_surface((2.0 * half, 2.0 * half, 2.0 * half)),
        ipc.Stiff(density=2000.0),
        pose=ipc.Pose((0.0, 0.0, half + 0.12e-3), rotation),
    )
    lid = ipc.KinematicBody("lid", ipc.box_surface((8e-3, 8e-3, 2e-3)), ipc.Pose((0.0, 0.0, 2.0 * half + 0.24e-3 + 1e-3)))
    settings = ipc.Settings(dt=0.01, d_hat=1e-4, gravity=(0.0, 0.0, -9.81), friction=0.5)
    world = ipc.World([bonded_pad(small_pad()), cube, lid], settings, num_envs=2, device=device)
    start = world.frame("lid")[1]
    for k in range(1, 5):
        world.set_target("lid", start + [[k * 0.05e-3, 0.0, -k * 0.12e-3 * (1.0 + 0.1 * b)] for b in range(2)])
        assert world.step().converged.all()
    return world


@pytest.mark.parametrize("device", DEVICES)
def test_sums_are_those_of_loops_over_contacts_and_nodes(device: str) -> None:
    world = rubbed(device)
    pressing, layout = world.pressing(), world.layout
    assert {("pad", "cube"), ("cube", "lid")} <= set(pressing)
    for env in range(2):
        wanted = oracle.pair_sums(world, env)
        for names, (normal, place, wrench) in wanted.items():
            found = pressing[names]
            np.testing.assert_allclose(found.normal[env], normal, rtol=1e-10, atol=1e-12)
            np.testing.assert_allclose(found.place[env], place, atol=1e-12)
            np.testing.assert_allclose(found.wrench[env], wrench, rtol=1e-9, atol=1e-11)
            assert np.linalg.norm(wrench[:3] - normal) > 1e-3  # friction counts
        for name in ("cube", "pad"):
            motion = world.rigid_motion(name)
            found = (motion.mass, motion.centre[env], motion.inertia[env], motion.velocity[env], motion.spin[env])
            scales = (1e-14, 1e-12, 1e-18, 1e-11, 1e-6)
            for one, other, scale in zip(found, oracle.rigid_motion(world, name, env), scales, strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-8, atol=scale)
    host = world.sums.host
    for name in ("pad", "cube", "lid"):
        body, forces = layout.names.index(name), world.contact_forces(name)
        np.testing.assert_allclose(host["force"][:, body], forces.sum(axis=1), rtol=1e-10, atol=1e-12)
        vertices, _ = world.surface(name)
        x = world.positions(name)[:, vertices] if name == "pad" else world.positions(name)
        torque = np.cross(x - host["position"][:, None, body], forces).sum(axis=1)
        np.testing.assert_allclose(host["torque"][:, body], torque, rtol=1e-9, atol=1e-13)
        area = layout.vert_area[layout.vert_start[body] : layout.vert_start[body + 1]]
        np.testing.assert_allclose(host["area"][:, body], (np.linalg.norm(forces, axis=2) > 0.0) @ area, rtol=1e-12)
    pad = layout.names.index("pad")
    low, high = world.positions("pad", frame="body").min(axis=1), world.positions("pad", frame="body").max(axis=1)
    np.testing.assert_array_equal((host["low"][:, pad], host["high"][:, pad]), (low, high))
    matrix, place = world.affine_pose("cube")
    u, _, v = np.linalg.svd(matrix)
    cube = layout.names.index("cube")
    np.testing.assert_allclose(host["rotation"][:, cube], u @ v, atol=1e-12)
    np.testing.assert_allclose(host["position"][:, cube], place, atol=1e-15)


def test_the_host_has_one_copy_of_each_state() -> None:
    world = rubbed("cpu")
    before = world.sums.copies
    for _ in range(3):
        first = world.sums.host
        world.pressing()
        world.rigid_motion("cube")
    assert world.sums.copies == before + 1 and world.sums.host is first
    state, area = world.save(), first["area"].copy()
    world.restore(state)
    assert world.sums.host["area"].max() == 0.0 < area.max()  # forces belong to a step
    world.set_velocity("cube", (0.1, 0.0, 0.0))
    np.testing.assert_allclose(world.rigid_motion("cube").velocity, [[0.1, 0.0, 0.0]] * 2, atol=1e-12)
    with pytest.raises(ValueError, match="read-only"):
        world.sums.host["area"][:] = 1.0


def test_forces_between_bodies_are_in_balance() -> None:
    """Of each pair what acts on one side acts on the other; all on a body is what its pairs say."""
    world = rubbed("cpu")
    host, names = world.sums.host, world.layout.names
    total = {name: np.zeros((2, 6)) for name in names}
    for (one, two), pair in world.pressing().items():
        for name, sign in ((one, 1.0), (two, -1.0)):
            arm = pair.place - host["position"][:, names.index(name)]
            force, torque = pair.wrench[:, :3], pair.wrench[:, 3:] + np.cross(arm, pair.wrench[:, :3])
            total[name] += sign * np.concatenate([force, torque], axis=1)
    for name in ("pad", "cube", "lid"):
        body = names.index(name)
        wrench = np.concatenate([host["force"][:, body], host["torque"][:, body]], axis=1)
        np.testing.assert_allclose(wrench[:, :3], total[name][:, :3], atol=1e-9)
        # A pair acts where its first body is touched; the second one is up to d̂ away from there.
        loads = np.sum(
            [np.linalg.norm(one.wrench[:, :3], axis=1) for names, one in world.pressing().items() if name in names], axis=0
        )
        assert (np.linalg.norm(wrench[:, 3:] - total[name][:, 3:], axis=1) < world.d_hat * loads).all() and (loads > 0.01).all()
