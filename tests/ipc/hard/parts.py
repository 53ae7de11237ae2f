"""Parts of the larger scenes: balls, links, rings, threads, gears, blades and channels, all made from mapped grids. Lengths [m]."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

import ipc
from tests.ipc.hard.shapes import as_surface, pyramid, wedge

Floats = NDArray[np.float64]
Place = Callable[[Floats, Floats, Floats], Sequence[Floats]]

_ONE_PLACE = 1e-9
"""Vertices of a mapped grid closer than this are one [m]."""


def mapped(x: ArrayLike, y: ArrayLike, z: ArrayLike, place: Place) -> ipc.TetMesh:
    """The grid of three coordinate lists, moved by ``place``; sides that come to lie on each other are joined, and cells without a
    volume are left out."""
    grid = ipc.box_mesh(x, y, z)
    v = np.stack(np.broadcast_arrays(*place(*grid.vertices.T)), axis=1)
    _, first, joined = np.unique(np.round(v / _ONE_PLACE), axis=0, return_index=True, return_inverse=True)
    tets = joined.reshape(-1)[grid.tets]
    tets = tets[(np.diff(np.sort(tets, axis=1), axis=1) > 0).all(axis=1)]
    v = v[first]
    edges = v[tets][:, 1:] - v[tets][:, :1]
    inside_out = np.linalg.det(edges) < 0
    tets[inside_out] = tets[inside_out][:, [0, 1, 3, 2]]
    return ipc.TetMesh(v, tets)


def _round(u: Floats, v: Floats) -> tuple[Floats, Floats]:
    """A square of half side 1 as a disc of radius 1."""
    longest, size = np.maximum(np.abs(u), np.abs(v)), np.hypot(u, v)
    share = np.where(size > 0, longest / np.maximum(size, 1e-300), 1.0)
    return u * share, v * share


def ball(radius: float, cells: int = 4) -> ipc.TetMesh:
    """A ball about the origin, of a cube whose sides bulge."""
    line = np.linspace(-1, 1, cells + 1)

    def place(x: Floats, y: Floats, z: Floats) -> tuple[Floats, ...]:
        p = np.stack([x, y, z])
        longest, size = np.abs(p).max(axis=0), np.linalg.norm(p, axis=0)
        return tuple(radius * p * np.where(size > 0, longest / np.maximum(size, 1e-300), 1.0))

    return mapped(line, line, line, place)


def link(radius: float, tube: float, around: int = 12) -> ipc.TetMesh:
    """A torus about the y axis: ``radius`` of the middle line and of the ``tube``."""
    line = np.array([-1.0, 0.0, 1.0])

    def place(u: Floats, v: Floats, phi: Floats) -> tuple[Floats, ...]:
        out, along = _round(u, v)
        r = radius + tube * out
        return r * np.cos(phi), tube * along, r * np.sin(phi)

    return mapped(line, line, np.linspace(0, 2 * math.pi, around + 1), place)


def ring(inner: float, outer: Callable[[Floats], Floats], height: float, around: int) -> ipc.TetMesh:
    """A ring about the z axis from the bore's radius to the radius ``outer(φ)``, a cell thick; about z = 0."""

    def place(share: Floats, phi: Floats, z: Floats) -> tuple[Floats, ...]:
        r = inner + share * (outer(phi) - inner)
        return r * np.cos(phi), r * np.sin(phi), z

    return mapped([0, 1], np.linspace(0, 2 * math.pi, around + 1), [-height / 2, height / 2], place)


def cylinder(radius: float, length: float, around: int = 16) -> ipc.TriMesh:
    """A closed cylinder about the z axis, its middle at the origin."""

    def place(share: Floats, phi: Floats, z: Floats) -> tuple[Floats, ...]:
        return share * radius * np.cos(phi), share * radius * np.sin(phi), z

    return as_surface(mapped([0, 1], np.linspace(0, 2 * math.pi, around + 1), [-length / 2, length / 2], place))


def gear(teeth: int, radius: float, depth: float, bore: float, height: float, phase: float = 0.0) -> ipc.TetMesh:
    """A wheel with ``teeth`` waves of ±``depth`` about ``radius``; one has its crest at the angle ``phase``."""
    return ring(bore, lambda phi: radius + depth * np.cos(teeth * (phi - phase)), height, 6 * teeth)


