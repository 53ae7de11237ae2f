"""Meshes: volumes, closed surfaces, areas, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import ipc
from ipc.meshes import surface_of, surface_topology, tet_volumes
from ipc.meshes.tetwild import tetrahedralize
from tests.ipc.conftest import bonded_pad

CUTS = get_args(ipc.Cut)


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("cells", [(1, 1, 1), (3, 2, 3), (4, 6, 2)])
def test_box_fills_its_volume_with_a_closed_outward_surface(cells: tuple[int, int, int], cut: ipc.Cut) -> None:
    x, y, z = cells
    mesh = ipc.box_mesh(np.linspace(0, 2, x + 1), np.linspace(0, 1, y + 1), ipc.graded(0.5, z, 0.7), cut)
    volumes = tet_volumes(mesh.vertices, mesh.tets)
    assert len(volumes) == 6 * x * y * z and (volumes > 0).all() and volumes.sum() == pytest.approx(1.0, rel=1e-13)
    faces = surface_of(mesh.tets)
    corners = mesh.vertices[faces]
    assert np.linalg.det(corners).sum() / 6 == pytest.approx(1.0, rel=1e-13)
    topology = surface_topology(mesh.vertices, faces)
    assert len(np.unique(faces)) - len(topology.edges) + len(faces) == 2
    area = 2 * (2 * 1 + 2 * 0.5 + 1 * 0.5)
    assert topology.vertex_area.sum() == pytest.approx(area) and topology.edge_area.sum() == pytest.approx(area)


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("cells", [(1, 2, 3), (5, 4, 3)])
def test_inner_faces_are_shared_by_two_cells_on_either_side(cells: tuple[int, int, int], cut: ipc.Cut) -> None:
    mesh = ipc.box_mesh(*(np.linspace(0, n, n + 1) for n in cells), cut=cut)
    faces = np.sort(mesh.tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    apex = mesh.vertices[mesh.tets.ravel()]
    unique, which, count = np.unique(faces, axis=0, return_inverse=True, return_counts=True)
    middles = mesh.vertices[unique].mean(axis=1)
    outer = ((middles < 1e-9) | (middles > np.array(cells) - 1e-9)).any(axis=1)
    assert (count[outer] == 1).all() and (count[~outer] == 2).all() and outer.any() and (~outer).any()
    a, b, c = (mesh.vertices[unique[which.ravel(), k]] for k in range(3))
    side = np.sign(np.einsum("fi,fi->f", np.cross(b - a, c - a), apex - a))
    assert (np.bincount(which.ravel(), weights=side)[~outer] == 0).all()


def test_neighbouring_cells_are_mirror_images() -> None:
    """Two halves of a box of two cells, in each direction; only some of them with cells cut alike."""

    def halves_match(axis: int, cut: ipc.Cut) -> bool:
        cells = np.where(np.arange(3) == axis, 6, 1)
        mesh = ipc.box_mesh(*(np.linspace(0, n, n + 1) for n in cells), cut=cut)
        middles = mesh.vertices[mesh.tets].mean(axis=1)
        flip = np.where(np.arange(3) == axis, -1.0, 1.0)
        sets = []
        for k in range(6):
            inside = middles[(middles[:, axis] > k) & (middles[:, axis] < k + 1)].copy()
            inside[:, axis] -= k + 0.5
            sets.append({tuple(np.round(m * (flip if k % 2 else 1.0), 9) + 0.0) for m in inside})
        return all(unique == sets[0] for unique in sets)

    for axis in range(3):
        assert halves_match(axis, "mirrored")
        assert not halves_match(axis, "alike")


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("axis", [0, 1])
def test_even_pads_are_symmetric(axis: int, cut: ipc.Cut) -> None:
    mesh = ipc.domed_pad((2.0, 2.0), 0.5, (5.0, 7.0), (4, 4, 3), cut=cut)
    flipped = mesh.vertices * np.where(np.arange(3) == axis, -1, 1)
    where = np.linalg.norm(mesh.vertices[:, None] - flipped[None], axis=-1).argmin(axis=0)
    cells = {tuple(sorted(t)) for t in mesh.tets}
    assert {tuple(sorted(where[t])) for t in mesh.tets} == cells


def squeezed(cut: ipc.Cut, poisson: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Vertices at rest, their displacements and the force [N] of a small flat punch on the middle of a bonded pad."""
    mesh = ipc.domed_pad((12e-3, 12e-3), 4e-3, (np.inf, np.inf), (8, 8, 3), cut=cut)
    pad = bonded_pad(mesh, material=ipc.Material(4e5, poisson))
    block = ipc.box_mesh([-1.5e-3, 0, 1.5e-3], [-1.5e-3, 0, 1.5e-3], [0, 1e-3])  # its triangles are symmetric too
    punch = ipc.KinematicBody("punch", ipc.TriMesh(block.vertices, surface_of(block.tets)), ipc.Pose((0, 0, 2.1e-5)))
    settings = ipc.Settings(d_hat=2e-5, velocity_tolerance=1e-6, linear_tolerance=1e-8)
    world = ipc.World([pad, punch], settings, device="cpu")
    for depth in (0.0, 2e-5, 4e-5):
        world.set_target("punch", position=(0.0, 0.0, -depth))
        assert world.step().converged.all()
    return mesh.vertices, world.positions("pad")[0] - mesh.vertices, float(world.wrench("punch").force[0, 2])


def test_mirrored_cells_lock_less_and_a_symmetric_press_stays_symmetric() -> None:
    (rest, moved, force), (_, _, locked) = squeezed("mirrored", 0.48), squeezed("alike", 0.48)
    assert locked > 1.3 * force > 0
    # Straight above a vertex the symmetric state is a ridge of the energy: what rounding begins grows up to the tolerance of the solve.
    rounding = 1e-8
    for axis in (0, 1):
        flip = np.where(np.arange(3) == axis, -1.0, 1.0)
        where = np.linalg.norm(rest[:, None] - (rest * flip)[None], axis=-1).argmin(axis=0)
        np.testing.assert_allclose(moved[where] * flip, moved, rtol=0, atol=rounding)
    swapped = np.linalg.norm(rest[:, None] - rest[None][..., [1, 0, 2]], axis=-1).argmin(axis=0)
    np.testing.assert_allclose(moved[swapped][:, [1, 0, 2]], moved, rtol=0, atol=rounding)


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
    with pytest.raises(ipc.IpcError, match=r"cut = 'halved'.*mirrored, alike"):
        ipc.box_mesh([0, 1], [0, 1], [0, 1], cut="halved")  # type: ignore[arg-type]
    with pytest.raises(ipc.IpcError, match="there are 4"):
        ipc.TetMesh(x, np.array([[0, 1, 2, 4]], np.int32))


def test_tetwild_fills_a_surface_and_reads_its_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    box = ipc.box_surface((1.0, 1.0, 1.0))
    calls = []

    def fake(surface: ipc.TriMesh, edge_length: float) -> tuple[np.ndarray, np.ndarray]:
        calls.append(edge_length)
        mesh = ipc.box_mesh([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])
        return mesh.vertices, mesh.tets[:, [0, 2, 1, 3]]

    monkeypatch.setattr("ipc.meshes.tetwild._fill", fake)
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
