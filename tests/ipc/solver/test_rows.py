"""Contact rows over the unknowns of soft nodes and of one or two affine bodies: products, and their part in the rest inverse."""

# pyright: reportInvalidTypeForm=false, reportCallIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

import ipc
from ipc.arrays import FloatArray, Vec4Array2d
from ipc.contact.contacts import Contacts
from ipc.reduce import BLOCK
from ipc.solver.halves import multiply_half
from ipc.solver.linear import SystemView, multiply_blocks, multiply_rows
from ipc.solver.potential import Potential
from ipc.solver.preconditioners.rest_inverse import RestInverse
from tests.ipc.conftest import bonded_pad, small_pad

DEVICES = [
    "cpu",
    pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="needs CUDA")]),
]


class Rows:
    """A pad at rest, two affine boxes far from it, and random contact rows between all; H as a dense matrix."""

    def __init__(self, count: int, rng: np.random.Generator, device: str, faces: int = 0) -> None:
        boxes: list[ipc.Body] = [
            ipc.AffineBody(f"box{k}", ipc.box_surface((2e-3, 2e-3, 2e-3)), pose=ipc.Pose((5e-3 * k, 0.0, 0.1))) for k in range(2)
        ]
        settings = ipc.Settings(dt=0.01, linear_tolerance=1e-6)
        self.world = world = ipc.World([bonded_pad(small_pad((7, 6, 1))), *boxes], settings, device=device)
        self.layout, self.pot = layout, pot = world.layout, world._newton.potential
        self.free = np.flatnonzero(layout.node_free)
        pot.set_frames(wp.zeros(1, dtype=wp.float64, device=device), pot.R, pot.t)
        pot.place_vertices(pot.y, pot.R, pot.t, pot.x)
        pot.aim_inertia(pot.R, pot.t)
        pot.assemble(pot.everyone)
        pot.fill_matrix(pot.everyone)
        soft = rng.permutation(np.flatnonzero((layout.vert_count == 1) & (layout.node_free[layout.vert_nodes[:, 0]] != 0)))[
            :count
        ]
        bonded = np.flatnonzero((layout.vert_count == 1) & (layout.node_free[layout.vert_nodes[:, 0]] == 0))
        one, other = (np.flatnonzero(layout.vert_body == body) for body in (1, 2))
        choose = rng.choice
        verts = [
            *([v, *choose(one, 3, False)] for v in soft),
            *([*choose(soft, 3, False), choose(other)] for _ in range(count)),
            *([*choose(one, 2, False), *choose(other, 2, False)] for _ in range(7)),
            *([choose(one), -1, -1, -1] for _ in range(5)),
            *([choose(bonded), choose(soft), *choose(one, 2, False)] for _ in range(5)),
            *([*choose(soft, 4, False)] for _ in range(5)),
        ]
        own = layout.faces[(layout.vert_body[layout.faces] == 0).all(axis=1)]
        verts += [[*face, -1] for face in np.repeat(choose(own, faces, False), 2, axis=0)]
        self.verts, n = np.array(verts), len(verts)
        rows = 10 ** rng.uniform(0, 2, (n, 1, 1)) * rng.normal(size=(n, 3, 4)) * (self.verts >= 0)[:, None]
        concave = (np.arange(n) >= n - faces).astype(int)
        self._put("row_verts", self.verts)
        self._put("row", rows)
        self._put("concave", concave)
        pot.collision.contacts.row_count.fill_(n)
        pot.turn_rows(pot.everyone)
        q, R = np.zeros((n, len(layout.node_rest), 3)), pot.R.numpy()[0]
        for r, k in zip(*np.nonzero(self.verts >= 0), strict=True):
            v = self.verts[r, k]
            for m in range(layout.vert_count[v]):
                node = layout.vert_nodes[v, m]
                if layout.node_free[node]:
                    q[r, node] += layout.vert_weight[v, m] * (R[layout.vert_body[v]].T @ rows[r, :, k])
        self.q = q.reshape(n, -1)

    def _put(self, name: str, values: np.ndarray) -> None:
        array = getattr(self.pot.collision.contacts, name)
        assert array.shape[1] >= len(values)
        now = array.numpy()
        now[0, : len(values)] = values
        array.assign(now)

    def product(self, p: np.ndarray) -> np.ndarray:
        """H p, blocks and rows, of all nodes."""
        return whole_product(self.pot, p)


