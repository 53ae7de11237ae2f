"""Presses on a bonded pad: balance of forces, batches, state, drives that cannot be followed, and what is refused."""

from __future__ import annotations

import ipctk
import numpy as np
import pytest
import warp as wp

import ipc
from ipc.reduce import BLOCK
from ipc.solver.pcg import Pcg
from tests.ipc.conftest import bonded_pad, small_pad

RADIUS = 4e-3
GAP = 1.2e-4
CUDA = pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")])


def make_world(num_envs: int = 1, friction: float = 0.0, device: str = "cpu", **settings: object) -> ipc.World:
    options: dict = {"dt": 0.01, "d_hat": 1e-4, "friction": friction} | settings
    ball = ipc.KinematicBody("ball", ipc.icosphere(RADIUS, 2), ipc.Pose((0.0, 0.0, RADIUS + GAP)))
    return ipc.World([bonded_pad(small_pad()), ball], ipc.Settings(**options), num_envs=num_envs, device=device)


def press(world: ipc.World, depth: float | np.ndarray, steps: int, side: float = 0.0) -> list[ipc.StepReport]:
    """Drive the ball ``depth`` [m] down and ``side`` [m] along x from where it is; depth and side may be arrays (B,)."""
    start = world.frame("ball")[1]
    reports = []
    for k in range(1, steps + 1):
        path = np.stack(np.broadcast_arrays(np.asarray(side) * 1.0, 0.0, -np.asarray(depth) * 1.0), axis=-1)
        world.set_target("ball", start + path * k / steps)
        reports.append(world.step())
    return reports


def collision_mesh(world: ipc.World) -> ipctk.CollisionMesh:
    return ipctk.CollisionMesh(world.layout.vert_local, world.layout.edges, world.layout.faces)


def test_press_balances_forces_and_stays_apart() -> None:
    world = make_world()
    mesh = collision_mesh(world)
    reports = []
    for _ in range(8):
        before = world._potential.x.numpy()[0].copy()
        reports += press(world, 0.1e-3, 1)
        after = np.asfortranarray(world._potential.x.numpy()[0])
        assert not ipctk.has_intersections(mesh, after)
        assert np.abs(after - before).max() > 0
    for r in reports:
        assert r.converged[0] and r.blocked[0] == 0 and r.min_gap[0] > 0 and r.min_det[0] > 0
        assert r.newton[0] <= 20 and not r.failed[0]
    for _ in range(3):
        report = world.step()  # at rest
    ball, pad = world.wrench("ball"), world.wrench("pad")
    assert ball.force[0, 2] > 0.05
    # Bound: Newton's residual, a node's unbalanced force being about its stiffness times the last step.
    assert np.abs(ball.force + pad.force).max() < 1e-3 * ball.force[0, 2]
    about_world = pad.torque[0] + np.cross(world.frame("pad")[1][0], pad.force[0])
    ball_about_world = ball.torque[0] + np.cross(world.frame("ball")[1][0], ball.force[0])
    assert np.abs(about_world + ball_about_world).max() < 1e-3 * ball.force[0, 2] * RADIUS
    pairs = world.contacts()
    assert report.pairs[0] == len(pairs.force) > 0 and set(pairs.bodies) == {("pad", "ball")}
    # The mollifier's own force on parallel edges is not along the normal; a ball has few.
    assert world.contact_forces("ball")[0].sum(axis=0) == pytest.approx(ball.force[0])
    assert world.traction("pad").shape == (1, len(world.surface("pad")[0]), 3)


