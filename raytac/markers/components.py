"""Connected components of contact masks, by runs: few NumPy calls for all environments, then plain Python over some dozens of runs."""

from __future__ import annotations

import numpy as np

__all__ = ["find_runs", "join_runs"]


def find_runs(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Runs of True along the rows of B masks (B, Ny, Nx): (row of all B · Ny, first column, column after the last), each (R,), in order."""
    batch, ny, nx = mask.shape
    padded = np.zeros((batch * ny, nx + 2), dtype=bool)
    padded[:, 1:-1] = mask.reshape(batch * ny, nx)
    # Along a row, edges are in turn the first column of a run and the column after its last.
    row, column = (padded[:, 1:] != padded[:, :-1]).nonzero()
    return row[::2], column[::2], column[1::2]


def join_runs(row: list[int], start: list[int], stop: list[int], ny: int) -> list[int]:
    """For every run of ``find_runs``, as lists, the number of the first run of its 8-connected piece.

    Union-find (Rosenfeld and Pfaltz 1966): a run is joined to those of the row above, in the same mask of ``ny`` rows, that it touches
    at a side or a corner.
    """
    parent = list(range(len(row)))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = i = parent[parent[i]]
        return i

    above = 0
    for i, r in enumerate(row):
        if r % ny == 0:
            continue
        while row[above] < r - 1 or (row[above] == r - 1 and stop[above] < start[i]):
            above += 1
        k = above
        while row[k] == r - 1 and start[k] <= stop[i]:
            a, b = root(i), root(k)
            parent[max(a, b)] = min(a, b)
            k += 1
    return [root(i) for i in range(len(row))]
