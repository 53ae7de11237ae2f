"""Result of a sensor: one record of arrays. An output is present only if it was asked for."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any

import numpy as np

from raytac.checks import check_whole
from raytac.errors import BackendError, InputError
from raytac.gel.surface import GelSurface, summary

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from raytac.markers import MarkerFrame

__all__ = ["IMAGES", "OUTPUTS", "MissingOutputError", "TactileFrame"]

OUTPUTS = ("rgb", "layers", "normals", "depth", "height", "wrench", "traction")
"""Names that ``TactileSensor(outputs=…)`` and ``raytac press --outputs`` accept."""
IMAGES = ("rgb", "layers", "normals", "position", "depth", "contact", "uncovered")
"""Fields of a frame that an optical mode makes."""


class MissingOutputError(InputError, AttributeError):
    """A field of a frame that was not asked for, or cannot be; the message says how to ask."""


_ASK = {
    "markers": "was not asked for: give the sensor a marker model, as in markers='fots'",
    "position": "comes with the normals, which were not asked for: outputs=('normals', …)",
    "contact": "comes with normals or depth, which were not asked for: outputs=('normals', …)",
    "uncovered": "is of optics='taxim' alone, where an image is asked for and the table tells its coverage",
    "contact_area": "comes with wrench or traction, which were not asked for: outputs=('wrench', …)",
    "contact_cells": "is of soft pads, and comes with wrench or traction: physics='ipc', outputs=('wrench', …)",
    "force": "is not known: the frame was made from a bare surface, and not by a pad",
    "force_law_area": "is of the rigid pad's presses alone: physics='rigid'",
    "unconverged": "is of soft pads alone: physics='ipc'",
}
"""Advice on asking for an array that ``outputs=`` does not list by its own name."""
_WAITING = RLock()
"""Held while images are waited for, so that two readers of a frame do not both render."""


@dataclass(frozen=True, repr=False, eq=False, init=False)
class TactileFrame:
    """Images, forces and markers of B sensors at one instant.

    All images are (B, H, W, …) at the rendered resolution, row 0 at the top (pad-frame −y).

    ``surface``, ``failed``, ``time_ms`` and ``label`` are always there, and ``force`` too unless the frame was made from a bare surface.
    What ``OUTPUTS`` names is there if the sensor was asked for it, so ``wrench``, which holds the same force with its torque; markers if
    the sensor has a marker model. ``outputs`` names all that is there. What is not raises ``MissingOutputError``, which says how to ask
    for it.

    Images may still be computed when the frame is there: the first that is read waits for all, and copies them to the host.
    """

    surface: GelSurface
    rgb: np.ndarray
    """8-bit image after the camera response, shape (B, H, W, 3), uint8."""
    layers: dict[str, np.ndarray]
    """Linear radiance by light layer, each (B, H, W, 3), float32; the sum is the image."""
    normals: np.ndarray
    """Unit normal of the coat towards the camera (n_z < 0), pad frame, (B, H, W, 3), float32."""
    position: np.ndarray
    """Seen point of the coat, pad frame [m], (B, H, W, 3), float32 (comes with ``normals``)."""
    depth: np.ndarray
    """Camera-axis depth z − z_camera [m], shape (B, H, W), float32 (not distance along the ray)."""
    height: np.ndarray
    """Surface height on the pad grid [m], shape (B, Ny, Nx), float32."""
    contact: np.ndarray
    """Contact mask seen by the camera, (B, H, W), bool (comes with ``normals`` or ``depth``)."""
    uncovered: np.ndarray
    """Share of the contact's pixels whose bin of the Taxim table no sample reached, (B,).

    NaN without contact; of the mode ``taxim`` alone, where the table tells its coverage."""
    markers: MarkerFrame
    """Positions of the markers, in metres and pixels; present if the sensor has a marker model."""
    wrench: np.ndarray
    """Force on the pad [N] and torque about the pad frame's origin [N m], pad frame, (B, 6)."""
    traction: np.ndarray
    """Force on the pad per area [Pa], (B, Ny, Nx, 3), float32: x, y shear, −z pressure.

    Pad frame, on the pad grid. Of a soft pad at the place that the coat has at rest; of the rigid pad its force shared out over the
    contact (a model). Its sum over the nodes, each times its area (``raytac.gel.traction.cell_areas``: half a cell at the pad's edge), is
    the wrench's force."""
    contact_area: np.ndarray
    """Area of ``surface.contact`` [m²], shape (B,) (comes with ``wrench`` or ``traction``)."""
    contact_cells: np.ndarray
    """Width of the narrowest patch of contact in cells of a soft pad, (B,); NaN without contact.

    With fewer than 6 the force at a given depth is too large. Comes with ``wrench`` or ``traction``."""
    force: np.ndarray
    """Force of the object on the pad, pad frame [N], shape (B, 3); not of a bare surface."""
    force_law_area: np.ndarray
    """Area in the load law of a rigid press [m²], (B,); not that of ``surface.contact``."""
    failed: np.ndarray
    """Environments whose physics broke down, shape (B,), bool; their arrays hold nothing of use."""
    unconverged: np.ndarray
    """Steps of a soft pad's solver that missed its tolerance since press or reset, (B,), int.

    An environment whose last step is one of them has ``failed``."""
    time_ms: dict[str, float]
    """Wall time of ``physics``, ``surface``, ``markers``, ``optics`` for the batch [ms].

    ``optics`` is the time to launch the images and, once one was read, the wait for them; the dictionary is another one then."""

    label: str
    """Physics and optics that it came from, as ``TactileSensor.label``; empty if unknown."""

    def __init__(self, surface: GelSurface, *, images: Callable[[], Mapping[str, Any]] | None = None, **values: Any) -> None:
        """``values``: further fields, None as not given; ``images`` waits for those of ``IMAGES``."""
        known = [f.name for f in fields(type(self))]
        for name in values:
            if name not in known:
                raise InputError("values", value=name, rule="must be a field of a frame", choices=known)
        always: dict[str, Any] = {"failed": np.zeros(surface.batch, bool), "time_ms": {}, "label": ""}
        given = {name: value for name, value in values.items() if value is not None}
        self.__dict__.update({"surface": surface, **always, **given})
        if images is not None:
            self.__dict__["_images"] = images

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of all fields that are there."""
        self._wait()
        return tuple(f.name for f in fields(self) if f.name in self.__dict__)

    def with_values(self, **values: Any) -> TactileFrame:
        """The same with other values of some fields; None leaves one out."""
        if values.keys() & IMAGES:
            self._wait()
        own = {"images" if name == "_images" else name: value for name, value in self.__dict__.copy().items()}
        return TactileFrame(**{**own, **values})

    def _wait(self) -> None:
        """Wait for the images, if nobody has."""
        if "_images" not in self.__dict__:
            return
        with _WAITING:
            images = self.__dict__.get("_images")
            if images is None:  # another thread has waited
                return
            began = time.perf_counter()
            given = {name: value for name, value in images().items() if value is not None}
            waited = 1e3 * (time.perf_counter() - began)
            self.__dict__.update(given, time_ms={**self.time_ms, "optics": self.time_ms.get("optics", 0.0) + waited})
            self.__dict__.pop("_images", None)

    def __getstate__(self) -> dict[str, Any]:
        self._wait()
        return self.__dict__.copy()

    if not TYPE_CHECKING:  # a type checker knows the fields, and so finds names that do not exist

        def __getattr__(self, name: str) -> Any:
            if name not in type(self).__dataclass_fields__:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            if name in IMAGES:
                self._wait()
                if name in self.__dict__:  # another thread may have waited since the lookup that failed
                    return self.__dict__[name]
            raise MissingOutputError(f"frame.{name}", rule=_ASK.get(name, f'was not asked for: outputs=("{name}", …)'))

    def __repr__(self) -> str:
        return summary(self, self.outputs)

    def show(self, env: int = 0) -> Figure:
        """Draw one environment: image with markers, indentation, normals, depth, pressure.

        What is not there is left out. In a notebook the figure appears where the call is a cell's last line; with a windowing backend of
        matplotlib a window opens, and the call returns when it is closed.

        Raises:
            InputError: an environment that does not exist.
            BackendError: matplotlib is not installed.
        """
        env = check_whole("env", env, 0, self.surface.batch - 1)
        try:
            from matplotlib import pyplot
        except ImportError as error:
            raise BackendError(f"show() needs matplotlib ({error}): `pip install matplotlib`; save() works without") from error
        panels = self._panels(env)
        figure, places = pyplot.subplots(1, len(panels), figsize=(3.4 * len(panels), 3.2), layout="constrained", squeeze=False)
        for axes, (caption, image, settings) in zip(places[0], panels, strict=True):
            drawn = axes.imshow(image, **settings)
            axes.set_title(caption, fontsize=9)
            axes.tick_params(labelsize=7)
            axes.set_xlabel("x [mm]" if "extent" in settings else "x [px]", fontsize=7)
            axes.set_ylabel("y [mm]" if "extent" in settings else "y [px]", fontsize=7)
            if image.ndim == 2:
                figure.colorbar(drawn, ax=axes, shrink=0.8).ax.tick_params(labelsize=7)
            if caption == "image" and "markers" in self.outputs:
                (u, v), (du, dv) = self.markers.rest_px[env].T, self.markers.displacement_px[env].T
                axes.quiver(u, v, du, dv, color="white", angles="xy", scale_units="xy", scale=0.2, width=0.006)
                axes.set_title("image; arrows: markers × 5", fontsize=9)
        figure.suptitle(self._title(env), fontsize=9)
        if pyplot.get_backend().lower() in {"qtagg", "tkagg", "gtk3agg", "gtk4agg", "wxagg", "macosx", "qt5agg"}:
            pyplot.show()
        pyplot.close(figure)  # a notebook would show it twice
        return figure

    def save(self, path: str | Path, env: int = 0) -> list[Path]:
        """Write the frame, and return the files written.

        ``NAME.png`` is the image of environment ``env``. ``NAME.npz`` has every array of all environments under its name, layers and
        markers as ``layers.red`` and ``markers.displacement``, with the surface's ``height``, ``contact``, ``grid_x`` and ``grid_y``. A
        path without suffix is a folder with ``frame.npz`` and one image an environment.

        Raises ``InputError``: another suffix, a PNG without image, or a folder that cannot be written.
        """
        from raytac.io.arrays import npz_bytes
        from raytac.io.folder import result_folder
        from raytac.io.images import png_bytes

        path, many = Path(path), self.surface.batch > 1
        if path.suffix == ".png":
            files = {path.name: png_bytes(self.rgb[check_whole("env", env, 0, self.surface.batch - 1)])}
        elif path.suffix == ".npz":
            files = {path.name: npz_bytes(self._arrays())}
        elif path.suffix:
            raise InputError("path", value=path, rule="must end in .png or .npz, or be a folder without a suffix")
        else:
            files = {"frame.npz": npz_bytes(self._arrays())}
            for k, image in enumerate(self.rgb if "rgb" in self.outputs else ()):
                files[f"rgb_{k:03d}.png" if many else "rgb.png"] = png_bytes(image)
        out = path.parent if path.suffix else path
        with result_folder(out) as folder:
            for name, data in files.items():
                (folder / name).write_bytes(data)
        return [out / name for name in files]

    def _arrays(self) -> dict[str, np.ndarray]:
        """Every array that is there, by a dotted name."""
        grid = self.surface.grid
        arrays = {"grid_x": grid.x, "grid_y": grid.y, "height": self.surface.height, "contact_on_grid": self.surface.contact}
        for name in self.outputs:
            value = getattr(self, name)
            if isinstance(value, np.ndarray):
                arrays[name] = value
            elif name == "layers":
                arrays |= {f"layers.{layer}": image for layer, image in value.items()}
            elif name == "markers":
                arrays |= {f"markers.{f.name}": getattr(value, f.name) for f in fields(value)}
        return arrays

    def _title(self, env: int) -> str:
        """Label, environment and force, as far as they are known."""
        texts = [self.label, f"environment {env} of {self.surface.batch}"] if self.surface.batch > 1 else [self.label]
        if "force" in self.outputs:
            texts.append("force {:.2f}, {:.2f}, {:.2f} N".format(*self.force[env]))
        return " · ".join(text for text in (*texts, "failed" if self.failed[env] else "") if text)

    def _panels(self, env: int) -> list[tuple[str, np.ndarray, dict[str, Any]]]:
        """Caption, array (H, W) or (H, W, 3), and settings of ``imshow`` of each picture."""
        surface, grid = self.surface, self.surface.grid
        extent = [1e3 * value for value in (grid.x[0], grid.x[-1], grid.y[-1], grid.y[0])]
        panels: list[tuple[str, np.ndarray, dict[str, Any]]] = []
        if "rgb" in self.outputs:
            panels.append(("image", self.rgb[env], {}))
        panels.append(("indentation [mm]", 1e3 * surface.indentation[env], {"extent": extent, "cmap": "viridis"}))
        if "normals" in self.outputs:
            towards_camera = self.normals[env] * [1.0, 1.0, -1.0]  # so that flat gel is blue, as normal maps have it
            panels.append(("normals", np.clip(0.5 + 0.5 * towards_camera, 0.0, 1.0), {}))
        if "depth" in self.outputs:
            panels.append(("depth [mm]", 1e3 * self.depth[env], {"cmap": "viridis"}))
        if "traction" in self.outputs:
            panels.append(("pressure [kPa]", -1e-3 * self.traction[env, ..., 2], {"extent": extent, "cmap": "magma"}))
        return panels

    def _repr_html_(self) -> str:
        """Card for notebooks: forces, outputs, and the pictures of the first environments."""
        from raytac.io.html import card, coloured, picture

        batch, shown = self.surface.batch, min(self.surface.batch, 4)
        rows = {"outputs": ", ".join(name for name in self.outputs if name not in ("surface", "failed", "time_ms", "label"))}
        rows["indentation"] = f"up to {_range(1e3 * self.surface.indentation)[1]:.2f} mm"
        if self.failed.any():
            rows["failed"] = f"{int(self.failed.sum())} of {batch} environments"
        if "force" in self.outputs:
            rows["force"] = "; ".join("{:.2f}, {:.2f}, {:.2f} N".format(*force) for force in self.force[:shown])
            rows["force"] += "; …" if batch > shown else ""
        pictures = ""
        for env in range(shown):
            for caption, image, _ in self._panels(env)[: 2 if batch > 1 else None]:
                if image.ndim == 2:
                    low, high = _range(image)
                    caption, image = f"{caption}: {low:.4g} to {high:.4g}", coloured(image, low, high)
                elif image.dtype != np.uint8:
                    image = np.round(255.0 * image).astype(np.uint8)
                pictures += picture(image, caption if batch == 1 else f"{env}: {caption}")
        title = f"TactileFrame · {self.label}" if self.label else "TactileFrame"
        return card(title + (f" · {batch} environments" if batch > 1 else ""), rows, pictures)


def _range(values: np.ndarray) -> tuple[float, float]:
    """Least and greatest number that is finite, to 0.001; 0 and 0 without one."""
    finite = values[np.isfinite(values)]
    return (0.0, 0.0) if not len(finite) else (round(float(finite.min()), 3) + 0.0, round(float(finite.max()), 3) + 0.0)
