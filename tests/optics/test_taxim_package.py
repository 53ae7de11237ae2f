"""Where the PyPI package ``taxim`` 1.4.1 differs from the simulator that it ports, each difference reproduced on its own.

``Package`` is the package's algorithm in NumPy with every deviation as a switch. With all of them on it is the package; with all of
them off it is ``tests.optics.taxim_upstream``. So the differences are explained, and raytac follows the first release.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import convolve1d

from tests.optics import taxim_upstream as upstream

jax = pytest.importorskip("jax", reason="the package taxim computes with JAX, which is not installed")
taxim = pytest.importorskip("taxim", reason="the package taxim is not installed")
if importlib.util.find_spec("taxim") is not None and not hasattr(taxim, "CALIB_GELSIGHT"):
    pytest.skip("another version of the package taxim", allow_module_level=True)

pytestmark = pytest.mark.slow  # JAX compiles for a quarter of a minute

PIXMM, DEPTH = 0.0295, 0.8


@dataclass(frozen=True)
class Package:
    """Switches of the deviations; True is the package's way."""

    swapped_widths: bool = True
    """(a) The last blur of the heights has σ = 2.0 px (first release 1.1)."""
    short_kernels: bool = True
    """(b) Kernels have about 4 of the Gaussian's tails' taps fewer: the half width is taken for the width."""
    no_fill: bool = True
    """(c) The threshold of 5 levels is compared with images in [0, 1], so dark dots are never filled."""
    object_contact: bool = True
    """(f) Contact is where the object lies below the gel's highest plane, not below the gel."""
    other_fan: bool = True
    """(d) Shadow rays at linspace(−0.1, 0.1, 4) rad, not at arange(−0.1, 0.1, 0.05) (four or five)."""
    late_values: bool = True
    """(e) A list's value k lies k + 1 steps away, the first one included, not k."""

    def blur(self, image: np.ndarray, sigma: float, size: int) -> np.ndarray:
        if self.short_kernels:
            size = int(np.round(np.sqrt(-2 * np.log(1e-5 * np.sqrt(2 * np.pi) * sigma)) * sigma)) // 2 * 2 + 1
        k = np.arange(size) - size // 2
        weights = np.exp(-0.5 * (k / sigma) ** 2)
        for axis in (0, 1):
            image = convolve1d(image, weights / weights.sum(), axis=axis, mode="mirror")
        return image

    @property
    def last(self) -> float:
        return 2.0 if self.swapped_widths else 1.1

    def heights(self, object_mm: np.ndarray, gel_map: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(surface, gel) [mm], 0 at the gel's highest plane and negative below, of an object in place."""
        gel = self.blur(gel_map.astype(float), self.last, 5) * PIXMM
        gel = gel - gel.max()
        contact = object_mm < (0 if self.object_contact else gel)
        joined = np.minimum(object_mm, gel)
        mask = (joined - gel < 0.4 * object_mm.min()) & contact
        z = joined
        for sigma, size in zip((30.5, 15.5, 8.0, 3.5, 2.0, 1.1), upstream.PYRAMID, strict=True):
            z = np.where(mask, joined, self.blur(z, sigma, size))
        return self.blur(z, self.last, 5), gel

    def background(self, f0: np.ndarray) -> np.ndarray:
        """[levels]"""
        sharp = f0.astype(float)
        if not self.no_fill:
            return upstream.processed_background(f0)
        blurred = np.stack([self.blur(sharp[..., c], 50.0, 401) for c in range(3)], axis=-1)
        return 0.15 * blurred + 0.85 * sharp


def calibration() -> Path:
    return Path(taxim.CALIB_GELSIGHT)


@pytest.fixture(scope="module")
def object_mm() -> np.ndarray:
    y, x = np.mgrid[0:480, 0:640]
    height = np.sqrt(np.maximum(90.0**2 - (x - 310.0) ** 2 - (y - 230.0) ** 2, 0)) * PIXMM
    return height.max() - DEPTH - height


@pytest.fixture(scope="module")
def package_image(object_mm: np.ndarray) -> np.ndarray:
    """The package's own image without shadow, R, G, B [levels]."""
    simulator: Any = taxim.Taxim(calib_folder=calibration(), backend="jax")
    return 255 * np.asarray(simulator.render(object_mm.astype(np.float32), with_shadow=False), dtype=float)


def simulator_of(package: Package) -> upstream.Upstream:
    folder = calibration()
    with np.load(folder / "polycalib.npz") as data:
        table = np.stack([data["grad_r"], data["grad_g"], data["grad_b"]])
    with np.load(folder / "dataPack.npz") as data:
        background = package.background(data["f0"])
    with np.load(folder / "shadowTable.npz", allow_pickle=True) as data:
        return upstream.Upstream(table, background, PIXMM, data["shadowTable"], data["shadowDirections"])


def image_of(package: Package, object_mm: np.ndarray) -> np.ndarray:
    """Without shadow, R, G, B [levels], clipped (g)."""
    z, gel = package.heights(object_mm, np.load(calibration() / "gelmap.npy"))
    return np.clip(simulator_of(package).image(-z / PIXMM, np.zeros(z.shape, bool), (gel - z) / PIXMM)[..., ::-1], 0, 255)


def shadows_of(package: Package, object_mm: np.ndarray) -> np.ndarray:
    """What shadows change before any blur, B, G, R [levels], (H, W, 3)."""
    z_mm, gel = package.heights(object_mm, np.load(calibration() / "gelmap.npy"))
    simulator, z, lift = simulator_of(package), -z_mm / PIXMM, (gel - z_mm) / PIXMM
    assert simulator.shadow is not None
    mask = (np.minimum(object_mm, gel) - gel < 0.4 * object_mm.min()) & (object_mm < gel)
    _, direction = upstream.slopes(z)
    out = np.zeros((*z.shape, 3))
    for c in range(3):
        for row, column in zip(*np.nonzero(upstream.dilate(mask) & ~mask), strict=True):
            n = int((direction[row, column] + np.pi) // 0.1)
            depth = int((lift[row, column] * PIXMM - 0.4) // 0.1) + 6
            levels = simulator.shadow[c][n][depth] if 0 <= depth < len(simulator.shadow[c][n]) else []
            a = simulator.directions[n]
            fan = a + np.linspace(-0.1, 0.1, 4) if package.other_fan else np.arange(a - 0.1, a + 0.1, 0.05)
            first, late = (0, 1) if package.late_values else (1, 0)
            for theta in fan:
                for k in range(first, len(levels)):
                    way = 1.25 * (k + late)
                    u, v = int(column + way * np.cos(theta)), int(row + way * np.sin(theta))
                    if 0 <= u < z.shape[1] and 0 <= v < z.shape[0] and z[row, column] > z[v, u]:
                        out[v, u, c] = min(out[v, u, c], levels[k])
    return out


def shadow_image_of(package: Package, object_mm: np.ndarray) -> np.ndarray:
    """With shadow, R, G, B [levels], clipped: (a) blurs the difference by 1.1 px and the image by 2.0, the first release the reverse."""
    z_mm, gel = package.heights(object_mm, np.load(calibration() / "gelmap.npy"))
    simulator = simulator_of(package)
    z, lift = -z_mm / PIXMM, (gel - z_mm) / PIXMM
    change = simulator.image(z, np.zeros(z.shape, bool), lift) - simulator.background
    cast = shadows_of(package, object_mm)
    change = np.where(cast < 0, np.minimum(change, cast), change)
    image = package.blur(change, 1.1, 5) + simulator.background
    return np.clip(package.blur(image, 2.0, 5)[..., ::-1], 0, 255)


def test_with_all_deviations_it_is_the_package(object_mm: np.ndarray, package_image: np.ndarray) -> None:
    """float32 puts a few slopes on the other side of a bin's edge: all other pixels agree. (g) The package clips."""
    difference = np.abs(image_of(Package(), object_mm) - package_image).max(axis=-1)
    assert np.median(difference) < 0.01
    assert (difference > 0.1).mean() < 0.02


@pytest.mark.parametrize("name", ["swapped_widths", "short_kernels", "no_fill"])
def test_each_deviation_is_needed(object_mm: np.ndarray, package_image: np.ndarray, name: str) -> None:
    without = np.abs(image_of(Package(**{name: False}), object_mm) - package_image)
    explained = np.abs(image_of(Package(), object_mm) - package_image)
    assert without.mean() > 1.5 * explained.mean(), f"{without.mean()} against {explained.mean()} levels"


def test_with_none_of_them_it_is_the_first_release(object_mm: np.ndarray) -> None:
    none = Package(swapped_widths=False, short_kernels=False, no_fill=False, object_contact=False)
    gel_map = np.load(calibration() / "gelmap.npy")
    z, gel = none.heights(object_mm, gel_map)
    expected, _, lift = upstream.deform(-object_mm / PIXMM + 5.0 / PIXMM, gel_map, DEPTH, PIXMM)
    np.testing.assert_allclose((gel - z) / PIXMM, lift, atol=1e-6)
    assert np.ptp(expected) > 20


def test_the_contact_rule_changes_nothing(object_mm: np.ndarray) -> None:
    """(f) A pixel that passes 0.4 of the depth lies below the gel, and so below its highest plane: either rule admits it."""
    np.testing.assert_array_equal(image_of(Package(object_contact=False), object_mm), image_of(Package(), object_mm))


def test_with_shadow_it_is_the_package_and_fan_and_steps_are_needed(object_mm: np.ndarray) -> None:
    simulator: Any = taxim.Taxim(calib_folder=calibration(), backend="jax")
    theirs = 255 * np.asarray(simulator.render(object_mm.astype(np.float32), with_shadow=True), dtype=float)
    explained = np.abs(shadow_image_of(Package(), object_mm) - theirs)
    assert explained.mean() < 0.01 and (explained.max(axis=-1) > 0.5).mean() < 0.005
    for name in ("other_fan", "late_values"):
        without = np.abs(shadow_image_of(Package(**{name: False}), object_mm) - theirs)
        assert without.mean() > 1.5 * explained.mean(), f"{name}: {without.mean()} against {explained.mean()} levels"
