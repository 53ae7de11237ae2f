"""Bodies that go through a rigid pad: their environment fails, whatever they are and however fast, and nobody else's does."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from raytac.envs.batch import TaskBatch
from raytac.envs.push_cube import PushCube
from raytac.errors import InputError, OverlapError
from raytac.gel import pyramid
from raytac.gel.gaussian import PYRAMID_SIGMAS
from raytac.physics.objects import object_parts
from raytac.physics.rigid.pierced import BondedFaces
from raytac.robots.mount import case_depth
from raytac.se3 import rotations
from raytac.shapes.part import mesh_part, primitive
from raytac.specs import BodySpec, RobotSpec, TaskScene, load_sensor
from raytac.world.world import TactileWorld

MINI = load_sensor("gelsight_mini")
THICK = MINI.gelpad.thickness
SHAPES: dict[str, BodySpec] = {
    "ball": BodySpec("body", "sphere", {"radius": 5e-3}, mass=0.05),
    "grain": BodySpec("body", "sphere", {"radius": 0.3e-3}, mass=0.05),
    "block": BodySpec("body", "box", {"length": 8e-3, "width": 6e-3, "height": 4e-3}, mass=0.05),
    "plate": BodySpec("body", "box", {"length": 60e-3, "width": 60e-3, "height": 1e-3}, mass=0.05),
    "rod": BodySpec("body", "cylinder", {"radius": 1e-3, "length": 10e-3}, mass=0.05),
}


def world_of(
    body: BodySpec, at: np.ndarray | list[list[float]], speed: list[float], timestep: float = 0.01, **options
) -> TactileWorld:
    """A sensor on its back, world and pad frame one, and in each environment the body at a place (B, 3) with a speed (3,)."""
    scene = TaskScene("upward", RobotSpec("fixed_sensor"), (replace(body, position=(0.0, 0.0, 0.2)),), gravity=(0.0, 0.0, 0.0))
    world = TactileWorld(replace(scene, timestep=timestep), num_envs=len(at), **{"outputs": ("wrench",), **options})
    for data, place in zip(world.data, at, strict=True):
        data.qpos[:3], data.qvel[:3] = place, speed
    return world


@pytest.mark.parametrize("shape", sorted(SHAPES))
@pytest.mark.parametrize("speed", [0.5, 5.0])
def test_what_hits_the_gel_between_two_steps_of_10_ms_is_held_by_it(shape: str, speed: float) -> None:
    """50 g, at any place: at 5 m/s a step would take it past gel and case. The other environment's passes the sensor by."""
    rng = np.random.default_rng(3)
    over = [*rng.uniform(-8e-3, 8e-3, 2), 0.012 + 0.01 * speed * rng.random()]
    world = world_of(SHAPES[shape], [over, [0.09, 0.0, over[2]]], [0.0, 0.0, -speed])
    for _ in range(6):
        state = world.step()
        assert not state.failed.any()
        assert state.world_from_body["body"][0, 2, 3] > -THICK
    assert world.data[0].qvel[2] > -0.5 * speed and world.data[1].qvel[2] == pytest.approx(-speed)


@pytest.mark.parametrize("shape", sorted(SHAPES))
def test_what_is_beyond_the_gel_all_the_same_fails_alone(shape: str) -> None:
    """Someone puts a body where no gel is left; the path to there counts too."""
    world = world_of(SHAPES[shape], [[0.0, 0.0, 0.02], [0.09, 0.0, 0.02]], [0.0, 0.0, 0.0])
    world.step()
    for data in world.data:
        data.qpos[2] -= 0.02 + 1.2 * THICK
    state = world.step()
    assert state.failed.tolist() == [True, False]
    assert np.isnan(state.wrench["sensor"][0]).all() and np.isnan(state.world_from_body["body"][0]).all()
    frame = world.observe()["sensor"]
    assert frame.failed.tolist() == [True, False]
    assert np.isnan(frame.surface.height[0]).all() and np.isfinite(frame.surface.height[1]).all()
    assert not world.reset().failed.any()


