"""Run one press and write its folder: images, height, traction, markers, preview, metrics."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from raytac.errors import InputError, RaytacError
from raytac.frame import TactileFrame
from raytac.gel.surface import GelSurface
from raytac.io.arrays import npy_bytes
from raytac.io.folder import result_folder
from raytac.io.images import vector_channels, write_exr, write_png
from raytac.io.metrics import Metric, versions, write_metrics
from raytac.markers import MARKERS
from raytac.optics.backgrounds import draw_photograph, shown_on
from raytac.sensor import TactileSensor
from raytac.specs import PressScene, validate_press
from raytac.specs.sensor import SensorSpec

FILES = ("rgb.png", "frame.exr", "height.npy", "traction.npy", "markers.npz", "preview.png", "metrics.json")
"""Every file of a press; those of an earlier press that a new one lacks are removed."""


def run_press(
    sensor: TactileSensor,
    scene: PressScene,
    out: Path,
    *,
    outputs: tuple[str, ...],
    start: float | None = None,
    progress: bool = False,
    background: Path | None = None,
) -> list[Path]:
    """Press ``scene`` into ``sensor`` and write the files that ``outputs`` name, environment 0.

    ``start`` is ``time.perf_counter()`` at the beginning of the job (for ``wall_s``), None is now. ``progress``: show the progress of a
    soft pad. ``background``: photograph of the untouched sensor on which the image is shown, or a folder of some, from which the sensor's
    seed draws. Returns the files written. Nothing in ``out`` changes until everything is computed and written.

    Raises:
        SpecError: the scene does not fit this sensor.
        InputError: a background that cannot be read, has another size than the image, or would not be seen.
        RaytacError: the press did not settle.
    """
    start = time.perf_counter() if start is None else start
    validate_press(sensor.spec, scene)
    if background is not None and not ("rgb" in outputs and "rgb" in sensor.outputs):
        raise InputError("background", value=background, rule="is shown in rgb, which is not among the outputs")
    drawn = None if background is None else draw_photograph(background, sensor.resolution, sensor.seed)
    with result_folder(out, FILES) as folder:
        began = time.perf_counter()
        rest = sensor.rest()
        setup_ms = 1e3 * (time.perf_counter() - began)
        frame = sensor.press(scene, progress=progress)
        if frame.failed[0]:
            raise RaytacError(f"the press {scene.name!r} did not settle, or its state is not finite: nothing is written")
        if drawn is not None:
            frame, rest = (one.with_values(rgb=shown_on(drawn[1], one.rgb, rest.rgb)) for one in (frame, rest))
        if "rgb" in outputs and "rgb" in frame.outputs:
            write_png(folder / "rgb.png", frame.rgb[0])
        channels = exr_channels(frame, outputs)
        if channels:
            write_exr(folder / "frame.exr", channels, exr_header(sensor, scene, frame))
        if "height" in outputs:
            (folder / "height.npy").write_bytes(npy_bytes(frame.surface.height[0].astype(np.float32)))
        if "traction" in outputs and "traction" in frame.outputs:
            (folder / "traction.npy").write_bytes(npy_bytes(frame.traction[0]))
        if "markers" in frame.outputs:
            names = ("displacement", "displacement_px", "rest", "rest_px", "position")
            np.savez(folder / "markers.npz", **{name: getattr(frame.markers, name)[0] for name in names})
        _write_preview(folder / "preview.png", sensor, scene, frame, rest, outputs)
        metrics = press_metrics(sensor, scene, frame, rest) | {"time.setup_ms": setup_ms}
        metrics |= {} if drawn is None else {"image.background": drawn[0]}
        write_metrics(folder / "metrics.json", metrics | {"wall_s": time.perf_counter() - start})
        names = sorted(path.name for path in folder.iterdir())
    return [Path(out) / name for name in names]


def exr_channels(frame: TactileFrame, outputs: tuple[str, ...], env: int = 0) -> dict[str, np.ndarray]:
    """Channels of ``frame.exr`` for one environment, each (H, W) float32; empty without images.

    ``R G B``: linear image, the sum of the layers; ``led_<layer>.R`` …: each layer; ``N.X`` …: normal; ``P.X`` …: position [m];
    ``Z``: camera-axis depth [m].
    """
    channels: dict[str, np.ndarray] = {}
    if "layers" in frame.outputs and "rgb" in outputs:
        channels |= vector_channels("", np.sum([layer[env] for layer in frame.layers.values()], axis=0), "RGB")
    if "layers" in frame.outputs and "layers" in outputs:
        for name, layer in frame.layers.items():
            channels |= vector_channels(f"led_{name}", layer[env], "RGB")
    if "normals" in frame.outputs and "normals" in outputs:
        channels |= vector_channels("N", frame.normals[env])
        if "position" in frame.outputs:
            channels |= vector_channels("P", frame.position[env])
    if "depth" in frame.outputs and "depth" in outputs:
        channels["Z"] = frame.depth[env]
    return channels


def exr_header(sensor: TactileSensor, scene: PressScene, frame: TactileFrame) -> dict[str, str]:
    """Origin of an image: sensor, scene, mode, seed, units and versions; all text."""
    header = {key: str(value) for key, value in sensor.sampling.items()}
    if (size := _image_size(frame)) is not None:
        header["resolution"] = f"{size[0]}x{size[1]}"
    if "layers" in frame.outputs:
        header["layers"] = " ".join(f"led_{name}" for name in frame.layers)
    header |= {
        "sensor": sensor.spec.name,
        "scene": scene.name,
        "mode": frame.label,
        "seed": str(sensor.seed),
        "unitsRadiance": "linear, relative W/(m^2 sr)",
        "unitsPosition": "m",
        "unitsDepth": "m",
        "frame": "pad: origin at the centre of the gel surface at rest, +x image right, +y image down, +z towards the object",
    }
    return header | {key.replace("versions.", "version:"): value for key, value in versions().items()}


def press_metrics(sensor: TactileSensor, scene: PressScene, frame: TactileFrame, rest: TactileFrame) -> dict[str, Metric]:
    """Everything of ``metrics.json`` but ``wall_s``; environment 0."""
    surface = frame.surface
    dx, dy = surface.grid.pitch
    metrics: dict[str, Metric] = {
        "command": "press",
        "sensor": sensor.spec.name,
        "scene": scene.name,
        "mode": frame.label,
        "device": sensor.device_used,
        "seed": sensor.seed,
        "machine.cores": os.cpu_count() or 1,
        **{f"image.{key}": value for key, value in sensor.sampling.items()},
        "contact.max_indentation_mm": 1e3 * float(surface.indentation[0].max()),
        "contact.surface_area_mm2": 1e6 * dx * dy * int(surface.contact[0].sum()),
    }
    size = _image_size(frame)
    if size is not None:
        metrics["image.width_px"], metrics["image.height_px"] = size
        for axis, pitch in zip("xy", sensor.spec.camera.pitch_at(size), strict=True):
            metrics[f"image.pixel_{axis}_mm"] = 1e3 * pitch
    if np.isfinite(surface.contact_centre[0]).all():
        metrics["contact.centre_x_mm"], metrics["contact.centre_y_mm"] = (1e3 * float(v) for v in surface.contact_centre[0])
    if "contact_cells" in frame.outputs and np.isfinite(frame.contact_cells[0]):
        metrics["contact.cells_across"] = float(frame.contact_cells[0])
    if "unconverged" in frame.outputs:
        metrics["contact.unconverged_steps"] = int(frame.unconverged[0])
    if "force_law_area" in frame.outputs:
        metrics["contact.force_law_area_mm2"] = 1e6 * float(frame.force_law_area[0])
    if "force" in frame.outputs:
        for axis, value in zip("xyz", frame.force[0], strict=True):
            metrics[f"contact.force_{axis}_n"] = float(value)
    if "wrench" in frame.outputs:
        for axis, value in zip("xyz", frame.wrench[0, 3:], strict=True):
            metrics[f"contact.torque_{axis}_nmm"] = 1e3 * float(value)
    if "traction" in frame.outputs:
        metrics["contact.max_pressure_kpa"] = -1e-3 * float(frame.traction[0, ..., 2].min())
        metrics["contact.max_shear_kpa"] = 1e-3 * float(np.hypot(*np.moveaxis(frame.traction[0, ..., :2], -1, 0)).max())
    if "markers" in frame.outputs:
        moved = np.linalg.norm(frame.markers.displacement[0], axis=-1)
        moved_px = np.linalg.norm(frame.markers.displacement_px[0], axis=-1)
        metrics |= {
            "markers.model": "" if sensor.markers is None else MARKERS.name_of(sensor.markers),
            "markers.count": len(moved),
            "markers.mean_mm": 1e3 * float(np.nanmean(moved)),
            "markers.max_mm": 1e3 * float(np.nanmax(moved)),
            "markers.mean_px": float(np.nanmean(moved_px)),
            "markers.max_px": float(np.nanmax(moved_px)),
        }
    if "rgb" in frame.outputs and "rgb" in rest.outputs:
        change = np.abs(frame.rgb[0].astype(float) - rest.rgb[0])
        metrics["image.change_from_rest_mean_u8"] = float(change.mean())
        metrics["image.change_from_rest_max_u8"] = float(change.max())
    if "uncovered" in frame.outputs and np.isfinite(frame.uncovered[0]):
        metrics["taxim.uncovered_share"] = float(frame.uncovered[0])
    metrics |= {f"time.{name}_ms": value for name, value in frame.time_ms.items()}
    return metrics | versions()


def _image_size(frame: TactileFrame) -> tuple[int, int] | None:
    """(width, height) of the frame's images [px], None if it has none."""
    images = [getattr(frame, name) for name in ("rgb", "normals", "depth") if name in frame.outputs]
    images += getattr(frame, "layers", {}).values()
    return (images[0].shape[2], images[0].shape[1]) if images else None


