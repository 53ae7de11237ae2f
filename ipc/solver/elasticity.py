"""Stored energies of a tetrahedron and their derivatives, gathered into nodes and blocks.

With F = Σ_a x_a ∇w_aᵀ and J = det F:

``stable`` (code 0)      Ψ = μ/2 (I_C − 3) − μ (J − 1) + λ/2 (J − 1)²
``stable_log`` (code 1)  Ψ = μ/2 (I_C − 3) + λ/2 (J − a)² − μ/2 ln(I_C + 1), a = 1 + 3μ/(4λ)      (Smith et al. 2018, eq. 14)
``orthogonal`` (code 2)  Ψ = μ ‖F Fᵀ − 1‖²                                                        (Lan et al. 2022, eq. 6)

To the first two comes, below J = J₀ = 0.2, the barrier −λ (J − J₀)² ln(J/J₀), of the form of the contact barrier: without it a collapsed
element costs little, Newton's steps are cut short at det F = 0, and the step stalls. Above J₀ it is zero.

For the first two, P = m F + c cof F with m = μ or μ (1 − 1/(I_C + 1)) and c = λ (J − 1) − μ or λ (J − a), plus the barrier's slope. The
second derivative is

    δP = m δF + k F (F : δF) + l cof F (cof F : δF) + c δ(cof F),        k = 0 or 2μ/(I_C + 1)², l = λ plus the barrier's curvature,

and every term but the last is positive semi-definite. The blocks need no 9×9 matrix: with g_a = ∇w_a, the last term couples corners
a and b by −c [F (g_a × g_b)]_×. Where the matrix must be positive semi-definite, ``geometric_factor`` shrinks c toward 0 until it is;
the semi-definite set of c is an interval around 0, computed from the singular values (Smith et al. 2018, section 4, gives the modes).

Elements of a volume block keep λ' of the λ in λ/2 (J − 1)² or λ/2 (J − a)²; the rest, λ − λ', has the block's mean dilation J̄ in the place
of J, and so in c, and l has λ' for λ. What the mean adds to the second derivative, a term of rank one a block, is in
``ipc/solver/dilation.py``.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import warp as wp

from ipc.arrays import FloatArray, FloatArray2d, IntArray, IntArray2d, MatArray2d, Vec4Array2d, VecArray2d
from ipc.contact.barrier import barrier, barrier_first, barrier_second
from ipc.solver.dynamics import Masses

wp.set_module_options({"enable_backward": False})


@wp.struct
class Elements:
    """Tetrahedra: nodes, ∇w of corners [1/m], volume [m³], energy code, coefficients [Pa].

    ``volume_block``: number of the block that shares its mean dilation, or −1.    ``own``: λ' [Pa], λ itself without a block.
    """

    tets: IntArray2d
    grads: VecArray2d
    volume: FloatArray
    model: IntArray
    mu: FloatArray
    lam: FloatArray
    volume_block: IntArray
    own: FloatArray


@wp.func
def cofactor(F: wp.mat33d) -> wp.mat33d:
    """cof F = ∂J/∂F."""
    f0 = wp.vec3d(F[0, 0], F[1, 0], F[2, 0])
    f1 = wp.vec3d(F[0, 1], F[1, 1], F[2, 1])
    f2 = wp.vec3d(F[0, 2], F[1, 2], F[2, 2])
    return wp.matrix_from_cols(wp.cross(f1, f2), wp.cross(f2, f0), wp.cross(f0, f1))


INVERSION = wp.constant(wp.float64(0.2))
"""J₀: an element squeezed to less than this share of its volume meets the barrier."""


@wp.func
def squeeze(det: wp.float64) -> wp.float64:
    """The barrier over λ, −(J − J₀)² ln(J/J₀) below J₀ [-]."""
    if det <= wp.float64(0.0):
        return wp.float64(1.0e30)
    return barrier(det, INVERSION)


@wp.func
def squeeze_first(det: wp.float64) -> wp.float64:
    """Its slope [-]."""
    if det <= wp.float64(0.0):
        return wp.float64(0.0)
    return barrier_first(det, INVERSION)


@wp.func
def squeeze_second(det: wp.float64) -> wp.float64:
    """Its curvature [-], never negative."""
    if det <= wp.float64(0.0):
        return wp.float64(0.0)
    return barrier_second(det, INVERSION)


@wp.func
def strain_energy(
    F: wp.mat33d, mean: wp.float64, own: wp.float64, model: wp.int32, mu: wp.float64, lam: wp.float64
) -> wp.float64:
    """Ψ(F) [J/m³]; ``mean`` is the mean dilation of the element's block, ``own`` λ'."""
    one, half = wp.float64(1.0), wp.float64(0.5)
    ic = wp.ddot(F, F)
    J = wp.determinant(F)
    if model == 2:
        C = F * wp.transpose(F) - wp.identity(n=3, dtype=wp.float64)
        return mu * wp.ddot(C, C)
    if model == 1:
        a = one + wp.float64(0.75) * mu / lam
        base = (
            half * mu * (ic - wp.float64(3.0))
            + half * (own * (J - a) * (J - a) + (lam - own) * (mean - a) * (mean - a))
            - half * mu * wp.log(ic + one)
        )
        return base + lam * squeeze(J)
    volumetric = half * (own * (J - one) * (J - one) + (lam - own) * (mean - one) * (mean - one))
    return half * mu * (ic - wp.float64(3.0)) - mu * (J - one) + volumetric + lam * squeeze(J)


@wp.func
def stress_factors(
    F: wp.mat33d, J: wp.float64, mean: wp.float64, own: wp.float64, model: wp.int32, mu: wp.float64, lam: wp.float64
) -> wp.vec3d:
    """(m, c, k) of the module's docstring [Pa]."""
    one = wp.float64(1.0)
    pressure = own * (J - one) + (lam - own) * (mean - one) + lam * squeeze_first(J)
    if model == 1:
        q = one / (wp.ddot(F, F) + one)
        return wp.vec3d(mu * (one - q), pressure - wp.float64(0.75) * mu, wp.float64(2.0) * mu * q * q)
    return wp.vec3d(mu, pressure - mu, wp.float64(0.0))


