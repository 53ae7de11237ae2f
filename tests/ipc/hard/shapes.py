"""The bodies of the hard cases: spikes, wedges, holes, cracks, sheets and cubes of few elements. Lengths [m]."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import ipc
from ipc.bodies import rotation_matrix
from ipc.meshes import surface_of

SIZE = 0.02
"""Size of the bodies of the sharp cases [m]."""


def pyramid(up: bool, size: float = SIZE) -> ipc.TetMesh:
    """Two tetrahedra: a square base of ``size`` and a tip as far above or below it; the tip is at the origin."""
    h = size / 2
    z = -size if up else size
    v = np.array([[-h, -h, z], [h, -h, z], [h, h, z], [-h, h, z], [0.0, 0.0, 0.0]])
    t = np.array([[0, 1, 2, 4], [0, 2, 3, 4]]) if up else np.array([[0, 2, 1, 4], [0, 3, 2, 4]])
    return ipc.TetMesh(v, t)


def wedge(up: bool, size: float = SIZE, width: float | None = None, height: float | None = None) -> ipc.TetMesh:
    """Three tetrahedra: a base of ``size`` along x and ``width`` and, ``height`` above or below it, an edge along x.

    The middle of the edge is at the origin; width and height are ``size`` unless given.
    """
    h, w = size / 2, (width or size) / 2
    z = -(height or size) if up else (height or size)
    v = np.array([[-h, -w, z], [h, -w, z], [h, w, z], [-h, w, z], [-h, 0.0, 0.0], [h, 0.0, 0.0]])
    t = np.array([[0, 1, 3, 4], [1, 2, 3, 5], [1, 3, 4, 5]])
    negative = np.linalg.det(v[t][:, 1:] - v[t][:, :1]) < 0
    t[negative] = t[negative][:, [0, 2, 1, 3]]
    return ipc.TetMesh(v, t)


def notched_block(length: float, width: float) -> ipc.TriMesh:
    """A block along x with a groove of walls at 45°, ``width`` wide and half as deep, whose lowest line is z = 0; closed.

    The block is twice as wide as the groove and as high as it is wide.
    """
    d = width / 2
    profile = np.array([(-width, -d), (0, -d), (width, -d), (width, d), (d, d), (0, 0), (-d, d), (-width, d)])
    n = len(profile)
    v = np.concatenate([np.column_stack([np.full(n, x), profile]) for x in (-length / 2, length / 2)])
    side = [(k, (k + 1) % n, n + (k + 1) % n) for k in range(n)] + [(k, n + (k + 1) % n, n + k) for k in range(n)]
    end = np.array([(0, 1, 5), (0, 5, 6), (0, 6, 7), (1, 2, 5), (2, 4, 5), (2, 3, 4)])
    return ipc.TriMesh(v, np.concatenate([np.array(side), end[:, ::-1], end + n]))


def as_surface(mesh: ipc.TetMesh) -> ipc.TriMesh:
    """The boundary of tetrahedra."""
    used, local = np.unique(surface_of(mesh.tets), return_inverse=True)
    return ipc.TriMesh(mesh.vertices[used], local.reshape(-1, 3))


def hole(size: float = 1.5 * SIZE) -> ipc.TriMesh:
    """An open funnel of four triangles whose lowest point is the origin; its walls are as steep as those of :func:`pyramid`."""
    h = size / 2
    v = np.array([[-h, -h, size], [h, -h, size], [h, h, size], [-h, h, size], [0.0, 0.0, 0.0]])
    return ipc.TriMesh(v, np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])[:, ::-1])


def crack(size: float = 1.5 * SIZE) -> ipc.TriMesh:
    """An open groove of two rectangles along x whose lowest line is z = 0; its walls are as steep as those of :func:`wedge`."""
    h = size / 2
    v = np.array([[-h, -h, size], [h, -h, size], [h, h, size], [-h, h, size], [-h, 0.0, 0.0], [h, 0.0, 0.0]])
    return ipc.TriMesh(v, np.array([[0, 4, 1], [1, 4, 5], [2, 5, 3], [3, 5, 4]]))


def sheet(cells: int, size: float = 4 * SIZE) -> ipc.TriMesh:
    """A flat square of many triangles at z = 0: every inner edge could catch what slides over it."""
    line = np.linspace(-size / 2, size / 2, cells + 1)
    x, y = np.meshgrid(line, line)
    v = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]).astype(np.float64)
    n = cells + 1
    i, j = np.meshgrid(np.arange(cells), np.arange(cells))
    a = (j * n + i).ravel()
    return ipc.TriMesh(v, np.concatenate([np.stack([a, a + 1, a + n + 1], 1), np.stack([a, a + n + 1, a + n], 1)]))


def cube(size: float = SIZE, cells: int = 1) -> ipc.TetMesh:
    """A cube about the z axis that stands on z = 0."""
    line = np.linspace(-size / 2, size / 2, cells + 1)
    return ipc.box_mesh(line, line, line + size / 2)


def bar(width: float, height: float, length: float, cells: tuple[int, int, int]) -> ipc.TetMesh:
    """A box along x from −``length``/2 to ``length``/2, centred in y and z."""
    sides = (length, width, height)
    x, y, z = (np.linspace(-side / 2, side / 2, n + 1) for side, n in zip(sides, cells, strict=True))
    return ipc.box_mesh(x, y, z)


def moved(mesh: ipc.TetMesh, by: tuple[float, float, float], turn: NDArray | None = None) -> ipc.TetMesh:
    """The same tetrahedra, turned about the origin by a quaternion (w, x, y, z) and then moved [m]."""
    vertices = mesh.vertices if turn is None else mesh.vertices @ rotation_matrix(turn).T
    return ipc.TetMesh(vertices + np.array(by), mesh.tets)


def about(axis: tuple[float, float, float], angle: float) -> NDArray[np.float64]:
    """The quaternion (w, x, y, z) of a turn by ``angle`` [rad] about ``axis``."""
    unit = np.array(axis) / np.linalg.norm(axis)
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * unit)])


def then(first: NDArray, second: NDArray) -> tuple[float, float, float, float]:
    """The quaternion (w, x, y, z) of the turn ``first`` and then ``second``."""
    w = second[0] * first[0] - second[1:] @ first[1:]
    x, y, z = second[0] * first[1:] + first[0] * second[1:] + np.cross(second[1:], first[1:])
    return float(w), float(x), float(y), float(z)


def dented_ball(radius: float) -> ipc.TriMesh:
    """A coarse ball whose lower cap is turned inwards."""
    ball = ipc.icosphere(radius, 1)
    v = ball.vertices.copy()
    v[:, 2] = np.where(v[:, 2] < -radius / 2, -radius - v[:, 2], v[:, 2])
    return ipc.TriMesh(v, ball.faces)


def fork() -> ipc.TetMesh:
    """A slotted block of 20 mm: two arms, 4 mm apart, on a foot of 4 mm."""
    line = np.array([-0.01, -0.006, -0.002, 0.002, 0.006, 0.01])
    mesh = ipc.box_mesh(line, [-0.004, 0.004], np.linspace(0, 0.02, 6))
    middle = mesh.vertices[mesh.tets].mean(axis=1)
    keep = ~((np.abs(middle[:, 0]) < 0.002) & (middle[:, 2] > 0.004))
    used, tets = np.unique(mesh.tets[keep], return_inverse=True)
    return ipc.TetMesh(mesh.vertices[used], tets.reshape(-1, 4))
