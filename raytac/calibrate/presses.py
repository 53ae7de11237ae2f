"""Real images of ball presses: a folder of photographs, or one of three published layouts.

- a folder with ``background.png`` and a PNG a press, of any names, all of one ball. Circles are searched for; those of a ``circles.csv``
  (columns ``press``, the file's name without its end, ``cx_px``, ``cy_px``, ``r_px``) are taken instead, as ``raytac calibrate`` writes it.
- ``labels.csv`` (columns ``diameter``, ``index``, ``cx_px``, ``cy_px``, ``r_px``, and perhaps ``edge_score``, ``fully_visible``) beside
  ``background.png`` and ``DIAMETER_INDEX.png``, such as ``6.310mm_07.png``.
- ``catalog.csv`` (columns ``experiment_reldir``, ``diameter(mm)``) beside ``background.png`` and one folder a press, such as
  ``6.310mm/7/gelsight.png``: what the calibration scripts of gs_sdk write. It has no circles.
- a Taxim ``dataPack.npz``, or the folder that holds it: ``f0`` and ``imgs`` in B, G, R, ``touch_center`` and ``touch_radius`` [px]. It does
  not say how large the ball is.

Everything is checked when it is read and refused with file and rule.
"""

from __future__ import annotations

import csv
import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from raytac.errors import CalibrationError, InputError
from raytac.io.images import read_png
from raytac.optics.taxim.restricted_pickle import npz_arrays

LAYOUTS = ("labels.csv", "catalog.csv", "dataPack.npz", "background.png")
"""The file that tells a layout; where several are there, the first counts."""


