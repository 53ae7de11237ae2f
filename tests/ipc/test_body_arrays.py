"""Arrays of the device against what the world copies to NumPy, and their memory, which other libraries share."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

import ipc
from tests.ipc.conftest import bonded_pad, small_pad

RADIUS, GAP = 4e-3, 1.2e-4
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")]),
]


def pressed(device: str, num_envs: int = 2) -> ipc.World:
    """A ball on a pad and a small cube beside it, after two steps in contact; the second environment is pressed deeper."""
    ball = ipc.KinematicBody("ball", ipc.icosphere(RADIUS, 2), ipc.Pose((0.0, 0.0, RADIUS + GAP)))
    cube = ipc.AffineBody("cube", ipc.box_surface((2e-3, 2e-3, 2e-3)), pose=ipc.Pose((0.0, 0.0, 0.05)))
    floor = ipc.HalfSpace("floor", pose=ipc.Pose((0.0, 0.0, -0.1)))
    settings = ipc.Settings(dt=0.01, d_hat=1e-4, gravity=(0.0, 0.0, -9.81))
    world = ipc.World([bonded_pad(small_pad()), ball, cube, floor], settings, num_envs=num_envs, device=device)
    start = world.frame("ball")[1]
    for k in (1, 2):
        world.set_target("ball", start - [[0.0, 0.0, k * 0.1e-3 * (1.0 + 0.2 * b)] for b in range(num_envs)])
        assert world.step().converged.all()
    return world


def shared(array: Any) -> Any:
    """The memory of an array of the CPU by DLPack; a copy of one on CUDA."""
    return np.from_dlpack(array) if array.device.is_cpu else array.numpy()


@pytest.mark.parametrize("device", DEVICES)
def test_arrays_of_the_device_are_what_numpy_gets(device: str) -> None:
    world = pressed(device)
    for name in ("pad", "ball", "cube"):
        arrays = world.arrays(name)
        vertices, positions = world.surface(name)[0], world.positions(name)
        expected = positions[:, vertices] if name == "pad" else positions
        assert np.abs(shared(arrays.vertices) - expected).max() < 1e-15
        assert np.array_equal(shared(arrays.forces), world.contact_forces(name))
    pad, cube = world.arrays("pad"), world.arrays("cube")
    assert np.abs(shared(pad.forces)[:, :, 2].sum(axis=1)).min() > 1e-3  # something is pressed
    assert np.array_equal(shared(pad.nodes), world.positions("pad", frame="body"))
    assert np.array_equal(shared(cube.velocities), world.velocities("cube")) and np.abs(shared(cube.velocities)).max() > 0.01
    rotation, position = world.frame("ball")
    ball = world.arrays("ball")
    assert np.array_equal(shared(ball.rotation), rotation) and np.array_equal(shared(ball.position), position)
    assert ball.nodes.shape == (2, 0) and world.arrays("floor").vertices.shape == (2, 0)
    contacts = world.contact_arrays()
    for env in range(2):
        known, count = world.contacts(env), int(shared(contacts.count)[env])
        assert count == len(known.force) > 0
        assert np.array_equal(shared(contacts.force)[env, :count], known.force)
        assert np.array_equal(shared(contacts.normal)[env, :count], known.normal)
    with pytest.raises(ipc.IpcError, match="choose from pad"):
        world.arrays("bell")


def test_memory_is_shared_and_follows_the_world() -> None:
    """An array that was asked for once has the state of every later step, and that of a reset, without a copy."""
    world = pressed("cpu")
    arrays = world.arrays("pad")
    vertices: Any = np.from_dlpack(arrays.vertices)
    forces: Any = np.from_dlpack(arrays.forces)
    assert not vertices.flags.owndata and vertices.ctypes.data == arrays.vertices.ptr
    before = vertices.copy(), forces.copy()
    world.set_target("ball", world.frame("ball")[1] - [0.0, 0.0, 0.1e-3])
    world.step()
    assert np.abs(vertices - before[0]).max() > 1e-5 and np.abs(forces - before[1]).max() > 1e-4
    assert np.array_equal(forces, world.contact_forces("pad"))
    world.reset([0])
    assert not forces[0].any() and forces[1].any()
    assert np.array_equal(vertices[0], world.positions("pad")[0, world.surface("pad")[0]])
