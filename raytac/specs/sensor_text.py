"""Writes a sensor as the TOML that ``load_sensor`` reads, so that the folder that holds it can be copied anywhere."""

from __future__ import annotations

from dataclasses import replace

from raytac.specs.files import available, find_file
from raytac.specs.marker_motion import MarkerMotionSpec, load_marker_motion, marker_motion_text
from raytac.specs.sensor import SensorSpec
from raytac.specs.sensor_file import SENSOR_SCHEMA, load_sensor, response_text
from raytac.specs.toml import split_unit

__all__ = ["sensor_files"]

_MOTION = "marker_motion.toml"


def sensor_files(sensor: SensorSpec) -> dict[str, str]:
    """Text by name of file: ``sensor.toml``, whose lights are those of ``lights.toml`` beside it, and what else it needs there.

    A sensor whose lights, response and optics are all that it does not have from a shipped one names that as its base; any other holds
    every table itself. Markers' motion is a shipped name or a file beside it. No path of this machine is in it.
    """
    files: dict[str, str] = {}
    base = _shipped_base(sensor)
    head = ['lights = "lights.toml"'] if base is None else [f'base = "{base}"', 'lights = "lights.toml"']
    tables = ["response", "optics"] if base is not None else [name for name in SENSOR_SCHEMA if name]
    if base is None and sensor.marker_motion is not None:
        shipped = _shipped_motion(sensor.marker_motion)
        head.append(f'marker_motion = "{shipped or _MOTION}"')
        if shipped is None:
            files[_MOTION] = marker_motion_text(sensor.marker_motion)
    blocks = [response_text(sensor.response) if name == "response" else _table(sensor, name) for name in tables]
    return {"sensor.toml": "\n".join(["\n".join(head) + "\n", *blocks])} | files


def _shipped_base(sensor: SensorSpec) -> str | None:
    """Name of the shipped sensor that ``sensor`` was read from and is but for its lights, response and optics; None if there is none."""
    source = sensor.source
    if source is None or source.stem not in available("sensor") or source.resolve() != find_file("sensor", source.stem).resolve():
        return None
    shipped = load_sensor(source.stem)
    own = replace(sensor, lights=shipped.lights, response=shipped.response, optics=shipped.optics)
    return source.stem if own == shipped else None


def _shipped_motion(motion: MarkerMotionSpec) -> str | None:
    """Name of the shipped marker motion that this is; None if it is another."""
    for name in available("marker motion"):
        if replace(load_marker_motion(name), source=motion.source) == motion:
            return name
    return None


def _table(sensor: SensorSpec, name: str) -> str:
    """One table in the units of its keys, to fifteen digits: what is read back is the same number."""
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
    return "\n".join(lines) + "\n"