def test_a_slow_body_is_carried_at_the_same_step() -> None:
    world = world_of(SHAPES["ball"], [[0.0, 0.0, 0.0055]], [0.0, 0.0, -0.05])
    forces = []
    for _ in range(20):
        state = world.step()
        forces.append(-state.wrench["sensor"][0, 2])
    assert not state.failed.any() and max(forces) > 0.1


def test_a_skew_path_counts_where_it_crosses_the_gel() -> None:
    """In one step from beside the pad to behind it: once through the gel's face, once past the case's edge."""
    faces, half = BondedFaces.on_cpu([MINI.gelpad], [object_parts(SHAPES["grain"])]), 0.5 * MINI.gelpad.size[0]
    for beside, move, crosses in ((half + 0.01, [-0.03, 0.0, -0.06], True), (half + 0.025, [-0.01, 0.0, -0.08], False)):
        before, after = np.tile(np.eye(4), (2, 1, 1, 1, 1, 1))
        before[..., :3, 3] = beside, 0.0, 0.02
        after[..., :3, 3] = before[..., :3, 3] + move
        assert faces.pierced(after, before).item() == crosses
        assert not faces.pierced(before).any() and not faces.pierced(after).any()


def test_what_lies_behind_the_sensor_neither_presses_nor_fails() -> None:
    back = -case_depth(MINI)
    for shape in ("ball", "plate"):
        world = world_of(SHAPES[shape], [[0.0, 0.0, back - 0.02], [0.0, 0.0, 0.02]], [0.0, 0.0, 0.0])
        state = world.step()
        assert not state.failed.any() and not state.wrench["sensor"].any()
        assert not world.observe()["sensor"].surface.contact.any()
        np.testing.assert_allclose([data.qvel[2] for data in world.data], 0.0, atol=1e-12)


def test_a_start_beyond_the_bonded_face_is_refused_and_changes_nothing() -> None:
    body = replace(SHAPES["ball"], position=(0.0, 0.0, -0.002))
    with pytest.raises(InputError, match="overlap by 3 mm at the start"):  # with the case
        TactileWorld(TaskScene("upward", RobotSpec("fixed_sensor"), (body,)))
    world = world_of(SHAPES["ball"], [[0.0, 0.0, 0.02], [0.0, 0.0, 0.03]], [0.0, 0.0, 0.0])
    before = [data.qpos.copy() for data in world.data]
    start = np.tile(np.eye(4), (2, 1, 1))
    start[:, 2, 3] = 0.004, 0.0005  # in contact, as it may be, and through the gel
    with pytest.raises(OverlapError, match="environment 1: 'body' starts beyond the face that the gel of 'sensor'"):
        world.reset(bodies={"body": start})
    for data, was in zip(world.data, before, strict=True):
        np.testing.assert_array_equal(data.qpos, was)
    assert not world.reset([0], bodies={"body": start[:1]}).failed.any()


