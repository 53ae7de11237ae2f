"""The gel around a contact: Taxim's pyramid of Gaussians with the contact re-imposed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from raytac.errors import InputError
from raytac.gel.components import span
from raytac.gel.gaussian import GaussianBlur, fast_gaussian_matrix
from raytac.gel.matmul import product
from raytac.gel.surface import GelSurface, PadGrid

_TAXIM_PIXEL = 0.0295e-3
PYRAMID_SIGMAS = tuple(s * _TAXIM_PIXEL for s in (30.5, 15.5, 8.0, 3.5, 2.0, 1.1))
"""Standard deviations of Taxim's pyramid [m].

OpenCV's automatic σ for kernels 201, 101, 51, 21, 11, 5 at 0.0295 mm a pixel."""
FINAL_SIGMA = 1.1 * _TAXIM_PIXEL
"""Standard deviation of the last smoothing [m]."""
CONTACT_RULES = ("unilateral", "threshold")
CONTACT_SCALE = 0.4
"""Share of the deepest overlap from which a node counts as in full contact."""
FINEST = 0.2
"""Share of the pitch below which Gaussians are skipped: the grid cannot resolve them."""
ROUNDING = 1e-5
"""Excess of w over u in contact over the deepest overlap: above the rounding in float32."""
_REACH = 4.8
"""Standard deviations beyond which a contact has no effect: Φ(−4.8) is 10⁻⁶ of its depth."""

_TOGETHER = 16384
"""Most nodes of a grid whose environments are smoothed together, over the whole pad.

On larger ones what lies around a contact costs more than a call for each environment."""
_STACK = 1 << 17
"""Nodes of all environments that are processed at once, so that they stay in a core's cache."""

Piece = tuple[slice, slice]
"""Rows and columns, with plain starts and stops."""

