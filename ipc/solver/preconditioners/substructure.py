"""Static condensation: the inverse of a large sparse matrix as a few dense ones.

The unknowns of a body are those of P patches of its inside, I_1 … I_P, that do not see each other, and of an interface Γ that holds
every node of its surface (contacts act there) and the nodes between patches. With E_p = K_pp⁻¹ K_pΓ and the Schur complement
S = K_ΓΓ − Σ K_Γp E_p, K x = r is solved by

    x_Γ = S⁻¹ (r_Γ − Σ E_pᵀ r_p),      x_p = K_pp⁻¹ r_p − E_p x_Γ.

K_pp⁻¹, E_p and S⁻¹ are dense. In single precision the product of these steps is still symmetric, since E_p and E_pᵀ are the same
numbers, and positive definite if S⁻¹ and every K_pp⁻¹ are. Without patches everything is interface, and S⁻¹ is the inverse itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipc.bodies.layout import Layout
from ipc.solver.preconditioners.rest_stiffness import Floats, Ints, couplings, dense_block, free_nodes

Singles = NDArray[np.float32]

MAX_ENTRIES = 60_000_000
"""Most entries of four bytes of a body's rest inverse; the host needs a minute for them."""
MAX_PATCHES = 64
"""More than that many patches leave little inside them."""


@dataclass(frozen=True)
class Patch:
    """Nodes (n,), interface nodes beside them (g,), K_pp⁻¹ (3n, 3n) [m/N], E_p (3n, 3g) [-]."""

    nodes: Ints
    border: Ints
    inverse: Singles
    extension: Singles


@dataclass(frozen=True)
class Substructure:
    """Interface nodes (Γ,), S⁻¹ (3Γ, 3Γ) [m/N], and the patches."""

    interface: Ints
    inverse: Singles
    patches: tuple[Patch, ...]


def _neighbours(layout: Layout, label: Ints) -> tuple[Ints, Ints]:
    """Pairs of nodes that a block of the matrix couples, both with a non-negative label."""
    rows, cols = couplings(layout)
    keep = (label[rows] >= 0) & (label[cols] >= 0)
    return rows[keep], cols[keep]


def partition(layout: Layout, nodes: Ints, parts: int) -> Ints:
    """Patch of each node, −1 for none: ``nodes`` are halved into ``parts``, a power of two.

    Each cut is across the longest side, just after the median coordinate, and the nodes just before it become interface. A patch that
    is only a few nodes long may lose all of them.
    """
    label = np.full(len(layout.node_rest), -1)
    label[nodes] = 0
    for _ in range(parts.bit_length() - 1):
        cut = label.copy()
        for part in range(label.max() + 1):
            inside = np.flatnonzero(label == part)
            cut[inside] = 2 * part
            if len(inside) == 0:
                continue
            x = layout.node_rest[inside]
            along = x[:, np.argmax(np.ptp(x, axis=0))]
            scaled = np.round(along / max(np.ptp(along), 1e-300), 9)
            levels = np.unique(scaled)
            if len(levels) < 2:
                continue
            middle = levels[min(int(np.searchsorted(levels, np.median(scaled))), len(levels) - 2)]
            cut[inside[scaled > middle]] = 2 * part + 1
        rows, cols = _neighbours(layout, cut)
        between = (cut[rows] // 2 == cut[cols] // 2) & (cut[rows] < cut[cols])
        cut[rows[between]] = -1
        label = cut
    return label


def _single(inverse: NDArray[np.floating]) -> Singles:
    """An inverse in single precision; ``LinAlgError`` if rounding makes it indefinite."""
    single = (0.5 * (inverse + inverse.T)).astype(np.float32)
    np.linalg.cholesky(single.astype(np.float64))
    return single


def condense(layout: Layout, blocks: Floats, nodes: Ints, label: Ints) -> Substructure:
    """The substructure of the matrix between ``nodes``, all others fixed.

    Args:
        layout, blocks: the matrix (K', 3, 3) between the layout's ``couplings``.
        nodes: of one body.
        label: patch of every node of the layout, −1 for the interface.

    Raises:
        numpy.linalg.LinAlgError: if a part is too ill-conditioned for single precision.
    """
    interface = nodes[label[nodes] < 0]
    place = np.full(len(layout.node_rest), -1)
    place[interface] = np.arange(len(interface))
    schur = dense_block(layout, blocks, interface, interface)
    coupled, others = couplings(layout)
    patches = []
    for part in np.unique(label[nodes][label[nodes] >= 0]):
        inside = nodes[label[nodes] == part]
        border = np.unique(others[np.isin(coupled, inside)])
        border = border[place[border] >= 0]
        inverse = np.linalg.inv(dense_block(layout, blocks, inside, inside))
        coupling = dense_block(layout, blocks, inside, border)
        extension = inverse @ coupling
        at = (3 * place[border][:, None] + np.arange(3)).ravel()
        schur[np.ix_(at, at)] -= coupling.T @ extension
        patches.append(Patch(inside, border, _single(inverse), extension.astype(np.float32)))
    return Substructure(interface, _single(np.linalg.inv(schur)), tuple(patches))


def entries(layout: Layout, nodes: Ints, label: Ints) -> int:
    """Entries of the inverse in this form, patches padded to the largest."""
    interface = 3 * int((label[nodes] < 0).sum())
    inner = 3 * np.bincount(label[label >= 0], minlength=1)
    rows, cols = couplings(layout)
    rows = label[rows]
    free = np.zeros(len(label), bool)
    free[nodes] = True
    touch = (rows >= 0) & (label[cols] < 0) & free[cols]
    pairs = np.unique(rows[touch] * len(label) + cols[touch]) // len(label)
    border = 3 * np.bincount(pairs, minlength=1)
    return interface**2 + len(inner) * int(inner.max()) * int(inner.max() + 2 * border.max())


def choose_partition(layout: Layout, body: int, patches: int | None = None) -> tuple[Ints, Ints]:
    """The free nodes of a body, and the patch of every node (−1 for the interface).

    Args:
        patches: a power of two, 0 for none, None for the number with the fewest entries; none if that saves less than half.
    """
    nodes = free_nodes(layout, body)
    surface = layout.vert_nodes[layout.vert_count == 1, 0]
    whole, inside = np.full(len(layout.node_rest), -1), np.setdiff1d(nodes, surface)
    if patches == 0 or len(inside) == 0:
        return nodes, whole
    if patches is not None:
        return nodes, partition(layout, inside, patches)
    labels = [partition(layout, inside, 2**k) for k in range(1, MAX_PATCHES.bit_length())]
    best = min(labels, key=lambda label: entries(layout, nodes, label))
    return nodes, best if 2 * entries(layout, nodes, best) < entries(layout, nodes, whole) else whole
