"""Pads read by kernels, all at once, against the same method in NumPy, one pad after the other."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import warp as wp

from raytac.gel.surface import make_grid
from raytac.markers.surface import CoatPoints
from raytac.physics.soft.bodies import ScenePad, scene_body
from raytac.physics.soft.coat_points import CoatMarkers, CoatTraction
from raytac.physics.soft.coat_state import CoatState, ContactObject
from raytac.physics.soft.mesh import PadLevel, pad_mesh
from raytac.physics.soft.reading import SoftReader
from raytac.physics.soft.scene import SoftScene
from raytac.physics.soft.settings import Correction
from raytac.physics.soft.undersides import Touched, Undersides
from raytac.se3 import rotations
from raytac.shapes.part import primitive
from raytac.specs import load_sensor
from tests.physics.rigid.test_pad_search import KINDS, body_of
from tests.physics.soft.oracles import reading as oracle
from tests.physics.soft.oracles.traction import CoatTraction as OracleTraction

SENSOR = load_sensor("gelsight_mini")
GELPAD = SENSOR.gelpad
MESH = pad_mesh(GELPAD, PadLevel(1.6e-3, 2, 3.0, 1.5, 5e-5))
GRID = make_grid(GELPAD, 0.2e-3)
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")]),
]
TURNED = np.array([[0.8, 0.0, 0.6, 0.0], [0.0, 1.0, 0.0, 0.0], [-0.6, 0.0, 0.8, 0.0], [0.0, 0.0, 0.0, 1.0]])
CORRECTIONS = {
    "plain": None,
    "height": Correction(tangential=False, friction=False),
    "all": Correction(),
    "sideways": Correction(normal=False),
    "finer": Correction(pitch=0.25e-3),
}


def at(x, y, z, turn=None) -> Any:
    pose = np.eye(4) if turn is None else turn.copy()
    pose[:3, 3] = x, y, z
    return pose


@cache
def pressed(device="cpu"):
    """A ball and a turned box on a pad in three environments, sheared in the last; the second box stays away."""
    bodies = [
        scene_body("ball", (primitive("sphere", (3e-3,)),), "kinematic", friction=0.6),
        scene_body("box", (primitive("box", (1e-3, 2e-3, 1e-3)),), "kinematic", friction=0.9),
    ]
    ball, box = np.array([[-2e-3, 0.4e-3, 3.05e-3]] * 3), np.array([[5e-3, 0.0, 1.48e-3], [5e-3, 0.0, 8e-3], [5e-3, 0.0, 8e-3]])
    places = ("ball", ball, np.eye(4)), ("box", box, TURNED)
    start = {name: np.stack([at(p[0], p[1], p[2], turn) for p in where]) for name, where, turn in places}
    scene = SoftScene(
        [ScenePad("pad", SENSOR, MESH)], bodies, np.eye(4)[None], start, num_envs=3, gravity=(0.0, 0.0, 0.0), device=device
    )
    for k in range(1, 6):
        goal = {name: pose.copy() for name, pose in start.items()}
        goal["ball"][:, 2, 3] -= np.array([0.08e-3, 0.1e-3, 0.12e-3]) * k
        goal["ball"][2, 0, 3] += 0.04e-3 * max(k - 2, 0)
        goal["box"][0, 2, 3] -= 0.07e-3 * k
        assert scene.step(np.eye(4)[None], goal).converged.all()
    return scene


def in_numpy(scene) -> Any:
    """The same state by the world's copies, for the oracle and for ``CoatState.of``."""
    touching = scene.world.touching("pad")
    objects = [
        ContactObject(scene.bodies[name].parts, scene.pose(name), None, mask, scene.bodies[name].friction)
        for name, mask in touching.items()
    ]
    return scene.coat("pad"), scene.coat_forces("pad"), objects


