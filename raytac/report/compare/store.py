"""Finished rows of a comparison on disk, so that an interrupted run goes on."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.io.arrays import npz_bytes
from raytac.io.atomic import write_atomic
from raytac.io.code_digest import code_digest
from raytac.io.images import png_bytes, read_png
from raytac.io.metrics import versions
from raytac.io.seal import read_sealed, write_sealed
from raytac.optics.trace.config import RayTraced
from raytac.report.tracers import Tracers, path_trace

Value = str | int | float | bool | None


@dataclass(frozen=True)
class Row:
    """Figures of a scene, resolution and mode by column, None if not known; and the image."""

    figures: dict[str, Value]
    image: np.ndarray
    """Image of the scene by the mode, (H, W, 3) uint8."""


def row_key(basis: Mapping[str, object]) -> str:
    """20 hex digits that change with anything in ``basis``."""
    return hashlib.sha256(json.dumps(basis, sort_keys=True, default=repr).encode()).hexdigest()[:20]


class RowStore:
    """One JSON file and one PNG a row in ``folder``; a row counts only if both are whole."""

    def __init__(self, folder: Path, say: Callable[[str], object] = print) -> None:
        """``say`` tells of rows that cannot be used."""
        self.folder, self.say = Path(folder), say

    def read(self, name: str, key: str) -> Row | None:
        """The row written under ``name`` and ``key``; None if there is none or it is damaged."""
        path = self._path(name, key)
        if not path.is_file():
            return None
        try:
            kept = json.loads(path.read_text(encoding="utf-8"))
            image = read_png(path.with_suffix(".png"))
            whole = kept["key"] == key and kept["figures_sha256"] == _digest_figures(kept["figures"])
            if not whole or kept["image_sha256"] != _digest_image(image):
                raise ValueError("contents differ from their checksum")
            return Row(kept["figures"], image)
        except (OSError, ValueError, KeyError, TypeError) as error:
            self.say(f"{path.name} cannot be used ({error}): measured again")
            return None

    def write(self, name: str, key: str, row: Row) -> None:
        """Keep a row; the JSON file comes last, so that no interrupted row looks finished."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self._path(name, key)
        write_atomic(path.with_suffix(".png"), png_bytes(row.image))
        kept = {
            "key": key,
            "figures": row.figures,
            "figures_sha256": _digest_figures(row.figures),
            "image_sha256": _digest_image(row.image),
        }
        write_atomic(path, (json.dumps(kept, indent=1, allow_nan=False) + "\n").encode())

    def _path(self, name: str, key: str) -> Path:
        return self.folder / f"{name}-{key}.json"


def _digest_figures(figures: dict[str, Value]) -> str:
    return hashlib.sha256(json.dumps(figures, sort_keys=True).encode()).hexdigest()


def _digest_image(image: np.ndarray) -> str:
    return hashlib.sha256(repr(image.shape).encode() + np.ascontiguousarray(image).tobytes()).hexdigest()


class References:
    """Images of ``reference`` without limit of depth, named by a hash of all that shapes them."""

    def __init__(
        self, folder: Path, tracers: Tracers, size: tuple[int, int], spp: int, say: Callable[[str], object] = print
    ) -> None:
        """``spp``: samples a pixel of both halves together, at least 2; ``say``: for messages."""
        self.folder, self.tracers, self.size, self.spp, self.say = Path(folder), tracers, size, spp, say
        spec = replace(tracers.spec, source=None, lights=replace(tracers.spec.lights, source=None))
        basis = [repr(spec), repr(size), str(spp), str(tracers.seed), tracers.device]
        basis += [*versions(("mitsuba", "drjit")).values(), code_digest("raytac.optics.trace.reference", "raytac.optics.runtime")]
        self._basis = "\n".join(basis).encode()

    def key(self, surface: GelSurface) -> str:
        """Hash of sensor, surface, size, samples, seed, device, versions and code; 20 hex digits."""
        return hashlib.sha256(self._basis + surface.height.astype(np.float32).tobytes()).hexdigest()[:20]

    def halves(self, scene: str, surface: GelSurface) -> np.ndarray:
        """Two linear images of ``spp`` / 2 samples and own seeds, (2, H, W, 3); read if kept."""
        path = self.folder / f"{scene}-{self.key(surface)}.npz"
        kept = self._read(path)
        if kept is not None:
            return kept
        tracer = self.tracers.get(self.size, RayTraced("reference", progress=True))
        seed, half = 2 * self.tracers.seed, self.spp // 2
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
