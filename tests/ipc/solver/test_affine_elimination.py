"""Affine bodies in the preconditioner: is M what its formula says, and do mixed worlds need fewer iterations for the same steps?"""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
import warp as wp

import ipc
from ipc.settings import RIGID_STIFFNESS, barrier_stiffness
from ipc.solver import affine_elimination, pcg
from ipc.solver.block_jacobi import BlockJacobi
from ipc.solver.preconditioners import RestInverse
from tests.ipc.conftest import bonded_pad, small_pad
from tests.ipc.hard.run import Setup, Worst
from tests.ipc.hard.scenes import CASES

G = (0.0, 0.0, -9.81)


def blocks_on_pad(affine: tuple[bool, ...], num_envs: int = 1, **changes: object) -> ipc.World:
    """A pad under a stack of 2 mm cubes, affine or soft, each 90 µm over what is below it."""
    line = np.linspace(-1e-3, 1e-3, 3)
    bodies: list[ipc.Body] = [bonded_pad(small_pad((4, 4, 2)))]
    for k, rigid in enumerate(affine):
        pose = ipc.Pose((1e-4 * k, 0, 1.09e-3 + 2.09e-3 * k))
        surface = ipc.box_surface((2e-3, 2e-3, 2e-3))
        soft = ipc.SoftBody(f"b{k}", ipc.box_mesh(line, line, line), ipc.Material(1e5, 0.4), pose=pose)
        bodies.append(ipc.AffineBody(f"b{k}", surface, pose=pose) if rigid else soft)
    options: dict = {"gravity": G, "d_hat": 1e-4} | changes
    return ipc.World(bodies, ipc.Settings(**options), num_envs=num_envs, device="cpu")


def with_blocks_only(world: ipc.World) -> ipc.World:
    """The same world with 3×3 blocks for the nodes of affine bodies, as if the elimination had no memory."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(affine_elimination, "MOST_BYTES", 0)
        preconditioner = BlockJacobi(world.layout, world.num_envs, 1, world.device)
    assert preconditioner.affine is None
    world._newton.preconditioner = preconditioner
    return world


class Dense:
    """H where it must be definite and M⁻¹ of a world after a step, dense over the unknowns, and the rows of its contacts."""

    def __init__(self, world: ipc.World, make: type[BlockJacobi] | type[RestInverse] = BlockJacobi) -> None:
        pot, layout = world._potential, world.layout
        pot.assemble(pot.everyone)
        pot.fill_matrix(pot.everyone)
        n = len(layout.node_rest)
        self.free = np.flatnonzero(layout.node_free)
        blocks = np.zeros((n, 3, n, 3))
        rows = np.repeat(np.arange(n), np.diff(layout.row_start))
        blocks[rows, :, layout.col, :] = pot.system.blocks.numpy()[0][pot.where]
        contacts, R = pot.collision.contacts, pot.R.numpy()[0]
        kept = np.flatnonzero(contacts.concave.numpy()[0, : int(contacts.row_count.numpy()[0])] == 0)
        verts, values = contacts.row_verts.numpy()[0, kept], contacts.row.numpy()[0, kept]
        self.q = np.zeros((len(kept), n, 3))
        for r in range(len(kept)):
            for k in range(4):
                v = verts[r, k]
                for m in range(layout.vert_count[v] if v >= 0 else 0):
                    self.q[r, layout.vert_nodes[v, m]] += layout.vert_weight[v, m] * R[layout.vert_body[v]].T @ values[r, :, k]
        self.q[:, layout.node_free == 0] = 0
        self.elastic = blocks
        self.affine = np.isin(np.arange(n), layout.vert_nodes[layout.vert_count == 4])
        size = (1, 1, world.device)
        preconditioner = RestInverse(layout, world.settings, *size) if make is RestInverse else BlockJacobi(layout, *size)
        preconditioner.update(pot.system, contacts, contacts.row.shape[1], pot.everyone)
        inverse = np.zeros((n, 3, n, 3))
        for i in self.free:
            for c in range(3):
                r = np.zeros((1, n, 3))
                r[0, i, c] = 1.0
                z = wp.zeros_like(pot.y)
                preconditioner.apply(wp.array(r, dtype=wp.vec3d, device="cpu"), pot.everyone, z)
                inverse[:, :, i, c] = z.numpy()[0]
        self.inverse = self.on_free(inverse)
        self.H = self.on_free(blocks + np.einsum("rni,rmj->nimj", self.q, self.q))

    def on_free(self, matrix: np.ndarray) -> np.ndarray:
        return matrix[self.free][:, :, self.free].reshape(3 * len(self.free), -1)

    def formula(self) -> np.ndarray:
        """M of the module's docstring, from the rows."""
        n = len(self.affine)
        M = np.zeros((n, 3, n, 3))
        both = self.affine[:, None] & self.affine
        M += self.elastic * (both | np.eye(n, dtype=bool))[:, None, :, None]
        for q in self.q:
            soft = np.linalg.norm(q, axis=1) * ~self.affine
            mixed = bool(soft.any() and (np.abs(q[self.affine]) > 0).any())
            keep = both | (self.affine[:, None] != self.affine)
            M += np.einsum("ni,mj->nimj", q, q) * keep[:, None, :, None]
            for i in np.flatnonzero(soft):
                M[i, :, i] += np.outer(q[i], q[i]) * (soft.sum() / soft[i] if mixed else 1.0)
        return self.on_free(M)


