"""Converged reference images, kept on disk: two independent halves each, so that their own noise is known."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.io.arrays import npz_bytes
from raytac.io.code_digest import code_digest
from raytac.io.metrics import versions
from raytac.io.seal import read_sealed, write_sealed
from raytac.optics.trace.config import RayTraced
from raytac.report.tracers import Tracers, path_trace

__all__ = ["References"]


class References:
    """Images of the ``reference`` integrator without limit of depth, in ``folder`` under a hash of all that shapes them."""

    def __init__(
        self, folder: Path, tracers: Tracers, size: tuple[int, int], spp: int, say: Callable[[str], object] = print
    ) -> None:
        """``spp`` samples a pixel in both halves together, at least 2; ``say`` tells what is computed and what was unreadable."""
        self.folder, self.tracers, self.size, self.spp, self.say = Path(folder), tracers, size, spp, say
        spec = replace(tracers.spec, source=None, lights=replace(tracers.spec.lights, source=None))
        basis = [repr(spec), repr(size), str(spp), str(tracers.seed), tracers.device]
        basis += [*versions(("mitsuba", "drjit")).values(), code_digest("raytac.optics.trace.reference", "raytac.optics.runtime")]
        self._basis = "\n".join(basis).encode()

    def key(self, surface: GelSurface) -> str:
        """Content hash of sensor, lights, surface, size, samples, seed, device, versions and code; 20 hex digits."""
        return hashlib.sha256(self._basis + surface.height.astype(np.float32).tobytes()).hexdigest()[:20]

    def halves(self, scene: str, surface: GelSurface) -> np.ndarray:
        """Two linear images of ``spp`` / 2 samples a pixel with independent seeds, (2, H, W, 3) float32.

        Read if they were computed before; a file that cannot be read is computed again.
        """
        path = self.folder / f"{scene}-{self.key(surface)}.npz"
        kept = self._read(path)
        if kept is not None:
            return kept
        tracer, seed, half = (
            self.tracers.get(self.size, RayTraced("reference", progress=True)),
            2 * self.tracers.seed,
            self.spp // 2,
        )
        self.say(f"reference of {scene}, {self.size[0]}x{self.size[1]}: 2 x {half} spp")
        halves = np.stack([path_trace(tracer, surface, half, seed + k) for k in (0, 1)])
        write_sealed(path, npz_bytes({"halves": halves}))
        return halves

    def _read(self, path: Path) -> np.ndarray | None:
        if not path.is_file():
            return None
        try:
            with np.load(io.BytesIO(read_sealed(path)), allow_pickle=False) as kept:
                halves = kept["halves"]
        except (OSError, ValueError, KeyError) as error:
            self.say(f"{path} cannot be used ({error}): computed again")
            return None
        if halves.shape != (2, self.size[1], self.size[0], 3) or not np.isfinite(halves).all():
            self.say(f"{path} does not hold two finite images of {self.size[0]}x{self.size[1]}: computed again")
            return None
        return halves

    def linear(self, scene: str, surface: GelSurface) -> np.ndarray:
        """The reference: mean of both halves, linear, (H, W, 3) float32."""
        return self.halves(scene, surface).mean(axis=0)
