"""Regions that a contact may cover: stiffness as flat punches, and the mean gap under them."""

from __future__ import annotations

import numpy as np

from raytac.physics.rigid.layer_response import LayerResponse, layer_response, reduced_modulus
from raytac.specs.sensor import GelpadSpec

PER_SIDE, PER_CORNER = 7, 5
"""Weights of a neighbour out of a region, beside a node and across, as 1 : 1/√2."""
CROSSING = np.pi / 8.0 / PER_SIDE
"""Perimeter per weight, in spacings of nodes.

It is Crofton's formula for lines of four directions: right on average, within 5 % for straight edges."""
FULL = 0.95
"""Area over that of the ellipse of the same second moments from which a region is one piece.

A rectangle has 0.955, an ellipse 1."""
OVAL = 0.92, 0.98
"""The same from and up to which the ellipse is shrunk to the region's own area."""
CROWDED = 0.3
"""Share by which what pieces add is less where they all but fill the ellipse.

Fitted to flat pieces on the layer: fields of pins, quarters of a punch, a plate with holes."""
_AT_EDGE = 1e-9
"""Nodes within this of an edge of the pad are on it [m]."""


def region_lines(
    gap: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    gelpad: GelpadSpec,
    highest: float = np.inf,
    levels: int = 1024,
    every: int = 16,
    cells: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stiffness k [N/m], k ⟨gap⟩ [N] and area [m²] of regions, (n,) each.

    The force at a depth δ is the greatest k δ − k ⟨gap⟩.

    They are half a node, which stands for a tip between nodes, and all where the gap is below one of ``levels`` up to ``highest`` [m],
    evenly spaced in their roots. The stiffness is computed of ``every``-th of them and follows the root of the area in between. Other
    arguments are those of ``LoadLaw``.
    """
    layer = layer_response(gelpad)
    step_x, step_y = x[1] - x[0], y[1] - y[0]
    highest = min(highest, layer.share.max() * gelpad.thickness)
    j, i = np.nonzero(gap < highest)
    g, x_near, y_near = gap[j, i], x[i], y[j]
    weight = (cells_of(x, y, gelpad) if cells is None else cells)[j, i]
    level = (np.sqrt(g / highest) * levels).astype(int)
    terms = (1.0, x_near, y_near, x_near**2, x_near * y_near, y_near**2, g)
    of_level = np.array([*(np.bincount(level, weight * term, levels) for term in terms), np.zeros(levels)])
    of_level[-1] = np.bincount(level, _crossings(gap, highest)[j, i], levels)
    perimeter = np.cumsum(of_level[-1]) * CROSSING * np.sqrt(step_x * step_y)
    filled = np.flatnonzero(of_level[0] > 0.0)
    last = np.append(np.diff(filled // every) > 0, True)  # of every group of levels
    *of_level, of_gap, _ = of_level[:, filled]
    of_gap /= of_level[0]
    # Over all nodes up to each level: number and means; the same times the gap.
    nodes, *first = np.cumsum(of_level, axis=1)
    cx, cy, xx, xy, yy = np.array(first) / nodes
    mean, gap_x, gap_y, gap_xx, gap_xy, gap_yy = np.cumsum(of_gap * of_level, axis=1) / nodes
    square = np.cumsum(of_gap**2 * of_level[0]) / nodes
    cell_x, cell_y = step_x**2 / 12.0, step_y**2 / 12.0
    xx, xy, yy = xx - cx**2 + cell_x, xy - cx * cy, yy - cy**2 + cell_y
    gap_xx += -2.0 * cx * gap_x + (cx**2 + cell_x) * mean
    gap_xy += -cx * gap_y - cy * gap_x + cx * cy * mean
    gap_yy += -2.0 * cy * gap_y + (cy**2 + cell_y) * mean
    gap_x, gap_y = gap_x - cx * mean, gap_y - cy * mean
    whole = step_x * step_y
    tip = np.sqrt(0.5 * whole / np.pi)
    (tip_stiffening, _, _), (_, moment, bend) = layer.at(np.array(tip)), layer.at(np.array(0.0))
    tip_stiffness = 2.0 * reduced_modulus(gelpad) * tip * float(tip_stiffening)
    computed = punches(nodes[last] * whole, perimeter[filled[last]], (xx[last], xy[last], yy[last]), gelpad)
    computed[0] /= np.sqrt(nodes[last])
    first_punch = tip_stiffness / np.sqrt(0.5), 1.0, 12.0 * float(moment) - 6.0, float(bend)
    at = np.append(0.0, np.sqrt(nodes[last]))
    per_root, joint, rim, bend = (
        np.interp(np.sqrt(nodes), at, np.append(one, more)) for one, more in zip(first_punch, computed, strict=True)
    )
    stiffness = per_root * np.sqrt(nodes)
    # Covariance of the gap with ρ², by the ellipse of the region's moments, and with the rank of the gap.
    determinant = xx * yy - xy**2
    bowl = 0.25 * (yy * gap_xx - 2.0 * xy * gap_xy + xx * gap_yy) / determinant - 0.5 * mean
    ranked, twice = (np.cumsum(of_gap * np.diff(nodes**n, prepend=0.0)) / nodes**n for n in (2, 3))
    # Share of the gap's variance that is smooth over the whole region: a tilt, or a paraboloid.
    variance = np.maximum(square - mean**2, 1e-30)
    tilt = (yy * gap_x**2 - 2.0 * xy * gap_x * gap_y + xx * gap_y**2) / (determinant * variance)
    smooth = np.minimum(np.maximum(tilt, 0.0) + (12.0 * bowl**2 / variance) ** 2, 1.0)
    within = 1.5 * (cell_x * yy + cell_y * xx) / determinant * 2.0 * bowl  # by the curvature within a cell
    under = mean + within + rim * (joint * bowl + (1.0 - joint**2) * (1.0 - smooth) * 0.5 * (ranked - mean))
    under += bend * (2.0 * twice - 3.0 * ranked + mean)
    offset = np.append(0.0, stiffness * np.maximum(under, 0.0))
    return np.append(tip_stiffness, stiffness), offset, whole * np.append(0.5, nodes)


def punches(area: np.ndarray, perimeter: np.ndarray, moments: tuple[np.ndarray, ...], gelpad: GelpadSpec) -> list[np.ndarray]:
    """Stiffness of flat punches [N/m], joint share, and 12 m − 6 and n of their pressure.

    The compliance of a punch is that of the ellipse of the same second ``moments`` (xx, xy, yy) [m²], as if the load were spread over all
    of it, and what pieces add that carry it alone. Pieces have the region's area over perimeter, N of radius b in all, and each stands in
    a cell of the ellipse's area over N:

        1/k = C(ellipse) + (C(b) − C(cell)) / N,   b = 2 A/P,   N = P² / (4π A)

    So a disc is a disc, pieces far apart add up, and in between they hinder each other. The joint share is C(ellipse) k.
    """
    layer = layer_response(gelpad)
    xx, xy, yy = moments
    half, apart = 0.5 * (xx + yy), np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    long, short = 2.0 * np.sqrt(half + apart), 2.0 * np.sqrt(np.maximum(half - apart, 1e-6 * half))
    disc = np.sqrt(area / np.pi)
    perimeter = np.maximum(perimeter, 2.0 * np.pi * disc)
    piece, pieces = 2.0 * area / perimeter, perimeter**2 / (4.0 * np.pi * area)
    filled = area / (np.pi * long * short)
    share = np.minimum(filled / FULL, 1.0)
    round_off = np.clip((filled - OVAL[0]) / (OVAL[1] - OVAL[0]), 0.0, 1.0)
    long, short = (np.sqrt(1.0 - round_off * (1.0 - filled)) * axis for axis in (long, short))  # an oval has its area
    cell = piece / np.sqrt(share)
    narrow = np.minimum(cell, np.maximum(short, piece))  # a cell is not wider than the ellipse
    whole = elliptic_compliance(long, short, layer, gelpad)
    added = elliptic_compliance(piece, piece, layer, gelpad) - elliptic_compliance(cell**2 / narrow, narrow, layer, gelpad)
    stiffness = 1.0 / (whole + (1.0 - CROWDED * share) * np.maximum(added, 0.0) / pieces)
    joint = whole * stiffness
    _, moment, bend = layer.at(joint * disc + (1.0 - joint) * piece)
    return [stiffness, joint, 12.0 * moment - 6.0, bend]


def elliptic_compliance(long: np.ndarray, short: np.ndarray, layer: LayerResponse, gelpad: GelpadSpec) -> np.ndarray:
    """Depth over force [m/N] of flat elliptic punches with half axes ``long`` >= ``short`` [m].

    On a half-space it is that of a disc with their arithmetic-geometric mean as radius. On a layer it is made up of those of discs
    with the long axis, the short one and their geometric mean, in shares that agree with that: a layer feels the load of a long punch
    only as far as it is thick.
    """
    ratio = short / long
    root = np.sqrt(ratio)
    means = 0.25 * (1.0 + ratio) + 0.5 * root
    mean = 0.5 * (means + np.sqrt(0.5 * (1.0 + ratio) * root))
    share = np.where(ratio < 1.0 - 1e-6, 0.5 * (1.0 / mean - 1.0) / np.maximum(1.0 - root, 1e-9), 0.5) * root
    at_long, at_middle, at_short = (
        1.0 / (2.0 * reduced_modulus(gelpad) * radius * layer.at(radius)[0]) for radius in (long, root * long, short)
    )
    return at_long + share * (at_middle - at_long + root * (at_short - at_middle))


def _crossings(gap: np.ndarray, highest: float) -> np.ndarray:
    """Weights of a node's neighbours with a larger gap, less those with a smaller one.

    By so much it adds to the perimeter of its region."""
    padded = np.pad(np.where(gap < highest, gap, np.inf), 1, constant_values=np.inf)
    rows, columns = gap.shape
    result = np.zeros(gap.shape)
    for dy, dx, weight in ((0, 1, PER_SIDE), (1, 0, PER_SIDE), (1, 1, PER_CORNER), (1, -1, PER_CORNER)):
        one = padded[1 : rows + 1, 1 : columns + 1]
        for sign in (1, -1):
            other = padded[1 + sign * dy : rows + 1 + sign * dy, 1 + sign * dx : columns + 1 + sign * dx]
            result += weight * ((other > one).astype(float) - (other < one))
    return result


def cells_of(x: np.ndarray, y: np.ndarray, gelpad: GelpadSpec) -> np.ndarray:
    """Cells for which each place stands, (Ny, Nx): 1, 1/2 on an edge, 1/4 in a corner."""
    at_x, at_y = (np.where(np.abs(v) > 0.5 * size - _AT_EDGE, 0.5, 1.0) for v, size in zip((x, y), gelpad.size, strict=True))
    return at_y[:, None] * at_x