@wp.func
def first_piola(F: wp.mat33d, f: wp.vec3d, model: wp.int32, mu: wp.float64) -> wp.mat33d:
    """P = ∂Ψ/∂F [Pa] from :func:`stress_factors`."""
    if model == 2:
        return wp.float64(4.0) * mu * (F * wp.transpose(F) - wp.identity(n=3, dtype=wp.float64)) * F
    return f[0] * F + f[1] * cofactor(F)


@wp.func
def stretch_block_definite(s: wp.vec3d, m: wp.float64, k: wp.float64, lam: wp.float64, c: wp.float64) -> wp.bool:
    """True if the block of the stretch modes is semi-definite (leading minors ≥ 0)."""
    p = wp.vec3d(s[1] * s[2], s[0] * s[2], s[0] * s[1])
    a00 = m + k * s[0] * s[0] + lam * p[0] * p[0]
    a11 = m + k * s[1] * s[1] + lam * p[1] * p[1]
    a22 = m + k * s[2] * s[2] + lam * p[2] * p[2]
    a01 = k * s[0] * s[1] + lam * p[0] * p[1] + c * s[2]
    a02 = k * s[0] * s[2] + lam * p[0] * p[2] + c * s[1]
    a12 = k * s[1] * s[2] + lam * p[1] * p[2] + c * s[0]
    two = a00 * a11 - a01 * a01
    three = a00 * (a11 * a22 - a12 * a12) - a01 * (a01 * a22 - a12 * a02) + a02 * (a01 * a12 - a11 * a02)
    return a00 >= wp.float64(0.0) and two >= wp.float64(0.0) and three >= wp.float64(0.0)


@wp.func
def geometric_factor(F: wp.mat33d, m: wp.float64, k: wp.float64, lam: wp.float64, c: wp.float64) -> wp.float64:
    """The c' between 0 and c, closest to c, with a semi-definite second derivative."""
    _U, s, _V = wp.svd3(F)
    top = wp.max(wp.max(wp.abs(s[0]), wp.abs(s[1])), wp.abs(s[2]))
    limit = m / wp.max(top, wp.float64(1.0e-30))  # twist and flip modes: m ± c s_i ≥ 0
    high = wp.clamp(c, -limit, limit)
    if stretch_block_definite(s, m, k, lam, high):
        return high
    low = wp.float64(0.0)
    for _ in range(30):
        middle = wp.float64(0.5) * (low + high)
        if stretch_block_definite(s, m, k, lam, middle):
            low = middle
        else:
            high = middle
    return low


@wp.func
def volume_change(F0: wp.mat33d, F1: wp.mat33d) -> wp.float64:
    """det F1 − det F0, written in F1 − F0."""
    G = F1 - F0
    return wp.ddot(cofactor(F0), G) + wp.ddot(F0, cofactor(G)) + wp.determinant(G)


