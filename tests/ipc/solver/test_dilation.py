"""Volume blocks: the mean-dilation term against finite differences, patches, single elements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import ipc
from ipc.bodies import build_layout
from ipc.solver import newton, pcg
from ipc.solver.dilation import dilation_rows
from ipc.solver.linear import find_volume_motions, multiply_blocks
from ipc.solver.potential import Potential
from ipc.solver.preconditioners.rest_stiffness import couplings, rest_blocks
from tests.ipc.conftest import bonded_pad, small_pad, turns, unit_cell
from tests.ipc.solver.test_elasticity import MODELS, Model, dense, energy_change, gradient_at, make_potential, volume_rows

CUDA = pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")])


def blocked_cube(model: Model = "stable", poisson: float = 0.45, own: float = 0.3) -> Potential:
    """Eight cells: two blocks of three cells each, numbered with a gap, and two cells without."""
    blocks = np.repeat([7, 7, -1, 3, 7, 3, 3, -1], 6)
    return make_potential(ipc.Material(1e5, poisson, model=model), unit_cell(2), blocks=blocks, own_volume=own)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(("height", "own"), [(1.0, 0.0), (1.0, 2.0), (0.12, 0.3)])
def test_gradient_and_hessian_match_finite_differences(model: Model, height: float, own: float, rng: np.random.Generator) -> None:
    """Also where elements are squeezed so far that the barrier against inversion acts; the blocks' own term is not small."""
    solver = blocked_cube(model, own=own)
    rest = solver.layout.node_rest
    y = (rest + 0.04 * rng.standard_normal(rest.shape)) * [1, 1, height]
    g = gradient_at(solver, y)
    J = solver.el_J.numpy()[0]
    assert (J > 0.02).all() and (J < 0.2).any() == (height < 1)
    solver.fill_matrix(solver.everyone)
    H, q = dense(solver), volume_rows(solver).reshape(2, -1)
    h = 1e-5 * height
    probes = np.random.default_rng(5).permutation(y.size)[:24]
    steps = [h * np.eye(1, y.size, k).reshape(y.shape) for k in probes]
    g_fd = np.array([energy_change(solver, y - d, y + d) / (2 * h) for d in steps])
    H_fd = np.array([(gradient_at(solver, y + d) - gradient_at(solver, y - d)) / (2 * h) for d in steps])
    assert np.abs(np.einsum("bi,bj->ij", q, q)).max() > (0.08 if height == 1 else 0.003) * np.abs(H).max() > 0.0
    assert np.abs(g[probes] - g_fd).max() / np.abs(g).max() < 1e-8
    assert np.abs(H[probes] - H_fd).max() / np.abs(H).max() < 2e-8
    assert np.abs(H - H.T).max() / np.abs(H).max() < 1e-14


@pytest.mark.parametrize("model", MODELS)
def test_energy_is_that_of_the_mean_dilation(model: Model, rng: np.random.Generator) -> None:
    """Elastic energy less that of the same mesh without blocks, from J of the elements alone."""
    solver, plain = blocked_cube(model), make_potential(ipc.Material(1e5, 0.45, model=model), unit_cell(2))
    y = solver.layout.node_rest + 0.04 * rng.standard_normal(solver.layout.node_rest.shape)
    for one in (solver, plain):
        gradient_at(one, y)
        one.energies()
    J, V, of = plain.el_J.numpy()[0], plain.layout.volume, np.repeat([7, 7, -1, 3, 7, 3, 3, -1], 6)
    mu, lam = plain.layout.mu[0], plain.layout.lam[0]
    a = 1.0 if model == "stable" else 1.0 + 0.75 * mu / lam
    expected = 0.0
    for block in (3, 7):
        inside = of == block
        mean = (V[inside] @ J[inside]) / V[inside].sum()
        expected += 0.5 * (lam - 0.3 * mu) * (V[inside].sum() * (mean - a) ** 2 - V[inside] @ (J[inside] - a) ** 2)
    difference = float(solver.elastic_energy.numpy()[0] - plain.elastic_energy.numpy()[0])
    assert abs(expected) > 1e-3 * plain.elastic_energy.numpy()[0] and difference == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_blocks_of_one_element_are_plain_elements(model: Model, rng: np.random.Generator) -> None:
    """Force, energy, matrix and their changes, to rounding."""
    material, mesh = ipc.Material(1e5, 0.49, model=model), unit_cell(2)
    single = make_potential(material, mesh, blocks=np.arange(len(mesh.tets)))
    plain = make_potential(material, mesh)
    y = plain.layout.node_rest + 0.04 * rng.standard_normal(plain.layout.node_rest.shape)
    z = y + 1e-3 * rng.standard_normal(y.shape)
    found = []
    for one in (single, plain):
        g = gradient_at(one, y)
        one.fill_matrix(one.everyone)
        one.energies()
        found.append((g, dense(one), one.elastic_energy.numpy().copy(), energy_change(one, y, z)))
    assert len(single.layout.block_volume) == len(mesh.tets) and len(plain.layout.block_volume) == 0
    for a, b in zip(*found, strict=True):
        assert np.abs(a - b).max() < 1e-13 * np.abs(b).max()


