"""The same presses on the rigid pad and on levels of the soft one: one report."""

from __future__ import annotations

import base64
import html
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.frame import TactileFrame
from raytac.gel.surface import GelSurface
from raytac.io.folder import result_folder
from raytac.io.metrics import Metric, versions, write_metrics
from raytac.physics import Ipc, PhysicsConfig, Rigid
from raytac.report.measure import machine, timed_within
from raytac.report.preview import camera_extent_mm
from raytac.report.style import STYLE
from raytac.sensor import TactileSensor
from raytac.specs import PADS, load_press

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RIGID = "rigid"
NEAR, BEYOND = 1e-3, 2e-3
"""Distances from the contact [m] at which the zones of a height difference end."""
STEP_MM = 0.05
"""A scale of height differences ends at a multiple of this."""
FILES = ("report.html", "sheet.png", "error_cost.png", "metrics.json")


@dataclass(frozen=True)
class PadPress:
    """One press on one pad at its peak stage."""

    scene: str
    pad: str
    """``rigid``, or the level of the soft pad."""
    frame: TactileFrame
    seconds: float
    """Time of the whole press with its image [s]."""


@dataclass(frozen=True)
class ModeImage:
    """Image of one optical mode on the finest pad's surface of a scene."""

    scene: str
    mode: str
    image: float
    """Mean absolute difference to the ray tracer's image of that surface [levels of 255]."""
    frame_ms: float
    """Median time of an image [ms]."""


def press_pads(
    scenes: Sequence[str | Path],
    levels: Sequence[str],
    *,
    sensor: str = "gelsight_mini",
    resolution: tuple[int, int] | None = None,
    device: str = "auto",
    seed: int = 0,
) -> tuple[list[PadPress], TactileSensor]:
    """Press every scene on the rigid pad and on the soft pad of every level, coarsest first.

    Returns:
        The presses, pads of a scene side by side, and the sensor of the finest level.

    Raises:
        InputError: no scene, two of one name, or an unknown level.
        BackendError: the soft pad's solver cannot run here.
    """
    for level in levels:
        if level not in PADS:
            raise InputError("levels", value=level, rule="must be known levels", choices=PADS)
    if not scenes or not levels:
        name = "levels" if scenes else "scenes"
        raise InputError(name, value=(), rule="must name at least one")
    pads: dict[str, PhysicsConfig] = {RIGID: Rigid(), **{level: Ipc(level=level) for level in PADS if level in levels}}
    presses = [load_press(scene) for scene in scenes]
    names = [scene.name for scene in presses]
    if len(set(names)) < len(names):
        raise InputError("scenes", value=names, rule="must have names that differ: keys of metrics begin with them")
    given = {"outputs": ("rgb", "wrench"), "resolution": resolution, "device": device, "seed": seed}
    sensors = {pad: TactileSensor(sensor, physics=physics, **given) for pad, physics in pads.items()}
    if resolve_device(device) == "cpu":
        from raytac.optics.runtime import share_cores

        share_cores()  # for all pads alike: a soft one does so from its first press on
    made = []
    for scene in presses:
        for pad, one in sensors.items():
            start = time.perf_counter()
            frame = one.press(scene, progress=True)
            made.append(PadPress(scene.name, pad, frame, time.perf_counter() - start))
            logging.getLogger("raytac").info("%s, %s: pressed in %.1f s", scene.name, pad, made[-1].seconds)
    return made, sensors[list(pads)[-1]]


def image_modes(presses: Sequence[PadPress], sensor: TactileSensor, modes: Sequence[str]) -> list[ModeImage]:
    """Images of other optical modes on the surfaces of the finest pad.

    Errors of a pad and of an image mode are then in one unit, and a plot shows which of both is worth its time.

    Args:
        presses, sensor: as ``press_pads`` returns them.
        modes: names of optical modes that need no file of their own, such as ``taxim``, which is baked at first use.
    """
    finest = {press.scene: press.frame for press in presses}
    made = []
    for mode in modes:
        given = {"resolution": sensor.resolution, "device": sensor.device, "seed": sensor.seed}
        other = TactileSensor(sensor.spec, optics=mode, outputs=("rgb",), **given)
        for scene, frame in finest.items():
            image = other.update(frame.surface).rgb
            assert image is not None and frame.rgb is not None
            times = timed_within(lambda surface, other=other: other.update(surface).rgb, [frame.surface], 5, 1.0)
            off = float(np.abs(image[0].astype(float) - frame.rgb[0]).mean())
            made.append(ModeImage(scene, mode, off, float(np.median(times))))
    return made