@wp.func
def strain_energy_change(
    F0: wp.mat33d, F1: wp.mat33d, own: wp.float64, model: wp.int32, mu: wp.float64, lam: wp.float64
) -> wp.float64:
    """Ψ(F1) − Ψ(F0) [J/m³], written in F1 − F0, so that it keeps its digits near rest.

    ``own``: λ', with which the element has λ'/2 (J − a)².
    """
    one, half = wp.float64(1.0), wp.float64(0.5)
    G = F1 - F0
    if model == 2:
        eye = wp.identity(n=3, dtype=wp.float64)
        sum_of = F0 * wp.transpose(F0) + F1 * wp.transpose(F1) - wp.float64(2.0) * eye
        return mu * wp.ddot(G * wp.transpose(F1) + F0 * wp.transpose(G), sum_of)
    ic = wp.ddot(G, F0 + F1)
    J = volume_change(F0, F1)
    J0, J1 = wp.determinant(F0), wp.determinant(F1)
    both = J0 + J1
    barrier = lam * (squeeze(J1) - squeeze(J0))
    if model == 1:
        a = one + wp.float64(0.75) * mu / lam
        z = ic / (wp.ddot(F0, F0) + one)
        log1p = z * (one - z * (half - z * (one / wp.float64(3.0) - z * (wp.float64(0.25) - z * wp.float64(0.2)))))
        if not (wp.abs(z) < wp.float64(1.0e-3)):
            log1p = wp.log(one + z)
        return half * mu * (ic - log1p) + half * own * J * (both - wp.float64(2.0) * a) + barrier
    return half * mu * ic - mu * J + half * own * J * (both - wp.float64(2.0)) + barrier


@wp.func
def deformation(env: wp.int32, e: wp.int32, y: VecArray2d, elements: Elements) -> wp.mat33d:
    """F of element e. Differences to corner 0, so that a common translation costs no digits."""
    x0 = y[env, elements.tets[e, 0]]
    F = wp.outer(y[env, elements.tets[e, 1]] - x0, elements.grads[e, 1])
    F += wp.outer(y[env, elements.tets[e, 2]] - x0, elements.grads[e, 2])
    F += wp.outer(y[env, elements.tets[e, 3]] - x0, elements.grads[e, 3])
    return F


@wp.kernel
def element_state(
    y: VecArray2d,
    elements: Elements,
    dilation: FloatArray2d,
    active: IntArray,
    project: IntArray,
    # outputs
    el_F: MatArray2d,
    el_P: MatArray2d,
    el_mckl: Vec4Array2d,
    el_J: FloatArray2d,
    el_energy: FloatArray2d,
):
    """F, volume·P, (m, c', k, l), J and energy [J] of every element of the active environments.

    ``dilation``: J̄ of every volume block. In a block, where the second derivative is projected, λ' counts as μ at least in l: without a
    λ of its own an element would have to give up half of c even at rest, and with it the freedom to turn.
    """
    env, e = wp.tid()
    if active[env] == 0:
        return
    mu, lam = elements.mu[e], elements.lam[e]
    F = deformation(env, e, y, elements)
    J = wp.determinant(F)
    mean = J
    own = elements.own[e]
    stiff = own + lam * squeeze_second(J)
    block = elements.volume_block[e]
    if block >= 0:
        mean = dilation[env, block]
        if project[env] != 0:
            stiff += wp.max(mu - own, wp.float64(0.0))
    f = stress_factors(F, J, mean, own, elements.model[e], mu, lam)
    c = f[1]
    if project[env] != 0 and elements.model[e] != 2:
        c = geometric_factor(F, f[0], f[2], stiff, c)
    el_F[env, e] = F
    el_P[env, e] = elements.volume[e] * first_piola(F, f, elements.model[e], mu)
    el_mckl[env, e] = wp.vec4d(f[0], c, f[2], stiff)
    el_J[env, e] = J
    el_energy[env, e] = elements.volume[e] * strain_energy(F, mean, own, elements.model[e], mu, lam)


@wp.kernel
def node_elastic_gradient(
    corner_start: IntArray, corner: IntArray, elements: Elements, el_P: MatArray2d, active: IntArray, gradient: VecArray2d
):
    """∂Ψ/∂y of every node [N], body frame; gathered, so the order of the sum never changes."""
    env, i = wp.tid()
    if active[env] == 0:
        return
    g = wp.vec3d()
    for k in range(corner_start[i], corner_start[i + 1]):
        e = corner[k] / 4
        g += el_P[env, e] * elements.grads[e, corner[k] - 4 * e]
    gradient[env, i] = g


