"""Steps that do not converge: taken back, and repeated in halves."""

from __future__ import annotations

import numpy as np
import pytest

import ipc
from tests.ipc.conftest import bonded_pad, small_pad, unit_cell

START = 4.12e-3
DEPTH = 0.8e-3
"""A step of this takes 10 Newton iterations, and each half of it 7."""
FEW = 8


def press_world(num_envs: int = 1, **settings: object) -> ipc.World:
    """A ball over a pad, and a cube that falls beside them."""
    ball = ipc.KinematicBody("ball", ipc.icosphere(4e-3, 2), ipc.Pose((1e-4, 2e-4, START)))
    mesh = ipc.TetMesh(1e-3 * unit_cell(1).vertices + [0.1, 0.0, 0.0], unit_cell(1).tets)
    options: dict = {"d_hat": 1e-4, "max_newton": FEW} | settings
    bodies = [bonded_pad(small_pad()), ball, ipc.SoftBody("cube", mesh, ipc.Material(1e5))]
    world = ipc.World(bodies, ipc.Settings(**options), num_envs=num_envs, device="cpu")
    world.set_velocity("cube", (0.0, 0.0, -0.1))
    return world


def press(world: ipc.World, depth: np.ndarray | float, dt: float | None = None) -> ipc.StepReport:
    depth = np.broadcast_to(depth, world.num_envs)
    world.set_target("ball", np.stack([np.full_like(depth, 1e-4), np.full_like(depth, 2e-4), START - depth], axis=1))
    return world.step(dt)


def test_a_step_that_does_not_converge_is_two_halves() -> None:
    """To the bit, in state, velocities and forces; the report tells both, and the attempt before them."""
    world, halves = press_world(), press_world(halvings=0)
    report = press(world, DEPTH)
    parts = [press(halves, 0.5 * DEPTH, 0.005), press(halves, DEPTH, 0.005)]
    assert report.converged.all() and report.halved.all() and all(r.converged.all() and not r.halved.any() for r in parts)
    assert report.newton[0] == FEW + sum(r.newton[0] for r in parts) and report.blocked[0] == 0.0
    for name in ("min_gap", "min_det"):
        assert getattr(report, name)[0] == min(getattr(r, name)[0] for r in parts)
    for name in ("pad", "cube"):
        assert np.array_equal(world.positions(name), halves.positions(name))
        assert np.array_equal(world.velocities(name), halves.velocities(name))
    assert np.array_equal(world.contact_forces("pad"), halves.contact_forces("pad")) and world.wrench("ball").force[0, 2] > 0.05
    # The next step is as long as ever, and goes on from there.
    assert np.array_equal(world.frame("ball")[1], halves.frame("ball")[1])
    later, other = press(world, DEPTH), press(halves, DEPTH)
    assert later.converged.all() and not later.halved.any() and later.newton[0] == other.newton[0]
    assert np.array_equal(world.positions("cube"), halves.positions("cube"))


def test_without_halvings_the_state_is_kept() -> None:
    report = press(world := press_world(halvings=0), DEPTH)
    assert not report.converged.any() and not report.halved.any() and report.newton[0] == FEW
    assert world.wrench("ball").force[0, 2] > 0.05


def test_other_environments_are_not_touched() -> None:
    batch, alone = press_world(3), press_world(1)
    report = press(batch, np.array([0.0, DEPTH, 0.2e-3]))
    assert report.converged.all() and report.halved.tolist() == [False, True, False]
    press(alone, 0.2e-3)
    for name in ("pad", "cube"):
        assert np.array_equal(batch.positions(name)[2], alone.positions(name)[0])
    assert np.array_equal(batch.contact_forces("pad")[2], alone.contact_forces("pad")[0])
    deep = press_world(1)
    press(deep, DEPTH)
    assert np.array_equal(batch.positions("pad")[1], deep.positions("pad")[0])


def test_a_half_is_halved_again() -> None:
    """1.2 mm: the first half takes 9 iterations, its halves fewer."""
    world = press_world()
    assert press(world, 1.2e-3).converged.all()
    once = press(world := press_world(halvings=1), 1.2e-3)
    assert once.halved.all() and not once.converged.any()
    assert world.frame("ball")[1][0, 2] == START - 1.2e-3


def test_a_step_that_nothing_helps_says_so() -> None:
    """It ends after the whole, a half, a quarter and the rest; surfaces are apart, and the ball is where the report says."""
    world = press_world(max_newton=2)
    report = press(world, 1.2e-3)
    assert report.halved.all() and not report.converged.any() and not report.failed.any()
    assert report.newton[0] == 4 * 2 and report.min_gap[0] > 0 and world.overlap() is None
    moved = (START - world.frame("ball")[1][0, 2]) / 1.2e-3
    assert 0.0 < moved < 1.0 and report.blocked[0] == pytest.approx(1.0 - moved, abs=1e-9)


def test_halvings_are_counted_in_whole_numbers() -> None:
    with pytest.raises(ipc.IpcError, match="halvings = -1: it cannot be negative"):
        ipc.Settings(halvings=-1)