@pytest.mark.parametrize("model", MODELS)
def test_blocks_whose_elements_keep_all_of_lambda_are_no_blocks(model: Model, rng: np.random.Generator) -> None:
    material, mesh = ipc.Material(1e5, 0.48, model=model), unit_cell(2)
    mu, lam = material.coefficients()
    blocks = ipc.grid_blocks((2, 2, 2))
    y = mesh.vertices + 0.04 * rng.standard_normal(mesh.vertices.shape)
    forces = [
        gradient_at(make_potential(material, mesh, blocks=b, own_volume=own), y) for b, own in ((blocks, lam / mu), (None, 0.0))
    ]
    assert np.abs(forces[0] - forces[1]).max() < 1e-12 * np.abs(forces[1]).max()
    softer = gradient_at(make_potential(material, mesh, blocks=blocks, own_volume=0.5 * lam / mu), y)
    assert np.abs(softer - forces[1]).max() > 0.05 * np.abs(forces[1]).max()
    with pytest.raises(ipc.IpcError, match=r"cube: own_volume = -1: it must lie in \[0, λ/μ\], here \[0, \d\d"):
        make_potential(material, mesh, blocks=blocks, own_volume=-1)


@pytest.mark.parametrize("model", MODELS)
def test_a_linear_displacement_has_constant_stress_and_no_force_inside(model: Model, rng: np.random.Generator) -> None:
    mesh = unit_cell(4)
    inner = ((mesh.vertices > 1e-9) & (mesh.vertices < 1 - 1e-9)).all(axis=1)
    moved = mesh.vertices.copy()
    moved[inner] += 0.03 * rng.standard_normal((inner.sum(), 3))
    solver = make_potential(
        ipc.Material(1e5, 0.49, model=model), ipc.TetMesh(moved, mesh.tets), blocks=ipc.grid_blocks((4, 4, 4))
    )
    F = np.eye(3) + 0.2 * rng.standard_normal((3, 3))
    g = gradient_at(solver, moved @ F.T).reshape(-1, 3)
    stress = solver.el_P.numpy()[0] / solver.layout.volume[:, None, None]
    assert np.abs(stress - stress[0]).max() < 1e-12 * np.abs(stress).max()
    assert inner.sum() == 27 and np.abs(g[inner]).max() < 1e-12 * np.abs(g).max()
    assert len(solver.layout.block_volume) == 16 and np.abs(g).max() > 1e3


def test_a_turned_body_has_the_same_energy_and_turned_forces(rng: np.random.Generator) -> None:
    solver = blocked_cube()
    y = solver.layout.node_rest + 0.04 * rng.standard_normal(solver.layout.node_rest.shape)
    R = turns(rng, 1)[0]
    g = gradient_at(solver, y).reshape(-1, 3)
    solver.energies()
    energy = float(solver.elastic_energy.numpy()[0])
    turned = gradient_at(solver, y @ R.T + [3.0, -1.0, 2.0]).reshape(-1, 3)
    solver.energies()
    assert float(solver.elastic_energy.numpy()[0]) == pytest.approx(energy, rel=1e-12)
    assert np.abs(turned - g @ R.T).max() < 1e-11 * np.abs(g).max()
    assert np.abs(g.sum(axis=0)).max() < 1e-12 * np.abs(g).max()  # and no net force


def test_a_mirrored_state_has_mirrored_forces(rng: np.random.Generator) -> None:
    """Cells and blocks are symmetric about the middle planes, and so is what they do."""
    mesh = unit_cell(4)
    solver = make_potential(ipc.Material(1e5, 0.49), mesh, blocks=ipc.grid_blocks((4, 4, 4)))
    rest = mesh.vertices
    u = 0.02 * rng.standard_normal(rest.shape)
    for axis in (0, 1):
        flip = np.where(np.arange(3) == axis, -1.0, 1.0)
        image = np.array([np.flatnonzero(np.abs(rest - (0.5 + (v - 0.5) * flip)).max(axis=1) < 1e-9)[0] for v in rest])
        g = gradient_at(solver, rest + u).reshape(-1, 3)
        other = gradient_at(solver, rest + (u * flip)[image]).reshape(-1, 3)
        assert np.abs(other - (g * flip)[image]).max() < 1e-11 * np.abs(g).max()


