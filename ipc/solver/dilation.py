"""Volume blocks: tetrahedra whose volumetric energy depends on their mean dilation.

A linear tetrahedron has one volume condition and, in a large mesh, half a node or less to meet it with; so nearly incompressible bodies
lock. A block b of tetrahedra e with volumes V_e has one condition for all of them: with

    J̄ = Σ V_e det F_e / V_b,      V_b = Σ V_e,

the term λ/2 (J − a)² of the stored energies (``ipc/solver/elasticity.py``; a = 1 for ``stable``, 1 + 3μ/(4λ) for ``stable_log``) becomes
V_b (λ − λ')/2 (J̄ − a)² and λ'/2 (J − a)² of each tetrahedron, and everything else stays with the tetrahedra. The sum of −μ (J − 1) is −μ
V_b (J̄ − 1) as it stands, so with λ' = 0 the block's is the whole volumetric function of ``stable``. This is the mean dilation of
Nagtegaal, Parks and Rice (Comput. Methods Appl. Mech. Eng. 4, 1974) and B-bar of Hughes (Int. J. Numer. Methods Eng. 15, 1980), for
groups of tetrahedra as in the F-bar-patch of de Souza Neto, Andrade Pires and Owen (Int. J. Numer. Methods Eng. 62, 2005); it is the
three-field form with pressure and dilation constant in a block (Simo, Taylor, Pister, Comput. Methods Appl. Mech. Eng. 51, 1985). The
barrier against inversion stays with each tetrahedron.

With λ' = 0 a free surface is on the verge of wrinkling (what is left inside a block is the linear material with λ = −μ, whose short
surface waves have no stiffness), and Newton's method takes many iterations. λ' of a fraction of μ prevents it and costs little accuracy.

Forces are those of elements whose J is J̄ in the volumetric factor c. The second derivative has, besides the elements' own,

    (λ − λ')/V_b (Σ V_e ∂J_e) (Σ V_e ∂J_e)ᵀ = q qᵀ,      q = √((λ − λ')/V_b) Σ V_e cof F_e ∇w,

which is positive semi-definite. q is kept by the nodes of a block and multiplied as it stands: first q·p of every block, then each node
gathers from the blocks around it, so that sums have one order.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from ipc.arrays import FloatArray, FloatArray2d, IntArray, MatArray2d, VecArray2d
from ipc.bodies.layout import Layout
from ipc.solver.elasticity import Elements, cofactor, deformation

wp.set_module_options({"enable_backward": False})


@wp.struct
class VolumeBlocks:
    """Q blocks and their S pairs (block, node).

    ``block_tet_start`` (Q+1,), ``block_tet``: elements of each block.    ``block_volume`` (Q,): V_b [m³].
    ``block_lam`` [Pa], ``block_rest`` (Q,): λ − λ' and a.
    ``pair_block``, ``pair_node`` (S,).    ``pair_corner_start`` (S+1,), ``pair_corner``: 4·element + a for each element of the block at
    the node.    ``corner_place`` (4 T,): the pair of a corner of an element, −1 without a block.
    """

    block_tet_start: IntArray
    block_tet: IntArray
    block_volume: FloatArray
    block_lam: FloatArray
    block_rest: FloatArray
    pair_block: IntArray
    pair_node: IntArray
    pair_corner_start: IntArray
    pair_corner: IntArray
    corner_place: IntArray


def corner_places(layout: Layout) -> NDArray[np.int32]:
    """``corner_place`` of :class:`VolumeBlocks`."""
    places = np.full(4 * len(layout.tets), -1, np.int32)
    places[layout.pair_corner] = np.repeat(np.arange(len(layout.pair_node)), np.diff(layout.pair_corner_start))
    return places


@wp.kernel
def element_dilation(y: VecArray2d, elements: Elements, active: IntArray, el_J: FloatArray2d):
    """det F of the elements that belong to a block."""
    env, e = wp.tid()
    if active[env] != 0 and elements.volume_block[e] >= 0:
        el_J[env, e] = wp.determinant(deformation(env, e, y, elements))


@wp.func
def block_mean(env: wp.int32, b: wp.int32, elements: Elements, volumes: VolumeBlocks, el: FloatArray2d) -> wp.float64:
    """Mean of a number of the elements of block b, weighted by volume."""
    total = wp.float64(0.0)
    for k in range(volumes.block_tet_start[b], volumes.block_tet_start[b + 1]):
        e = volumes.block_tet[k]
        total += elements.volume[e] * el[env, e]
    return total / volumes.block_volume[b]


@wp.kernel
def mean_dilation(elements: Elements, volumes: VolumeBlocks, el_J: FloatArray2d, active: IntArray, dilation: FloatArray2d):
    """J̄ of every block."""
    env, b = wp.tid()
    if active[env] != 0:
        dilation[env, b] = block_mean(env, b, elements, volumes, el_J)


@wp.kernel
def dilation_rows(elements: Elements, volumes: VolumeBlocks, el_F: MatArray2d, active: IntArray, q: VecArray2d):
    """q of every pair of block and node [√(N/m)]."""
    env, s = wp.tid()
    if active[env] == 0:
        return
    slope = wp.vec3d()
    for k in range(volumes.pair_corner_start[s], volumes.pair_corner_start[s + 1]):
        e = volumes.pair_corner[k] / 4
        slope += elements.volume[e] * (cofactor(el_F[env, e]) * elements.grads[e, volumes.pair_corner[k] - 4 * e])
    b = volumes.pair_block[s]
    q[env, s] = wp.sqrt(volumes.block_lam[b] / volumes.block_volume[b]) * slope


@wp.kernel
def block_dilation_rows(
    elements: Elements, volumes: VolumeBlocks, el_F: MatArray2d, active: IntArray, block_pair_start: IntArray, q: VecArray2d
):
    """q as of :func:`dilation_rows`, block by block: a cofactor an element, not one a corner.

    ``block_pair_start`` (Q+1,): first pair of each block.
    """
    env, b = wp.tid()
    if active[env] == 0:
        return
    rows = q[env]
    for s in range(block_pair_start[b], block_pair_start[b + 1]):
        rows[s] = wp.vec3d()
    for k in range(volumes.block_tet_start[b], volumes.block_tet_start[b + 1]):
        e = volumes.block_tet[k]
        C, volume = cofactor(el_F[env, e]), elements.volume[e]
        for a in range(4):
            s = volumes.corner_place[4 * e + a]
            rows[s] = rows[s] + volume * (C * elements.grads[e, a])
    scale = wp.sqrt(volumes.block_lam[b] / volumes.block_volume[b])
    for s in range(block_pair_start[b], block_pair_start[b + 1]):
        rows[s] = scale * rows[s]


@wp.kernel
def block_energy_change(
    elements: Elements,
    volumes: VolumeBlocks,
    det: FloatArray2d,
    det_change: FloatArray2d,
    active: IntArray,
    # outputs
    change: FloatArray2d,
):
    """Add V_b (λ − λ')/2 (J̄ − a)² at y1, less that at y0 [J].

    Each block's goes to its first element.
    """
    env, b = wp.tid()
    if active[env] == 0:
        return
    grown = block_mean(env, b, elements, volumes, det_change)
    both = wp.float64(2.0) * (block_mean(env, b, elements, volumes, det) - volumes.block_rest[b]) - grown
    first = volumes.block_tet[volumes.block_tet_start[b]]
    energy = wp.float64(0.5) * volumes.block_lam[b] * volumes.block_volume[b] * grown * both
    change[env, first] = change[env, first] + energy
