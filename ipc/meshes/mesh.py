"""Tetrahedral and triangle meshes: pads, simple solids, surfaces and their areas."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ipc.errors import IpcError


@dataclass(frozen=True)
class TetMesh:
    """Tetrahedra.

    Attributes:
        vertices: positions [m], shape (N, 3).
        tets: vertex indices, shape (T, 4), each of positive volume det[x1−x0, x2−x0, x3−x0] / 6.
    """

    vertices: NDArray[np.float64]
    tets: NDArray[np.integer]

    def __post_init__(self) -> None:
        _check_arrays(self, "tets", 4)
        volumes = tet_volumes(self.vertices, self.tets)
        if not (volumes > 0).all():
            bad = int(np.argmin(volumes))
            raise IpcError(f"tet {bad} has volume {volumes[bad]:.3g} m³: every tetrahedron must have a positive one")


@dataclass(frozen=True)
class TriMesh:
    """Triangles, counter-clockwise seen from outside.

    Attributes:
        vertices: positions [m], shape (N, 3).
        faces: vertex indices, shape (F, 3).
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.integer]

    def __post_init__(self) -> None:
        _check_arrays(self, "faces", 3)


def _check_arrays(mesh: TetMesh | TriMesh, cells: Literal["tets", "faces"], corners: int) -> None:
    """Make a mesh's arrays contiguous float64 and int32; refuse wrong shapes and indices."""
    vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
    indices = np.ascontiguousarray(getattr(mesh, cells), dtype=np.int32)
    object.__setattr__(mesh, "vertices", vertices)
    object.__setattr__(mesh, cells, indices)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise IpcError(f"vertices have shape {vertices.shape}: it must be (N, 3)")
    if indices.ndim != 2 or indices.shape[1] != corners or len(indices) == 0:
        count = cells[0].upper()
        raise IpcError(f"{cells} have shape {indices.shape}: it must be ({count}, {corners}) with {count} ≥ 1")
    if indices.min() < 0 or indices.max() >= len(vertices):
        raise IpcError(f"{cells} name vertices {indices.min()} to {indices.max()}: there are {len(vertices)}")


def tet_volumes(vertices: ArrayLike, tets: ArrayLike) -> NDArray[np.float64]:
    """Signed volumes [m³], shape (T,)."""
    x = np.asarray(vertices, dtype=np.float64)[np.asarray(tets)]
    return np.linalg.det(x[:, 1:] - x[:, :1]) / 6


def graded(length: float, count: int, ratio: float = 1.0) -> NDArray[np.float64]:
    """Coordinates [m] (count + 1,) from 0 to ``length``; each cell is ``ratio`` times the last."""
    if count < 1 or not length > 0 or not ratio > 0:
        raise IpcError(f"graded(length={length}, count={count}, ratio={ratio}): all three must be positive")
    steps = ratio ** np.arange(count)
    return np.concatenate([[0.0], np.cumsum(steps)]) * (length / steps.sum())


Cut = Literal["mirrored", "alike"]
"""Subdivision of the cells of a grid into tetrahedra; see ``box_mesh``."""

# The six tetrahedra of a cube around its diagonal 0-7 (corner k has bits x = k & 1, y = k & 2, z = k & 4). Opposite faces of the cube have
# the same diagonals, so neighbouring cells match whether or not they are mirrored in the face between them.
_KUHN = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])


