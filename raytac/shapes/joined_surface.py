"""Closed surfaces of objects whose parts are one solid: a coin and its relief, a plate and its pins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import ipc
from raytac.errors import InputError
from raytac.shapes.facets import SAG, around, coarse_relief, grid_facets
from raytac.shapes.part import Part

__all__ = ["joined_surface"]


def joined_surface(parts: Sequence[Part], sag: float = SAG) -> ipc.TriMesh:
    """The closed surface of a first part and those ``joined`` to its lower face, without walls between them, object frame [m].

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
    """The relief's facets over the whole disc, flat where nothing rises; around them the disc's wall, and its upper face.

    The facets' outline is a polygon of grid nodes around the disc, whose corners, drawn in to the disc, are those of the wall: every
    facet between the two lies in a sector of its own, so that none can cross another.
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
    follows = dict(zip(end[is_outline], start[is_outline], strict=True))
    if any(follows[one] != after for one, after in zip(outline, np.roll(outline, -1), strict=True)):
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
    """Triangles (n, 3) each between two closed rings of as many vertices, ``low`` counter-clockwise seen from the side of ``high``."""
    low_next, high_next = np.roll(low, -1), np.roll(high, -1)
    return [np.stack([low, low_next, high_next], 1), np.stack([low, high_next, high], 1)]


def _plate_with_pins(plate: Part, pins: Sequence[Part], sag: float) -> ipc.TriMesh:
    """The plate's lower face as squares, each with a hole whose rim is a pin's; the other faces meet the squares' corners."""
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
