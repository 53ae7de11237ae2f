"""Correction of normal contact below the size of the mesh's cells, for B pads."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from raytac.gel.interpolate import SplineAxis, hat_matrix
from raytac.gel.products import Matrices, Products
from raytac.gel.surface import PadGrid
from raytac.physics.soft.clearance import hat_arrays
from raytac.physics.soft.coat_surface import CoatSurface
from raytac.physics.soft.correction import normal_kernels as kernels
from raytac.physics.soft.correction.cosine_series import CosineSeries, nodal_compliance
from raytac.physics.soft.correction.plane_waves import CosineSum
from raytac.physics.soft.correction.vertex_forces import VertexForces
from raytac.physics.soft.settings import Correction
from raytac.specs.sensor import GelpadSpec


class ContactSampler:
    """Evaluates normal contacts of the fine grid over the lines of another grid, or of its own.

    Between the nodes the dent is a cubic spline: cosines up to the shortest wave of the grid would ring along a sharp rim.
    """

    def __init__(self, correction: NormalCorrection, x: np.ndarray, y: np.ndarray) -> None:
        self._products, self._is_own = correction.products, np.array_equal(x, correction.x) and np.array_equal(y, correction.y)
        lines = (y, correction.y), (x, correction.x)
        nearest = (np.abs(line[:, None] - nodes).argmin(axis=1) for line, nodes in lines)
        self.nearest = tuple(wp.array(index, dtype=wp.int32, device=self._products.device) for index in nearest)
        if not self._is_own:
            over_y, over_x = (SplineAxis(nodes).matrix(line) for line, nodes in lines)
            self._rows, self._columns = self._products.constant(over_y), self._products.constant(over_x.T)
            self._spare, self._dent = self._products.zeros(len(y), len(correction.x)), self._products.zeros(len(y), len(x))

    def dent(self, contact: NormalCorrection) -> Matrices:
        """Launch the dent of the contacts that were solved last [m], where they touch."""
        if self._is_own:
            return contact.dent
        self._products.multiply(self._rows, contact.dent, self._spare, active=contact.search.touched)
        self._products.multiply(self._spare, self._columns, self._dent, active=contact.search.touched)
        return self._dent


class NormalCorrection:
    """Corrects a coat's height for its coarse mesh (*defect correction*).

    A mesh whose cells are wider than a contact, or than the bend at its rim, makes the dent too wide and uneven. The part of that error
    that is linear elasticity can be undone. Let w be the solver's height over rest and C its vertices in contact. E w is the linear
    response of *the same mesh* to the normal forces on C that give the heights w there. A p is the linear response of *the gel layer*
    to a pressure p on a fine grid. The corrected coat is

        rest + (w − E w) − A p,   p >= 0, never above the object's underside, and p = 0 where it lies below.

    So the mesh's normal contact is exchanged for the solution of a linear complementarity problem on the fine grid. The remainder w − E w
    holds everything else: friction, shear, twist, large strain, sideways motion. It is 0 at vertices that touch and jumps beside them,
    which is an artefact of the mesh; waves of two cells are therefore filtered out of it. The finer the mesh, the less E w and A p differ.
    (Correction by the difference of two discretisations of a simplified operator: K. Böhmer, P. Hemker and H. Stetter, The defect
    correction approach, Computing Suppl. 5, 1984.)

    A is the layer's exact response (``layer_compliance``) at the nodes to pressures that are linear between them, wave by wave over
    cosines, as if the pad were continued by its mirror image. Such pressures have waves shorter than the grid resolves. At the nodes
    these look like longer ones and are counted there: without them, every jump of pressure at a rim rings as waves of two cells. The
    difference that the pad's free sides make is smooth and is added on the coat's own mesh.

    The pressure is solved for by conjugate gradients over the nodes in contact, which are revised in every step (I. A. Polonsky and
    L. M. Keer, A numerical method for solving rough contact problems, Wear 231, 1999), with a preconditioner: g is their gap, z the
    preconditioned gap, t the direction, G = g·z, τ the step length. z is local and grows with wave number, as A falls: A falls as 1/k.
    In units of the grid c + k² (c − the five-point Laplacian) times that varies by 7 where 1/k varies by 200. A step that takes the
    pressure of no node to 0 and adds none changes A p by τ A t, which is known.

    Attributes of the last ``solve``:
        load: normal force on the vertices [N], (B, V), float64.
        touching: 1 where a vertex is in contact, (B, V), int32.
        mesh_forces: normal forces on the vertices [N] that hold the linear mesh in contact, (B, V), float64.
        rise: w − E w on the lattice [m], as of ``CoatSurface.rise``.    over: the same at the nodes of the fine grid [m].
        pressure: p on the fine grid [Pa], >= 0.
        waves: cosine amplitudes of the pressure [Pa].
        dent: A p at the nodes of the fine grid [m], where anything touches.
        forces: of the pressure on the vertices [N], (1, B, V), for products with all environments.
        search: windows, residuals (``best``) and what is in contact (``touched``).
    """

    def __init__(
        self, surface: CoatSurface, gelpad: GelpadSpec, grid: PadGrid, compliance: np.ndarray, continued: np.ndarray,
        settings: Correction, products: Products,
    ) -> None:  # fmt: skip
        """Prepare the fine grid.

        Args:
            compliance: z of the coat's vertices over a force along z on each [m/N], (V, V), of the pad's mesh.
            continued: the same if the pad's sides may not move outwards.
        """
        self.surface, self.settings, self.products = surface, settings, products
        self.x, self.y, mesh, device = grid.x, grid.y, surface.mesh, products.device
        self._wide, count, shape, vertices = mesh.shape[1], products.num_envs, grid.shape, len(mesh.rest)
        self.series_x, self.series_y = CosineSeries(grid.x), CosineSeries(grid.y)
        layer = nodal_compliance(self.series_x, self.series_y, gelpad)
        constant, (ny, nx) = products.constant, shape
        self._layer, self._table = constant(layer), self._distances(layer, nx)
        self._analysis = constant(self.series_y.analysis), constant(self.series_x.analysis.T)
        self._across = constant(self.series_y.analysis.T), constant(self.series_y.synthesis(grid.y).T)
        self._synthesis = CosineSum((self.series_x, self.series_y), grid.x, grid.y, products)
        self._sides = constant((compliance - continued).T)
        area_x, area_y = (_lengths(line) for line in (grid.x, grid.y))
        self._force_y = constant(hat_matrix(mesh.lines_y, grid.y).T * area_y)
        self._force_x = constant(hat_matrix(mesh.lines_x, grid.x) * area_x[:, None])
        border_y, border_x = SplineAxis(mesh.lines_y).matrix(grid.y), SplineAxis(mesh.lines_x).matrix(grid.x)
        self._border, self._border_x = (constant(border_y.T), constant(border_x)), constant(border_x.T)
        zeros, (rows, columns) = products.zeros, mesh.shape
        self._along_y, self._convolved, self._dent, self._response = (zeros(nx, ny) for _ in range(4))
        self.dent = zeros(ny, nx)
        self._over_x, self._over_vertices, self._border_y = zeros(ny, columns), zeros(rows, columns), zeros(columns, ny)
        self._border_at = zeros(columns, rows)
        self.hats = hat_arrays(mesh, grid.x, grid.y, device)
        self.sampler = ContactSampler(self, grid.x, grid.y)
        self._smooth = tuple(wp.array(_smoothing(t), dtype=wp.vec3d, device=device) for t in (mesh.lines_y, mesh.lines_x))
        self.holding = VertexForces(compliance, products)
        self._rows, self._columns = surface.matrices(grid.x, grid.y)
        self._spare, self.over = products.zeros(shape[0], surface.lattice[1]), products.zeros(*shape)
        self.rise, self._half, self.waves = products.zeros(*surface.lattice), products.zeros(*shape), products.zeros(*shape)
        self.pressure, self._p, self._t = (products.zeros(*shape) for _ in range(3))
        self._g, self._z, self._overlap, self._start = (products.zeros(*shape) for _ in range(4))
        self._rest = wp.array(grid.rest, dtype=wp.float64, device=device)
        self.forces, self._borders = (products.zeros(count, vertices, num_envs=1) for _ in range(2))
        self._force_flat, self._border_flat = (one.numbers[0] for one in (self.forces, self._borders))
        self.load = wp.zeros((count, vertices), dtype=wp.float64, device=device)
        self.touching = wp.zeros((count, vertices), dtype=wp.int32, device=device)
        self._remainder = wp.zeros((count, 1, vertices), dtype=wp.float64, device=device)
        self._near = wp.zeros((count, shape[0]), dtype=wp.vec2i, device=device)
        self._sums, self._gaps = (wp.zeros((count, shape[0]), dtype=wp.vec3d, device=device) for _ in range(2))
        self._overlapping, self._bent = (wp.zeros((count, shape[0]), dtype=wp.int32, device=device) for _ in range(2))
        self._greatest, self._go = wp.zeros(count, dtype=wp.float32, device=device), wp.zeros(1, dtype=wp.int32, device=device)
        search: Any = kernels.Search()
        for name, dtype in _SEARCH.items():
            setattr(search, name, wp.zeros(count, dtype=dtype, device=device))
        self.search = search

    @property
    def mesh_forces(self) -> wp.array:
        """As of the class."""
        return self.holding.forces

    def solve(self, forces: wp.array, clearance: wp.array, sound: wp.array, under: wp.array) -> None:
        """Launch the solution of the contact of every pad, after the surface's ``place``.

        Args:
            forces: on the vertices (B, V), ``vec3d`` [N].
            clearance: (B,), float64, NaN out of contact.
            sound: 1 in environments (B,), int32, that are read.
            under: z of the object's underside over the fine grid [m], (B, Ny, Nx), float64; inf where there is none.
        """
        s, lines, each = self.search, self._near.shape, self.load.shape
        self._launch(kernels.loads, each, [sound, forces, clearance, self.load])
        self._launch(
            kernels.choose_touching,
            each[0],
            [self.load, self.settings.least_load, self.holding.can_move, self.touching, self.holding.unknowns],
        )
        self.holding.wanted_from(self.surface.displacement, 2)
        self.holding.solve(_SAME, _MOST)
        inputs = [*self._smooth, self.surface.displacement, self.holding.response(), self._remainder]
        # The third component of the displacement is the height.
        self._launch(kernels.smooth_remainder, each, inputs)
        self.surface.rise_of(self._remainder, self.rise)
        self.products.sandwich(self._rows, self.rise, self._columns, self._spare, self.over)
        gaps = [self.settings.open_gap, self.settings.clear_gap, self._rest, self.over.numbers, under]
        self._launch(kernels.overlaps, lines, [*gaps, self._overlap.numbers, self._near])
        self._launch(kernels.choose_windows, each[0], [sound, clearance, self._near, s])
        self._launch(kernels.first_pressures, lines, [s, self.hats, self._wide, self.load, self._start.numbers])
        self._launch(kernels.greatest_in_window, each[0], [s, self._start.numbers, self._greatest])
        for one in (self._p, self._t, self.pressure):
            one.padded.zero_()
        begun = [self._p.numbers, self.pressure.numbers, self._overlapping]
        self._launch(kernels.begin, lines, [s, self._overlap.numbers, self._greatest, self._start.numbers, *begun])
        self._launch(kernels.put, 1, [1, self._go])
        with wp.ScopedDevice(self.products.device):
            wp.capture_while(self._go, self._iterate)
        self._find_whole_dent()

    def _iterate(self) -> None:
        """Launch one step of the search for the pressure."""
        s, lines, count = self.search, self._near.shape, len(self._greatest)
        p, t, g, z = (one.numbers for one in (self._p, self._t, self._g, self._z))
        dent, response = (one.numbers.transpose((0, 2, 1)) for one in (self._dent, self._response))
        self._find_dent(self._p, self._dent, s.stale)
        self._launch(kernels.gaps, lines, [s, dent, self._overlap.numbers, p, g, self._gaps])
        self._launch(kernels.stiffen, lines, [s, _SHORTEST, g, p, z, self._sums])
        self._launch(kernels.judge, count, [s, self._gaps, self._sums, self._overlapping, self.settings.gap_tolerance])
        self._launch(kernels.turn, lines, [s, z, p, self.pressure.numbers, t])
        self._find_dent(self._t, self._response, s.active)
        self._launch(kernels.curvatures, lines, [s, response, g, p, t, self._sums])
        self._launch(kernels.put, 1, [0, self._go])
        self._launch(kernels.choose_length, count, [s, self._sums, self.settings.normal_iterations, self._go])
        self._launch(kernels.move, lines, [s, _SHORTEST, g, t, p, self._overlapping, self._bent])
        self._launch(kernels.choose_stale, count, [s, self._bent])
        self._launch(kernels.follow_step, lines, [s, response, dent])

    def _find_dent(self, pressure: Matrices, out: Matrices, active: wp.array) -> None:
        """Launch the dent under a pressure where ``active`` (B,), in the windows by column and row."""
        s, multiply = self.search, self.products.multiply
        window: Any = {"rows": s.columns, "active": active}
        multiply(pressure.transposed, self._across[0], self._along_y, inner=s.rows, **window)
        dim = self.products.blocks(self._along_y)
        inputs = [active, s.columns, self._table, self._along_y.packets, len(self.x), dim[2], self._convolved.packets]
        self._launch(kernels.convolve, dim, inputs)
        multiply(self._convolved, self._across[1], out, columns=s.rows, **window)
        self._find_border(pressure, active)
        multiply(self._border_at, self._border[0], self._border_y, columns=s.rows, active=active)
        multiply(self._border[1], self._border_y, out, columns=s.rows, adds=True, **window)

    def _find_border(self, pressure: Matrices, active: wp.array) -> None:
        """Launch what the pad's free sides add: ``forces`` and the dent at the vertices."""
        s, multiply = self.search, self.products.multiply
        multiply(pressure, self._force_x, self._over_x, rows=s.rows, inner=s.columns, active=active)
        multiply(self._force_y, self._over_x, self._over_vertices, inner=s.rows, active=active)
        self._launch(kernels.flatten, self.load.shape, [self._over_vertices.numbers, self._force_flat])
        multiply(self.forces, self._sides, self._borders)
        self._launch(kernels.fold, self.load.shape, [self._border_flat, self._border_at.numbers])

    def _find_whole_dent(self) -> None:
        """Launch ``waves``, ``forces`` and ``dent`` of the best pressure."""
        s, multiply, active = self.search, self.products.multiply, self.search.touched
        multiply(self._analysis[0], self.pressure, self._half, inner=s.rows, columns=s.columns, active=active)
        multiply(self._half, self._analysis[1], self.waves, inner=s.columns, active=active)
        self._synthesis.find(self._layer, self.waves, active, self.dent)
        self._find_border(self.pressure, active)
        multiply(self._border_at, self._border[0], self._border_y, active=active)
        multiply(self._border_y.transposed, self._border_x, self.dent, active=active, adds=True)

    def _distances(self, layer: np.ndarray, nodes: int) -> wp.array:
        """Response c at a distance along x to a line load, for each wave along y (see ``convolve``).

        With the analysis along x, 2 h_k h_i cos(k i)/(n − 1), h = ½ at both ends, a product of two cosines is the sum of those of i − i'
        and i + i'.
        """
        half = np.ones(nodes)
        half[[0, -1]] = 0.5
        distance = np.arange(2 * nodes - 1)
        cosines = np.cos(np.pi * np.outer(np.arange(nodes), distance) / (nodes - 1))
        table = self.products.constant((cosines.T * (half / (nodes - 1))) @ layer.T)
        packets: Any = table.packets
        return packets[0]

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.products.device)


