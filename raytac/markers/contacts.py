"""Cells that contacts are averaged over, and the separate contacts of every pad."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np

from raytac.checks import is_number
from raytac.errors import InputError
from raytac.gel.components import boxes
from raytac.gel.surface import GelSurface, PadGrid

TWIST_SLIP = 3 * math.pi / 16
"""Displacement at a contact's edge when it spins over that when it slides, at the limits.

Of a ball on incompressible rubber. Sliding, μ P = 8 G A Δs / (2 − ν); spinning, 3π/16 μ P A = 16/3 G A³ Δθ (Johnson, §3.6, 3.9); so
9π/32 / (2 − ν)."""
COLUMNS = 12
"""Of ``Contacts.table``."""


@dataclass(frozen=True)
class ContactSettings:
    """Sampling of contacts, and tracking from one surface to the next."""

    cell: float = 0.4e-3
    """Largest side of a cell that a contact is averaged over [m], unless the grid is coarser.

    Gaps narrower than a cell do not separate two contacts. Marker motion is fitted with this size."""
    reach: float = 1e-3
    """Distance [m] beyond a carried contact's radius within which a contact is that one.

    It covers what a contact's centre moves by itself, as of a ball that rolls or an edge that comes down."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (is_number(value) and 0.0 < value < math.inf):
                raise InputError(name, value=value, rule="must be finite and > 0 [m]")


