"""FOTS' shear against the linear elasticity of a bonded layer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.linalg import LinearOperator, cg

from raytac.gel.surface import PadGrid, make_grid
from raytac.specs import PunchSpec, load_sensor
from tests.markers.test_fots_punch import moved

MINI = load_sensor("gelsight_mini")
GRID: PadGrid = make_grid(MINI.gelpad, 0.4e-3)


def punch() -> PunchSpec:
    """The Mini's, of which nothing slips."""
    assert MINI.marker_motion is not None and MINI.marker_motion.punch is not None
    return replace(MINI.marker_motion.punch, slip=1e9)


def in_plane(
    radius: float, thickness: float, poisson: float, *, stretch: bool = False, n: int = 128, size: float = 0.0
) -> tuple[np.ndarray, ...]:
    """Distance from the middle [m] and motion along x, there along x and along y, around a disc that sticks to a bonded layer.

    The disc is sheared by 1 along x, or (``stretch``) every point of it moves by its place; then the motion along x is all. Traction by
    conjugate gradients; its displacements by the layer's compliance in the Fourier domain, with a period of ``size``, 0 for ten times
    the thickness.
    """
    size = size or 10.0 * thickness
    place = (np.arange(n) - n // 2) * size / n
    x, y = np.meshgrid(place, place, indexing="ij")
    inside = x**2 + y**2 <= radius**2
    wave = 2.0 * np.pi * np.fft.fftfreq(n, size / n)
    kx, ky = np.meshgrid(wave, wave, indexing="ij")
    k = np.hypot(kx, ky)
    k[0, 0] = 1e-6 / thickness
    s, kappa = np.minimum(k * thickness, 40.0), 3.0 - 4.0 * poisson
    plane = (2.0 * kappa * np.sinh(2.0 * s) + 4.0 * s) / (2.0 * kappa * np.cosh(2.0 * s) + 1.0 + kappa**2 + 4.0 * s**2)
    plane, out = (1.0 - poisson) / k * plane, np.tanh(s) / k
    plane[0, 0] = out[0, 0] = thickness
    cos, sin = kx / k, ky / k
    along, mixed, across = plane * cos**2 + out * sin**2, (plane - out) * cos * sin, plane * sin**2 + out * cos**2

    def displacement(traction: np.ndarray) -> np.ndarray:
        full = np.zeros((2, n, n))
        full[:, inside] = traction.reshape(2, -1)
        tx, ty = np.fft.fft2(full)
        return np.fft.ifft2(np.stack([along * tx + mixed * ty, mixed * tx + across * ty])).real

    count = int(inside.sum())
    inner = LinearOperator((2 * count, 2 * count), matvec=lambda q: displacement(q)[:, inside].ravel(), dtype=float)  # type: ignore[call-arg]
    prescribed = np.concatenate([x[inside], y[inside]]) if stretch else np.repeat([1.0, 0.0], count)
    traction, _ = cg(inner, prescribed, rtol=1e-4)
    moved = displacement(traction)[0]
    there = place[n // 2 :], moved[n // 2 :, n // 2], moved[n // 2, n // 2 :]
    return there[:2] if stretch else there


@pytest.mark.parametrize("radius", [1.6e-3, 2.4e-3])
def test_around_a_contact_the_skin_moves_nearly_as_that_of_a_bonded_layer(radius: float) -> None:
    gel, shear = MINI.gelpad, 1e-5
    r, along, across = in_plane(radius, gel.thickness, gel.poisson_ratio)
    near = (r > 1.2 * radius) & (r < 10e-3)
    contact = shear, 0.0, shear, 0.0, 0.0, radius**2, 0.0, radius**2, 1e-3
    zero = np.zeros(int(near.sum()))
    there = [
        moved(GRID, punch(), [contact], np.stack(places, axis=1))[:, 0] / shear for places in ((r[near], zero), (zero, r[near]))
    ]
    for fots, elastic, most in zip(there, (along[near], across[near]), (0.08, 0.11), strict=True):
        print(np.round(np.stack([1e3 * r[near], fots, elastic]), 2))
        assert np.abs(fots - elastic).max() < most
