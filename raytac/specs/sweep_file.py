"""Reads sweeps from TOML: ``scenes/sweeps/*.toml``."""

from __future__ import annotations

from pathlib import Path

from raytac.errors import SpecError
from raytac.specs.files import find_file, name_of
from raytac.specs.mesh import MESH_SUFFIXES
from raytac.specs.press import PressScene
from raytac.specs.press_file import load_press, press_of
from raytac.specs.sensor_file import load_sensor
from raytac.specs.sweep import MARKER_NOISE_SCHEMA, RANDOMIZATION_SCHEMA, RANGE_SCHEMA, SWEEP_SCHEMA, PressRanges, SweepSpec
from raytac.specs.toml import Table, read_toml


def load_sweep(name_or_path: str | Path) -> SweepSpec:
    """Read and check a sweep, with the sensors and press scenes that it names.

    Args:
        name_or_path: shipped name such as ``"demo"``, or path of a TOML file (see ``scenes/README.md``); paths of sensors, scenes and
            meshes in it are relative to it. A mesh is taken as ``press_of`` takes it.

    Raises:
        SpecError: unknown name, unreadable file, unknown or missing key, wrong type, value out of range, or a range whose ends are
            in the wrong order; or as ``load_sensor`` and ``load_press``.
        MeshError: as ``load_mesh``.
    """
    path = find_file("sweep", name_or_path)
    top = read_toml(path)
    values = top.read(SWEEP_SCHEMA, sections=("press", "randomization"))
    sensors = tuple(load_sensor(find_file("sensor", name, base=path.parent)) for name in values.pop("sensors"))
    values["ranges"] = _read_ranges(top.section("press"))
    objects = tuple(_read_object(name, path.parent, values["ranges"].depth[1]) for name in values.pop("objects"))
    values["randomization"], values["marker_perturbation"] = _read_randomization(top)
    return SweepSpec(name_of(path), sensors, objects, source=path, **values)


def _read_object(name: str, base: Path, depth: float) -> PressScene:
    if Path(name).suffix.lower() in MESH_SUFFIXES:
        return press_of(base / name, depth=depth)
    return load_press(find_file("press scene", name, base=base))


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
    return ({k: v for k, v in given.items() if v is not None} for given in (values, markers))  # type: ignore[return-value]
