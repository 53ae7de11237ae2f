"""8-bit PNG images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from raytac.errors import InputError

__all__ = ["read_png", "write_png"]


def write_png(path: Path, rgb_u8: np.ndarray) -> None:
    """Write ``rgb_u8``, shape (H, W, 3), uint8.

    Raises:
        InputError: another shape or type.
    """
    if rgb_u8.ndim != 3 or rgb_u8.shape[2] != 3 or rgb_u8.dtype != np.uint8:
        raise InputError("rgb_u8", value=(rgb_u8.shape, str(rgb_u8.dtype)), rule="must have shape (H, W, 3) and type uint8")
    from PIL import Image

    Image.fromarray(np.ascontiguousarray(rgb_u8)).save(path)


def read_png(path: Path) -> np.ndarray:
    """The image as RGB, shape (H, W, 3), uint8."""
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))
