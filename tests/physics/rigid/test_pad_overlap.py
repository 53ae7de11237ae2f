"""Overlap of a body and a resting pad: what is looked at in a window, against all nodes of one fine grid."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.gel.surface import make_grid
from raytac.physics.rigid.layer_response import layer_response
from raytac.physics.rigid.load_law import LoadLaw
from raytac.shapes.part import Part, mesh_part, primitive
from raytac.shapes.underside import object_height, object_radius
from raytac.specs import load_sensor
from tests.physics.rigid.pad_overlap import PadOverlap

PAD = load_sensor("gelsight_mini").gelpad
OVERLAP = PadOverlap(PAD)
FINE = make_grid(PAD, 0.2e-3)


def body(kind: str) -> Part:
    if kind == "mesh":
        import trimesh

        ball = trimesh.creation.icosphere(4, 4e-3)
        return mesh_part(ball.vertices, ball.faces)
    return primitive(kind, {"sphere": (4e-3,), "box": (9e-3, 7e-3, 2e-3), "cylinder": (2e-3, 4e-3), "torus": (6e-3, 1e-3)}[kind])


def pose(x: float, y: float, z: float, tilt: float = 0.0) -> np.ndarray:
    """Tilted about x [rad] after its place [m]."""
    c, s = np.cos(tilt), np.sin(tilt)
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = [[1, 0, 0], [0, c, -s], [0, s, c]], (x, y, z)
    return out


def gap_of(part: Part, at: np.ndarray) -> np.ndarray:
    return object_height([part], at[None], FINE.x, FINE.y)[0] - FINE.rest


def sunk(part: Part, at: np.ndarray, depth: float) -> np.ndarray:
    """``at`` moved along z so that the body overlaps by ``depth``."""
    moved = at.copy()
    moved[2, 3] -= gap_of(part, at).min() + depth
    return moved


CASES = [("sphere", 0.0), ("box", 0.02), ("box", 0.0), ("cylinder", np.pi / 2), ("torus", 0.1), ("mesh", 0.0)]


@pytest.mark.parametrize(("kind", "tilt"), CASES)
@pytest.mark.parametrize("depth", [20e-6, 0.3e-3, 1e-3])
def test_depth_centre_and_normal_are_those_of_all_nodes(kind: str, tilt: float, depth: float) -> None:
    part = body(kind)
    at = sunk(part, pose(2.3e-3, -1.7e-3, 0.0, tilt), depth)
    (found,) = [OVERLAP.touches([part], at[None], object_radius([part]))]
    gap = gap_of(part, at)
    share = np.maximum(-gap, 0.0)
    share /= share.sum()
    lines = FINE.x[None, :], FINE.y[:, None], FINE.rest + np.where(share > 0.0, gap, 0.0)
    expected = [np.sum(share * line) for line in lines]
    slope_y, slope_x = (np.sum(share * slope) for slope in np.gradient(FINE.rest, FINE.y, FINE.x))
    assert found.depth[0] == pytest.approx(depth, rel=0.02, abs=4e-6)
    np.testing.assert_allclose(found.centre[0], expected, atol=0.12e-3)
    assert found.centre[0, 2] == pytest.approx(expected[2], rel=0.02, abs=4e-6)
    assert np.linalg.norm(found.normal[0]) == pytest.approx(1.0)
    np.testing.assert_allclose(found.normal[0, :2] / found.normal[0, 2], (-slope_x, -slope_y), atol=1e-3)
    assert kind != "sphere" or np.hypot(slope_x, slope_y) > 0.01


@pytest.mark.parametrize(("kind", "tilt"), CASES)
def test_what_does_not_touch_is_not_found(kind: str, tilt: float) -> None:
    part = body(kind)
    at = sunk(part, pose(2.3e-3, -1.7e-3, 0.0, tilt), -10e-6)
    assert not len(OVERLAP.touches([part], at[None], object_radius([part])).env)


def test_an_environment_is_found_as_it_is_alone() -> None:
    part, radius = body("sphere"), object_radius([body("sphere")])
    places = [pose(x, y, 0.0) for x, y in ((0.0, 0.0), (3.1e-3, 2.2e-3), (-9e-3, 6e-3), (11e-3, 0.0), (1e-3, -8e-3))]
    at = np.stack([sunk(part, one, depth) for one, depth in zip(places, (0.9e-3, 5e-6, 0.2e-3, -1e-3, 0.5e-3), strict=True)])
    together = OVERLAP.touches([part], at, radius)
    assert together.env.tolist() == [0, 1, 2, 4]
    for k, b in enumerate(together.env):
        alone = OVERLAP.touches([part], at[b : b + 1], radius)
        for name in ("depth", "centre", "normal", "cell", "clear"):
            np.testing.assert_array_equal(getattr(together, name)[k], getattr(alone, name)[0])
        np.testing.assert_array_equal(together.gap[k], alone.gap[0])


@pytest.mark.parametrize("depth", [20e-6, 0.3e-3])
def test_the_law_holds_to_the_depth_that_is_known(depth: float) -> None:
    part = body("sphere")
    at = sunk(part, pose(2.3e-3, -1.7e-3, 0.0), depth)
    found = OVERLAP.touches([part], at[None], object_radius([part]))
    law, known = OVERLAP.law(found, 0), found.known_depth(0, layer_response(PAD))
    gap = gap_of(part, at)
    whole = LoadLaw(np.maximum(gap + found.depth[0], 0.0), FINE.x, FINE.y, PAD)
    assert known >= 1.2 * depth
    for share in (0.1, 0.5, 1.0):
        assert law.force(share * known) == pytest.approx(whole.force(share * known), rel=1e-12)
    assert law.greatest < 0.9 * whole.greatest  # far beyond, it is too soft: RigidPads recomputes it