@wp.func
def even_part(
    model: wp.int32,
    mu: wp.float64,
    f: wp.vec4d,
    ga: wp.vec3d,
    gb: wp.vec3d,
    ba: wp.vec3d,
    bb: wp.vec3d,
    ca: wp.vec3d,
    cb: wp.vec3d,
) -> wp.mat33d:
    """Block of corners a and b over the volume [Pa/m²], but for its part with c.

    b = F g and c = cof F g of the corners' g = ∇w.
    """
    one = wp.identity(n=3, dtype=wp.float64)
    if model == 2:
        # The Gauss-Newton part; (F Fᵀ − 1) stays tiny while the body is near-rigid, and is not always positive.
        return (wp.float64(4.0) * mu) * (wp.dot(ba, bb) * one + wp.outer(bb, ba))
    return (f[0] * wp.dot(ga, gb)) * one + f[2] * wp.outer(ba, bb) + f[3] * wp.outer(ca, cb)


@wp.func
def odd_part(model: wp.int32, f: wp.vec4d, F: wp.mat33d, ga: wp.vec3d, gb: wp.vec3d) -> wp.mat33d:
    """Its part with c, which is antisymmetric and vanishes on the diagonal."""
    if model == 2:
        return wp.mat33d()
    return -f[1] * wp.skew(F * wp.cross(ga, gb))


@wp.func
def inertia_block(masses: Masses, dt: FloatArray, env: wp.int32, k: wp.int32) -> wp.mat33d:
    """Inertia and drag of block k [N/m]."""
    h = dt[env] + wp.float64(0.0)
    return (masses.inertia[k] * (wp.float64(1.0) / (h * h)) + masses.drag[k] / h) * wp.identity(n=3, dtype=wp.float64)


@wp.kernel
def block_hessian(
    upper: IntArray2d,
    part_start: IntArray,
    part: IntArray,
    elements: Elements,
    masses: Masses,
    dt: FloatArray,
    el_F: MatArray2d,
    el_mckl: Vec4Array2d,
    active: IntArray,
    # outputs
    blocks: MatArray2d,
):
    """Blocks of the elastic and inertial Hessian [N/m], gathered from the elements.

    Each row of ``upper`` names a block on or above the diagonal, where it is to lie, and where its transpose. A thread a block, so that
    sums have one order; :func:`add_element_blocks` computes the same on a CPU.
    """
    env, u = wp.tid()
    if active[env] == 0:
        return
    k = upper[u, 0]
    H = inertia_block(masses, dt, env, k)
    for s in range(part_start[k], part_start[k + 1]):
        e = part[s] / 16
        code = part[s] - 16 * e
        ga = elements.grads[e, code / 4]
        gb = elements.grads[e, code % 4]
        F, f, model = el_F[env, e], el_mckl[env, e], elements.model[e]
        C = cofactor(F)
        even = even_part(model, elements.mu[e], f, ga, gb, F * ga, F * gb, C * ga, C * gb)
        H += elements.volume[e] * (even + odd_part(model, f, F, ga, gb))
    blocks[env, upper[u, 1]] = H
    if upper[u, 2] != upper[u, 1]:
        blocks[env, upper[u, 2]] = wp.transpose(H)


@wp.kernel
def fill_inertia(upper: IntArray2d, masses: Masses, dt: FloatArray, active: IntArray, blocks: MatArray2d):
    """Inertia and drag in the blocks ``upper``, on and above the diagonal [N/m]."""
    env, u = wp.tid()
    if active[env] != 0:
        blocks[env, upper[u, 1]] = inertia_block(masses, dt, env, upper[u, 0])


@wp.struct
class Corner:
    """A corner of an element: g = ∇w, b = F g, c = cof F g."""

    g: wp.vec3d
    b: wp.vec3d
    c: wp.vec3d


@wp.func
def corner_of(elements: Elements, e: wp.int32, a: wp.int32, F: wp.mat33d, C: wp.mat33d) -> Corner:
    g = elements.grads[e, a] + wp.vec3d()
    return Corner(g, F * g, C * g)


UNUSED = wp.constant(-(2**31))
"""Place of a block that is left out."""


