"""The deformed coat surface: the one thing that physics hands to optics, markers and force outputs."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from raytac.errors import InputError
from raytac.gel.coat_mesh import DeformedCoat

__all__ = ["GelSurface", "PadGrid", "summary"]


def summary(record: Any) -> str:
    """A dataclass on one line: arrays by type and shape instead of their values, and without the fields that are None or empty."""
    shown = []
    for name, value in ((f.name, getattr(record, f.name)) for f in fields(record)):
        if isinstance(value, dict):
            value = {key: _brief(v) for key, v in value.items()}
            text = "{" + ", ".join(f"{key}: {v}" for key, v in value.items()) + "}" if value else ""
        else:
            text = "" if value is None else _brief(value)
        shown += [f"{name}={text}"] if text else []
    return f"{type(record).__name__}({', '.join(shown)})"


def _brief(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}"
    return f"{value:.3g}" if isinstance(value, float) else repr(value)


@dataclass(frozen=True, repr=False)
class PadGrid:
    """Nodes of a regular grid over the whole pad, pad frame.

    ``x`` [m], shape (Nx,), ascending from −size_x/2 to size_x/2; ``y`` [m], shape (Ny,), likewise (image down);
    ``rest`` [m], shape (Ny, Nx): z of the undeformed surface, 0 at the pad centre and <= 0 elsewhere on a dome.
    """

    x: np.ndarray
    y: np.ndarray
    rest: np.ndarray

    def __repr__(self) -> str:
        return summary(self)

    @cached_property
    def pitch(self) -> tuple[float, float]:
        """Node spacing along x and y [m]."""
        return float(self.x[1] - self.x[0]), float(self.y[1] - self.y[0])

    @property
    def shape(self) -> tuple[int, int]:
        return self.rest.shape  # type: ignore[return-value]

    @cached_property
    def origin(self) -> tuple[float, float]:
        """x and y of the first node [m]."""
        return float(self.x[0]), float(self.y[0])


@dataclass(frozen=True, repr=False)
class GelSurface:
    """Coat surface of B pads on one grid.

    height [m], shape (B, Ny, Nx), float32: z in the pad frame. contact, shape (B, Ny, Nx), bool: where the object touches.
    contact_centre [m], shape (B, 2): x, y of the pressure-weighted (here: indentation-weighted) contact centroid, NaN without
    contact.
    pad_from_object, shape (B, 4, 4): pose of the object, or None when there is no object.
    coat: the same surface as a mesh that moves sideways too, where the physics simulates the gel; None elsewhere.
    ink, shape (B, Ny, Nx), float32: share of the skin that marker dots cover around each node, in [0, 1]; None without dots.

    Raises ``InputError`` for arrays of another kind or shape; heights of environments that failed may be NaN.
    """

    grid: PadGrid
    height: np.ndarray
    contact: np.ndarray
    contact_centre: np.ndarray
    pad_from_object: np.ndarray | None = None
    coat: DeformedCoat | None = None
    ink: np.ndarray | None = None

    def __post_init__(self) -> None:
        expected = (len(self.height) if isinstance(self.height, np.ndarray) and self.height.ndim else 0, *self.grid.shape)
        shapes = {"height": ("f", expected), "contact": ("b", expected), "contact_centre": ("f", (expected[0], 2))}
        if self.pad_from_object is not None:
            shapes["pad_from_object"] = ("f", (expected[0], 4, 4))
        for name, (kind, shape) in shapes.items():
            array = getattr(self, name)
            if not isinstance(array, np.ndarray) or array.dtype.kind != kind or array.shape != shape:
                shown = (str(array.dtype), array.shape) if isinstance(array, np.ndarray) else type(array).__name__
                kinds = {"f": "floating-point numbers", "b": "truth values"}[kind]
                rule = f"must be an array of {kinds} of shape {shape}, as grid and height say"
                raise InputError(f"surface.{name}", value=shown, rule=rule)

    def __repr__(self) -> str:
        return summary(self)

    @classmethod
    def at_rest(cls, grid: PadGrid) -> GelSurface:
        """One untouched pad (B = 1)."""
        height = grid.rest[None].astype(np.float32)
        return cls(grid, height, np.zeros(height.shape, bool), np.full((1, 2), np.nan))

    @property
    def batch(self) -> int:
        return self.height.shape[0]

    @property
    def indentation(self) -> np.ndarray:
        """Indentation depth rest − height [m], shape (B, Ny, Nx); negative where the gel bulges outwards."""
        return self.grid.rest[None] - self.height