@dataclass(frozen=True)
class ContactCells:
    """Cells of whole grid nodes that cover the pad's face."""

    grid: PadGrid
    nodes: tuple[int, int]
    """Nodes of a cell along x and y."""
    x: np.ndarray
    """Centres of the columns [m], shape (nx,); the last cell may reach beyond the pad."""
    y: np.ndarray
    """Centres of the rows [m], shape (ny,)."""

    @classmethod
    def over(cls, grid: PadGrid, settings: ContactSettings | None = None) -> ContactCells:
        """Cells of a grid; ``settings``: None is the default ones."""
        size = (settings or ContactSettings()).cell
        nodes = tuple(max(1, int(size / pitch + 1e-9)) for pitch in grid.pitch)
        x, y = (
            first + pitch * (count * np.arange(-(-len(line) // count)) + 0.5 * (count - 1))
            for first, pitch, count, line in zip((grid.x[0], grid.y[0]), grid.pitch, nodes, (grid.x, grid.y), strict=True)
        )
        return cls(grid, (nodes[0], nodes[1]), x, y)

    @cached_property
    def pitch(self) -> tuple[float, float]:
        """Width and height of a cell [m]."""
        (dx, dy), (kx, ky) = self.grid.pitch, self.nodes
        return dx * kx, dy * ky

    @property
    def area(self) -> float:
        """Area of a cell [m²]."""
        return self.pitch[0] * self.pitch[1]

    @cached_property
    def _rest(self) -> np.ndarray:
        """The grid's rest surface as heights are stored."""
        return self.grid.rest.astype(np.float32)

    def sample(self, surface: GelSurface) -> ContactSamples:
        """Average the indentation over the cells; none where heights are not finite."""
        if surface.grid is not self.grid and surface.grid.shape != self.grid.shape:
            rule = f"must be that of the first surface, {self.grid.shape}"
            raise InputError("surface.grid", value=surface.grid.shape, rule=rule)
        (kx, ky), batch = self.nodes, surface.batch
        depth = np.zeros((batch, len(self.y), len(self.x)), dtype=np.float32)
        contact = np.zeros(depth.shape, bool)
        mask = np.asarray(surface.contact)
        r0, r1, c0, c1 = _box_of(mask[0] if batch == 1 else np.logical_or.reduce(mask))
        if r0 == r1:
            return ContactSamples(self, depth, contact, (0, 0, 0, 0))
        r0, r1, c0, c1 = r0 // ky, -(-r1 // ky), c0 // kx, -(-c1 // kx)
        part = np.s_[:, r0 * ky : r1 * ky, c0 * kx : c1 * kx]
        touched = mask[part]
        indentation = self._rest[part[1:]] - surface.height[part]
        np.maximum(indentation, 0, out=indentation)
        if not math.isfinite(indentation.sum()):
            touched = touched & np.all(np.isfinite(indentation), axis=(1, 2))[:, None, None]
            indentation = np.where(touched, indentation, np.float32(0))
        np.multiply(indentation, touched, out=indentation)
        cells = np.s_[:, r0:r1, c0:c1]
        depth[cells] = self._pooled(np.add, indentation, r1 - r0, c1 - c0)
        if kx * ky > 1:
            depth[cells] /= np.float32(kx * ky)
        contact[cells] = self._pooled(np.logical_or, touched, r1 - r0, c1 - c0)
        return ContactSamples(self, depth, contact, (r0, r1, c0, c1))

    def _pooled(self, join: np.ufunc, values: np.ndarray, ny: int, nx: int) -> np.ndarray:
        """Node values (B, Ny, Nx) joined over ``ny`` × ``nx`` cells; the last may pass the edge."""
        kx, ky = self.nodes
        if kx == ky == 1:
            return values
        missing = ny * ky - values.shape[1], nx * kx - values.shape[2]
        if any(missing):
            values = np.pad(values, ((0, 0), (0, missing[0]), (0, missing[1])))
        lines = join.reduce(values.reshape(len(values), ny, ky, nx * kx), axis=2)
        return reduce(join, [lines[..., k::kx] for k in range(kx)])


@dataclass(frozen=True)
class ContactSamples:
    """Contact of B pads by cell."""

    cells: ContactCells
    depth: np.ndarray
    """Mean of max(rest − height, 0) in contact, else 0 [m], (B, ny, nx), float32."""
    contact: np.ndarray
    """True where the object touches the cell at all, (B, ny, nx), bool."""
    box: tuple[int, int, int, int]
    """Rows [r0, r1) and columns [c0, c1) outside of which no environment has contact."""

    @property
    def boxes(self) -> np.ndarray:
        """Columns [c0, c1) and rows [r0, r1) of each contact, (B, 4), uint32; 0 without contact."""
        if len(self.contact) > 1:
            return boxes(self.contact)
        r0, r1, c0, c1 = self.box
        return np.array([[c0, c1, r0, r1]], dtype=np.uint32)


def _box_of(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Rows [r0, r1) and columns [c0, c1) of the True values of a mask (Ny, Nx); 0 if none."""
    # A search in bytes, from either end, is several times faster than a reduction of the array.
    flat, width = mask.tobytes(), mask.shape[1]
    first = flat.find(1)
    if first < 0:
        return 0, 0, 0, 0
    r0, r1 = first // width, flat.rfind(1) // width + 1
    line = mask[r0:r1].any(axis=0).tobytes()
    return r0, r1, line.find(1), line.rfind(1) + 1


@dataclass(frozen=True)
class Contacts:
    """Up to K contacts of each of B pads; rows that are not ``active`` are zero.

    ``table`` (B, K, 12) has the columns ``active``, ``centre`` (2), ``shear`` (2), ``twist``, ``ellipse`` (3), ``depth``, ``radius`` and
    the height z of the pressed gel.
    """

    table: np.ndarray

    @property
    def active(self) -> np.ndarray:
        """True for rows that are contacts, (B, K), bool."""
        return self.table[..., 0] > 0

    @property
    def centre(self) -> np.ndarray:
        """Indentation-weighted centre [m], (B, K, 2)."""
        return self.table[..., 1:3]

    @property
    def shear(self) -> np.ndarray:
        """Tangential displacement of the object since first touch, less known slip [m], (B, K, 2)."""
        return self.table[..., 3:5]

    @property
    def twist(self) -> np.ndarray:
        """Rotation of the object about +z since first touch, less known slip [rad], (B, K)."""
        return self.table[..., 5]

    @property
    def ellipse(self) -> np.ndarray:
        """T_xx, T_xy, T_yy of the ellipse xᵀ T⁻¹ x = 1 [m²], (B, K, 3).

        It has the contact's area, and its axes have the directions and the ratio of the cells' second moments. A disc has T = radius² 1.
        """
        return self.table[..., 6:9]

    @property
    def depth(self) -> np.ndarray:
        """Mean indentation over the cells that the contact touches [m], (B, K)."""
        return self.table[..., 9]

    @property
    def radius(self) -> np.ndarray:
        """Radius of a disc with the area of all cells that the contact touches [m], (B, K).

        It is larger than the contact's own: for a disc of radius R and cells whose nodes span a × b, on average
        π radius² = π R² + 2 R (a + b) + a b (Steiner), about R + (a + b)/π; 0.2 mm more for cells of 0.4 mm.
        """
        return self.table[..., 10]
