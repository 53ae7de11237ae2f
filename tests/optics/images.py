"""Compare images: on failure say by how much, and leave what was computed, what was expected and the error to look at."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from raytac.io.images import write_png

__all__ = ["assert_images_agree", "errors", "psnr_db"]


def errors(actual: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """Mean and largest absolute error, relative to the mean of ``expected``."""
    error = np.abs(actual.astype(np.float64) - expected)
    scale = float(np.abs(expected).mean())
    return float(error.mean()) / scale, float(error.max()) / scale


def psnr_db(actual: np.ndarray, expected: np.ndarray) -> float:
    """Peak signal-to-noise ratio of 8-bit images [dB]."""
    mean_square = np.mean((actual.astype(np.float64) - expected) ** 2)
    return float("inf") if mean_square == 0 else float(10 * np.log10(255**2 / mean_square))


def assert_images_agree(
    actual: np.ndarray, expected: np.ndarray, folder: Path, *, mean: float, maximum: float = np.inf, name: str = "image"
) -> None:
    """Images (H, W, 3): mean and largest error below the limits, both relative to the mean of ``expected``.

    On failure ``folder`` gets ``{name}_actual.png``, ``_expected.png`` and ``_error.png`` (mid-grey is no error, white or black
    is as large as the mean of ``expected``).
    """
    found_mean, found_max = errors(actual, expected)
    if found_mean <= mean and found_max <= maximum:
        return
    top = float(expected.max()) or 1.0
    error = (actual.astype(np.float64) - expected) / (float(np.abs(expected).mean()) or 1.0)
    pictures = {"actual": actual / top, "expected": expected / top, "error": 0.5 + 0.5 * error}
    for what, picture in pictures.items():
        write_png(folder / f"{name}_{what}.png", (255 * np.clip(picture, 0, 1)).astype(np.uint8))
    worst = np.unravel_index(np.abs(actual.astype(np.float64) - expected).argmax(), actual.shape)
    raise AssertionError(
        f"{name}: mean error {found_mean:.3%} (limit {mean:.3%}), largest {found_max:.3%} (limit {maximum:.3%}) of the mean, "
        f"at {tuple(int(i) for i in worst)}: {actual[worst]:.6g} instead of {expected[worst]:.6g}; pictures in {folder}"
    )
