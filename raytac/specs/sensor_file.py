"""Reads sensors and lights from TOML: ``scenes/sensors/*.toml`` and ``lights/*.toml``."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from raytac.errors import InputError
from raytac.specs.files import available, find_file, name_of
from raytac.specs.height_map import HeightMap, read_height_map
from raytac.specs.marker_motion import MarkerMotionSpec, load_marker_motion, marker_motion_text
from raytac.specs.sensor import (
    LED_SCHEMA,
    SENSOR_PARTS,
    SENSOR_SCHEMA,
    SURFACE_SCHEMA,
    UNMIXED,
    GelpadSpec,
    LedSpec,
    LightsSpec,
    ResponseSpec,
    SensorSpec,
    shading_degree,
)
from raytac.specs.sensor_check import validate_sensor
from raytac.specs.toml import Number, Table, Text, read_toml, split_unit

_LONGEST_CHAIN = 32
"""Files that a sensor can be built on, one after the other."""
_MAY_LACK = ("optics", "noise")
"""Tables that a file without a base need not give."""


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


def sensor_spec(sensor: str | Path | SensorSpec) -> SensorSpec:
    """The specification itself, or of a name or file. Raises ``InputError`` or ``SpecError``."""
    if not isinstance(sensor, (str, Path, SensorSpec)):
        raise InputError("sensor", value=sensor, rule=f"must be a name, a path or a SensorSpec, not {type(sensor).__name__}")
    if not isinstance(sensor, SensorSpec):
        return load_sensor(sensor)
    validate_sensor(sensor)
    return sensor


def files_in_chain(path: Path) -> list[Path]:
    """A sensor file and those that it is built on, one after the other; it has been read before."""
    top = read_toml(path)
    if "base" not in top.data:
        return [path]
    return [path, *files_in_chain(find_file("sensor", top.data["base"], base=path.parent))]


def _read_sensor(path: Path, above: tuple[Path, ...] = ()) -> SensorSpec:
    """A sensor file, or ``base`` with this one's tables; ``above``: files built on this one."""
    top = read_toml(path)
    parts = {name: schema for name, schema in SENSOR_SCHEMA.items() if name}
    base = None
    if "base" in top.data:
        named = top.read_one("base", SENSOR_SCHEMA[""]["base"])
        file, above = find_file("sensor", named, base=path.parent), (*above, path.resolve())
        if file.resolve() in above:
            raise top.error("must be a sensor that is not built on this one", "base", top.data["base"])
        if len(above) > _LONGEST_CHAIN:
            raise top.error(f"a sensor must be built on at most {_LONGEST_CHAIN} others, one after the other", "base", named)
        base = _read_sensor(file, above)
    schema = dict(SENSOR_SCHEMA[""])
    if base is not None:
        schema["lights"] = Text(default="")
    head = top.read(schema, sections=tuple(parts))
    given = [name for name in parts if name in top.data or (base is None and name not in _MAY_LACK)]
    changes: dict[str, Any] = {
        name: _read_gelpad(top.section(name)) if name == "gelpad" else SENSOR_PARTS[name](**top.section(name).read(parts[name]))
        for name in given
    }
    if head["lights"]:
        changes["lights"] = _read_lights(find_file("lights", head["lights"], base=path.parent))
    if head["marker_motion"]:
        changes["marker_motion"] = load_marker_motion(head["marker_motion"], base=path.parent)
    changes |= {"name": name_of(path), "source": path}
    return _valid(SensorSpec(**changes) if base is None else replace(base, **changes))


def _read_gelpad(table: Table) -> GelpadSpec:
    """The gelpad, with the surface of the file that it names in place of a dome."""
    schema = dict(SENSOR_SCHEMA["gelpad"])
    for key in [key for key in SURFACE_SCHEMA if key in table.data]:
        if "surface" not in table.data:
            raise table.error("is of a surface that no key names: surface = a file", key, table.data[key])
    if "surface" not in table.data:
        return GelpadSpec(**table.read(schema))
    schema["dome_radius_mm"] = Number("[1, inf]", length=2, default=(math.inf, math.inf))
    values = table.read({**schema, **SURFACE_SCHEMA})
    name, unit, pitch = values.pop("surface"), values.pop("surface_unit"), values.pop("surface_pitch")
    return GelpadSpec(**values, surface=read_height_map(table.file.parent / Path(name).expanduser(), unit, pitch, values["size"]))


