"""Lens and aim of a camera: from the image to rays in the pad frame and back.

It is the same in every optical mode. Distortion is that of Brown and Conrady, with the coefficients of OpenCV. With r² = x² + y² of
undistorted coordinates x = X/Z, y = Y/Z

    x_d = x (1 + k1 r² + k2 r⁴) + 2 p1 x y + p2 (r² + 2x²)
    y_d = y (1 + k1 r² + k2 r⁴) + p1 (r² + 2y²) + 2 p2 x y

(D. C. Brown, Decentering distortion of lenses, 1966). The inverse has no closed form and is found by Newton's method. All functions take
floats, NumPy or Dr.Jit arrays.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from raytac.se3 import rotations

_STEPS = 6
"""Newton steps of the inverse: it converges quadratically, and lenses that fold are refused."""


@dataclass(frozen=True)
class Lens:
    """Distortion and tilt of a camera; without either, image coordinates are slopes of rays."""

    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2."""
    tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector [rad], pad frame, that turns the camera from looking along +z."""

    @property
    def distorts(self) -> bool:
        return any(self.distortion)

    @property
    def tilts(self) -> bool:
        return any(self.tilt)

    @property
    def is_plain(self) -> bool:
        """True for a pinhole that looks along +z."""
        return not (self.distorts or self.tilts)

    @cached_property
    def rotation(self) -> tuple[tuple[float, float, float], ...]:
        """Rows of the rotation from the camera's frame to the pad frame."""
        turn = rotations(np.array(self.tilt)) if self.tilts else np.eye(3)
        return tuple(tuple(map(float, row)) for row in turn)  # type: ignore[return-value]

    @property
    def axis(self) -> tuple[float, float, float]:
        """Optical axis in the pad frame, of length 1."""
        return self.rotation[0][2], self.rotation[1][2], self.rotation[2][2]

    def slope(self, x: Any, y: Any) -> tuple[Any, Any]:
        """(dx/dz, dy/dz), pad frame, of the ray that the image shows at (x, y) = pixels over f."""
        if self.distorts:
            x, y = self._undistorted(x, y)
        if not self.tilts:
            return x, y
        along = [a * x + b * y + c for a, b, c in self.rotation]
        return along[0] / along[2], along[1] / along[2]

    def image(self, tx: Any, ty: Any) -> tuple[Any, Any]:
        """Place in the image, in units of f, of a ray with these slopes: inverse of ``slope``."""
        x, y = tx, ty
        if self.tilts:
            rows = zip(*self.rotation, strict=True)
            along = [a * tx + b * ty + c for a, b, c in rows]
            x, y = along[0] / along[2], along[1] / along[2]
        return self._distorted(x, y, *self._radial(x, y)) if self.distorts else (x, y)

    def determinant(self, x: Any, y: Any) -> Any:
        """Area of the image over that without distortion at undistorted (x, y); ≤ 0 where it folds."""
        xx, xy, yy = self._jacobian(x, y, *self._radial(x, y))
        return xx * yy - xy * xy

    def _radial(self, x: Any, y: Any) -> tuple[Any, Any]:
        """r² and 1 + k1 r² + k2 r⁴."""
        k1, k2, _, _ = self.distortion
        r2 = x * x + y * y
        return r2, 1 + r2 * (k1 + k2 * r2)

    def _distorted(self, x: Any, y: Any, r2: Any, radial: Any) -> tuple[Any, Any]:
        _, _, p1, p2 = self.distortion
        x_d, y_d = x * radial, y * radial
        if not (p1 or p2):
            return x_d, y_d
        return x_d + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y_d + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y

    def _jacobian(self, x: Any, y: Any, r2: Any, radial: Any) -> tuple[Any, Any, Any]:
        """∂x_d/∂x, ∂x_d/∂y = ∂y_d/∂x and ∂y_d/∂y."""
        k1, k2, p1, p2 = self.distortion
        rise = 2 * (k1 + 2 * k2 * r2)
        xx, xy, yy = radial + rise * x * x, rise * x * y, radial + rise * y * y
        if not (p1 or p2):
            return xx, xy, yy
        return xx + 2 * p1 * y + 6 * p2 * x, xy + 2 * p1 * x + 2 * p2 * y, yy + 6 * p1 * y + 2 * p2 * x

    def _undistorted(self, x_d: Any, y_d: Any) -> tuple[Any, Any]:
        x, y = x_d, y_d
        for _ in range(_STEPS):
            r2, radial = self._radial(x, y)
            at_x, at_y = self._distorted(x, y, r2, radial)
            off_x, off_y = at_x - x_d, at_y - y_d
            xx, xy, yy = self._jacobian(x, y, r2, radial)
            scale = 1 / (xx * yy - xy * xy)
            x, y = x - scale * (yy * off_x - xy * off_y), y - scale * (xx * off_y - xy * off_x)
        return x, y