def test_forces_by_pair_add_up_to_those_of_each_body() -> None:
    """Normal forces and friction of two balls on one pad, summed contact by contact, against what the solver's gradient says."""
    bodies: list = [bonded_pad(small_pad())]
    for name, x in (("left", -2.5e-3), ("right", 2.5e-3)):
        bodies.append(ipc.KinematicBody(name, ipc.icosphere(2e-3, 2), ipc.Pose((x, 0.0, 2e-3 + GAP))))
    world = ipc.World(bodies, ipc.Settings(dt=0.01, d_hat=1e-4, friction=0.5), num_envs=2, device="cpu")
    start = {name: world.frame(name)[1] for name in ("left", "right")}
    for k in range(1, 7):
        world.set_target("left", start["left"] + k * np.array([[2e-5, 0.0, -8e-5], [0.0, 0.0, 1e-4]]))
        world.set_target("right", start["right"] + k * np.array([0.0, 3e-5, -6e-5]))
        assert world.step().converged.all()
    by_pair = world.pressing()
    assert set(by_pair) == {("pad", "left"), ("pad", "right")}
    vertices = world.surface("pad")[0]
    at, forces = world.positions("pad")[:, vertices], world.contact_forces("pad")
    for name, mine in (("left", at[0, :, 0] < 0.0), ("right", at[0, :, 0] > 0.0)):
        pair = by_pair["pad", name]
        size = np.linalg.norm(world.wrench(name).force, axis=1).max()
        arm = at[:, mine] - np.nan_to_num(pair.place)[:, None]
        np.testing.assert_allclose(pair.wrench[:, :3], forces[:, mine].sum(axis=1), atol=1e-9 * size)
        np.testing.assert_allclose(pair.wrench[:, 3:], np.cross(arm, forces[:, mine]).sum(axis=1), atol=1e-9 * size)
        assert np.linalg.norm((pair.wrench[:, :3] - pair.normal)[0]) > 0.05 * size  # friction is in it
    assert not by_pair["pad", "left"].wrench[1].any() and np.isnan(by_pair["pad", "left"].place[1]).all()


def test_bonded_vertices_do_not_move_and_follow_their_frame() -> None:
    world = make_world()
    press(world, 0.6e-3, 4)
    pad = world.bodies[0]
    assert isinstance(pad, ipc.SoftBody)
    bonded, rest = pad.bonded, pad.mesh.vertices
    assert (world.positions("pad", frame="body")[0, bonded] == rest[bonded]).all()
    world.set_target("pad", position=(1e-4, 0.0, 2e-4), rotation=(np.cos(0.02), 0.0, np.sin(0.02), 0.0))
    report = world.step()
    assert report.blocked[0] == 0 and report.converged[0]
    R, t = world.frame("pad")
    expected = rest[bonded] @ R[0].T + t[0]
    assert np.abs(world.positions("pad")[0, bonded] - expected).max() < 1e-17
    assert t[0] == pytest.approx([1e-4, 0, 2e-4], abs=0) and np.abs(R[0] - np.eye(3)).max() > 0.01


def test_a_pad_moved_onto_a_ball_is_a_ball_moved_into_a_pad() -> None:
    """At rest only the relative pose counts: solving in the moving frame costs nothing.

    Off centre: right above a vertex and without friction the symmetric state is unstable, and rounding chooses the side.
    """
    results = []
    for mover in ("ball", "pad"):
        world = make_world(velocity_tolerance=1e-7)
        world.teleport("ball", (4e-4, 3e-4, RADIUS + GAP))
        start = world.frame(mover)[1][0]
        for k in range(6):
            world.set_target(mover, start + np.array([0, 0, (1 if mover == "pad" else -1) * 1e-4 * (k + 1)]))
            world.step()
        for _ in range(30):
            world.step()
        results.append((world.positions("pad", frame="body")[0], world.wrench("pad").force[0, 2]))
    assert abs(results[0][1]) > 0.03
    assert results[1][1] == pytest.approx(results[0][1], rel=1e-4)
    assert np.abs(results[0][0] - results[1][0]).max() < 1e-7