@dataclass(frozen=True)
class RealPresses:
    """N images of ball presses and one of the untouched sensor, as the camera gave them."""

    background: np.ndarray
    """Untouched sensor, (H, W, 3) uint8."""
    images: np.ndarray
    """Presses, (N, H, W, 3) uint8."""
    ball_radius: np.ndarray
    """Radius of each press's ball [m], (N,)."""
    circles: np.ndarray
    """Contact circle of each press: centre x, y and radius [px], (N, 3); NaN without one."""
    names: tuple[str, ...]
    """Name of each press, for messages and figures."""

    def __len__(self) -> int:
        return len(self.images)

    @property
    def resolution(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self.background.shape[1], self.background.shape[0]

    @property
    def fully_visible(self) -> np.ndarray:
        """Mask (N,) of the circles that lie in the image; False where the circle is unknown."""
        return in_image(self.circles, self.resolution)

    def take(self, index: np.ndarray) -> RealPresses:
        """The presses at ``index``, whole numbers or a mask (N,)."""
        index = np.flatnonzero(index) if np.asarray(index).dtype == bool else np.asarray(index)
        return dataclasses.replace(
            self,
            images=self.images[index],
            ball_radius=self.ball_radius[index],
            circles=self.circles[index],
            names=tuple(self.names[k] for k in index),
        )

    def with_circles(self, circles: np.ndarray) -> RealPresses:
        """The same presses with other circles (N, 3)."""
        return dataclasses.replace(self, circles=np.asarray(circles, dtype=float))


def in_image(circles: np.ndarray, resolution: tuple[int, int]) -> np.ndarray:
    """Mask (N,) of circles (N, 3) [px] that lie in an image of (width, height) whole."""
    (width, height), (x, y, r) = resolution, circles.T
    return (x - r >= 0) & (y - r >= 0) & (x + r <= width) & (y + r <= height)


def read_presses(data: Path | str, *, ball_diameter: float | None = None) -> RealPresses:
    """All presses of a data set, those at the border included.

    Args:
        data: a folder of one of the layouts, or a ``dataPack.npz``.
        ball_diameter: [m]; needed by plain photographs and a ``dataPack.npz``, which do not say it, and refused elsewhere.

    Raises:
        InputError: no such folder, none of the layouts, or a ball diameter where it is not needed, missing or not positive.
        CalibrationError: a file that is missing or malformed, an image of another size, no press at all.
    """
    data = Path(data)
    if not data.exists():
        raise InputError("data", value=str(data), rule="must exist")
    if ball_diameter is not None and not (math.isfinite(ball_diameter) and ball_diameter > 0):
        raise InputError("ball_diameter", value=ball_diameter, rule="must be a length > 0 [m]")
    is_plain = False
    if data.is_dir():
        matching = [name for name in LAYOUTS if (data / name).exists()]
        if not matching:
            rule = "must hold one of the files that tell a layout; plain photographs are PNGs beside background.png"
            raise InputError("data", value=str(data), rule=rule, choices=LAYOUTS)
        data, is_plain = data / matching[0], matching[0] == LAYOUTS[-1]
    if data.name.endswith(".npz") or is_plain:
        if ball_diameter is None:
            what = f"{data.parent} has photographs alone and" if is_plain else data.name
            raise InputError(
                "ball_diameter", rule=f"must be given (--ball-diameter-mm): {what} does not say how large the ball is"
            )
        presses = (_read_photographs if is_plain else _read_pack)(data, ball_diameter / 2)
    elif ball_diameter is not None:
        raise InputError("ball_diameter", value=ball_diameter, rule=f"must not be given: {data.name} says it for every press")
    elif data.name == "labels.csv":
        presses = _read_labels(data)
    elif data.name == "catalog.csv":
        presses = _read_catalog(data)
    else:
        raise InputError("data", value=str(data), rule="must be a folder or an .npz file of presses", choices=LAYOUTS)
    if not len(presses):
        raise CalibrationError("must hold at least one press", file=data)
    return presses


def _read_labels(path: Path) -> RealPresses:
    rows = _rows(path, ("diameter", "index", "cx_px", "cy_px", "r_px"))
    files, radii, circles = [], [], []
    for number, row in enumerate(rows, start=2):
        diameter, centre = row["diameter"], [_number(path, number, key, row[key]) for key in ("cx_px", "cy_px")]
        radii.append(_number(path, number, "diameter", diameter.removesuffix("mm"), positive=True) / 2e3)
        index = _number(path, number, "index", row["index"])
        if index != int(index) or index < 0:
            raise CalibrationError("must be a whole number >= 0", file=path, key=f"line {number}, index", value=row["index"])
        files.append(path.parent / f"{diameter}_{int(index):02d}.png")
        centre = [_number(path, number, key, row[key]) for key in ("cx_px", "cy_px")]
        circles.append([*centre, _number(path, number, "r_px", row["r_px"], positive=True)])
    return _from_files(path.parent, files, radii, np.array(circles).reshape(-1, 3))


def _read_catalog(path: Path) -> RealPresses:
    rows = _rows(path, ("experiment_reldir", "diameter(mm)"))
    files, radii = [], []
    for number, row in enumerate(rows, start=2):
        files.append(path.parent / row["experiment_reldir"] / "gelsight.png")
        radii.append(_number(path, number, "diameter(mm)", row["diameter(mm)"], positive=True) / 2e3)
    return _from_files(path.parent, files, radii, np.full((len(files), 3), np.nan))


def _read_photographs(background: Path, ball_radius: float) -> RealPresses:
    folder = background.parent
    files = sorted(path for path in folder.glob("*.png") if path.name != background.name)
    circles = {path.stem: [math.nan] * 3 for path in files}
    table = folder / "circles.csv"
    if table.exists():
        for number, row in enumerate(_rows(table, ("press", "cx_px", "cy_px", "r_px")), start=2):
            name = row["press"]
            if name not in circles:
                rule = "must be a photograph's name without .png"
                raise CalibrationError(rule, file=table, key=f"line {number}, press", value=name, choices=list(circles))
            centre = [_number(table, number, key, row[key]) for key in ("cx_px", "cy_px")]
            circles[name] = [*centre, _number(table, number, "r_px", row["r_px"], positive=True)]
    return _from_files(folder, files, [ball_radius] * len(files), np.array(list(circles.values())).reshape(-1, 3))


def _read_pack(path: Path, ball_radius: float) -> RealPresses:
    keys = ("f0", "imgs", "touch_center", "touch_radius")
    pack = npz_arrays(path, keys)
    background, images, centre, radius = (pack[key] for key in keys)
    if background.ndim != 3 or background.shape[2] != 3 or background.dtype != np.uint8:
        rule = "must be one uint8 image, (H, W, 3)"
        raise CalibrationError(rule, file=path, key="f0", value=f"{background.dtype} {background.shape}")
    if images.shape[1:] != background.shape or images.dtype != np.uint8:
        rule = f"must be uint8 images of the size of f0, (N, {background.shape[0]}, {background.shape[1]}, 3)"
        raise CalibrationError(rule, file=path, key="imgs", value=f"{images.dtype} {images.shape}")
    count = len(images)
    for key, array, shape in (("touch_center", centre, (count, 2)), ("touch_radius", radius, (count,))):
        if array.shape != shape or array.dtype.kind not in "iuf" or not np.isfinite(array).all():
            raise CalibrationError(f"must be finite numbers {shape}", file=path, key=key, value=f"{array.dtype} {array.shape}")
    if (radius <= 0).any():
        raise CalibrationError("must be > 0", file=path, key="touch_radius", value=float(radius.min()))
    circles = np.column_stack([centre, radius]).astype(float)
    names = tuple(f"{k:02d}" for k in range(count))
    return RealPresses(background[..., ::-1].copy(), images[..., ::-1].copy(), np.full(count, ball_radius), circles, names)


def _rows(path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    """Rows of a table with at least these columns."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            table = csv.DictReader(file)
            missing = [name for name in columns if name not in (table.fieldnames or ())]
            if missing:
                raise CalibrationError(
                    f"must have the column {missing[0]!r}", file=path, choices=[n for n in table.fieldnames or () if n]
                )
            rows = list(table)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"cannot be read ({error})", file=path) from error
    for number, row in enumerate(rows, start=2):
        empty = [name for name in columns if not row[name]]
        if empty:
            raise CalibrationError("must not be empty", file=path, key=f"line {number}, {empty[0]}", value=row[empty[0]])
    return rows


def _number(path: Path, line: int, key: str, text: str, *, positive: bool = False) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or (positive and value <= 0):
        rule = "must be a finite number" + (" > 0" if positive else "")
        raise CalibrationError(rule, file=path, key=f"line {line}, {key}", value=text)
    return value


def _from_files(folder: Path, files: list[Path], radii: list[float], circles: np.ndarray) -> RealPresses:
    background = _image(folder / "background.png", None)
    images = [_image(file, background.shape) for file in files]
    stack = np.stack(images) if images else np.empty((0, *background.shape), np.uint8)
    names = tuple(str(file.relative_to(folder).with_suffix("")).removesuffix("/gelsight") for file in files)
    return RealPresses(background, stack, np.array(radii), circles, names)


def _image(path: Path, shape: tuple[int, ...] | None) -> np.ndarray:
    try:
        pixels = read_png(path)
    except OSError as error:
        reason = "is missing" if isinstance(error, FileNotFoundError) else f"cannot be read as an image ({error})"
        raise CalibrationError(reason, file=path) from error
    if shape is not None and pixels.shape != shape:
        rule = f"must have the size of background.png, {shape[1]} x {shape[0]}"
        raise CalibrationError(rule, file=path, value=f"{pixels.shape[1]} x {pixels.shape[0]}")
    return pixels


Split = tuple[np.ndarray, np.ndarray]
"""Indices of the presses to fit to and of those to test on."""


def by_press(count: int, folds: int) -> list[Split]:
    """Splits into ``folds``: fold k tests every ``folds``-th of ``count`` presses from the k-th.

    So neighbours of a scan are apart. ``folds = count`` leaves one out. Raises InputError for fewer than two folds, or more folds than
    presses.
    """
    if int(folds) != folds or not 2 <= folds <= count:
        raise InputError("folds", value=folds, rule=f"must be a whole number from 2 to the number of presses, {count}")
    index = np.arange(count)
    return [(index[index % folds != k], index[index % folds == k]) for k in range(folds)]


def by_half(presses: RealPresses) -> list[Split]:
    """Splits from the pad's left half to the right, and back; InputError for an empty half."""
    in_left_half = _known(presses)[:, 0] < presses.resolution[0] / 2
    if in_left_half.all() or not in_left_half.any():
        raise InputError("presses", value=f"{len(presses)} presses", rule="must lie on both halves of the image")
    a, b = np.flatnonzero(in_left_half), np.flatnonzero(~in_left_half)
    return [(a, b), (b, a)]


def shallow_to_deep(presses: RealPresses, share: float = 0.5) -> Split:
    """Split from the shallower ``share`` of presses to the deeper; InputError for an empty side."""
    relative = _known(presses)[:, 2] / presses.ball_radius
    order, cut = np.argsort(relative, kind="stable"), round(share * len(presses))
    if not 0 < cut < len(presses):
        raise InputError("share", value=share, rule=f"must leave a press on either side of {len(presses)}")
    return np.sort(order[:cut]), np.sort(order[cut:])


def _known(presses: RealPresses) -> np.ndarray:
    unknown = int(np.isnan(presses.circles).any(axis=1).sum())
    if unknown:
        raise InputError("presses", value=f"{unknown} of {len(presses)} without a circle", rule="must all have a contact circle")
    return presses.circles
