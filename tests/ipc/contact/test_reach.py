"""Candidates out of reach: bounds of distances, and what is left out because of them."""

# pyright: reportInvalidTypeForm=false, reportCallIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportAssignmentType=false

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import ipc
from ipc.arrays import FloatArray, FloatArray2d
from ipc.broad_phase.lists import Candidates, gap_bounds
from ipc.contact import collision, reach
from ipc.contact.distance import box_gap, pair_coefficients, separation
from tests.ipc.solver.test_recording import pressed


@wp.kernel
def both_distances(x: wp.array2d(dtype=wp.vec3d), ee: wp.bool, box: FloatArray, exact: FloatArray):
    i = wp.tid()
    a, b, c, d = x[i, 0], x[i, 1], x[i, 2], x[i, 3]
    box[i] = box_gap(ee, a, b, c, d)
    exact[i] = wp.length(separation(pair_coefficients(ee, a, b, c, d), a, b, c, d))


@wp.kernel
def both_bounds(candidates: Candidates, ee: wp.bool, low: FloatArray2d, high: FloatArray2d):
    env, i = wp.tid()
    least, most = gap_bounds(candidates, ee, env, i)
    low[env, i] = least
    high[env, i] = most


@pytest.mark.parametrize("ee", [False, True])
def test_boxes_of_a_pair_are_no_farther_apart_than_the_pair(ee: bool, rng: np.random.Generator) -> None:
    n = 2000
    x = rng.normal(size=(n, 4, 3))
    x[:, 2 if ee else 1 :] += 3.0 * rng.normal(size=(n, 1, 3))
    points = wp.array(x, dtype=wp.vec3d, device="cpu")
    box, exact = (wp.zeros(n, dtype=wp.float64, device="cpu") for _ in range(2))
    wp.launch(both_distances, dim=n, inputs=[points, ee], outputs=[box, exact], device="cpu")
    gaps, distances = box.numpy(), exact.numpy()
    first, second = (x[:, :2], x[:, 2:]) if ee else (x[:, :1], x[:, 1:])
    apart = np.maximum(first.min(axis=1) - second.max(axis=1), second.min(axis=1) - first.max(axis=1)).max(axis=1)
    np.testing.assert_allclose(gaps, apart, rtol=2e-9)
    assert (gaps <= distances).all() and (gaps > 0.5 * distances).mean() > 0.3


def test_no_candidate_is_nearer_than_its_bound() -> None:
    """After steps of differing length, in two environments."""
    world, _ = pressed(True)
    collision, x = world._potential.collision, world._potential.x.numpy()
    layout, candidates = world.layout, collision.candidates
    assert (candidates.moved.numpy() > 0).all()
    for ee, pairs, count in ((False, candidates.pt, candidates.pt_count), (True, candidates.ee, candidates.ee_count)):
        low, high = (wp.zeros(pairs.shape, dtype=wp.float64, device="cpu") for _ in range(2))
        wp.launch(both_bounds, dim=pairs.shape, inputs=[candidates, ee], outputs=[low, high], device="cpu")
        for env in range(2):
            n = int(count.numpy()[env])
            a, b = pairs.numpy()[env, :n, :2].T
            verts = np.concatenate([layout.edges[a], layout.edges[b]] if ee else [a[:, None], layout.faces[b]], axis=1)
            points = wp.array(x[env][verts], dtype=wp.vec3d, device="cpu")
            box, exact = (wp.zeros(n, dtype=wp.float64, device="cpu") for _ in range(2))
            wp.launch(both_distances, dim=n, inputs=[points, ee], outputs=[box, exact], device="cpu")
            distance = exact.numpy()
            gaps = (candidates.ee_gap if ee else candidates.pt_gap).numpy()[env, :n]
            away = gaps > float(reach.AWAY) * collision.d_hat
            assert n > 50 and (low.numpy()[env, :n] <= distance).all() and (distance <= high.numpy()[env, :n])[~away].all()
            assert (distance > high.numpy()[env, :n])[away].any()  # whose numbers are lower bounds alone
            assert (low.numpy()[env, :n] > collision.d_hat).mean() > 0.1  # some are left out


def test_what_is_left_out_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    with_bounds, reports = pressed(True)

    def never(*_: object) -> None:
        """Distances of 0, of which no pair is left out."""

    monkeypatch.setattr(reach.Reach, "update", never)
    monkeypatch.setattr(collision, "NEAR", 0.0)  # nor is any left off a list of near ones
    without, plain = pressed(True)
    assert not without._potential.collision.candidates.ee_gap.numpy().any()
    assert [r.newton.tolist() for r in reports] == [r.newton.tolist() for r in plain]
    np.testing.assert_array_equal(with_bounds.positions("pad"), without.positions("pad"))
    np.testing.assert_array_equal(with_bounds.wrench("ball").force, without.wrench("ball").force)


def test_a_body_moved_by_hand_is_measured_anew() -> None:
    """Contacts of a world that is put back are those of one that never went elsewhere."""
    world, _ = pressed(True)
    state = world.save()
    forces = []
    for away in (False, True):
        world.restore(state)
        if away:
            world.teleport("ball", (0.0, 0.0, 0.05))
            world.step()
            assert not world.contacts().gap.size
            world.restore(state)
        world.step()
        forces.append(world.wrench("ball").force.copy())
    np.testing.assert_array_equal(*forces)
    assert isinstance(world.bodies[0], ipc.SoftBody) and forces[0][0, 2] > 0.01
