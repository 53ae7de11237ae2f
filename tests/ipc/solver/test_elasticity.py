"""Elastic energies against finite differences, Lamé's constants, an affine patch and uniaxial stretch and shear."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
import warp as wp

import ipc
from ipc.bodies import build_layout
from ipc.solver import elasticity
from ipc.solver.potential import Potential
from tests.ipc.conftest import bonded_pad, small_pad, unit_cell

Model = Literal["stable", "stable_log"]

MODELS: list[Model] = ["stable", "stable_log"]


def make_potential(
    material: ipc.Material,
    mesh: ipc.TetMesh | None = None,
    bonded: np.ndarray | None = None,
    blocks: np.ndarray | None = None,
    own_volume: float = 0.0,
) -> Potential:
    """A solver of one cube of soft material, statics only."""
    held = np.zeros(0, int) if bonded is None else bonded
    body = ipc.SoftBody("cube", mesh or unit_cell(1), material, bonded=held, volume_blocks=blocks, own_volume=own_volume)
    layout = build_layout([body], 0.0, {}, [])
    statics = ipc.Settings(dt=np.inf)  # no inertia
    solver = Potential(layout, statics, 1, 0.01, 1.0, wp.get_device("cpu"))
    solver.y.assign(layout.node_rest[None])
    identity = np.eye(3)[None, None]
    solver.R.assign(identity)
    return solver


def dense(solver: Potential) -> np.ndarray:
    """The assembled matrix, with the rows of volume blocks, as a dense one (3N, 3N)."""
    n, layout = solver.y.shape[1], solver.layout
    out = np.zeros((n, n, 3, 3))
    rows = np.repeat(np.arange(n), np.diff(layout.row_start))
    out[rows, layout.col] = solver.system.blocks.numpy()[0, solver.where]
    q = volume_rows(solver)
    out += np.einsum("bia,bjc->ijac", q, q)
    return out.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)


def volume_rows(solver: Potential) -> np.ndarray:
    """q of every volume block at every node, (Q, N, 3)."""
    layout = solver.layout
    q = np.zeros((len(layout.block_volume), solver.y.shape[1], 3))
    q[layout.pair_block, layout.pair_node] = solver.system.volume_row.numpy()[0]
    return q


def gradient_at(solver: Potential, y: np.ndarray, project: bool = False) -> np.ndarray:
    solver.y.assign(y[None])
    solver.project.fill_(int(project))
    solver.assemble(solver.everyone)
    return solver.gradient.numpy()[0].ravel().copy()


def energy_change(solver: Potential, y0: np.ndarray, y1: np.ndarray) -> float:
    for array, y in ((solver.y, y0), (solver.y1, y1)):
        array.assign(y[None])
    solver.evaluate_elements(solver.everyone)
    solver.elastic_change(solver.everyone, wp.full(1, np.inf, dtype=wp.float64, device="cpu"))
    return float(solver.el_change.numpy().sum())


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("height", [1.0, 0.12])
def test_gradient_and_hessian_match_finite_differences(model: Model, height: float, rng: np.random.Generator) -> None:
    """Also where elements are squeezed so far that the barrier against inversion acts."""
    solver = make_potential(ipc.Material(1e5, 0.4, model=model))
    y = (solver.layout.node_rest + 0.1 * rng.standard_normal(solver.layout.node_rest.shape)) * [1, 1, height]
    g = gradient_at(solver, y)
    J = solver.el_J.numpy()[0]
    assert (J > 0.05).all() and (J < 0.2).any() == (height < 1)
    solver.fill_matrix(solver.everyone)
    H = dense(solver)
    h = 1e-5 * height
    steps = [h * np.eye(y.size)[k].reshape(y.shape) for k in range(y.size)]
    g_fd = np.array([energy_change(solver, y - d, y + d) / (2 * h) for d in steps])
    H_fd = np.array([(gradient_at(solver, y + d) - gradient_at(solver, y - d)) / (2 * h) for d in steps])
    assert np.linalg.norm(g) > 1e3 and np.linalg.norm(H) > 1e4
    assert np.abs(g - g_fd).max() / np.abs(g).max() < 1e-8
    assert np.abs(H - H_fd).max() / np.abs(H).max() < 1e-8
    assert np.abs(H - H.T).max() / np.abs(H).max() < 1e-14


@pytest.mark.parametrize("model", MODELS)
def test_blocks_are_the_same_summed_by_elements_and_gathered(model: Model, rng: np.random.Generator) -> None:
    """The form of a CPU, whose blocks are their transposes bit for bit, and that of CUDA."""
    solver = make_potential(ipc.Material(1e5, 0.4, model=model))
    y = solver.layout.node_rest + 0.1 * rng.standard_normal(solver.layout.node_rest.shape)
    gradient_at(solver, y)
    solver.fill_matrix(solver.everyone)
    summed = dense(solver)
    assert np.array_equal(summed, summed.T) and np.linalg.norm(summed) > 1e4
    solver.system.blocks.zero_()
    inputs = [solver.upper, solver.part_start, solver.part, solver.elements, solver.masses, solver.dt]
    inputs += [solver.el_F, solver.el_mckl, solver.everyone]
    solver.launch(elasticity.block_hessian, (1, len(solver.upper)), inputs, [solver.system.blocks])
    gathered = dense(solver)
    assert np.abs(summed - gathered).max() < 1e-14 * np.abs(gathered).max()


@pytest.mark.parametrize("model", MODELS)
def test_projected_hessian_is_definite_and_close(model: Model, rng: np.random.Generator) -> None:
    solver = make_potential(ipc.Material(1e5, 0.45, model=model))
    indefinite = 0
    for scale, height in ((0.02, 1.0), (0.2, 1.0), (0.6, 1.0), (0.1, 0.1)):
        y = (solver.layout.node_rest + scale * rng.standard_normal(solver.layout.node_rest.shape)) * [1, 1, height]
        gradient_at(solver, y)
        solver.fill_matrix(solver.everyone)
        exact, c = dense(solver), solver.el_mckl.numpy()[0, :, 1].copy()
        gradient_at(solver, y, project=True)
        solver.fill_matrix(solver.everyone)
        projected, reduced = dense(solver), solver.el_mckl.numpy()[0, :, 1].copy()
        top = np.linalg.eigvalsh(projected)[-1]
        assert np.linalg.eigvalsh(projected)[0] > -1e-12 * top
        indefinite += np.linalg.eigvalsh(exact)[0] < -1e-9 * top
        # The geometric term was shrunk, never turned round, and nothing else was changed.
        assert (np.abs(reduced) > 0).all() and (reduced / c > 0).all() and (reduced / c <= 1).all()
        taken = np.zeros((len(y), 3, len(y), 3))
        for e, corners in enumerate(solver.layout.tets):
            F, grads = solver.el_F.numpy()[0, e], solver.layout.grads[e]
            for a in range(4):
                for b in range(4):
                    x, y_, z = F @ np.cross(grads[a], grads[b])
                    skew = np.array([[0, -z, y_], [z, 0, -x], [-y_, x, 0]])
                    taken[corners[a], :, corners[b]] -= solver.layout.volume[e] * (c[e] - reduced[e]) * skew
        assert np.abs(exact - projected - taken.reshape(projected.shape)).max() < 1e-12 * top
    assert indefinite >= 3


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.49])
def test_rest_state_is_free_of_stress_and_has_lame_constants(model: Model, poisson: float) -> None:
    material = ipc.Material(2e5, poisson, model=model)
    solver = make_potential(material)
    rest = solver.layout.node_rest
    assert np.abs(gradient_at(solver, rest)).max() < 1e-9 * material.young
    solver.masses.inertia.zero_()
    solver.fill_matrix(solver.everyone)
    H = dense(solver)
    mu, lam = material.lame()
    for strain, expected in (
        (np.diag([1.0, 0, 0]), lam + 2 * mu),
        (np.eye(3), 9 * lam + 6 * mu),
        (np.array([[0, 0.5, 0], [0.5, 0, 0], [0, 0, 0]]), mu),
        (np.array([[0, 1.0, 0], [-1.0, 0, 0], [0, 0, 0]]), 0.0),
    ):
        u = (rest @ strain.T).ravel()
        assert u @ H @ u == pytest.approx(expected, rel=1e-11, abs=1e-9 * material.young)


def test_affine_patch_is_reproduced() -> None:
    """Affine displacements on the boundary give the affine field inside, to 1e-10."""
    rng = np.random.default_rng(3)
    mesh = unit_cell(3)
    inner = ((mesh.vertices > 1e-9) & (mesh.vertices < 1 - 1e-9)).all(axis=1)
    v = mesh.vertices.copy()
    v[inner] += 0.05 * rng.standard_normal((inner.sum(), 3))
    mesh = ipc.TetMesh(v, mesh.tets)
    body = ipc.SoftBody("block", mesh, ipc.Material(1e5, 0.4), bonded=np.flatnonzero(~inner))
    world = ipc.World([body], ipc.Settings(dt=1e3, velocity_tolerance=1e-16, linear_tolerance=1e-12), device="cpu")
    F = np.eye(3) + 0.15 * rng.standard_normal((3, 3))
    expected = v @ F.T
    state = world.save()
    state.y[0, ~inner] = expected[~inner]
    state.y[0, inner] = (v @ (0.5 * (F + np.eye(3))).T)[inner]
    world.restore(state)
    for _ in range(3):
        world.step()
    error = np.abs(world.positions("block")[0] - expected).max()
    assert inner.sum() >= 8 and error < 1e-10, f"off by {error:.3g}"


@pytest.mark.parametrize("model", MODELS)
def test_uniaxial_and_shear_moduli(model: Model) -> None:
    """A pulled block has E and ν, a sheared one G, to 0.1 %, at a strain of 1e-4."""
    material = ipc.Material(1e5, 0.45, model=model)
    mesh = unit_cell(2)
    x = mesh.vertices
    strain, mu = 1e-4, material.young / (2 * 1.45)
    settings = ipc.Settings(dt=1e4, velocity_tolerance=1e-14, linear_tolerance=1e-10)
    # Symmetry planes would need sliding supports; instead bond the two ends with the sideways contraction already in place.
    ends = np.flatnonzero(np.isclose(x[:, 0], 0) | np.isclose(x[:, 0], 1))
    for F, stress in (
        (np.diag([1 + strain, 1 - 0.45 * strain, 1 - 0.45 * strain]), material.young * strain),
        (np.eye(3) + strain * np.outer([0, 1, 0], [1, 0, 0]), mu * strain),
    ):
        world = ipc.World([ipc.SoftBody("block", mesh, material, bonded=ends)], settings, device="cpu")
        state = world.save()
        state.y[0, ends] = (x @ F.T)[ends]
        if F[1, 0]:  # simple shear needs its tractions on the sides too: hold them
            world = ipc.World(
                [ipc.SoftBody("block", mesh, material, bonded=np.flatnonzero(x.min(1) * (1 - x).min(1) == 0))],
                settings,
                device="cpu",
            )
            state = world.save()
            state.y[0] = x @ F.T
        world.restore(state)
        world.step()
        gradient = world._potential.gradient.numpy()[0]
        face = np.isclose(x[:, 0], 1)
        if F[1, 0]:
            P = world._potential.el_P.numpy()[0] / world.layout.volume[:, None, None]
            assert P[:, 1, 0].mean() == pytest.approx(stress, rel=1e-3)
        else:
            assert gradient[face, 0].sum() == pytest.approx(stress, rel=1e-3)


def test_bad_materials_are_refused() -> None:
    with pytest.raises(ipc.IpcError, match=r"0\.5"):
        ipc.Material(1e5, 0.5)
    with pytest.raises(ipc.IpcError, match="young"):
        ipc.Material(-1.0)


def test_blocks_are_used_again_until_an_element_deforms(rng: np.random.Generator) -> None:
    """After small motions the blocks stay; after a large one, another projection or at a new step they are new."""
    world = ipc.World([bonded_pad(small_pad())], ipc.Settings(dt=0.01, preconditioner="block_jacobi"), device="cpu")
    pot = world._newton.potential
    pot.place_vertices(pot.y, pot.R, pot.t, pot.x)
    free = world.layout.node_free[None, :, None]
    start, upper, edge = pot.y.numpy().copy(), pot.upper.numpy()[:, 1], world.layout.min_edge

    def blocks(share: float, *, anew: bool = False) -> np.ndarray:
        pot.y.assign(start + share * edge * free * motion)
        if anew:
            pot.forget_matrix()
        pot.assemble(pot.everyone)
        pot.fill_matrix(pot.everyone)
        return pot.system.blocks.numpy()[0, upper].copy()

    motion = rng.uniform(-1.0, 1.0, size=start.shape)
    first = blocks(0.0)
    assert np.array_equal(blocks(1e-4), first) and not np.array_equal(blocks(1e-4, anew=True), first)
    assert np.array_equal(blocks(0.1), blocks(0.1, anew=True))
    definite = blocks(0.3)
    pot.project.fill_(1)
    assert not np.array_equal(blocks(0.3), definite)