def pad_metrics(presses: Sequence[PadPress], images: Sequence[ModeImage] = ()) -> dict[str, Metric]:
    """``SCENE.PAD.*`` of every press, and its differences to the finest pad's.

    ``press_s``; ``imprint_mm`` (deepest), ``bulge_mm`` (highest above rest), ``contact_mm2``, ``force_n``. But for the finest pad also root
    mean square differences of height: ``contact_um`` (where both touch: small between soft pads, which are all laid on the object there),
    ``near_um`` (outside the contact of either, up to 1 mm from it) and ``beyond_um`` (1 to 2 mm from it); and ``image``: mean absolute
    difference of the images [levels of 255]. Of ``images`` ``SCENE.MODE.image`` and ``SCENE.MODE.frame_ms``.
    """
    finest = {press.scene: press for press in presses}
    metrics: dict[str, Metric] = {}
    for press in presses:
        values = {"press_s": press.seconds, **_measured(press.frame)}
        if press is not finest[press.scene]:
            values |= differences(press.frame, finest[press.scene].frame)
        metrics |= {f"{press.scene}.{press.pad}.{key}": value for key, value in values.items() if np.isfinite(value)}
    for one in images:
        metrics |= {f"{one.scene}.{one.mode}.image": one.image, f"{one.scene}.{one.mode}.frame_ms": one.frame_ms}
    return metrics


def _measured(frame: TactileFrame) -> dict[str, float]:
    surface = frame.surface
    return {
        "imprint_mm": 1e3 * float(surface.indentation.max()),
        "bulge_mm": -1e3 * float(surface.indentation.min()),
        "contact_mm2": 1e6 * float(surface.contact[0].sum()) * surface.grid.pitch[0] * surface.grid.pitch[1],
        "force_n": -float(frame.force[0, 2]),
    }


def differences(one: TactileFrame, other: TactileFrame) -> dict[str, float]:
    """Differences of two frames of one press, as of ``pad_metrics``; NaN where there is no node."""
    assert one.rgb is not None and other.rgb is not None
    heights = height_differences(one.surface, other.surface)
    return heights | {"image": float(np.abs(one.rgb[0].astype(float) - other.rgb[0]).mean())}


def height_differences(one: GelSurface, other: GelSurface) -> dict[str, float]:
    """Root mean square difference of height [µm] by zone, as of ``pad_metrics``."""
    off = 1e6 * (one.height[0].astype(float) - other.height[0])
    either = one.contact[0] | other.contact[0]
    near, beyond = (widened(either, reach, one.grid.pitch) for reach in (NEAR, BEYOND))
    where = {"contact_um": one.contact[0] & other.contact[0], "near_um": near & ~either, "beyond_um": beyond & ~near}
    return {key: float(np.sqrt((off[mask] ** 2).mean())) if mask.any() else float("nan") for key, mask in where.items()}


def widened(mask: np.ndarray, by: float, pitch: tuple[float, float]) -> np.ndarray:
    """Nodes within ``by`` [m] of the mask along x and y, (Ny, Nx)."""
    out = mask.copy()
    for axis, step in ((1, pitch[0]), (0, pitch[1])):
        grown = out.copy()
        for k in range(1, round(by / step) + 1):
            ahead, back = [slice(None)] * 2, [slice(None)] * 2
            ahead[axis], back[axis] = slice(k, None), slice(None, -k)
            grown[tuple(ahead)] |= out[tuple(back)]
            grown[tuple(back)] |= out[tuple(ahead)]
        out = grown
    return out


