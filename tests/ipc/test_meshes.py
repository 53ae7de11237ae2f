"""Meshes: volumes, closed surfaces, areas, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ipc
from ipc.meshes import surface_of, surface_topology, tet_volumes
from ipc.tetwild import tetrahedralize


def test_box_fills_its_volume_with_a_closed_outward_surface() -> None:
    mesh = ipc.box_mesh(np.linspace(0, 2, 4), np.linspace(0, 1, 3), ipc.graded(0.5, 3, 0.7), mirrored=True)
    assert tet_volumes(mesh.vertices, mesh.tets).sum() == pytest.approx(1.0, rel=1e-13)
    faces = surface_of(mesh.tets)
    corners = mesh.vertices[faces]
    assert np.linalg.det(corners).sum() / 6 == pytest.approx(1.0, rel=1e-13)
    topology = surface_topology(mesh.vertices, faces)
    assert len(np.unique(faces)) - len(topology.edges) + len(faces) == 2
    area = 2 * (2 * 1 + 2 * 0.5 + 1 * 0.5)
    assert topology.vertex_area.sum() == pytest.approx(area) and topology.edge_area.sum() == pytest.approx(area)


def test_mirrored_box_is_symmetric() -> None:
    mesh = ipc.domed_pad((2.0, 2.0), 0.5, (5.0, 7.0), (4, 4, 2))
    flipped = mesh.vertices * [-1, 1, 1]
    where = np.linalg.norm(mesh.vertices[:, None] - flipped[None], axis=-1).argmin(axis=0)
    cells = {tuple(sorted(t)) for t in mesh.tets}
    assert {tuple(sorted(where[t])) for t in mesh.tets} == cells


def test_dome_has_its_radii() -> None:
    mesh = ipc.domed_pad((20e-3, 25e-3), 4e-3, (30e-3, np.inf), (8, 8, 2))
    top = mesh.vertices[mesh.vertices[:, 2] > -1.9e-3]
    edge = top[np.isclose(top[:, 0], 10e-3)]
    assert edge[:, 2].max() == pytest.approx(np.sqrt(30e-3**2 - 10e-3**2) - 30e-3, rel=1e-12)
    with pytest.raises(ipc.IpcError, match="falls"):
        ipc.domed_pad((20e-3, 25e-3), 1e-3, (20e-3, 20e-3), (4, 4, 2))


def test_icosphere_is_closed_and_round() -> None:
    sphere = ipc.icosphere(2.0, 2)
    assert np.allclose(np.linalg.norm(sphere.vertices, axis=1), 2.0, rtol=1e-14)
    volume = np.linalg.det(sphere.vertices[sphere.faces]).sum() / 6
    assert 0.95 < volume / (4 / 3 * np.pi * 8) < 1


def test_bad_meshes_are_refused() -> None:
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    with pytest.raises(ipc.IpcError, match="volume"):
        ipc.TetMesh(x, np.array([[0, 2, 1, 3]], np.int32))
    with pytest.raises(ipc.IpcError, match="there are 4"):
        ipc.TetMesh(x, np.array([[0, 1, 2, 4]], np.int32))


def test_tetwild_fills_a_surface_and_reads_its_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    box = ipc.box_surface((1.0, 1.0, 1.0))
    calls = []

    def fake(surface: ipc.TriMesh, edge_length: float) -> tuple[np.ndarray, np.ndarray]:
        calls.append(edge_length)
        mesh = ipc.box_mesh([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])
        return mesh.vertices, mesh.tets[:, [0, 2, 1, 3]]

    monkeypatch.setattr("ipc.tetwild._fill", fake)
    for _ in range(2):
        mesh = tetrahedralize(box, 0.5, cache=tmp_path)
        assert tet_volumes(mesh.vertices, mesh.tets).sum() == pytest.approx(1.0)
    tetrahedralize(box, 0.25, cache=tmp_path)
    assert calls == [0.5, 0.25]


@pytest.mark.slow
def test_tetwild_itself(tmp_path: Path) -> None:
    pytest.importorskip("pytetwild")
    mesh = tetrahedralize(ipc.icosphere(1.0, 2), 0.4, cache=tmp_path)
    assert tet_volumes(mesh.vertices, mesh.tets).sum() == pytest.approx(4 / 3 * np.pi, rel=0.05)


def test_vertices_near_a_surface_are_those_at_that_distance(rng: np.random.Generator) -> None:
    """Against a dense sampling of the surface, which can only be farther away."""
    line = np.linspace(-2.0, 2.0, 9)
    mesh, ball = ipc.box_mesh(line, line, line), ipc.icosphere(1.0, 1)
    near = ipc.vertices_near(mesh, ball, 0.5)
    w = rng.dirichlet([1, 1, 1], (len(ball.faces), 400))
    samples = np.einsum("fsk,fki->fsi", w, ball.vertices[ball.faces]).reshape(-1, 3)
    sampled = np.sqrt(((mesh.vertices[:, None] - samples[None]) ** 2).sum(-1).min(axis=1))
    assert 0 < len(near) < len(mesh.vertices)
    assert (sampled[near] < 0.5 + 0.03).all()
    rest = np.setdiff1d(np.arange(len(mesh.vertices)), near)
    assert (sampled[rest] > 0.5).all()
    points = mesh.vertices[[0, 40]]
    assert ipc.vertices_near(mesh, points, 1e-9).tolist() == [0, 40]
