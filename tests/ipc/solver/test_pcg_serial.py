"""Conjugate gradients by one thread, as a CPU takes them in held worlds: against dense solutions, and when they end."""

# pyright: reportInvalidTypeForm=false, reportCallIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

import ipc
from ipc.arrays import FloatArray, MatArray2d
from ipc.solver.affine_elimination import Elimination
from ipc.solver.block_jacobi import BlockJacobi
from ipc.solver.lines import Lines
from ipc.solver.pcg_serial import Vectors, make_vectors, precondition
from tests.ipc.conftest import bonded_pad, small_pad
from tests.ipc.solver.test_rows import half_product


@wp.kernel
def precondition_once(lines: Lines, inverse: MatArray2d, affine: Elimination, w: Vectors, total: FloatArray):
    env = wp.tid()
    total[env] = precondition(lines, inverse, affine, env, w, w.p)


class Pressed:
    """The matrix of a held world in contact, with friction: a tool in a pad of volume blocks, and its preconditioner."""

    def __init__(self, tool: str) -> None:
        cells = (6, 6, 2)
        pad = bonded_pad(small_pad(cells), material=ipc.Material(1e5, 0.47), volume_blocks=ipc.grid_blocks(cells))
        start = np.array([1e-4, 2e-4, 1.2e-3 if tool == "affine box" else 4.12e-3])
        body: ipc.Body = ipc.KinematicBody("tool", ipc.icosphere(4e-3, 2), ipc.Pose(tuple(start)))
        if tool == "affine box":
            body = ipc.AffineBody("tool", ipc.box_surface((2e-3, 2e-3, 2e-3)), pose=ipc.Pose(tuple(start)), drive=1e4)
        settings = ipc.Settings(d_hat=1e-4, friction=0.5, preconditioner="block_jacobi")
        world = ipc.World([pad, body], settings, device="cpu")
        for k in range(1, 5):
            world.set_target("tool", start + k / 4 * np.array([1e-4, 0.0, -0.5e-3]))
            assert world.step().converged[0]
        assert world.wrench("tool").force[0, 2] > 0.05
        self.newton, self.pot, self.layout = world._newton, world._newton.potential, world.layout
        self.pot.assemble(self.pot.everyone)
        self.pot.fill_matrix(self.pot.everyone)
        self.newton._update_preconditioner(self.pot.everyone)
        chosen = self.newton.preconditioner
        assert (
            isinstance(chosen, BlockJacobi) and chosen.lines is not None and (chosen.affine is not None) == (tool == "affine box")
        )
        self.preconditioner = chosen
        self.free = np.repeat(self.layout.node_free != 0, 3)
        self.H = np.array([half_product(self.pot, row)[0] for row in np.eye(len(self.free))[self.free]])[:, self.free]

    def on_nodes(self, values: np.ndarray) -> wp.array:
        """Values of the unknowns on all nodes (1, N), 0 elsewhere."""
        full = np.zeros(len(self.free))
        full[self.free] = values
        return wp.array(full.reshape(1, -1, 3), dtype=wp.vec3d, device="cpu")

    def norms(self, r: np.ndarray) -> np.ndarray:
        """‖r‖ and √(r·M⁻¹ r)."""
        return np.array([np.linalg.norm(r), np.sqrt(self.preconditioned(r)[1])])

    def solve(self, r: np.ndarray, tolerance: float, most: int = 10_000) -> tuple[np.ndarray, np.ndarray, int]:
        """Solution and residual of the unknowns, and iterations."""
        residual = self.on_nodes(r)
        x, pot = wp.zeros_like(residual), self.pot
        arguments: list[Any] = [pot.system, pot.collision.contacts, self.preconditioner, residual, x, tolerance, most]
        self.newton.pcg.solve(*arguments, pot.everyone)
        assert not self.newton.pcg.scalars.negative.numpy().any()
        solution, rest = (a.numpy().ravel()[self.free] for a in (x, residual))
        return solution, rest, int(self.newton.pcg.scalars.iterations.numpy()[0])

    def preconditioned(self, r: np.ndarray) -> tuple[np.ndarray, float]:
        """M⁻¹ r of the unknowns, and r·M⁻¹ r."""
        full = self.on_nodes(r).numpy()
        w = make_vectors(1, full.shape[1], wp.get_device("cpu"))
        w.r.assign(np.pad(full, ((0, 0), (0, 0), (0, 1))))
        total, m = wp.zeros(1, dtype=wp.float64, device="cpu"), self.preconditioner
        wp.launch(precondition_once, dim=1, inputs=[m.lines, m.inverse, m.elimination, w, total], device="cpu")
        return w.p.numpy()[0, :, :3].ravel()[self.free], float(total.numpy()[0])


