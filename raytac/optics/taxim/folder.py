"""Calibration folders of Taxim: ``load_calibration`` and ``save_calibration``.

=================  ===================================================================================================
``polycalib.npz``  ``bins`` (whole number n), ``grad_r``, ``grad_g``, ``grad_b`` (n, n, 6) float64; named as if images were
                   R, G, B, while they are B, G, R: ``grad_r`` is the blue channel
``dataPack.npz``   ``f0`` (H, W, 3) uint8, B, G, R: the image at rest; the rest of the pack is not read
``gelmap.npy``     (H, W) height of the gel at rest [px], larger is farther from the camera; may be missing
``shadowTable.npz``  ``shadowDirections`` (n_dir,), ``shadowTable`` (3, n_dir, n_depth) objects: lists of numbers; may be missing
``params.json``    ``sensor`` (``pixmm``, ``num_bins``, ``h``, ``w``) and ``simulator``, as the PyPI package ``taxim`` has it
``raytac.npz``     what the files above cannot say of a table of raytac's own: ``background``, ``covered``, and of a table of two sheets
                   ``surround`` and ``gradients``, the coefficients (3, n, n, 6) of pixels that are not touched and of those that are;
                   ``polycalib.npz`` then holds one sheet for both. Settings are in ``params.json`` under ``raytac``
=================  ===================================================================================================

Everything is checked while it is read: kind, shape, size and finiteness. Pickled lists go through ``restricted_pickle``.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from raytac.errors import CalibrationError, InputError
from raytac.io.arrays import npy_bytes
from raytac.io.folder import result_folder
from raytac.optics.taxim.params import params_of, read_params
from raytac.optics.taxim.restricted_pickle import check_file_numbers, file_bytes, npy_array, npz_arrays, npz_names
from raytac.optics.taxim.table import PolyTable, ShadowTable, TaximConstants

CALIBRATION_FILES = ("polycalib.npz", "dataPack.npz", "gelmap.npy", "shadowTable.npz", "params.json", "raytac.npz")
_MOST_BINS = 1024
"""Bins a side of a table; upstream's have 80 to 125."""
_MOST_PIXELS = 2**23
"""Pixels of an image at rest."""
_HEADER = 2**16
"""Bytes that the header of an array may have."""
_BGR = ("b", "g", "r")
"""Upstream's names of the channels red, green, blue."""


def load_calibration(folder: str | Path, pixel_pitch: float | None = None) -> PolyTable:
    """Table of a calibration folder: upstream's, or one that ``save_calibration`` wrote.

    ``pixel_pitch`` [m] stands in for ``params.json``, which the folders of the first release lack. Of ``simulator``, the settings of
    background and shadow rays are read; the two blur widths are not, since the package's files have them swapped (docs). Raises
    CalibrationError for a file that is missing, damaged, or of the wrong kind, shape or range.
    """
    folder = Path(folder)
    absent = [name for name in ("polycalib.npz", "dataPack.npz") if not (folder / name).is_file()]
    if absent:
        rule = f"must be a folder with polycalib.npz, dataPack.npz and mostly params.json; absent: {', '.join(absent)}"
        raise CalibrationError(rule, file=folder)
    if pixel_pitch is not None and not (math.isfinite(pixel_pitch) and pixel_pitch > 0):
        raise InputError("pixel_pitch", value=pixel_pitch, rule="must be finite and > 0 [m]")
    gradients = _gradients(folder / "polycalib.npz")
    f0 = _image(folder / "dataPack.npz")
    params = read_params(folder / "params.json", pixel_pitch, gradients.shape[1], f0.shape)
    gel_map = _gel_map(folder / "gelmap.npy", f0.shape[:2]) if (folder / "gelmap.npy").exists() else None
    shadow = _shadow(folder / "shadowTable.npz", params.shadow) if (folder / "shadowTable.npz").exists() else None
    own: dict[str, np.ndarray] = {}
    if (folder / "raytac.npz").exists():
        own = _own_arrays(folder / "raytac.npz", gradients.shape[1], f0.shape)
    try:
        return PolyTable(
            gradients=own.get("gradients", gradients),
            covered=own.get("covered"),
            background=own["background"] if own else processed_background(f0, params.constants),
            pixel_pitch=params.pixel_pitch,
            shadow=shadow,
            slopes_of=params.slopes_of,
            rest_image=f0,
            gel_map=gel_map,
            surround=own.get("surround"),
            one_sheet=gradients if "gradients" in own else None,
            constants=params.constants,
            provenance=params.provenance,
        )
    except InputError as error:
        raise CalibrationError(str(error), file=folder) from error


