"""Volume blocks do not lock: Cook's membrane and a bonded layer under a wave of pressure, up to ν = 0.499."""

from __future__ import annotations

import numpy as np
import pytest

import ipc
from tests.ipc.oracles.closed_forms import layer_compliance
from tests.ipc.oracles.membrane import END, LENGTH, panel, tip_displacement
from tests.ipc.solver.test_elasticity import MODELS, Model, dense, gradient_at, make_potential

RATIOS = (0.45, 0.48, 0.49, 0.499)


def membrane_tip(poisson: float, cells: int, block: tuple[int, int, int] | None, model: Model) -> float:
    """Displacement of Cook's membrane in plane strain: one layer of cells, no motion across it."""
    line = np.linspace(0, 1, cells + 1)
    square = ipc.box_mesh(line, line, np.array([0, 1 / cells]))
    place, vertices = square.vertices[:, :2], square.vertices * LENGTH
    vertices[:, :2] = panel(place)
    blocks = None if block is None else ipc.grid_blocks((cells, cells, 1), block)
    solver = make_potential(
        ipc.Material(1.0, poisson, model=model), ipc.TetMesh(vertices, square.tets), blocks=blocks, own_volume=0.25
    )
    gradient_at(solver, vertices)
    solver.fill_matrix(solver.everyone)
    free = np.ones(vertices.shape, bool)
    free[:, 2] = False
    free[np.isclose(place[:, 0], 0)] = False
    free = free.ravel()
    end, faces = np.isclose(place[:, 0], 1), ipc.surface_of(square.tets)
    faces = faces[end[faces].all(axis=1)]
    first, second = (vertices[faces[:, a]] - vertices[faces[:, 0]] for a in (1, 2))
    area = 0.5 * np.linalg.norm(np.cross(first, second), axis=1)
    load = np.zeros_like(vertices)
    for a in range(3):
        np.add.at(load[:, 1], faces[:, a], area / 3 / END)
    u = np.zeros(load.size)
    u[free] = np.linalg.solve(dense(solver)[np.ix_(free, free)], load.ravel()[free])
    return float(u.reshape(-1, 3)[end & np.isclose(place[:, 1], 0.5), 1].mean())


def test_the_oracle_of_cooks_membrane_has_the_published_displacement() -> None:
    """23.96 in plane stress at ν = 1/3 (tabulated since Cook 1974), approached from below."""
    coarse, fine = (tip_displacement(1.0, 1 / 3, cells, plane_strain=False) for cells in (8, 16))
    assert coarse < fine < 23.97 and fine == pytest.approx(23.96, rel=2e-3)


@pytest.mark.parametrize("model", MODELS)
def test_cooks_membrane_does_not_lock(model: Model) -> None:
    """Against quadratic triangles in plane strain: the error does not grow with ν, and falls as cells get smaller."""
    for poisson in (0.45, 0.49, 0.499):
        exact = tip_displacement(1.0, poisson, 32, plane_strain=True)
        coarse, fine, plain = (membrane_tip(poisson, n, b, model) / exact for n, b in ((4, (2, 2, 1)), (8, (2, 2, 1)), (8, None)))
        assert 0.84 < coarse < 0.91 and 0.95 < fine < 1.0 and 1 - fine < 0.35 * (1 - coarse), f"ν = {poisson}: {coarse}, {fine}"
        assert plain < (0.89 if poisson == 0.45 else 0.86), f"ν = {poisson}, without blocks: {plain}"


def wave_compliance(poisson: float, cells: tuple[int, int, int], block: tuple[int, int, int] | None, model: Model) -> float:
    """Deflection of a bonded layer under a pressure wave of four thicknesses, over the closed form."""
    thickness, length, young = 1e-3, 2e-3, 1e5
    lines = [np.linspace(0, top, n + 1) for top, n in zip((length, length / cells[0] * cells[1], thickness), cells, strict=True)]
    mesh = ipc.box_mesh(lines[0], lines[1], lines[2])
    solver = make_potential(
        ipc.Material(young, poisson, model=model), mesh, blocks=None if block is None else ipc.grid_blocks(cells, block)
    )
    gradient_at(solver, mesh.vertices)
    solver.fill_matrix(solver.everyone)
    x, top = mesh.vertices, np.isclose(mesh.vertices[:, 2], thickness)
    ends = np.stack([np.isclose(x[:, a] * (lines[a][-1] - x[:, a]), 0) for a in (0, 1)], axis=1)
    free = ~np.stack(
        [ends[:, 0] | np.isclose(x[:, 2], 0), ends[:, 1] | np.isclose(x[:, 2], 0), np.isclose(x[:, 2], 0)], axis=1
    ).ravel()
    faces = ipc.surface_of(mesh.tets)
    faces = faces[top[faces].all(axis=1)]
    area = 0.5 * np.linalg.norm(np.cross(x[faces[:, 1]] - x[faces[:, 0]], x[faces[:, 2]] - x[faces[:, 0]]), axis=1)
    wave = np.cos(np.pi * x[:, 0] / length)
    load = np.zeros_like(x)
    for a in range(3):  # ∫ p w over a triangle with p linear between its corners
        np.add.at(load[:, 2], faces[:, a], area / 12 * (wave[faces].sum(axis=1) + wave[faces[:, a]]))
    force = load.ravel()[free]
    u = np.linalg.solve(dense(solver)[np.ix_(free, free)], force)
    wavelength, plane = np.pi / length, young / (1 - poisson**2)
    exact = 2 / (plane * wavelength) * float(layer_compliance(poisson, np.array([wavelength * thickness]))[0])
    return float(force @ u) / (0.5 * length * lines[1][-1]) / exact


@pytest.mark.parametrize("model", MODELS)
def test_a_bonded_layer_does_not_lock(model: Model) -> None:
    """Deflection under a wave of pressure against the closed form of the layer (``layer_compliance``), ν from 0.45 to 0.499.

    Plain elements lose 3 % of it over that range, blocks nothing; and the error falls with the square of the cell.
    """
    blocked, plain = ([wave_compliance(nu, (8, 2, 4), block, model) for nu in RATIOS] for block in ((2, 2, 1), None))
    fine = [wave_compliance(nu, (12, 2, 6), (2, 2, 1), model) for nu in RATIOS]
    assert np.abs(np.array(blocked) - 1).max() < 0.03 and np.ptp(blocked) < 0.008, f"blocks of cells: {blocked}"
    assert np.abs(np.array(fine) - 1).max() < 0.03 / 1.5**2 + 0.003, f"smaller cells: {fine}"
    assert max(plain) < 0.93 and plain[0] - plain[-1] > 0.025, f"without blocks: {plain}"
