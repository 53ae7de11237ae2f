"""Linear compliance of the coat of a pad's mesh, on the solver's own tetrahedra."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from itertools import product

import numpy as np

from raytac.physics.soft.mesh import PadMesh
from raytac.specs.sensor import GelpadSpec

_SAME_PLACE = 1e-9
"""Vertices nearer than this are mirror images [m]."""
_SAME = 1e-9
"""Relative difference of two stiffnesses that is rounding."""
_MOST_BYTES = 1 << 27
"""Memory of ``correction_compliances`` that a process keeps."""
_kept: dict[str, tuple[np.ndarray, np.ndarray]] = {}
"""Last of them, by all that they depend on."""


def compliance_basis(mesh: PadMesh, gelpad: GelpadSpec) -> tuple[str | bytes, ...]:
    """All that a compliance depends on, but for the code."""
    arrays = [mesh.tets.vertices, mesh.tets.tets, mesh.bonded, mesh.coat_vertices]
    if mesh.volume_blocks is not None:
        arrays += [mesh.volume_blocks, np.array(mesh.own_volume)]
    return repr(gelpad), *(array.tobytes() for array in arrays)


def correction_compliances(mesh: PadMesh, gelpad: GelpadSpec) -> tuple[np.ndarray, np.ndarray]:
    """Compliance of the coat, and of one whose sides may not move outwards.

    Shapes (3, V, V), for forces along z, and (3, 3, V, V). Both take as long as a quarter of a press of the coarse pad: those of the
    last meshes are kept and shared, read-only.
    """
    key = hashlib.sha256(repr(compliance_basis(mesh, gelpad)).encode()).hexdigest()
    if key not in _kept:
        made = coat_compliance(mesh, gelpad)[0], coat_compliance(mesh, gelpad, rollers=True, along=(0, 1, 2))
        for array in made:
            array.flags.writeable = False
        size = sum(array.nbytes for array in made)
        if size > _MOST_BYTES:
            return made
        while size + sum(array.nbytes for pair in _kept.values() for array in pair) > _MOST_BYTES:
            _kept.pop(next(iter(_kept)))
        _kept[key] = made
    return _kept[key]


def coat_compliance(mesh: PadMesh, gelpad: GelpadSpec, *, rollers: bool = False, along: tuple[int, ...] = (2,)) -> np.ndarray:
    """Displacement of each coat vertex under 1 N on each [m], shape (A, 3, V, V), float64.

    Entry (a, c, i, j): component c of vertex i, force on vertex j along the axis ``along[a]`` (0, 1, 2: x, y, z).

    Linear tetrahedra with the gelpad's E and ν, as the solver's neo-Hookean gel has them at small strain, fixed where the mesh is
    bonded. ``rollers``: the sides of the pad do not move outwards either (and may slide), as if the pad were continued by its mirror
    image. The unknowns are eliminated layer by layer from the back (block Gaussian elimination of a block tridiagonal matrix); a layer
    is the set of vertices equally many edges from the coat. A mesh that is its own mirror image is first split into its symmetric
    and antisymmetric parts, which is exact and halves the layers for each mirror.
    """
    stiffness = rest_stiffness(mesh, gelpad)
    fixed = np.zeros((len(mesh.tets.vertices), 3), bool)
    fixed[mesh.bonded] = True
    if rollers:
        for axis in (0, 1):
            at = mesh.tets.vertices[:, axis]
            fixed[(at <= at.min() + _SAME_PLACE) | (at >= at.max() - _SAME_PLACE), axis] = True
    layer = _layers(mesh)
    compliance = np.zeros((len(along), 3, *(len(mesh.coat_vertices),) * 2))
    on_coat = np.full(len(mesh.tets.vertices), -1)
    on_coat[mesh.coat_vertices] = np.arange(len(mesh.coat_vertices))
    for basis in _halves(mesh, stiffness, fixed):
        compliance += _condensed(stiffness, basis, layer, on_coat, along)
    for one, axis in zip(compliance, along, strict=True):
        one[axis] = 0.5 * (one[axis] + one[axis].T)
    return compliance


@dataclass(frozen=True)
class _Sparse:
    """Entries of a sparse matrix; entries at the same place add up."""

    row: np.ndarray
    column: np.ndarray
    value: np.ndarray
    shape: tuple[int, int]

    def times(self, vector: np.ndarray) -> np.ndarray:
        return np.bincount(self.row, self.value * vector[self.column], self.shape[0])


def rest_stiffness(mesh: PadMesh, gelpad: GelpadSpec) -> _Sparse:
    """Stiffness of all vertices [N/m], (3n, 3n), unknown 3 v + axis, by linear elasticity.

    A tetrahedron of volume V whose shape functions have gradients g adds V (λ g_a g_bᵀ + μ g_b g_aᵀ + μ (g_a · g_b) 1) to block (a, b).
    In a volume block b its λ is λ' − μ, and the block adds (λ + μ − λ')/V_b q qᵀ with q = Σ V g: the coefficient of (J − 1)² in the
    solver's energy is λ + μ, of which the tetrahedron keeps λ' = ``own_volume`` μ (``ipc.solver.dilation``).
    """
    vertices, tets = mesh.tets.vertices, mesh.tets.tets
    young, nu = gelpad.youngs_modulus, gelpad.poisson_ratio
    lame, shear = young * nu / ((1.0 + nu) * (1.0 - 2.0 * nu)), 0.5 * young / (1.0 + nu)
    corners = vertices[tets]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    inverse = np.linalg.inv(edges)
    slope = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)  # of the four hat functions, (T, 4, 3)
    outer = slope[:, :, None, :, None] * slope[:, None, :, None, :]
    volume = np.abs(np.linalg.det(edges)) / 6.0
    own = np.full(len(tets), lame)
    if mesh.volume_blocks is not None:
        own[mesh.volume_blocks >= 0] = (mesh.own_volume - 1.0) * shear
    block = own[:, None, None, None, None] * outer + shear * np.swapaxes(outer, 3, 4)
    block += shear * np.einsum("tac,tbc->tab", slope, slope)[..., None, None] * np.eye(3)
    block *= volume[:, None, None, None, None]
    n = len(vertices)
    pair, back = np.unique(tets[:, :, None].astype(np.int64) * n + tets[:, None, :], return_inverse=True)
    entry = (9 * back.reshape(len(tets), 4, 4, 1, 1) + np.arange(9).reshape(3, 3)).ravel()
    row, column = 3 * (pair // n)[:, None, None] + np.arange(3)[:, None], 3 * (pair % n)[:, None, None] + np.arange(3)
    row, column = (np.broadcast_to(x, (len(pair), 3, 3)).ravel() for x in (row, column))
    value = np.bincount(entry, block.ravel(), 9 * len(pair))
    rows, columns, values = [row], [column], [value]
    for inside in _volume_blocks(mesh):
        unknown, where = np.unique(3 * tets[inside][:, :, None] + np.arange(3), return_inverse=True)
        total = np.bincount(where.ravel(), (volume[inside, None, None] * slope[inside]).ravel())
        rows.append(np.repeat(unknown, len(unknown)))
        columns.append(np.tile(unknown, len(unknown)))
        values.append(((lame + shear - mesh.own_volume * shear) / volume[inside].sum() * total[:, None] * total).ravel())
    row, column, value = (np.concatenate(parts) for parts in (rows, columns, values))
    order = np.argsort(row * 3 * n + column, kind="stable")
    return _Sparse(row[order], column[order], value[order], (3 * n, 3 * n))


def _volume_blocks(mesh: PadMesh) -> list[np.ndarray]:
    """Tetrahedra of each volume block."""
    if mesh.volume_blocks is None:
        return []
    order = np.argsort(mesh.volume_blocks, kind="stable")
    blocks = np.split(order, np.flatnonzero(np.diff(mesh.volume_blocks[order])) + 1)
    return [block for block in blocks if mesh.volume_blocks[block[0]] >= 0]


def _layers(mesh: PadMesh) -> np.ndarray:
    """Number of edges, or volume blocks, between each vertex and the coat, shape (n,)."""
    tets = mesh.tets.tets
    layer = np.full(len(mesh.tets.vertices), -1)
    layer[mesh.coat_vertices] = 0
    depth = 0
    while (layer < 0).any():
        near = (layer[tets] == depth).any(axis=1)
        if mesh.volume_blocks is not None:
            near |= np.isin(mesh.volume_blocks, mesh.volume_blocks[near & (mesh.volume_blocks >= 0)])
        touched = np.unique(tets[near])
        new = touched[layer[touched] < 0]
        if len(new) == 0:
            break
        depth += 1
        layer[new] = depth
    return layer


def _halves(mesh: PadMesh, stiffness: _Sparse, fixed: np.ndarray) -> list[_Sparse]:
    """Orthonormal bases of the free unknowns, one for each kind of symmetry."""
    vertices = mesh.tets.vertices
    n = len(vertices)
    mirrors = []
    for axis in (0, 1):
        image = _mirror_image(vertices, axis)
        if image is None:
            continue
        sign = np.where(np.arange(3) == axis, -1.0, 1.0)
        where = (3 * image[:, None] + np.arange(3)).ravel()
        signs = np.tile(sign, n)
        probe = np.cos(np.arange(3 * n) ** 2 % 1009)
        one, two = stiffness.times(signs * probe[where]), signs * stiffness.times(probe)[where]
        if np.abs(one - two).max() <= _SAME * np.abs(one).max() and np.array_equal(fixed.ravel()[where], fixed.ravel()):
            mirrors.append((where, signs))
    free = np.flatnonzero(~fixed.ravel())
    bases = []
    for parities in product((1.0, -1.0), repeat=len(mirrors)):
        row, value = free[:, None], np.ones((len(free), 1))
        for (where, signs), parity in zip(mirrors, parities, strict=True):
            row, value = np.hstack([row, where[row]]), np.hstack([value, parity * signs[row] * value])
        # Unknowns that are their own image add up or cancel; an orbit is kept once, by its lowest unknown.
        order = np.argsort(row, axis=1, kind="stable")
        row, value = np.take_along_axis(row, order, 1), np.take_along_axis(value, order, 1)
        keep = row[:, 0] == free
        row, value = row[keep], value[keep]
        total = np.stack([np.where(row == row[:, k : k + 1], value, 0.0).sum(axis=1) for k in range(row.shape[1])], axis=1)
        first = np.hstack([np.ones((len(row), 1), bool), row[:, 1:] != row[:, :-1]])
        total = np.where(first, total, 0.0)
        norm = np.linalg.norm(total, axis=1)
        alive = norm > 0.5
        row, total = row[alive], total[alive] / norm[alive, None]
        column, k = np.nonzero(total)
        bases.append(_Sparse(row[column, k], column, total[column, k], (3 * n, len(row))))
    return bases


def _mirror_image(vertices: np.ndarray, axis: int) -> np.ndarray | None:
    """Mirror image of each vertex, shape (n,); None if some have none."""
    mirrored = vertices * np.where(np.arange(3) == axis, -1.0, 1.0)
    here, there = (np.lexsort(np.round(v / _SAME_PLACE).astype(np.int64).T) for v in (vertices, mirrored))
    if np.abs(vertices[here] - mirrored[there]).max() > _SAME_PLACE:
        return None
    image = np.empty(len(vertices), int)
    image[there] = here
    return image


def _condensed(stiffness: _Sparse, basis: _Sparse, layer: np.ndarray, on_coat: np.ndarray, along: tuple[int, ...]) -> np.ndarray:
    """Contribution of one basis to the coat's compliance, (A, 3, V, V)."""
    by_row = np.argsort(basis.row, kind="stable")
    row, column, value = basis.row[by_row], basis.column[by_row], basis.value[by_row]
    n = stiffness.shape[0]
    # Within one half every unknown occurs in at most one column.
    column_of, weight = np.full(n, -1), np.zeros(n)
    column_of[row], weight[row] = column, value
    first, second = column_of[stiffness.row], column_of[stiffness.column]
    used = (first >= 0) & (second >= 0)
    first, second = first[used], second[used]
    entry = stiffness.value[used] * weight[stiffness.row[used]] * weight[stiffness.column[used]]
    depth_of = np.empty(basis.shape[1], int)
    depth_of[column] = layer[row // 3]
    place = np.empty(basis.shape[1], int)
    sizes = np.bincount(depth_of)
    for depth, size in enumerate(sizes):
        place[depth_of == depth] = np.arange(size)

    def block(upper: int, lower: int) -> np.ndarray:
        here = (depth_of[first] == upper) & (depth_of[second] == lower)
        at = place[first[here]] * sizes[lower] + place[second[here]]
        return np.bincount(at, entry[here], sizes[upper] * sizes[lower]).reshape(sizes[upper], sizes[lower])

    inverse = np.zeros((0, 0))
    for depth in range(len(sizes) - 1, -1, -1):
        here = block(depth, depth)
        if inverse.size:
            coupling = block(depth, depth + 1)
            here -= coupling @ inverse @ coupling.T
        inverse = np.linalg.inv(here)
    # On the coat every component of a vertex is one unknown, times its weight; without an unknown the weight is 0.
    unknown, share = (np.zeros((3, int(on_coat.max()) + 1), dtype) for dtype in (int, float))
    for axis in range(3):
        top = np.flatnonzero((column_of >= 0) & (np.arange(n) % 3 == axis) & (on_coat[np.arange(n) // 3] >= 0))
        unknown[axis, on_coat[top // 3]], share[axis, on_coat[top // 3]] = place[column_of[top]], weight[top]
    result = np.zeros((len(along), 3, *(unknown.shape[1],) * 2))
    for one, axis in zip(result, along, strict=True):
        response = inverse[:, unknown[axis]] * share[axis]
        for side in range(3):
            one[side] = share[side][:, None] * response[unknown[side]]
    return result