def write_pads(
    presses: Sequence[PadPress], sensor: TactileSensor, out: Path, wall_s: float, images: Sequence[ModeImage] = ()
) -> list[Path]:
    """Write ``report.html`` (one file), both pictures and ``metrics.json``; returns their paths."""
    metrics = pad_metrics(presses, images)
    facts: dict[str, Metric] = {
        "command": "compare-physics",
        "sensor": sensor.spec.name,
        "device": sensor.device_used,
        **machine(),
    }
    with result_folder(out, FILES) as folder:
        sheet_figure(presses, sensor).savefig(folder / "sheet.png", pil_kwargs={"optimize": True})
        error_cost_figure(presses, images).savefig(folder / "error_cost.png", pil_kwargs={"optimize": True})
        pictures = [(folder / name).read_bytes() for name in ("sheet.png", "error_cost.png")]
        page = _page(presses, metrics, facts, *pictures)
        (folder / "report.html").write_text(page, encoding="utf-8")
        write_metrics(folder / "metrics.json", facts | metrics | versions() | versions(["warp-lang"]) | {"wall_s": wall_s})
    return [out / name for name in FILES]


def error_cost_figure(presses: Sequence[PadPress], images: Sequence[ModeImage] = ()) -> Figure:
    """Image error against time of pads and of image modes; a line from best to worst scene.

    The finest pad, with the ray tracer, is the reference: it has a time and no error.
    """
    import matplotlib
    from matplotlib.figure import Figure

    finest = {press.scene: press for press in presses}
    points: dict[str, list[tuple[float, float]]] = {}
    for press in presses:
        off = differences(press.frame, finest[press.scene].frame)["image"]
        points.setdefault(f"{press.pad} pad" if press.pad == RIGID else f"soft pad, {press.pad}", []).append((press.seconds, off))
    for one in images:
        points.setdefault(f"{one.mode}, on the finest pad", []).append((1e-3 * one.frame_ms, one.image))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 3.4), layout="constrained", dpi=100)
        axes = figure.subplots()
        for k, (name, values) in enumerate(points.items()):
            seconds, offs = float(np.median([s for s, _ in values])), [off for _, off in values]
            if not max(offs) > 0.0:
                axes.axvline(seconds, color=f"C{k}", linestyle=":", label=f"{name}: the reference")
                continue
            marker = "^" if name.endswith("finest pad") else "o"
            axes.plot([seconds] * 2, [min(offs), max(offs)], color=f"C{k}", linewidth=0.8, alpha=0.6)
            axes.plot(seconds, np.mean(offs), color=f"C{k}", marker=marker, linestyle="none", label=name)
        axes.set(xscale="log", xlabel="time of a press with its image (circles), of an image (triangles) [s]")
        axes.set(yscale="log", ylabel="image, mean absolute\ndifference [levels of 255]")
        axes.grid(True, linewidth=0.3, color="0.9")
        figure.legend(loc="outside right upper", frameon=False)
    return figure


def sheet_figure(presses: Sequence[PadPress], sensor: TactileSensor) -> Figure:
    """One row a scene: images, indentations, and each height less that of the finest pad.

    No scale cuts anything off.
    """
    import matplotlib
    from matplotlib.figure import Figure

    view = camera_extent_mm(sensor.spec.camera)
    rows = {scene: [press for press in presses if press.scene == scene] for scene in dict.fromkeys(p.scene for p in presses)}
    pads = [press.pad for press in next(iter(rows.values()))]
    count, finest = len(pads), pads[-1]
    titles = [f"image, {pad}" for pad in pads] + [f"indentation, {pad}" for pad in pads]
    titles += [f"height, {pad} − {finest}" for pad in pads[:-1]]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(2.05 * len(titles), 1.24 * len(rows) + 0.45), layout="constrained", dpi=100)
        figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, hspace=0.0, wspace=0.0)  # type: ignore[union-attr, call-arg]
        axes = np.atleast_2d(figure.subplots(len(rows), len(titles), squeeze=False))
        for row, (line, (name, pressed)) in enumerate(zip(axes, rows.items(), strict=True)):
            grid = pressed[0].frame.surface.grid
            extent = [1e3 * v for v in (grid.x[0], grid.x[-1], grid.y[-1], grid.y[0])]
            dents = [1e3 * press.frame.surface.indentation[0] for press in pressed]
            deepest, highest = max(float(d.max()) for d in dents), min(float(d.min()) for d in dents)
            for axis, press in zip(line[:count], pressed, strict=True):
                assert press.frame.rgb is not None
                axis.imshow(press.frame.rgb[0], extent=view)
            for axis, dent in zip(line[count : 2 * count], dents, strict=True):
                shown = axis.imshow(dent, extent=extent, cmap="cividis", vmin=highest, vmax=deepest)
            bars = [figure.colorbar(shown, ax=list(line[count : 2 * count]), shrink=0.9, pad=0.01)]
            offs = [dents[-1] - dent for dent in dents[:-1]]
            end = max(float(np.ceil(max(np.abs(off).max() for off in offs) / STEP_MM - 1e-9)), 1.0) * STEP_MM
            for axis, off in zip(line[2 * count :], offs, strict=True):
                shown = axis.imshow(off, extent=extent, cmap="PuOr", vmin=-end, vmax=end)
            bars.append(figure.colorbar(shown, ax=list(line[2 * count :]), shrink=0.9, pad=0.02, ticks=(-end, 0.0, end)))
            for bar in bars:
                bar.set_label("mm", labelpad=1)
                bar.ax.tick_params(labelsize=7.5, length=2)
            for axis, title in zip(line, titles, strict=True):
                axis.set(xticks=[], yticks=[])
                if row == 0:
                    axis.set_title(title)
            line[0].set_ylabel(name)
    return figure


