"""The clearance that the barrier keeps between a coat and an object, at samples of both."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from raytac.gel.coat_mesh import CoatMesh
from raytac.gel.interpolate import SplineAxis, cell_lengths
from raytac.gel.products import Products
from raytac.gel.surface import PadGrid
from raytac.physics.soft import clearance_kernels as kernels
from raytac.physics.soft.coat_surface import CoatSurface
from raytac.physics.soft.undersides import Touched, Undersides

_SLACK = 1.0 / 64.0
"""Further allowance for sag, as a share of the cell."""


class BarrierClearance:
    """Measures the mean clearance that the barrier keeps in the contacts of B pads.

    The barrier holds the coat's facets slightly off the object, and where the coat wraps a curved object its vertices lie deeper than
    its facets. Both are artefacts of the discretisation: a real coat touches. Let c = underside of the object − smooth coat. The
    clearance is the mean of c weighted by pressure, over samples under pressure and where c is no more than barrier and sag explain.
    A larger c is a recess of the object. Facets sag only where the object is convex, that is lower than its own mean over a cell.

    Cells that are wider than the contact, as under a cone's tip, sag by more than the gel would indent. In a press of depth δ the gel
    itself falls by at most about δ/2 within the contact (a ball's; 0.6 δ a cone's), so the clearance is at most d̂ + δ/2. With o the overlap
    of object and resting gel, which is δ less the clearance, that is 2 d̂ + o.

    The object is shown lower than the solver has it by this clearance, and a press to a depth drives it higher by as much: the coat, not
    the barrier, is at the commanded depth.

    Attributes:
        clearance: [m], (B,), float64; NaN out of contact.
        lattice: the coat's height over rest on the surface's lattice [m], of the last ``measure``.
    """

    def __init__(self, surface: CoatSurface, samples: PadGrid, d_hat: float, products: Products) -> None:
        """``samples``: grid at which gaps are taken; ``d_hat``: reach of the barrier [m]."""
        mesh, self._products, device = surface.mesh, products, products.device
        self._surface, self._device, self._d_hat = surface, device, d_hat
        self._rows, self._columns = surface.matrices(samples.x, samples.y)
        self._hats = hat_arrays(mesh, samples.x, samples.y, device)
        cell_x, cell_y = (cell_lengths(lines, t) for lines, t in ((mesh.lines_x, samples.x), (mesh.lines_y, samples.y)))
        reach = d_hat + _SLACK * np.maximum(cell_y[:, None], cell_x[None, :])
        self._rest, self._reach = (wp.array(field, dtype=wp.float64, device=device) for field in (samples.rest, reach))
        count, ny = products.num_envs, samples.shape[0]
        self.undersides = Undersides(samples, float(samples.rest.max()) + 10.0 * d_hat, count, device)
        self._spare = products.zeros(ny, surface.lattice[1])
        self._rise, self.lattice = products.zeros(*samples.shape), products.zeros(*surface.lattice)
        self._mean, self._pressure = (wp.zeros((count, len(mesh.rest)), dtype=wp.float64, device=device) for _ in range(2))
        self._lowest_rows = wp.zeros((count, ny), dtype=wp.float64, device=device)
        self._lowest, self.clearance = (wp.zeros(count, dtype=wp.float64, device=device) for _ in range(2))
        self._sums = wp.zeros((count, ny), dtype=wp.vec3d, device=device)
        self._unmoved = wp.zeros(count, dtype=wp.float64, device=device)

    def measure(self, forces: wp.array, objects: Touched, sound: wp.array) -> None:
        """Launch the measurement under ``forces``, after the surface's ``place``.

        ``forces``: (B, V) of ``vec3d`` [N]; ``sound``: 1 in environments (B,), int32, that are read.
        """
        columns, under = self._surface.mesh.shape[1], self.undersides.under
        self._surface.rise(self.lattice)
        self._products.sandwich(self._rows, self.lattice, self._columns, self._spare, self._rise)
        self.undersides.find(objects, sound, self._unmoved)
        self.undersides.remove_behind(objects, self._rise.numbers, self._unmoved)
        self._launch(kernels.pressures, forces.shape, [self._surface.struct, sound, forces, self._pressure])
        self._launch(kernels.lowest_in_rows, self._sums.shape, [under, self._lowest_rows])
        self._launch(kernels.lowest_of_rows, len(self._lowest), [self._lowest_rows, self._lowest])
        self._launch(kernels.mean_over_cells, forces.shape, [self._hats, columns, under, self._lowest, self._mean])
        fields = [self._pressure, self._mean, self._lowest, self._rest, self._reach, self._rise.numbers, under, self._sums]
        self._launch(kernels.gaps_in_rows, self._sums.shape, [self._hats, columns, *fields])
        self._launch(kernels.mean_gaps, len(self.clearance), [self._sums, wp.float64(self._d_hat), self.clearance])

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self._device)


def hat_arrays(mesh: CoatMesh, x: np.ndarray, y: np.ndarray, device: Any) -> Any:
    """Arrays of ``Hats`` for the lines ``x`` (Nx,), ``y`` (Ny,) [m] of a grid, evenly spaced."""
    hats: Any = kernels.Hats()
    for axis, lines, nodes in (("x", mesh.lines_x, x), ("y", mesh.lines_y, y)):
        cell, (_, share, _, _) = SplineAxis(lines).weights(nodes)
        used = (np.abs(np.arange(len(lines))[:, None] - cell - 0.5) < 1.0) & np.ones(len(nodes), bool)
        around = np.stack([used.argmax(axis=1), len(nodes) - used[:, ::-1].argmax(axis=1)], axis=1)
        around[~used.any(axis=1)] = 0
        length = np.full(len(nodes), nodes[1] - nodes[0])
        length[[0, -1]] *= 0.5
        for name, values, dtype in (
            ("cell", cell, wp.int32),
            ("share", share, wp.float64),
            ("around", around, wp.vec2i),
            ("area", length, wp.float64),
        ):
            setattr(hats, f"{name}_{axis}", wp.array(values, dtype=dtype, device=device))
    return hats
