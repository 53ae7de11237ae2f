"""Samples of a contact on a coarser grid that has the same effect on a marker, for a Gaussian that is wide compared with a cell.

A sum Σ h_i f(C_i) over samples does not change if f is interpolated from nodes Q_q, f(C) = Σ_q L_q(C) f(Q_q), and the weights are given
to the samples instead: Σ_q h'_q f(Q_q) with h'_q = Σ_i L_q(C_i) h_i (anterpolation, as of fast multipole methods). With
f(C) = (M − C) exp(−λ ‖M − C‖²), which is smooth, Lagrange's polynomials of degree 7 on nodes up to ``_SPACING`` / √λ apart leave an error
of about 10⁻⁶ of a sample's greatest effect, and less in a sum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from raytac.gel.matmul import stacked_product

_SPACING = 0.17
"""Largest distance of the coarser nodes over 1/√λ."""
_STENCIL = 8
"""Nodes, along an axis, that a sample is given to."""


@dataclass(frozen=True)
class SourceLine:
    """Evenly spaced nodes along one axis that stand for samples."""

    first: float
    """Place of the first node [m]."""
    pitch: float
    """Their distance [m]."""
    count: int
    factor: int
    """Samples from one node to the next."""
    weights: np.ndarray | None
    """Share of each sample in each node, (nodes, samples), float64; None where the nodes are the samples."""

    @classmethod
    def of(cls, line: np.ndarray, decay: float) -> SourceLine:
        """Nodes for samples at ``line`` (n,) [m], evenly spaced, and Gaussians exp(−``decay`` d²), ``decay`` in 1/m²."""
        pitch, factor = float(line[1] - line[0]), coarsening(line, decay)
        if factor == 1:
            return cls(float(line[0]), pitch, len(line), 1, None)
        before = _STENCIL // 2 - 1
        at, place = np.divmod(np.arange(len(line)), factor)
        offset = place / factor + before
        nodes = np.arange(_STENCIL)
        weights = np.zeros((int(at[-1]) + _STENCIL, len(line)))
        for k in nodes:
            others = nodes[nodes != k]
            weights[at + k, np.arange(len(line))] = np.prod((offset[:, None] - others) / (k - others), axis=1)
        first = float(line[0]) - before * factor * pitch
        return cls(first, factor * pitch, len(weights), factor, weights)

    @cached_property
    def turned(self) -> np.ndarray:
        """``weights``, transposed."""
        assert self.weights is not None
        return np.ascontiguousarray(self.weights.T)

    def edges(self, start: np.ndarray, stop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nodes from and to that samples ``start`` to ``stop`` are given to; none for none."""
        if self.weights is None:
            return start, stop
        is_empty = stop <= start
        return np.where(is_empty, 0, start // self.factor), np.where(is_empty, 0, (stop - 1) // self.factor + _STENCIL)


def coarsening(line: np.ndarray, decay: float) -> int:
    """Samples from one node to the next for samples at ``line``; 1: too few to gain, and the samples themselves are used."""
    factor = min(int(_SPACING / (math.sqrt(decay) * float(line[1] - line[0]))), _STENCIL) if decay > 0 else _STENCIL
    return factor if factor > 1 else 1


def anterpolated(depth: np.ndarray, boxes: np.ndarray, x: SourceLine, y: SourceLine, out: np.ndarray) -> np.ndarray:
    """Write depths (B, ny, nx), 0 outside ``boxes``, as nodes' (B, ``y.count``, ``x.count``), float32; returns the nodes' boxes (B, 4).

    Boxes are columns from, to and rows from, to, all 0 for none; ``out`` is written for environments with contact, where any has it.
    """
    edges = np.stack([*x.edges(*boxes.T[:2]), *y.edges(*boxes.T[2:])], axis=1)
    some = boxes[:, 1] > boxes[:, 0]
    if not some.any():
        return edges
    (columns, x_nodes), (rows, y_nodes) = (
        [slice(int(box[some, low].min()), int(box[some, low + 1].max())) for box in (boxes, edges)] for low in (0, 2)
    )
    # In double precision, since the order of a product's sums depends on the piece, and so on the other environments.
    part = depth[some, rows, columns].astype(float)
    if y.weights is not None:
        part = stacked_product(y.weights[y_nodes, rows], part)
    if x.weights is not None:
        part = stacked_product(part, x.turned[columns, x_nodes])
    out[some, y_nodes, x_nodes] = part
    return edges
