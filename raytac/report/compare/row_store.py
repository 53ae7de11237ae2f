"""Finished rows of a long comparison, kept on disk so that an interrupted run goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from raytac.io.atomic import write_atomic
from raytac.io.png import png_bytes, read_png

__all__ = ["Row", "RowStore", "row_key"]

Value = str | int | float | bool | None


@dataclass(frozen=True)
class Row:
    """Figures of one scene, resolution and mode by column name, None where one is not defined or not known; and the image."""

    figures: dict[str, Value]
    image: np.ndarray
    """What the mode made of the scene, (H, W, 3) uint8."""


def row_key(basis: Mapping[str, object]) -> str:
    """20 hex digits that change with anything in ``basis``."""
    return hashlib.sha256(json.dumps(basis, sort_keys=True, default=repr).encode()).hexdigest()[:20]


class RowStore:
    """One JSON file and one PNG a row in ``folder``; a row counts only if both are whole."""

    def __init__(self, folder: Path, say: Callable[[str], object] = print) -> None:
        """``say`` tells of rows that cannot be used."""
        self.folder, self.say = Path(folder), say

    def read(self, name: str, key: str) -> Row | None:
        """The row written under ``name`` and ``key``, or None if there is none or its files are damaged."""
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
        except (OSError, ValueError, KeyError, TypeError, SyntaxError) as error:  # PIL calls a broken chunk a SyntaxError
            self.say(f"{path.name} cannot be used ({error}): measured again")
            return None

    def write(self, name: str, key: str, row: Row) -> None:
        """Keep a row; the JSON file comes last, so that an interrupt leaves no row that looks finished."""
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
