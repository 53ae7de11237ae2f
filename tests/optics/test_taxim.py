"""The table mode against an independent implementation of upstream's semantics, on random tables and on upstream's own calibration."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest

from raytac.gel.gaussian import gaussian_matrix
from raytac.gel.pyramid import ElasticSurround
from raytac.gel.surface import PadGrid
from raytac.optics.image.base import ImageHeights
from raytac.optics.runtime import load_mitsuba
from raytac.optics.taxim.folder import load_calibration, processed_background
from raytac.optics.taxim.mode import TableShader
from raytac.optics.taxim.table import PolyTable, ShadowTable, TaximConstants
from tests.optics import taxim_upstream as upstream

PIXMM = 0.0295
NEAR_EDGE = 2e-3
"""Bins within which float32 may round a slope to the other side of a bin's edge."""


@pytest.fixture(scope="module")
def mi() -> Any:
    return load_mitsuba("cpu")[0]


def shade(mi: Any, table: PolyTable, z: np.ndarray, mask: np.ndarray, lift: np.ndarray, *, shadow: bool) -> np.ndarray:
    """The mode's shader on one height image [px], (H, W, 3) R, G, B."""
    h, w = z.shape
    heights, moved = (mi.Float(np.ascontiguousarray(a, dtype=np.float32).ravel()) for a in (z, lift))
    contact = mi.UInt8(mask.astype(np.uint8).ravel())
    shader = TableShader(mi, table, (w, h), table.pixel_pitch[0], shadow=shadow)
    channels, _ = shader.levels(ImageHeights(heights, moved, contact, 1, (w, h)), shader.inputs)
    return np.stack([np.array(c) for c in channels], axis=-1).reshape(h, w, 3)


def random_table(rng: np.random.Generator, shape: tuple[int, int], n: int = 40) -> PolyTable:
    gradients = rng.normal(size=(3, n, n, 6)) * np.array([2e-4, 2e-4, 2e-4, 2e-2, 2e-2, 12.0])
    lengths = rng.integers(0, 20, (3, 63, 9)).astype(np.int32)
    values = rng.uniform(-60, -10, (3, 63, 9, 20)).astype(np.float32)
    shadow = ShadowTable(np.arange(0, 2 * np.pi, 0.1), values, lengths)
    background = rng.integers(60, 180, (*shape, 3)).astype(np.float32)
    return PolyTable(gradients, None, background, (1e-3 * PIXMM, 1e-3 * PIXMM), shadow, slopes_of="height")


def as_upstream(table: PolyTable) -> upstream.Upstream:
    lists = None
    if table.shadow is not None:
        s = table.shadow
        lists = [
            [
                [s.values[c, a, d, : s.lengths[c, a, d]].astype(float).tolist() for d in range(s.lengths.shape[2])]
                for a in range(63)
            ]
            for c in (2, 1, 0)
        ]
    return upstream.Upstream(table.gradients[::-1], table.background[..., ::-1].astype(float), 1e3 * table.pixel_pitch[0], lists)


