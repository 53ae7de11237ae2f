"""Driven bodies: two bonded ends, affine bodies with a drive; and buffers that grow in the middle of a step."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import ipc
from ipc.bodies import rotation_matrix
from ipc.solver import frames
from tests.ipc.conftest import bonded_pad, small_pad

LENGTH = 10e-3


def beam(cells: int = 2, **settings: object) -> ipc.World:
    """A beam along z, 2 mm wide, bonded at z = 0 and gripped at its far end."""
    line, z = np.linspace(-1e-3, 1e-3, cells + 1), np.linspace(0, LENGTH, 4 * cells + 1)
    mesh = ipc.box_mesh(line, line, z)
    ends = [ipc.vertices_in_box(mesh, (-1, -1, h), (1, 1, h)) for h in (0.0, LENGTH)]
    body = ipc.SoftBody("beam", mesh, ipc.Material(1e5, 0.4), bonded=ends[0], grips={"far": ends[1]})
    options: dict = {"dt": 0.01, "velocity_tolerance": 1e-8, "linear_tolerance": 1e-6} | settings
    return ipc.World([body], ipc.Settings(**options), device="cpu")


def turned(angle: float) -> tuple[float, float, float, float]:
    return (float(np.cos(angle / 2)), 0.0, 0.0, float(np.sin(angle / 2)))


def test_both_ends_moved_alike_leave_the_beam_without_stress() -> None:
    world = beam()
    rest = world.positions("beam")[0]
    for k in range(1, 6):
        pose = ((1e-3 * k, 0.0, 2e-3 * k), turned(0.3 * k))
        for name in ("beam", "beam.far"):
            world.set_target(name, *pose)
        assert world.step().converged.all()
    for _ in range(40):
        report = world.step()
    expected = rest @ rotation_matrix(turned(1.5)).T + [5e-3, 0, 10e-3]
    assert np.abs(world.positions("beam")[0] - expected).max() < 1e-9
    assert report.elastic[0] < 1e-12
    assert np.abs(world.wrench("beam.far").force).max() < 1e-6


def test_a_stretched_beam_pulls_its_ends_together_with_the_force_of_a_bar() -> None:
    world = beam()
    for k in range(1, 5):
        world.set_target("beam.far", (0.0, 0.0, 1e-4 * k))
        report = world.step()
        assert report.converged.all() and report.blocked.max() == 0
    for _ in range(40):
        world.step()
    far, near = world.wrench("beam.far").force[0], world.wrench("beam").force[0]
    gripped = world.positions("beam")[0][world.positions("beam")[0, :, 2] > LENGTH]
    assert np.abs(gripped[:, 2] - (LENGTH + 4e-4)).max() < 1e-15
    assert np.abs(far + near).max() < 1e-6 * np.abs(far).max()
    # Held ends cannot contract, which stiffens a bar of five widths a little.
    uniaxial = 1e5 * (2e-3) ** 2 * 4e-4 / LENGTH
    assert far[2] < 0 and uniaxial < -far[2] < 1.12 * uniaxial


def test_a_twisted_beam_has_the_torque_of_saint_venant() -> None:
    """Two meshes and second-order convergence give G · 0.1406 a⁴ · θ/L, within the effect of gripped ends."""
    torque = []
    for cells in (4, 8):
        world = beam(cells, dt=1.0)
        for k in range(1, 3):
            world.set_target("beam.far", rotation=turned(0.05 * k))
            assert world.step().converged.all()
        far, near = world.wrench("beam.far").torque[0], world.wrench("beam").torque[0]
        assert far[2] == pytest.approx(-near[2], rel=1e-5)
        torque.append(-far[2])
    theory = 1e5 / 2.8 * 0.1406 * (2e-3) ** 4 * 0.1 / LENGTH
    assert torque[0] > torque[1] > theory
    assert torque[1] - (torque[0] - torque[1]) / 3 == pytest.approx(theory, rel=0.05)


def test_teleport_of_a_body_takes_its_grips_along() -> None:
    world = beam()
    world.teleport("beam", (0.0, 1e-3, 0.0), turned(np.pi / 2))
    assert world.step().elastic[0] < 1e-15
    R, t = world.frame("beam.far")
    assert np.abs(R[0] - rotation_matrix(turned(np.pi / 2))).max() < 1e-12 and np.abs(t[0] - [0, 1e-3, 0]).max() < 1e-15


def test_bonds_that_contradict_are_refused() -> None:
    mesh = small_pad()
    low = ipc.vertices_in_box(mesh, (-1, -1, -4e-3), (1, 1, -4e-3))
    with pytest.raises(ipc.IpcError, match="held twice"):
        ipc.SoftBody("pad", mesh, ipc.Material(1e5), bonded=low, grips={"side": low[:2]})
    with pytest.raises(ipc.IpcError, match="need bonded vertices"):
        ipc.SoftBody("pad", mesh, ipc.Material(1e5), grips={"side": low})
    with pytest.raises(ipc.IpcError, match=r"beam, beam\.far"):
        beam().set_target("beam.near", (0, 0, 0))


@pytest.mark.parametrize("strength", [0.5, 9.0])
def test_a_driven_affine_body_covers_its_share_of_the_way(strength: float) -> None:
    """From rest, ½‖x − x₀‖² + ½ s ‖x − aim‖² has its minimum s/(1 + s) of the distance to the aim."""
    peg = ipc.AffineBody("peg", ipc.box_surface((2e-3, 2e-3, 2e-3)), drive=strength)
    world = ipc.World([peg], ipc.Settings(velocity_tolerance=1e-9, linear_tolerance=1e-8), device="cpu")
    world.set_target("peg", (1e-3, 0.0, -2e-3))
    world.step()
    _, p = world.affine_pose("peg")
    assert np.abs(p[0] - strength / (1 + strength) * np.array([1e-3, 0, -2e-3])).max() < 1e-9


def test_teleport_puts_a_driven_affine_body_at_its_pose() -> None:
    peg = ipc.AffineBody("peg", ipc.box_surface((2e-3, 2e-3, 2e-3), (1e-3, 0, 0)), drive=5.0)
    world = ipc.World([peg], num_envs=2, device="cpu")
    world.teleport("peg", (0.0, 1e-2, 0.0), turned(np.pi / 2), envs=[1])
    expected = peg.surface.vertices @ rotation_matrix(turned(np.pi / 2)).T + [0, 1e-2, 0]
    assert np.abs(world.positions("peg")[1] - expected).max() < 1e-15
    assert np.abs(world.positions("peg")[0] - peg.surface.vertices).max() < 1e-15
    world.step()
    assert np.abs(world.positions("peg")[1] - expected).max() < 1e-12


def test_a_turn_however_small_begins_where_the_frame_is() -> None:
    """Half a turn of 1e-7 rad is half of it: no part of the motion is made without a check of the gaps."""
    start, end = wp.array([[(0.0, 0, 0, 1)]], dtype=wp.quatd), wp.array([[(0.0, 0, 5e-8, 1)]], dtype=wp.quatd)
    place, turn = wp.zeros((1, 1), dtype=wp.vec3d), wp.zeros((1, 1), dtype=wp.mat33d)
    for share in (0.0, 0.5, 1.0):
        shares = wp.array([share], dtype=wp.float64)
        inputs, outputs = [start, place, end, place, shares], [turn, wp.zeros_like(place), wp.zeros_like(start)]
        wp.launch(frames.frames_at, dim=(1, 1), inputs=inputs, outputs=outputs, device="cpu")
        assert turn.numpy()[0, 0, 1, 0] == pytest.approx(share * 1e-7, rel=1e-9, abs=1e-16)


def test_a_drive_gives_way_to_contact() -> None:
    peg = ipc.AffineBody("peg", ipc.box_surface((2e-3, 2e-3, 2e-3)), ipc.Stiff(), ipc.Pose((0, 0, 1.3e-3)), drive=5.0)
    world = ipc.World([peg, ipc.HalfSpace("floor")], ipc.Settings(d_hat=2e-4), device="cpu")
    for k in range(10):
        world.set_target("peg", (0, 0, 1.3e-3 - 1e-4 * (k + 1)))
        report = world.step()
        assert report.converged.all() and report.min_gap[0] > 0
    assert world.positions("peg")[0, :, 2].min() > 0
    assert world.wrench("floor").force[0, 2] < -1e-4


def test_buffers_grow_in_the_middle_of_a_step() -> None:
    """Buffers of one place each, and lists that overflow amid every step, give the bit-same press as ample ones."""
    results, counts = [], []
    for room in (None, 1):
        ball = ipc.KinematicBody("ball", ipc.icosphere(4e-3, 2), ipc.Pose((2e-4, 1e-4, 4e-3 + 1.2e-4)))
        world = ipc.World([bonded_pad(small_pad()), ball], ipc.Settings(d_hat=1e-4, friction=0.5), num_envs=2, device="cpu")
        if room:
            world._potential.collision._size_candidates(room, room)
            world._potential.collision._size_contacts(room, room)
        for k in range(4):
            world.set_target("ball", (2e-4, 1e-4, 4e-3 + 1.2e-4 - 1.5e-4 * (k + 1)))
            report = world.step()
            assert report.converged.all()
            counts.append((report.newton, report.linear))
            if room:
                # As much as the present lists need: the next new list, in the middle of the step, is too long.
                lists = world._potential.collision.candidates
                now = [max(1, int(c.numpy().max())) for c in (lists.pt_count, lists.ee_count)]
                world._potential.collision._size_candidates(*now)
                world._potential.collision.forget(np.ones(2, bool))
        results.append((world.positions("pad"), report.newton, report.min_gap))
    assert report.pairs.min() > 1
    for one, other in zip(*results, strict=True):
        assert np.array_equal(one, other)
    assert np.array_equal(counts[:4], counts[4:]), "iterations that were done again count once"
