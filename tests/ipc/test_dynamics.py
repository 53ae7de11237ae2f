"""Free bodies: momentum, energy, falls, slopes, affine bodies, half-spaces."""

from __future__ import annotations

import numpy as np
import pytest

import ipc
from tests.ipc.conftest import unit_cell

THETA = np.arctan(0.5)


def block_on_slope(mu: float, kind: str, theta: float = THETA, dt: float = 0.01) -> ipc.World:
    """A 0.1 m block of 1 kg on a plane; the slope is in the direction of gravity."""
    size = 0.1
    pose = ipc.Pose((0.0, 0.0, size / 2 + 0.8e-3))
    if kind == "affine":
        body: ipc.AffineBody | ipc.SoftBody = ipc.AffineBody(
            "block", ipc.box_surface((size, size, size)), ipc.Stiff(1e8, 1000.0), pose
        )
    else:
        mesh = unit_cell(1, size)
        body = ipc.SoftBody("block", ipc.TetMesh(mesh.vertices - [0, 0, size / 2], mesh.tets), ipc.Material(1e7, 0.3), pose=pose)
    gravity = (9.81 * np.sin(theta), 0.0, -9.81 * np.cos(theta))
    settings = ipc.Settings(
        dt=dt,
        gravity=gravity,
        d_hat=1e-3,
        kappa=1e5,
        friction=mu,
        friction_slip=1e-6,
        velocity_tolerance=1e-8,
        friction_relags=20,
        friction_tolerance=1e-6,
    )
    return ipc.World([body, ipc.HalfSpace("slope")], settings, device="cpu")


@pytest.mark.parametrize("kind", ["affine", "soft"])
@pytest.mark.parametrize("mu", [0.501, 0.51, 0.8])
def test_block_sticks_without_creep(kind: str, mu: float) -> None:
    """Under the share r of its friction limit it gives way by ε (1 − √(1 − r)) once, a soft one by its strain too, and stays there."""
    world = block_on_slope(mu, kind, theta=0.0)
    lowest = (slice(None), np.isclose(world.positions("block")[0, :, 2], world.positions("block")[0, :, 2].min()), 0)
    places = []
    for k in range(60):
        # Pressed on first, pulled along little by little.
        world.set_gravity((9.81 * np.sin(THETA) * np.clip((k - 10) / 25, 0, 1), 0.0, -9.81 * np.cos(THETA)))
        report = world.step()
        places.append(world.positions("block")[lowest].mean())
        assert report.converged[0] and report.min_gap[0] > 0
    given = places[-1] - places[10]
    if kind == "affine":
        assert given == pytest.approx(1e-6 * (1 - np.sqrt(1 - 0.5 / mu)), rel=0.02)
    assert abs(places[-1] - places[-6]) < 1e-10


@pytest.mark.parametrize("kind", ["affine", "soft"])
def test_block_slides_with_the_right_acceleration(kind: str) -> None:
    world = block_on_slope(0.49, kind)
    speeds = []
    for _ in range(80):
        before = world.positions("block")[0].mean(axis=0)[0]
        assert world.step().converged[0]
        speeds.append((world.positions("block")[0].mean(axis=0)[0] - before) / world.settings.dt)
    acceleration = (speeds[-1] - speeds[39]) / (40 * world.settings.dt)
    expected = 9.81 * (np.sin(THETA) - 0.49 * np.cos(THETA))
    assert acceleration == pytest.approx(expected, rel=0.01)
    wrench = world.wrench("slope").force[0]
    weight = 9.81 * np.cos(THETA)
    assert wrench[2] == pytest.approx(-weight, rel=1e-3)
    assert wrench[0] == pytest.approx(0.49 * weight, rel=1e-3)


