"""``preview.png``: what was pressed and what the sensor saw, on one sheet fit for a paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from matplotlib.ticker import MaxNLocator

from raytac.gel.surface import PadGrid
from raytac.markers import MarkerFrame
from raytac.report.markers import draw_arrows
from raytac.report.style import STYLE
from raytac.specs.sensor import CameraSpec, SensorSpec

DIFFERENCE_RANGE = 64
"""Levels (of 255) at full scale of the difference panel, either way, in every preview."""

_STYLE = {
    **STYLE,
    "font.family": "sans-serif",
    "axes.titlepad": 4,
    "axes.labelsize": 7.5,
    "axes.labelpad": 1.5,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.major.pad": 2,
    "ytick.major.pad": 2,
}
_GEL, _REST, _OBJECT = "#9fc5cf", "#22586b", "#5b5b60"
_PLATE = {"frameon": True, "facecolor": "white", "edgecolor": "none", "framealpha": 0.85, "borderpad": 0.3, "borderaxespad": 0.3}
"""Ground of the section's legend, so that it reads over the dark object too."""
_TICKS_MM = (-15, -10, -5, 0, 5, 10, 15)
_UNTOUCHED = 1e-6
"""Indentation [m] below which the pad is untouched when the section's plane is chosen."""


@dataclass(frozen=True)
class PreviewData:
    """One environment's arrays; a panel whose array is None is left out."""

    title: str
    grid: PadGrid
    height: np.ndarray
    """Coat surface, pad frame [m], shape (Ny, Nx)."""
    contact: np.ndarray
    """Contact mask, shape (Ny, Nx), bool."""
    extent_mm: tuple[float, float, float, float]
    """Left, right, bottom, top edge of the image on z = 0 [mm]; bottom > top: +y is down."""
    object_height: np.ndarray | None = None
    """z of the object's underside, pad frame [m], (Ny, Nx); not finite without an object."""
    rgb: np.ndarray | None = None
    """Tactile image, shape (H, W, 3), uint8."""
    rest_rgb: np.ndarray | None = None
    """Image of the untouched pad, shape (H, W, 3), uint8."""
    normals: np.ndarray | None = None
    """Unit normals, pad frame, n_z < 0, shape (H, W, 3)."""
    markers: MarkerFrame | None = None
    """Markers of environment 0, in pixels of ``resolution``."""
    resolution: tuple[int, int] | None = None
    """(width, height) of the image [px]."""
    traction: np.ndarray | None = None
    """Force of the object on the pad per area, pad frame [Pa], shape (Ny, Nx, 3)."""
    traction_at_rest: bool = False
    """True if ``traction`` is at the coat's place at rest (soft pad), not at the contact's."""
    section: tuple[float, float] | None = None
    """x, y [m] of the point that the cross-section goes through; None finds the deepest."""


_Panel = Callable[[Axes, PreviewData], None]


def camera_extent_mm(camera: CameraSpec) -> tuple[float, float, float, float]:
    """Left, right, bottom, top edge of the whole image on the plane z = 0 [mm].

    Of a camera with distortion or tilt it is the extent that it would have without, about its optical axis.
    """
    (width, height), (px, py), (cx, cy) = camera.resolution, camera.pixel_pitch, camera.principal_point
    x, y = camera.centre
    return tuple(1e3 * v for v in (x - cx * px, x + (width - cx) * px, y + (height - cy) * py, y - cy * py))  # type: ignore[return-value]


def difference_to_rest(rgb: np.ndarray, rest_rgb: np.ndarray, full_scale: float = DIFFERENCE_RANGE) -> np.ndarray:
    """0.5 + (rgb − rest) / (2 · full_scale) of two 8-bit images, clipped to [0, 1]."""
    return np.clip(0.5 + (rgb.astype(np.float32) - rest_rgb.astype(np.float32)) / (2.0 * full_scale), 0.0, 1.0)


def write_preview(path: Path, data: PreviewData, sensor: SensorSpec, *, dpi: int = 300) -> None:
    """Draw the preview of ``data`` and save it as PNG."""
    draw_preview(data, sensor).savefig(path, dpi=dpi)


