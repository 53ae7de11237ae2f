"""Reads sweeps from TOML: ``scenes/sweeps/*.toml``."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from raytac.errors import SpecError
from raytac.specs.files import find_file, name_of
from raytac.specs.press_file import load_press
from raytac.specs.sensor_file import load_sensor
from raytac.specs.sweep import RANGE_SCHEMA, SWEEP_SCHEMA, PressRanges, SweepSpec
from raytac.specs.toml import Number, Schema, Table, read_toml

__all__ = ["MARKER_NOISE_SCHEMA", "RANDOMIZATION_SCHEMA", "load_sweep"]

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
        name_of(path),
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
    try:
        return PressRanges(**values)
    except SpecError as error:
        raise SpecError(error.rule, file=table.file, key=error.key, value=error.value) from None


def _read_randomization(top: Table) -> tuple[dict[str, float], dict[str, float]]:
    if "randomization" not in top.data:
        return {}, {}
    table = top.section("randomization")
    values = table.read(RANDOMIZATION_SCHEMA, sections=("markers",))
    markers = table.section("markers").read(MARKER_NOISE_SCHEMA) if "markers" in table.data else {}
    if "noise" in markers:
        markers["noise_px"] = markers.pop("noise")
    return ({k: v for k, v in found.items() if v is not None} for found in (values, markers))  # type: ignore[return-value]