def processed_background(f0: np.ndarray, constants: TaximConstants) -> np.ndarray:
    """Upstream's background from the image at rest: (H, W, 3) uint8 to float32 of whole levels.

    Blurred by a Gaussian (cut at 4 σ, border reflected), truncated to whole levels; where blurred − sharp, averaged over the
    channels, stays below the threshold, the mix share · blurred + (1 − share) · sharp, truncated too. Elsewhere, in dark dots, the
    blurred image remains.
    """
    sharp = f0.astype(np.float64)
    rows, columns = (_blur_matrix(n, constants.background_sigma) for n in f0.shape[:2])
    blurred = np.stack([rows @ sharp[..., c] @ columns.T for c in range(3)], axis=-1)
    # Rounding of the matrix product must not decide a truncation: a flat image stays as it is.
    blurred = np.floor(blurred + 1e-9)
    share = constants.background_share
    mixed = np.floor(share * blurred + (1 - share) * sharp)
    below = (blurred - sharp).mean(axis=2, keepdims=True) < constants.background_threshold
    return np.where(below, mixed, blurred).astype(np.float32)


def _blur_matrix(n: int, sigma: float) -> np.ndarray:
    """(n, n): Gaussian cut at 4 σ on n pixels, mirrored at the border, edge pixel included."""
    radius = int(4 * sigma + 0.5)
    offset = np.arange(-radius, radius + 1)
    weights = np.exp(-0.5 * (offset / sigma) ** 2)
    weights /= weights.sum()
    # The mirrored line repeats after 2n pixels, so a kernel of any width folds into one period.
    folded = np.zeros(2 * n)
    np.add.at(folded, offset % (2 * n), weights)
    place = (np.arange(n)[:, None] + np.arange(2 * n)) % (2 * n)
    matrix = np.zeros((n, n))
    np.add.at(matrix, (np.arange(n)[:, None], np.where(place >= n, 2 * n - 1 - place, place)), folded[None, :])
    return matrix


def _bytes(*shape: int) -> int:
    """Most bytes of an array of float64."""
    return 8 * math.prod(shape) + _HEADER


def _gradients(path: Path) -> np.ndarray:
    bins = npz_arrays(path, ("bins",), _HEADER)["bins"]
    if bins.size != 1 or bins.dtype.kind not in "iu" or not 2 <= int(bins.reshape(())) <= _MOST_BINS:
        raise CalibrationError(f"must be one whole number in [2, {_MOST_BINS}]", file=path, key="bins", value=str(bins)[:40])
    n = int(bins.reshape(()))
    arrays = npz_arrays(path, tuple(f"grad_{c}" for c in _BGR), _bytes(n, n, 6))
    for c in _BGR:
        check_file_numbers(path, f"grad_{c}", arrays[f"grad_{c}"], (n, n, 6))
    return np.stack([arrays[f"grad_{c}"].astype(np.float64) for c in _BGR])


def _image(path: Path) -> np.ndarray:
    f0 = npz_arrays(path, ("f0",), 3 * _MOST_PIXELS + _HEADER)["f0"]
    if f0.ndim != 3 or f0.shape[2] != 3 or f0.dtype != np.uint8 or min(f0.shape) < 3 or max(f0.shape) > 8192:
        rule = f"must be a uint8 image of shape (H, W, 3), 3 to 8192 pixels a side and at most {_MOST_PIXELS} in all"
        raise CalibrationError(rule, file=path, key="f0", value=f"{f0.dtype} {f0.shape}")
    return np.ascontiguousarray(f0[..., ::-1])


def _gel_map(path: Path, shape: tuple[int, int]) -> np.ndarray:
    data = file_bytes(path)
    return check_file_numbers(path, "", npy_array(path, "", data), shape).astype(np.float64)


