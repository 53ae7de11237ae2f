"""Volume blocks of unstructured meshes."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

import ipc
from tests.ipc.conftest import unit_cell


def scattered() -> ipc.TetMesh:
    """Delaunay tetrahedra of points at random on the lines of a cube."""
    rng = np.random.default_rng(0)
    points = np.stack(np.meshgrid(*[np.arange(7.0)] * 3), axis=-1).reshape(-1, 3) + rng.uniform(-0.3, 0.3, (343, 3))
    tets = Delaunay(points).simplices.astype(np.int32)
    corners = points[tets]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1])
    tets[volume < 0.0] = tets[volume < 0.0][:, [1, 0, 2, 3]]
    return ipc.TetMesh(points, tets[np.abs(volume) > 1e-3])


def test_every_tetrahedron_has_a_block_of_neighbours_around_one_vertex() -> None:
    mesh = scattered()
    blocks = ipc.patch_blocks(mesh)
    assert blocks.min() == 0 and set(blocks) == set(range(blocks.max() + 1))
    size = np.bincount(blocks)
    assert size.min() >= 4 and size.max() < 100
    for block in range(len(size)):
        members = mesh.tets[blocks == block]
        vertices, count = np.unique(members, return_counts=True)
        whole = vertices[count == np.bincount(mesh.tets.ravel(), minlength=len(mesh.vertices))[vertices]]
        near = [np.isin(members, members[(members == centre).any(axis=1)]).sum(axis=1).min() for centre in whole]
        assert len(whole) and max(near) >= 1  # all around one vertex, and what touches that


def test_pieces_apart_share_no_block() -> None:
    cell = unit_cell(2)
    tets = np.concatenate([cell.tets, cell.tets + len(cell.vertices)])
    blocks = ipc.patch_blocks(ipc.TetMesh(np.concatenate([cell.vertices, cell.vertices + np.array([2.0, 0.0, 0.0])]), tets))
    first, second = np.split(blocks, 2)
    assert blocks.min() >= 0 and not np.isin(first, second).any()