def read_by_oracle(state, correction, failed, grid=GRID):
    vertices, forces, objects = state
    things = tuple(oracle.ContactObject(o.parts, o.poses, o.surface, o.touching, o.friction) for o in objects)
    mesh = replace(MESH, d_hat=pressed().world.d_hat)
    return oracle.SoftReader(mesh, GELPAD, grid, correction).read(oracle.CoatState(vertices, forces, things), failed)


def reader(correction, grid=GRID):
    return SoftReader(replace(MESH, d_hat=pressed().world.d_hat), GELPAD, grid, correction)


def assert_same(seen: Any, expected: Any, sideways=1e-9):
    """Readings agree: heights to the rounding of float32; sideways to what the oracle's own search for forces leaves."""
    assert np.array_equal(seen.failed, expected.failed)
    assert seen.surface.contact.any() and (seen.surface.contact != expected.surface.contact).mean() < 1e-4
    for name in ("clearance", "residual"):
        assert np.allclose(getattr(seen, name), getattr(expected, name), atol=1e-8, equal_nan=True), name
    assert np.allclose(seen.surface.height, expected.surface.height, rtol=0.0, atol=5e-9, equal_nan=True)
    assert np.allclose(seen.surface.contact_centre, expected.surface.contact_centre, rtol=0.0, atol=1e-12, equal_nan=True)
    off = np.nan_to_num(seen.surface.coat.positions - expected.surface.coat.positions)
    assert np.abs(off).max() < sideways, f"the coat differs by {1e6 * np.abs(off).max():.3f} µm"
    assert np.array_equal(np.isnan(seen.surface.coat.positions), np.isnan(expected.surface.coat.positions))
    for mine, other in zip(seen.poses, expected.poses, strict=False):  # the oracle knows none of what touches nowhere
        assert np.allclose(mine, other, rtol=0.0, atol=1e-8, equal_nan=True)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", CORRECTIONS)
def test_kernels_read_what_numpy_reads(name, device):
    """Several objects, of which one touches in one environment only; one pad that has failed."""
    state, failed = in_numpy(pressed()), np.array([False, True, False])
    correction = CORRECTIONS[name]
    friction = correction is not None and correction.friction
    expected = read_by_oracle(state, correction, failed)
    mine = reader(correction)
    given = CoatState.of(*state, device=device)
    for _ in range(2):  # launched one by one, then as one recording
        assert_same(mine.read(given, failed), expected, 1e-6 if friction else 1e-9)
    assert np.isnan(mine.read(given, failed).surface.height[1]).all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", CORRECTIONS)
