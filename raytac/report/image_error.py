"""Error of an 8-bit image against a reference: MAE, RMSE, PSNR, SSIM and FLIP.

Over the frame or a part of it. Images are RGB as the camera writes them: (H, W, 3), uint8, the gamma of the sensor's response in them.
docs/concepts/image-error.md defines every figure once more in words.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping

import numpy as np

from raytac.errors import BackendError, InputError

METRICS = ("mae", "rmse", "psnr", "ssim", "flip")
"""MAE and RMSE [levels of 255], PSNR [dB], SSIM and FLIP [1]."""
RING_WIDTH = 2e-3
"""Width of the shadow ring round the contact, measured on the gel plane [m]."""
SSIM_SIGMA = 1.5
"""Standard deviation of SSIM's 11-pixel Gaussian window [px] (Wang et al. 2004, III.B)."""
SSIM_BORDER = 5
"""Half the window [px]: nearer to the image's edge it would lack pixels."""
FLIP_PPD = 67.0206
"""Pixels per degree, FLIP's default: 0.7 m before 0.7 m of 3840 pixels (Andersson 2020)."""


def rmse(a: np.ndarray, b: np.ndarray) -> float:
    """Root mean square of a − b, in the unit of both."""
    return float(np.sqrt(np.mean((a.astype(np.float64) - b.astype(np.float64)) ** 2)))


def mae(a: np.ndarray, b: np.ndarray) -> float:
    """Mean of |a − b|, in the unit of both."""
    return float(np.mean(np.abs(a.astype(np.float64) - b.astype(np.float64))))


def psnr(rmse_levels: float) -> float:
    """PSNR = 20 log₁₀(255 / RMSE) [dB] of an 8-bit image, RMSE in levels; inf if equal."""
    return float("inf") if rmse_levels == 0 else float(20 * np.log10(255 / rmse_levels))


