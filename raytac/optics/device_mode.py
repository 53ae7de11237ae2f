"""``DeviceMode``: Dr.Jit code that optical modes share, recorded once a batch size."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from weakref import ref

import drjit as dr
import numpy as np

from raytac.checks import check_names
from raytac.device import total_memory
from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid, rounded_envs
from raytac.optics.base import OpticalMode, OpticsConfig, OpticsImages
from raytac.optics.camera import Pinhole
from raytac.optics.geometry import CoatField, CoatLayout, check_view, concave_cover, see, seen_images
from raytac.optics.host_copy import copy_of
from raytac.optics.ink import checked_ink
from raytac.optics.refraction import Slab
from raytac.optics.runtime import RENDERER, load_mitsuba, no_collection
from raytac.specs.sensor import SensorSpec

Float = Any  # Dr.Jit array of float32
UInt8 = Any  # Dr.Jit array of bytes

ROUNDING = 2
"""Largest size of an array over its own: Dr.Jit's allocator takes powers of two of bytes."""
_LONGEST_ARRAY = 2**32 - 1
"""Dr.Jit indexes with 32 bits."""


@dataclass(frozen=True)
class FrameInputs:
    """Device arrays besides the surface that a recorded frame reads; Dr.Jit wants them named."""

    rest: Float
    """Heights at rest [m], Ny·Nx, as ``concave_cover`` gives them."""
    own: Any
    """Further arrays of the mode."""
    ink: Float | None = None
    """Share of marker dots at the nodes, B·Ny·Nx; None without dots."""


@dataclass(frozen=True)
class DeviceFrame:
    """Images of B sensors on the device."""

    rgb: UInt8
    """B·H·W·3."""
    layers: list[Float]
    """Linear radiance, three channels a layer, each B·H·W; empty where not asked for."""
    flags: UInt8
    """Marks of every pixel (B·H·W), or one unused value."""