def after(world: ipc.World, steps: int) -> ipc.World:
    for _ in range(steps):
        assert not world.step().failed.any()
    return world


@pytest.mark.parametrize("affine", [(True,), (True, True), (True, False, True)])
def test_m_is_its_formula_and_bounds_the_contacts(affine: tuple[bool, ...]) -> None:
    dense = Dense(after(blocks_on_pad(affine, friction=0.3), 3))
    M = dense.formula()
    assert np.abs(dense.q[:, dense.affine]).max() > 0 and np.abs(dense.q[:, ~dense.affine]).max() > 0
    error = dense.inverse @ M - np.eye(len(M))
    assert np.abs(error).max() < 1e-6
    np.testing.assert_allclose(dense.inverse, dense.inverse.T, rtol=0, atol=1e-10 * np.abs(dense.inverse).max())
    assert np.linalg.eigvalsh(dense.inverse).min() > 0
    # What M puts for rows between soft nodes and affine bodies is never less than these rows themselves.
    soft = ~dense.affine[dense.free].repeat(3)
    mixed = (np.abs(dense.q[:, dense.affine]) > 0).any(axis=(1, 2)) & (np.abs(dense.q[:, ~dense.affine]) > 0).any(axis=(1, 2))
    rows = dense.q[mixed][:, dense.free].reshape(-1, len(M))
    exact = dense.q[~mixed][:, dense.free].reshape(-1, len(M))
    rest = exact.T @ exact
    rest[np.ix_(soft, soft)] *= np.kron(np.eye(int(soft.sum()) // 3), np.ones((3, 3)))
    elastic = dense.on_free(dense.elastic)
    elastic[np.ix_(soft, soft)] *= np.kron(np.eye(int(soft.sum()) // 3), np.ones((3, 3)))
    least = np.linalg.eigvalsh(M - rest - elastic - rows.T @ rows).min()
    assert least > -1e-9 * np.linalg.norm(M, 2), f"the least eigenvalue is {least:.3g}"


@pytest.mark.parametrize("affine", [(True,), (True, True)])
def test_the_rest_inverse_has_affine_bodies_with_their_contacts(affine: tuple[bool, ...]) -> None:
    """M⁻¹ H is 1 but for the pad's deformation, and symmetric where contacts are 10⁴ times as stiff as a light body's inertia."""
    dense = Dense(after(blocks_on_pad(affine, friction=0.3), 3), RestInverse)
    assert np.abs(dense.q[:, dense.affine]).max() > 0 and np.abs(dense.q[:, ~dense.affine]).max() > 0
    L = np.linalg.cholesky(dense.H)
    product = L.T @ dense.inverse @ L
    assert np.abs(product - product.T).max() < 1e-3
    values = np.linalg.eigvalsh(0.5 * (product + product.T))
    assert values.min() > 0.9 and values.max() < 1.1, f"eigenvalues {values.min():.4f} to {values.max():.4f}"


def test_affine_bodies_alone_are_solved_in_one_iteration() -> None:
    """M = H: whatever touches what, a Newton iteration takes one PCG iteration."""
    bodies: list[ipc.Body] = [
        ipc.AffineBody(f"b{k}", ipc.box_surface((2e-3, 2e-3, 2e-3)), pose=ipc.Pose((1e-4 * k, 0, 1.09e-3 + 2.09e-3 * k)))
        for k in range(4)
    ]
    settings = ipc.Settings(gravity=G, friction=0.3, d_hat=1e-4)
    world = ipc.World([*bodies, ipc.HalfSpace("floor")], settings, device="cpu")
    reports = [world.step() for _ in range(4)]
    assert all(r.converged.all() for r in reports) and reports[-1].pairs[0] > 4
    newton, linear = (sum(int(getattr(r, name)[0]) for r in reports) for name in ("newton", "linear"))
    assert linear <= 1.2 * newton + 4, f"{linear} PCG iterations in {newton} Newton iterations"


def test_same_steps_in_fewer_iterations() -> None:
    fine: dict = {"linear_tolerance": 1e-6, "forcing": 1e-6, "velocity_tolerance": 1e-6}
    ends = []
    for prepare in (with_blocks_only, lambda world: world):
        world = prepare(blocks_on_pad((True, False, True), **fine))
        linear = sum(int(world.step().linear[0]) for _ in range(4))
        ends.append((np.concatenate([world.positions(b.name)[0] for b in world.bodies]), linear))
    assert np.abs(ends[0][0] - ends[1][0]).max() < 1e-7
    assert ends[1][1] < ends[0][1] / 2, f"{ends[0][1]} PCG iterations with 3×3 blocks, {ends[1][1]} with affine bodies eliminated"


def test_the_rest_inverse_takes_the_same_steps_in_few_iterations() -> None:
    fine: dict = {"linear_tolerance": 1e-6, "velocity_tolerance": 1e-6, "friction": 0.3}
    ends = []
    for preconditioner in ("block_jacobi", "rest_inverse"):
        world = blocks_on_pad((True, True), preconditioner=preconditioner, **fine)
        reports = [world.step() for _ in range(4)]
        assert all(r.converged.all() for r in reports)
        height = np.concatenate([world.positions(b.name)[0][:, 2] for b in world.bodies])
        ends.append((height, *(sum(int(getattr(r, name)[0]) for r in reports) for name in ("newton", "linear"))))
    assert np.abs(ends[0][0] - ends[1][0]).max() < 1e-7
    assert ends[1][1] <= ends[0][1] + 2
    assert ends[1][2] < 6 * ends[1][1] and ends[1][2] < ends[0][2] / 4, (
        f"{ends[0][2]} PCG iterations, {ends[1][2]} with the rest inverse"
    )


def test_loose_solves_change_nothing_but_their_number() -> None:
    fine: dict = {"linear_tolerance": 1e-8, "velocity_tolerance": 1e-6}
    ends = []
    for forcing in (1e-8, 1e-2):
        world = blocks_on_pad((True, True), forcing=forcing, **fine)
        reports = [world.step() for _ in range(4)]
        assert all(r.converged.all() for r in reports)
        height, force = (
            world.positions("b1")[0, :, 2],
            world.contact_forces("b0")[0].sum(axis=0)[2],
        )  # sideways nothing holds them
        ends.append((height, force, sum(int(r.linear[0]) for r in reports)))
    assert np.abs(ends[0][0] - ends[1][0]).max() < 1e-7
    assert abs(ends[0][1] - ends[1][1]) < 1e-3 * abs(ends[0][1])
    assert ends[1][2] < 0.8 * ends[0][2], f"{ends[0][2]} PCG iterations, {ends[1][2]} with loose solves"


@pytest.mark.parametrize("forcing", [0.0, 1e-2])
def test_batch_is_single(forcing: float) -> None:
    """With loose solves too, where each environment decides by itself when its step may be the last."""
    fine: dict = {"forcing": forcing, "linear_tolerance": 1e-6, "velocity_tolerance": 1e-6}
    batch, alone = blocks_on_pad((True, False), num_envs=3, **fine), blocks_on_pad((True, False), **fine)
    batch.set_velocity("b0", np.array([[0, 0, -0.1], [0.02, 0, 0], [0, 0, 0]]))
    alone.set_velocity("b0", (0.02, 0, 0))
    for _ in range(3):
        batch.step()
        alone.step()
    for name in ("pad", "b0", "b1"):
        np.testing.assert_array_equal(batch.positions(name)[1], alone.positions(name)[0])


def test_general_conjugate_gradients_are_those_of_one_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    ends = []
    for general in (False, True):
        if general:
            monkeypatch.setattr(pcg, "BlockJacobi", type("Other", (), {}))  # so that solve() takes the general loop
        world = blocks_on_pad((True, False))
        ends.append(([int(world.step().linear[0]) for _ in range(2)], world.positions("pad")))
    assert np.abs(np.subtract(ends[0][0], ends[1][0])).max() <= 2
    assert np.abs(ends[0][1] - ends[1][1]).max() < 1e-11


def test_stiffness_follows_from_the_bodies_and_the_step() -> None:
    def kappa(*bodies: ipc.Body, dt: float = 0.01) -> float:
        return ipc.World(list(bodies), ipc.Settings(dt=dt), device="cpu").kappa

    def cube(size: float, drive: float = 0.0, stiffness: float = 1e12) -> ipc.AffineBody:
        return ipc.AffineBody("cube", ipc.box_surface((size, size, size)), ipc.Stiff(stiffness, 2000.0), drive=drive)

    assert kappa(cube(0.01)) == RIGID_STIFFNESS
    assert kappa(cube(2.0)) == pytest.approx(2000 * 4 / 1e-4)
    assert kappa(cube(2.0, drive=9.0)) == pytest.approx(10 * 2000 * 4 / 1e-4)
    assert kappa(cube(2.0), dt=0.1) == pytest.approx(2000 * 4 / 1e-2)
    assert kappa(cube(2.0, stiffness=1e7)) == 1e7
    soft = bonded_pad(small_pad(), material=ipc.Material(4e5, 0.45))
    far = ipc.AffineBody("far", ipc.box_surface((0.01, 0.01, 0.01)), pose=ipc.Pose((0, 0, 1.0)))
    assert kappa(soft, far) == 4e5
    world = ipc.World([cube(2.0)], ipc.Settings(kappa=7.0), device="cpu")
    assert world.kappa == 7.0 and barrier_stiffness(world.layout, 0.01) == pytest.approx(8e7)


def test_force_of_a_weight_does_not_depend_on_the_stiffness() -> None:
    weight = 1000.0 * 8e-9 * 9.81
    for kappa in (1e4, 1e5, 1e7):
        world = after(blocks_on_pad((True,), kappa=kappa, dt=1.0, velocity_tolerance=1e-10), 5)
        force = world.contact_forces("b0")[0].sum(axis=0)[2]
        assert force == pytest.approx(weight, rel=5e-3), f"{force:.6g} N at κ = {kappa:g} Pa"


def test_a_press_does_not_depend_on_the_one_before() -> None:
    """An affine ball pressed hard, lifted and pressed lightly gives what a fresh one gives.

    Beside the middle: right above a vertex it would lie on a ridge, from which rounding takes it either way.
    """

    def pressed(heights: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
        ball = ipc.AffineBody("ball", ipc.icosphere(4e-3, 2), pose=ipc.Pose((1.3e-4, 0.7e-4, 4.2e-3)), drive=1e3)
        settings = ipc.Settings(d_hat=1e-4, velocity_tolerance=1e-6, linear_tolerance=1e-6)
        world = ipc.World([bonded_pad(small_pad()), ball], settings, device="cpu")
        for height in heights:
            world.set_target("ball", (1.3e-4, 0.7e-4, height))
            assert world.step().converged.all()
        return world.positions("pad")[0], world.contact_forces("ball")[0].sum(axis=0)

    light = (4.0e-3, 3.9e-3, *(3.9e-3,) * 20)
    once, force = pressed(light)
    again, force_again = pressed((4.0e-3, 3.8e-3, 3.6e-3, 3.5e-3, 3.8e-3, 4.3e-3, *(4.3e-3,) * 20, *light))
    assert np.abs(once).max() > 0 and force[2] > 1e-4
    assert np.abs(once - again).max() < 1e-7
    assert np.abs(force - force_again).max() < 1e-3 * force[2]


@pytest.mark.slow
def test_wedge_goes_out_of_its_crack_without_a_step_that_does_not_converge() -> None:
    worst: Worst = CASES["wedge_out_of_crack"](Setup())
    assert worst.passed() and worst.unconverged == 0
    assert worst.newton < 1300, f"{worst.newton} Newton iterations; at 1e5 Pa there were 5,795"


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")
@pytest.mark.parametrize("preconditioner", ["block_jacobi", "rest_inverse"])
@pytest.mark.parametrize("graph", [True, False])
def test_cuda_takes_the_same_steps(graph: bool, preconditioner: Literal["block_jacobi", "rest_inverse"]) -> None:
    """A batch of mixed worlds, as one recorded graph and launch by launch."""
    bodies = blocks_on_pad((True, False, True)).bodies
    options: dict = {"gravity": G, "friction": 0.3, "d_hat": 1e-4, "linear_tolerance": 1e-6, "velocity_tolerance": 1e-6}
    ends = []
    for device in ("cpu", "cuda"):
        settings = ipc.Settings(**options, graph=graph, preconditioner=preconditioner)
        world = ipc.World(list(bodies), settings, num_envs=4, device=device)
        reports = [world.step() for _ in range(4)]
        assert all(r.converged.all() for r in reports)
        ends.append(
            (np.concatenate([world.positions(b.name) for b in bodies], axis=1), sum(int(r.linear.max()) for r in reports))
        )
    assert np.abs(ends[0][0] - ends[1][0]).max() < 1e-7
    assert ends[1][1] < 1.3 * ends[0][1] + 20
