"""The oracles of the closed-form tests, checked by routes of their own: they must not share an error with the solver."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import spsolve

from tests.ipc.oracles.closed_forms import (
    BondedLayer,
    Elastic,
    boussinesq_displacement,
    hertz_force,
    layer_compliance,
    punch_force,
)

SOLID = Elastic(1e5, 0.3)


def surface_sink(poisson: float, k: float) -> float:
    """Sink of a layer of thickness 1 on a rigid base under the pressure cos(k x), E* = 1, by finite differences through the thickness.

    Plane strain, u_x = U(z) sin(k x), u_z = W(z) cos(k x): linear elements in z for the two amplitudes, no formula of the layer's used.
    """
    young = 1 - poisson**2
    lam, mu = young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))
    n = 300
    z = np.linspace(0, 1, n + 1) ** 1.5  # from the base up, finest where nothing moves; the surface has n/1.5 cells a unit
    z = 1 - z[::-1]
    K = np.zeros((n + 1, 2, n + 1, 2))
    for e in range(n):
        h = z[e + 1] - z[e]
        for point, weight in ((0.5 - 12**-0.5, h / 2), (0.5 + 12**-0.5, h / 2)):
            value, slope = np.array([1 - point, point]), np.array([-1, 1]) / h
            # strains of the four amplitudes (U0, W0, U1, W1): e_xx, e_zz, 2 e_xz
            B = np.zeros((3, 4))
            B[0, 0::2], B[1, 1::2] = k * value, slope
            B[2, 0::2], B[2, 1::2] = slope, -k * value
            D = np.array([[lam + 2 * mu, lam, 0], [lam, lam + 2 * mu, 0], [0, 0, mu]])
            K[e : e + 2, :, e : e + 2, :] += weight * (B.T @ D @ B).reshape(2, 2, 2, 2)
    A = K.reshape(2 * n + 2, 2 * n + 2)[2:, 2:]
    load = np.zeros(2 * n)
    load[-1] = 1.0
    return float(np.linalg.solve(A, load)[-1])


@pytest.mark.parametrize(("poisson", "s"), [(0.3, 0.7), (0.45, 1.5), (0.0, 3.0)])
def test_layer_compliance_is_that_of_a_layer_cut_into_slices(poisson: float, s: float) -> None:
    assert surface_sink(poisson, s) == pytest.approx(2 * float(layer_compliance(poisson, s)) / s, rel=1e-4)


def test_layer_presses_have_their_limits() -> None:
    """A thick layer is a half-space; a thin, compressible one under a wide punch is a bed of columns; forces follow from energies."""
    a, R = 1e-3, 20e-3
    thick = BondedLayer(SOLID, 1.0)
    assert thick.punch_force(a, 1e-5) == pytest.approx(punch_force(SOLID, a, 1e-5), rel=2e-3)
    assert thick.sphere_force(R, 5e-5) == pytest.approx(hertz_force(SOLID, R, 5e-5), rel=2e-3)
    column = SOLID.young * 0.7 / (1.3 * 0.4)
    ratios = [BondedLayer(SOLID, 1e-3, 80).punch_force(r, 1e-5) / (np.pi * r**2 * column * 1e-2) for r in (5e-3, 10e-3, 20e-3)]
    # What the rim adds falls as 1/r.
    assert ratios[2] - 1 == pytest.approx((ratios[1] - 1) / 2, rel=0.1) and ratios[2] == pytest.approx(1, abs=0.02)
    layer = BondedLayer(SOLID, 4e-3)
    depth, force = layer.sphere(R, a)
    assert layer.sphere_force(R, depth) == pytest.approx(force, rel=1e-9)
    # dF/dδ of the sphere is the stiffness of a punch as wide as its contact.
    ends = np.array([layer.sphere(R, a * (1 + s)) for s in (-1e-4, 1e-4)])
    slope = (ends[1] - ends[0])[1] / (ends[1] - ends[0])[0]
    assert slope == pytest.approx(layer.punch_force(a, 1.0), rel=1e-5)


def test_boussinesq_field_is_in_equilibrium_and_carries_its_load() -> None:
    """Navier's equation by differences, and the traction on a hemisphere adds up to the force."""
    rng = np.random.default_rng(0)
    points = rng.standard_normal((20, 3))
    points[:, 2] = -np.abs(points[:, 2]) - 0.3
    h = 1e-3
    eye = np.eye(3)

    def u(p: np.ndarray) -> np.ndarray:
        return boussinesq_displacement(SOLID, 1.0, p) * SOLID.young

    second = np.array(
        [
            [(u(points + h * (eye[i] + eye[j])) - u(points + h * (eye[i] - eye[j]))
              - u(points - h * (eye[i] - eye[j])) + u(points - h * (eye[i] + eye[j]))) / (4 * h * h) for j in range(3)]
            for i in range(3)
        ]
    )  # fmt: skip
    laplace, grad_div = np.einsum("iinc->nc", second), np.einsum("cjnj->nc", second)
    assert np.abs(laplace).max() > 0.1
    assert np.abs(laplace + grad_div / (1 - 2 * SOLID.poisson)).max() < 1e-4 * np.abs(laplace).max()
    c, w = np.polynomial.legendre.leggauss(40)
    cosine, w = (c - 1) / 2, w / 2  # lower hemisphere
    angle = (np.arange(40) + 0.5) * 2 * np.pi / 40
    cos_, ang = np.meshgrid(cosine, angle, indexing="ij")
    n = np.stack([np.sqrt(1 - cos_**2) * np.cos(ang), np.sqrt(1 - cos_**2) * np.sin(ang), cos_], -1).reshape(-1, 3)
    grad = np.stack([(u(n + h * e) - u(n - h * e)) / (2 * h) for e in eye], axis=-1) / SOLID.young
    strain = (grad + np.swapaxes(grad, 1, 2)) / 2
    lam = SOLID.young * SOLID.poisson / ((1 + SOLID.poisson) * (1 - 2 * SOLID.poisson))
    stress = 2 * SOLID.shear * strain + lam * np.einsum("nii->n", strain)[:, None, None] * eye
    total = np.einsum("nij,nj,n->i", stress, n, np.repeat(w, 40) * 2 * np.pi / 40)
    assert total == pytest.approx([0, 0, 1.0], abs=1e-4)


