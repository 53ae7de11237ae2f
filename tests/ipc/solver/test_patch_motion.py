"""A patch of a bonded body that moves as a whole, against the solver itself: the same patch bonded to a second frame that moves."""

from __future__ import annotations

import numpy as np
import pytest

import ipc
from ipc.solver.patch_motion import RestPatches

YOUNG, WIDTH, HEIGHT = 1e5, 8e-3, 24e-3
TURNED = ipc.Pose((0.1, -0.2, 0.3), (np.cos(0.4), 0.0, np.sin(0.4), 0.0))


def column(grip: bool) -> ipc.World:
    side, up = np.linspace(-WIDTH / 2, WIDTH / 2, 4), np.linspace(0.0, HEIGHT, 9)
    mesh = ipc.box_mesh(side, side, up, cut="mirrored")
    base, top = (np.flatnonzero(np.abs(mesh.vertices[:, 2] - z) < 1e-9) for z in (0.0, HEIGHT))
    grips = {"top": top} if grip else {}
    body = ipc.SoftBody(
        "column", mesh, ipc.Material(young=YOUNG, poisson=0.4, density=1000.0), bonded=base, grips=grips, pose=TURNED
    )
    settings = ipc.Settings(dt=1e3, gravity=(0.0, 0.0, 0.0), velocity_tolerance=1e-15, linear_tolerance=1e-9, d_hat=1e-4)
    return ipc.World([body], settings, device="cpu")


@pytest.fixture(scope="module")
def patch() -> ipc.PatchMotion:
    world = column(grip=False)
    body = world.bodies[0]
    assert isinstance(body, ipc.SoftBody)
    top = np.flatnonzero(np.abs(body.mesh.vertices[:, 2] - HEIGHT) < 1e-9)
    return RestPatches(world.layout, world.settings, 0).motion(world._potential, 0, top)


def test_the_stiffness_is_what_the_solver_answers_with(patch: ipc.PatchMotion) -> None:
    turn, origin = (a[0] for a in column(grip=False).frame("column"))
    np.testing.assert_allclose(patch.centre, origin + turn @ [0.0, 0.0, HEIGHT], atol=1e-12)
    shift = 1e-6
    for axis in range(6):
        world = column(grip=True)
        position, rotation = (a[0] for a in world.frame("column.top")[::-1])
        if axis < 3:
            world.set_target("column.top", position + shift * np.eye(3)[axis])
        else:
            angle = shift / WIDTH
            spin = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * np.eye(3)[axis - 3]])
            # About the patch's centre, not the grip's origin.
            arm = position - patch.centre
            moved = patch.centre + arm + angle * np.cross(np.eye(3)[axis - 3], arm)
            world.set_target("column.top", moved, _times(spin, _of(rotation)))
        assert world.step().converged[0]
        wrench = world.wrench("column.top")
        force = wrench.force[0]
        torque = wrench.torque[0] + np.cross(world.frame("column.top")[1][0] - patch.centre, force)
        expected = -patch.stiffness[:, axis] * (shift if axis < 3 else shift / WIDTH)
        scale = np.abs(expected[:3]).max() + np.abs(expected[3:]).max() / WIDTH
        np.testing.assert_allclose(force, expected[:3], atol=5e-3 * scale)
        np.testing.assert_allclose(torque, expected[3:], atol=5e-3 * scale * WIDTH)


def test_a_slender_column_bends_and_weighs_as_a_beam_does(patch: ipc.PatchMotion) -> None:
    turn = column(grip=False).frame("column")[0][0]
    along, across = turn[:, 2], turn[:, 0]
    area, second = WIDTH**2, WIDTH**4 / 12.0
    give = np.linalg.inv(patch.stiffness)[:3, :3]
    # Long along z, and a short one: the bonded ends cannot widen, linear tetrahedra bend too stiffly, shear makes it softer.
    assert 1.0 / (along @ give @ along) == pytest.approx(YOUNG * area / HEIGHT, rel=0.2)
    assert 1.0 / (across @ give @ across) == pytest.approx(3.0 * YOUNG * second / HEIGHT**3, rel=0.4)
    weight = 1000.0 * area * HEIGHT
    assert (
        0.2 * weight < patch.mass < 0.5 * weight
    )  # a third where the body stretches evenly, about as much where its end moves parallel
    assert np.linalg.eigvalsh(patch.inertia).min() > 0.0 and not patch.velocity.any()


def test_a_body_too_large_or_too_badly_shaped_to_be_inverted_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    world = column(grip=False)
    assert world.held_patch("column", 0) is None  # nothing touches it
    world = column(grip=False)
    with monkeypatch.context() as patched:
        patched.setattr("ipc.solver.patch_motion.MAX_ENTRIES", 10_000)
        with pytest.raises(ipc.IpcError, match=r"'column' has 128 free vertices.* at most 10000"):
            world.held_patch("column", 0)

    def singular(*_: object) -> None:
        raise np.linalg.LinAlgError

    monkeypatch.setattr("ipc.solver.patch_motion.condense", singular)
    with pytest.raises(ipc.IpcError, match=r"'column': .*ill-conditioned"):
        world.held_patch("column", 0)


def _of(matrix: np.ndarray) -> np.ndarray:
    w = 0.5 * np.sqrt(1.0 + np.trace(matrix))
    axis = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    return np.concatenate([[w], axis / (4.0 * w)])


def _times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.concatenate([[a[0] * b[0] - a[1:] @ b[1:]], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])
