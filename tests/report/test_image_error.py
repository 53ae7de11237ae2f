"""Error figures against scikit-image, flip-evaluator and closed forms; the masks over which they are taken."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from raytac.errors import InputError
from raytac.report.image_error import (
    FLIP_PPD,
    METRICS,
    SSIM_BORDER,
    contact_box,
    error_maps,
    flip_map,
    has_flip,
    image_errors,
    mae,
    psnr,
    regions,
    rmse,
    ssim_map,
)

skimage_metrics = pytest.importorskip("skimage.metrics")
needs_flip = pytest.mark.skipif(not has_flip(), reason="flip-evaluator is not installed")
IMAGES = arrays(np.uint8, (13, 12, 3))
PITCH = (1e-3, 1e-3)


def pair(seed: int = 0, size: tuple[int, int] = (48, 64), sigma: float = 9.0) -> tuple[np.ndarray, np.ndarray]:
    """A smooth colour image and the same with noise."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: size[0], : size[1]] / size[0]
    smooth = np.stack([90 + 60 * np.sin(5 * u + k) * np.cos(4 * v - k) for k in range(3)], axis=-1)
    noisy = np.clip(np.rint(smooth + rng.normal(0, sigma, smooth.shape)), 0, 255)
    return noisy.astype(np.uint8), np.rint(smooth).astype(np.uint8)


def whole(image: np.ndarray) -> dict[str, np.ndarray]:
    return {"frame": np.ones(image.shape[:2], bool)}


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_figures_of_the_whole_frame_agree_with_scikit_image(seed: int) -> None:
    image, truth = pair(seed)
    figures = image_errors(image, truth, whole(image), flip=False)
    assert figures["frame.rmse"] ** 2 == pytest.approx(skimage_metrics.mean_squared_error(truth, image), rel=1e-12)
    assert figures["frame.psnr"] == pytest.approx(skimage_metrics.peak_signal_noise_ratio(truth, image), rel=1e-12)
    expected = skimage_metrics.structural_similarity(
        truth, image, channel_axis=-1, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255
    )
    assert figures["frame.ssim"] == pytest.approx(expected, rel=1e-9)
    assert 0.1 < figures["frame.ssim"] < 0.95  # not a pair that any formula would agree on
    assert figures["frame.mae"] == pytest.approx(np.abs(image.astype(int) - truth.astype(int)).mean(), rel=1e-12)