def load_lights(name_or_path: str | Path) -> LightsSpec:
    """Read and check the lights of a sensor: a shipped name or the path of a TOML file.

    Whether each LED lies inside the case and outside the gel needs the sensor: ``load_sensor`` and ``validate_sensor`` check it.

    Raises ``SpecError``: as ``load_sensor``; also no LED, two LEDs of one name, or an axis of zero length.
    """
    return _read_lights(find_file("lights", name_or_path))


def with_lights(sensor: SensorSpec, lights: LightsSpec | str | Path) -> SensorSpec:
    """``sensor`` under other lights, checked.

    Its response stays, colour shading and black level too, though these belong to the lights that they were fitted with.

    Raises ``SpecError``: as ``load_lights`` and ``validate_sensor``.
    """
    return _valid(replace(sensor, lights=lights if isinstance(lights, LightsSpec) else load_lights(lights)))


def _valid(sensor: SensorSpec) -> SensorSpec:
    validate_sensor(sensor)
    return sensor


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


def lights_text(lights: LightsSpec, comment: str) -> str:
    """A light file: ``comment``, then a table an LED; lengths to 10 µm, powers to four digits."""

    def row(values: tuple[float, ...], scale: float, digits: str) -> str:
        return ", ".join(f"{scale * value:{digits}}" for value in values)

    tables = [
        f'[[led]]\nname = "{led.name}"\nlayer = "{led.layer}"\nposition_mm = [{row(led.position, 1e3, ".2f")}]\n'
        f"axis = [{row(led.axis, 1, '.4f')}]\nsize_mm = [{row(led.size, 1e3, '.2f')}]\nlobe = {led.lobe:.2f}\n"
        f"power_w_per_sr = [{row(led.power, 1, '.3e')}]\n"
        + (f"glow_per_m2 = {led.glow:.4g}\n" if led.glow else "")
        + ("virtual = true\n" if led.virtual else "")
        for led in lights.leds
    ]
    return "\n".join([*(f"# {line}" for line in comment.splitlines()), "", "\n".join(tables)])


def response_text(response: ResponseSpec) -> str:
    """The table ``[response]`` to six digits; shading to four decimals, a line an order in x."""

    def row(values: tuple[float, ...]) -> str:
        return "[" + ", ".join(f"{value:.6g}" for value in values) + "]"

    lines = [
        "[response]",
        f"exposure = {response.gain:.6g}",
        f"white_balance = {row(response.white_balance)}",
        f"gamma = {response.gamma:.6g}",
        f"black_level = {row(response.black_level)}",
        f"vignetting = {row(response.vignetting)}",
    ]
    if response.colour_mix != UNMIXED:
        lines.append(f"colour_mix = {row(response.colour_mix)}")
    if response.tone:
        lines.append(f"tone = {row(response.tone)}")
    for channel, coefficients in zip(("red", "green", "blue"), response.shading, strict=True):
        if not coefficients:
            continue
        lines.append(f"shading_{channel} = [")
        rest = iter(coefficients)
        for order in range(shading_degree(len(coefficients)), -1, -1):
            lines.append("    " + ", ".join(f"{value:.4f}" for value in islice(rest, order + 1)) + ",")
        lines.append("]")
    return "\n".join(lines) + "\n"


_MOTION, _SURFACE = "marker_motion.toml", "surface.csv"


