"""The surface that a soft body's tetrahedra carry along: what it reproduces exactly, and what it evens out."""

from __future__ import annotations

import numpy as np
import pytest

import ipc
from raytac.physics.soft.skin import SoftSkin, _subdivide
from raytac.shapes.part import primitive
from raytac.shapes.triangulate import enclosed_volume

RADIUS, SIDE = 4e-3, 6e-3


def lines(count: int) -> np.ndarray:
    return np.linspace(-0.5 * SIDE, 0.5 * SIDE, count + 1)


@pytest.fixture(scope="module")
def ball():
    """A ball whose tetrahedra are those of a cube blown up: facets of 1.3 mm."""
    cut = ipc.box_mesh(lines(6), lines(6), lines(6), cut="mirrored")
    far, out = np.abs(cut.vertices).max(axis=1, keepdims=True), np.linalg.norm(cut.vertices, axis=1, keepdims=True)
    vertices = cut.vertices * (RADIUS / (0.5 * SIDE)) * far / np.maximum(out, 1e-12)
    tets = ipc.TetMesh(vertices, cut.tets)
    return tets, SoftSkin((primitive("sphere", (RADIUS,)),), tets)


def test_at_rest_it_is_the_object_and_not_its_facets(ball):
    tets, skin = ball
    still = skin.deform(tets.vertices[None])[0]
    assert np.abs(still - skin.rest).max() < 1e-12
    assert np.abs(np.linalg.norm(still, axis=1) - RADIUS).max() < 1e-9
    middles = skin.rest[skin.faces].mean(axis=1)
    assert (RADIUS - np.linalg.norm(middles, axis=1)).max() < 2e-6  # its own facets


def test_motions_that_are_linear_in_the_place_are_exact(ball):
    tets, skin = ball
    rng = np.random.default_rng(0)
    motion, shift = np.eye(3) + 0.5 * rng.normal(size=(2, 3, 3)), rng.normal(size=(2, 1, 3))
    found = skin.deform(np.einsum("bij,vj->bvi", motion, tets.vertices) + shift)
    assert np.abs(found - np.einsum("bij,vj->bvi", motion, skin.rest) - shift).max() < 1e-12


def test_a_bend_is_followed_and_single_vertices_are_evened_out(ball):
    """A flattening as of a contact: closer than the facets come; of noise of single vertices less than two thirds is left."""
    tets, skin = ball

    def bent(at):
        moved = at.copy()
        moved[:, 2] += 0.2e-3 * np.cos(at[:, 0] / 2.5e-3) * np.cos(at[:, 1] / 2.5e-3)
        return moved

    found = skin.deform(bent(tets.vertices)[None])[0]
    assert np.abs(found - bent(skin.rest)).max() < 0.05 * 0.2e-3
    noise = 10e-6 * np.random.default_rng(1).normal(size=tets.vertices.shape)
    left = skin.deform((tets.vertices + noise)[None])[0] - skin.rest
    assert 0.5e-6 < np.sqrt((left**2).mean()) < 6.7e-6


def test_a_box_keeps_its_shape():
    tets = ipc.box_mesh(lines(4), lines(4), lines(4), cut="mirrored")
    skin = SoftSkin((primitive("box", (0.5 * SIDE,) * 3),), tets)
    assert len(skin.rest) > 100 and np.abs(skin.rest).max() == pytest.approx(0.5 * SIDE)
    assert enclosed_volume(ipc.TriMesh(skin.deform(tets.vertices[None])[0], skin.faces)) == pytest.approx(SIDE**3)


def test_long_edges_are_halved_on_both_sides_alike():
    box = ipc.box_mesh(np.array([0.0, 1.0]), np.array([0.0, 0.4]), np.array([0.0, 3.0]), cut="alike")
    surface = np.concatenate([box.tets[:, k] for k in ([1, 3, 2], [0, 2, 3], [0, 3, 1], [0, 1, 2])])
    _, first, count = np.unique(np.sort(surface, axis=1), axis=0, return_index=True, return_counts=True)
    outer = surface[first[count == 1]]
    whole = abs(enclosed_volume(ipc.TriMesh(box.vertices, outer)))
    vertices, faces = _subdivide(box.vertices, outer, 0.3)
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    assert np.linalg.norm(vertices[sides[:, 0]] - vertices[sides[:, 1]], axis=1).max() <= 0.3
    assert (np.unique(sides, axis=0, return_counts=True)[1] == 2).all()  # closed
    assert whole == pytest.approx(1.2) and abs(enclosed_volume(ipc.TriMesh(vertices, faces))) == pytest.approx(1.2)
