"""Settings of a bake: numbers of presses and their ranges, which a cached table's key holds."""

from __future__ import annotations

from dataclasses import dataclass

from raytac.checks import check_number, check_numbers, check_whole
from raytac.errors import InputError
from raytac.optics.taxim.table import TaximConstants

PLAIN = TaximConstants(background_sigma=1.0, background_share=0.0, background_threshold=1e3, shadow_sigma=0.0, final_sigma=0.0)
"""The image at rest is the background as it is, and nothing is blurred."""


@dataclass(frozen=True)
class BakeSettings:
    """Presses of the virtual calibration and how they are fitted."""

    images: int = 400
    """Images with balls."""
    punches: int = 100
    """Images with flat-ended pins, for steep gel that no object touches."""
    balls: int = 4
    """Most balls in one image."""
    radius: tuple[float, float] = (1e-3, 6e-3)
    """Smallest and largest ball [m]."""
    depth: tuple[float, float] = (0.3e-3, 1.1e-3)
    """Shallowest and deepest press [m]; at most ``deepest_share`` of the pad's thickness."""
    deepest_share: float = 0.3
    """Deepest press as a share of the pad's thickness."""
    bare_share: float = 0.4
    """Share of images whose balls press without the gel around them yielding."""
    n_bins: int = 125
    """Bins of the slope's magnitude, and of its direction (upstream: 125)."""
    neighbours: float = 0.3
    """Weight of the samples of each of the eight bins around a bin in its fit."""
    ridge: float = 1e-4
    """Pull of all but the constant term to 0, over the number of samples; positions in [−1, 1]."""
    pins: int = 96
    """Presses of a pin, and as many of a ball, that shadows are read from; 0 bakes none."""
    pin_radius: tuple[float, float] = (0.4e-3, 2e-3)
    """Thinnest and thickest pin, of punches too [m]."""

    def __post_init__(self) -> None:
        for name, lowest in (("images", 1), ("punches", 0), ("balls", 1), ("n_bins", 3), ("pins", 0)):
            check_whole(f"bake.{name}", getattr(self, name), lowest)
        for name in ("radius", "depth", "pin_radius"):
            low, high = check_numbers(f"bake.{name}", getattr(self, name), (2,), finite=True)
            if not 0 < low <= high:
                raise InputError(f"bake.{name}", value=getattr(self, name), rule="must be (low, high) with 0 < low <= high [m]")
        for name in ("deepest_share", "bare_share", "neighbours", "ridge"):
            check_number(f"bake.{name}", getattr(self, name), "[0, 1]")

    @classmethod
    def quick(cls) -> BakeSettings:
        """Coarse and in seconds, to see that all works."""
        return cls(images=40, punches=10, n_bins=45, pins=12)

    def renders(self, shadows: bool) -> int:
        """Images that a bake renders: balls, punches, and with ``shadows`` pins and balls for these."""
        return self.images + self.punches + 6 * self.pins * shadows

    def depth_range(self, thickness: float) -> tuple[float, float]:
        """Shallowest and deepest press [m] on a pad of this ``thickness`` [m]."""
        deepest = min(self.depth[1], self.deepest_share * thickness)
        return min(self.depth[0], deepest), deepest