def test_batch_equals_singles() -> None:
    depths = np.array([0.5e-3, 0.8e-3, 0.1e-3])
    batch = make_world(num_envs=3, friction=0.5)
    press(batch, depths, 5, side=2e-4)
    for i, depth in enumerate(depths):
        single = make_world(friction=0.5)
        press(single, depth, 5, side=2e-4)
        difference = np.abs(single.positions("pad")[0] - batch.positions("pad")[i]).max()
        assert difference == 0.0, f"environment {i} is off by {difference:.3g} m"


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_environments_take_steps_of_their_own_length_or_none(device: str) -> None:
    """One presses in whole steps, one in halves, one stands still from the second step on; each as a world of its own does."""
    depth = np.array([0.25e-3, 0.25e-3, 0.2e-3])
    batch = make_world(3, friction=0.5, device=device, deterministic=True)
    singles = [make_world(1, friction=0.5, device=device, deterministic=True) for _ in depth]
    start = batch.frame("ball")[1]
    halves = np.array([1.0, 0.5, 0.5])
    share = np.zeros(3)
    for k, stepped in enumerate(([0, 1, 2], [1], [0, 1], [1])):
        share[stepped] += halves[stepped]
        target = start + np.column_stack([0.1e-3 * share, 0.0 * share, -depth * share])
        before = batch.save()
        batch.set_target("ball", target)
        report = batch.step(0.01 * halves, stepped)
        rest = np.setdiff1d(range(3), stepped)
        assert report.converged.all() and (report.newton[stepped] > 0).all() and (report.newton[rest] == 0).all()
        assert (report.blocked == 0.0).all()
        after = batch.save()
        for name in ("y", "velocity", "frame_position"):
            assert np.array_equal(getattr(before, name)[rest], getattr(after, name)[rest])
        for env in stepped:
            singles[env].set_target("ball", target[env])
            singles[env].step(0.01 * halves[env])
        for env, single in enumerate(singles):  # those that were not stepped keep their forces
            assert np.array_equal(batch.positions("pad")[env], single.positions("pad")[0]), k
            assert np.array_equal(batch.contact_forces("pad")[env], single.contact_forces("pad")[0]), k
    assert np.abs(batch.wrench("ball").force[:, 2]).min() > 0.01
    with pytest.raises(ipc.IpcError, match=r"dt = .*positive"):
        batch.step([0.01, 0.0, 0.01], [0, 1])
    batch.step([0.01, 0.0, 0.01], [0, 2])


def test_reset_in_contact_is_a_fresh_start() -> None:
    world = make_world(num_envs=2, friction=0.5)
    press(world, 0.5e-3, 4, side=1e-4)
    kept = world.positions("pad")[0].copy()
    world.reset([1])
    assert (world.positions("pad")[0] == kept).all()
    start = world.frame("ball")[1]
    assert start[1] == pytest.approx([0, 0, RADIUS + GAP], abs=0)
    fresh = make_world(friction=0.5)
    for k in range(3):
        world.set_target("ball", start + np.array([[0, 0, 0], [5e-5, 0, -1e-4]]) * (k + 1))
        fresh.set_target("ball", start[1] + np.array([5e-5, 0, -1e-4]) * (k + 1))
        world.step()
        fresh.step()
    assert np.abs(world.positions("pad")[1] - fresh.positions("pad")[0]).max() <= 1e-15


def test_save_and_restore_repeat_a_press() -> None:
    world = make_world(friction=0.5)
    press(world, 0.4e-3, 3)
    state = world.save()
    ends = []
    for _ in range(2):
        world.restore(state)
        press(world, 0.2e-3, 2, side=1e-4)
        ends.append(world.positions("pad").copy())
    assert np.abs(ends[0] - ends[1]).max() <= 1e-15


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_states_set_by_hand_are_seen_by_a_step_that_was_recorded(device: str) -> None:
    """Restored, reset, failed and teleported after several steps, environments go on as a fresh world does."""
    fine = {"velocity_tolerance": 1e-8, "linear_tolerance": 1e-8}
    world, fresh = (make_world(3, 0.5, device, **fine) for device in (device, "cpu"))
    place = np.array([1e-4, 2e-4, RADIUS + GAP])

    def go(one: ipc.World, depth: float) -> ipc.StepReport:
        for k in range(1, 4):
            one.set_target("ball", place - [0, 0, depth * k / 3])
            report = one.step()
        return report

    for one in (world, fresh):
        one.teleport("ball", place)
    start = world.save()
    broken = world.save()
    broken.velocity[1, 120] = np.nan
    go(world, 0.5e-3)
    world.restore(broken)
    assert go(world, 0.5e-3).failed.tolist() == [False, True, False]
    world.reset([0])
    world.teleport("ball", place, envs=[0])
    world.restore(start, [1, 2])
    assert go(world, 0.4e-3).converged.all() and go(fresh, 0.4e-3).converged.all()
    assert fresh.wrench("ball").force[:, 2].min() > 0.05
    assert np.abs(world.positions("pad") - fresh.positions("pad")).max() < 1e-9
    other = ipc.World([world.bodies[0]], num_envs=3, device="cpu")
    with pytest.raises(ipc.IpcError, match="frames of shape"):
        world.restore(other.save())


