"""The tactile image as the page shows it: enlarged, with arrows where the markers went."""

from __future__ import annotations

import numpy as np

from raytac.view.session import PadView

__all__ = ["ARROW_SCALE", "picture"]

ARROW_SCALE = 2.0
"""Length of a drawn arrow over the marker's way, so that tenths of a pixel are seen."""
_LEAST_WIDTH = 480
"""Images are enlarged by a whole factor to at least this width [px], so that arrows are crisp."""
_SHORTEST = 1.0
"""Arrows of fewer enlarged pixels are drawn as dots."""
_INK = (255, 220, 60)


def picture(pad: PadView, *, arrows: bool) -> np.ndarray | None:
    """8-bit image (H', W', 3) of the pad's sensor; None if it makes none. ``arrows``: where it has markers, over the image."""
    if pad.rgb is None:
        return None
    factor = -(-_LEAST_WIDTH // pad.rgb.shape[1])
    if not arrows or pad.markers_px is None:
        return pad.rgb
    from PIL import Image, ImageDraw

    height, width = pad.rgb.shape[:2]
    image = Image.fromarray(pad.rgb).resize((factor * width, factor * height), Image.Resampling.BILINEAR)
    draw = ImageDraw.Draw(image)
    rest, moved = pad.markers_px
    starts, ways = factor * rest, factor * ARROW_SCALE * moved
    for (x, y), (dx, dy) in zip(starts, ways, strict=True):
        if not np.isfinite([x, y, dx, dy]).all():
            continue
        length = float(np.hypot(dx, dy))
        if length < _SHORTEST:
            draw.ellipse((x - 1.5, y - 1.5, x + 1.5, y + 1.5), fill=_INK)
            continue
        end = np.array([x + dx, y + dy])
        draw.line([(x, y), (float(end[0]), float(end[1]))], fill=_INK, width=2)
        along, across = np.array([dx, dy]) / length, np.array([-dy, dx]) / length
        head = min(7.0, 0.5 * length)
        tip = [end, end - head * along + 0.45 * head * across, end - head * along - 0.45 * head * across]
        draw.polygon([(float(px), float(py)) for px, py in tip], fill=_INK)
    return np.asarray(image)
