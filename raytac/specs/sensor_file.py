"""Reads sensors and lights from TOML: the schemas of ``scenes/sensors/*.toml`` and ``lights/*.toml``."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from raytac.specs.files import find_file
from raytac.specs.marker_motion import load_marker_motion
from raytac.specs.sensor import (
    AUTO,
    BONDED,
    CameraSpec,
    CaseSpec,
    CoatSpec,
    GelpadSpec,
    LedSpec,
    LightsSpec,
    MarkerSpec,
    OpticsSpec,
    RefractionSpec,
    ResponseSpec,
    SensorSpec,
)
from raytac.specs.sensor_check import validate_sensor
from raytac.specs.toml import ANY, Flag, Integer, Number, Schema, Table, Text, read_toml

__all__ = ["LED_SCHEMA", "SENSOR_SCHEMA", "load_lights", "load_sensor", "with_lights"]

_NAME = Text(pattern=r"[a-z][a-z0-9_]*", described="a name of lower-case letters, digits and underscores")

SENSOR_SCHEMA: Final[dict[str, Schema]] = {
    "": {"lights": Text(), "base": Text(default=""), "marker_motion": Text(default="")},
    "gelpad": {
        "size_mm": Number("[2, 200]", length=2),
        "thickness_mm": Number("[0.2, 50]"),
        "dome_radius_mm": Number("[1, inf]", length=2),
        "youngs_modulus_kpa": Number("[1, 100000]"),
        "poisson_ratio": Number("[0, 0.5)"),
        "density_kg_m3": Number("[100, 10000]"),
        "friction": Number("[0, 10]"),
        "bonded": Text(choices=BONDED, default="back"),
    },
    "coat": {
        "reflectance": Number("[0, 1]", length=3),
        "specular": Number("[0, 1)"),
        "roughness": Number("[0.05, 1]"),
    },
    "case": {
        "size_mm": Number("[2, 300]", length=2),
        "floor_z_mm": Number("[-500, 0)"),
        "reflectance": Number("[0, 1)"),
    },
    "camera": {
        "resolution_px": Integer("[8, 8192]", length=2),
        "pixel_pitch_mm": Number("[0.0005, 5]", length=2),
        "position_mm": Number("[-500, 500]", length=3),
        "principal_point_px": Number("[-8192, 16384]", length=2),
    },
    "response": {
        "exposure": Number("(0, 1e9]", word=AUTO),
        "white_balance": Number("(0, 100]", length=3),
        "gamma": Number("[0.5, 5]"),
        "black_level": Number("[-0.5, 0.5]", length=3, default=(0.0, 0.0, 0.0)),
        "vignetting": Number("[-10, 10]", length=3, default=(0.0, 0.0, 0.0)),
        "shading_red": Number("[-5, 5]", length=ANY, default=()),
        "shading_green": Number("[-5, 5]", length=ANY, default=()),
        "shading_blue": Number("[-5, 5]", length=ANY, default=()),
    },
    "markers": {
        "rows": Integer("[0, 200]"),
        "columns": Integer("[0, 200]"),
        "pitch_mm": Number("[0, 50]", length=2, default=(0.0, 0.0)),
        "offset_mm": Number("[-100, 100]", length=2, default=(0.0, 0.0)),
        "radius_mm": Number("[0, 10]", default=0.0),
        "reflectance": Number("[0, 1]", default=0.0),
    },
    "refraction": {
        "model": Text(choices=("none", "slab")),
        "ior": Number("[1, 3]"),
        "plate_thickness_mm": Number("[0, 50]"),
    },
    "optics": {"shadows": Flag(default=True)},
}
"""Table (``""``: the top of the file) to its keys."""

_PARTS: Final = {
    "gelpad": GelpadSpec,
    "coat": CoatSpec,
    "case": CaseSpec,
    "camera": CameraSpec,
    "response": ResponseSpec,
    "markers": MarkerSpec,
    "refraction": RefractionSpec,
    "optics": OpticsSpec,
}
_MAY_LACK: Final = ("optics",)
"""Tables that a file without a base need not give."""

LED_SCHEMA: Final[Schema] = {
    "name": _NAME,
    "layer": _NAME,
    "position_mm": Number("[-500, 500]", length=3),
    "axis": Number("[-1000, 1000]", length=3),
    "size_mm": Number("(0, 50]", length=2),
    "lobe": Number("[1, 1000]"),
    "power_w_per_sr": Number("[0, 1e6]", length=3),
    "glow_per_m2": Number("[0, 1e6]", default=0.0),
}
"""Keys of one ``[[led]]`` table."""


def load_sensor(name_or_path: str | Path) -> SensorSpec:
    """Read and check a sensor with its lights.

    Args:
        name_or_path: shipped name such as ``"gelsight_mini"``, or path of a TOML file (see ``scenes/README.md``).

    Returns:
        The sensor in SI units and the pad frame; its name is the file's stem.

    Raises:
        SpecError: unknown name, unreadable file, unknown or missing key, wrong type, value out of range, or a sensor that cannot
            work (see ``validate_sensor``).
    """
    return _read_sensor(find_file("sensor", name_or_path))


def _read_sensor(path: Path, above: tuple[Path, ...] = ()) -> SensorSpec:
    """A sensor file; with ``base``, that sensor with every table and file that this one gives in place of its own. ``above``: files that
    are built on this one."""
    top = read_toml(path)
    parts = {name: schema for name, schema in SENSOR_SCHEMA.items() if name}
    base = None
    if "base" in top.data:
        named = top.read_one("base", SENSOR_SCHEMA[""]["base"])
        found, above = find_file("sensor", named, base=path.parent), (*above, path.resolve())
        if found.resolve() in above:
            raise top.error("must be a sensor that is not built on this one", "base", top.data["base"])
        base = _read_sensor(found, above)
    schema = dict(SENSOR_SCHEMA[""])
    if base is not None:
        schema["lights"] = Text(default="")
    head = top.read(schema, sections=tuple(parts))
    given = [name for name in parts if name in top.data or (base is None and name not in _MAY_LACK)]
    changes: dict[str, Any] = {name: _PARTS[name](**top.section(name).read(parts[name])) for name in given}
    if head["lights"]:
        changes["lights"] = _read_lights(find_file("lights", head["lights"], base=path.parent))
    if head["marker_motion"]:
        changes["marker_motion"] = load_marker_motion(head["marker_motion"], base=path.parent)
    changes |= {"name": path.stem, "source": path}
    sensor = SensorSpec(**changes) if base is None else replace(base, **changes)
    validate_sensor(sensor)
    return sensor


def load_lights(name_or_path: str | Path) -> LightsSpec:
    """Read and check the lights of a sensor: a shipped name such as ``"gelsight_mini"`` or the path of a TOML file.

    Whether each LED lies inside the case and outside the gel needs the sensor: ``load_sensor`` and ``validate_sensor`` check it.

    Raises:
        SpecError: as ``load_sensor``; also no LED, two LEDs of one name, or an axis of zero length.
    """
    return _read_lights(find_file("lights", name_or_path))


def with_lights(sensor: SensorSpec, lights: LightsSpec | str | Path) -> SensorSpec:
    """``sensor`` under other lights, checked.

    Its response stays, colour shading and black level too, though these belong to the lights that they were fitted with.

    Raises:
        SpecError: as ``load_lights`` and ``validate_sensor``.
    """
    changed = replace(sensor, lights=lights if isinstance(lights, LightsSpec) else load_lights(lights))
    validate_sensor(changed)
    return changed


def _read_lights(path: Path) -> LightsSpec:
    top = read_toml(path)
    top.read({}, sections=("led",))
    tables = top.sections("led")
    if not tables:
        raise top.error("at least one [[led]] table is needed", "led")
    leds = tuple(_read_led(table) for table in tables)
    names = [led.name for led in leds]
    for table, name in zip(tables, names, strict=True):
        if names.count(name) > 1:
            raise table.error("must be unique among the LEDs of a file", "name", name)
    return LightsSpec(leds, source=path)


def _read_led(table: Table) -> LedSpec:
    values = table.read(LED_SCHEMA)
    length = math.hypot(*values["axis"])
    if length < 1e-6:
        raise table.error("must be a direction of length > 0", "axis", table.data["axis"])
    values["axis"] = tuple(component / length for component in values["axis"])
    return LedSpec(**values)
