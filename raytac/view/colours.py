"""Colours of a coat: viridis, even to the eye and readable without red or green, over a scale that only grows."""

from __future__ import annotations

import numpy as np

from raytac.view.session import Quantity, round_up

__all__ = ["ColourScale", "legend_html"]

_MAP = "viridis"


def _table() -> np.ndarray:
    """The colour map's 256 entries, 8-bit sRGB, (256, 3)."""
    from matplotlib import colormaps

    return np.rint(255.0 * colormaps[_MAP](np.linspace(0.0, 1.0, 256))[:, :3]).astype(np.uint8)


class ColourScale:
    """From 0 to a round number that is at least what was seen since ``reset``, so that colours keep their meaning in a motion."""

    def __init__(self, quantity: Quantity) -> None:
        self.quantity = quantity
        self._table = _table()
        self.full = quantity.least

    def reset(self) -> None:
        self.full = self.quantity.least

    def include(self, values: np.ndarray) -> None:
        """Let the scale reach the greatest of ``values`` (SI); what is not finite does not count."""
        greatest = float(np.max(values[np.isfinite(values)], initial=0.0)) * self.quantity.factor
        if greatest > self.full:
            self.full = round_up(greatest)

    def colours(self, values: np.ndarray) -> np.ndarray:
        """8-bit sRGB (V, 3) of SI values (V,): below 0 as 0; grey where not finite."""
        share = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0) * (self.quantity.factor / self.full)
        found = self._table[np.rint(255.0 * np.clip(share, 0.0, 1.0)).astype(int)]
        found[~np.isfinite(values)] = 128
        return found


def legend_html(scale: ColourScale) -> str:
    """The scale as a bar with its label and five figures."""
    stops = ",".join("#{:02x}{:02x}{:02x}".format(*rgb) for rgb in _table()[:: 255 // 15])
    figures = "".join(f"<span>{share * scale.full:.4g}</span>" for share in (0.0, 0.25, 0.5, 0.75, 1.0))
    return (
        f'<div style="padding:0 1em 0.4em;font-size:0.8em"><div>{scale.quantity.label}</div>'
        f'<div style="height:0.8em;border-radius:2px;background:linear-gradient(to right,{stops})"></div>'
        f'<div style="display:flex;justify-content:space-between">{figures}</div></div>'
    )