_LARGEST = 512
"""Nodes along an axis up to which Gaussians are kept as matrices: 1 MB each in float32."""


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
        """``sigmas`` [m], wide to narrow; ``final_sigma`` [m], 0: none; threshold's scale, [0, 1)."""
        if contact_rule not in CONTACT_RULES:
            raise InputError("contact_rule", value=contact_rule, rule="must be a known rule", choices=CONTACT_RULES)
        self.grid, self.contact_rule, self.contact_scale = grid, contact_rule, contact_scale
        finest = FINEST * min(grid.pitch)
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
        if self.grid.rest.size <= _TOGETHER:
            count = max(_STACK // self.grid.rest.size, 1)
            for start in range(0, batch, count):
                some = slice(start, start + count)
                self._press_together(object_height[some], height[some], contact[some], centre[some])
        else:
            for b in range(batch):
                centre[b] = self._press(object_height[b], height[b], contact[b])
        return GelSurface(self.grid, height, contact, centre, pad_from_object)

    def _press_together(self, under: np.ndarray, height: np.ndarray, contact: np.ndarray, centre: np.ndarray) -> None:
        """Write height, contact and its centre under objects, whose undersides are ``under``.

        Environments are smoothed in one call; an environment's result does not depend on its neighbours.
        """
        overlap, field, pressed, spare = (own[: len(under)] for own in self._memory)
        np.subtract(self.grid.rest, under, out=overlap, casting="same_kind")
        deepest = overlap.max(axis=(1, 2))
        height[:] = self._rest
        height[np.isnan(deepest)] = np.nan
        rows = np.flatnonzero(deepest > 0.0)
        if not len(rows):
            return
        if len(rows) < len(overlap):
            np.take(overlap, rows, axis=0, out=field[: len(rows)])
            overlap, field, pressed, spare = (own[: len(rows)] for own in (field, overlap, pressed, spare))
        deepest = deepest[rows, None, None]
        np.maximum(overlap, np.float32(0.0), out=pressed)
        field[:] = pressed
        full = None if self.contact_rule == "unilateral" else overlap > np.float32(self.contact_scale) * deepest
        for blur in self._pyramid:
            blur.of_stack(field, spare)
            if full is None:
                np.maximum(field, pressed, out=field)
            else:
                np.copyto(field, pressed, where=full)
        if full is None:
            np.add(pressed, _slack(deepest), out=spare)
            full = (overlap > 0.0) & (field <= spare)
        contact[rows] = full
        np.multiply(pressed, full, out=spare)
        centre[rows] = self._centroids(spare)
        if self._final is not None:
            self._final.of_stack(field, spare)
        height[rows] = np.subtract(self._rest, field, out=spare)

    @cached_property
    def _memory(self) -> tuple[np.ndarray, ...]:
        """Arrays for ``_press_together``, since new ones would take longer to get than to fill."""
        shape = max(_STACK // self.grid.rest.size, 1), *self.grid.shape
        return tuple(np.empty(shape, np.float32) for _ in range(4))

    @cached_property
    def _weights(self) -> np.ndarray:
        """As ``overlap`` of ``_centroids``, in float64."""
        return np.empty(self._memory[0].shape)

    def _centroids(self, overlap: np.ndarray) -> np.ndarray:
        """Overlap-weighted centres (x, y) [m], (n, 2), of contacts (n, Ny, Nx), 0 outside."""
        weights = self._weights[: len(overlap)]
        weights[:] = overlap
        lines = np.stack([np.ones_like(self.grid.y), self.grid.y])
        sums = lines @ weights  # of every column: the overlap and its moment along y
        moments = np.stack([(sums[:, 0] * self.grid.x).sum(axis=1), sums[:, 1].sum(axis=1)], axis=1)
        return moments / sums[:, 0].sum(axis=1)[:, None]

    def _press(self, under: np.ndarray, height: np.ndarray, contact: np.ndarray) -> tuple[float, float]:
        """``_press_together`` of one environment; returns the contact's centre."""
        overlap = np.subtract(self.grid.rest, under).astype(np.float32)
        deepest = overlap.max()
        height[:] = np.nan if np.isnan(deepest) else self._rest
        if not deepest > 0.0:
            return np.nan, np.nan
        touched = _touched(overlap)
        window = around(touched, self._reach, self.grid.pitch, (slice(0, overlap.shape[0]), slice(0, overlap.shape[1])))
        overlap = overlap[touched]
        displacement, contact[touched] = self._displacement(overlap, deepest, touched, window)
        height[window] -= displacement
        return self._centroid(overlap, contact[touched], touched)

    def _displacement(self, overlap: np.ndarray, deepest: float, touched: Piece, window: Piece) -> tuple[np.ndarray, np.ndarray]:
        """w [m] on the window, and the contact on ``touched``, for the ``overlap`` there."""
        pressed = np.maximum(overlap, 0.0)
        full = overlap > self.contact_scale * deepest
        field, w = self._field(pressed, touched, window), pressed
        for _ in self._pyramid:
            w = field.smooth()
            w = np.maximum(w, pressed) if self.contact_rule == "unilateral" else np.where(full, pressed, w)
            field.impose(w)
        contact = (overlap > 0.0) & (w <= pressed + _slack(np.float32(deepest))) if self.contact_rule == "unilateral" else full
        return field.over(window), contact

    def _field(self, pressed: np.ndarray, touched: Piece, window: Piece) -> WholeField | LocalField:
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


def _slack(deepest: np.ndarray | np.float32) -> np.ndarray:
    """Excess of w over u that still is contact [m].

    Where the overlap is constant the Gaussians keep it up to rounding, which must not decide the contact. The deepest node is always in
    contact, since no Gaussian exceeds the maximum.
    """
    return np.maximum(np.float32(ROUNDING) * deepest, np.finfo(np.float32).tiny)


def _touched(overlap: np.ndarray) -> Piece:
    """Rows and columns in which the object overlaps the resting gel."""
    mask = overlap > 0.0
    rows = span(mask.any(axis=1))
    return rows, span(mask[rows].any(axis=0))


class WholeField:
    """Field on a window, 0 at first outside ``touched``, which every Gaussian sets again."""

    def __init__(
        self, values: np.ndarray, touched: Piece, window: Piece, blurs: Sequence[GaussianBlur], final: GaussianBlur | None
    ) -> None:
        """``values``: on ``touched``, float32; ``window``: beyond it the field stays 0."""
        self._blurs, self._final, self._window, self._next = blurs, final, window, 0
        self._field = np.zeros([line.stop - line.start for line in window], np.float32)
        self._touched = _within(touched, window)
        self._field[self._touched] = values

    def smooth(self) -> np.ndarray:
        """Apply the next Gaussian; returns the field on ``touched``."""
        self._field = self._blurs[self._next](self._field, self._window)
        self._next += 1
        return self._field[self._touched]

    def impose(self, values: np.ndarray) -> None:
        """Set the field on ``touched``."""
        self._field[self._touched] = values

    def over(self, window: Piece) -> np.ndarray:
        """The field on the initial window, with the last Gaussian if there is one."""
        return self._field if self._final is None else self._final(self._field, window)


class ComposedGaussians:
    """Products of successive Gaussians as matrices on one grid, made at the first small contact.

    Successive discrete Gaussians are one of the sum of their variances, also with mirrored borders (see ``gaussian_matrix``).
    """

    def __init__(self, shape: tuple[int, int], pitch: tuple[float, float], sigmas: Sequence[float]) -> None:
        """``shape`` (Ny, Nx); ``pitch`` (x, y) [m]; ``sigmas`` [m] in their order."""
        self.shape, self.pitch, self._squares = shape, pitch, np.square(sigmas)
        self._matrices: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    @property
    def fits(self) -> bool:
        """True if the matrices are small enough to be cached."""
        return max(self.shape) <= _LARGEST

    def sigma(self, first: int, last: int) -> float:
        """Standard deviation of the Gaussians from ``first`` to ``last`` [m]."""
        return float(np.sqrt(self._squares[first : last + 1].sum()))

    def apply(self, first: int, last: int, values: np.ndarray, touched: Piece, piece: Piece) -> np.ndarray:
        """Field on ``piece`` after the Gaussians ``first`` to ``last`` of ``values`` on ``touched``."""
        if (first, last) not in self._matrices:
            sigma = self.sigma(first, last)
            self._matrices[first, last] = tuple(  # type: ignore[assignment]
                fast_gaussian_matrix(nodes, sigma / pitch) for nodes, pitch in zip(self.shape, reversed(self.pitch), strict=True)
            )
        along_y, along_x = self._matrices[first, last]
        return product(product(along_y[piece[0], touched[0]], values), along_x[piece[1], touched[1]].T)


class LocalField:
    """``WholeField`` as a sum of increments on ``touched``, smoothed by all later Gaussians.

    Only the re-imposed contact is not linear, and it acts on ``touched`` alone. So the field is computed there, and at the end over the
    window. With m nodes along a side of ``touched`` and n Gaussians this takes about n² m³ multiply-adds, whatever the window.
    """

    def __init__(
        self, values: np.ndarray, touched: Piece, gaussians: ComposedGaussians, count: int, final: bool, reach: float
    ) -> None:
        """``count`` Gaussians before an imposition, one more if ``final``, each to ``reach`` σ."""
        self._gaussians, self._touched = gaussians, touched
        self._last, self._reach = count - 1 + final, reach
        self._increments, self._present = [values], values

    def smooth(self) -> np.ndarray:
        last = len(self._increments) - 1
        total = np.zeros_like(self._present)
        for first, values in enumerate(self._increments):
            total += self._gaussians.apply(first, last, values, self._touched, self._touched)
        self._present = total
        return total

    def impose(self, values: np.ndarray) -> None:
        self._increments.append(values - self._present)
        self._present = values

    def over(self, window: Piece) -> np.ndarray:
        total = np.zeros([line.stop - line.start for line in window], np.float32)
        for first, values in enumerate(self._increments):
            if first > self._last:  # no Gaussian comes after it
                total[_within(self._touched, window)] += values
                continue
            # A discrete Gaussian narrower than a node reaches farther for its width than a wide one.
            margin = self._reach * self._gaussians.sigma(first, self._last) + 2.0 * max(self._gaussians.pitch)
            piece = around(self._touched, margin, self._gaussians.pitch, window)
            total[_within(piece, window)] += self._gaussians.apply(first, self._last, values, self._touched, piece)
        return total


def around(piece: Piece, margin: float, pitch: tuple[float, float], within: Piece) -> Piece:
    """A piece with a ``margin`` [m] around it, clipped to the piece ``within``."""
    rows, columns = (
        slice(max(line.start - nodes, whole.start), min(line.stop + nodes, whole.stop))
        for line, nodes, whole in zip(piece, (int(np.ceil(margin / p)) for p in reversed(pitch)), within, strict=True)
    )
    return rows, columns


def _within(piece: Piece, window: Piece) -> Piece:
    """A piece of the grid in the window's own rows and columns."""
    rows, columns = (slice(line.start - whole.start, line.stop - whole.start) for line, whole in zip(piece, window, strict=True))
    return rows, columns
