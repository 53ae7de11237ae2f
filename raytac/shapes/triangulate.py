"""Closed triangle surfaces of an object's parts, for a solver that collides triangles.

Parts that are one solid (a coin and its relief, a plate and its pins) get one surface without walls between them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import ipc
from raytac.errors import InputError
from raytac.shapes.facets import SAG, around, coarse_relief, grid_facets
from raytac.shapes.part import Part


def object_surface(parts: Sequence[Part], sag: float = SAG) -> ipc.TriMesh:
    """Surfaces of all parts in one mesh, object frame [m].

    Parts that are ``joined`` to the first one make one closed surface with it; others that overlap keep the walls inside each other.

    Raises:
        InputError: no parts, a ``plane``, which has no closed surface, or joined parts other than a disc and its relief or a plate and
            its pins.
    """
    if not parts:
        raise InputError("parts", value=(), rule="an object without parts has no surface")
    if any(part.joined for part in parts):
        return _joined_surface(parts, sag)
    vertices, faces, start = [], [], 0
    for part in parts:
        surface = part_surface(part, sag)
        pose = part.object_from_part
        vertices.append(surface.vertices @ pose[:3, :3].T + pose[:3, 3])
        faces.append(surface.faces + start)
        start += len(surface.vertices)
    return ipc.TriMesh(np.concatenate(vertices), np.concatenate(faces))


def part_surface(part: Part, sag: float = SAG) -> ipc.TriMesh:
    """One part as triangles, part frame [m], closed unless the part is an open mesh.

    Curved parts are inscribed: their vertices lie on them, their facets up to ``sag`` [m] inside (with at least 16 and at most 256
    facets around). A relief gets facets 0.2 mm apart, closed by its plane z = 0.

    Raises ``InputError``: a ``plane``, which has no closed surface.
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
    """Solid of revolution about z from (radius, z), upwards; ``ends``: z of poles, else flat."""
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
    """(radius, z) of the rounded cone without its poles: the tip's ball, then the rim."""
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
    """The raised part of the relief's map at a wider spacing, closed by the plane behind it."""
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


def _joined_surface(parts: Sequence[Part], sag: float = SAG) -> ipc.TriMesh:
    """Closed surface of a first part and those ``joined`` to its lower face, object frame [m].

    Raises:
        InputError: anything but a disc under which lies one relief as wide, or a box whose lower face is divided into equal squares with
            an upright cylinder in the middle of each.
    """
    base, *others = parts
    kinds = {part.kind for part in others if part.joined}
    if base.kind == "cylinder" and len(others) == 1 and kinds == {"relief"}:
        return _disc_with_relief(base, others[0], sag)
    if base.kind == "box" and all(part.joined for part in others) and kinds == {"cylinder"}:
        return _plate_with_pins(base, others, sag)
    rule = "must be a disc and its relief, or a plate and its pins, to be joined to one surface"
    raise InputError("parts", value=[part.kind for part in parts], rule=rule)


def _disc_with_relief(disc: Part, relief: Part, sag: float) -> ipc.TriMesh:
    """The relief's facets over the disc, with the disc's wall and upper face.

    The facets' outline is a polygon of grid nodes around the disc. Its corners, projected onto the disc's rim, are those of the wall. Every
    facet between the two lies in a sector of its own, so none can cross another.
    """
    radius, height = disc.size[0], 2.0 * disc.size[1]
    x, elevation = coarse_relief(relief)
    n = len(x)
    grid = np.stack([*np.meshgrid(x, x), -elevation], axis=-1).reshape(-1, 3)
    inside = np.hypot(grid[:, 0], grid[:, 1]) < radius
    facets = grid_facets(n)
    facets = facets[inside[facets].any(axis=1)]
    start, end = facets.ravel(), np.roll(facets, -1, axis=1).ravel()
    is_outline = np.isin(start * n * n + end, end * n * n + start, invert=True)
    outline = start[is_outline]
    angle = np.arctan2(grid[outline, 1], grid[outline, 0])
    outline = outline[np.argsort(angle)]
    # Facets look down, so their outline runs clockwise from above.
    following = dict(zip(end[is_outline], start[is_outline], strict=True))
    if any(following[one] != after for one, after in zip(outline, np.roll(outline, -1), strict=True)):
        raise InputError("radius", value=radius, rule="of a disc must be much more than the spacing of its relief's facets")
    count = len(outline)
    direction = grid[outline, :2] / np.linalg.norm(grid[outline, :2], axis=1, keepdims=True)
    wall = direction * (radius - 0.5 * min(sag, 1e-3 * radius))
    rings = [np.column_stack([wall, np.full(count, z)]) for z in (0.0, height)]
    vertices = np.concatenate([grid, *rings, [[0.0, 0.0, height]]])
    lower, upper = n * n + np.arange(count), n * n + count + np.arange(count)
    faces = [facets, *_band(outline, lower), *_band(lower, upper)]
    faces.append(np.stack([upper, np.roll(upper, -1), np.full(count, len(vertices) - 1)], 1))
    used, faces = np.unique(np.concatenate(faces), return_inverse=True)
    return ipc.TriMesh(vertices[used], faces.reshape(-1, 3))


