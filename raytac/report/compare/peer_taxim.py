"""The PyPI package ``taxim`` as a peer: its own sensor and table, on the same contacts."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import os

import numpy as np

from raytac.errors import BackendError
from raytac.gel.surface import GelSurface
from raytac.optics.base import OpticsImages

AWAY_MM = 5.0
"""Height above the gel that stands for no object [mm]."""


def contact_height_map(surface: GelSurface, size: tuple[int, int], width_mm: float) -> np.ndarray:
    """Object's underside for the package: (B, H, W) float32 [mm], 0 at the gel's top.

    Negative inside. Where there is contact the gel's surface is the object's underside; elsewhere the object counts as ``AWAY_MM`` off,
    since the package deforms the gel by itself. Pixels are squares of ``width_mm`` / W, centred on the pad.
    """
    width, height = size
    pitch = 1e-3 * width_mm / width
    x, y = (np.arange(width) + 0.5 - width / 2) * pitch, (np.arange(height) + 0.5 - height / 2) * pitch
    grid = surface.grid
    column, row = (x - grid.x[0]) / grid.pitch[0], (y - grid.y[0]) / grid.pitch[1]
    inside = ((row >= 0) & (row <= len(grid.y) - 1))[:, None] & ((column >= 0) & (column <= len(grid.x) - 1))[None, :]
    i, j = (np.clip(np.floor(at).astype(int), 0, n - 2) for at, n in ((row, len(grid.y)), (column, len(grid.x))))
    v, u = np.clip(row - i, 0, 1)[:, None], np.clip(column - j, 0, 1)[None, :]

    def corner(a: np.ndarray, di: int, dj: int) -> np.ndarray:
        return a[:, (i + di)[:, None], (j + dj)[None, :]]

    z = surface.height
    upper = (1 - u) * corner(z, 0, 0) + u * corner(z, 0, 1)
    lower = (1 - u) * corner(z, 1, 0) + u * corner(z, 1, 1)
    nearest = surface.contact[:, (i + (v[:, 0] >= 0.5))[:, None], (j + (u[0] >= 0.5))[None, :]]
    return np.where(nearest & inside, 1e3 * ((1 - v) * upper + v * lower), AWAY_MM).astype(np.float32)


class PeerTaxim:
    """The package ``taxim`` with its own sensor, as an ``OpticalMode``: only its time compares."""

    def __init__(self, size: tuple[int, int], *, shadow: bool, device: str) -> None:
        """``size`` (width, height) [px]; ``device``: ``cpu``, or ``cuda`` with a JAX built for it.

        Raises ``BackendError``: the package or JAX is not installed or does not start on ``device``.
        """
        if importlib.util.find_spec("taxim") is None:
            raise BackendError("the package taxim is not installed (`pip install taxim[jax-cpu]` adds it as a peer)")
        # JAX would otherwise take most of the GPU's memory for itself, and this process renders with Dr.Jit too.
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
        try:
            package = importlib.import_module("taxim")
            self.taxim = package.Taxim(calib_folder=package.CALIB_GELSIGHT, backend="jax", device=device)
        except (ImportError, RuntimeError, OSError) as error:
            raise BackendError(f"the package taxim does not start with JAX on {device}: {error}") from error
        self.size, self.shadow, self.device = size, shadow, device
        version = importlib.metadata.version("taxim")
        self.label = f"taxim-{version}-jax" + ("-shadow" if shadow else "")
        self._inputs: dict[int, tuple[GelSurface, np.ndarray]] = {}

    def render(self, surface: GelSurface) -> OpticsImages:
        """Images (B, H, W, 3) uint8; repeated calls with a surface time the package alone."""
        if id(surface) not in self._inputs:
            width_mm = self.taxim.sensor_params.pixmm * self.taxim.width
            self._inputs[id(surface)] = surface, contact_height_map(surface, self.size, width_mm)
        rgb = self.taxim.render(self._inputs[id(surface)][1], with_shadow=self.shadow)
        return OpticsImages(rgb=(np.clip(rgb, 0, 1) * 255 + 0.5).astype(np.uint8))