@pytest.mark.parametrize("model", MODELS)
def test_projected_hessian_is_definite_and_close(model: Model, rng: np.random.Generator) -> None:
    """Definite at any state; and where the exact one is definite, near rest, not far from it: nothing is a large multiple of it."""
    solver = blocked_cube(model)
    rest = solver.layout.node_rest
    indefinite = 0
    for scale, height in ((0.0, 1.0), (0.02, 1.0), (0.05, 1.0), (0.15, 1.0), (0.05, 0.1)):
        y = (rest + scale * rng.standard_normal(rest.shape)) * [1, 1, height]
        gradient_at(solver, y)
        solver.fill_matrix(solver.everyone)
        exact = dense(solver)
        gradient_at(solver, y, project=True)
        solver.fill_matrix(solver.everyone)
        projected = dense(solver)
        top = np.linalg.eigvalsh(projected)[-1]
        assert np.linalg.eigvalsh(projected)[0] > -1e-12 * top
        indefinite += np.linalg.eigvalsh(exact)[0] < -1e-9 * top
        if scale == 0.0:
            # At rest only l differs, by less than μ: the freedom to turn is kept.
            turn = np.cross([0.3, -0.5, 0.8], rest - 0.5).ravel()
            assert turn @ projected @ turn < 1e-12 * top * (turn @ turn)
            assert np.linalg.norm(projected - exact) < 0.2 * np.linalg.norm(exact)
    assert indefinite >= 2


def test_the_product_and_the_diagonal_hold_the_blocks(rng: np.random.Generator) -> None:
    """H p by the kernels against the dense matrix, and prescribed motion pushed through the same rows."""
    solver = blocked_cube()
    y = solver.layout.node_rest + 0.04 * rng.standard_normal(solver.layout.node_rest.shape)
    gradient_at(solver, y)
    solver.fill_matrix(solver.everyone)
    H, p = dense(solver), rng.standard_normal(y.shape)
    solver.p.assign(p[None])
    solver.launch(find_volume_motions, solver.dilation.shape, [solver.system, solver.p, solver.everyone])
    out, partial = wp.zeros_like(solver.p), wp.zeros((1, 1), dtype=wp.float64, device="cpu")
    solver.launch(multiply_blocks, (1, 1, 1), [solver.system, solver.p, solver.everyone, 1], [out, partial])
    assert out.numpy()[0].ravel() == pytest.approx(H @ p.ravel(), abs=1e-12 * np.abs(H @ p.ravel()).max())
    assert partial.numpy()[0, 0] == pytest.approx(p.ravel() @ H @ p.ravel(), rel=1e-12)
    jacobi = pcg.BlockJacobi(solver.layout, 1, 1, wp.get_device("cpu"))
    jacobi.update(solver.system, solver.collision.contacts, 0, solver.everyone)
    for i in (0, 13, 26):
        inverse = np.linalg.inv(H[3 * i : 3 * i + 3, 3 * i : 3 * i + 3])
        assert np.abs(jacobi.inverse.numpy()[0, i] - inverse).max() < 1e-10 * np.abs(inverse).max()


@pytest.mark.parametrize("model", MODELS)
def test_rest_blocks_are_the_solvers_matrix_at_rest(model: Model) -> None:
    """What preconditioners and patches invert, with two bodies whose blocks have the same numbers, and affine patches between."""
    pads = [
        bonded_pad(
            small_pad((4, 4, 2)),
            name=name,
            material=ipc.Material(young, 0.48, model=model),
            own_volume=0.25,
            volume_blocks=ipc.grid_blocks((4, 4, 2)),
        )
        for name, young in (("one", 1e5), ("other", 3e5))
    ]
    layout = build_layout([pads[0], replace(pads[1], pose=ipc.Pose((0.0, 0.0, 1.0)))], 0.0, {}, [])
    settings = ipc.Settings(dt=0.01)
    solver = Potential(layout, settings, 1, 1e-4, 1.0, wp.get_device("cpu"))
    solver.y.assign(layout.node_rest[None])
    solver.R.assign(np.broadcast_to(np.eye(3), (1, 2, 3, 3)))
    solver.evaluate_elements(solver.everyone)
    solver.fill_matrix(solver.everyone)
    rows, cols = couplings(layout)
    found = np.zeros((len(layout.node_rest), 3, len(layout.node_rest), 3))
    found[rows, :, cols, :] = rest_blocks(layout, settings)
    H = dense(solver)
    assert len(layout.block_volume) == 16 and len(rows) > 2 * len(layout.col)
    assert np.abs(found.reshape(H.shape) - H).max() < 1e-12 * np.abs(H).max()
    assert not H[: 3 * layout.node_start[1], 3 * layout.node_start[1] :].any()