def _band(low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """Triangles (n, 3) between two closed rings; ``low`` counter-clockwise seen from ``high``."""
    low_next, high_next = np.roll(low, -1), np.roll(high, -1)
    return [np.stack([low, low_next, high_next], 1), np.stack([low, high_next, high], 1)]


def _plate_with_pins(plate: Part, pins: Sequence[Part], sag: float) -> ipc.TriMesh:
    """The plate's lower face: squares with a pin's rim as hole; other faces meet their corners."""
    (half_x, half_y, _), (radius, half_height) = plate.size, pins[0].size
    centres = np.array([pin.object_from_part[:2, 3] for pin in pins])
    columns, rows = (len(np.unique(np.round(centres[:, k], 12))) for k in (0, 1))
    pitch = 2.0 * half_x / columns
    count = around(radius, sag)
    # Pins that touch would share a line if their polygons had corners there.
    turn = 0.5 if pitch - 2.0 * radius < sag else 0.0
    angle = 2.0 * np.pi * (np.arange(count) + turn) / count
    rim = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    nodes = np.stack(np.meshgrid(np.linspace(-half_x, half_x, columns + 1), np.linspace(-half_y, half_y, rows + 1)), -1)
    index = np.arange(nodes.shape[0] * nodes.shape[1]).reshape(nodes.shape[:2])
    top = index[[0, 0, -1, -1], [0, -1, -1, 0]]  # its corners, counter-clockwise from above
    vertices = [np.concatenate([nodes.reshape(-1, 2), np.zeros((index.size, 1))], axis=1)]
    vertices.append(vertices[0][top] + [0.0, 0.0, 2.0 * plate.size[2]])
    upper = index.size + np.arange(4)
    faces = [np.array([upper[[0, 1, 2]], upper[[0, 2, 3]]])]
    for k, edge in enumerate((index[0], index[:, -1], index[-1, ::-1], index[::-1, 0])):
        faces.append(np.stack([edge[:-1], edge[1:], np.full(len(edge) - 1, upper[k])], 1))
        faces.append(np.array([[edge[-1], upper[(k + 1) % 4], upper[k]]]))
    # Every edge of a rim sees the corner of its quarter, and where two quarters meet, a side of the square sees their common corner.
    middle = angle + np.pi / count
    quarter = ((middle + 1e-9) // (0.5 * np.pi)).astype(int) % 4
    start = index.size + 4
    here, after = np.arange(count), (np.arange(count) + 1) % count
    for centre in centres:
        column, row = (round((centre[k] + half) / pitch - 0.5) for k, half in ((0, half_x), (1, half_y)))
        corner = index[
            [row + 1, row + 1, row, row], [column + 1, column, column, column + 1]
        ]  # of the quarters, counter-clockwise
        foot, end = start + here, start + count + here
        faces.append(np.stack([foot, foot[after], corner[quarter]], 1))
        turns = np.flatnonzero(quarter != quarter[after])
        faces.append(np.stack([foot[after[turns]], corner[quarter[after[turns]]], corner[quarter[turns]]], 1))
        faces += _band(end, foot)
        faces.append(np.stack([end[after], end, np.full(count, start + 2 * count)], 1))
        placed = rim + centre
        vertices += [np.column_stack([placed, np.full(count, z)]) for z in (0.0, -2.0 * half_height)]
        vertices.append(np.array([[*centre, -2.0 * half_height]]))
        start += 2 * count + 1
    return ipc.TriMesh(np.concatenate(vertices), np.concatenate(faces))


def enclosed_volume(surface: ipc.TriMesh) -> float:
    """Volume [m³] inside a closed surface (divergence theorem); > 0 with outward faces."""
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)
