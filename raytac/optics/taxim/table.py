"""A Taxim table: polynomials by slope, shadows by direction and depth, the rest image.

Si and Yuan, Taxim: an example-based simulation model for GelSight tactile sensors (RA-L 2022), section III. Conventions of every array
here: colours in the order R, G, B (upstream's files are B, G, R), values in 8-bit levels (0-255, not clipped), row 0 at the image's
top, column and row of a pixel's centre are whole numbers (the first pixel's centre is column 0, row 0) of the *calibration image*.

Heights follow upstream: h = −z of the pad frame, so h grows towards the camera, and a press raises it. The slope of a pixel is

    s_x = ∂h/∂x, s_y = ∂h/∂y   (x right along columns, y down along rows; dimensionless)

by central differences over the neighbouring pixels, magnitude atan √(s_x² + s_y²) in [0, π/2), direction atan2(s_y, s_x) in [−π, π],
0 where it is flat. It points uphill: towards the centre of a ball's imprint.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from raytac.checks import check_known
from raytac.errors import InputError

SLOPES_OF = ("height", "displacement")
"""Fields whose slopes index a table: the surface (upstream) or its displacement (baked)."""

DEPTHS_OF = ("origin", "drop")
"""Depths that index a shadow table: the casting pixel's (upstream), or the drop from it."""


@dataclass(frozen=True)
class TaximConstants:
    """Settings of upstream's simulator and its values; lengths in calibration pixels."""

    background_sigma: float = 50.0
    """Width of the Gaussian over the rest image [px]."""
    background_share: float = 0.15
    """Share of the blurred rest image in the background, in [0, 1]."""
    background_threshold: float = 5.0
    """Least mean of blurred − sharp [levels] at which the blurred image fills in (dark markers)."""
    ring_dilations: int = 2
    """Dilations of the contact by a 5 × 5 square whose new pixels cast shadows."""
    shadow_sigma: float = 2.0
    """Gaussian over the shaded difference image [px], truncated at 4 σ."""
    final_sigma: float = 1.1
    """Gaussian over the image with shadows [px], 5 taps."""