def whole_product(pot: Potential, p: np.ndarray) -> np.ndarray:
    """H p of a matrix that has all its blocks, volumes apart, and its contact rows."""
    device, lanes = pot.device, pot.collision.lanes
    threads = BLOCK if device.is_cuda else 1
    x, out = (wp.array(a.reshape(1, -1, 3), dtype=wp.vec3d, device=device) for a in (p, np.zeros_like(p)))

    def launch(kernel: Any, chunks: int, inputs: list) -> None:
        partial = wp.zeros((1, chunks), dtype=wp.float64, device=device)
        wp.launch(kernel, dim=(1, chunks, threads), inputs=inputs, outputs=[out, partial], device=device, block_dim=BLOCK)

    launch(multiply_blocks, 1, [pot.system, x, pot.everyone, threads])
    launch(multiply_rows, -(-lanes // BLOCK), [pot.system, pot.collision.contacts, x, pot.everyone, lanes, threads])
    return out.numpy().ravel()


def half_product(pot: Potential, p: np.ndarray) -> tuple[np.ndarray, float]:
    """H p by the upper half, and p·H p."""
    padded = np.pad(p.reshape(1, -1, 3), ((0, 0), (0, 0), (0, 1)))
    x, out = (wp.array(a, dtype=wp.vec4d, device="cpu") for a in (padded, np.zeros_like(padded)))
    total = wp.zeros(1, dtype=wp.float64, device="cpu")
    wp.launch(multiply_by_half, dim=1, inputs=[pot.system, pot.collision.contacts, x, out, total], device="cpu")
    assert not out.numpy()[..., 3].any()
    return out.numpy()[..., :3].ravel(), float(total.numpy()[0])


@pytest.mark.parametrize("device", DEVICES)
def test_products_are_those_of_the_rows(device: str, rng: np.random.Generator) -> None:
    rows = Rows(12, rng, device)
    p = rng.normal(size=rows.q.shape[1]) * np.repeat(rows.layout.node_free, 3)
    with_rows = rows.product(p)
    rows.pot.collision.contacts.row_count.zero_()
    result, expected = with_rows - rows.product(p), rows.q.T @ (rows.q @ p)
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@wp.kernel
def multiply_by_half(system: SystemView, contacts: Contacts, p: Vec4Array2d, out: Vec4Array2d, total: FloatArray):
    env = wp.tid()
    total[env] = multiply_half(system, contacts, env, p, out)


@pytest.mark.parametrize("project", [0, 1])
def test_products_with_the_upper_half_are_those_with_blocks_and_rows(project: int, rng: np.random.Generator) -> None:
    """Rows at the nodes of one face are added to blocks, those of affine bodies and of distant nodes are not."""
    rows = Rows(12, rng, "cpu", faces=6)
    pot, contacts = rows.pot, rows.pot.collision.contacts
    pot.use_halves()
    pot.project.fill_(project)
    p = rng.normal(size=rows.q.shape[1]) * np.repeat(rows.layout.node_free, 3)
    expected = rows.product(p)
    pot.fold_rows(pot.everyone)
    is_open = np.zeros(len(rows.verts), bool)
    is_open[contacts.open_row.numpy()[0, : contacts.open_count.numpy()[0]]] = True
    assert is_open[:-12].sum() > 20 and not is_open[-12:].any()
    result, total = half_product(pot, p)
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert total == pytest.approx(p @ expected, rel=1e-12)


def test_products_do_without_the_blocks_that_are_left_out(rng: np.random.Generator) -> None:
    """A pad alone, whose blocks below the diagonal and of bonded nodes nobody reads; stretched, against the whole matrix."""
    products, p = [], None
    for preconditioner in ("block_jacobi", "rest_inverse"):
        settings = ipc.Settings(dt=0.01, linear_tolerance=1e-6, preconditioner=preconditioner)
        world = ipc.World([bonded_pad(small_pad((7, 6, 1)))], settings, device="cpu")
        layout, pot = world.layout, world._newton.potential
        free = layout.node_free[:, None] * np.ones(3)
        if p is None:
            p, stretch = rng.normal(size=free.shape) * free, 2e-5 * rng.normal(size=free.shape) * free
        pot.set_frames(wp.zeros(1, dtype=wp.float64, device="cpu"), pot.R, pot.t)
        pot.y.assign(pot.y.numpy() + stretch)
        pot.place_vertices(pot.y, pot.R, pot.t, pot.x)
        pot.aim_inertia(pot.R, pot.t)
        pot.assemble(pot.everyone)
        pot.fill_matrix(pot.everyone)
        pot.fold_rows(pot.everyone)
        assert pot.mirrors == (preconditioner == "rest_inverse")
        products.append(whole_product(pot, p) if pot.mirrors else half_product(pot, p)[0])
    whole = products[1]
    np.testing.assert_allclose(products[0], whole, rtol=0, atol=1e-12 * np.abs(whole).max())
    assert np.abs(whole.reshape(-1, 3)[layout.node_free != 0]).min() > 0


@pytest.mark.parametrize("count", [11, 40])
@pytest.mark.parametrize("device", DEVICES)
def test_the_rest_inverse_is_exact_with_affine_bodies(device: str, count: int, rng: np.random.Generator) -> None:
    """M H p = p, to single precision, with few and with many contact nodes, odd numbers among them."""
    rows = Rows(count, rng, device)
    pot, contacts = rows.pot, rows.pot.collision.contacts
    preconditioner = RestInverse(rows.layout, rows.world.settings, 1, pot.collision.lanes, rows.world.device)
    preconditioner.update(pot.system, contacts, contacts.row.shape[1], pot.everyone)
    small = preconditioner.low_rank.small
    assert small.count.numpy()[0] == small.pads.numpy()[0] + 8 >= count + 8
    for _ in range(3):
        p = rng.normal(size=rows.q.shape[1]) * np.repeat(rows.layout.node_free, 3)
        r = wp.array(rows.product(p).reshape(1, -1, 3), dtype=wp.vec3d, device=device)
        z = wp.zeros_like(r)
        preconditioner.apply(r, pot.everyone, z)
        size = np.abs(p).max()
        np.testing.assert_allclose(z.numpy().ravel(), p, rtol=0, atol=5e-3 * size)
