"""Cards of HTML for notebooks: a title, a table and small pictures inside of the page."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping

import numpy as np

from raytac.io.images import png_bytes

SIDE = 200
"""Longest side of a picture in a card [px]."""
# Anchors of a scale from dark blue over green to yellow, even in lightness, as of viridis.
_ANCHORS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], float)
_STYLE = "font:13px/1.4 system-ui,sans-serif;border:1px solid #ccc;border-radius:6px;padding:8px 12px;display:inline-block"


def coloured(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Numbers (H, W) as colours (H, W, 3), uint8, from ``low`` to ``high``; NaN is grey."""
    share = np.clip((np.asarray(values, float) - low) / (high - low if high > low else 1.0), 0.0, 1.0)
    place = np.nan_to_num(share) * (len(_ANCHORS) - 1)
    colours = np.stack([np.interp(place, np.arange(len(_ANCHORS)), channel) for channel in _ANCHORS.T], axis=-1)
    colours[np.isnan(share)] = 160.0
    return np.round(colours).astype(np.uint8)


def picture(image: np.ndarray, caption: str) -> str:
    """An image (H, W, 3), uint8, of at most ``SIDE`` pixels, inside of the page."""
    step = max(1, -(-max(image.shape[:2]) // SIDE))
    small = image[: image.shape[0] // step * step, : image.shape[1] // step * step]
    small = small.reshape(small.shape[0] // step, step, small.shape[1] // step, step, 3).mean(axis=(1, 3))
    data = base64.b64encode(png_bytes(np.round(small).astype(np.uint8))).decode("ascii")
    text = html.escape(caption, quote=True)
    return (
        f'<figure style="display:inline-block;margin:4px 8px 0 0"><img alt="{text}" src="data:image/png;base64,{data}" '
        f'style="display:block;image-rendering:auto"><figcaption style="font-size:11px;color:#666">{text}</figcaption></figure>'
    )


def card(title: str, rows: Mapping[str, object], pictures: str = "") -> str:
    """A card: its title, rows of names and values as text, and pictures as HTML."""
    lines = "".join(
        f'<tr><td style="text-align:left;padding:0 12px 0 0;color:#666">{html.escape(name)}</td>'
        f'<td style="text-align:left;padding:0">{html.escape(str(value))}</td></tr>'
        for name, value in rows.items()
    )
    return f'<div style="{_STYLE}"><b>{html.escape(title)}</b><table style="margin:4px 0">{lines}</table>{pictures}</div>'