_SEARCH = {
    "active": wp.int32, "touched": wp.int32, "rows": wp.vec2i, "columns": wp.vec2i, "last": wp.float64, "beta": wp.float32,
    "tau": wp.float32, "best": wp.float64, "improved": wp.int32, "count": wp.int32, "stale": wp.int32,
}  # fmt: skip
_SHORTEST = 0.5
"""c of the preconditioner, in units of the grid.

It needs the fewest steps for pins, a coin and a gear."""
_SAME = 1e-12
"""Difference of the heights of vertices that is none [m]."""
_MOST = 2000
"""Most steps of that search."""


def _lengths(line: np.ndarray) -> np.ndarray:
    """Length of the cell around each of evenly spaced nodes [m], half of one at the ends."""
    length = np.full(len(line), line[1] - line[0])
    length[[0, -1]] *= 0.5
    return length


def _smoothing(lines: np.ndarray) -> np.ndarray:
    """Filter on ``lines`` (n,): waves of λ even cells keep cos²(π/λ), 0 of two cells.

    Weights of the line before, the line and the line after, (n, 3).
    """
    cell, n = np.diff(lines), len(lines)
    out = np.tile([0.0, 1.0, 0.0], (n, 1))
    for i in range(1, n - 1):
        out[i] = 0.5 * cell[i] / (cell[i - 1] + cell[i]), 0.5, 0.5 * cell[i - 1] / (cell[i - 1] + cell[i])
    return out
