"""The deformed gel surface, which physics passes to optics, markers and force outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from raytac.checks import check_kind, check_number
from raytac.errors import InputError
from raytac.gel.coat_mesh import DeformedCoat
from raytac.gel.gaussian import CONTACT_SCALE
from raytac.gel.interpolate import sampled
from raytac.specs.sensor import GelpadSpec


def summary(record: Any, names: Sequence[str] | None = None) -> str:
    """One line on a dataclass: its fields ``names`` (None: all) but empty ones, arrays by shape."""
    shown = []
    for name in [f.name for f in fields(record)] if names is None else names:
        value = getattr(record, name)
        if isinstance(value, dict):
            value = {key: _brief(v) for key, v in value.items()}
            text = "{" + ", ".join(f"{key}: {v}" for key, v in value.items()) + "}" if value else ""
        else:
            text = "" if value is None else _brief(value)
        if text:
            shown.append(f"{name}={text}")
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

    Raises ``InputError`` for arrays of another kind or shape; heights of environments that failed may be NaN.
    """

    grid: PadGrid
    height: np.ndarray
    """z in the pad frame [m], (B, Ny, Nx), float32."""
    contact: np.ndarray
    """True where the object touches, (B, Ny, Nx), bool."""
    contact_centre: np.ndarray
    """x, y of the contact's centre [m], (B, 2); NaN without contact.

    It is weighted by the overlap under a rigid pad, by the normal load under a soft one."""
    pad_from_object: np.ndarray | None = None
    """Pose of the object, (B, 4, 4); None without an object."""
    coat: DeformedCoat | None = None
    """The same surface as a mesh that moves sideways too, of a soft pad; else None."""
    ink: np.ndarray | None = None
    """Share in [0, 1] of the coat that marker dots cover, (B, Ny, Nx), float32, or None."""

    def __post_init__(self) -> None:
        expected = (len(self.height) if isinstance(self.height, np.ndarray) and self.height.ndim else 0, *self.grid.shape)
        shapes = {"height": ("f", expected), "contact": ("b", expected), "contact_centre": ("f", (expected[0], 2))}
        if self.pad_from_object is not None:
            shapes["pad_from_object"] = ("f", (expected[0], 4, 4))
        for name, (kind, shape) in shapes.items():
            array = getattr(self, name)
            if not isinstance(array, np.ndarray) or array.dtype.kind != kind or array.shape != shape:
                given = (str(array.dtype), array.shape) if isinstance(array, np.ndarray) else type(array).__name__
                numbers = {"f": "floating-point numbers", "b": "truth values"}[kind]
                rule = f"must be an array of {numbers} of shape {shape}, as grid and height say"
                raise InputError(f"surface.{name}", value=given, rule=rule)

    def __repr__(self) -> str:
        return summary(self)

    @classmethod
    def at_rest(cls, grid: PadGrid) -> GelSurface:
        """One untouched pad (B = 1)."""
        height = grid.rest[None].astype(np.float32)
        return cls(grid, height, np.zeros(height.shape, bool), np.full((1, 2), np.nan))

    @classmethod
    def displaced(cls, grid: PadGrid, displacement: np.ndarray, contact: np.ndarray | None = None) -> GelSurface:
        """Surfaces moved by ``displacement`` [m], (B, Ny, Nx), along z; <= 0 is pressed in.

        ``contact`` (B, Ny, Nx), bool; None takes Taxim's rule, the nodes pressed in by more than 0.4 of the deepest.
        """
        indentation = np.maximum(-displacement, 0.0)
        is_deep = indentation > CONTACT_SCALE * indentation.max(axis=(1, 2), keepdims=True)
        touched = is_deep if contact is None else contact
        weight = np.where(touched, indentation, 0.0)
        total = weight.sum(axis=(1, 2))
        moments = np.stack([weight.sum(axis=1) @ grid.x, weight.sum(axis=2) @ grid.y], axis=1)
        centre = np.divide(moments, total[:, None], out=np.full((len(total), 2), np.nan), where=total[:, None] > 0.0)
        return cls(grid, (grid.rest + displacement).astype(np.float32), touched, centre)

    @property
    def batch(self) -> int:
        return self.height.shape[0]

    def rows(self, envs: Sequence[int] | np.ndarray) -> GelSurface:
        """The surfaces of some environments, one row each."""
        pose, coat, ink = self.pad_from_object, self.coat, self.ink
        return GelSurface(
            self.grid,
            self.height[envs],
            self.contact[envs],
            self.contact_centre[envs],
            None if pose is None else pose[envs],
            None if coat is None else replace(coat, positions=coat.positions[envs]),
            None if ink is None else ink[envs],
        )

    @property
    def is_finite(self) -> np.ndarray:
        """Environments all of whose heights are finite, (B,), bool."""
        # One NaN or infinity makes the sum of squares one, and no height is so large that it does: many times cheaper than asking
        # every node.
        heights = self.height.reshape(self.batch, -1).astype(np.float32, copy=False)
        return np.isfinite(np.vecdot(heights, heights))

    @property
    def indentation(self) -> np.ndarray:
        """Depth rest − height [m], (B, Ny, Nx); negative where the gel bulges outwards."""
        return self.grid.rest[None] - self.height


