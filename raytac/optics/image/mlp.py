"""The optical mode ``mlp``: colour by a small network (``mlp_weights``)."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from raytac.gel.surface import PadGrid
from raytac.optics.device_mode import Float, UInt8
from raytac.optics.image.base import ImageHeights, ImageMode
from raytac.optics.image.config import Mlp
from raytac.optics.image.mlp_weights import LEVELS, MlpWeights, forward, inputs, load_mlp, view_slope
from raytac.optics.image.network_files import check_straight, check_view
from raytac.optics.taxim.mode import padded, resized


class MlpMode(ImageMode):
    """The optical mode ``mlp`` of one sensor, network and resolution, for batches of surfaces."""

    needs_contact = True

    config: Mlp

    def _set_up(self) -> None:
        super()._set_up()
        weights = self.config.weights
        assert weights is not None
        self.weights = weights if isinstance(weights, MlpWeights) else load_mlp(weights)
        check_straight("mlp", self.sensor)
        check_view("mlp", self.sensor, self.weights.view, self.weights.provenance)
        self._view = view_slope(self.sensor)

    @property
    def _crops(self) -> bool:
        return True

    def _place(self, ops: Any, column: Any, row: Any) -> tuple[Any, Any]:
        width, height = self.camera.resolution
        return (column + 0.5) * (2 / width) - 1, (row + 0.5) * (2 / height) - 1

    def _build(self, grid: PadGrid) -> Float:
        """The image at rest less what the network says of it, 4 floats a pixel."""
        width, height = self.camera.resolution
        row, column = np.mgrid[:height, :width].astype(np.float32)
        u, v = self._place(np, column, row)
        flat = forward(np, self.weights, inputs(np, 0 * u, 0 * u, 0 * u, u, v, self._view))
        rest = resized(self.weights.background, (width, height)) - LEVELS * np.stack(flat, axis=-1)
        return self.mi.Float(padded(rest))

    def _levels(self, seen: ImageHeights, arrays: Float) -> tuple[list[Float], UInt8]:
        mi = self.mi
        sx, sy, _ = seen.slopes(mi, seen.displacement)
        _, p, column, row = seen.pixel(mi)
        u, v = self._place(dr, mi.Float(column), mi.Float(row))
        touched = mi.Float(seen.here(mi, seen.contact))
        change = forward(dr, self.weights, inputs(dr, sx, sy, touched, u, v, self._view))
        rest = dr.gather(mi.Vector4f, arrays, p)
        return [LEVELS * c + rest[k] for k, c in enumerate(change)], mi.UInt8(0)

    def _floats_per_pixel(self) -> float:
        return 4