def test_ssim_at_a_pixel_is_the_formula_of_wang_2004() -> None:
    image, truth = pair()
    row, column, r = 20, 31, SSIM_BORDER
    offset = np.arange(-r, r + 1)
    window = np.exp(-(offset[:, None] ** 2 + offset[None, :] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    values = []
    for c in range(3):
        x, y = (a[row - r : row + r + 1, column - r : column + r + 1, c].astype(float) for a in (image, truth))
        mx, my = (window * x).sum(), (window * y).sum()
        vx, vy, cov = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum(), (window * (x - mx) * (y - my)).sum()
        values.append((2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2)))
    assert ssim_map(image, truth)[row, column] == pytest.approx(np.mean(values), rel=1e-9)


def test_ssim_has_no_value_where_its_window_leaves_the_image() -> None:
    image, truth = pair()
    values = ssim_map(image, truth)
    inside = values[SSIM_BORDER:-SSIM_BORDER, SSIM_BORDER:-SSIM_BORDER]
    assert np.isfinite(inside).all() and np.isnan(values).sum() == values.size - inside.size


@needs_flip
def test_flip_is_what_flip_evaluator_says() -> None:
    import flip_evaluator

    image, truth = pair()
    a, b = (x.astype(np.float32) / 255 for x in (truth, image))
    _, mean, used = flip_evaluator.evaluate(a, b, "LDR", applyMagma=False, parameters={"vc": [0.7, 3840, 0.7]})
    figures = image_errors(image, truth, whole(image), flip=True)
    assert figures["frame.flip"] == pytest.approx(mean, rel=1e-4) and 0.02 < mean < 0.8
    assert used["ppd"] == pytest.approx(FLIP_PPD, rel=1e-5)
    assert flip_map(truth, truth).max() == 0


@given(IMAGES, IMAGES)
@settings(max_examples=30, deadline=None)
def test_errors_are_symmetric_and_ordered(a: np.ndarray, b: np.ndarray) -> None:
    one, two = (image_errors(x, y, whole(x), flip=False) for x, y in ((a, b), (b, a)))
    for metric in ("mae", "rmse", "psnr", "ssim"):
        assert one[f"frame.{metric}"] == pytest.approx(two[f"frame.{metric}"], rel=1e-9, abs=1e-9)
    assert one["frame.mae"] <= one["frame.rmse"] + 1e-9
    assert -1 - 1e-9 <= one["frame.ssim"] <= 1 + 1e-9


@given(IMAGES)
@settings(max_examples=20, deadline=None)
def test_equal_images_have_no_error(a: np.ndarray) -> None:
    figures = image_errors(a, a, whole(a), flip=has_flip())
    assert figures["frame.mae"] == figures["frame.rmse"] == 0 and figures["frame.psnr"] == math.inf
    assert figures["frame.ssim"] == pytest.approx(1.0) and figures.get("frame.flip", 0.0) == 0


@given(st.integers(1, 60), st.integers(0, 100))
def test_a_constant_shift_is_its_own_mae_and_rmse(shift: int, level: int) -> None:
    a = np.full((4, 5, 3), level, np.uint8)
    assert mae(a, a + np.uint8(shift)) == rmse(a, a + np.uint8(shift)) == shift
    assert psnr(shift) == pytest.approx(20 * math.log10(255 / shift))


def test_psnr_of_known_noise() -> None:
    assert psnr(2.55) == pytest.approx(40.0)
    # White noise of standard deviation s, rounded to whole levels: the variance of rounding, 1/12, comes on top.
    rng = np.random.default_rng(3)
    truth = np.full((400, 500, 3), 128, np.uint8)
    image = np.rint(128 + rng.normal(0, 5.0, truth.shape)).astype(np.uint8)
    assert psnr(rmse(image, truth)) == pytest.approx(10 * math.log10(255**2 / (25 + 1 / 12)), abs=0.02)


def disc(radius_px: float = 10.0, size: tuple[int, int] = (60, 80)) -> np.ndarray:
    v, u = np.mgrid[: size[0], : size[1]]
    return np.hypot(u - size[1] // 2, v - size[0] // 2) <= radius_px


def test_regions_of_a_disc() -> None:
    contact = disc()
    masks = regions(contact, PITCH, ring_width=5e-3)
    assert masks["frame"].all() and (masks["contact"] == contact).all()
    assert not (masks["ring"] & contact).any()
    v, u = np.mgrid[:60, :80]
    distance = np.hypot(u - 40, v - 30)
    assert masks["ring"][(distance > 11) & (distance < 14.5)].all() and not masks["ring"][distance > 15.5].any()
    rows, columns = np.nonzero(masks["box"])
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (20, 40, 30, 50) and masks["box"].sum() == 21 * 21


def test_box_with_a_margin_stays_in_the_image() -> None:
    contact = np.zeros((40, 60), bool)
    assert contact_box(contact, 5) == (slice(0, 40), slice(0, 60))
    contact[3:10, 50:58] = True
    assert contact_box(contact) == (slice(3, 10), slice(50, 58))
    rows, columns = contact_box(contact, 5)
    grown = np.zeros_like(contact)
    grown[rows, columns] = True
    assert grown.sum() == (10 + 5) * (60 - 45) and grown[0, 45] and grown[14, 59] and not grown[15].any()


def test_ring_is_as_wide_in_metres_along_both_axes() -> None:
    contact = np.zeros((101, 101), bool)
    contact[50, 50] = True
    ring = regions(contact, (1e-3, 2e-3), ring_width=10e-3)["ring"]
    assert ring[50].sum() == 20 and ring[:, 50].sum() == 10


def test_regions_are_measured_apart() -> None:
    truth = np.full((60, 80, 3), 100, np.uint8)
    masks = regions(disc(), PITCH, ring_width=5e-3)
    image = truth.copy()
    image[masks["contact"]] += 7
    image[masks["ring"]] -= 3
    figures = image_errors(image, truth, masks, flip=False)
    assert figures["contact.mae"] == figures["contact.rmse"] == 7 and figures["ring.mae"] == 3
    share = masks["contact"].mean(), masks["ring"].mean()
    assert figures["frame.mae"] == pytest.approx(7 * share[0] + 3 * share[1])


def test_masks_average_the_maps_of_the_whole_image() -> None:
    image, truth = pair()
    mask = np.zeros(image.shape[:2], bool)
    mask[10:20, 12:40] = True
    figures, maps = image_errors(image, truth, {"part": mask}), error_maps(image, truth)
    for metric, values in (("ssim", maps["ssim"]), ("flip", maps.get("flip"))):
        if values is not None:
            assert figures[f"part.{metric}"] == pytest.approx(float(values[mask].mean()), rel=1e-6)


def test_no_contact_gives_no_figures_but_those_of_the_frame() -> None:
    image, truth = pair()
    figures = image_errors(image, truth, regions(np.zeros(image.shape[:2], bool), PITCH), flip=False)
    assert all(math.isnan(figures[f"{region}.{metric}"]) for region in ("contact", "ring", "box") for metric in METRICS[:4])
    assert math.isfinite(figures["frame.mae"])


@pytest.mark.parametrize(
    ("image", "reference"),
    [
        (np.zeros((20, 20, 3)), np.zeros((20, 20, 3), np.uint8)),
        (np.zeros((20, 20, 3), np.uint8), np.zeros((20, 21, 3), np.uint8)),
        (np.zeros((20, 20), np.uint8), np.zeros((20, 20), np.uint8)),
        (np.zeros((10, 20, 3), np.uint8), np.zeros((10, 20, 3), np.uint8)),
    ],
)
def test_images_that_cannot_be_compared_are_refused(image: np.ndarray, reference: np.ndarray) -> None:
    with pytest.raises(InputError):
        error_maps(image, reference, flip=False)


def test_bad_masks_are_refused() -> None:
    image, truth = pair()
    with pytest.raises(InputError, match="masks"):
        image_errors(image, truth, {"part": np.ones((3, 3), bool)})
    with pytest.raises(InputError, match="contact"):
        regions(np.zeros((3, 3)), PITCH)
    with pytest.raises(InputError, match="ring_width"):
        regions(np.zeros((3, 3), bool), PITCH, ring_width=0.0)
