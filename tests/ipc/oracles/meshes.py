"""Meshes for presses with a known answer: round blocks that are fine where the contact is, and tools that are as large as they say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

import ipc

Floats = NDArray[np.floating]


def ring_plan(radii: Sequence[float] | Floats, counts: Sequence[int], straight: int = 0) -> tuple[Floats, NDArray[np.int64]]:
    """A disc of triangles: a centre and rings of ``counts`` points at ``radii`` [m].

    Ring ``straight`` has a point on the x axis, and every other ring from there is turned by half a point.

    Returns:
        Points (n, 2), the centre first and then ring by ring, and triangles (T, 3), counter-clockwise.
    """
    turns = [0.5 * ((k - straight) % 2) for k in range(len(counts))]
    points = [np.zeros((1, 2))]
    for radius, count, turn in zip(radii, counts, turns, strict=True):
        angle = 2 * np.pi * (np.arange(count) + turn) / count
        points.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    first = np.concatenate([[0, 1], 1 + np.cumsum(counts)])
    faces = [(0, 1 + k, 1 + (k + 1) % counts[0]) for k in range(counts[0])]
    for ring in range(1, len(counts)):
        m, n = counts[ring - 1], counts[ring]
        inner, outer = first[ring], first[ring + 1]
        j = k = 0
        while j < m or k < n:  # step along whichever ring has its next point first
            a, b = inner + j % m, outer + k % n
            if k < n and (j >= m or (k + turns[ring] + 1) / n < (j + turns[ring - 1] + 1) / m):
                faces.append((a, b, outer + (k + 1) % n))
                k += 1
            else:
                faces.append((a, b, inner + (j + 1) % m))
                j += 1
    xy, tri = np.concatenate(points), np.array(faces)
    side, other = xy[tri[:, 1]] - xy[tri[:, 0]], xy[tri[:, 2]] - xy[tri[:, 0]]
    clockwise = side[:, 0] * other[:, 1] - side[:, 1] * other[:, 0] < 0
    tri[clockwise] = tri[clockwise][:, [0, 2, 1]]
    return xy, tri


def extruded(xy: Floats, triangles: NDArray[np.int64], z: Floats) -> ipc.TetMesh:
    """Prisms above the triangles between the rising heights ``z`` [m], each cut into three tetrahedra.

    A side of a prism is cut from its vertex of lower index below to the one of higher index above, so neighbours agree.
    """
    n = len(xy)
    vertices = np.concatenate([np.column_stack([xy, np.full(n, height)]) for height in z])
    a, b, c = np.sort(triangles, axis=1).T
    layer = np.concatenate([np.stack(t, axis=1) for t in ((a, b, c, c + n), (a, b, b + n, c + n), (a, a + n, b + n, c + n))])
    tets = np.concatenate([layer + k * n for k in range(len(z) - 1)])
    corners = vertices[tets]
    negative = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    tets[negative] = tets[negative][:, [0, 1, 3, 2]]
    return ipc.TetMesh(vertices, tets)


def growing(start: float, cell: float, growth: float, reach: float) -> Floats:
    """Coordinates after ``start`` up to ``reach`` [m]: the first cell is near ``cell`` · ``growth``, each ``growth`` times the last."""
    line = [0.0]
    while line[-1] < reach - start:
        cell *= growth
        line.append(line[-1] + cell)
    return start + np.array(line[1:]) * ((reach - start) / line[-1])


def round_block(
    fine: Floats, counts: Sequence[int], depth: Floats, growth: float, reach: float, straight: int = 0
) -> tuple[ipc.TetMesh, NDArray]:
    """A cylinder of radius and height ``reach`` [m] with its upper side at z = 0, and its vertices on the side and below.

    Args:
        fine: radii of the rings that are given [m]; further ones grow from the last.
        counts: points of each of these rings; further ones have as many as their cells are wide, but no fewer than 24.
        depth: depths of the layers that are given [m], from 0; further ones grow from the last.
        growth: ratio of one cell to the one before it.
        reach: [m].
        straight: see :func:`ring_plan`.
    """
    radii = np.concatenate([fine, growing(fine[-1], fine[-1] - fine[-2], growth, reach)])
    steps = np.diff(radii, prepend=0.0)[len(fine) :]
    outer = [min(counts[-1], max(24, round(2 * np.pi * r / h))) for r, h in zip(radii[len(fine) :], steps, strict=True)]
    xy, triangles = ring_plan(radii, [*counts, *outer], straight)
    z = np.concatenate([depth, growing(depth[-1], depth[-1] - depth[-2], growth, reach)])
    mesh = extruded(xy, triangles, -z[::-1])
    v = mesh.vertices
    return mesh, np.flatnonzero((np.hypot(v[:, 0], v[:, 1]) > reach * (1 - 1e-9)) | (v[:, 2] < -reach * (1 - 1e-9)))


def even_block(contact: float, cells: int, growth: float, reach: float) -> tuple[ipc.TetMesh, NDArray]:
    """For a sphere: even cells, ``cells`` to the ``contact`` radius [m], to 1.3 times that radius and depth."""
    n = round(1.3 * cells)
    even = contact / cells * np.arange(n + 1)
    return round_block(even[1:], [6 * (k + 1) for k in range(n)], even, growth, reach)


def rim_block(contact: float, cells: int, growth: float, reach: float) -> tuple[ipc.TetMesh, NDArray]:
    """For a punch: a ring of the mesh lies under the rim, and cells shrink towards it as the root of their distance.

    The stress at the rim goes as the inverse root of the distance; ``cells`` is their number from the axis to the rim. The polygon that
    is the rim encloses the area of the circle of radius ``contact`` [m].
    """
    squares = (np.arange(cells + 1) / cells) ** 2
    squares_out = squares[1:][squares[1:] < 0.8]
    around = round(2 * np.pi * cells)
    inner = contact * (1 - squares[-2::-1])
    counts = [max(6, round(around * r / contact)) for r in inner] + [around] * len(squares_out)
    fine = np.concatenate([inner, contact * (1 + squares_out)]) * equal_area(around)
    return round_block(fine, counts, contact * squares[squares < 1.3], growth, reach, cells - 1)


def equal_area(corners: int) -> float:
    """By how much the corners of a polygon lie outside the circle of the same area."""
    return float((2 * np.pi / corners / np.sin(2 * np.pi / corners)) ** 0.5)


def flat_tool(contact: float, cells: int) -> ipc.TriMesh:
    """A disc facing down with the rim of :func:`rim_block`."""
    around = round(2 * np.pi * cells)
    share = np.arange(1, 2 * cells + 1) / (2 * cells)
    xy, triangles = ring_plan(contact * equal_area(around) * share, [max(6, round(around * s)) for s in share], 2 * cells - 1)
    return ipc.TriMesh(np.column_stack([xy, np.zeros(len(xy))]).astype(np.float64), triangles[:, ::-1])


def ball_tool(width: float, rings: int, radius: float, inscribed: bool = False) -> ipc.TriMesh:
    """The lower cap of a sphere of ``radius``, out to ``width`` [m]; its lowest point would be the origin.

    Triangles with their corners on the sphere lie inside it; the cap is lowered by the mean of what they miss, unless ``inscribed``.
    """
    xy, triangles = ring_plan(width * np.arange(1, rings + 1) / rings, [6 * (k + 1) for k in range(rings)])
    corners = xy[triangles]
    sides = ((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=(1, 2))
    # Over a triangle with sides l the chord of x²/(2R) is higher than it by Σ l²/(24 R) in the mean.
    missed = 0.0 if inscribed else float(sides.mean()) / (24 * radius)
    z = radius - np.sqrt(radius**2 - (xy**2).sum(axis=1)) - missed
    return ipc.TriMesh(np.column_stack([xy, z]).astype(np.float64), triangles[:, ::-1])