def ssim_map(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """SSIM at every pixel, mean of three channels, (H, W); NaN within ``SSIM_BORDER``.

    Wang et al. 2004, eq. 13: K₁ = 0.01, K₂ = 0.03, L = 255, Gaussian window, population covariance; computed by scikit-image.

    Raises:
        BackendError: scikit-image is not installed.
        InputError: an image smaller than the window.
    """
    try:
        from skimage.metrics import structural_similarity
    except ImportError as error:
        raise BackendError("SSIM needs scikit-image: `pip install 'raytac[report]'`") from error
    if min(image.shape[:2]) < 2 * SSIM_BORDER + 1:
        rule = f"must be at least {2 * SSIM_BORDER + 1} pixels a side, the window of SSIM"
        raise InputError("image", value=image.shape, rule=rule)
    _, full = structural_similarity(  # type: ignore[misc]
        reference,
        image,
        data_range=255,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=SSIM_SIGMA,
        use_sample_covariance=False,
        full=True,
    )
    values = np.full(image.shape[:2], np.nan)
    inside = slice(SSIM_BORDER, -SSIM_BORDER)
    values[inside, inside] = np.mean(full, axis=-1)[inside, inside]
    return values


def has_flip() -> bool:
    """True if the package ``flip-evaluator`` is installed."""
    return importlib.util.find_spec("flip_evaluator") is not None


def flip_map(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """LDR-FLIP at every pixel, in [0, 1], (H, W) float32, at ``FLIP_PPD``.

    8-bit values / 255 are read as sRGB.

    Raises ``BackendError``: ``flip-evaluator`` is not installed.
    """
    if not has_flip():
        raise BackendError("FLIP needs the package flip-evaluator: `pip install 'raytac[report]'`, or leave FLIP out")
    import flip_evaluator

    one, two = (np.ascontiguousarray(a, dtype=np.float32) / np.float32(255) for a in (reference, image))
    values, _, _ = flip_evaluator.evaluate(one, two, "LDR", applyMagma=False, parameters={"ppd": FLIP_PPD})
    return np.asarray(values)[..., 0]


def contact_box(contact: np.ndarray, margin: int = 0) -> tuple[slice, slice]:
    """Rows and columns of the contact and a ``margin`` [px] in the image; all without contact."""
    height, width = contact.shape
    if not contact.any():
        return slice(0, height), slice(0, width)
    rows, columns = (np.flatnonzero(contact.any(axis=axis)) for axis in (1, 0))
    return (
        slice(max(int(rows[0]) - margin, 0), int(rows[-1]) + margin + 1),
        slice(max(int(columns[0]) - margin, 0), int(columns[-1]) + margin + 1),
    )


def regions(contact: np.ndarray, pixel_pitch: tuple[float, float], ring_width: float = RING_WIDTH) -> dict[str, np.ndarray]:
    """Masks (H, W) bool of the parts of an image over which errors are taken.

    ``frame``: all pixels. ``contact``: where the object touches, as the camera sees it. ``ring``: pixels outside the contact and at most
    ``ring_width`` [m] from its nearest pixel, where shadows fall and the gel bends. ``box``: the contact's bounding box, no margin. The
    last three are empty if nothing touches.

    Args:
        contact: (H, W) bool, as ``OpticsImages.contact`` of one environment.
        pixel_pitch: distance of pixels on the gel plane along x and y [m].
        ring_width: [m].

    Raises:
        InputError: a contact that is not a boolean image, or a width or pitch that is not positive.
    """
    if contact.ndim != 2 or contact.dtype != bool:
        raise InputError("contact", value=f"{contact.dtype} {contact.shape}", rule="must be a boolean image of shape (H, W)")
    for name, value in (("pixel_pitch", min(pixel_pitch)), ("ring_width", ring_width)):
        if not value > 0:
            raise InputError(name, value=value, rule="must be > 0 [m]")
    from scipy.ndimage import distance_transform_edt

    ring, box = np.zeros_like(contact), np.zeros_like(contact)
    if contact.any():
        box[contact_box(contact)] = True
        distance = np.asarray(distance_transform_edt(~contact, sampling=(pixel_pitch[1], pixel_pitch[0])))
        ring = (distance <= ring_width * (1 + 1e-9)) & ~contact
    return {"frame": np.ones_like(contact), "contact": contact, "ring": ring, "box": box}


def error_maps(image: np.ndarray, reference: np.ndarray, *, flip: bool | None = None) -> dict[str, np.ndarray]:
    """Maps (H, W): ``absolute`` and ``squared`` [levels], ``ssim`` and ``flip``.

    Every region's figures are means of them. ``flip``: None is with FLIP if its package is there, True asks for it.

    Raises:
        InputError: images that are not uint8 (H, W, 3) of one shape.
        BackendError: a package is missing.
    """
    for name, value in (("image", image), ("reference", reference)):
        if value.dtype != np.uint8 or value.ndim != 3 or value.shape[2] != 3:
            raise InputError(name, value=f"{value.dtype} {value.shape}", rule="must be a uint8 image of shape (H, W, 3)")
    if image.shape != reference.shape:
        raise InputError("image", value=image.shape, rule=f"must have the shape of its reference, {reference.shape}")
    off = image.astype(np.float64) - reference
    maps = {"absolute": np.abs(off).mean(axis=-1), "squared": (off**2).mean(axis=-1), "ssim": ssim_map(image, reference)}
    if has_flip() if flip is None else flip:
        maps["flip"] = flip_map(image, reference)
    return maps


def image_errors(
    image: np.ndarray, reference: np.ndarray, masks: Mapping[str, np.ndarray], *, flip: bool | None = None
) -> dict[str, float]:
    """``{"frame.mae": …, "contact.psnr": …}`` for each mask and metric; NaN of an empty mask.

    SSIM and FLIP look at a pixel's neighbourhood: their maps come from the whole images, and the mask only says where to average. SSIM
    leaves out pixels near the edge of the image, as ``ssim_map`` says. ``flip`` as for ``error_maps``.

    Raises:
        InputError: as ``error_maps``, or a mask of another shape.
        BackendError: a package is missing.
    """
    maps = error_maps(image, reference, flip=flip)
    figures: dict[str, float] = {}
    for name, mask in masks.items():
        if mask.shape != image.shape[:2] or mask.dtype != bool:
            rule = f"must be a boolean image of shape {image.shape[:2]}"
            raise InputError(f"masks[{name!r}]", value=f"{mask.dtype} {mask.shape}", rule=rule)
        off = float(np.sqrt(_mean(maps["squared"], mask)))
        figures |= {f"{name}.mae": _mean(maps["absolute"], mask), f"{name}.rmse": off, f"{name}.psnr": psnr(off)}
        for metric in ("ssim", "flip"):
            if metric in maps:
                figures[f"{name}.{metric}"] = _mean(maps[metric], mask)
    return figures


def _mean(values: np.ndarray, mask: np.ndarray) -> float:
    """Mean over the mask where there is a value, NaN if there is none."""
    chosen = values[mask]
    chosen = chosen[~np.isnan(chosen)]
    return float(chosen.mean(dtype=np.float64)) if chosen.size else float("nan")
