"""Blocks of nodes on lines: their factors against dense inverses."""

# pyright: reportInvalidTypeForm=false, reportCallIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import ipc
from ipc.arrays import FloatArray, Vec4Array2d
from ipc.solver.block_jacobi import BlockJacobi
from ipc.solver.lines import Lines, apply_lines
from tests.ipc.conftest import bonded_pad, small_pad
from tests.ipc.solver.test_rows import half_product


@wp.kernel
def precondition(lines: Lines, r: Vec4Array2d, z: Vec4Array2d, total: FloatArray):
    env = wp.tid()
    total[env] = apply_lines(lines, env, r, z)


@pytest.mark.parametrize("blocks", [None, (2, 2, 1)])
@pytest.mark.parametrize("beside", [False, True])
def test_lines_are_inverted_as_a_whole(blocks: tuple[int, int, int] | None, beside: bool, rng: np.random.Generator) -> None:
    """Stretched, with and without volume blocks; beside an affine body each node is a line of its own."""
    cells = 4, 4, 3
    changes = {} if blocks is None else {"volume_blocks": ipc.grid_blocks(cells, blocks), "own_volume": 0.5}
    pad = bonded_pad(small_pad(cells), **changes)
    boxes = (
        [ipc.AffineBody("box", ipc.box_surface((2e-3, 2e-3, 2e-3)), pose=ipc.Pose((0.0, 0.0, 0.1)), drive=1.0)] if beside else []
    )
    settings = ipc.Settings(dt=0.01, preconditioner="block_jacobi")
    world = ipc.World([pad, *boxes], settings, device="cpu")
    newton, layout = world._newton, world.layout
    pot, chosen = newton.potential, newton.preconditioner
    assert isinstance(chosen, BlockJacobi) and chosen.lines is not None
    soft = (layout.node_free != 0) & (layout.node_body == 0)
    pot.set_frames(wp.zeros(1, dtype=wp.float64, device="cpu"), pot.R, pot.t)
    pot.y.assign(pot.y.numpy() + 1e-4 * soft[:, None] * rng.normal(size=pot.y.numpy().shape))
    pot.place_vertices(pot.y, pot.R, pot.t, pot.x)
    pot.aim_inertia(pot.R, pot.t)
    pot.assemble(pot.everyone)
    pot.fill_matrix(pot.everyone)
    newton._update_preconditioner(pot.everyone)

    size, nodes = 3 * len(soft), np.flatnonzero(soft)
    H = np.array([half_product(pot, row)[0] for row in np.eye(size)])
    places = layout.node_rest[nodes, :2].round(9)
    groups = [[n] for n in nodes] if beside else [nodes[(places == place).all(axis=1)] for place in np.unique(places, axis=0)]
    assert len(groups) == (len(nodes) if beside else 25)
    r = rng.normal(size=(len(soft), 3)) * soft[:, None]
    expected = np.zeros_like(r)
    for group in groups:
        at = (3 * np.asarray(group)[:, None] + np.arange(3)).ravel()
        expected[group] = np.linalg.solve(H[np.ix_(at, at)], r[group].ravel()).reshape(-1, 3)

    padded = np.pad(r, ((0, 0), (0, 1)))[None]
    source, z = (wp.array(a, dtype=wp.vec4d, device="cpu") for a in (padded, np.zeros_like(padded)))
    total = wp.zeros(1, dtype=wp.float64, device="cpu")
    wp.launch(precondition, dim=1, inputs=[chosen.lines, source, z, total], device="cpu")
    np.testing.assert_allclose(z.numpy()[0, soft, :3], expected[soft], rtol=0, atol=1e-12 * np.abs(expected).max())
    assert total.numpy()[0] == pytest.approx((r * expected).sum(), rel=1e-12)