@dataclass(frozen=True)
class ShadowTable:
    """Levels along the shadow of a contact's rim, by direction of the rim's slope and by depth.

    A ring pixel with slope direction a and indentation d has direction bin ⌊(a + π) / direction_precision⌋ and depth bin
    ⌊(d − first_depth) / depth_precision⌋ + depth_offset; outside the table it casts none. It casts a fan of rays
    (``rays``); at the distance s · step, s = 1, 2, … < length, along a ray the difference from the background is at most
    values[c, direction, depth, s]. ``directions`` are those of the rays in the image: x right, y down, so π/2 is down.
    """

    directions: np.ndarray
    """Ray direction by direction bin [rad], shape (n_dir,)."""
    values: np.ndarray
    """Change [levels], (3, n_dir, n_depth, max_length), float32; 0 beyond a list's length."""
    lengths: np.ndarray
    """Values in each list, (3, n_dir, n_depth), int32; 0 is no shadow; the first is never read."""
    first_depth: float = 0.4e-3
    """Depth at which the bins start [m]."""
    depth_precision: float = 0.1e-3
    """Width of a depth bin [m]."""
    depth_offset: int = 6
    """Added to the depth bin: 6 in upstream, without a reason; 0 in tables of raytac."""
    direction_precision: float = 0.1
    """Width of a direction bin [rad]."""
    step: float = 1.25
    """Distance between values along a ray [calibration pixels]."""
    fan_angle: float = 0.1
    """Half the opening of the fan of rays about a direction [rad]."""
    fan_precision: float = 0.05
    """Angle between the rays of a fan [rad]."""
    depth_of: str = "origin"
    """Depth that gives the bin, one of ``DEPTHS_OF``.

    ``"origin"``: the ring pixel's indentation, one list for the whole ray (upstream). ``"drop"``: by how much less the shaded pixel is
    indented, so that a ray in the valley of a relief meets a low wall."""

    def __post_init__(self) -> None:
        n_dir = len(self.directions)
        shape = self.values.shape
        if self.directions.ndim != 1 or not n_dir:
            raise InputError("shadow.directions", value=self.directions.shape, rule="must have shape (n_dir,), n_dir >= 1")
        if len(shape) != 4 or shape[:2] != (3, n_dir) or min(shape) < 1:
            raise InputError("shadow.values", value=shape, rule=f"must have shape (3, {n_dir}, n_depth, max_length), all >= 1")
        if self.lengths.shape != shape[:3]:
            raise InputError("shadow.lengths", value=self.lengths.shape, rule=f"must have shape {shape[:3]}, as values say")
        if self.lengths.dtype.kind not in "iu" or self.lengths.min() < 0 or self.lengths.max() > shape[3]:
            raise InputError("shadow.lengths", value=self.lengths.dtype, rule=f"must be whole numbers in [0, {shape[3]}]")
        for name, array in (("directions", self.directions), ("values", self.values)):
            if not np.isfinite(array).all():
                raise InputError(f"shadow.{name}", value=array.dtype, rule="must be finite")
        for name in ("depth_precision", "direction_precision", "step", "fan_angle", "fan_precision"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InputError(f"shadow.{name}", value=getattr(self, name), rule="must be finite and > 0")
        check_known("shadow.depth_of", self.depth_of, DEPTHS_OF)
        if self.fan_angle > 32 * self.fan_precision:
            raise InputError("shadow.fan_precision", value=self.fan_precision, rule="must make a fan of at most 64 rays")

    def rays(self) -> np.ndarray:
        """Ray directions [rad], (n_dir, n_rays): arange(a ± fan_angle, fan_precision) about each a.

        Rounding makes that one ray more for some directions than for others (upstream: 4 or 5); shorter fans repeat their last ray,
        which changes nothing.
        """
        fans = [np.arange(a - self.fan_angle, a + self.fan_angle, self.fan_precision) for a in self.directions]
        most = max(len(fan) for fan in fans)
        return np.stack([np.pad(fan, (0, most - len(fan)), mode="edge") for fan in fans])


@dataclass(frozen=True)
class PolyTable:
    """Differences from the rest image: one polynomial of the position a slope bin.

    dI_c(x, y) = gradients[c, i, j] · [x², y², x y, x, y, 1] with i the magnitude's bin, j the direction's (``slope_bins``), x the
    column and y the row in the calibration image; the image is background + dI.
    """

    gradients: np.ndarray
    """Coefficients [levels], (3, n_bins, n_bins, 6): channel, magnitude, direction, monomial."""
    covered: np.ndarray | None
    """Bins that a sample reached, (n_bins, n_bins), bool; None if not known (upstream).

    The others hold a fill (``provenance["fill"]`` says which)."""
    background: np.ndarray
    """Processed rest image that differences are added to [levels], (H, W, 3), float32."""
    pixel_pitch: tuple[float, float]
    """Size of a pixel of the calibration image on the plane z = 0 along x and y [m]."""
    shadow: ShadowTable | None = None
    slopes_of: str = "displacement"
    """Field whose slopes are the index, one of ``SLOPES_OF``.

    ``"displacement"``: slopes of rest − z, and dI = 0 where a pixel and its four neighbours have not moved, so that the image at rest is
    the background exactly, also on a dome; where it moved by less than 20 µm, dI is that share of the polynomial's. ``"height"``: slopes of
    −z (upstream)."""
    rest_image: np.ndarray | None = None
    """Image at rest as taken, (H, W, 3), uint8, for ``save_calibration``; None: the background."""
    gel_map: np.ndarray | None = None
    """Height at rest as upstream has it [calibration pixels], (H, W), larger is farther off."""
    surround: np.ndarray | None = None
    """Coefficients where the object does not touch; None: ``gradients`` serve both (upstream).

    The apex of a press and the skirt around it have slopes alike but not colours."""
    one_sheet: np.ndarray | None = None
    """Beside ``surround``: coefficients for readers that know one sheet; None: ``gradients``."""
    constants: TaximConstants = TaximConstants()
    provenance: dict[str, str] = field(default_factory=dict)
    """Origin of the table, text by name: ``source``, ``sensor``, ``fill``, …"""

    def __post_init__(self) -> None:
        shape = self.gradients.shape
        if len(shape) != 4 or shape[0] != 3 or shape[1] != shape[2] or shape[1] < 2 or shape[3] != 6:
            raise InputError("gradients", value=shape, rule="must have shape (3, n_bins, n_bins, 6), n_bins >= 2")
        if not np.isfinite(self.gradients).all():
            raise InputError("gradients", value=self.gradients.dtype, rule="must be finite")
        for name in ("surround", "one_sheet"):
            sheet = getattr(self, name)
            if sheet is not None and (sheet.shape != shape or not np.isfinite(sheet).all()):
                raise InputError(name, value=sheet.shape, rule=f"must be finite and of the gradients' shape {shape}, or None")
        if self.one_sheet is not None and self.surround is None:
            raise InputError("one_sheet", value=self.one_sheet.shape, rule="must be None without surround: gradients are the one")
        if self.covered is not None and (self.covered.shape != shape[1:3] or self.covered.dtype != np.bool_):
            value = f"{self.covered.dtype} {self.covered.shape}"
            raise InputError("covered", value=value, rule=f"must be bool of shape {shape[1:3]}, or None")
        image = self.background
        if image.ndim != 3 or image.shape[2] != 3 or min(image.shape) < 3 or not np.isfinite(image).all():
            rule = "must be a finite image of shape (H, W, 3), at least 3 x 3 pixels"
            raise InputError("background", value=image.shape, rule=rule)
        for name in ("rest_image", "gel_map"):
            array, expected = getattr(self, name), image.shape if name == "rest_image" else image.shape[:2]
            if array is not None and array.shape != expected:
                raise InputError(name, value=array.shape, rule=f"must have the background's shape {expected}")
        if len(self.pixel_pitch) != 2 or not all(np.isfinite(p) and p > 0 for p in self.pixel_pitch):
            raise InputError("pixel_pitch", value=self.pixel_pitch, rule="must be (x, y), finite and > 0 [m]")
        check_known("slopes_of", self.slopes_of, SLOPES_OF)

    @property
    def n_bins(self) -> int:
        """Number of bins of the magnitude, and of the direction."""
        return self.gradients.shape[1]

    @property
    def resolution(self) -> tuple[int, int]:
        """(width, height) of the calibration image [px]."""
        return self.background.shape[1], self.background.shape[0]


def slope_bins(slope_x: np.ndarray, slope_y: np.ndarray, n_bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Magnitude and direction bin (i, j) of slopes of any shape.

    i = ⌊magnitude / (π/2 / (n − 1))⌋ and j = ⌊(direction + π) / (2π / (n − 1))⌋, both in [0, n − 1]; a flat place is (0, ⌊(n − 1)/2⌋).
    """
    magnitude = np.arctan(np.hypot(slope_x, slope_y))
    direction = np.arctan2(slope_y, slope_x)
    i, j = magnitude / (0.5 * np.pi / (n_bins - 1)), (direction + np.pi) / (2 * np.pi / (n_bins - 1))
    return np.floor(i).astype(np.int64), np.floor(j).astype(np.int64)


def polynomial_basis(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[x², y², x y, x, y, 1] of columns x and rows y, (…, 6), as in ``PolyTable.gradients``."""
    x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
    return np.stack([x * x, y * y, x * y, x, y, np.ones_like(x)], axis=-1)