def random_surface(rng: np.random.Generator, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(z, mask, lift) [px]: smooth hills up to 40 px over a tilted plane; the higher ones touch."""
    hills = upstream.opencv_blur(rng.normal(size=shape), 31)
    lift = np.maximum(40 * hills / hills.max(), 0)
    tilt = 0.05 * np.arange(shape[1]) - 0.03 * np.arange(shape[0])[:, None]
    # What float32 holds exactly, so that both sides shade one surface.
    lift, tilt = np.round(lift * 256) / 256, np.round(tilt * 256) / 256
    return lift + tilt, lift > 0.55 * lift.max(), lift


def errors_beside_ties(
    table: PolyTable, z: np.ndarray, mask: np.ndarray, lift: np.ndarray, got: np.ndarray
) -> tuple[np.ndarray, float]:
    """Largest channel error of every pixel [levels], without shadows, and the share of pixels whose slope lies on the edge of two bins:
    there either bin's image is right."""
    reference = as_upstream(table)
    magnitude, direction = upstream.slopes(z)
    i, j = reference.bins(magnitude, direction)
    best = np.full(z.shape, np.inf)
    for a in (-NEAR_EDGE, NEAR_EDGE):
        for b in (-NEAR_EDGE, NEAR_EDGE):
            image = reference.with_bins(z, mask, lift, i + a, j + b, direction, shadow=False)
            best = np.minimum(best, np.abs(image[..., ::-1] - got).max(axis=-1))
    on_edge = (np.abs(i - np.round(i)) < NEAR_EDGE) | (np.abs(j - np.round(j)) < NEAR_EDGE)
    return best, float((on_edge & (magnitude > 0)).mean())


@pytest.mark.parametrize("seed", range(3))
def test_parity_without_shadow_on_random_tables_and_surfaces(mi: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    table, surface = random_table(rng, (60, 80)), random_surface(rng, (60, 80))
    error, on_edge = errors_beside_ties(table, *surface, shade(mi, table, *surface, shadow=False))
    assert on_edge < 0.02
    assert error.max() <= 0.01, f"{error.max()} levels"


@pytest.mark.parametrize("seed", range(3))
def test_parity_with_shadow_on_random_tables_and_surfaces(mi: Any, seed: int) -> None:
    """A slope on the edge of two bins would smear through the blur, so the polynomials are those of one bin; the shadows are not."""
    rng = np.random.default_rng(seed)
    table, surface = random_table(rng, (60, 80), n=2), random_surface(rng, (60, 80))
    expected = as_upstream(table).image(*surface, shadow=True)[..., ::-1]
    bare = as_upstream(table).image(*surface)[..., ::-1]
    got = shade(mi, table, *surface, shadow=True)
    assert np.abs(expected - bare).max() > 10, "no shadow was cast"
    assert np.abs(got - expected).max() <= 0.01, f"{np.abs(got - expected).max()} levels"


# -------------------------------------------------------------------- upstream's own calibration

_PACKAGE = importlib.util.find_spec("taxim")
needs_taxim = pytest.mark.skipif(
    _PACKAGE is None, reason="the package taxim, which brings upstream's calibration, is not installed"
)


def calibration_folder(name: str = "gelsight") -> Path:
    assert _PACKAGE is not None and _PACKAGE.origin is not None
    return Path(_PACKAGE.origin).parent / "calib" / name


@pytest.fixture(scope="module")
def pressed() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(z, mask, lift) of a ball and a step on upstream's domed gel, deformed as upstream does it."""
    gel_map = np.load(calibration_folder() / "gelmap.npy")
    y, x = np.mgrid[0:480, 0:640]
    r2 = (x - 300.0) ** 2 + (y - 250.0) ** 2
    ball = np.sqrt(np.maximum(100.0**2 - r2, 0))
    ball[100:160, 400:480] = 90.0
    return upstream.deform(ball, gel_map, 1.0, PIXMM)


@needs_taxim
def test_parity_with_the_upstream_calibration_from_height_map_to_image(mi: Any, pressed: tuple[np.ndarray, ...]) -> None:
    z, mask, lift = (a.astype(np.float32).astype(float) if a.dtype.kind == "f" else a for a in pressed)
    table = load_calibration(calibration_folder())
    error, on_edge = errors_beside_ties(table, z, mask, lift, shade(mi, table, z, mask, lift, shadow=False))
    assert error.max() <= 0.5 and on_edge < 0.03, f"{error.max()} levels, {on_edge} on an edge"


@needs_taxim
@pytest.mark.slow
def test_parity_with_the_upstream_calibration_and_shadow(mi: Any, pressed: tuple[np.ndarray, ...]) -> None:
    z, mask, lift = (np.round(a * 256) / 256 if a.dtype.kind == "f" else a for a in pressed)
    table = load_calibration(calibration_folder())
    got = shade(mi, table, z, mask, lift, shadow=True)
    expected = as_upstream(table).image(z, mask, lift, shadow=True)[..., ::-1]
    # A flipped bin is one pixel before the blur, which spreads some of it over its neighbours.
    assert np.abs(got - expected).max() <= 0.5, f"{np.abs(got - expected).max()} levels"


@needs_taxim
@pytest.mark.parametrize("name", ["gelsight", "gelsight_mini"])
def test_background_is_processed_as_upstream_does(name: str) -> None:
    f0 = np.load(calibration_folder(name) / "dataPack.npz")["f0"]
    expected = upstream.processed_background(f0)
    got = processed_background(f0, TaximConstants())
    differs = np.abs(got - expected)
    assert (differs > 0).mean() < 1e-4 and differs.max() <= 1, "more than the rounding of a truncation"


@needs_taxim
def test_the_gels_pyramid_with_upstreams_rule_is_upstreams_deformation() -> None:
    """A flat gel: raytac smooths the displacement by exact Gaussians, upstream the heights by kernels cut at 3 σ."""
    shape = (240, 320)
    gel_map = np.full(shape, 169.5)
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    ball = np.sqrt(np.maximum(80.0**2 - (x - 150.0) ** 2 - (y - 110.0) ** 2, 0))
    _, mask, lift = upstream.deform(ball, gel_map, 0.8, PIXMM)
    pitch = 1e-3 * PIXMM
    grid = PadGrid(x=np.arange(shape[1]) * pitch, y=np.arange(shape[0]) * pitch, rest=np.zeros(shape))
    under = -(ball - (ball.max() - 0.8 / PIXMM)) * pitch
    surface = ElasticSurround(grid, thickness=4e-3, contact_rule="threshold").surface(under[None])
    deepest = 0.8 / PIXMM
    assert (surface.contact[0] != mask).mean() < 1e-3
    assert np.abs(surface.indentation[0] / pitch - lift).max() < 0.03 * deepest


@pytest.mark.parametrize(("size", "sigma"), [(201, 30.5), (101, 15.5), (51, 8.0), (21, 3.5), (11, 2.0), (5, 1.1)])
def test_pyramid_blur_is_the_gaussian_of_scipy(size: int, sigma: float) -> None:
    from scipy.ndimage import gaussian_filter1d

    assert upstream.opencv_sigma(size) == pytest.approx(sigma)
    field = np.random.default_rng(0).normal(size=400)
    smooth = gaussian_filter1d(field, 4.0)  # what a surface is beside noise
    exact, sampled = gaussian_matrix(400, sigma)[0] @ smooth, gaussian_filter1d(smooth, sigma, mode="mirror", truncate=8)
    assert np.abs(exact - sampled).max() < 0.01 * np.abs(smooth).max()


# -------------------------------------------------------------------- polynomials


def test_polynomials_have_the_derivatives_that_their_coefficients_say(mi: Any) -> None:
    """On a plane all pixels share one bin: finite differences over columns and rows are those of its polynomial."""
    rng = np.random.default_rng(4)
    table = random_table(rng, (30, 40))
    flat = np.zeros((30, 40, 3), np.float32)
    table = PolyTable(table.gradients, None, flat, table.pixel_pitch, slopes_of="height")
    y, x = np.mgrid[0:30, 0:40].astype(float)
    z = 0.5 * x + 0.25 * y
    image = shade(mi, table, z, np.zeros(z.shape, bool), z, shadow=False).astype(float)
    n = table.n_bins
    i = int(np.arctan(np.hypot(0.5, 0.25)) / (np.pi / 2 / (n - 1)))
    j = int((np.arctan2(0.25, 0.5) + np.pi) / (2 * np.pi / (n - 1)))
    for c in range(3):
        xx, yy, xy, bx, by, _ = table.gradients[c, i, j]
        along_x, along_y = (image[5:-5, 7:-5, c] - image[5:-5, 5:-7, c]) / 2, (image[7:-5, 5:-5, c] - image[5:-7, 5:-5, c]) / 2
        expected_x, expected_y = (2 * xx * x + xy * y + bx)[5:-5, 6:-6], (2 * yy * y + xy * x + by)[6:-6, 5:-5]
        assert np.abs(expected_x).max() > 1e-3 and np.abs(expected_y).max() > 1e-3
        np.testing.assert_allclose(along_x, expected_x, atol=2e-4)
        np.testing.assert_allclose(along_y, expected_y, atol=2e-4)


# -------------------------------------------------------------------- shadows


def test_shadows_fall_away_from_each_light_and_lengthen_with_depth(mi: Any) -> None:
    """One light a channel. Its table holds shadows on the far side only, as long as the rim is deep."""
    shape, directions = (120, 160), np.arange(0, 2 * np.pi, 0.1)
    lights = np.array([0.0, 2.1, 4.2])  # azimuths of red, green and blue, x right and y down
    away = np.cos(directions[None, :] - lights[:, None] - np.pi) > 0.8
    lengths = np.where(away[..., None], 3 * np.arange(1, 10), 0).astype(np.int32)
    values = np.full((3, 63, 9, 27), -40, np.float32)
    table = PolyTable(
        np.zeros((3, 4, 4, 6)),
        None,
        np.full((*shape, 3), 100, np.float32),
        (1e-3 * PIXMM, 1e-3 * PIXMM),
        ShadowTable(directions, values, lengths, first_depth=0.0, depth_offset=0),
        slopes_of="height",
    )
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
    r = np.hypot(x - 80, y - 60)
    darkened = []
    for depth_mm in (0.35, 0.75):
        z = depth_mm / PIXMM / (1 + np.exp((r - 20) / 0.6))
        image = shade(mi, table, z, r < 17, z, shadow=True)
        dark = 100 - image.astype(float)
        assert dark[r > 17].min() > -1e-3
        total = dark.sum(axis=(0, 1))
        centre = np.stack([(dark * a[..., None]).sum(axis=(0, 1)) / total for a in (x - 80, y - 60)], axis=-1)
        for c, azimuth in enumerate(lights):
            to_light = np.array([np.cos(azimuth), np.sin(azimuth)])
            assert centre[c] @ to_light < -10, f"channel {c} is dark at {centre[c]}"
            assert abs(centre[c] @ np.array([-to_light[1], to_light[0]])) < 3
        darkened.append([r[dark[..., c] > 10].max() for c in range(3)])
    assert (np.array(darkened[1]) > np.array(darkened[0]) + 3).all(), darkened


def test_without_contact_no_shadow_is_cast(mi: Any) -> None:
    rng = np.random.default_rng(0)
    table = random_table(rng, (60, 80), n=2)
    z = np.zeros((60, 80))
    none = np.zeros(z.shape, bool)
    expected = as_upstream(table).image(z, none, z, shadow=True)[..., ::-1]
    np.testing.assert_allclose(shade(mi, table, z, none, z, shadow=True), expected, atol=0.01)
    dr.sync_thread()