def test_teleport_takes_the_pad_along() -> None:
    world = make_world()
    press(world, 0.4e-3, 3)
    body = world.positions("pad", frame="body").copy()
    world.teleport("pad", position=(0.0, 0.0, -5e-3))
    assert (world.positions("pad", frame="body") == body).all()
    assert world.positions("pad")[0, :, 2].max() < -4e-3
    report = world.step()
    assert report.pairs[0] == 0 and report.converged[0]


def test_infeasible_drive_is_reported_as_blocked() -> None:
    """The ball is sent through the pad into the rigid case: it stops at the bonded base, and the report says how much remained."""
    world = make_world(halvings=0)
    start = world.frame("ball")[1][0]
    total = 0
    for _ in range(3):
        world.set_target("ball", start - [0, 0, 9e-3])
        report = world.step()
        total += report.newton[0]
    assert 0 < report.blocked[0] <= 1 and not report.failed[0]
    assert report.min_gap[0] > 0 and report.min_det[0] > 0
    assert total <= 3 * world.settings.max_newton
    assert world.frame("ball")[1][0, 2] > RADIUS - 4e-3


def test_a_failed_environment_leaves_the_others_alone() -> None:
    world, single = make_world(num_envs=3), make_world()
    state = world.save()
    state.velocity[1, 120] = np.nan
    world.restore(state)
    reports = press(world, 0.4e-3, 3)
    press(single, 0.4e-3, 3)
    assert reports[-1].failed.tolist() == [False, True, False]
    for env in (0, 2):
        assert np.abs(world.positions("pad")[env] - single.positions("pad")[0]).max() <= 1e-12
    assert np.isfinite(world.positions("pad")).all()
    assert (world.frame("ball")[1][1] == state.frame_position[1, 1]).all() and reports[-1].blocked[1] == 1
    assert world.positions("ball")[1] == pytest.approx(world.positions("ball")[0] + [0, 0, 0.4e-3], abs=1e-15)
    world.reset([1])
    assert not world.step().failed.any()


def test_forces_are_those_of_a_step_and_none_after_a_reset() -> None:
    world = make_world(num_envs=2, friction=0.5)
    press(world, 0.4e-3, 3, side=1e-4)
    before = world.wrench("ball").force
    world.reset([1])
    for name in ("ball", "pad"):
        assert (world.wrench(name).force[1] == 0).all() and (world.contact_forces(name)[1] == 0).all()
    assert len(world.contacts(1).force) == 0 < len(world.contacts(0).force)
    assert (world.wrench("ball").force[0] == before[0]).all() and before[1, 2] > 0.05


def test_teleport_leaves_the_targets_of_others() -> None:
    world = make_world()
    world.set_target("ball", (1e-4, 0.0, RADIUS + GAP))
    world.teleport("pad", (0.0, 0.0, -1e-3))
    world.step()
    assert (world.frame("ball")[1][0] == [1e-4, 0, RADIUS + GAP]).all()
    assert (world.frame("pad")[1][0] == [0, 0, -1e-3]).all()


