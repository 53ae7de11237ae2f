"""Bodies beyond bonded faces, at a pose or on the path to it: the kernels against NumPy, and CUDA against the CPU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
import warp as wp

from raytac.physics.rigid.contact_rows import LAST
from raytac.physics.rigid.pierced import BondedFaces
from raytac.physics.rigid.search_kernels import PITCHES
from raytac.physics.rigid.shape_arrays import PadArrays, ShapeArrays
from raytac.se3 import rotations
from raytac.shapes.part import Part, mesh_part, primitive
from raytac.specs import load_sensor
from tests.physics.rigid import oracle_pierced

MINI = load_sensor("gelsight_mini").gelpad
GELS = MINI, replace(MINI, size=(12e-3, 9e-3), thickness=3e-3)


def shifted(part: Part, at: tuple[float, float, float]) -> Part:
    pose = part.object_from_part.copy()
    pose[:3, 3] = at
    return replace(part, object_from_part=pose)


def bodies() -> list[list[Part]]:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=3e-3)
    return [
        [primitive("sphere", (3e-3,))],
        [primitive("box", (4e-3, 2e-3, 1e-3)), shifted(primitive("sphere", (1e-3,)), (3e-3, 0.0, 4e-3))],
        [primitive("plane", ())],
        [primitive("torus", (3e-3, 1e-3))],
        [mesh_part(ball.vertices, ball.faces)],
    ]


def random_poses(count: int, seed: int) -> np.ndarray:
    """About the layer behind the faces, (count, pads, bodies, 4, 4); one of each is not finite."""
    rng, shape = np.random.default_rng(seed), (count, len(GELS), len(bodies()))
    poses = np.tile(np.eye(4), (*shape, 1, 1))
    poses[..., :3, :3] = rotations(rng.normal(size=(*shape, 3)).reshape(-1, 3)).reshape(*shape, 3, 3)
    poses[..., :3, 3] = rng.uniform([-0.012, -0.01, -0.02], [0.012, 0.01, 0.01], (*shape, 3))
    poses[-1] = np.nan
    return poses


def test_bodies_beyond_a_face_are_those_of_numpy() -> None:
    poses = random_poses(120, 1)
    expected = oracle_pierced.BondedFaces(GELS, bodies()).pierced(poses)
    np.testing.assert_array_equal(BondedFaces.on_cpu(GELS, bodies()).pierced(poses), expected)
    assert (expected.mean(axis=0) > 0.1).all() and (expected.mean(axis=0) < 0.9).all() and not expected[-1].any()


def test_paths_through_a_face_are_those_of_numpy() -> None:
    """From above the gel to below the case, with a turn; before may be unknown."""
    after, before = random_poses(12, 2), random_poses(12, 3)
    after[..., 2, 3] -= 0.03
    before[..., 2, 3] += 0.03
    before[::5] = np.nan
    oracle = oracle_pierced.BondedFaces(GELS, bodies())
    expected = oracle.pierced_on_path(after, before, np.ones(after.shape[:3], bool))
    np.testing.assert_array_equal(BondedFaces.on_cpu(GELS, bodies()).pierced(after, before), expected)
    ends = oracle.pierced(after)
    assert ((expected & ~ends).mean(axis=0)[:, [0, 1, 3, 4]] > 0.2).all() and not expected.all()


@pytest.mark.gpu
def test_cuda_finds_what_the_cpu_finds() -> None:
    wp.init()
    device = wp.get_device("cuda")
    faces = BondedFaces(PadArrays(GELS, PITCHES, LAST, device), ShapeArrays(bodies(), device), device)
    after, before = random_poses(80, 2), random_poses(80, 3)
    before[..., 2, 3] += 0.03
    expected = BondedFaces.on_cpu(GELS, bodies()).pierced(after, before)
    # A line through an edge between two triangles may see either.
    assert (faces.pierced(after, before) != expected).mean() < 0.002
