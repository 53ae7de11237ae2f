"""Connected components of contact masks, by runs of True along the rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def find_runs(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Runs of True along the rows of B masks (B, Ny, Nx), in order.

    Returns row of all B · Ny, first column, column after the last, each (R,).
    """
    row, column = np.divmod(find_edges(mask), mask.shape[2] + 1)
    return row[::2], column[::2], column[1::2]


def find_edges(mask: np.ndarray) -> np.ndarray:
    """Beginnings and ends of all runs, (2 R,), in order, as row · (Nx + 1) + column."""
    batch, ny, nx = mask.shape
    # One False before every row, so that beginnings and ends alternate.
    padded = np.zeros(batch * ny * (nx + 1) + 1, dtype=bool)
    padded[:-1].reshape(batch * ny, nx + 1)[:, 1:] = mask.reshape(batch * ny, nx)
    return np.flatnonzero(padded[1:] != padded[:-1])


def join_runs(row: np.ndarray, start: np.ndarray, stop: np.ndarray, ny: int) -> np.ndarray:
    """Number of the first run of the 8-connected piece of every run of ``find_runs``, (R,).

    Union-find (Rosenfeld and Pfaltz 1966): a run is joined to those of the row above, in the same mask of ``ny`` rows, that it touches
    at a side or a corner.
    """
    if (row[1:] > row[:-1]).all():  # one run a row, as of most contacts: the run before is the only one that may touch
        begins = np.ones(len(row), bool)
        begins[1:] = (row[1:] > row[:-1] + 1) | (row[1:] % ny == 0) | (start[1:] > stop[:-1]) | (start[:-1] > stop[1:])
        return np.flatnonzero(begins)[np.cumsum(begins) - 1]
    return np.array(_joined(row.tolist(), start.tolist(), stop.tolist(), ny))


def _joined(row: list[int], start: list[int], stop: list[int], ny: int) -> list[int]:
    """``join_runs`` of any runs."""
    parent = list(range(len(row)))
    above = 0
    for i, r in enumerate(row):
        if r % ny == 0:
            continue
        begin, end = start[i], stop[i]
        while row[above] < r - 1 or (row[above] == r - 1 and stop[above] < begin):
            above += 1
        k, mine = above, i
        while row[k] == r - 1 and start[k] <= end:
            other = k
            while parent[other] != other:
                parent[other] = other = parent[parent[other]]
            if other < mine:
                parent[mine] = mine = other
            else:
                parent[other] = mine
            k += 1
    # A parent comes before its child, so one pass in order makes every parent a root.
    for i, number in enumerate(parent):
        parent[i] = parent[number]
    return parent


def span(used: ArrayLike, margin: int = 0) -> slice:
    """Slice from the first to the last true entry, widened by ``margin``."""
    at = np.flatnonzero(used)
    return slice(max(int(at[0]) - margin, 0), int(at[-1]) + 1 + margin)


def boxes(masks: np.ndarray) -> np.ndarray:
    """Columns [c0, c1) and rows [r0, r1) of the True values of masks (B, Ny, Nx).

    (B, 4), uint32; 0 for none.
    """
    lines = np.any(masks, axis=1), np.any(masks, axis=2)
    edges = [edge for line in lines for edge in (line.argmax(axis=1), line.shape[1] - line[:, ::-1].argmax(axis=1))]
    return np.where(np.any(lines[1], axis=1)[:, None], np.stack(edges, axis=1), 0).astype(np.uint32)