def test_a_height_that_is_not_finite_fails_alone(name, device):
    """Vertices are finite, and their height is not in single precision."""
    vertices, forces, objects = in_numpy(pressed())
    vertices = vertices.copy()
    vertices[0, vertices.shape[1] // 2, 2] = -1e60
    given, sound = CoatState.of(vertices, forces, objects, device=device), np.zeros(3, bool)
    mine = reader(CORRECTIONS[name])
    for _ in range(2):  # launched one by one, then as one recording
        seen = mine.read(given, sound)
        assert seen.failed.tolist() == [True, False, False]
        assert np.isnan(seen.surface.height[0]).all() and np.isfinite(seen.surface.height[1:]).all()
        assert not seen.surface.contact[0].any() and seen.surface.contact[1:].any()


@pytest.mark.parametrize("device", DEVICES)
def test_a_recording_reads_what_its_arrays_hold_now(device):
    vertices, forces, objects = in_numpy(pressed())
    objects, sound = [replace(objects[0], touching=None)], np.zeros(3, bool)
    given, mine = CoatState.of(vertices, forces, objects, device), reader(CORRECTIONS["all"])
    first = mine.read(given, sound)
    assert np.array_equal(mine.read(given, sound).surface.height, first.surface.height)
    half, poses = MESH.coat.rest + 0.7 * (vertices - MESH.coat.rest), objects[0].poses.copy()
    poses[:, 2, 3] += 0.15e-3
    given.update(half, 0.6 * forces, poses)
    failed = np.array([False, False, True])
    expected = read_by_oracle((half, 0.6 * forces, [replace(objects[0], poses=poses)]), CORRECTIONS["all"], failed)
    assert_same(mine.read(given, failed), expected, 1e-6)
    assert np.abs(first.surface.height - expected.surface.height)[:2].max() > 1e-4


def test_a_pad_is_read_the_same_alone_and_in_a_batch():
    """To the bit: neither other environments nor what touches there matter."""
    vertices, forces, objects = in_numpy(pressed())
    whole: Any = reader(CORRECTIONS["all"]).read(CoatState.of(vertices, forces, objects), np.zeros(3, bool))
    alone = reader(CORRECTIONS["all"])
    for b in range(3):
        some = [replace(o, poses=o.poses[b : b + 1], touching=o.touching[b : b + 1]) for o in objects]
        one: Any = alone.read(CoatState.of(vertices[b : b + 1], forces[b : b + 1], some), np.zeros(1, bool))
        for values, expected in (
            (one.surface.height, whole.surface.height),
            (one.surface.coat.positions, whole.surface.coat.positions),
            (one.clearance, whole.clearance),
        ):
            assert np.array_equal(values[0], expected[b])


@pytest.mark.parametrize("device", DEVICES)
def test_the_state_is_read_from_the_arrays_of_the_world(device):
    """Coat, forces, poses and touching objects in the pad's frame, without NumPy, are those of the scene's own methods."""
    scene = pressed(device)
    vertices, forces, objects = in_numpy(scene)
    state = scene.coat_state("pad")
    assert np.abs(state.vertices.numpy() - vertices).max() < 1e-15 and np.abs(state.forces.numpy() - forces).max() < 1e-12
    assert np.array_equal(state.objects.touching.numpy(), np.stack([o.touching for o in objects], axis=1))
    assert state.objects.touching.numpy().tolist() == [[True, True], [True, False], [True, False]]
    assert np.abs(state.objects.poses.numpy() - np.stack([o.poses for o in objects], axis=1)).max() < 1e-12
    assert state.objects.friction.numpy().tolist() == [0.6, 0.9]
    assert_same(scene.reading("pad", GRID), read_by_oracle((vertices, forces, objects), Correction(), np.zeros(3, bool)), 1e-6)


@cache
def squeezed():
    """A turned pad with a soft ball and an affine cube on it, and a second pad on the ball, in two environments."""
    half, turn = 1.5e-3, np.diag([1.0, -1.0, -1.0, 1.0])
    bodies = [
        scene_body(
            "ball", (primitive("sphere", (2e-3,)),), "soft", density=1e3, youngs_modulus=3e5, poisson_ratio=0.4, cell=1e-3
        ),
        scene_body("cube", (primitive("box", (half,) * 3),), "affine", density=5e3),
    ]
    case = at(0.02, -0.01, 0.03, TURNED)
    pads = np.stack([case, case @ at(0.0, 0.0, 4.08e-3, turn)])
    start = {"ball": case @ at(0.0, 0.0, 2.04e-3), "cube": case @ at(7e-3, 0.0, half + 0.04e-3 - GELPAD.sag(7e-3 - half, 0.0))}
    names = "pad", "over"
    scene = SoftScene([ScenePad(n, SENSOR, MESH) for n in names], bodies, pads, start, num_envs=2, gravity=-20.0 * case[:3, 2])
    for k in range(1, 4):
        goal = np.stack([pads] * 2)
        goal[:, 1] = np.stack([case @ at(0.0, 0.0, 4.08e-3 - depth * k, turn) for depth in (0.06e-3, 0.1e-3)])
        scene.step(goal)
    return scene


def test_soft_bodies_affine_ones_and_other_pads_are_read_as_they_are_touched():
    scene = squeezed()
    inverse = np.linalg.inv(scene.pose("pad"))
    touching, objects = scene.world.touching("pad"), []
    assert touching["ball"].all() and touching["cube"].all()
    for name, mask in touching.items():
        body = scene.bodies.get(name)
        soft = body is None or body.is_soft
        surface = scene.skin(name, "pad") if soft else None
        parts = () if body is None else body.parts  # a soft body has none
        objects.append(ContactObject(parts, inverse @ scene.pose(name), surface, mask, None if soft else GELPAD.friction))
    state = scene.coat_state("pad")
    cube = scene.coat_state("pad").objects.poses.numpy()[:, 0]
    assert np.abs(cube - next(o.poses for o in objects if o.surface is None)).max() < 1e-9
    ball = state.objects.surfaces[0][0].numpy()
    assert np.abs(ball - scene.skin("ball", "pad")[0]).max() < 1e-15
    ordered = sorted(objects, key=lambda one: one.surface is not None)
    expected = read_by_oracle((scene.coat("pad"), scene.coat_forces("pad"), ordered), Correction(), np.zeros(2, bool))
    seen = scene.reading("pad", GRID)
    assert seen.surface.contact[:, :, : GRID.shape[1] // 2 + 8].any() and seen.surface.contact[:, :, -40:].any()
    assert_same(seen, expected, 1e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_traction_and_markers_are_those_of_numpy(device):
    """Of random forces and displacements: the same sums of the same triangles."""
    rng, mesh = np.random.default_rng(3), MESH.coat
    forces, coat = rng.normal(size=(2, len(mesh.rest), 3)), mesh.rest + rng.normal(scale=1e-4, size=(2, len(mesh.rest), 3))
    expected = OracleTraction(mesh, GRID)(forces)
    traction = CoatTraction(mesh, GRID, device)
    for _ in range(2):
        assert np.allclose(traction(forces), expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    places = rng.uniform(-6e-3, 6e-3, size=(2, 40, 2))[0]
    rest = np.concatenate([places, np.zeros((40, 1))], axis=1)[None]
    tracked = CoatPoints().interpolate(mesh, np.repeat(rest, 2, axis=0), coat - mesh.rest)
    markers = CoatMarkers(mesh, places, 2, device)
    followed = markers.launch(wp.array(coat, dtype=wp.vec3d, device=device)).numpy()
    assert np.abs(followed - tracked[..., :2]).max() < 1e-10 and np.abs(followed).max() > 5e-5


@pytest.mark.parametrize("kind", KINDS)
def test_no_underside_is_infinitely_low(kind: str) -> None:
    """Heights are laid on whatever is less than inf. Turns are random, upright to rounding and nearly so."""
    count, rng = 40, np.random.default_rng(7)
    quarter = np.array([[0.5 * np.pi, 0.0, 0.0], [0.0, 0.5 * np.pi, 0.0], [0.0, -0.5 * np.pi, 0.0], [np.pi, 0.0, 0.0]])
    turns = np.concatenate([rng.normal(size=(20, 3)), np.tile(quarter, (5, 1))])
    turns[24:] += 10.0 ** rng.integers(-16, -2, (16, 1)) * rng.normal(size=(16, 3))
    poses = np.tile(np.eye(4), (count, 1, 1, 1))
    poses[:, 0, :3, :3] = rotations(turns)
    poses[:, 0, :3, 3] = rng.uniform(-2e-3, 2e-3, (count, 3))
    everywhere = wp.ones((count, 1), dtype=wp.bool, device="cpu")
    objects = Touched(
        (body_of(kind, rng),),
        wp.array(poses, dtype=wp.mat44d, device="cpu"),
        everywhere,
        wp.ones(1, dtype=wp.float64, device="cpu"),
        (),
    )
    under = Undersides(GRID, 5e-3, count, "cpu")
    under.find(objects, wp.ones(count, dtype=wp.int32, device="cpu"), wp.zeros(count, dtype=wp.float64, device="cpu"))
    lowest = under.under.numpy()
    assert np.isfinite(lowest).any()
    assert (lowest > -np.inf).all()