def torsion(ratio: float, n: int = 120) -> float:
    """Torque per angle of a disc of radius 1 on a layer of thickness 1 / ``ratio``, G = 1, by finite volumes over radius and depth.

    The angle ω obeys ∇·(r³ ∇ω) = 0, and the torque is 2π ∫∫ r³ |∇ω|². Cells are finest at the disc's edge.
    """
    grade = np.linspace(0.0, 1.0, n + 1) ** 2
    r, z = np.concatenate([1.0 - grade[::-1], 1.0 + 7.0 * grade[1:]]), grade / ratio
    border = np.concatenate([r[:1], 0.5 * (r[1:] + r[:-1]), r[-1:]])
    height = 0.5 * (np.diff(z, prepend=0.0) + np.diff(z, append=z[-1]))
    along = (0.25 * np.diff(r**4) / np.diff(r) ** 2)[:, None] * height
    down = 0.25 * np.diff(border**4)[:, None] / np.diff(z)
    node = np.arange(len(r) * len(z)).reshape(len(r), len(z))
    one, two = np.r_[node[:-1].ravel(), node[:, :-1].ravel()], np.r_[node[1:].ravel(), node[:, 1:].ravel()]
    weight, edge = np.concatenate([along.ravel(), down.ravel()]), np.arange(len(one))
    gradient = coo_array((np.r_[-np.ones(len(one)), np.ones(len(one))], (np.r_[edge, edge], np.r_[one, two]))).tocsr()
    stiffness = (gradient.T @ diags_array(weight) @ gradient).tocsr()
    angle, free = np.zeros(node.shape), np.ones(node.shape, bool)
    angle[r <= 1.0, 0] = 1.0
    free[r <= 1.0, 0] = free[-1] = free[:, -1] = False
    inner, turned = node[free], angle.ravel()
    turned[inner] = np.asarray(spsolve(stiffness[inner][:, inner].tocsc(), -(stiffness @ turned)[inner]))
    return 2.0 * np.pi * float(turned @ (stiffness @ turned))


def test_the_twist_of_a_layer_is_that_of_its_volume() -> None:
    for ratio in (0.5, 1.5):
        assert BondedLayer(Elastic(3.0, 0.5), 1.0 / ratio).twist_stiffness(1.0) == pytest.approx(torsion(ratio), rel=0.02)
    assert BondedLayer(Elastic(3.0, 0.5), 100.0).twist_stiffness(1.0) == pytest.approx(16.0 / 3.0, rel=1e-5)