def draw_preview(data: PreviewData, sensor: SensorSpec) -> Figure:
    """A figure 7.16 inches wide (two columns), three panels a row; maps in mm at one scale.

    The section begins the last row and is as wide as leaves no place empty, one to three panels.
    """
    chosen: tuple[tuple[_Panel, bool], ...] = (
        (_object_panel, True),
        (_indentation_panel, True),
        (_image_panel, data.rgb is not None),
        (_normals_panel, data.normals is not None),
        (_difference_panel, data.rgb is not None and data.rest_rgb is not None),
        (_marker_panel, data.markers is not None),
        (_pressure_panel, data.traction is not None),
        (_shear_panel, _is_sheared(data)),
    )
    panels = [(draw, 1) for draw, is_there in chosen if is_there]
    rows = -(-(len(panels) + 1) // 3)
    # Its long label has no room beside a colour bar: at the left edge, or beside the object, which has none.
    section = partial(_section_panel, sensor=sensor), 3 * rows - len(panels)
    panels.insert(max(1, 3 * (rows - 1)), section)
    with matplotlib.rc_context(_STYLE):
        return _lay_out(panels, rows, data)


def _lay_out(panels: list[tuple[_Panel, int]], rows: int, data: PreviewData) -> Figure:
    """Place the panels by hand, with widths in columns, so that they line up with any labels."""
    x_low, x_high, bottom, top = data.extent_mm
    wide = 1.62  # leaves room for a colour bar's figures at the right edge
    high = wide * float(np.clip((bottom - top) / (x_high - x_low), 0.5, 1.3))
    margin, between, above, below, heading = 0.46, 0.74, 0.22, 0.36, 0.24  # inches
    width, total = 7.16, heading + rows * (above + high + below)
    figure = Figure(figsize=(width, total))
    figure.text(margin / width, 1.0 - 0.55 * heading / total, data.title, fontsize=8.5, va="center", weight="bold")
    place = 0
    for index, (draw, span) in enumerate(panels):
        row, column = divmod(place, 3)
        x, y = margin + column * (wide + between), total - heading - (row + 1) * (above + high) - row * below
        across = span * wide + (span - 1) * between
        axes = figure.add_axes((x / width, y / total, across / width, high / total))
        draw(axes, data)
        axes.set_title(f"({'abcdefghi'[index]}) {axes.get_title(loc='left')}", loc="left")
        place += span
    return figure


def _map_axes(axes: Axes, data: PreviewData, title: str) -> None:
    axes.set_title(title, loc="left")
    x_low, x_high, bottom, top = data.extent_mm
    axes.set(xlim=(x_low, x_high), ylim=(bottom, top), aspect="equal", xlabel="x [mm]", ylabel="y [mm]")
    axes.set_xticks([t for t in _TICKS_MM if x_low <= t <= x_high])
    axes.set_yticks([t for t in _TICKS_MM if top <= t <= bottom])


def _grid_extent_mm(grid: PadGrid) -> tuple[float, float, float, float]:
    """Outer edges of the cells whose centres are the grid's nodes."""
    dx, dy = grid.pitch
    return (
        1e3 * (grid.x[0] - dx / 2), 1e3 * (grid.x[-1] + dx / 2), 1e3 * (grid.y[-1] + dy / 2), 1e3 * (grid.y[0] - dy / 2),
    )  # fmt: skip


def _hillshade(height: np.ndarray, pitch: tuple[float, float]) -> np.ndarray:
    """Lambert shading in [0, 1] of a height map seen from −z, lit from the upper left."""
    zy, zx = np.gradient(height, pitch[1], pitch[0])
    normal = np.stack([zx, zy, -np.ones_like(zx)], axis=-1) / np.sqrt(1.0 + zx**2 + zy**2)[..., None]
    light = np.array([-0.5, -0.6, -1.0]) / np.linalg.norm([0.5, 0.6, 1.0])
    return np.clip(normal @ light, 0.0, 1.0)


def _object_panel(axes: Axes, data: PreviewData) -> None:
    if data.object_height is None or not np.isfinite(data.object_height).any():
        _map_axes(axes, data, "object: none")
        return
    _map_axes(axes, data, "object, face to the gel")
    there = np.isfinite(data.object_height)
    filled = np.where(there, data.object_height, np.nanmax(np.where(there, data.object_height, np.nan)))
    shade = 0.25 + 0.70 * _hillshade(filled, data.grid.pitch)
    image = np.dstack([shade, shade, shade, there.astype(float)])
    axes.imshow(image, extent=_grid_extent_mm(data.grid), interpolation="bilinear")
    if data.contact.any() and not data.contact.all():
        x, y = 1e3 * data.grid.x, 1e3 * data.grid.y
        axes.contour(x, y, data.contact.astype(float), levels=[0.5], colors="#d55e00", linewidths=0.7)
        _note(axes, "contact", "#d55e00")


def _note(axes: Axes, text: str, colour: str = "#222222") -> None:
    """A word at the lower left inside of a map, where a title would run over the colour bar."""
    label = axes.text(0.03, 0.04, text, color=colour, fontsize=7, transform=axes.transAxes)
    label.set_bbox({"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.0})


def _indentation_panel(axes: Axes, data: PreviewData) -> None:
    _map_axes(axes, data, "indentation [mm]")
    indentation = 1e3 * (data.grid.rest - data.height)
    low, high = min(0.0, float(indentation.min())), max(float(indentation.max()), 1e-3)
    extent = _grid_extent_mm(data.grid)
    shown = axes.imshow(indentation, extent=extent, cmap="viridis", vmin=low, vmax=high, interpolation="nearest")
    axes.axhline(_section_point(data)[1], color="white", linewidth=0.6, linestyle=(0, (4, 3)))
    _colour_bar(axes, shown)


def _colour_bar(axes: Axes, shown: AxesImage) -> None:
    bar = axes.figure.colorbar(shown, cax=axes.inset_axes((1.025, 0.0, 0.035, 1.0)))
    bar.outline.set_linewidth(0.6)  # type: ignore[operator]
    bar.locator = MaxNLocator(nbins=4, steps=[1, 2, 5, 10])
    bar.update_ticks()


def _marker_panel(axes: Axes, data: PreviewData) -> None:
    assert data.markers is not None and data.resolution is not None
    magnified = draw_arrows(axes, data.markers, data.resolution)
    longest = float(np.nanmax(np.linalg.norm(data.markers.displacement_px[0], axis=-1)))
    axes.set_title(f"markers × {magnified:g}, longest {longest:.1f} px", loc="left")


def _traction_axes(axes: Axes, data: PreviewData, kind: str, note: str = "") -> None:
    _map_axes(axes, data, f"{kind} traction [kPa]")
    notes = [text for text in ("at the place of rest" if data.traction_at_rest else "", note) if text]
    if notes:
        _note(axes, ", ".join(notes))


def _is_sheared(data: PreviewData) -> bool:
    """True if there is any shear traction; a map of none would be black."""
    return data.traction is not None and bool(data.traction[..., :2].any())


def _pressure_panel(axes: Axes, data: PreviewData) -> None:
    assert data.traction is not None
    _traction_axes(axes, data, "normal", "" if _is_sheared(data) else "no shear")
    pressure = -1e-3 * data.traction[..., 2]
    extent = _grid_extent_mm(data.grid)
    _colour_bar(axes, axes.imshow(pressure, extent=extent, cmap="magma", vmin=0.0, vmax=max(float(pressure.max()), 1e-3)))


def _shear_panel(axes: Axes, data: PreviewData) -> None:
    """Size of the shear traction, and its direction at some places where it is not small."""
    assert data.traction is not None
    _traction_axes(axes, data, "shear")
    shear = 1e-3 * data.traction[..., :2]
    size = np.hypot(shear[..., 0], shear[..., 1])
    largest = max(float(size.max()), 0.1)
    _colour_bar(axes, axes.imshow(size, extent=_grid_extent_mm(data.grid), cmap="magma", vmin=0.0, vmax=largest))
    step = max(len(data.grid.y) // 24, 1)
    nodes = np.meshgrid(np.arange(step // 2, len(data.grid.y), step), np.arange(step // 2, len(data.grid.x), step), indexing="ij")
    rows, columns = (n[size[tuple(nodes)] > 0.1 * largest] for n in nodes)
    across, along = shear[rows, columns].T
    x, y = 1e3 * data.grid.x[columns], 1e3 * data.grid.y[rows]
    # One arrow's length is the distance to the next arrow where the shear is largest; +y is down in the panel.
    spacing = 1e3 * step * data.grid.pitch[0]
    axes.quiver(x, y, across, along, color="#56b4e9", angles="xy", scale_units="xy", scale=largest / spacing, width=0.006)


def _image_panel(axes: Axes, data: PreviewData) -> None:
    assert data.rgb is not None
    _map_axes(axes, data, "tactile image")
    axes.imshow(data.rgb, extent=data.extent_mm, interpolation="nearest")


def _normals_panel(axes: Axes, data: PreviewData) -> None:
    assert data.normals is not None
    _map_axes(axes, data, "surface normals")
    axes.imshow(_normal_colours(data.normals), extent=data.extent_mm, interpolation="nearest")
    key = axes.inset_axes((1.02, 0.70, 0.19, 0.30))  # beside the image, which it must not cover
    key.set_axis_off()
    u, v = np.meshgrid(np.linspace(-1, 1, 96), np.linspace(-1, 1, 96))
    ball = np.dstack([u, v, -np.sqrt(np.clip(1 - u**2 - v**2, 0, 1))])
    disc = key.imshow(_normal_colours(ball), extent=(-1, 1, 1, -1))
    circle = Circle((0, 0), 1.0, fill=False, edgecolor="#555555", linewidth=0.6, transform=key.transData)
    disc.set_clip_path(circle)
    key.add_patch(circle)
    key.set(xlim=(-1.08, 1.08), ylim=(1.08, -1.08), aspect="equal", anchor="NW")


def _normal_colours(normals: np.ndarray) -> np.ndarray:
    """R, G, B = (n_x, n_y, −n_z) from [−1, 1] to [0, 1]."""
    return np.clip(0.5 + 0.5 * normals * np.array([1.0, 1.0, -1.0]), 0.0, 1.0)


def _difference_panel(axes: Axes, data: PreviewData) -> None:
    assert data.rgb is not None and data.rest_rgb is not None
    _map_axes(axes, data, f"image − rest, ±{DIFFERENCE_RANGE} of 255")
    axes.imshow(difference_to_rest(data.rgb, data.rest_rgb), extent=data.extent_mm, interpolation="nearest")


def _section_point(data: PreviewData) -> tuple[int, float]:
    """Grid row of the cross-section and its y [mm]: ``section``, else the deepest point."""
    indentation = data.grid.rest - data.height
    if data.section is not None and np.isfinite(data.section).all():
        row = int(np.argmin(np.abs(data.grid.y - data.section[1])))
        if data.contact[row].any():
            return row, 1e3 * float(data.grid.y[row])
    deepest = int(np.unravel_index(np.argmax(indentation), indentation.shape)[0])
    row = deepest if indentation.max() > _UNTOUCHED else len(data.grid.y) // 2
    return row, 1e3 * float(data.grid.y[row])


def _section_panel(axes: Axes, data: PreviewData, sensor: SensorSpec) -> None:
    row, y_mm = _section_point(data)
    x, surface, rest = 1e3 * data.grid.x, 1e3 * data.height[row], 1e3 * data.grid.rest[row]
    depth = float(np.max(1e3 * (data.grid.rest - data.height)))
    low = max(-1e3 * sensor.gelpad.thickness, min(float(surface.min()), float(rest.min())) - max(0.6 * depth, 0.3))
    high = max(1.2 * depth, 0.5)
    axes.fill_between(x, low, surface, color=_GEL, linewidth=0)
    if data.object_height is not None:
        under = 1e3 * data.object_height[row]
        inside = np.isfinite(under) & (under < high)
        under = np.where(inside, np.maximum(under, low), high)
        axes.fill_between(x, under, high, color=_OBJECT, linewidth=0)
    axes.plot(x, rest, color=_REST, linewidth=0.7, linestyle=(0, (4, 2)))
    axes.plot(x, surface, color=_REST, linewidth=1.0)
    x_low, x_high = data.extent_mm[:2]
    axes.set(xlim=(x_low, x_high), ylim=(low, high), xlabel="x [mm]")
    axes.set_xticks([t for t in _TICKS_MM if x_low <= t <= x_high])
    box = axes.get_window_extent()
    stretch = (box.height / (high - low)) / (box.width / (x_high - x_low))
    y_mm = round(y_mm, 1) + 0.0  # no "−0.0"
    axes.set_title(f"section y = {y_mm:.1f} mm".replace("-", "−"), loc="left")
    axes.set_ylabel(f"z [mm], stretched {stretch:.1f} ×")
    handles = [
        Patch(facecolor=_GEL, edgecolor=_REST, linewidth=0.6, label="gel"),
        Patch(facecolor=_OBJECT, label="object"),
        Line2D([], [], color=_REST, linewidth=0.8, linestyle=(0, (3, 1.5)), label="rest"),
    ]
    axes.legend(handles=handles, loc="lower center", fontsize=7, ncols=3, handlelength=1.2, columnspacing=0.9, **_PLATE)