def box_mesh(x: ArrayLike, y: ArrayLike, z: ArrayLike, cut: Cut = "mirrored") -> TetMesh:
    """A box of six tetrahedra a cell on the grid of three rising coordinate lists [m].

    Vertex (i, j, k) has index (k·ny + j)·nx + i.

    Args:
        x, y, z: grid lines [m], at least two each.
        cut: direction of the diagonals of the cells.

            - ``"mirrored"``: each cell is the mirror image of its neighbours, in all three directions. Two by two by two cells are the
              barycentric subdivision of a cube, as the Powell-Sabin split is of a triangle; there, continuous piecewise linear fields
              without divergence approximate well (S. Zhang, J. Comput. Math. 26, 2008, in two dimensions; in three this is measured,
              not proven). Locks little where ν nears 0.5; docs/measurements/soft-pad.md has figures.
            - ``"alike"``: all diagonals are parallel, but for a reflection in the middle of x and of y. Locks where ν nears 0.5.

            With even cell counts in x and y either mesh is symmetric about its middle planes, if the grid lines are.

    Raises:
        IpcError: grid lines that do not rise, or an unknown ``cut``.
    """
    if cut not in get_args(Cut):
        raise IpcError(f"cut = {cut!r}: it must be one of {', '.join(get_args(Cut))}")
    axes = [np.asarray(a, dtype=np.float64) for a in (x, y, z)]
    for name, axis in zip("xyz", axes, strict=True):
        if axis.ndim != 1 or len(axis) < 2 or not (np.diff(axis) > 0).all():
            raise IpcError(f"{name} = {axis}: a grid line needs at least two rising coordinates")
    nx, ny, nz = (len(a) for a in axes)
    zz, yy, xx = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    vertices = np.stack([xx, yy, zz], axis=-1).reshape(-1, 3)
    k, j, i = (a.ravel() for a in np.meshgrid(np.arange(nz - 1), np.arange(ny - 1), np.arange(nx - 1), indexing="ij"))
    # Layers are counted from the top, so that the pattern of the face that is touched does not depend on their number.
    patterns = {"mirrored": (i % 2, j % 2, (nz - 2 - k) % 2), "alike": (2 * i >= nx - 1, 2 * j >= ny - 1, np.zeros_like(k))}
    corner = np.arange(8)
    at_x, at_y, at_z = (
        start[:, None] + ((corner >> bit & 1) ^ flip[:, None].astype(int))
        for bit, (start, flip) in enumerate(zip((i, j, k), patterns[cut], strict=True))
    )
    tets = ((at_z * ny + at_y) * nx + at_x)[:, _KUHN].reshape(-1, 4)
    inside_out = tet_volumes(vertices, tets) < 0
    tets[inside_out] = tets[inside_out][:, [0, 1, 3, 2]]
    return TetMesh(vertices, tets)


