"""Depth of points in simple solids, against distances to points drawn on their surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.shapes.part import Part, primitive
from raytac.shapes.point_depth import SOLIDS, point_depth
from raytac.shapes.triangulate import part_surface

POSE = np.eye(4)
POSE[:3, :3] = [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
POSE[:3, 3] = 0.01, -0.02, 0.03
SIZES = {"box": (3e-3, 4e-3, 3.5e-3), "sphere": (4e-3,), "cylinder": (4e-3, 3e-3), "capsule": (3e-3, 4e-3)}


@pytest.mark.parametrize("kind", SIZES)
def test_inside_it_is_the_distance_to_the_surface(kind: str) -> None:
    rng = np.random.default_rng(3)
    part = primitive(kind, SIZES[kind], POSE)
    surface = part_surface(part, 4e-5)
    triangles = surface.vertices[surface.faces]
    triangles = triangles @ POSE[:3, :3].T + POSE[:3, 3]
    points = rng.uniform(-1.0, 1.0, (60, 3)) * 2.5e-3 @ POSE[:3, :3].T + POSE[:3, 3]
    weights = rng.dirichlet(np.ones(3), 60)
    on_surface = np.einsum("wk,fki->fwi", weights, triangles).reshape(-1, 3)
    nearest = np.array([np.linalg.norm(on_surface - p, axis=1).min() for p in points])
    depth = point_depth(part, points)
    inside = depth > 0.0
    assert inside.sum() > 20
    np.testing.assert_allclose(depth[inside], nearest[inside], atol=4e-4)
    assert (-depth[~inside] <= nearest[~inside] + 4e-4).all()


def test_a_half_space_and_what_is_not_known() -> None:
    assert point_depth(Part("plane"), np.array([[0.0, 0.0, -2e-3], [1.0, 2.0, 1e-3]])) == pytest.approx([2e-3, -1e-3])
    assert "ellipsoid" not in SOLIDS
    with pytest.raises(ValueError, match="ellipsoid"):
        point_depth(primitive("ellipsoid", (1e-3, 1e-3, 2e-3)), np.zeros((1, 3)))