def on_grid(grid: PadGrid, values: np.ndarray, pitch: tuple[float, float]) -> np.ndarray:
    """Maps (B, rows, columns) as the camera sees them, at the nodes of a grid (B, Ny, Nx).

    The middle of a map is over the pad's centre, its columns and rows are ``pitch`` (x, y) [m] apart. Between them it is bilinear; beyond
    the edges the value at the edge is taken.
    """
    y, x = (step * (np.arange(n) - 0.5 * (n - 1)) for n, step in zip(values.shape[1:], pitch[::-1], strict=True))
    at_x, at_y = (nodes.ravel() for nodes in np.meshgrid(grid.x, grid.y))
    return sampled(values, x, y, at_x, at_y).reshape(len(values), *grid.shape)


def rounded_envs(envs: list[int], batch: int) -> list[int]:
    """``envs`` padded with its last entry to a power of two: kernels are recorded by row count."""
    count = min(1 << max(len(envs) - 1, 0).bit_length(), batch)
    return [*envs, *envs[-1:] * (count - len(envs))]


def chosen_envs(envs: ArrayLike | None, batch: int) -> list[int]:
    """Environment numbers of a mask (B,) or a list, in its order; None names all.

    Raises ``InputError``: an environment that does not exist, numbers that are not whole, or a mask of the wrong length.
    """
    if envs is None:
        return list(range(batch))
    try:
        chosen = np.asarray(envs)
    except ValueError as error:  # lists of several lengths
        raise InputError("envs", value=envs, rule=f"must name environments 0 to {batch - 1}") from error
    if chosen.dtype == bool:
        if chosen.shape != (batch,):
            raise InputError("envs", value=chosen.shape, rule=f"a mask must have shape ({batch},)")
        return np.flatnonzero(chosen).tolist()
    if chosen.size == 0:
        return []
    if not np.issubdtype(chosen.dtype, np.integer) or chosen.min() < 0 or chosen.max() >= batch:
        raise InputError("envs", value=chosen.tolist(), rule=f"must name environments 0 to {batch - 1}")
    return chosen.ravel().tolist()


COARSEST_PITCH = 0.1e-3
"""Spacing of the pad's grid where the image does not ask for a finer one [m]."""
MOST_CELLS = 8192
"""Most cells of the pad's grid along an axis: the most pixels of an image."""
_SAME = 1e-6
"""Tolerance of a grid's edges and rest heights [m]."""


def grid_pitch(pixel: tuple[float, float]) -> float:
    """Node spacing [m] for an image whose pixels cover ``pixel`` (x, y) [m] of the pad."""
    return min(COARSEST_PITCH, *pixel)


def rest_height(gelpad: GelpadSpec, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Rest surface z [m] at pad-frame positions ``x``, ``y`` [m] of any shapes that broadcast.

    z = −``gelpad.sag(x, y)``: 0 at the pad centre, an exact circle along both axes, the paraboloid −x²/(2Rx) − y²/(2Ry) to fourth
    order, flat along an axis whose radius is ``inf``.
    """
    return -gelpad.sag(np.asarray(x, float), np.asarray(y, float))


def check_grid(gelpad: GelpadSpec, grid: PadGrid) -> None:
    """Raise ``InputError`` unless ``grid`` spans this gelpad and rests on its dome."""
    ends = [float(nodes[k]) for nodes in (grid.x, grid.y) for k in (0, -1)]
    expected = [sign * 0.5 * size for size in gelpad.size for sign in (-1.0, 1.0)]
    if not np.allclose(ends, expected, rtol=0.0, atol=_SAME):
        rule = f"must be a grid of this sensor's pad, x and y from {expected} m"
        raise InputError("surface.grid", value=ends, rule=rule)
    error = float(np.abs(grid.rest - rest_height(gelpad, grid.x[None, :], grid.y[:, None])).max())
    if not error <= _SAME:
        raise InputError("surface.grid", value=error, rule="must rest on this sensor's dome; its nodes are so far off it [m]")


def make_grid(gelpad: GelpadSpec, pitch: float) -> PadGrid:
    """Grid of nodes over the whole pad.

    ``pitch`` [m] is the wanted spacing; along each axis it is adjusted to size / round(size / pitch), so that nodes fall on both
    edges. Raises ``InputError`` if the pitch is not positive and finite, or leaves fewer than two cells along an axis or more than
    ``MOST_CELLS``.
    """
    check_kind("gelpad", gelpad, GelpadSpec)
    check_number("pitch", pitch, "(0, inf)", "m")
    for axis, size in zip("xy", gelpad.size, strict=True):
        if not 1.5 <= size / pitch <= MOST_CELLS:
            rule = f"in metres, must divide the pad's {size:g} m along {axis} into 2 to {MOST_CELLS} cells"
            raise InputError("pitch", value=pitch, rule=rule)
    x, y = (np.linspace(-0.5 * size, 0.5 * size, round(size / pitch) + 1) for size in gelpad.size)
    return PadGrid(x=x, y=y, rest=rest_height(gelpad, x[None, :], y[:, None]))