def test_overlapping_starts_are_refused_with_names() -> None:
    pad = bonded_pad(small_pad())
    ball = ipc.KinematicBody("ball", ipc.icosphere(RADIUS, 2), ipc.Pose((0.0, 0.0, RADIUS - 1e-4)))
    with pytest.raises(ipc.OverlapError, match=r"environment 0.*(pad|ball).*through triangle.*(pad|ball)"):
        ipc.World([pad, ball], device="cpu")
    tiny = ipc.KinematicBody("tiny", ipc.icosphere(2e-4, 1), ipc.Pose((0.3e-3, 0.2e-3, -1e-3)))
    with pytest.raises(ipc.OverlapError, match="'tiny' lies inside 'pad'"):
        ipc.World([pad, tiny], device="cpu")
    floor = ipc.HalfSpace("floor", ipc.Pose((0.0, 0.0, -3.9e-3)))
    with pytest.raises(ipc.OverlapError, match=r"0\.0001 m inside the half-space 'floor'"):
        ipc.World([pad, floor], device="cpu")
    world = make_world()
    with pytest.raises(ipc.OverlapError, match="environment 0"):
        world.teleport("ball", position=(0.0, 0.0, RADIUS - 1e-4))
    assert world.step().converged[0]


def test_bad_input_is_refused_before_anything_changes() -> None:
    world = make_world(num_envs=2)
    with pytest.raises(ipc.IpcError, match="choose from pad, ball"):
        world.set_target("bal", (0, 0, 0))
    with pytest.raises(ipc.IpcError, match=r"must be \(3,\) or \(2, 3\)"):
        world.set_target("ball", np.zeros((3, 3)))
    with pytest.raises(ipc.IpcError, match="finite"):
        world.set_target("ball", (0, 0, np.nan))
    goals = world._goal_p.copy()
    for ask in (world.set_target, world.teleport):
        with pytest.raises(ipc.IpcError, match="length 1"):
            ask("ball", (0, 0, 2 * RADIUS), (1, 1, 0, 0))
    assert (world._goal_p == goals).all() and (world.frame("ball")[1][:, 2] == RADIUS + GAP).all()
    with pytest.raises(ipc.IpcError, match="environments 0 to 2"):
        world.reset([0, 2])
    with pytest.raises(ipc.IpcError, match="whole numbers"):
        world.reset([0.5])
    with pytest.raises(ipc.IpcError, match="unique"):
        ipc.World([world.bodies[0], world.bodies[0]], device="cpu")
    with pytest.raises(ipc.IpcError, match="nothing can move"):
        ipc.World([world.bodies[1]], device="cpu")


@pytest.mark.parametrize("lanes", [32, 131, 436, 655, 1024])
def test_blocks_of_threads_reach_all_lanes_of_rows(lanes: int) -> None:
    """On CUDA row r belongs to thread r mod lanes: with fewer threads than lanes, rows would be missing from the product."""
    pcg = Pcg(2, 10, lanes, wp.get_device("cpu"))
    assert lanes <= pcg._by_rows.shape[1] * BLOCK < lanes + BLOCK


def test_batched_conjugate_gradients_match_the_one_kernel_form(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop for any preconditioner, given block-Jacobi, takes the iterations and gives the press of the kernel that knows it."""
    from ipc.solver import newton, pcg

    monkeypatch.setattr(newton, "_is_held", lambda layout: False)  # the whole matrix, as on CUDA
    ends, general = [], []
    solve = pcg.Pcg._solve_by_launches
    monkeypatch.setattr(pcg.Pcg, "_solve_by_launches", lambda *args: general.append(1) or solve(*args))
    for batched in (False, True):
        if batched:
            monkeypatch.setattr(pcg, "BlockJacobi", type("Other", (), {}))  # so that solve() takes the general loop
        world = make_world(num_envs=2, friction=0.3)
        reports = press(world, np.array([0.3e-3, 0.4e-3]), 2)
        ends.append((world.positions("pad"), reports[-1].linear))
        assert bool(general) == batched
    assert (ends[0][1] > 0).all() and np.abs(ends[0][1] - ends[1][1]).max() <= 1
    assert np.abs(ends[0][0] - ends[1][0]).max() < 1e-12
