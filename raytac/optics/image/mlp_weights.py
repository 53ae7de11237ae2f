"""A small network from slope and place to colour: its inputs, its arithmetic, its file.

Zhao, Qian, Duan and Luo, FOTS (RA-L 2024), map normal and position to colour by a network of three hidden layers of 32; Si et al.,
DiffTactile (ICLR 2024), give theirs positions in a frequency code and the direction of view. Here the inputs are

    3 (n_x, n_y, 1 − n_z), 0.3 (u, v), 0.03 (sin, cos) of π u, π v, 2 π u and 2 π v, 0.3 (x, y) of the unit view direction, c,

with n the normal of the surface −displacement, u, v in [−1, 1] over the image and c = 1 where the object touches, else 0 (in neither
paper: the apex of a press and the skirt around it have slopes alike but not colours). The factors hold a network back from learning
places by heart where presses are few. Between layers stands ReLU, and the output is the difference from the image at rest over
``LEVELS``. What it says of a pixel that has not moved is taken off, so that the image at rest is the background exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from raytac.errors import CalibrationError
from raytac.optics.image.network_files import check_header, file_provenance, file_view, header_arrays
from raytac.optics.taxim.restricted_pickle import check_file_numbers, npz_arrays, npz_names
from raytac.specs.sensor import SensorSpec

FORMAT, VERSION = "raytac mlp", 1
"""Format and version of a file; the version counts changes of inputs, arithmetic or arrays."""
INPUTS = 16
LEVELS = 100.0
"""Levels that an output of 1 stands for."""
_LARGEST = 256
"""Widest layer that a file may hold."""


@dataclass(frozen=True)
class MlpWeights:
    """Matrices (out, in), offsets (out,), and the image at rest [levels], (H, W, 3) float32."""

    matrices: tuple[np.ndarray, ...]
    offsets: tuple[np.ndarray, ...]
    background: np.ndarray
    provenance: dict[str, str] = field(default_factory=dict)
    """``sensor`` names the sensor that it was fitted to."""
    view: tuple[float, float] | None = None
    """Width and height of the pad in that sensor's view [m]; None where it is not known."""


def view_slope(sensor: SensorSpec) -> tuple[float, float]:
    """dx/dz and dy/dz of the rays at the image's right and bottom border."""
    camera = sensor.camera
    distance = -camera.position[2]
    return tuple(0.5 * n * p / distance for n, p in zip(camera.resolution, camera.pixel_pitch, strict=True))  # type: ignore[return-value]


def inputs(ops: Any, slope_x: Any, slope_y: Any, touched: Any, u: Any, v: Any, view: tuple[float, float]) -> list[Any]:
    """The ``INPUTS`` arrays of slopes, c (0. or 1.) and places u, v; ``ops``: NumPy or Dr.Jit."""
    nz = 1 / ops.sqrt(slope_x * slope_x + slope_y * slope_y + 1)
    tx, ty = view[0] * u, view[1] * v
    wz = 1 / ops.sqrt(tx * tx + ty * ty + 1)
    codes = [f(k * np.pi * w) for k in (1, 2) for w in (u, v) for f in (ops.sin, ops.cos)]
    normal = [3 * slope_x * nz, 3 * slope_y * nz, 3 * (1 - nz)]
    return [*normal, *(0.3 * w for w in (u, v)), *(0.03 * c for c in codes), 0.3 * tx * wz, 0.3 * ty * wz, touched]


def forward(ops: Any, weights: MlpWeights, x: list[Any]) -> list[Any]:
    """Three outputs of the network for ``INPUTS`` arrays."""
    last = len(weights.matrices) - 1
    for k, (matrix, offset) in enumerate(zip(weights.matrices, weights.offsets, strict=True)):
        rows = [sum((float(w) * a for w, a in zip(row, x, strict=True)), float(b)) for row, b in zip(matrix, offset, strict=True)]
        x = rows if k == last else [ops.maximum(a, 0.0) for a in rows]
    return x


def save_mlp(weights: MlpWeights, path: Path) -> None:
    """Write the network as an ``.npz``."""
    arrays: dict[str, Any] = {f"matrix_{k}": m.astype(np.float32) for k, m in enumerate(weights.matrices)}
    arrays |= {f"offset_{k}": b.astype(np.float32) for k, b in enumerate(weights.offsets)}
    arrays |= header_arrays(FORMAT, VERSION, weights.provenance, weights.view)
    np.savez(path, background=weights.background.astype(np.float32), **arrays)


def load_mlp(path: str | Path) -> MlpWeights:
    """A network of ``save_mlp``: its file, or the folder that holds it; else CalibrationError."""
    path = Path(path)
    path = path / "mlp.npz" if path.is_dir() else path
    if not path.is_file():
        raise CalibrationError("must be a file mlp.npz, or a folder that holds one", file=path)
    check_header(path, FORMAT, VERSION, "`raytac calibrate DATASET --model mlp` fits it again", unmarked="matrix_0")
    count = sum(name.startswith("matrix_") for name in npz_names(path))
    if not 1 <= count <= 16:
        raise CalibrationError("must hold 1 to 16 layers, matrix_0 and on", file=path, value=count)
    arrays = npz_arrays(path, ("background", *(f"{kind}_{k}" for kind in ("matrix", "offset") for k in range(count))))
    width, matrices, offsets = INPUTS, [], []
    for k in range(count):
        shape = arrays[f"matrix_{k}"].shape
        rows = 3 if k == count - 1 else (shape[0] if shape else 0)
        if not 1 <= rows <= _LARGEST:
            raise CalibrationError(f"must have 1 to {_LARGEST} rows", file=path, key=f"matrix_{k}", value=shape)
        matrices.append(check_file_numbers(path, f"matrix_{k}", arrays[f"matrix_{k}"], (rows, width)))
        offsets.append(check_file_numbers(path, f"offset_{k}", arrays[f"offset_{k}"], (rows,)))
        width = rows
    background = arrays["background"]
    if background.ndim != 3 or background.shape[2] != 3 or min(background.shape[:2]) < 3:
        raise CalibrationError("must have shape (H, W, 3)", file=path, key="background", value=background.shape)
    check_file_numbers(path, "background", background, background.shape)
    return MlpWeights(tuple(matrices), tuple(offsets), background.astype(np.float32), file_provenance(path), file_view(path))