def _own_arrays(path: Path, n: int, shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    """``background``, and those of ``covered``, ``surround`` and ``gradients`` that are there."""
    names = npz_names(path)
    arrays = npz_arrays(path, ("background",), _bytes(*shape))
    arrays |= npz_arrays(path, tuple(name for name in ("covered", "surround", "gradients") if name in names), _bytes(3, n, n, 6))
    if "gradients" in arrays and "surround" not in arrays:
        raise CalibrationError("must come with the array 'surround'", file=path, key="gradients", value=arrays["gradients"].shape)
    for name in {"surround", "gradients"} & set(arrays):
        arrays[name] = check_file_numbers(path, name, arrays[name], (3, n, n, 6)).astype(np.float64)
    covered = arrays.get("covered")
    if covered is not None and (covered.shape != (n, n) or covered.dtype != np.bool_):
        value = f"{covered.dtype} {covered.shape}"
        raise CalibrationError(f"must be bool of shape {(n, n)}", file=path, key="covered", value=value)
    return arrays | {"background": check_file_numbers(path, "background", arrays["background"], shape).astype(np.float32)}


def _shadow(path: Path, settings: dict[str, Any]) -> ShadowTable:
    arrays = npz_arrays(path, ("shadowDirections", "shadowTable"))
    directions, lists = arrays["shadowDirections"], arrays["shadowTable"]
    if directions.ndim != 1 or not 1 <= len(directions) <= 4096:
        raise CalibrationError("must have shape (n_dir,)", file=path, key="shadowDirections", value=directions.shape)
    check_file_numbers(path, "shadowDirections", directions, directions.shape)
    if lists.ndim != 3 or lists.shape[:2] != (3, len(directions)) or not 1 <= lists.shape[2] <= 4096:
        rule = f"must have shape (3, {len(directions)}, n_depth), as shadowDirections says"
        raise CalibrationError(rule, file=path, key="shadowTable", value=lists.shape)
    rows = {place: _numbers(path, place, lists[place]) for place in np.ndindex(*lists.shape)}
    lengths = np.array([len(rows[place]) for place in np.ndindex(*lists.shape)], dtype=np.int32).reshape(lists.shape)
    if lengths.max() > 4096:
        raise CalibrationError("lists must have at most 4096 values", file=path, key="shadowTable", value=int(lengths.max()))
    values = np.zeros((*lists.shape, max(1, int(lengths.max()))), dtype=np.float32)
    for place, row in rows.items():
        values[place][: len(row)] = row
    values, lengths = (np.ascontiguousarray(array[::-1]) for array in (values, lengths))
    try:
        return ShadowTable(directions.astype(np.float64), values, lengths, **settings)
    except InputError as error:
        raise CalibrationError(str(error), file=path) from error


def _numbers(path: Path, place: tuple[int, ...], row: Any) -> np.ndarray:
    key = f"shadowTable[{', '.join(map(str, place))}]"
    try:
        array = np.asarray(row, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.zeros(())
    if array.ndim != 1 or not isinstance(row, (list, tuple, np.ndarray)):
        raise CalibrationError("must be a list of numbers", file=path, key=key, value=row)
    if not np.isfinite(array).all() or np.abs(array).max(initial=0) > 1e6:
        raise CalibrationError("must be finite, at most 10^6", file=path, key=key, value=row)
    return array


def save_calibration(table: PolyTable, folder: str | Path) -> None:
    """Write ``table`` as a folder for ``load_calibration`` and for the package ``taxim``."""
    rest = np.clip(np.rint(table.background), 0, 255).astype(np.uint8) if table.rest_image is None else table.rest_image
    with result_folder(Path(folder), CALIBRATION_FILES) as work:
        for_one = table.gradients if table.one_sheet is None else table.one_sheet
        gradients: dict[str, Any] = {f"grad_{c}": for_one[k] for k, c in enumerate(_BGR)}
        np.savez(work / "polycalib.npz", bins=np.int64(table.n_bins), **gradients)
        np.savez(work / "dataPack.npz", f0=rest[..., ::-1], img_size=np.array(rest.shape))
        (work / "gelmap.npy").write_bytes(npy_bytes(np.zeros(rest.shape[:2]) if table.gel_map is None else table.gel_map))
        names = ("covered", "surround") if table.one_sheet is None else ("covered", "surround", "gradients")
        own: dict[str, Any] = {name: getattr(table, name) for name in names if getattr(table, name) is not None}
        np.savez(work / "raytac.npz", background=table.background.astype(np.float32), **own)
        if table.shadow is not None:
            _save_shadow(work / "shadowTable.npz", table.shadow)
        (work / "params.json").write_text(json.dumps(params_of(table), indent=2) + "\n", encoding="utf-8")


def _save_shadow(path: Path, shadow: ShadowTable) -> None:
    lists = np.empty(shadow.lengths.shape, dtype=object)
    for place in np.ndindex(*lists.shape):
        lists[place] = [float(v) for v in shadow.values[place][: shadow.lengths[place]]]
    arrays: dict[str, Any] = {"shadowDirections": shadow.directions, "shadowTable": lists[::-1]}
    np.savez(path, **arrays)