def _write_preview(
    path: Path, sensor: TactileSensor, scene: PressScene, frame: TactileFrame, rest: TactileFrame, outputs: tuple[str, ...]
) -> None:
    from raytac.report.preview import PreviewData, camera_extent_mm, write_preview

    surface = frame.surface
    under = sensor.object_height(surface)
    data = PreviewData(
        title=f"{scene.name} · {sensor.spec.name} · {frame.label}",
        grid=surface.grid,
        height=surface.height[0],
        contact=surface.contact[0],
        extent_mm=camera_extent_mm(sensor.spec.camera),
        object_height=under[0] if under is not None else None,
        rgb=frame.rgb[0] if "rgb" in frame.outputs and "rgb" in outputs else None,
        rest_rgb=rest.rgb[0] if "rgb" in rest.outputs else None,
        normals=frame.normals[0] if "normals" in frame.outputs else None,
        markers=getattr(frame, "markers", None),
        resolution=sensor.resolution,
        traction=frame.traction[0] if "traction" in frame.outputs and "traction" in outputs else None,
        traction_at_rest=surface.coat is not None,
        section=(float(surface.contact_centre[0, 0]), float(surface.contact_centre[0, 1])),
    )
    write_preview(path, data, sensor.spec)


def press_peaks(
    sensor: str | Path | SensorSpec, scenes: Sequence[str | Path], size: tuple[int, int], seed: int = 0
) -> tuple[SensorSpec, dict[str, GelSurface]]:
    """The sensor's specification, and the surface (B = 1) at the peak of scenes by name.

    The grid's pitch is that of a pixel of ``size`` (width, height) on the pad, at most 0.1 mm.

    Raises ``SpecError``: an unknown sensor or scene, or a file that breaks a rule.
    """
    pressed = TactileSensor(sensor, outputs=("height",), resolution=size, device="cpu", seed=seed)
    return pressed.spec, {Path(scene).stem: pressed.press(scene).surface for scene in scenes}