@pytest.mark.parametrize("gains", ["layer", "lossless"])
def test_gel_that_only_its_surface_shows_below_the_bonded_face_fails_its_environment(
    gains: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plate wider than the pad, a hair above the bonded face: under Gaussians without loss the mirrored borders lift the displacement
    over the plate's; the layer's hold it at the plate."""
    if gains == "lossless":
        monkeypatch.setattr(pyramid, "LAYER_STEPS", tuple((sigma / THICK, 1.0) for sigma in PYRAMID_SIGMAS))
    world = world_of(SHAPES["plate"], [[0.0, 0.0, 0.5e-3 - 0.995 * THICK], [0.0, 0.0, 0.01]], [0.0, 0.0, 0.0], timestep=1e-4)
    for data, model in zip(world.data, (world.models[0], world.models[1]), strict=True):
        mujoco.mj_forward(model, data)
    assert not world.failed.any()
    frame = world.observe()["sensor"]
    assert frame.failed.tolist() == [gains == "lossless", False] == world.failed.tolist()


def faces(count: int, rng: np.random.Generator) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotations(rng.normal(size=(count, 3)))
    poses[:, :3, 3] = rng.uniform([-0.015, -0.013, -0.03], [0.015, 0.013, 0.01], (count, 3))
    return poses


@pytest.mark.parametrize("kind", ["sphere", "box", "cylinder", "capsule", "mesh"])
def test_pierced_is_a_point_of_the_body_below_the_face_and_in_front_of_the_case(kind: str) -> None:
    """Against points drawn in the body; a body whose points all but touch the region is not asked."""
    rng = np.random.default_rng(5)
    size = {
        "sphere": (3e-3,),
        "box": (4e-3, 2e-3, 1e-3),
        "cylinder": (2e-3, 3e-3),
        "capsule": (1e-3, 3e-3),
        "mesh": (4e-3, 2e-3, 1e-3),
    }[kind]
    part = primitive("box" if kind == "mesh" else kind, size)
    box = {"cylinder": (2e-3, 2e-3, 3e-3), "capsule": (1e-3, 1e-3, 4e-3), "sphere": (3e-3, 3e-3, 3e-3)}.get(kind) or size
    points = rng.uniform(-1.0, 1.0, (5000, 3)) * box
    if kind == "sphere":
        points = points[np.linalg.norm(points, axis=1) < 3e-3]
    elif kind == "cylinder":
        points = points[np.hypot(points[:, 0], points[:, 1]) < 2e-3]
    elif kind == "capsule":
        axis = np.clip(points[:, 2], -3e-3, 3e-3)
        points = points[np.linalg.norm(points - axis[:, None] * [0.0, 0.0, 1.0], axis=1) < 1e-3]
    if kind == "mesh":
        import trimesh

        mesh = trimesh.creation.box(extents=2.0 * np.array(size))
        part = mesh_part(mesh.vertices, mesh.faces)
    poses = faces(80, rng)
    found = BondedFaces.on_cpu([MINI.gelpad], [[part]]).pierced(poses[:, None, None])[:, 0, 0]

    def share(margin: float) -> np.ndarray:
        """Of the points in the region grown by a margin [m]."""
        at = np.einsum("bij,nj->bni", poses[:, :3, :3], points) + poses[:, None, :3, 3]
        half = 0.5 * np.array(MINI.gelpad.size) + margin
        inside = (np.abs(at[..., :2]) < half).all(axis=-1)
        return (inside & (at[..., 2] < -THICK + margin) & (at[..., 2] > -2.0 * THICK - margin)).mean(axis=1)

    surely, never = share(-0.4e-3) > 0.0, share(0.4e-3) == 0.0
    assert found[surely].all() and not found[never].any()
    assert surely.sum() > 10 and never.sum() > 10


def test_a_task_ends_an_episode_that_has_failed_and_pays_nothing_for_it() -> None:
    batch = TaskBatch(PushCube(), num_envs=2, tactile=("wrench",), seed=0, device="cpu")
    batch.reset(range(2), [np.random.default_rng(b) for b in range(2)])
    for _ in range(10):
        sound = batch.step(np.tile([0.0, 0.0, -0.5], (2, 1)))
    assert sound.reward.min() > 0.0 and not sound.failed.any()
    cube = batch.world.composed.bodies["cube"]
    batch.world.data[1].qpos[cube.qpos + 2] += 6e-3  # its top goes through the gel
    out = batch.step(np.zeros((2, 3)))
    assert out.failed.tolist() == [False, True] == out.truncated.tolist()
    assert out.reward[0] > 0.0 == out.reward[1] and not out.terminated.any() and not out.success[1]
    assert all(term[1] == 0.0 for term in out.terms.values())
    np.testing.assert_array_equal(out.observation["sensor_wrench"][1], sound.observation["sensor_wrench"][1])
    batch.reset([1], [np.random.default_rng(1)])
    assert not batch.step(np.zeros((2, 3))).failed.any()
