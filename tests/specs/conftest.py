"""Good files to spoil. The sensor and its lights are written here, so that tuning the shipped ones leaves the tests alone."""

from __future__ import annotations

import copy
import datetime
import json
import re
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from raytac.assets import asset_root

DELETE = object()

SENSOR = """
lights = "lights.toml"
[gelpad]
size_mm = [25.25, 20.75]
thickness_mm = 4.0
dome_radius_mm = [210.0, 135.0]
youngs_modulus_kpa = 430.0
poisson_ratio = 0.48
density_kg_m3 = 1000.0
friction = 1.0
[coat]
reflectance = [0.5, 0.5, 0.5]
specular = 0.05
roughness = 0.4
[case]
size_mm = [30.4, 26.4]
floor_z_mm = -28.5
reflectance = 0.1
[camera]
resolution_px = [320, 240]
pixel_pitch_mm = [0.0634, 0.0634]
position_mm = [0.0, 0.0, -28.0]
principal_point_px = [160.0, 120.0]
[response]
exposure = 4.0
white_balance = [1.0, 1.0, 1.0]
gamma = 2.2
[markers]
rows = 0
columns = 0
[refraction]
model = "none"
ior = 1.41
plate_thickness_mm = 3.0
"""
LIGHTS = """
[[led]]
name = "red"
layer = "red"
position_mm = [0.0, -12.0, -9.0]
axis = [0.0, 2.0, 1.0]
size_mm = [2.0, 1.0]
lobe = 1.5
power_w_per_sr = [2e-4, 0.0, 0.0]
[[led]]
name = "green"
layer = "green"
position_mm = [14.2, 5.0, -8.0]
axis = [-1.0, -0.2, 0.5]
size_mm = [2.0, 1.0]
lobe = 1.5
power_w_per_sr = [0.0, 1e-4, 0.0]
"""


def quoted(text: str) -> str:
    """A TOML basic string: JSON's, but for one character that only TOML forbids."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def to_toml(value: Any) -> str:
    """A TOML value; tables are written inline, so that nesting needs no headers."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{quoted(k)} = {to_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(to_toml, value)) + "]"
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, datetime.datetime | datetime.date | datetime.time):
        return value.isoformat()
    return repr(value)


def document(data: Mapping[str, Any]) -> str:
    return "".join(f"{quoted(key)} = {to_toml(value)}\n" for key, value in data.items())


def changed(data: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A deep copy with dotted paths such as ``led[1].axis`` set, or removed where the value is ``DELETE``."""
    result: Any = copy.deepcopy(dict(data))
    for dotted, value in changes.items():
        *way, last = [int(step) if step.isdigit() else step for step in re.findall(r"[^.\[\]]+", dotted)]
        node = result
        for step in way:
            node = node[step]
        if value is DELETE:
            del node[last]
        else:
            node[last] = value
    return result


@pytest.fixture
def delete() -> object:
    """The value that removes a key in the changes of the factories below."""
    return DELETE


@pytest.fixture
def make_sensor(tmp_path: Path) -> Callable[..., Path]:
    """``make_sensor({"gelpad.size_mm": …}, lights={"led[0].axis": …})``: ``SENSOR`` and ``LIGHTS``, changed."""

    def make(changes: Mapping[str, Any] | None = None, lights: Mapping[str, Any] | None = None) -> Path:
        (tmp_path / "lights.toml").write_text(document(changed(tomllib.loads(LIGHTS), lights or {})), "utf-8")
        (tmp_path / "sensor.toml").write_text(document(changed(tomllib.loads(SENSOR), changes or {})), "utf-8")
        return tmp_path / "sensor.toml"

    return make


@pytest.fixture
def make_press(tmp_path: Path) -> Callable[..., Path]:
    """``make_press("torus", {"object.major_radius_mm": …})``: a changed press scene, ``tmp_path/torus.toml``."""

    def make(name: str, changes: Mapping[str, Any] | None = None) -> Path:
        scene = tomllib.loads((asset_root("scenes") / "press" / f"{name}.toml").read_text("utf-8"))
        if scene["object"]["kind"] == "mesh":
            scene["object"]["path"] = str(asset_root("scenes") / "meshes" / "gear.stl")
        path = tmp_path / f"{name}.toml"
        path.write_text(document(changed(scene, changes or {})), "utf-8")
        return path

    return make
