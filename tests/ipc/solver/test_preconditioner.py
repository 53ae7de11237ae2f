"""The rest inverse: is it what it says, and does it change nothing but the number of iterations?"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import warp as wp

import ipc
from ipc.blocks import THREADS
from ipc.bodies import Layout, build_layout, rotation_matrix
from ipc.contact.contacts import Contacts, mat34d
from ipc.solver.block_jacobi import BlockJacobi
from ipc.solver.frames import VertexMap
from ipc.solver.linear import SystemView, turn_rows
from ipc.solver.preconditioners import pays
from ipc.solver.preconditioners.rest_inverse import RestInverse, place_running
from ipc.solver.preconditioners.rest_stiffness import rest_blocks
from ipc.solver.preconditioners.substructure import choose_partition, entries, partition
from tests.ipc.conftest import bonded_pad, small_pad

LANES = 8
"""Fewer than there are contact rows."""


class Problem:
    """Bonded pads at rest with random contact rows, the same in every environment, and H as a dense matrix."""

    def __init__(self, layout: Layout, batch: int, contacts: int, rng: np.random.Generator, device: str) -> None:
        self.layout, self.batch, self.device = layout, batch, wp.get_device(device)
        self.settings = ipc.Settings(dt=0.01)
        count = len(layout.node_rest)
        blocks = rest_blocks(layout, self.settings)
        turns = rng.normal(size=(len(layout.names), 4))
        R = rotation_matrix(turns / np.linalg.norm(turns, axis=1, keepdims=True))
        self.free = np.flatnonzero(layout.node_free)
        H = np.zeros((count, 3, count, 3))
        H[np.repeat(np.arange(count), np.diff(layout.row_start)), :, layout.col, :] = blocks
        soft = (layout.vert_count == 1) & (layout.node_free[layout.vert_nodes[:, 0]] != 0)
        touched = rng.choice(np.flatnonzero(soft), contacts, replace=False)
        verts, rows = np.full((4 * contacts, 4), -1), np.zeros((4 * contacts, 3, 4))
        for r in range(4 * contacts):
            verts[r, :2] = touched[r // 4], rng.choice(touched[touched != touched[r // 4]])
            rows[r, :, :2] = 10 ** rng.uniform(0, 2.5) * rng.normal(size=(3, 2))
            q = np.zeros((count, 3))
            for k in range(2):
                q[layout.vert_nodes[verts[r, k], 0]] += R[layout.vert_body[verts[r, k]]].T @ rows[r, :, k]
            H += q[:, :, None, None] * q
        self.H = H[self.free][:, :, self.free].reshape(3 * len(self.free), -1)
        self.R, self.blocks, self.verts, self.rows = R, blocks, verts, rows
        self.system, self.contacts = SystemView(), Contacts()
        s = self.system
        rows_of = np.repeat(np.arange(count), np.diff(layout.row_start))
        for name, values in (
            *(("row_base", layout.row_start[:-1]), ("row_length", np.diff(layout.row_start)), ("col", layout.col)),
            *(("diagonal", np.flatnonzero(rows_of == layout.col)), ("free", layout.node_free)),
            *(
                (name, getattr(layout, name))
                for name in ("block_pair_start", "pair_block", "pair_node", "node_pair_start", "node_pair")
            ),
        ):
            setattr(s, name, self._array(values, wp.int32))
        s.stride = 1
        s.verts = VertexMap()
        for name, values in (("body", layout.vert_body), ("count", layout.vert_count), ("nodes", layout.vert_nodes)):
            setattr(s.verts, name, self._array(values, wp.int32))
        s.verts.weight = self._array(layout.vert_weight, wp.float64)
        s.blocks, s.R = self._array(self._repeat(blocks), wp.mat33d), self._array(self._repeat(R), wp.mat33d)
        self.contacts.row_verts = self._array(self._repeat(verts), wp.vec4i)
        self.contacts.row = self._array(self._repeat(rows), mat34d)
        self.contacts.row_count = self._array(np.full(batch, len(rows)), wp.int32)
        self.contacts.concave = self._array(np.zeros((batch, len(rows))), wp.int32)
        s.project = self.mask(0)
        shape = batch, len(rows)
        for name, dtype in (("row_nodes", wp.vec4i), ("row_body", wp.int32)):
            setattr(self.contacts, name, wp.zeros(shape, dtype=dtype, device=self.device))
        for name in ("node_row", "body_row", "scaled_row"):
            setattr(self.contacts, name, wp.zeros(shape, dtype=mat34d, device=self.device))
        wp.launch(turn_rows, dim=(batch, LANES), inputs=[s, self.contacts, self.mask(), LANES], device=self.device)

    def _array(self, values: np.ndarray, dtype: type) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

    def _repeat(self, values: np.ndarray) -> np.ndarray:
        return np.broadcast_to(values, (self.batch, *values.shape))

    def mask(self, values: np.ndarray | int = 1) -> wp.array:
        return self._array(np.broadcast_to(values, self.batch), wp.int32)

    def updated(self, **options: int) -> RestInverse:
        preconditioner = RestInverse(self.layout, self.settings, self.batch, LANES, self.device, **options)
        preconditioner.update(self.system, self.contacts, self.contacts.row.shape[1], self.mask())
        return preconditioner

    def apply(self, preconditioner: RestInverse, r: np.ndarray) -> np.ndarray:
        """M⁻¹ r for r of shape (B, 3n) on the free nodes."""
        full = np.zeros((self.batch, len(self.layout.node_rest), 3))
        full[:, self.free] = r.reshape(self.batch, -1, 3)
        z = self._array(np.zeros_like(full), wp.vec3d)
        preconditioner.apply(self._array(full, wp.vec3d), self.mask(), z)
        assert not z.numpy()[:, self.layout.node_free == 0].any()
        return z.numpy()[:, self.free].reshape(self.batch, -1)

    def inverse(self, preconditioner: RestInverse) -> np.ndarray:
        """M⁻¹ as a matrix: environment i gets the i-th unit vector."""
        assert self.batch == len(self.H)
        return self.apply(preconditioner, np.eye(self.batch)).T


def two_pads() -> Layout:
    """Two different pads that face each other."""
    far = ipc.Pose((0, 0, 5e-3), (0.0, 1.0, 0.0, 0.0))
    second = bonded_pad(small_pad((2, 3, 1)), name="other", pose=far, material=ipc.Material(2e5, 0.4, model="stable_log"))
    return build_layout([bonded_pad(small_pad((3, 2, 2))), second], 0.5, {}, [])


def spectrum(inverse: np.ndarray, H: np.ndarray) -> np.ndarray:
    """Eigenvalues of M⁻¹ H."""
    L = np.linalg.cholesky(H)
    return np.linalg.eigvalsh(L.T @ (0.5 * (inverse + inverse.T)) @ L)


@pytest.fixture
def problem(rng: np.random.Generator) -> Problem:
    layout = two_pads()
    return Problem(layout, 3 * int(layout.node_free.sum()), 8, rng, "cpu")


@pytest.fixture(scope="module")
def thick() -> Problem:
    """A pad with 24 nodes inside."""
    layout = build_layout([bonded_pad(small_pad((5, 4, 3)))], 0.5, {}, [])
    return Problem(layout, 3 * int(layout.node_free.sum()), 8, np.random.default_rng(7), "cpu")


class Recorder(BlockJacobi):
    """Keeps the first matrix it is given."""

    blocks: np.ndarray | None = None

    def update(self, system: Any, contacts: Any, rows: int, active: wp.array) -> None:
        if self.blocks is None:
            self.blocks = system.blocks.numpy()[0].copy()
        super().update(system, contacts, rows, active)


@pytest.mark.parametrize("model", ["stable", "stable_log"])
def test_rest_blocks_are_those_of_the_solver(model: str) -> None:
    pad = bonded_pad(small_pad((3, 3, 2)), material=ipc.Material(1e5, 0.45, 1000.0, model=model, mass_damping=3.0))  # pyright: ignore[reportArgumentType]
    # With this preconditioner no block is left out.
    world = ipc.World([pad], ipc.Settings(gravity=(0, 0, -1.0), preconditioner="rest_inverse"), device="cpu")
    recorder = Recorder(world.layout, 1, 1, world.device)
    world._newton.preconditioner = recorder
    world.step()
    assert recorder.blocks is not None
    blocks = rest_blocks(world.layout, world.settings)
    np.testing.assert_allclose(blocks, recorder.blocks, rtol=0, atol=1e-12 * np.abs(blocks).max())


def test_symmetric_positive_definite(problem: Problem) -> None:
    inverse = problem.inverse(problem.updated())
    np.testing.assert_allclose(inverse, inverse.T, rtol=0, atol=1e-6 * np.abs(inverse).max())
    values = np.linalg.eigvalsh(0.5 * (inverse + inverse.T))
    assert values.min() > 0, f"the least eigenvalue is {values.min():.3g}"


def test_exact_at_rest(problem: Problem) -> None:
    """At rest M = H, to single precision."""
    values = spectrum(problem.inverse(problem.updated()), problem.H)
    assert values.min() > 1 - 1e-3 and values.max() < 1 + 1e-3, f"eigenvalues {values.min():.5f} to {values.max():.5f}"
    alone = RestInverse(problem.layout, problem.settings, problem.batch, LANES, problem.device)
    assert spectrum(problem.inverse(alone), problem.H).max() > 10, "the contacts were to matter"


@pytest.mark.parametrize("patches", [0, 1, 2, 4])
def test_condensation_changes_nothing(thick: Problem, patches: int) -> None:
    preconditioner = thick.updated(patches=patches)
    assert preconditioner.patched == (patches > 0)
    inverse = thick.inverse(preconditioner)
    np.testing.assert_allclose(inverse, inverse.T, rtol=0, atol=1e-6 * np.abs(inverse).max())
    values = spectrum(inverse, thick.H)
    assert values.min() > 1 - 1e-3 and values.max() < 1 + 1e-3, f"eigenvalues {values.min():.5f} to {values.max():.5f}"


def test_patches_do_not_see_each_other(thick: Problem) -> None:
    layout = thick.layout
    nodes = np.flatnonzero(layout.node_free)
    inside = np.setdiff1d(nodes, layout.vert_nodes[layout.vert_count == 1, 0])
    rows = np.repeat(np.arange(len(layout.node_rest)), np.diff(layout.row_start))
    before = 0
    for parts in (1, 2, 4):
        label = partition(layout, inside, parts)
        assert set(np.unique(label[label >= 0])) <= set(range(parts)) and (label >= 0).any()
        assert (label[np.setdiff1d(np.arange(len(label)), inside)] == -1).all()
        one, other = label[rows], label[layout.col]
        assert (one[(one >= 0) & (other >= 0)] == other[(one >= 0) & (other >= 0)]).all()
        interface = int((label[nodes] < 0).sum())
        assert interface > before, "every cut takes nodes from the patches"
        before = interface


def test_partition_with_the_fewest_entries() -> None:
    """A small pad stays whole; a larger one is cut, and holds less than half of what the whole inverse would."""
    small = build_layout([bonded_pad(small_pad())], 0.5, {}, [])
    assert (choose_partition(small, 0)[1] == -1).all()
    large = build_layout([bonded_pad(small_pad((20, 20, 4)))], 0.5, {}, [])
    nodes, label = choose_partition(large, 0)
    assert label.max() >= 3
    assert 2 * entries(large, nodes, label) < (3 * len(nodes)) ** 2
    assert entries(large, nodes, np.full_like(label, -1)) == (3 * len(nodes)) ** 2


def test_more_contacts_than_room(problem: Problem) -> None:
    """Environments that do not fit have block-Jacobi; the others keep the rest inverse."""
    rows = np.where(np.arange(problem.batch) % 2, len(problem.rows), 0)
    problem.contacts.row_count.assign(rows.astype(np.int32))
    inverse = problem.inverse(problem.updated(max_contacts=3))
    n = len(problem.H) // 3
    diagonal = problem.H.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
    expected = np.zeros((n, 3, n, 3))
    expected[np.arange(n), :, np.arange(n)] = np.linalg.inv(diagonal)
    full, fit = rows > 0, rows == 0
    np.testing.assert_allclose(inverse[:, full], expected.reshape(3 * n, -1)[:, full], rtol=0, atol=1e-9 * np.abs(expected).max())
    alone = RestInverse(problem.layout, problem.settings, problem.batch, LANES, problem.device)
    np.testing.assert_array_equal(inverse[:, fit], problem.inverse(alone)[:, fit])
    assert np.abs(inverse[:, fit] - expected.reshape(3 * n, -1)[:, fit]).max() > 0.1 * np.abs(inverse).max()


def test_masks(problem: Problem) -> None:
    preconditioner = problem.updated()
    before = problem.inverse(preconditioner)
    every_other = np.arange(problem.batch) % 2
    none = problem.mask(np.zeros(problem.batch, np.int32))
    problem.contacts.row_count.zero_()
    preconditioner.update(problem.system, problem.contacts, 1, none)
    np.testing.assert_array_equal(problem.inverse(preconditioner), before)
    preconditioner.update(problem.system, problem.contacts, 1, problem.mask(every_other))
    after = problem.inverse(preconditioner)
    np.testing.assert_array_equal(after[:, every_other == 0], before[:, every_other == 0])
    assert np.abs(after - before)[:, every_other == 1].max() > 1e-3 * np.abs(before).max()
    z = problem._array(np.ones((problem.batch, len(problem.layout.node_rest), 3)), wp.vec3d)
    preconditioner.apply(z, none, z)
    assert (z.numpy() == 1).all()


def test_no_contacts_is_the_rest_inverse(rng: np.random.Generator) -> None:
    problem = Problem(two_pads(), 2, 2, rng, "cpu")
    problem.contacts.row_count.zero_()
    r = rng.normal(size=(2, len(problem.H)))
    count = len(problem.layout.node_rest)
    H = np.zeros((count, 3, count, 3))
    H[np.repeat(np.arange(count), np.diff(problem.layout.row_start)), :, problem.layout.col, :] = problem.blocks
    expected = np.linalg.solve(H[problem.free][:, :, problem.free].reshape(r.shape[1], -1), r.T).T
    np.testing.assert_allclose(problem.apply(problem.updated(), r), expected, rtol=0, atol=1e-5 * np.abs(expected).max())


def test_rows_that_are_not_finite_leave_the_rest_inverse(rng: np.random.Generator) -> None:
    """Of the contacts that were there before nothing stays: it is as without any."""
    problem = Problem(two_pads(), 1, 6, rng, "cpu")
    preconditioner, r = problem.updated(), rng.normal(size=(1, len(problem.H)))
    problem.apply(preconditioner, r)
    rows = problem.contacts.node_row.numpy()
    rows[0, 0] = 1e200
    problem.contacts.node_row.assign(rows)
    preconditioner.update(problem.system, problem.contacts, problem.contacts.row.shape[1], problem.mask())
    z = problem.apply(preconditioner, r)
    problem.contacts.row_count.fill_(0)
    np.testing.assert_array_equal(z, problem.apply(problem.updated(), r))


def press(preconditioner: str, steps: int = 4, max_contacts: int | None = None, **changes: object) -> tuple[np.ndarray, int, int]:
    """Positions after a press with a twist, and the Newton and PCG iterations it took."""
    ball = ipc.KinematicBody("ball", ipc.icosphere(4e-3, 2), ipc.Pose((1e-4, 2e-4, 4.12e-3)))
    options: dict = {
        "d_hat": 1e-4,
        "friction": 0.5,
        "velocity_tolerance": 1e-7,
        "linear_tolerance": 1e-6,
    } | changes
    settings = ipc.Settings(preconditioner=preconditioner, **options)  # pyright: ignore[reportArgumentType]
    world = ipc.World([bonded_pad(small_pad()), ball], settings, num_envs=2, device="cpu")
    if max_contacts is not None:
        world._newton.preconditioner = RestInverse(world.layout, settings, 2, 1, world.device, max_contacts=max_contacts)
    newton = linear = 0
    for k in range(1, steps + 1):
        angle = 0.05 * k
        depth = np.array([[0.4e-3], [0.7e-3]]) * k / steps
        world.set_target("pad", rotation=(np.cos(angle / 2), 0, 0, np.sin(angle / 2)))
        world.set_target("ball", np.array([1e-4, 2e-4, 4.12e-3]) - depth * np.array([0, 0, 1]))
        report = world.step()
        assert report.converged.all() and not report.failed.any()
        newton, linear = newton + int(report.newton.max()), linear + int(report.linear.max())
    return world.positions("pad"), newton, linear


def test_same_step_in_fewer_iterations() -> None:
    one, newton, linear = press("block_jacobi")
    other, newton2, linear2 = press("rest_inverse")
    assert np.abs(one - other).max() < 1e-8
    assert newton2 <= newton + 3
    assert linear2 < linear / 3, f"{linear} PCG iterations with block-Jacobi, {linear2} with the rest inverse"


def test_a_press_with_too_little_room_converges() -> None:
    one, _, linear = press("rest_inverse")
    other, _, linear2 = press("rest_inverse", max_contacts=4)
    assert np.abs(one - other).max() < 1e-8
    assert linear2 > linear


def test_other_bodies_have_block_jacobi() -> None:
    """A free cube, an affine block and a bonded pad in one world: each has its preconditioner, and the step is the same."""

    def drop(preconditioner: str) -> np.ndarray:
        line = np.linspace(-1e-3, 1e-3, 3)
        soft = ipc.SoftBody("soft", ipc.box_mesh(line, line, line), ipc.Material(1e5, 0.4), pose=ipc.Pose((-2e-3, 0, 1.05e-3)))
        block = ipc.AffineBody("block", ipc.box_surface((2e-3, 2e-3, 2e-3)), ipc.Stiff(), ipc.Pose((2e-3, 0, 1.05e-3)))
        options: dict = {"preconditioner": preconditioner, "d_hat": 1e-4, "velocity_tolerance": 1e-7, "linear_tolerance": 1e-6}
        settings = ipc.Settings(gravity=(0, 0, -9.81), friction=0.3, friction_relags=0, **options)
        world = ipc.World([bonded_pad(small_pad()), soft, block], settings, device="cpu")
        assert world.step().converged.all()
        return np.concatenate([world.positions(name)[0] for name in ("pad", "soft")])

    assert np.abs(drop("block_jacobi") - drop("rest_inverse")).max() < 1e-8


def test_bad_settings() -> None:
    with pytest.raises(ipc.IpcError, match="choose 'auto', 'block_jacobi' or 'rest_inverse'"):
        ipc.Settings(preconditioner="multigrid")  # pyright: ignore[reportArgumentType]
    free = ipc.SoftBody("free", small_pad((2, 2, 1)), ipc.Material(1e5, 0.4))
    with pytest.raises(ipc.IpcError, match="no body is bonded"):
        ipc.World([free], ipc.Settings(preconditioner="rest_inverse"), device="cpu")


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")
@pytest.mark.parametrize("patches", [0, 4])
@pytest.mark.parametrize("batch", [1, 3, 40])
def test_cuda_agrees_and_can_be_captured(batch: int, patches: int, rng: np.random.Generator) -> None:
    """Vectors, a few of them, and tiles; once launch by launch and once as a graph."""
    device = "cuda"
    layout = build_layout([bonded_pad(small_pad((5, 4, 3)))], 0.5, {}, []) if patches else two_pads()
    state = rng.bit_generator.state
    here = Problem(layout, batch, 8, rng, "cpu")
    rng.bit_generator.state = state
    there = Problem(layout, batch, 8, rng, device)
    r = rng.normal(size=(batch, len(here.H)))
    expected, preconditioner = here.apply(here.updated(patches=0), r), there.updated(patches=patches)
    np.testing.assert_allclose(there.apply(preconditioner, r), expected, rtol=0, atol=1e-4 * np.abs(expected).max())
    full = np.zeros((batch, len(here.layout.node_rest), 3))
    full[:, here.free] = r.reshape(batch, -1, 3)
    r_device, z, mask = there._array(full, wp.vec3d), there._array(np.zeros_like(full), wp.vec3d), there.mask()
    with wp.ScopedCapture(device=device) as capture:
        preconditioner.update(there.system, there.contacts, there.contacts.row.shape[1], mask)
        preconditioner.apply(r_device, mask, z)
    assert capture.graph is not None
    for _ in range(2):
        wp.capture_launch(capture.graph)
    np.testing.assert_allclose(z.numpy()[:, here.free].reshape(batch, -1), expected, rtol=0, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("cells", "poisson", "tolerance", "batch", "free", "cuda", "expected"),
    [
        ((6, 6, 2), 0.45, 1e-2, 1, False, True, False),
        ((16, 20, 3), 0.45, 1e-2, 1, False, True, True),
        ((16, 20, 3), 0.45, 1e-2, 1, True, True, False),
        ((26, 32, 5), 0.45, 1e-2, 1, False, True, False),
        ((26, 32, 5), 0.49, 1e-2, 1, False, True, True),
        ((6, 6, 2), 0.45, 1e-6, 1, True, True, True),
        ((6, 6, 2), 0.45, 1e-6, 64, False, True, False),
        ((26, 32, 5), 0.45, 1e-6, 64, True, True, True),
        ((16, 20, 3), 0.45, 1e-2, 1, False, False, False),
        ((16, 20, 3), 0.45, 1e-6, 1, False, False, False),
    ],
)
def test_auto_takes_the_rest_inverse_where_it_pays(
    cells: tuple[int, int, int], poisson: float, tolerance: float, batch: int, free: bool, cuda: bool, expected: bool
) -> None:
    bodies: list[ipc.Body] = [bonded_pad(small_pad(cells), material=ipc.Material(1e5, poisson))]
    bodies += [ipc.AffineBody("free", ipc.icosphere(1e-3, 0), pose=ipc.Pose((0, 0, 5e-3)))] if free else []
    layout = build_layout(bodies, 0.0, {}, [])
    device = cast(Any, SimpleNamespace(is_cuda=cuda))
    assert pays(layout, ipc.Settings(linear_tolerance=tolerance), batch, device) == expected


@pytest.mark.parametrize(
    "device",
    ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")])],
)
@pytest.mark.parametrize("batch", [1, 256, 257, 1000])
def test_running_environments_are_numbered_in_their_order(device: str, batch: int, rng: np.random.Generator) -> None:
    flags, threads = rng.integers(0, 2, batch), THREADS if device == "cuda" else 1
    running = wp.array(flags, dtype=wp.int32, device=device)
    place, total = (wp.zeros(n, dtype=wp.int32, device=device) for n in (batch, 1))
    wp.launch(place_running, threads, [running, threads], [place, total], device=device, block_dim=threads)
    np.testing.assert_array_equal(place.numpy(), np.where(flags, np.cumsum(flags) - flags, -1))
    assert total.numpy()[0] == flags.sum()