def collide(velocity_tolerance: float, linear_tolerance: float, relags: int = 30) -> tuple[float, float]:
    """Two soft cubes meet off-centre, with friction, without gravity.

    Returns:
        Largest drift of momentum as a share of that of the moving cube, and largest rise of energy in a step as a share of its own.
    """
    a, b = unit_cell(2, 0.02), unit_cell(2, 0.02)
    bodies = [
        ipc.SoftBody("a", a, ipc.Material(1e5, 0.4)),
        ipc.SoftBody("b", ipc.TetMesh(b.vertices + np.array([0.023, 0.006, 0.004]), b.tets), ipc.Material(2e5, 0.4)),
    ]
    tolerances: dict = {"velocity_tolerance": velocity_tolerance, "linear_tolerance": linear_tolerance}
    settings = ipc.Settings(dt=2e-3, d_hat=1e-3, friction=0.3, friction_relags=relags, **tolerances)
    world = ipc.World(bodies, settings, device="cpu")
    world.set_velocity("a", (1.0, 0.0, 0.0))
    mass = 0.02**3 * 1000
    lumped = [
        np.bincount(m.tets.ravel(), weights=np.full(m.tets.size, mass / m.tets.size), minlength=len(m.vertices)) for m in (a, b)
    ]

    def momentum() -> np.ndarray:
        return np.sum([w @ world.velocities(n)[0] for w, n in zip(lumped, "ab", strict=True)], axis=0)

    start, energies, drifts, strained = momentum(), [0.5 * mass], [], 0.0
    for _ in range(15):
        report = world.step()
        assert report.converged[0]
        energies.append(float(report.elastic[0] + report.kinetic[0] + report.barrier[0]))
        drifts.append(np.abs(momentum() - start).max() / mass)
        strained = max(strained, float(report.elastic[0]))
    # It was a collision: energy went into strain, half the momentum and some of it sideways, by friction and off-centre, to the other cube.
    along, aside, _ = world.velocities("b")[0].mean(axis=0)
    assert strained > 0.01 * energies[0] and along > 0.4 and aside > 0.02
    return max(drifts), float(np.diff(energies).max()) / energies[0]


def test_a_velocity_that_is_set_is_kept() -> None:
    cube = ipc.SoftBody("cube", unit_cell(1, 0.01), ipc.Material(1e5))
    settings = ipc.Settings(velocity_tolerance=1e-9, linear_tolerance=1e-8)
    world = ipc.World([cube], settings, num_envs=2, device="cpu")
    for _ in range(3):
        world.step()
    world.set_velocity("cube", (1.0, 0.0, 0.0), envs=[1])
    for _ in range(4):
        world.step()
    assert np.abs(world.velocities("cube")[1] - [1, 0, 0]).max() < 1e-8
    assert np.abs(world.velocities("cube")[0]).max() < 1e-8


def test_collision_keeps_momentum_and_energy_never_rises() -> None:
    """Both hold to rounding at a tight tolerance; at a coarse one, friction not renewed, both fail, so the measure does measure."""
    drift, rise = collide(1e-11, 1e-8)
    assert drift < 1e-8, f"momentum drifted by {drift:.3g} of that of the moving cube"
    assert rise <= 1e-12, f"energy rose by {rise:.3g} of itself"
    drift, rise = collide(1e-2, 0.1, relags=0)
    assert drift > 1e-5 and rise > 1e-7


def test_fall_is_of_first_order() -> None:
    """A soft cube bonded on one side and let go: the displacement of the other side converges with the order of backward Euler."""
    mesh = ipc.box_mesh([0.0, 0.01], [0.0, 0.01], [0.0, 0.01])
    tips = []
    for steps in (10, 20, 40):
        settings = ipc.Settings(dt=0.02 / steps, gravity=(0, 0, -2.0), velocity_tolerance=1e-10, linear_tolerance=1e-8)
        bonded = ipc.vertices_in_box(mesh, (0, -1, -1), (0, 1, 1))
        world = ipc.World([ipc.SoftBody("bar", mesh, ipc.Material(2e3, 0.3), bonded=bonded)], settings, device="cpu")
        for _ in range(steps):
            world.step()
        tips.append(world.positions("bar")[0, -1])
    rate = np.log2(np.linalg.norm(tips[1] - tips[0]) / np.linalg.norm(tips[2] - tips[1]))
    assert np.linalg.norm(tips[0] - mesh.vertices[-1]) > 5e-5
    assert rate == pytest.approx(1, abs=0.35), f"order {rate:.2f}"


