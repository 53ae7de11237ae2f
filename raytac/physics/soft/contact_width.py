"""Width of a contact in cells of the soft pad's mesh, on which the force's accuracy depends."""

from __future__ import annotations

import warnings

import numpy as np

from raytac.gel.coat_mesh import CoatMesh
from raytac.gel.components import find_runs, join_runs, span
from raytac.gel.interpolate import cell_lengths
from raytac.gel.surface import GelSurface
from raytac.specs import PressScene
from raytac.specs.press import PADS

LEAST_CELLS = 6.0
"""Least number of cells across a contact for an accurate force: three to its radius."""
_SMALL = 0.1
"""Share of the contact's area below which patches together do not count: specks at a rim."""


class NarrowContactWarning(UserWarning):
    """A contact is too narrow for the pad's cells: its force and traction are inaccurate."""


def cells_across(surface: GelSurface, mesh: CoatMesh) -> np.ndarray:
    """Width of the narrowest contact patch in cells of the coat, (B,); NaN without contact.

    A patch is an 8-connected piece of ``surface.contact``; its width is the diameter of its largest inscribed circle, over the longer
    side of the coat's cell at that circle's centre. The narrowest is the first at which patches, in order of width, make up a tenth of
    the area. The width is accurate within two nodes of the surface's grid.
    """
    return np.array([_narrowest(contact, surface, mesh) for contact in surface.contact])


def holds_force(scene: PressScene, stage: int) -> bool:
    """True if a force is prescribed at a stage: the total is then right on every mesh."""
    indents = [s for s in scene.trajectory[: stage + 1] if s.kind == "indent"]
    return bool(indents) and indents[-1].force is not None


def warn_if_narrow(cells: np.ndarray, level: object, *, stacklevel: int) -> bool:
    """Warn of the narrowest of B contacts if it has fewer than ``LEAST_CELLS`` across.

    Returns True if it has.

    Args:
        cells: from ``cells_across``, shape (B,).
        level: level of ``PADS`` of the mesh, or something else for a custom mesh.
        stacklevel: as for ``warnings.warn``, seen from here.
    """
    least = float(np.nanmin(cells, initial=np.inf))
    if not least < LEAST_CELLS:
        return False
    level = level if isinstance(level, str) else "own"
    finer = PADS[PADS.index(level) + 1 :] if level in PADS else ()
    remedy = f"choose level={finer[0]!r}" if finer else "no level is finer: give a finer mesh of your own as level"
    where = f" in environment {int(np.nanargmin(cells))}" if len(cells) > 1 else ""
    warnings.warn(
        f"level = {level!r}: the contact{where} is {least:.1f} cells across; for a force or traction to be trusted it must be at least "
        f"{LEAST_CELLS:g}, three to its radius, and with fewer they may be off at a given depth: {remedy}, or press to a force",
        NarrowContactWarning,
        stacklevel=stacklevel + 1,
    )
    return True


def _narrowest(contact: np.ndarray, surface: GelSurface, mesh: CoatMesh) -> float:
    if not contact.any():
        return float("nan")
    box = span(contact.any(axis=1)), span(contact.any(axis=0))
    contact, x, y = contact[box], surface.grid.x[box[1]], surface.grid.y[box[0]]
    row, start, stop = find_runs(contact[None])
    piece = join_runs(row, start, stop, len(y))
    # Runs lie in the order of the nodes, row by row.
    of_node, (rows, columns) = np.repeat(piece, stop - start), contact.nonzero()
    radius = _inscribed(contact, surface.grid.pitch)[rows, columns]
    order = np.lexsort((-radius, of_node))
    _, first, count = np.unique(of_node[order], return_index=True, return_counts=True)
    centre = order[first]
    cell = np.maximum(cell_lengths(mesh.lines_x, x[columns[centre]]), cell_lengths(mesh.lines_y, y[rows[centre]]))
    # Distances reach to the first node out of contact, so a strip comes out up to two nodes too wide; a disc's centre lies between nodes,
    # which takes as much off.
    width = 2.0 * radius[centre] / cell
    by_width = np.argsort(width)
    area = np.cumsum(count[by_width])
    return float(width[by_width[np.searchsorted(area, _SMALL * area[-1])]])


def _inscribed(mask: np.ndarray, pitch: tuple[float, float]) -> np.ndarray:
    """Distance from every node of a mask to the nearest outside it [m]; 0 outside the mask.

    Exact, one axis after the other (Felzenszwalb and Huttenlocher, Distance transforms of sampled functions, 2012, without their
    envelopes: contacts are some dozens of nodes wide).
    """
    inside = np.pad(mask, 1)
    line = np.arange(len(inside))[:, None]
    before = np.maximum.accumulate(np.where(inside, 0, line), axis=0)
    after = np.minimum.accumulate(np.where(inside, len(line) - 1, line)[::-1], axis=0)[::-1]
    along = (pitch[1] * np.minimum(line - before, after - line)) ** 2
    square = along.copy()
    for step in range(1, inside.shape[1]):
        beside = (step * pitch[0]) ** 2
        if beside >= square.max():
            break
        np.minimum(square[:, step:], along[:, :-step] + beside, out=square[:, step:])
        np.minimum(square[:, :-step], along[:, step:] + beside, out=square[:, :-step])
    return np.sqrt(square[1:-1, 1:-1])