def press_world(num_envs: int = 1, depth: float = 0.0, device: str = "cpu", **settings: object) -> ipc.World:
    """A ball over a bonded pad of ν = 0.49 in blocks of 2 × 2 × 1 cells."""
    options: dict = {"d_hat": 1e-4, "friction": 0.5} | settings
    ball = ipc.KinematicBody("ball", ipc.icosphere(4e-3, 2), ipc.Pose((1e-4, 2e-4, 4.12e-3 - depth)))
    pad = bonded_pad(small_pad(), material=ipc.Material(1e5, 0.49), volume_blocks=ipc.grid_blocks((6, 6, 2)))
    return ipc.World([pad, ball], ipc.Settings(**options), num_envs=num_envs, device=device)


def press(world: ipc.World, depth: np.ndarray | float, side: np.ndarray | float, steps: int) -> list[ipc.StepReport]:
    start, reports = world.frame("ball")[1], []
    path = np.stack(np.broadcast_arrays(np.asarray(side, float), 0.0, -np.asarray(depth, float)), axis=-1)
    for k in range(1, steps + 1):
        world.set_target("ball", start + path * k / steps)
        reports.append(world.step())
    return reports


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_a_batch_is_its_single_worlds_to_the_bit(device: str) -> None:
    depths, sides = np.array([0.5e-3, 0.8e-3, 0.1e-3]), np.array([2e-4, 0.0, -1e-4])
    batch = press_world(3, device=device, deterministic=True)
    assert all(r.converged.all() for r in press(batch, depths, sides, 5))
    assert batch.wrench("ball").force[1, 2] > 0.05
    for i in range(3):
        single = press_world(device=device, deterministic=True)
        press(single, depths[i], sides[i], 5)
        assert np.array_equal(single.positions("pad")[0], batch.positions("pad")[i])


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")
@pytest.mark.gpu
def test_cuda_agrees_with_the_cpu() -> None:
    fine = {"velocity_tolerance": 1e-9, "linear_tolerance": 1e-8}
    ends = []
    for device in ("cpu", "cuda"):
        world = press_world(2, device=device, **fine)
        press(world, np.array([0.3e-3, 0.6e-3]), 1e-4, 5)
        ends.append(world.positions("pad"))
    assert np.abs(ends[0] - ends[1]).max() < 1e-10


