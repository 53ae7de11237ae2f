"""Closed triangle surfaces of an object's parts, for a solver that collides triangles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import ipc
from raytac.errors import InputError
from raytac.shapes.facets import SAG, around, coarse_relief, grid_facets
from raytac.shapes.joined_surface import joined_surface
from raytac.shapes.part import Part

__all__ = ["enclosed_volume", "object_surface", "part_surface"]


def object_surface(parts: Sequence[Part], sag: float = SAG) -> ipc.TriMesh:
    """Surfaces of all parts in one mesh, object frame [m].

    Parts that are ``joined`` to the first one make one closed surface with it; others that overlap keep the walls inside each other.

    Raises:
        InputError: no parts, a ``plane``, which has no closed surface, or joined parts of a shape that ``joined_surface`` does not know.
    """
    if not parts:
        raise InputError("parts", value=(), rule="an object without parts has no surface")
    if any(part.joined for part in parts):
        return joined_surface(parts, sag)
    vertices, faces, start = [], [], 0
    for part in parts:
        surface = part_surface(part, sag)
        pose = part.object_from_part
        vertices.append(surface.vertices @ pose[:3, :3].T + pose[:3, 3])
        faces.append(surface.faces + start)
        start += len(surface.vertices)
    return ipc.TriMesh(np.concatenate(vertices), np.concatenate(faces))


def part_surface(part: Part, sag: float = SAG) -> ipc.TriMesh:
    """One part as triangles, part frame [m], counter-clockwise from outside, closed unless the part is an open mesh.

    Curved parts are inscribed: their vertices lie on them, their facets up to ``sag`` [m] inside (with at least 16 and at most 256
    facets around). A relief gets facets 0.2 mm apart, closed by its plane z = 0.

    Raises:
        InputError: a ``plane``, which has no closed surface.
    """
    size = part.size
    if part.kind == "mesh":
        assert part.vertices is not None and part.faces is not None
        return ipc.TriMesh(part.vertices, part.faces)
    if part.kind == "sphere":
        return _ball(np.full(3, size[0]), sag)
    if part.kind == "ellipsoid":
        return _ball(np.asarray(size), sag)
    if part.kind == "box":
        corners = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)], float)
        return ipc.TriMesh((2.0 * corners - 1.0) * size, _BOX)
    if part.kind == "cylinder":
        return _turned([(size[0], -size[1]), (size[0], size[1])], sag)
    if part.kind == "capsule":
        angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 2 * (around(size[0], sag) // 4) + 1)[1:-1]
        shift = np.where(angle < 0.0, -size[1], size[1])
        profile = np.stack([size[0] * np.cos(angle), size[0] * np.sin(angle) + shift], axis=1)
        ends = (-size[1] - size[0], size[1] + size[0])
        equator = np.flatnonzero(np.abs(angle) < 1e-9)[0]
        profile = np.insert(profile, equator, (size[0], -size[1]), axis=0)
        return _turned(profile, sag, ends)
    if part.kind == "cone":
        return _turned(_cone_profile(size, sag), sag, (0.0, size[1]))
    if part.kind == "torus":
        return _ring(size, sag)
    if part.kind == "relief":
        return _relief(part)
    raise InputError("kind", value=part.kind, rule="has no closed surface that can be collided")


_BOX = np.array(
    [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]]
)  # fmt: skip


def _ball(radii: np.ndarray, sag: float) -> ipc.TriMesh:
    """An icosphere stretched to three radii [m]; symmetric in its three planes."""
    # An edge of 1.05 r / 2ⁿ lies e² / 8r inside, and a facet's middle a third more than that.
    levels = np.ceil(0.5 * np.log2(0.184 * float(radii.max()) / sag))
    ball = ipc.icosphere(1.0, int(np.clip(levels, 2, 5)))
    return ipc.TriMesh(ball.vertices * radii, ball.faces)


def _turned(
    profile: Sequence[tuple[float, float]] | np.ndarray, sag: float, ends: tuple[float, float] | None = None
) -> ipc.TriMesh:
    """A solid of revolution about z from its (radius, z) from low to high; ``ends`` are z of the poles, else the ends are flat."""
    rings = np.asarray(profile, float)
    count = around(float(rings[:, 0].max()), sag)
    angle = 2.0 * np.pi * np.arange(count) / count
    low, high = ends if ends is not None else (rings[0, 1], rings[-1, 1])
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    body = [np.column_stack([radius * circle, np.full(count, z)]) for radius, z in rings]
    vertices = np.concatenate([*body, [[0.0, 0.0, low], [0.0, 0.0, high]]])
    here, after = np.arange(count), (np.arange(count) + 1) % count
    faces = []
    for ring in range(len(rings) - 1):
        a, b, c, d = (start + ring * count for start in (here, after, here + count, after + count))
        faces += [np.stack([a, b, d], 1), np.stack([a, d, c], 1)]
    below, above = len(vertices) - 2, len(vertices) - 1
    last = (len(rings) - 1) * count
    faces += [np.stack([after, here, np.full(count, below)], 1), np.stack([here + last, after + last, np.full(count, above)], 1)]
    return ipc.TriMesh(vertices, np.concatenate(faces))


def _cone_profile(size: tuple[float, ...], sag: float) -> np.ndarray:
    """(radius, z) of the rounded cone without its poles: the tip's ball up to where the flank touches it, then the rim."""
    radius, height, tip = size
    if tip == 0.0:
        return np.array([[radius, height]])
    half = np.arctan2(radius, height - tip) - np.arcsin(tip / np.hypot(radius, height - tip))
    angle = np.linspace(0.0, 0.5 * np.pi - half, max(around(tip, sag) // 4, 4) + 1)[1:]
    ball = np.stack([tip * np.sin(angle), tip * (1.0 - np.cos(angle))], axis=1)
    return np.concatenate([ball, [[radius, height]]])


def _ring(size: tuple[float, ...], sag: float) -> ipc.TriMesh:
    major, minor = size
    turns, across = around(major + minor, sag), around(minor, sag)
    u, v = 2.0 * np.pi * np.arange(turns) / turns, 2.0 * np.pi * np.arange(across) / across
    rho, z = major + minor * np.cos(v)[None, :], minor * np.sin(v)[None, :]
    vertices = np.stack([rho * np.cos(u)[:, None], rho * np.sin(u)[:, None], np.broadcast_to(z, (turns, across))], axis=-1)
    index = np.arange(turns * across).reshape(turns, across)
    a, b, c, d = (m.ravel() for m in (index, np.roll(index, -1, 0), np.roll(index, -1, 1), np.roll(index, (-1, -1), (0, 1))))
    return ipc.TriMesh(vertices.reshape(-1, 3), np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]))


def _relief(part: Part) -> ipc.TriMesh:
    """The relief's map read at a wider spacing, as far as it rises, and closed by the plane behind it."""
    x, elevation = coarse_relief(part)
    n = len(x)
    front = np.stack([*np.meshgrid(x, x), -elevation], axis=-1).reshape(-1, 3)
    facets = grid_facets(n)
    risen = front[:, 2] < 0.0
    back_of = np.where(risen, np.arange(n * n) + n * n, np.arange(n * n))
    back = front * [1.0, 1.0, 0.0]
    # Facets with all corners at z = 0 would lie on their own backs.
    rising = facets[risen[facets].any(axis=1)]
    faces = np.concatenate([rising, back_of[rising][:, ::-1]])
    used, faces = np.unique(faces, return_inverse=True)
    return ipc.TriMesh(np.concatenate([front, back])[used], faces.reshape(-1, 3))


def enclosed_volume(surface: ipc.TriMesh) -> float:
    """Volume [m³] that a closed surface bounds (divergence theorem); positive where its faces look outwards."""
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)