def test_affine_body_falls_turns_and_stays_rigid() -> None:
    """Free flight of a spinning box: its centre falls freely, its angular momentum stays, its map stays near a rotation."""
    box = ipc.box_surface((0.04, 0.02, 0.03))
    body = ipc.AffineBody("box", box, ipc.Stiff(1e7, 500.0), ipc.Pose((0.1, 0.0, 0.2), (np.cos(0.2), 0.0, np.sin(0.2), 0.0)))
    h, steps = 1e-3, 40
    settings = ipc.Settings(dt=h, gravity=(0.0, 0.0, -9.81), velocity_tolerance=1e-12, linear_tolerance=1e-10)
    world = ipc.World([body], settings, device="cpu")
    A, p = world.affine_pose("box")
    assert np.abs(A[0] @ A[0].T - np.eye(3)).max() < 1e-12 and p[0] == pytest.approx([0.1, 0, 0.2], abs=1e-15)
    state = world.save()
    omega = np.array([0.0, 0.0, 10.0])
    nodes = state.y[0]
    state.velocity[0] = np.cross(omega, nodes - p[0]) + np.array([0.3, 0, 0])
    world.restore(state)

    def angular() -> np.ndarray:
        mass, y, v = world.layout.mass.reshape(4, 4), world.save().y[0], world.velocities("box")[0]
        centre, speed = mass.sum(0) @ y / mass.sum(), mass.sum(0) @ v / mass.sum()
        return np.einsum("kl,kli->i", mass, np.cross((y - centre)[:, None], (v - speed)[None]))

    start = angular()
    for _ in range(steps):
        assert world.step().converged[0]
    A, p = world.affine_pose("box")
    fall = -9.81 * h * h * steps * (steps + 1) / 2  # backward Euler's own parabola
    assert p[0] == pytest.approx([0.1 + 0.3 * h * steps, 0, 0.2 + fall], abs=1e-9)
    assert np.abs(A[0] @ A[0].T - np.eye(3)).max() < 1e-3
    assert np.linalg.norm(angular() - start) < 0.2 * np.linalg.norm(start)  # backward Euler damps spin
    assert world.layout.mass.sum() == pytest.approx(500 * 0.04 * 0.02 * 0.03, rel=1e-12)


def test_affine_mass_is_that_of_the_solid() -> None:
    """Centre of mass and second moments of a box from its surface alone."""
    size, density = np.array([0.04, 0.02, 0.03]), 700.0
    from ipc.bodies import build_layout

    layout = build_layout([ipc.AffineBody("box", ipc.box_surface((0.04, 0.02, 0.03)), ipc.Stiff(1e7, density))], 0.0, {}, [])
    mass, y = layout.mass.reshape(4, 4), layout.node_rest
    total = density * size.prod()
    assert np.abs(mass.sum(axis=0) @ y).max() < 1e-15
    assert np.einsum("kl,ki,lj->ij", mass, y, y) == pytest.approx(np.diag(total * size**2 / 12), abs=1e-12 * total)


def test_fast_ball_does_not_tunnel() -> None:
    """An affine ball at 60 m/s meets a thin bonded pad: a step is far longer than the pad is thick."""
    mesh = ipc.domed_pad((12e-3, 12e-3), 2e-3, (np.inf, np.inf), (4, 4, 1))
    pad = ipc.SoftBody("pad", mesh, ipc.Material(1e5, 0.4), bonded=ipc.vertices_in_box(mesh, (-1, -1, -2e-3), (1, 1, -2e-3)))
    ball = ipc.AffineBody("ball", ipc.icosphere(2e-3, 1), ipc.Stiff(1e7, 1000.0), ipc.Pose((2e-4, 1e-4, 5e-3)))
    world = ipc.World([pad, ball], ipc.Settings(dt=1e-3, d_hat=2e-4, max_newton=200), device="cpu")
    world.set_velocity("ball", (0.0, 0.0, -60.0))
    lowest = np.inf
    for _ in range(8):
        report = world.step()
        assert report.min_gap[0] > 0 and report.min_det[0] > 0 and not report.failed[0]
        lowest = min(lowest, world.positions("ball")[0, :, 2].min())
    assert -2e-3 < lowest < 0, f"lowest point {lowest:.3g} m"


def test_an_open_affine_surface_is_refused() -> None:
    box = ipc.box_surface((0.02, 0.02, 0.02))
    with pytest.raises(ipc.IpcError, match="closed"):
        ipc.World([ipc.AffineBody("box", ipc.TriMesh(box.vertices, box.faces[:-2]))], device="cpu")
