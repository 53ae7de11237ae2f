"""``params.json`` of a calibration folder: read, checked against the arrays, and written."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from raytac.checks import is_number, is_whole
from raytac.errors import CalibrationError
from raytac.gel.gaussian import CONTACT_SCALE, PYRAMID_SIGMAS
from raytac.optics.taxim.restricted_pickle import file_bytes
from raytac.optics.taxim.table import PolyTable, ShadowTable, TaximConstants


@dataclass(frozen=True)
class CalibrationParams:
    """Settings of a folder."""

    pixel_pitch: tuple[float, float]
    """Along x and y [m]."""
    constants: TaximConstants
    shadow: dict[str, Any]
    """Keyword arguments of ``ShadowTable`` besides its arrays."""
    slopes_of: str
    provenance: dict[str, str]


# Keys of "simulator" that are read: value of the first release, lowest admitted, whether relative to (width, height).
_SETTINGS: dict[str, tuple[float, float]] = {
    "frame_mixing_percentage": (0.15, 0.0),
    "diff_threshold": (5.0, -1e6),
    "discretize_precision": (0.1, 1e-4),
    "height_precision": (0.1, 1e-6),
    "fan_angle": (0.1, 1e-6),
    "fan_precision": (0.05, 1e-6),
}
_RELATIVE = {"initial_frame_sigma_rel": ("background_sigma", 50.0), "shadow_step_rel": ("shadow_step", 1.25)}
_OWN: dict[str, Callable[[Any], bool]] = {
    "slopes_of": lambda v: isinstance(v, str),
    "depth_of": lambda v: isinstance(v, str),
    "pixmm_y": lambda v: _is_number(v) and v > 0,
    "first_depth": lambda v: _is_number(v),
    "depth_offset": lambda v: is_whole(v) and abs(v) < 10**6,
    "ring_dilations": lambda v: is_whole(v) and 0 < v < 1000,
    "shadow_sigma": lambda v: _is_number(v) and 0 <= v < 1000,
    "final_sigma": lambda v: _is_number(v) and 0 <= v < 1000,
    "provenance": lambda v: isinstance(v, dict) and all(isinstance(one, str) for one in v.values()),
}


def read_params(path: Path, pixel_pitch: float | None, n_bins: int, shape: tuple[int, ...]) -> CalibrationParams:
    """Settings of ``params.json``; without that file upstream's, with ``pixel_pitch`` [m].

    ``n_bins`` and ``shape`` (H, W, 3) are those of the arrays, which the file must agree with. Raises CalibrationError for a file that
    is missing, no JSON, or breaks a rule.
    """
    if not path.exists() and pixel_pitch is not None:
        content: Any = {"sensor": {"pixmm": 1e3 * pixel_pitch, "num_bins": n_bins, "h": shape[0], "w": shape[1]}}
    else:
        try:
            content = json.loads(file_bytes(path).decode("utf-8"))
        except (ValueError, RecursionError) as error:
            raise CalibrationError(f"must be JSON ({error})", file=path) from error
    parts = {}
    for name in ("sensor", "simulator", "raytac"):
        part = content.get(name, {}) if isinstance(content, dict) else None
        if not isinstance(part, dict) or (name == "sensor" and not part):
            raise CalibrationError("must be an object with its settings", file=path, key=name)
        parts[name] = part
    sensor = dict(parts["sensor"])
    for key, expected in (("num_bins", n_bins), ("h", shape[0]), ("w", shape[1])):
        if sensor.get(key) != expected:
            rule = f"must be {expected}, as the arrays say"
            raise CalibrationError(rule, file=path, key=f"sensor.{key}", value=sensor.get(key, "missing"))
    if not _is_number(sensor.get("pixmm")) or not 1e-6 < sensor["pixmm"] < 1e3:
        rule = "must be the pixel pitch [mm], > 0"
        raise CalibrationError(rule, file=path, key="sensor.pixmm", value=sensor.get("pixmm", "missing"))
    settings = {}
    for key, (default, lowest) in _SETTINGS.items():
        value = parts["simulator"].get(key, default)
        if not _is_number(value) or not lowest <= value <= 1e6:
            raise CalibrationError(f"must be a number >= {lowest}", file=path, key=f"simulator.{key}", value=value)
        settings[key] = float(value)
    for key, (name, default) in _RELATIVE.items():
        pair = parts["simulator"].get(key, (default / shape[1], default / shape[0]))
        if not isinstance(pair, (list, tuple)) or len(pair) != 2 or not all(_is_number(v) and 0 < v <= 10 for v in pair):
            rule = "must be two numbers in (0, 10], shares of the image's width and height"
            raise CalibrationError(rule, file=path, key=f"simulator.{key}", value=pair)
        settings[name] = float(pair[0] * shape[1])
    for key, value in parts["raytac"].items():
        if key not in _OWN or not _OWN[key](value):
            raise CalibrationError(
                "must be a known setting of the right kind", file=path, key=f"raytac.{key}", value=value, choices=_OWN
            )
    own = parts["raytac"]
    return CalibrationParams(
        pixel_pitch=(1e-3 * sensor["pixmm"], 1e-3 * own.get("pixmm_y", sensor["pixmm"])),
        constants=TaximConstants(
            background_sigma=settings["background_sigma"],
            background_share=settings["frame_mixing_percentage"],
            background_threshold=settings["diff_threshold"],
            **{key: own[key] for key in ("ring_dilations", "shadow_sigma", "final_sigma") if key in own},
        ),
        shadow={
            "step": settings["shadow_step"],
            "depth_precision": 1e-3 * settings["height_precision"],
            "direction_precision": settings["discretize_precision"],
            **{key: settings[key] for key in ("fan_angle", "fan_precision")},
            **{key: own[key] for key in ("first_depth", "depth_offset", "depth_of") if key in own},
        },
        slopes_of=own.get("slopes_of", "height"),
        provenance=own.get("provenance") or {"source": path.parent.name, "coverage": "unknown: the folder does not say"},
    )


def _is_number(value: Any) -> bool:
    # Compared, since math.isfinite cannot take an integer beyond the range of float.
    return is_number(value) and abs(value) < 1e300


def params_of(table: PolyTable) -> dict[str, Any]:
    """Content of ``params.json``; the package ``taxim`` then blurs as its first release does.

    (Its own files have two widths swapped.)
    """
    width, height = table.resolution
    constants = table.constants
    shadow = table.shadow or ShadowTable(np.zeros(1), np.zeros((3, 1, 1, 1), np.float32), np.zeros((3, 1, 1), np.int32))

    def relative(length: float) -> list[float]:
        return [length / width, length / height]

    sides = zip(table.pixel_pitch, table.resolution, strict=True)
    pyramid = [[sigma / pitch / pixels for sigma in PYRAMID_SIGMAS] for pitch, pixels in sides]
    return {
        "simulator": {
            "initial_frame_sigma_rel": relative(constants.background_sigma),
            "diff_threshold": constants.background_threshold,
            "frame_mixing_percentage": constants.background_share,
            "shadow_step_rel": relative(shadow.step),
            "discretize_precision": shadow.direction_precision,
            "height_precision": 1e3 * shadow.depth_precision,
            "fan_angle": shadow.fan_angle,
            "fan_precision": shadow.fan_precision,
            "contact_scale": CONTACT_SCALE,
            "deform_pyramid_sigma_rel": pyramid,
            "deform_final_sigma_rel": relative(constants.final_sigma),
            "shadow_blur_sigma_rel": relative(constants.shadow_sigma),
            "shadow_attachment_kernel_size_rel": relative(5.0),
        },
        "sensor": {"pixmm": 1e3 * table.pixel_pitch[0], "num_bins": table.n_bins, "h": height, "w": width},
        "raytac": {
            "slopes_of": table.slopes_of,
            "pixmm_y": 1e3 * table.pixel_pitch[1],
            "first_depth": shadow.first_depth,
            "depth_offset": shadow.depth_offset,
            "depth_of": shadow.depth_of,
            "ring_dilations": constants.ring_dilations,
            "shadow_sigma": constants.shadow_sigma,
            "final_sigma": constants.final_sigma,
            "provenance": dict(table.provenance),
        },
    }
