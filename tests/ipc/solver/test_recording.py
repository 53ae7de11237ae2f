"""A step as one recorded graph on a CPU, and the steps of a world that is not recorded."""

from __future__ import annotations

import numpy as np
import pytest

import ipc


def pressed(graph: bool, room: int | None = None, envs: int = 2, steps: int = 7) -> tuple[ipc.World, list[ipc.StepReport]]:
    """A ball pressed into a block, turned and pushed aside, differently deep in each environment."""
    x, z = np.linspace(-4e-3, 4e-3, 5), np.linspace(0.0, 3e-3, 3)
    mesh = ipc.box_mesh(x, x, z)
    base = np.flatnonzero(mesh.vertices[:, 2] < mesh.vertices[:, 2].min() + 1e-9)
    top = float(mesh.vertices[:, 2].max())
    pad = ipc.SoftBody("pad", mesh, ipc.Material(1e5, 0.45, 1000.0), bonded=base)
    ball = ipc.KinematicBody("ball", ipc.icosphere(2e-3, 2), ipc.Pose((0, 0, top + 2.15e-3)))
    world = ipc.World([pad, ball], ipc.Settings(d_hat=1e-4, friction=0.5, graph=graph), num_envs=envs, device="cpu")
    if room is not None:
        world._potential.collision._size_contacts(room, room)
        world._potential.collision._size_candidates(room, room)
    reports = []
    for k in range(steps):
        depth = 1e-4 * min(k + 1, 5) * (1.0 + 0.3 * np.arange(envs))
        place = np.stack([1e-5 * k * np.ones(envs), np.zeros(envs), top + 2.15e-3 - depth], axis=1)
        half = 0.02 * min(k + 1, 5)
        world.set_target("ball", place, rotation=(np.cos(half), np.sin(half), 0.0, 0.0))
        reports.append(world.step())
    return world, reports


@pytest.mark.parametrize("room", [None, 1])
def test_recorded_steps_have_the_same_bits(room: int | None) -> None:
    """Also where buffers grow under a recording."""
    (plain, before), (recorded, after) = pressed(False), pressed(True, room)
    assert recorded._newton._graphs["_whole"] is not None and not plain._newton._graphs
    for one, other in zip(before, after, strict=True):
        assert one.converged.all() and np.array_equal(one.newton, other.newton) and np.array_equal(one.linear, other.linear)
    assert before[-1].newton.min() >= 2
    np.testing.assert_array_equal(plain.positions("pad"), recorded.positions("pad"))
    np.testing.assert_array_equal(plain.wrench("ball").force, recorded.wrench("ball").force)
    assert plain.wrench("ball").force[0, 2] > 0.01


def test_a_recorded_batch_has_the_bits_of_its_single_worlds() -> None:
    batch, _ = pressed(True)
    single, _ = pressed(True, envs=1)
    np.testing.assert_array_equal(batch.positions("pad")[0], single.positions("pad")[0])
    assert not np.array_equal(batch.positions("pad")[0], batch.positions("pad")[1])


def test_a_recorded_step_takes_other_targets_lengths_and_environments() -> None:
    """What a recording must not have fixed: gravity, the length of a step, the environments that take part."""
    ends = []
    for graph in (False, True):
        world, _ = pressed(graph)
        state = world.save()
        world.set_gravity((0.0, 0.0, -50.0))
        world.step(dt=0.02, envs=[1])
        ends.append((world.positions("pad").copy(), world.velocities("pad").copy()))
        np.testing.assert_array_equal(world.positions("pad")[0], state.y[0, : world.positions("pad").shape[1]])
    for a, b in zip(*ends, strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.abs(ends[0][1][1]).max() > 0


def test_stages_are_timed_without_a_recording() -> None:
    (plain, _), (recorded, _) = pressed(False), pressed(True)
    assert set(recorded.timers) == {"step"} and len(plain.timers) > 5
    assert sum(seconds for name, seconds in plain.timers.items() if name != "step") < plain.timers["step"]
