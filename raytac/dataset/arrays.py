"""Arrays and columns of a press in a data set: names, types, shapes, units and frames."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

DATASET_OUTPUTS = ("rgb", "normals", "depth", "height", "contact", "wrench", "traction")
"""Names that ``outputs`` of a sweep accepts."""


@dataclass(frozen=True)
class ArrayKind:
    """One array of a shard, of one press; the press is the first axis."""

    dtype: str
    shape: tuple[int | str, ...]
    """Numbers, or H, W of the image, Ny, Nx of the pad's grid, M markers, T frames."""
    unit: str
    meaning: str
    needs: str = ""
    """Output that it comes with, ``markers``, ``video``, or nothing: always there."""
    changes: bool = True
    """True if a video has one of every frame; else it has one in all."""

    def is_kept(self, outputs: Collection[str], markers: bool = False, video: bool = False) -> bool:
        """True if a sweep with these outputs keeps it."""
        extra = {"markers": markers, "video": video}
        return self.needs == "" or self.needs in outputs or extra.get(self.needs, False)


ARRAYS: dict[str, ArrayKind] = {
    "index": ArrayKind("int64", (), "", "number of the press in the data set", changes=False),
    "rgb": ArrayKind("uint8", ("H", "W", 3), "0-255", "image after the camera's response; row 0 is pad-frame -y", "rgb"),
    "normals": ArrayKind(
        "float32", ("H", "W", 3), "", "unit normal of the coat towards the camera (n_z < 0), pad frame", "normals"
    ),
    "depth": ArrayKind("float32", ("H", "W"), "m", "camera-axis depth of the coat, z - z_camera", "depth"),
    "height": ArrayKind(
        "float32",
        ("Ny", "Nx"),
        "m",
        "z of the deformed coat, pad frame, at grid_x, grid_y; rest_height - height is the indentation",
        "height",
    ),
    "contact": ArrayKind("bool", ("Ny", "Nx"), "", "where the object touches, at grid_x, grid_y", "contact"),
    "traction": ArrayKind(
        "float32", ("Ny", "Nx", 3), "Pa", "force of the object on the pad per area, pad frame, at grid_x, grid_y", "traction"
    ),
    "wrench": ArrayKind(
        "float64",
        (6,),
        "N, N m",
        "force of the object on the pad, and its torque about the pad frame's origin, pad frame",
        "wrench",
    ),
    "markers": ArrayKind(
        "float32", ("M", 2), "m", "displacement of the markers along x, y of the pad frame; NaN where one is lost", "markers"
    ),
    "markers_px": ArrayKind(
        "float32", ("M", 2), "px", "displacement of the markers along u, v of the image; NaN likewise", "markers"
    ),
    "markers_rest": ArrayKind("float32", ("M", 3), "m", "places of the markers at rest, pad frame", "markers", changes=False),
    "markers_rest_px": ArrayKind(
        "float32", ("M", 2), "px", "places of the markers at rest in the image", "markers", changes=False
    ),
    "marker_visible": ArrayKind("bool", ("M",), "", "whether the tracker finds the marker", "markers"),
    "pad_from_object": ArrayKind("float64", (4, 4), "m", "pose of the object when the image is taken, pad frame"),
    "travel": ArrayKind(
        "float64", (), "m", "travel of the object below first touch when the image is taken, negative above it", "video"
    ),
}
"""By name."""


def press_arrays(outputs: Collection[str], *, markers: bool, video: bool) -> dict[str, ArrayKind]:
    """Arrays of a press that a sweep keeps; those that change have T frames first in a video."""
    kept = {name: kind for name, kind in ARRAYS.items() if kind.is_kept(outputs, markers, video)}
    if not video:
        return kept
    return {name: replace(kind, shape=("T", *kind.shape)) if kind.changes else kind for name, kind in kept.items()}


SHARED: dict[str, ArrayKind] = {
    "grid_x": ArrayKind("float64", ("Nx",), "m", "x of the columns of height, contact and traction, pad frame"),
    "grid_y": ArrayKind("float64", ("Ny",), "m", "y of their rows, pad frame"),
    "rest_height": ArrayKind("float32", ("Ny", "Nx"), "m", "z of the coat that nothing touches, pad frame"),
    "rest_rgb": ArrayKind(
        "uint8", ("H", "W", 3), "0-255", "image of the pad that nothing touches, without camera randomisation", "rgb"
    ),
}
"""Arrays that a shard holds once for all its presses, which are of one sensor."""


@dataclass(frozen=True)
class Column:
    """One column of the manifest."""

    type: str
    unit: str
    meaning: str


_FORCE = "of the force of the object on the pad, pad frame"
_TORQUE = "of its torque about the pad frame's origin"
COLUMNS: dict[str, Column] = {
    "index": Column("int64", "", "number of the press in the data set"),
    "status": Column("string", "", "ok, or failed: then no shard holds it"),
    "reason": Column("string", "", "why it failed; empty if it did not"),
    "shard": Column("string", "", "file that holds its arrays; empty if it failed"),
    "row": Column("int32", "", "its place along the first axis there; -1 if it failed"),
    "sensor": Column("string", "", "name of the sensor"),
    "variant": Column("int32", "", "number of the sensor's drawn copy"),
    "object": Column("string", "", "press scene whose object was pressed"),
    "seed": Column("int64", "", "of noise in its image and markers"),
    "press_depth": Column("float64", "m", "travel below first touch"),
    "x": Column("float64", "m", "added to the place of the scene's object, pad frame"),
    "y": Column("float64", "m", "likewise"),
    "yaw": Column("float64", "rad", "turn of the object about +z, before the lean"),
    "tilt": Column("float64", "rad", "lean of the object away from +z"),
    "tilt_direction": Column("float64", "rad", "where its upper end leans to, from +x to +y"),
    "shear_x": Column("float64", "m", "sideways displacement after the indent, pad frame"),
    "shear_y": Column("float64", "m", "likewise"),
    "twist": Column("float64", "rad", "turn about +z after that"),
    "force_x": Column("float64", "N", f"x {_FORCE}; null without the output wrench, as for the next seven"),
    "force_y": Column("float64", "N", f"y {_FORCE}"),
    "force_z": Column("float64", "N", f"z {_FORCE}: negative when pressing"),
    "torque_x": Column("float64", "N m", f"x {_TORQUE}"),
    "torque_y": Column("float64", "N m", f"y {_TORQUE}"),
    "torque_z": Column("float64", "N m", f"z {_TORQUE}"),
    "contact_area": Column("float64", "m2", "area that is touched"),
    "contact_cells": Column(
        "float64",
        "",
        "width of the contact in cells of a soft pad; below 6 its force at a depth is too large; null if rigid",
    ),
    "indentation_max": Column("float64", "m", "how far the coat lies below its place at rest, at most"),
    "shard_sha256": Column("string", "", "of the file"),
}
"""By name, in order."""
