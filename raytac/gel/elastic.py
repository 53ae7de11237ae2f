"""The gel around a contact: Taxim's pyramid of Gaussians with the contact re-imposed."""

from __future__ import annotations

import numpy as np

from raytac.gel.gaussian import GaussianBlur
from raytac.gel.surface import GelSurface, PadGrid

__all__ = ["CONTACT_SCALE", "FINAL_SIGMA", "PYRAMID_SIGMAS", "ElasticSurround"]

_TAXIM_PIXEL = 0.0295e-3
PYRAMID_SIGMAS = tuple(s * _TAXIM_PIXEL for s in (30.5, 15.5, 8.0, 3.5, 2.0, 1.1))
"""Standard deviations of Taxim's pyramid [m]: OpenCV's automatic σ for kernels 201, 101, 51, 21, 11, 5 at 0.0295 mm a pixel."""
FINAL_SIGMA = 1.1 * _TAXIM_PIXEL
"""Standard deviation of the last smoothing [m]."""
CONTACT_SCALE = 0.4
"""Share of the deepest overlap from which a node counts as in full contact."""
_FINEST = 0.2
"""Gaussians narrower than this share of the pitch move nothing that the grid can hold and are skipped."""


class ElasticSurround:
    """From the overlap of object and resting gel to the deformed surface (Si & Yuan, RA-L 2022, section III).

    With u = rest − underside of the object (its overlap with the gel at rest), u⁺ = max(u, 0) and the full contact
    C = {u > 0.4 max u}: start from w = u⁺; for every width of the pyramid, wide to narrow, w ← Gaussian(w), then w = u⁺ on C;
    last, one narrow Gaussian everywhere. The surface is rest − w. Taxim does this to absolute heights in pixels; here it is done
    to the displacement w and with widths in metres, so that the dome is not smoothed, an untouched pad is exactly at rest, and
    the result does not depend on the grid. Borders are mirrored. Arrays are float32.
    """

    def __init__(
        self,
        grid: PadGrid,
        *,
        sigmas: tuple[float, ...] = PYRAMID_SIGMAS,
        final_sigma: float = FINAL_SIGMA,
        contact_scale: float = CONTACT_SCALE,
    ) -> None:
        """``sigmas`` [m], wide to narrow; ``final_sigma`` [m], 0 for none; ``contact_scale`` in [0, 1)."""
        self.grid = grid
        self.contact_scale = contact_scale
        finest = _FINEST * min(grid.pitch)
        self._pyramid = [GaussianBlur(grid.shape, grid.pitch, s) for s in sigmas if s > finest]
        self._final = GaussianBlur(grid.shape, grid.pitch, final_sigma) if final_sigma > finest else None

    def surface(self, object_height: np.ndarray, pad_from_object: np.ndarray | None = None) -> GelSurface:
        """Deformed surface under an object.

        ``object_height`` [m]: underside in the pad frame, shape (B, Ny, Nx), ``inf`` where nothing is above (see
        ``raytac.gel.object_height``); ``pad_from_object`` (B, 4, 4) is passed on. An environment with NaN in it gets a surface of
        NaN without contact.
        """
        batch = len(object_height)
        height = np.empty((batch, *self.grid.shape), np.float32)
        contact = np.zeros(height.shape, bool)
        centre = np.full((batch, 2), np.nan)
        rest = self.grid.rest.astype(np.float32)
        for b in range(batch):  # one by one: an environment's result must not depend on its neighbours
            overlap = (self.grid.rest - object_height[b]).astype(np.float32)
            deepest = overlap.max()
            if np.isnan(deepest):
                height[b] = np.nan
            elif deepest <= 0.0:
                height[b] = rest
            else:
                contact[b] = overlap > self.contact_scale * deepest
                np.subtract(rest, self._displacement(overlap, contact[b]), out=height[b])
                centre[b] = self._centroid(overlap, contact[b])
        return GelSurface(self.grid, height, contact, centre, pad_from_object)

    def _displacement(self, overlap: np.ndarray, contact: np.ndarray) -> np.ndarray:
        pressed = np.maximum(overlap, 0.0)
        moved = pressed
        for blur in self._pyramid:
            moved = blur(moved)
            np.copyto(moved, pressed, where=contact)
        return moved if self._final is None else self._final(moved)

    def _centroid(self, overlap: np.ndarray, contact: np.ndarray) -> tuple[float, float]:
        """Overlap-weighted centre (x, y) [m] of the contact."""
        weight = np.where(contact, overlap, 0.0).astype(float)
        total = weight.sum()
        return float(weight.sum(axis=0) @ self.grid.x / total), float(weight.sum(axis=1) @ self.grid.y / total)
