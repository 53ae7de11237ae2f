"""The gel around a contact: Taxim's pyramid of Gaussians with the contact re-imposed."""

from __future__ import annotations

import numpy as np

from raytac.errors import InputError
from raytac.gel.gaussian import GaussianBlur
from raytac.gel.pyramid_field import ComposedGaussians, LocalField, Piece, SmoothedField, WholeField, around
from raytac.gel.surface import GelSurface, PadGrid

__all__ = ["CONTACT_RULES", "CONTACT_SCALE", "FINAL_SIGMA", "PYRAMID_SIGMAS", "ElasticSurround"]

_TAXIM_PIXEL = 0.0295e-3
PYRAMID_SIGMAS = tuple(s * _TAXIM_PIXEL for s in (30.5, 15.5, 8.0, 3.5, 2.0, 1.1))
"""Standard deviations of Taxim's pyramid [m]: OpenCV's automatic σ for kernels 201, 101, 51, 21, 11, 5 at 0.0295 mm a pixel."""
FINAL_SIGMA = 1.1 * _TAXIM_PIXEL
"""Standard deviation of the last smoothing [m]."""
CONTACT_RULES = ("unilateral", "threshold")
CONTACT_SCALE = 0.4
"""Share of the deepest overlap from which a node counts as in full contact."""
_FINEST = 0.2
"""Gaussians narrower than this share of the pitch are skipped: the grid cannot resolve their effect."""
_ROUNDING = 1e-5
"""Excess of w over u in contact, as a share of the deepest overlap: above the pyramid's rounding in float32, far below any shape."""
_REACH = 4.8
"""Standard deviations of all Gaussians together beyond which a contact has no effect: Φ(−4.8) is 10⁻⁶ of its depth."""