def test_the_general_conjugate_gradients_are_those_of_one_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the whole matrix, as on CUDA."""
    monkeypatch.setattr(newton, "_is_held", lambda layout: False)
    ends = []
    for general in (False, True):
        if general:
            monkeypatch.setattr(pcg, "BlockJacobi", type("Other", (), {}))  # so that solve() takes the general loop
        world = press_world(2)
        reports = press(world, np.array([0.3e-3, 0.4e-3]), 0.0, 2)
        ends.append((world.positions("pad"), reports[-1].linear))
    assert (ends[0][1] > 0).all() and np.abs(ends[0][1] - ends[1][1]).max() <= 1
    assert np.abs(ends[0][0] - ends[1][0]).max() < 1e-12


def test_rows_block_by_block_are_those_gathered_by_pairs(rng: np.random.Generator) -> None:
    """The form of a CPU and that of CUDA."""
    solver = blocked_cube()
    gradient_at(solver, solver.layout.node_rest + 0.1 * rng.standard_normal(solver.layout.node_rest.shape))
    solver.fill_matrix(solver.everyone)
    rows = solver.system.volume_row.numpy().copy()
    solver.system.volume_row.zero_()
    inputs = [solver.elements, solver.volumes, solver.el_F, solver.everyone]
    solver.launch(dilation_rows, rows.shape, inputs, [solver.system.volume_row])
    gathered = solver.system.volume_row.numpy()
    assert np.abs(gathered).min(axis=2).max() > 0
    np.testing.assert_allclose(rows, gathered, rtol=0, atol=1e-14 * np.abs(gathered).max())


def test_the_rest_inverse_knows_the_blocks() -> None:
    """The same press with it, in far fewer iterations than block-Jacobi takes: K_0 has the rows of the blocks."""
    ends = []
    for name in ("block_jacobi", "rest_inverse"):
        world = press_world(preconditioner=name, velocity_tolerance=1e-8, linear_tolerance=1e-8)
        reports = press(world, 0.1e-3, 0.0, 2)
        ends.append((world.positions("pad"), sum(int(r.linear[0]) for r in reports) / sum(int(r.newton[0]) for r in reports)))
    assert np.abs(ends[0][0] - ends[1][0]).max() < 1e-9
    assert ends[1][1] < 0.5 * ends[0][1]


def test_a_hard_press_keeps_every_element_upright() -> None:
    """A ball sunk into 60 % of a layer of ν = 0.49: single elements change their volume, none turns over, and the steps converge."""
    world = press_world(friction=0.0)
    reports = press(world, 2.5e-3, 0.0, 25)
    least = min(float(r.min_det[0]) for r in reports)
    assert all(r.converged[0] and not r.failed[0] for r in reports) and 0.0 < least < 0.9
    assert max(int(r.newton[0]) for r in reports) < 40
    y, layout = world.positions("pad", frame="body")[0], world.layout
    x = y[layout.tets]
    J = np.linalg.det(x[:, 1:] - x[:, :1]) / 6 / layout.volume
    V = layout.volume
    mean = np.bincount(layout.volume_block, V * J) / np.bincount(layout.volume_block, V)
    assert np.abs(mean - 1).max() < 0.3 * np.abs(J - 1).max() and world.wrench("ball").force[0, 2] > 1.0


def test_grips_push_through_the_blocks() -> None:
    """A bar pulled by a grip: the force at the grip is that of the bonded end, and a straight pull keeps the blocks' volume."""
    line = np.linspace(0, 4e-3, 5)
    mesh = ipc.box_mesh(np.linspace(0, 1.6e-2, 9), line, line)
    ends = [np.flatnonzero(np.isclose(mesh.vertices[:, 0], at)) for at in (0, 1.6e-2)]
    blocks = ipc.grid_blocks((8, 4, 4))
    body = ipc.SoftBody("bar", mesh, ipc.Material(1e5, 0.49), bonded=ends[0], grips={"far": ends[1]}, volume_blocks=blocks)
    world = ipc.World([body], ipc.Settings(dt=1e2, velocity_tolerance=1e-12, linear_tolerance=1e-8), device="cpu")
    for k in range(1, 5):
        world.set_target("bar.far", (5e-4 * k, 0.0, 0.0))
        report = world.step()
        assert report.converged[0] and int(report.newton[0]) < 12
    pull = world.wrench("bar").force[0, 0]
    stretch = 1 + 2e-3 / 1.6e-2
    uniaxial = 1e5 / 3 * (stretch - stretch**-2) * 1.6e-5  # an incompressible neo-Hookean bar, less its held ends
    assert abs(pull) == pytest.approx(uniaxial, rel=0.12)


def test_blocks_of_a_grid() -> None:
    cells, line = (3, 4, 3), np.arange(5.0)
    blocks = ipc.grid_blocks(cells, (2, 2, 2))
    mesh = ipc.box_mesh(line[:4], line, line[:4])
    middle = mesh.vertices[mesh.tets].mean(axis=1)
    assert blocks.shape == (len(mesh.tets),) and sorted(set(blocks)) == list(range(2 * 2 * 2))
    assert np.bincount(blocks).tolist() == [48, 24, 48, 24, 24, 12, 24, 12]
    top, low = middle[blocks == 0], middle[blocks == 7]
    assert (
        top.min(axis=0)[2] > 1 and (top.max(axis=0)[:2] < 2).all() and low.max(axis=0)[2] < 1 and (low.min(axis=0)[:2] > 2).all()
    )
    with pytest.raises(ipc.IpcError, match=r"grid_blocks\(cells=\(3, 4, 3\), block=\(2, 0, 1\)\).*at least 1"):
        ipc.grid_blocks(cells, (2, 0, 1))


@pytest.mark.parametrize("blocks", [np.zeros(5, int), np.zeros((48, 1), int), np.zeros(48), np.full(48, -2)])
def test_wrong_blocks_are_refused(blocks: np.ndarray) -> None:
    with pytest.raises(ipc.IpcError, match=r"cube: volume_blocks .*whole numbers of at least −1, shape \(48,\)"):
        ipc.SoftBody("cube", unit_cell(2), ipc.Material(1e5), volume_blocks=blocks)
