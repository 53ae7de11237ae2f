"""Bodies that nothing touches, carried without a solve, against the same steps solved."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import ipc
from tests.ipc.conftest import bonded_pad, small_pad

CUDA = pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")])
DT = 0.01
TOLERANCE = 2e-8
"""Of a step [m], as of a soft scene."""


def on_a_face(radius: float) -> ipc.TriMesh:
    """A faceted ball that lies on one of its faces; on a vertex it would stand as a pencil does."""
    mesh = ipc.icosphere(radius, 1)
    vertices = np.asarray(mesh.vertices)
    a, b, c = vertices[np.asarray(mesh.faces)[0]]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    side = (b - a) / np.linalg.norm(b - a)
    return ipc.TriMesh(vertices @ np.stack([side, np.cross(side, normal), -normal], axis=1), mesh.faces)


def make_world(num_envs: int = 1, device: str = "cpu") -> ipc.World:
    """A pad of a GelSight gel, a ball that falls onto the ground, far from it, and a driven ball."""
    settings = ipc.Settings(
        dt=DT, d_hat=1e-4, friction=0.5, gravity=(0.0, 0.0, -9.81), velocity_tolerance=TOLERANCE / DT, linear_tolerance=1e-6
    )
    pad = bonded_pad(small_pad(), material=ipc.Material(4.3e5, 0.48, density=1100.0), pose=ipc.Pose((0.0, 0.0, 0.1)))
    free = ipc.AffineBody("free", on_a_face(5e-3), ipc.Stiff(density=1000.0), ipc.Pose((0.05, 0.0, 4.85e-3)))
    bodies = [pad, free, ipc.KinematicBody("ball", ipc.icosphere(4e-3, 1), ipc.Pose((-0.1, 0.0, 0.1))), ipc.HalfSpace("ground")]
    return ipc.World(bodies, settings, num_envs=num_envs, device=device)


def shaken(k: int) -> tuple[np.ndarray, np.ndarray]:
    """Position and rotation of a pad that is shaken by up to 1 g and turned by up to 1 rad/s and 20 rad/s²."""
    t = DT * k
    angle = 0.05 * np.sin(20.0 * t)
    position = np.array([2e-2 * (1.0 - np.cos(20.0 * t)), 1e-2 * np.sin(12.0 * t), 0.1 + 5e-3 * np.sin(9.0 * t)])
    return position, np.array([np.cos(0.5 * angle), 0.0, np.sin(0.5 * angle), 0.0])


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_a_pad_carried_lies_where_a_step_would_put_it(device: str) -> None:
    world = make_world(2, device)
    assert np.isinf(world.distance_from_rest()).all()
    for _ in range(30):  # until the ball lies still on the ground
        world.step()
    assert (world.distance_from_rest() < TOLERANCE).all()
    height, force = world.affine_pose("free")[1][:, 2], world.contact_forces("free").sum(axis=1)
    bent = 0.0
    for k in range(25):
        position, rotation = shaken(k)
        world.set_target("pad", position, rotation)
        world.step(envs=[0])
        world.carry(envs=[1])
        y = world.positions("pad", frame="body")
        rest = world.bodies[0].mesh.vertices  # type: ignore[union-attr]
        bent = max(bent, float(np.linalg.norm(y[0] - rest, axis=1).max()))
        assert np.linalg.norm(y[0] - y[1], axis=1).max() < TOLERANCE
        assert (world.distance_from_rest() < TOLERANCE).all()
        bond = world.wrench("pad")
        weight = np.linalg.norm(bond.force[0])
        # Under the force that the tolerance lets stand: about 15 N/mm of a layer of 12 mm x 12 mm x 4 mm, times it.
        assert np.abs(bond.force[0] - bond.force[1]).max() < 1e-2 * weight
        assert np.abs(bond.torque[0] - bond.torque[1]).max() < 1e-2 * weight * 6e-3
    assert bent > 20 * TOLERANCE  # it would not do to keep the shape
    assert np.array_equal(world.frame("pad")[1][0], world.frame("pad")[1][1])
    assert world.affine_pose("free")[1][:, 2] == pytest.approx(height, abs=2 * TOLERANCE)
    assert world.contact_forces("free").sum(axis=1) == pytest.approx(force, abs=1e-3 * np.abs(force).max())


def test_what_moves_or_is_bent_is_not_at_rest() -> None:
    world = make_world()
    for _ in range(30):
        world.step()
    assert world.distance_from_rest()[0] > 0.0
    still = world.save()
    world.restore(still)
    assert np.isinf(world.distance_from_rest()).all()  # how it came there is not known
    world.step()
    assert world.distance_from_rest()[0] < TOLERANCE
    world.set_gravity((0.0, 3.0, -9.0))
    assert np.isinf(world.distance_from_rest()).all()
    world.step()
    assert world.distance_from_rest()[0] > 1e3 * TOLERANCE  # the ball rolls
    world.restore(still)
    world.set_gravity((0.0, 0.0, -9.81))
    world.step()
    position = np.array([0.0, 0.0, 0.1 + 4.1e-3])  # above the pad, then into it and away again
    gap = []
    world.teleport("ball", position + np.array([0.0, 0.0, 1e-3]))
    for depth in (-0.5e-3, -0.1e-3, 0.3e-3, -0.5e-3, -1e-3, -1e-3):
        world.set_target("ball", position - np.array([0.0, 0.0, depth]))
        world.step()
        gap.append(world.distance_from_rest()[0])
    assert gap[2] > 1e-4 and max(gap[:2]) < TOLERANCE and gap[-1] < TOLERANCE < gap[3]


def test_a_driven_world_is_never_at_rest() -> None:
    cube = ipc.AffineBody("cube", ipc.icosphere(5e-3, 1), ipc.Stiff(density=1000.0), drive=100.0)
    world = ipc.World(
        [bonded_pad(small_pad(), pose=ipc.Pose((0.0, 0.0, 0.1))), cube], ipc.Settings(dt=DT, d_hat=1e-4), device="cpu"
    )
    world.step()
    assert np.isinf(world.distance_from_rest()).all()
    with pytest.raises(ipc.IpcError, match="drive"):
        world.carry()