class ElasticSurround:
    """Deformed surface from the overlap of object and resting gel (Si & Yuan, RA-L 2022, III).

    With u = rest − underside of the object (its overlap with the gel at rest) and u⁺ = max(u, 0): start from w = u⁺; for every width
    of the pyramid, wide to narrow, w ← Gaussian(w), then the contact is re-imposed; last, one narrow Gaussian everywhere. The surface
    is rest − w. The ``contact_rule`` says how the contact is re-imposed:

    - ``"unilateral"`` (default): w ← max(w, u⁺). The gel never reaches into the object and leaves it where the Gaussians keep it deeper;
      the contact is where w = u, up to 10⁻⁵ of the deepest overlap (float32). Everything stays continuous.
    - ``"threshold"``: Taxim's own, w = u⁺ on the full contact C = {u > 0.4 max u}, nothing elsewhere. It keeps every detail of a relief,
      tears the surface along the border of C on steep walls (dots in the image) and lets the gel reach into the object outside C.

    Taxim does this to absolute heights in pixels; here it is done to the displacement w and with widths in metres, so that the dome is
    not smoothed, an untouched pad is exactly at rest, and the result does not depend on the grid. Borders are mirrored. Arrays are
    float32.
    """

    def __init__(
        self,
        grid: PadGrid,
        *,
        sigmas: tuple[float, ...] = PYRAMID_SIGMAS,
        final_sigma: float = FINAL_SIGMA,
        contact_rule: str = "unilateral",
        contact_scale: float = CONTACT_SCALE,
    ) -> None:
        """``sigmas`` [m], wide to narrow; ``final_sigma`` [m], 0 for none; ``contact_scale`` in [0, 1) of the threshold rule.

        Raises:
            InputError: an unknown contact rule.
        """
        if contact_rule not in CONTACT_RULES:
            raise InputError("contact_rule", value=contact_rule, rule="must be a known rule", choices=CONTACT_RULES)
        self.grid = grid
        self.contact_rule = contact_rule
        self.contact_scale = contact_scale
        finest = _FINEST * min(grid.pitch)
        self._pyramid = [GaussianBlur(grid.shape, grid.pitch, s) for s in sigmas if s > finest]
        self._final = GaussianBlur(grid.shape, grid.pitch, final_sigma) if final_sigma > finest else None
        kept = [blur.sigma for blur in (*self._pyramid, *([] if self._final is None else [self._final]))]
        self._composed = ComposedGaussians(grid.shape, grid.pitch, kept)
        self._reach = _REACH * float(np.sqrt(np.square([*sigmas, final_sigma]).sum()))
        self._rest = grid.rest.astype(np.float32)

    def surface(self, object_height: np.ndarray, pad_from_object: np.ndarray | None = None) -> GelSurface:
        """Deformed surface under an object.

        ``object_height`` [m]: underside in the pad frame, shape (B, Ny, Nx), ``inf`` where nothing is above (see
        ``raytac.shapes.underside``); ``pad_from_object`` (B, 4, 4) is passed on. An environment with NaN in it gets a surface of
        NaN without contact.
        """
        batch = len(object_height)
        height = np.empty((batch, *self.grid.shape), np.float32)
        contact = np.zeros(height.shape, bool)
        centre = np.full((batch, 2), np.nan)
        for b in range(batch):  # one by one: an environment's result must not depend on its neighbours
            overlap = np.subtract(self.grid.rest, object_height[b]).astype(np.float32)
            deepest = overlap.max()
            if np.isnan(deepest):
                height[b] = np.nan
                continue
            height[b] = self._rest
            if deepest > 0.0:
                touched = _touched(overlap)
                window = around(touched, self._reach, self.grid.pitch, (slice(0, overlap.shape[0]), slice(0, overlap.shape[1])))
                overlap = overlap[touched]
                displacement, contact[b][touched] = self._displacement(overlap, deepest, touched, window)
                height[b][window] -= displacement
                centre[b] = self._centroid(overlap, contact[b][touched], touched)
        return GelSurface(self.grid, height, contact, centre, pad_from_object)

    def _displacement(self, overlap: np.ndarray, deepest: float, touched: Piece, window: Piece) -> tuple[np.ndarray, np.ndarray]:
        """w [m] on the window, and the contact on ``touched``, for the ``overlap`` there."""
        pressed = np.maximum(overlap, 0.0)
        full = overlap > self.contact_scale * deepest
        field, w = self._field(pressed, touched, window), pressed
        for _ in self._pyramid:
            w = field.smooth()
            w = np.maximum(w, pressed) if self.contact_rule == "unilateral" else np.where(full, pressed, w)
            field.impose(w)
        # Where the overlap is constant the Gaussians keep it up to rounding, which must not decide the contact: hence the slack. The
        # deepest node is always in contact, since no Gaussian exceeds the maximum.
        slack = np.float32(max(_ROUNDING * float(deepest), float(np.finfo(np.float32).tiny)))
        contact = (overlap > 0.0) & (w <= pressed + slack) if self.contact_rule == "unilateral" else full
        return field.over(window), contact

    def _field(self, pressed: np.ndarray, touched: Piece, window: Piece) -> SmoothedField:
        """The cheaper method: local, if the contact is narrower than the reach of the Gaussians."""
        widths = (pitch * (line.stop - line.start) for line, pitch in zip(touched, reversed(self.grid.pitch), strict=True))
        if self._composed.fits and max(widths) <= self._reach:
            return LocalField(pressed, touched, self._composed, len(self._pyramid), self._final is not None, _REACH)
        return WholeField(pressed, touched, window, self._pyramid, self._final)

    def _centroid(self, overlap: np.ndarray, contact: np.ndarray, window: Piece) -> tuple[float, float]:
        """Overlap-weighted centre (x, y) [m] of the contact, both of the shape of the window."""
        weight = np.where(contact, overlap, 0.0).astype(float)
        total = weight.sum()
        x, y = self.grid.x[window[1]], self.grid.y[window[0]]
        return float(weight.sum(axis=0) @ x / total), float(weight.sum(axis=1) @ y / total)


def _touched(overlap: np.ndarray) -> Piece:
    """Rows and columns in which the object overlaps the resting gel."""
    mask = overlap > 0.0
    rows = np.flatnonzero(mask.any(axis=1))
    band = slice(int(rows[0]), int(rows[-1]) + 1)
    columns = np.flatnonzero(mask[band].any(axis=0))
    return band, slice(int(columns[0]), int(columns[-1]) + 1)
