"""The coats of B pads as smooth surfaces, on the CPU or on CUDA."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from raytac.gel.coat_mesh import CoatMesh
from raytac.gel.interpolate import SplineAxis
from raytac.gel.products import Matrices, Products
from raytac.physics.rest_map import rest_maps
from raytac.physics.soft import coat_kernels as kernels
from raytac.specs.sensor import GelpadSpec

_FINER = 3
"""Cells of the lattice to one cell of the coat."""


class CoatSurface:
    """The coat as a C² height field: bicubic splines through its vertices' displacements.

    The three components of the displacement d are splines of the material position (u, v). So the surface at rest is exactly the dome,
    and the deformed one has continuous normals and curvature: no facet of the mesh shows. A height field needs the height at a *place*.
    The material point (u, v) that has come to (x, y) is therefore solved for first, by (u, v) ← (x, y) − d_xy(u, v), on a lattice of
    three lines to a cell. A second spline takes the heights from there to the nodes of a grid, in two matrix products a pad.

    Where the edge of the pad has drawn back, the height at its edge is continued. Where the coat hangs over itself, which no height
    field can hold, the search does not converge, and the height is that of its last point.

    Attributes:
        displacement: of the vertices from rest [m], (B, 3, V), float64, of the last ``place``.
        lattice: rows and columns of the lattice.
    """

    def __init__(self, mesh: CoatMesh, gelpad: GelpadSpec, products: Products) -> None:
        self.mesh, self._products, self._device = mesh, products, products.device
        x, y = SplineAxis(mesh.lines_x), SplineAxis(mesh.lines_y)
        self._lattice_x, self._lattice_y = SplineAxis(_refine(mesh.lines_x)), SplineAxis(_refine(mesh.lines_y))
        coat: Any = kernels.Coat()
        lines = {"lines_x": x.lines, "lines_y": y.lines, "lattice_x": self._lattice_x.lines, "lattice_y": self._lattice_y.lines}
        lines |= {"bending_x": x.bending, "bending_y": y.bending, "area": mesh.vertex_areas}
        for name, values in lines.items():
            setattr(coat, name, wp.array(values, dtype=wp.float64, device=self._device))
        coat.rest, coat.dome = wp.array(mesh.rest, dtype=wp.vec3d, device=self._device), wp.vec2d(*map(float, gelpad.dome_radius))
        coat.maps = rest_maps([gelpad], self._device)
        self.struct = coat
        self.lattice = len(self._lattice_y.lines), len(self._lattice_x.lines)
        count, points = products.num_envs, self.lattice[0] * self.lattice[1]
        places: Any = kernels.Places()
        for name, dtype in (("sag", wp.float64), ("corner", wp.int32), ("along_x", wp.vec4d), ("along_y", wp.vec4d)):
            setattr(places, name, wp.zeros((count, points), dtype=dtype, device=self._device))
        self.places = places
        self.displacement = wp.zeros((count, 3, len(mesh.rest)), dtype=wp.float64, device=self._device)
        self._fields = wp.zeros((count, 3, 4, len(mesh.rest)), dtype=wp.float64, device=self._device)
        self._other = wp.zeros((count, 1, 4, len(mesh.rest)), dtype=wp.float64, device=self._device)

    def matrices(self, x: np.ndarray, y: np.ndarray) -> tuple[Matrices, Matrices]:
        """(rows, columns) of grid lines [m]: rows @ rise @ columns is the height over rest."""
        return self._products.constant(self._lattice_y.matrix(y)), self._products.constant(self._lattice_x.matrix(x).T)

    def place(self, vertices: wp.array, sound: wp.array) -> None:
        """Launch the search for the material points of ``vertices`` (B, V), ``vec3d`` [m].

        ``sound``: 1 in environments (B,), int32, to be read; others are at rest.
        """
        self._launch(kernels.displacements, vertices.shape, [self.struct, sound, vertices, self.displacement])
        self._bend(self.displacement, self._fields)
        self._launch(kernels.find_places, self.places.sag.shape, [self.struct, self._fields, self.places])

    def rise(self, out: Matrices) -> None:
        """Launch the height over rest on the lattice [m], of the vertices of ``place``."""
        self._rise(self._fields, 2, out)

    def rise_of(self, upwards: wp.array, out: Matrices) -> None:
        """As ``rise``, for another displacement along z (B, 1, V), float64 [m]."""
        self._bend(upwards, self._other)
        self._rise(self._other, 0, out)

    def _bend(self, values: wp.array, fields: wp.array) -> None:
        self._launch(kernels.bend_rows, values.shape, [self.struct, values, fields])
        self._launch(kernels.bend_columns, values.shape, [self.struct, fields])

    def _rise(self, fields: wp.array, component: int, out: Matrices) -> None:
        self._launch(kernels.rise, self.places.sag.shape, [self.struct, self.places, fields, component, out.numbers])

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self._device)


def _refine(lines: np.ndarray) -> np.ndarray:
    """Lines with every cell divided into ``_FINER`` equal ones."""
    share = np.arange(_FINER) / _FINER
    return np.append((lines[:-1, None] + share * np.diff(lines)[:, None]).ravel(), lines[-1])