def sensor_files(sensor: SensorSpec) -> dict[str, str]:
    """Texts by name of file: ``sensor.toml``, and further files that it needs.

    Its lights are in a ``lights.toml`` beside it, which is not among them. A sensor whose lights, camera, response, optics and noise are
    all that it does not have from a shipped one names that as its base; any other holds every table itself. Markers' motion is a shipped
    name or a file beside it, the map of a pad's surface a file beside it. No path of this machine is in it.
    """
    files: dict[str, str] = {}
    base = _shipped_base(sensor)
    head = ['lights = "lights.toml"'] if base is None else [f'base = "{base}"', 'lights = "lights.toml"']
    tables = ["response", "optics", "noise"] if base is not None else [name for name in SENSOR_SCHEMA if name]
    if base is not None and sensor.camera != load_sensor(base).camera:
        tables.insert(0, "camera")
    if sensor.noise.is_none and (base is None or load_sensor(base).noise.is_none):
        tables.remove("noise")
    if base is None and sensor.marker_motion is not None:
        shipped = _shipped_motion(sensor.marker_motion)
        head.append(f'marker_motion = "{shipped or _MOTION}"')
        if shipped is None:
            files[_MOTION] = marker_motion_text(sensor.marker_motion)
    if base is None and sensor.gelpad.surface is not None:
        files[_SURFACE] = _map_text(sensor.gelpad.surface)
    blocks = [response_text(sensor.response) if name == "response" else _table(sensor, name) for name in tables]
    return {"sensor.toml": "\n".join(["\n".join(head) + "\n", *blocks])} | files


def gelpad_files(sensor: SensorSpec, base: str, comment: str) -> dict[str, str]:
    """Texts by name of file: a ``sensor.toml`` on ``base`` with the gelpad of ``sensor``.

    Where its surface is a map, that is a file beside it.

    ``base``: name of a shipped sensor, or a path from the file's folder; ``comment``: where the gelpad's values are from.
    """
    top = "\n".join([*(f"# {line}" for line in comment.splitlines()), "", f'base = "{base}"'])
    files = {"sensor.toml": f"{top}\n\n{_table(sensor, 'gelpad')}"}
    return files if sensor.gelpad.surface is None else files | {_SURFACE: _map_text(sensor.gelpad.surface)}


def _shipped_base(sensor: SensorSpec) -> str | None:
    """Name of the shipped sensor that this is but for what ``sensor_files`` says; or None."""
    source = sensor.source
    if source is None or source.stem not in available("sensor") or source.resolve() != find_file("sensor", source.stem).resolve():
        return None
    shipped = load_sensor(source.stem)
    parts = {name: getattr(shipped, name) for name in ("lights", "camera", "response", "optics", "noise")}
    own = replace(sensor, **parts)
    return source.stem if own == shipped else None


def _shipped_motion(motion: MarkerMotionSpec) -> str | None:
    """Name of the shipped marker motion that this is; None if it is another."""
    for name in available("marker motion"):
        if replace(load_marker_motion(name), source=motion.source) == motion:
            return name
    return None


def _table(sensor: SensorSpec, name: str) -> str:
    """One table in the units of its keys, to fifteen digits, so that numbers come back equal."""
    lines = [f"[{name}]"]
    for key in SENSOR_SCHEMA[name]:
        own, unit = split_unit(key)
        value = getattr(getattr(sensor, name), own)

        def text(one: object, unit=unit) -> str:
            if isinstance(one, bool):
                return "true" if one else "false"
            if isinstance(one, str):
                return f'"{one}"'
            return str(one) if isinstance(one, int) else f"{one * unit.denominator / unit.numerator:.15g}"  # type: ignore[operator]

        written = f"[{', '.join(text(one) for one in value)}]" if isinstance(value, tuple) else text(value)
        lines.append(f"{key} = {written}")
    if name == "gelpad" and sensor.gelpad.surface is not None:  # in metres, so that numbers come back equal
        dx, dy = (f"{1e3 * step:.15g}" for step in sensor.gelpad.surface.spacing)
        lines += [f'surface = "{_SURFACE}"', "surface_unit_mm = 1000", f"surface_pitch_mm = [{dx}, {dy}]"]
    return "\n".join(lines) + "\n"


def _map_text(surface: HeightMap) -> str:
    """Heights [m] as a table, a line a row."""
    return "".join(",".join(f"{value:.17g}" for value in row) + "\n" for row in surface.heights)