class DeviceMode(ABC):
    """Base of our optical modes; fulfils ``raytac.optics.base.OpticalMode``.

    A mode says how a frame is made (``_frame``), which arrays that needs (``_build``) and what memory it takes.
    """

    label: str
    needs_contact = False
    """True if a frame needs the mask of contact."""
    _smallest_side = 1
    """Least width and height of an image [px]."""
    _longest_row = 3
    """Values a pixel of the longest array."""

    def __init__(
        self,
        sensor: SensorSpec,
        config: OpticsConfig[OpticalMode],
        *,
        resolution: tuple[int, int] | None = None,
        outputs: tuple[str, ...] = ("rgb",),
        device: str = "auto",
        seed: int = 0,
    ) -> None:
        """Build what is independent of the grid; arguments and errors as of ``OpticsConfig.build``."""
        outputs = check_names("outputs", outputs, config.outputs)
        least = self._smallest_side
        if resolution is not None and (len(resolution) != 2 or min(resolution) < least):
            rule = f"must be (width, height), each >= {least} pixel{'s' * (least > 1)}"
            raise InputError("resolution", value=resolution, rule=rule)
        self.mi, self.device = load_mitsuba(device)
        self.sensor, self.config, self.outputs, self.seed = sensor, config, tuple(outputs), seed
        self.label = config.label
        self.slab = Slab.from_spec(sensor)
        self.camera = Pinhole.from_spec(sensor.camera, resolution, self.slab)
        self._memory = total_memory(self.device)
        self._known_to_fit = 0
        """Environments of a batch that is known to fit into memory."""
        self._grid: PadGrid | None = None
        # One recording a batch size: a recording would replay at another size by scaling its launches, which is not what B means.
        self._frozen: dict[tuple[str, bool, int], Callable[..., Any]] = {}
        self._at_rest: dict[bool, OpticsImages] = {}
        """Images of one untouched pad without and with dots, which every environment at rest shows."""
        self._rest_ink: np.ndarray | None = None
        """Dots (Ny, Nx) of that pad."""
        self._is_running = False
        """True if nobody has waited for the images that were begun last."""
        self._last: Callable[[], _Launched | None] = lambda: None
        """Weak reference to these images: whoever asked for them may have dropped them."""
        self._set_up()

    def _set_up(self) -> None:  # noqa: B027 (a mode may need nothing more)
        """Last part of the constructor: what else a mode needs, and checks of its configuration."""

    def crop(self, piece: tuple[int, int, int, int]) -> bool:
        """Render only (left, top, width, height) [px] from now on; False if all is computed anyway.

        What is rendered equals the same piece of the whole image. Called before the first frame.
        """
        if self._crops:
            self.camera = replace(self.camera, crop=piece)
        return self._crops

    @property
    def _crops(self) -> bool:
        """True if a piece of the image takes less than all of it."""
        return False

    @abstractmethod
    def _build(self, grid: PadGrid) -> Any:
        """Device arrays that a frame reads besides the surface; called once, for the first grid."""

    def _frame(self, heights: Float, contact: UInt8 | None, inputs: FrameInputs) -> tuple[UInt8, list[Float], UInt8]:
        """Fields of ``DeviceFrame``, from heights (B·Ny·Nx) [m]."""
        raise NotImplementedError

    def _other_images(self, frame: DeviceFrame, failed: np.ndarray) -> dict[str, Any]:
        """Fields of ``OpticsImages`` besides ``rgb`` that show light; ``failed`` (B,) is a mask."""
        return {}

    def _bytes_per_env(self, grid: PadGrid) -> int:
        """Most device memory that an environment's image takes [byte], before Dr.Jit's rounding."""
        return 0

    def prepare(self, grid: PadGrid) -> None:
        """Build what depends on the pad's grid; done at the first frame and kept.

        Raises ``InputError``: the camera sees beyond the pad, or a second grid.
        """
        if self._grid is not None:
            names = "x", "y", "rest"
            if grid is not self._grid and not all(np.array_equal(getattr(grid, k), getattr(self._grid, k)) for k in names):
                rule = f"one optical mode renders one grid and rest surface, the first that it was given, {self._grid.shape} here"
                raise InputError("surface.grid", value=grid.shape, rule=rule)
            self._grid = grid  # an equal one of another pad: known at sight from now on
            return
        check_view(self.camera, grid)
        self.layout = CoatLayout.from_grid(grid)
        # A copy: an array on NumPy memory that a surface shares would be one input twice for a recording.
        self._rest = self.mi.Float(concave_cover(grid).astype(np.float32).ravel())
        self._inputs = FrameInputs(self._rest, self._build(grid))
        self._grid, self._rest_heights = grid, grid.rest.astype(np.float32)

    def memory_per_env(self, grid: PadGrid) -> int:
        """Most device memory that an environment of a batch on ``grid`` takes [byte]."""
        width, height = self.camera.size
        seen = 0
        if {"normals", "depth"} & set(self.outputs):
            seen = 8 * grid.rest.size + CoatField.memory_per_env(CoatLayout.from_grid(grid)) + 24 * width * height
        return ROUNDING * max(seen, self._bytes_per_env(grid))

    def largest_batch(self, grid: PadGrid) -> int:
        """Most environments of one call on ``grid``; a path tracer's images are made one by one."""
        width, height = self.camera.size
        longest = max(4 * grid.rest.size, self._longest_row * width * height)
        return min(self._memory // max(self.memory_per_env(grid), 1), _LONGEST_ARRAY // longest)

    def _check_batch(self, envs: int, grid: PadGrid) -> None:
        """Raise InputError for a batch that would not fit, before Dr.Jit ends the process over it."""
        if grid is self._grid and envs <= self._known_to_fit:
            return
        each, most = self.memory_per_env(grid), self.largest_batch(grid)
        if each and envs > most:
            rule = f"must be at most {most}: an environment takes {each / 1e6:.1f} MB, this {self.device} has "
            rule += f"{self._memory / 1e9:.1f} GB and an array at most 2^32 values; render in parts"
            raise InputError("number of environments", value=envs, rule=rule)
        if grid is self._grid:
            self._known_to_fit = envs

    @property
    def _lit(self) -> bool:
        """True if any output needs light."""
        return bool({"rgb", "layers"} & set(self.outputs))

    def render(self, surface: GelSurface) -> OpticsImages:
        """Render every environment of ``surface``; see ``OpticsImages`` for the shapes.

        Untouched pads are not rendered again: they show the image at rest, which is rendered once. An environment whose heights are not
        finite fails alone: its ``rgb`` is 0, its other images are NaN, its contact is False.

        Raises ``InputError``: a surface whose arrays do not have the shape of its grid, an empty batch, one too large, or a second grid.
        """
        return self.start(surface)()

    def start(self, surface: GelSurface) -> Callable[[], OpticsImages]:
        """Begin ``render``; returns a function that waits for the images and copies them back.

        Dr.Jit computes them beside what the caller does next. At most one call is under way: the next one waits for it, and copies its
        images back if they may still be asked for. Only the thread that launched a kernel can wait for it: in another thread the function
        renders again. The images are those of ``surface`` at the call. Raises the same as ``render``.
        """
        with RENDERER:
            self._finish()
            # Copies: on the CPU Dr.Jit reads NumPy memory in place, when the kernel runs.
            ink = None if (checked := checked_ink(surface)) is None else copy_of(checked)
            surface = replace(surface, height=copy_of(surface.height), contact=copy_of(surface.contact), ink=ink)
            heights, failed = self._checked(surface)
            pressed = self._pressed(surface, heights, failed)
            whole, dotted = len(pressed) == surface.batch, ink is not None
            if not whole and dotted not in self._at_rest:
                rest = GelSurface.at_rest(surface.grid)
                if dotted:
                    assert self._rest_ink is not None
                    rest = replace(rest, ink=self._rest_ink[None])
                self._at_rest[dotted] = self._begun(rest, rest.height, np.zeros(1, bool))()
            begun = None
            if pressed:
                rows = (surface, heights, failed) if whole else (surface.rows(pressed), heights[pressed], failed[pressed])
                begun = self._begun(*rows)

        def images() -> OpticsImages:
            rendered = None if begun is None else begun()
            if whole and rendered is not None:
                return rendered
            return self._at_rest[dotted].repeated(surface.batch, pressed, rendered)

        result = _Launched(images, partial(self.render, surface))
        self._last, self._is_running = ref(result), begun is not None
        return result

    def _finish(self) -> None:
        """Wait for the images under way; copy them back if anybody may ask for them."""
        last, running, self._is_running = self._last(), self._is_running, False
        if running and (last is None or not last.keep()):
            dr.sync_thread()

    def _pressed(self, surface: GelSurface, heights: np.ndarray, failed: np.ndarray) -> list[int]:
        """Numbers of the environments to render, padded to a power of two, or all.

        The others show the image at rest: their gel is untouched, and their dots are where the first pad at rest had them.
        """
        rest = self._rest_heights
        differ = failed | surface.contact.any(axis=(1, 2))
        untouched = np.flatnonzero(~differ)
        differ[untouched] = (heights[untouched] != rest).any(axis=(1, 2))
        if surface.ink is not None and not differ.all():
            if self._rest_ink is None:
                self._rest_ink = surface.ink[int(np.argmin(differ))].copy()
            differ |= (surface.ink != self._rest_ink).any(axis=(1, 2))
        pressed = np.flatnonzero(differ).tolist()
        rounded = rounded_envs(pressed, surface.batch) if pressed else []
        return rounded if len(rounded) < surface.batch else list(range(surface.batch))

    def _begun(self, surface: GelSurface, heights: np.ndarray, failed: np.ndarray) -> Callable[[], OpticsImages]:
        """Launch the images of heights (B, Ny, Nx) safe to trace; returns a function that waits."""
        lit = seen = None
        if self._lit:
            lit = self.render_device(self._upload(heights), self._upload_contact(surface, failed), self._upload_ink(surface.ink))
        if {"normals", "depth"} & set(self.outputs):
            seen = self._recorded(self._seen, self._upload(heights), None, None)
        return partial(self._images, surface, failed, lit, seen)

    def render_device(self, heights: Float, contact: UInt8 | None = None, ink: Float | None = None) -> DeviceFrame:
        """Images on the device, of device arrays; recorded once a batch size, then replayed.

        Args:
            heights: of the coat [m], B·Ny·Nx; must be finite, which is not checked here.
            contact: where the object touches, B·Ny·Nx bytes; only for modes with ``needs_contact``.
            ink: share of marker dots at each node, B·Ny·Nx, in [0, 1].

        Raises:
            InputError: no call of ``prepare`` before, no whole number of grids, contact or ink of another width, too large a batch, or a
                mode with noise.
        """
        if self._grid is None:
            raise InputError("heights", value=type(heights).__name__, rule="call prepare(grid) first: it tells the grid")
        others = ({"contact": contact} if self.needs_contact else {}) | ({} if ink is None else {"ink": ink})
        self._check_batch(device_envs(self.layout.nx * self.layout.ny, heights, **others), self._grid)
        with RENDERER:
            return self._made(heights, contact if self.needs_contact else None, ink)

    def _made(self, heights: Float, contact: UInt8 | None, ink: Float | None) -> DeviceFrame:
        """Images of checked arrays; a mode that is not Dr.Jit code alone makes them by itself."""
        return DeviceFrame(*self._recorded(self._frame, heights, contact, ink))

    def _images(
        self, surface: GelSurface, failed: np.ndarray, lit: DeviceFrame | dict[str, Any] | None, seen: tuple[Any, Any] | None
    ) -> OpticsImages:
        """Images on the host, with the failed environments marked.

        ``lit``: of light, on the device or on the host; ``seen``: point and normal through every pixel. None is not asked for.
        """
        images: dict[str, Any] = lit if isinstance(lit, dict) else {}
        if isinstance(lit, DeviceFrame):
            if "rgb" in self.outputs:
                images["rgb"] = np.array(lit.rgb).reshape(*self._shape(len(failed)), 3)
            images |= self._other_images(lit, failed)
        if seen is not None:
            images |= seen_images(*seen, surface, self.camera, self.outputs)
        if failed.any():
            layers = images.get("layers") or {}
            for image in (*(one for one in images.values() if isinstance(one, np.ndarray)), *layers.values()):
                image[failed] = np.nan if image.dtype.kind == "f" else 0
        return OpticsImages(**images)

    def _recorded(self, function: Callable[..., Any], heights: Float, contact: UInt8 | None, ink: Float | None) -> Any:
        """Call ``function(heights, contact, inputs)``, recorded once for each size of ``heights``."""
        key = function.__name__, ink is not None, dr.width(heights)
        if key not in self._frozen:
            self._frozen[key] = dr.freeze(function)
        with no_collection():
            return self._frozen[key](heights, contact, self._inputs if ink is None else replace(self._inputs, ink=ink))

    def _seen(self, heights: Float, contact: None, inputs: FrameInputs) -> tuple[Any, Any]:
        """Point and normal of the coat through every pixel's centre."""
        field = CoatField(self.mi, self.layout, inputs.rest, heights)
        seen = see(self.mi, field, self.camera, dr.width(heights) // (self.layout.nx * self.layout.ny))
        return seen.p, seen.n

    def _shape(self, envs: int) -> tuple[int, int, int]:
        """(B, H, W)."""
        width, height = self.camera.size
        return envs, height, width

    def _check_image(self, name: str, image: object, *, floats: bool = False) -> None:
        """Raise InputError unless ``image`` is an 8-bit image at this resolution.

        With ``floats`` it may also have levels from 0 to 255 as floats.
        """
        kind = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        shape, other = (*self.camera.resolution[::-1], 3), ", or levels in [0, 255] as floats" if floats else ""
        if floats and isinstance(image, np.ndarray) and image.shape == shape and image.dtype.kind == "f":
            least, most = float(np.min(image)), float(np.max(image))
            if not (least >= 0.0 and most <= 255.0):
                raise InputError(name, value=f"{least:.4g} to {most:.4g}", rule="must have levels in [0, 255]")
        elif kind != f"uint8 {shape}":
            raise InputError(name, value=kind, rule=f"must be a uint8 image of shape {shape}{other}")

    def _checked(self, surface: GelSurface) -> tuple[np.ndarray, np.ndarray]:
        """Heights (B, Ny, Nx) float32, failed environments at rest, and which those are (B,)."""
        if surface.batch < 1:
            raise InputError("surface.height", value=surface.height.shape, rule="must have at least one environment")
        self._check_batch(surface.batch, surface.grid)
        self.prepare(surface.grid)
        heights, failed = np.ascontiguousarray(surface.height, dtype=np.float32), ~surface.is_finite
        if failed.any():  # a NaN would become an index into device memory
            heights = heights.copy()
            heights[failed] = surface.grid.rest
        return heights, failed

    def _upload(self, values: np.ndarray) -> Float:
        return self.mi.Float(np.ascontiguousarray(values, dtype=np.float32).ravel())

    def _upload_contact(self, surface: GelSurface, failed: np.ndarray) -> UInt8 | None:
        if not self.needs_contact:
            return None
        touched = surface.contact & ~failed[:, None, None] if failed.any() else surface.contact
        return self.mi.UInt8(np.ascontiguousarray(touched).view(np.uint8).ravel())

    def _upload_ink(self, checked: np.ndarray | None) -> Float | None:
        return None if checked is None else self._upload(checked)


class _Launched:
    """Images that the launching thread waits for and copies back once.

    Another thread renders them again.
    """

    def __init__(self, wait: Callable[[], OpticsImages], again: Callable[[], OpticsImages]) -> None:
        self._wait, self._again, self._caller = wait, again, threading.get_ident()
        self._images: OpticsImages | None = None

    def keep(self) -> bool:
        """Wait for the images and copy them back; False in a thread that did not launch them."""
        with RENDERER:
            if self._images is None and threading.get_ident() == self._caller:
                self._images = self._wait()
                del self._wait  # with the arrays on the device
            return self._images is not None

    def __call__(self) -> OpticsImages:
        with RENDERER:
            if not self.keep():
                self._images = self._again()
            assert self._images is not None
            return self._images


def upload(mi: Any, surface: GelSurface) -> tuple[Float, UInt8]:
    """Heights and contact of a surface on the device, each B·Ny·Nx."""
    heights = mi.Float(np.ascontiguousarray(surface.height, dtype=np.float32).ravel())
    contact = mi.UInt8(np.ascontiguousarray(surface.contact).view(np.uint8).ravel())
    dr.eval(heights, contact)
    return heights, contact


def device_envs(nodes: int, heights: Float, **others: Any) -> int:
    """B of device heights (B·``nodes``). Raises InputError unless ``others`` are as many values."""
    width = dr.width(heights)
    if width == 0 or width % nodes:
        raise InputError("heights", value=width, rule=f"must hold a whole number of grids of {nodes} nodes")
    for name, array in others.items():
        own = None if array is None else dr.width(array)
        if own != width:
            raise InputError(name, value=own, rule=f"must have one value a node, {width} here")
    return width // nodes
