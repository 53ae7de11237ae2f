"""Photographs of untouched sensors in the place of the image that a renderer gives at rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from raytac.errors import InputError
from raytac.io.images import read_png

_DARKEST = 4
"""Least value of the image at rest that a ratio is taken to: below, it is mostly rounding."""


def shown_on(photograph: np.ndarray, rgb: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Images (…, H, W, 3) as they would be where the image at rest is ``photograph``, uint8.

    The photograph times the ratio of the press to the pad at rest, in 8-bit values, which saturate as a camera does. Where a camera
    encodes light by a power, this is the ratio of light, since the exponent cancels; with a black level or a tone curve it is near.
    Where ``rgb`` is ``rest``, it is the photograph.
    """
    gain = photograph.astype(np.float32) / np.maximum(rest, _DARKEST)
    shown = np.clip(rgb * gain + np.float32(0.5), 0.0, 255.0).astype(np.uint8)
    return np.where(np.broadcast_to(rgb == rest, rgb.shape), photograph, shown)


def draw_photograph(path: Path, resolution: tuple[int, int], seed: int) -> tuple[str, np.ndarray]:
    """Name and pixels (H, W, 3), uint8, of an image file, or of one PNG file of a folder.

    ``resolution``: (width, height) [px] that it must have. ``seed`` draws among the files of a folder, in the order of their names.

    Raises ``InputError``: nothing of that name, a folder without PNG files, a file that is no image, or another size.
    """
    files = sorted(path.glob("*.png")) if path.is_dir() else [path]
    if not files:
        raise InputError("background", value=path, rule="must be an image file, or a folder with PNG files")
    file = files[np.random.default_rng((seed, 0)).integers(len(files))]
    try:
        photograph = read_png(file)
    except OSError as error:
        reason = "must exist" if isinstance(error, FileNotFoundError) else f"must be readable as an image ({error})"
        raise InputError("background", value=file, rule=reason) from error
    height, width = photograph.shape[:2]
    if (width, height) != tuple(resolution):
        rule = f"has {width}x{height} px and the image {resolution[0]}x{resolution[1]}: resolution {width}x{height} renders at its size"
        raise InputError("background", value=file, rule=rule)
    return file.name, photograph
