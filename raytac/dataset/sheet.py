"""A contact sheet: the first presses of a data set at a glance, images over maps of their indentation."""

from __future__ import annotations

import numpy as np

from raytac.dataset.loader import PressDataset
from raytac.errors import InputError

__all__ = ["contact_sheet"]

_GAP = 4
"""White pixels between tiles."""
_WIDTH = 160
"""Tiles are about so many pixels wide."""
_DEEPEST = 1e-3
"""Indentation that is drawn black [m]."""


def contact_sheet(data: PressDataset, count: int = 24, columns: int = 6) -> np.ndarray:
    """Tiles of the first ``count`` presses, row by row, shape (H, W, 3), uint8: the image, and under it the indentation, black at 1 mm.

    Tiles are whole-number reductions of what is there, so that nothing is resampled.

    Raises:
        InputError: the data set has neither images nor heights, or no sound press, or a number is below 1.
    """
    for name, value in (("count", count), ("columns", columns)):
        if value < 1:
            raise InputError(name, value=value, rule="must be a whole number >= 1")
    shown = [name for name in ("rgb", "height") if name in data.description["arrays"]]
    if not shown or not len(data):
        raise InputError("data set", value=data.folder, rule="must hold a sound press with an image or a height")
    presses = range(min(count, len(data)))
    tiles = [_stacked([_tile(data, i, name) for name in shown]) for i in presses]
    height, width = (max(tile.shape[axis] for tile in tiles) + _GAP for axis in (0, 1))
    rows = -(-len(tiles) // columns)
    sheet = np.full((rows * height + _GAP, min(columns, len(tiles)) * width + _GAP, 3), 255, np.uint8)
    for i, tile in enumerate(tiles):
        top, left = _GAP + i // columns * height, _GAP + i % columns * width
        sheet[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
    return sheet


def _stacked(images: list[np.ndarray]) -> np.ndarray:
    """One under the other, on white; the map is of the whole pad, of which the camera may see less."""
    out = np.full((sum(len(image) for image in images), max(image.shape[1] for image in images), 3), 255, np.uint8)
    top = 0
    for image in images:
        left = (out.shape[1] - image.shape[1]) // 2
        out[top : top + len(image), left : left + image.shape[1]] = image
        top += len(image)
    return out


def _tile(data: PressDataset, i: int, name: str) -> np.ndarray:
    if name == "rgb":
        return _reduced(data[i]["rgb"].astype(float))
    shared = data.shared(i)
    indentation = np.clip((shared["rest_height"] - data[i]["height"]) / _DEEPEST, 0.0, 1.0)
    return _reduced(np.repeat(255.0 * (1.0 - indentation)[..., None], 3, axis=2))


def _reduced(image: np.ndarray) -> np.ndarray:
    """Means over squares of pixels, cut to whole squares."""
    k = max(image.shape[1] // _WIDTH, 1)
    rows, columns = image.shape[0] // k, image.shape[1] // k
    cells = image[: rows * k, : columns * k].reshape(rows, k, columns, k, 3)
    return (cells.mean(axis=(1, 3)) + 0.5).astype(np.uint8)
