"""``BondedFaces``: bodies that have gone through the gel of a pad, or its case."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from raytac.physics.rigid.contact_rows import LAST
from raytac.physics.rigid.pierce_kernels import find_pierced, lose_pierced
from raytac.physics.rigid.search_kernels import PITCHES
from raytac.physics.rigid.shape_arrays import PadArrays, ShapeArrays
from raytac.shapes.part import Part
from raytac.specs.sensor import GelpadSpec
from raytac.warp_runtime import start_warp

_LANES = 128
"""Threads that look for one body beyond one face on CUDA."""


class BondedFaces:
    """Bonded faces of pads, and the cases behind them (``pierce_kernels``), on CPU or CUDA."""

    def __init__(self, pads: PadArrays, bodies: ShapeArrays, device: Any) -> None:
        """``pads`` and ``bodies``: on the device."""
        self._pads, self._bodies, self._device = pads, bodies, device
        self._lanes = 1 if device.is_cpu else _LANES

    @classmethod
    def on_cpu(cls, gelpads: Sequence[GelpadSpec], bodies: Sequence[Sequence[Part]]) -> BondedFaces:
        """Of pads and of bodies by their parts, body frame."""
        start_warp()
        device = wp.get_device("cpu")
        return cls(PadArrays(gelpads, PITCHES, LAST, device), ShapeArrays(bodies, device), device)

    def pierced(self, pad_from_body: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
        """True (n, pads, bodies) where bodies are beyond a pad's bonded face, or went there.

        Args:
            pad_from_body: poses (n, pads, bodies, 4, 4); one that is not finite is not beyond.
            before: poses that they come from, NaN where unknown; None is unknown everywhere.
        """
        if before is None:
            before = np.full(pad_from_body.shape, np.nan)
        arrays = [wp.array(np.ascontiguousarray(one), dtype=wp.mat44d, device=self._device) for one in (before, pad_from_body)]
        result = wp.zeros(pad_from_body.shape[:3], dtype=wp.int32, device=self._device)
        inputs = [self._bodies.struct, self._pads.struct, *arrays, self._lanes, result]
        wp.launch(find_pierced, dim=(*result.shape, self._lanes), inputs=inputs, device=self._device)
        return result.numpy() != 0

    def lose(self, motion: Any, steps: Any) -> None:
        """Lose environments of a step in which a body is or went beyond a face; one kernel."""
        inputs = [self._bodies.struct, self._pads.struct, motion, self._lanes, steps]
        wp.launch(lose_pierced, dim=(*motion.suspect.shape, self._lanes), inputs=inputs, device=self._device)