def thread(radius: float, depth: float, pitch: float, phi: Floats, z: Floats) -> Floats:
    """Radius of a right-handed thread, waves of ±``depth``."""
    return radius + depth * np.cos(2 * math.pi * z / pitch - phi)


def bolt(radius: float, depth: float, pitch: float, length: float, around: int = 16) -> ipc.TetMesh:
    """A threaded rod about the z axis, its middle at the origin."""
    rows = round(8 * length / pitch)

    def place(share: Floats, phi: Floats, z: Floats) -> tuple[Floats, ...]:
        r = share * thread(radius, depth, pitch, phi, z)
        return r * np.cos(phi), r * np.sin(phi), z

    return mapped([0, 1], np.linspace(0, 2 * math.pi, around + 1), np.linspace(-length / 2, length / 2, rows + 1), place)


def nut(radius: float, depth: float, pitch: float, length: float, width: float, around: int = 16) -> ipc.TetMesh:
    """A square block of that ``width`` with a threaded hole along the z axis."""
    rows = round(8 * length / pitch)

    def place(share: Floats, phi: Floats, z: Floats) -> tuple[Floats, ...]:
        hole = thread(radius, depth, pitch, phi, z)
        side = width / 2 / np.maximum(np.abs(np.cos(phi)), np.abs(np.sin(phi)))
        r = hole + share * (side - hole)
        return r * np.cos(phi), r * np.sin(phi), z

    return mapped([0, 1], np.linspace(0, 2 * math.pi, around + 1), np.linspace(-length / 2, length / 2, rows + 1), place)


def voussoirs(count: int, radius: float, thickness: float, depth: float, gap: float) -> list[ipc.TetMesh]:
    """Blocks of half a round arch over the x axis, ``gap`` apart from each other and from the floor z = 0."""
    step, blocks = math.pi / count, []
    for k in range(count):
        angle = (k + 0.5) * step
        out = gap / (2 * math.sin(step / 2))

        def place(r: Floats, phi: Floats, y: Floats, a: float = angle, s: float = out) -> tuple[Floats, ...]:
            return r * np.cos(phi) + s * math.cos(a), y, r * np.sin(phi) + s * math.sin(a) + gap / 2

        radii = [radius - thickness / 2, radius + thickness / 2]
        blocks.append(mapped(radii, [k * step, (k + 1) * step], [-depth / 2, depth / 2], place))
    return blocks


def together(*surfaces: ipc.TriMesh) -> ipc.TriMesh:
    """Several surfaces as one."""
    start = np.cumsum([0, *(len(s.vertices) for s in surfaces[:-1])])
    faces = [s.faces + k for s, k in zip(surfaces, start, strict=True)]
    return ipc.TriMesh(np.concatenate([s.vertices for s in surfaces]), np.concatenate(faces))


def shifted(surface: ipc.TriMesh, by: ArrayLike) -> ipc.TriMesh:
    """The same surface elsewhere [m]."""
    return ipc.TriMesh(surface.vertices + np.asarray(by, float), surface.faces)


def points(count: int, spacing: float, height: float) -> ipc.TriMesh:
    """A bed of ``count`` × ``count`` nails, a fifth as wide as high, whose tips are at z = 0."""
    nail = as_surface(pyramid(True, height))
    thin = ipc.TriMesh(nail.vertices * (0.2, 0.2, 1.0), nail.faces)
    at = spacing * (np.arange(count) - (count - 1) / 2)
    return together(*(shifted(thin, (x, y, 0)) for x in at for y in at))


def knives(count: int, spacing: float, length: float, height: float) -> ipc.TriMesh:
    """Blades along x, a fifth as thick as high, whose edges are at z = 0."""
    blade = as_surface(wedge(True, length, 0.2 * height, height))
    return together(*(shifted(blade, (0, spacing * (k - (count - 1) / 2), 0)) for k in range(count)))


def channel(levels: Sequence[tuple[float, float]]) -> ipc.TriMesh:
    """An open square tube about the z axis, of half widths [m] at heights [m]; its triangles look inwards."""
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    v = np.concatenate([np.column_stack([half * corner, np.full(4, z)]) for half, z in levels])
    faces = []
    for row in range(len(levels) - 1):
        for k in range(4):
            a, b = 4 * row + k, 4 * row + (k + 1) % 4
            faces += [(a, a + 4, b), (b, a + 4, b + 4)]
    return ipc.TriMesh(v, np.array(faces))