def grid_blocks(cells: tuple[int, int, int], block: tuple[int, int, int] = (2, 2, 1)) -> NDArray[np.int64]:
    """Volume block of each tetrahedron of a ``box_mesh`` or ``domed_pad``, shape (T,).

    Blocks in x and y are counted from the low side and in z from the top; the last of a direction may have fewer cells.

    Args:
        cells: number of cells of the grid in x, y and z.
        block: cells of a block in x, y and z. Of mirrored cells, (2, 2, 1) has 18 vertices and (2, 2, 2), the barycentric subdivision of
            a cube, 27.

    Raises:
        IpcError: a number below 1.
    """
    if min(*cells, *block) < 1:
        raise IpcError(f"grid_blocks(cells={cells}, block={block}): all numbers must be at least 1")
    count = [-(-n // b) for n, b in zip(cells, block, strict=True)]
    k, j, i = (a.ravel() for a in np.meshgrid(*(np.arange(n) for n in reversed(cells)), indexing="ij"))
    number = ((cells[2] - 1 - k) // block[2] * count[1] + j // block[1]) * count[0] + i // block[0]
    return np.repeat(number, len(_KUHN))


def domed_pad(
    size: tuple[float, float],
    thickness: float,
    radius: tuple[float, float],
    cells: tuple[int, int, int],
    grading: float = 1.0,
    cut: Cut = "mirrored",
) -> TetMesh:
    """A pad with a toroidal cap, z = 0 at its centre, on a flat base at z = −``thickness``.

    Args:
        size: extent in x and y [m].
        thickness: height at the centre [m].
        radius: radius of curvature along x and along y [m]; ``math.inf`` is flat.
        cells: number of cells in x, y and z.
        grading: ratio of each layer's height to the one below it; below 1 the layers get thinner towards the outer surface.
        cut: direction of the diagonals of the cells, see ``box_mesh``.

    Raises:
        IpcError: if the edge of the dome would fall below the base.
    """
    x = np.linspace(-size[0] / 2, size[0] / 2, cells[0] + 1)
    y = np.linspace(-size[1] / 2, size[1] / 2, cells[1] + 1)
    mesh = box_mesh(x, y, graded(thickness, cells[2], grading) - thickness, cut)
    v = mesh.vertices.copy()

    def sag(offset: NDArray[np.float64], r: float) -> NDArray[np.float64]:
        if not np.isfinite(r):
            return np.zeros_like(offset)
        if r <= np.abs(offset).max():
            raise IpcError(f"radius {r} m is less than half the pad's extent {np.abs(offset).max()} m")
        return offset**2 / (r + np.sqrt(r**2 - offset**2))

    drop = sag(v[:, 0], radius[0]) + sag(v[:, 1], radius[1])
    if drop.max() >= thickness:
        raise IpcError(f"the dome falls {drop.max():.3g} m at its corner: the pad is only {thickness:.3g} m thick")
    v[:, 2] -= drop * (1 + v[:, 2] / thickness)
    return TetMesh(v, mesh.tets)


def surface_of(tets: ArrayLike) -> NDArray[np.int32]:
    """Boundary triangles of tetrahedra, outward, in the mesh's own vertex numbers, (F, 3)."""
    t = np.asarray(tets)
    faces = t[:, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[count == 1])].astype(np.int32)


@dataclass(frozen=True)
class SurfaceTopology:
    """Edges and areas of a triangle mesh at rest.

    Attributes:
        edges: vertex indices, shape (E, 2), the lower first.
        vertex_area: a third of the areas of the triangles at each vertex [m²], shape (N,).
        edge_area: a third of the areas of the triangles at each edge [m²], shape (E,).
    """

    edges: NDArray[np.int32]
    vertex_area: NDArray[np.float64]
    edge_area: NDArray[np.float64]


def surface_topology(vertices: NDArray[np.float64], faces: NDArray[np.integer]) -> SurfaceTopology:
    """Edges, and the areas that weigh contacts (Li et al. 2023, section 3)."""
    x = vertices[faces]
    area = np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1) / 2
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, inverse = np.unique(sides, axis=0, return_inverse=True)
    vertex_area = np.bincount(faces.ravel(), weights=np.repeat(area / 3, 3), minlength=len(vertices))
    edge_area = np.bincount(inverse.ravel(), weights=np.repeat(area / 3, 3), minlength=len(edges))
    return SurfaceTopology(edges.astype(np.int32), vertex_area.astype(np.float64), edge_area.astype(np.float64))


def box_surface(size: tuple[float, float, float], centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> TriMesh:
    """The twelve triangles of a box of that size [m] about ``centre`` [m]."""
    half = np.asarray(size) / 2
    mesh = box_mesh((-half[0], half[0]), (-half[1], half[1]), (-half[2], half[2]))
    return TriMesh(mesh.vertices + np.asarray(centre), surface_of(mesh.tets))


def icosphere(radius: float, subdivisions: int = 3) -> TriMesh:
    """A sphere of 20·4ⁿ triangles with all vertices at ``radius`` [m] from the origin."""
    golden = (1 + 5**0.5) / 2
    v = np.array([(0, s, t * golden) for s in (-1, 1) for t in (-1, 1)])
    vertices = np.concatenate([v, np.roll(v, 1, axis=1), np.roll(v, 2, axis=1)])
    length2 = ((vertices[:, None] - vertices[None]) ** 2).sum(-1)
    near = np.isclose(length2, 4.0)
    faces = np.array(
        [(a, b, c) for a in range(12) for b in range(a) for c in range(b) if near[a, b] and near[b, c] and near[a, c]]
    )
    normals = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    inward = (normals * vertices[faces].sum(axis=1)).sum(axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    for _ in range(subdivisions):
        sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, inverse = np.unique(sides, axis=0, return_inverse=True)
        middle = inverse.reshape(-1, 3) + len(vertices)
        vertices = np.concatenate([vertices, vertices[edges].mean(axis=1)])
        a, b, c = faces.T
        ab, bc, ca = middle.T
        faces = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    vertices = vertices * (radius / np.linalg.norm(vertices, axis=1, keepdims=True))
    return TriMesh(vertices, faces)
