"""Reads sweeps from TOML: the schema of ``scenes/sweeps/*.toml``."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from raytac.specs.files import find_file
from raytac.specs.press import PADS, PHYSICS
from raytac.specs.press_file import load_press
from raytac.specs.sensor_file import load_sensor
from raytac.specs.sweep import PressRanges, SweepSpec
from raytac.specs.toml import ANY, Integer, Number, Schema, Table, Text, read_toml

__all__ = ["MARKER_NOISE_SCHEMA", "RANDOMIZATION_SCHEMA", "RANGE_SCHEMA", "SWEEP_SCHEMA", "load_sweep"]

SWEEP_SCHEMA: Final[Schema] = {
    "sensors": Text(length=ANY, default=("gelsight_mini",)),
    "objects": Text(length=ANY),
    "count": Integer("[1, 1000000000]"),
    "shard_size": Integer("[1, 100000]", default=256),
    "seed": Integer("[0, 4294967295]", default=0),
    "physics": Text(choices=PHYSICS, default="rigid"),
    "pad": Text(choices=PADS, default=None),
    "optics": Text(default="taxim"),
    "outputs": Text(length=ANY, default=("rgb", "height", "wrench")),
    "markers": Text(default=None),
    "resolution": Integer("[1, 8192]", length=2, default=None),
    "pitch_mm": Number("[0.01, 5]", default=None),
    "variants": Integer("[1, 10000]", default=1),
}
"""Keys at the top of a sweep."""

RANGE_SCHEMA: Final[Schema] = {
    "depth_mm": Number("(0, 50]", length=2),
    "x_mm": Number("[-100, 100]", length=2, default=(0.0, 0.0)),
    "y_mm": Number("[-100, 100]", length=2, default=(0.0, 0.0)),
    "yaw_deg": Number("[-360, 360]", length=2, default=(0.0, 0.0)),
    "tilt_deg": Number("[0, 180]", length=2, default=(0.0, 0.0)),
    "shear_mm": Number("[0, 50]", length=2, default=(0.0, 0.0)),
    "twist_deg": Number("[-180, 180]", length=2, default=(0.0, 0.0)),
}
"""Keys of ``[press]``: least and greatest value."""

_WIDTH = Number("[0, 1)", default=None)
RANDOMIZATION_SCHEMA: Final[Schema] = {
    "led_power": _WIDTH,
    "led_colour": _WIDTH,
    "reflectance": _WIDTH,
    "youngs_modulus": _WIDTH,
    "friction": _WIDTH,
    "exposure": _WIDTH,
    "white_balance": _WIDTH,
    "gamma": _WIDTH,
    "noise": Number("[0, 255]", default=None),
}
"""Keys of ``[randomization]``: those of ``raytac.observe.Randomization``."""

MARKER_NOISE_SCHEMA: Final[Schema] = {
    "noise_px": Number("[0, 100]", default=None),
    "dropout": Number("[0, 1)", default=None),
    "shift_mm": Number("[0, 20]", default=None),
    "turn_deg": Number("[0, 180]", default=None),
}
"""Keys of ``[randomization.markers]``: those of ``raytac.markers.MarkerPerturbation``."""


def load_sweep(name_or_path: str | Path) -> SweepSpec:
    """Read and check a sweep, with the sensors and press scenes that it names.

    Args:
        name_or_path: shipped name such as ``"demo"``, or path of a TOML file (see ``scenes/README.md``); paths of sensors and scenes in
            it are relative to it.

    Raises:
        SpecError: unknown name, unreadable file, unknown or missing key, wrong type, value out of range, or a range whose ends are
            the wrong way round; or as ``load_sensor`` and ``load_press``.
    """
    path = find_file("sweep", name_or_path)
    top = read_toml(path)
    values = top.read(SWEEP_SCHEMA, sections=("press", "randomization"))
    sensors = tuple(load_sensor(find_file("sensor", name, base=path.parent)) for name in values.pop("sensors"))
    objects = tuple(load_press(find_file("press scene", name, base=path.parent)) for name in values.pop("objects"))
    for scene, name in zip(objects, top.data["objects"], strict=True):
        if scene.object.kind == "none":
            raise top.error("must be press scenes with an object", "objects", name)
    for what, specs in (("sensors", sensors), ("objects", objects)):
        names = [spec.name for spec in specs]
        if len(set(names)) != len(names):
            raise top.error(
                "must have names of their own: the data set tells them apart by the stems of their files", what, names
            )
    if values["pad"] is not None and values["physics"] != "ipc":
        raise top.error('is how finely a simulated pad is cut, so physics must be "ipc"', "pad", values["pad"])
    randomization, markers = _read_randomization(top)
    return SweepSpec(
        path.stem,
        sensors,
        objects,
        ranges=_read_ranges(top.section("press")),
        randomization=randomization,
        marker_perturbation=markers,
        source=path,
        **values,
    )


def _read_ranges(table: Table) -> PressRanges:
    values = table.read(RANGE_SCHEMA)
    for key, (low, high) in zip(RANGE_SCHEMA, values.values(), strict=True):
        if low > high:
            raise table.error("must be the least and the greatest value, in this order", key, table.data[key])
    return PressRanges(**values)


def _read_randomization(top: Table) -> tuple[dict[str, float], dict[str, float]]:
    if "randomization" not in top.data:
        return {}, {}
    table = top.section("randomization")
    values = table.read(RANDOMIZATION_SCHEMA, sections=("markers",))
    markers = table.section("markers").read(MARKER_NOISE_SCHEMA) if "markers" in table.data else {}
    if "noise" in markers:
        markers["noise_px"] = markers.pop("noise")
    return ({k: v for k, v in found.items() if v is not None} for found in (values, markers))  # type: ignore[return-value]