@wp.func
def add_block(
    place: wp.int32,
    p: Corner,
    q: Corner,
    model: wp.int32,
    mu: wp.float64,
    f: wp.vec4d,
    volume: wp.float64,
    F: wp.mat33d,
    env: wp.int32,
    blocks: MatArray2d,
):
    """Add the block of two corners to ``place``.

    A negative one is that of its transpose, less one and with the other sign; ``UNUSED``: nobody reads the block.
    """
    if place == UNUSED:
        return
    even, odd = even_part(model, mu, f, p.g, q.g, p.b, q.b, p.c, q.c), odd_part(model, f, F, p.g, q.g)
    if place >= 0:
        blocks[env, place] = blocks[env, place] + volume * (even + odd)
    else:
        blocks[env, -1 - place] = blocks[env, -1 - place] + volume * wp.transpose(even + odd)


@wp.func
def add_diagonal(
    place: wp.int32,
    p: Corner,
    model: wp.int32,
    mu: wp.float64,
    f: wp.vec4d,
    volume: wp.float64,
    env: wp.int32,
    blocks: MatArray2d,
):
    """The same of one corner."""
    if place != UNUSED:
        blocks[env, place] = blocks[env, place] + volume * even_part(model, mu, f, p.g, p.g, p.b, p.b, p.c, p.c)


@wp.kernel
def add_element_blocks(
    places: IntArray2d,
    elements: Elements,
    el_F: MatArray2d,
    el_mckl: Vec4Array2d,
    active: IntArray,
    # outputs
    blocks: MatArray2d,
):
    """Add the elastic Hessian of every element to the blocks on and above the diagonal [N/m].

    Only where threads run one after the other, as on a CPU. An element computes what its ten blocks share once, where
    :func:`block_hessian` computes it for each block. Row e of ``places`` has those of its diagonal blocks and of its pairs of corners
    01, 02, 03, 12, 13, 23, see :func:`add_block`.
    """
    env, e = wp.tid()
    if active[env] == 0:
        return
    model, volume = elements.model[e] + 0, elements.volume[e] + wp.float64(0.0)
    mu = elements.mu[e] + wp.float64(0.0)
    f = el_mckl[env, e] + wp.vec4d()
    F = el_F[env, e] + wp.mat33d()
    C = cofactor(F)
    p0, p1 = corner_of(elements, e, 0, F, C), corner_of(elements, e, 1, F, C)
    p2, p3 = corner_of(elements, e, 2, F, C), corner_of(elements, e, 3, F, C)
    add_diagonal(places[e, 0], p0, model, mu, f, volume, env, blocks)
    add_diagonal(places[e, 1], p1, model, mu, f, volume, env, blocks)
    add_diagonal(places[e, 2], p2, model, mu, f, volume, env, blocks)
    add_diagonal(places[e, 3], p3, model, mu, f, volume, env, blocks)
    add_block(places[e, 4], p0, p1, model, mu, f, volume, F, env, blocks)
    add_block(places[e, 5], p0, p2, model, mu, f, volume, F, env, blocks)
    add_block(places[e, 6], p0, p3, model, mu, f, volume, F, env, blocks)
    add_block(places[e, 7], p1, p2, model, mu, f, volume, F, env, blocks)
    add_block(places[e, 8], p1, p3, model, mu, f, volume, F, env, blocks)
    add_block(places[e, 9], p2, p3, model, mu, f, volume, F, env, blocks)


PAIRS = (0, 5, 10, 15, 1, 2, 3, 6, 7, 11)
"""4·a + b of the pairs of corners in :func:`add_element_blocks`."""


@wp.kernel
def mirror_blocks(upper: IntArray2d, active: IntArray, blocks: MatArray2d):
    """Transposes of the blocks above the diagonal to where they lie below it."""
    env, u = wp.tid()
    if active[env] != 0 and upper[u, 2] != upper[u, 1]:
        blocks[env, upper[u, 2]] = wp.transpose(blocks[env, upper[u, 1]])


@wp.kernel
def element_energy_change(
    el_F: MatArray2d,
    y1: VecArray2d,
    elements: Elements,
    active: IntArray,
    # outputs
    change: FloatArray2d,
    det: FloatArray2d,
    det_change: FloatArray2d,
):
    """Ψ(y1) − Ψ(y0) of every element [J], J at y1, and its change; ``el_F``: F at y0.

    Sums of differences keep digits.

    What belongs to a volume block is left to the block.
    """
    env, e = wp.tid()
    if active[env] == 0:
        return
    F0 = el_F[env, e] + wp.mat33d()
    F1 = deformation(env, e, y1, elements)
    if elements.volume_block[e] >= 0:
        det_change[env, e] = volume_change(F0, F1)
    psi = strain_energy_change(F0, F1, elements.own[e], elements.model[e], elements.mu[e], elements.lam[e])
    change[env, e] = elements.volume[e] * psi
    det[env, e] = wp.determinant(F1)
