"""8-bit PNG images."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from raytac.errors import InputError

__all__ = ["png_bytes", "read_png", "write_png"]


def png_bytes(rgb_u8: np.ndarray) -> bytes:
    """``rgb_u8``, shape (H, W, 3), uint8, as the contents of a PNG file.

    Raises:
        InputError: another shape or type.
    """
    if rgb_u8.ndim != 3 or rgb_u8.shape[2] != 3 or rgb_u8.dtype != np.uint8:
        raise InputError("rgb_u8", value=(rgb_u8.shape, str(rgb_u8.dtype)), rule="must have shape (H, W, 3) and type uint8")
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(rgb_u8)).save(stream, "PNG")
    return stream.getvalue()


def write_png(path: Path, rgb_u8: np.ndarray) -> None:
    """Write ``png_bytes(rgb_u8)``.

    Raises:
        InputError: another shape or type.
    """
    path.write_bytes(png_bytes(rgb_u8))


def read_png(path: Path) -> np.ndarray:
    """The image as RGB, shape (H, W, 3), uint8."""
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))