_COLUMNS: Mapping[str, tuple[str, str]] = {
    "press_s": ("press [s]", ".1f"),
    "force_n": ("normal force [N]", ".2f"),
    "imprint_mm": ("imprint [mm]", ".3f"),
    "bulge_mm": ("bulge [mm]", ".3f"),
    "contact_mm2": ("contact [mm²]", ".1f"),
    "contact_um": ("height, contact [µm]", ".1f"),
    "near_um": ("height, to 1 mm [µm]", ".1f"),
    "beyond_um": ("height, 1 to 2 mm [µm]", ".1f"),
    "image": ("image [of 255]", ".2f"),
}
"""Heading and number format of each figure of the report."""


def _page(
    presses: Sequence[PadPress], metrics: Mapping[str, Metric], facts: Mapping[str, Metric], sheet: bytes, cost: bytes
) -> str:
    head = "".join(f"<th>{html.escape(text)}</th>" for text, _ in _COLUMNS.values())
    lines = []
    for press in presses:
        values = [(metrics.get(f"{press.scene}.{press.pad}.{key}"), form) for key, (_, form) in _COLUMNS.items()]
        cells = "".join(f"<td>{'–' if value is None else format(value, form)}</td>" for value, form in values)
        lines.append(f"<tr><td>{html.escape(press.scene)}</td><td>{press.pad}</td>{cells}</tr>")
    said = "".join(f"<tr><td>{html.escape(name)}</td><td>{html.escape(str(value))}</td></tr>" for name, value in facts.items())
    finest = presses[-1].pad
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>The same presses on rigid and soft pads</title>
<style>body{{font:15px/1.5 system-ui,sans-serif;max-width:1180px;margin:2rem auto;padding:0 1.2rem}}
table{{border-collapse:collapse;font-size:13px}}th,td{{padding:.2rem .55rem;text-align:right;border-bottom:1px solid #e4e4e4}}
td:first-child,td:nth-child(2){{text-align:left}}th{{background:#f5f5f5}}img{{max-width:100%}}</style></head><body>
<h1>The same presses on rigid and soft pads</h1>
<p>Each scene at its peak stage. Differences are to the {finest} soft pad: of height, root mean square, where both pads touch,
around the contact of either up to 1 mm, and 1 to 2 mm from it; of the image, mean absolute. The time of a press has its image in it,
and that of a pad's first press what is made once.</p>
<table><tr><th>scene</th><th>pad</th>{head}</tr>{"".join(lines)}</table>
<p><img alt="Images, indentations and height differences" src="data:image/png;base64,{base64.b64encode(sheet).decode("ascii")}"></p>
<p>Error against time: how far the images of a pad are from those of the {finest} soft pad, and how far other image modes are from the ray
tracer on that pad's surface. Median time and mean over the scenes; lines go from the best scene to the worst.</p>
<p><img alt="Image error against time" src="data:image/png;base64,{base64.b64encode(cost).decode("ascii")}"></p>
<table>{said}</table></body></html>
"""