@pytest.fixture(scope="module", params=["ball", "affine box"])
def pressed(request: pytest.FixtureRequest) -> Pressed:
    return Pressed(request.param)


def test_solutions_are_those_of_the_dense_matrix(pressed: Pressed, rng: np.random.Generator) -> None:
    """δ after many iterations and after few, with the residual that belongs to it; a second solve starts where the first ended."""
    H, size = pressed.H, len(pressed.H)
    np.testing.assert_allclose(H, H.T, rtol=0, atol=1e-12 * np.abs(H).max())
    assert np.linalg.eigvalsh(H).min() > 0
    r = rng.normal(size=size)
    expected = np.linalg.solve(H, r)
    x, rest, iterations = pressed.solve(r, 1e-12)
    assert iterations < size
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    x, rest, iterations = pressed.solve(r, 1e-12, most=5)
    assert iterations == 5 and np.linalg.norm(rest) > 0.01 * np.linalg.norm(r)
    np.testing.assert_allclose(rest, r - H @ x, rtol=0, atol=1e-12 * np.abs(r).max())
    more, _, _ = pressed.solve(rest, 1e-12)
    np.testing.assert_allclose(x + more, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def test_the_preconditioner_is_that_of_other_solvers_but_for_lines(pressed: Pressed, rng: np.random.Generator) -> None:
    """Symmetric and positive; beside affine bodies, where each node is a line, it is block-Jacobi with these bodies eliminated."""
    a, b = rng.normal(size=(2, len(pressed.H)))
    with pytest.raises(AssertionError, match="pivots of their factors"):
        pressed.preconditioner.apply(pressed.on_nodes(a), pressed.pot.everyone, pressed.on_nodes(b))
    (za, total), (zb, _) = pressed.preconditioned(a), pressed.preconditioned(b)
    assert total == pytest.approx(a @ za, rel=1e-12) and total > 0
    assert a @ zb == pytest.approx(b @ za, rel=1e-9)
    if pressed.preconditioner.affine is None:
        return
    pot = pressed.pot
    general = BlockJacobi(pressed.layout, 1, pot.collision.lanes, pot.device)
    contacts = pot.collision.contacts
    general.update(pot.system, contacts, contacts.row.shape[1], pot.everyone)
    r, z = pressed.on_nodes(a), wp.zeros(pot.y.shape, dtype=wp.vec3d, device="cpu")
    general.apply(r, pot.everyone, z)
    expected = z.numpy().ravel()[pressed.free]
    np.testing.assert_allclose(za, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("decides", [0, 1], ids=["plain norm", "preconditioned norm"])
def test_a_solve_ends_when_both_norms_are_small(pressed: Pressed, decides: int, rng: np.random.Generator) -> None:
    """One iteration earlier one was not, and each is the last to be at some tolerance: the plain one of random forces, the other of the
    forces of random motions, which are stiff ones.
    """
    alone = 0
    for tolerance in (0.3, 0.1, 0.03, 0.01):
        r = rng.normal(size=len(pressed.H))
        if decides:
            r = pressed.H @ r
        _, _, needed = pressed.solve(r, tolerance)
        before, after = (pressed.norms(pressed.solve(r, tolerance, most)[1]) / pressed.norms(r) for most in (needed - 1, needed))
        assert after.max() <= tolerance < before.max()
        alone += before[decides] > tolerance >= before[1 - decides]
    assert alone >= 2
