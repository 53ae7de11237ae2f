"""One sheet of several pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from raytac.errors import InputError
from raytac.io.png import read_png, write_png

__all__ = ["write_sheet"]


def write_sheet(pictures: list[Path], out: Path, *, gap: int = 24) -> None:
    """Stack PNG files under each other, ``gap`` white pixels apart, narrower ones filled up with white on the right.

    Raises:
        InputError: no pictures.
    """
    if not pictures:
        raise InputError("pictures", value=[], rule="must name at least one picture")
    images = [read_png(path) for path in pictures]
    width = max(image.shape[1] for image in images)
    sheet = np.full((sum(image.shape[0] for image in images) + gap * (len(images) - 1), width, 3), 255, np.uint8)
    top = 0
    for image in images:
        sheet[top : top + image.shape[0], : image.shape[1]] = image
        top += image.shape[0] + gap
    write_png(out, sheet)
