"""Pads shaped by a file: maps and meshes that are read, and those that are refused with file, value and rule."""

from __future__ import annotations

import re
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from raytac.assets import asset_root
from raytac.errors import SpecError
from raytac.specs import load_mesh, load_sensor, validate_sensor
from raytac.specs.height_map import HeightMap

SENSOR = """base = "gelsight_dome"
[gelpad]
size_mm = [24, 20]
thickness_mm = 5
youngs_modulus_kpa = 145
poisson_ratio = 0.45
density_kg_m3 = 1000
friction = 1
{keys}
"""
RADIUS = 0.06


def bent(nx: int = 121, ny: int = 101, half: tuple[float, float] = (12e-3, 10e-3)) -> np.ndarray:
    """A ball's cap [m]: no sum of arcs, so no dome of two radii."""
    x, y = np.linspace(-half[0], half[0], nx), np.linspace(-half[1], half[1], ny)
    return cap(x[None, :], y[:, None])


def cap(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.sqrt(RADIUS**2 - x**2 - y**2) - RADIUS


def sensor_of(folder: Path, keys: str):
    (folder / "sensor.toml").write_text(SENSOR.format(keys=keys), "utf-8")
    return load_sensor(folder / "sensor.toml")


def test_a_cubic_of_third_order_with_its_slopes() -> None:
    places = np.random.default_rng(1).uniform(-1, 1, (2, 500)) * [[12e-3], [10e-3]]
    errors = []
    for nodes in (25, 49, 97):
        surface = HeightMap(bent(nodes, nodes), (24e-3 / (nodes - 1), 20e-3 / (nodes - 1)))
        errors.append(np.abs(surface.height(*places) - cap(*places)).max())
        h = 1e-7
        for axis, slope in enumerate(surface.slope(*places)):
            step = np.eye(2)[:, axis : axis + 1] * h
            numeric = (surface.height(*(places + step)) - surface.height(*(places - step))) / (2 * h)
            inside = (np.abs(places) < [[11.9e-3], [9.9e-3]]).all(axis=0)
            assert slope[inside] == pytest.approx(numeric[inside], abs=1e-6) and np.abs(slope).max() > 0.1
    assert errors[0] < 1e-7 and errors[1] < errors[0] / 7 and errors[2] < errors[1] / 7


def test_maps_of_every_kind_and_a_mesh_give_the_same_pad(tmp_path: Path) -> None:
    z = bent()
    np.save(tmp_path / "gel.npy", 1e3 * z + 7.0)
    np.savetxt(tmp_path / "gel.csv", 1e3 * z, delimiter=",")
    Image.fromarray(np.round((z - z.min()) / 50e-9).astype(np.uint16)).save(tmp_path / "gel.png")
    wide = bent(161, 141, (16e-3, 14e-3))
    np.save(tmp_path / "wide.npy", 1e3 * wide)
    x, y = np.meshgrid(np.linspace(-12e-3, 12e-3, 37), np.linspace(-10e-3, 10e-3, 31))
    for keys, tolerance in (
        ('surface = "gel.npy"', 1e-9),
        ('surface = "gel.csv"', 1e-9),
        ('surface = "gel.png"\nsurface_unit_mm = 0.00005', 60e-9),
        ('surface = "wide.npy"\nsurface_pitch_mm = [0.2, 0.2]', 1e-9),
    ):
        pad = sensor_of(tmp_path, keys).gelpad
        assert -pad.sag(x, y) == pytest.approx(cap(x, y), abs=tolerance), keys
    pad = load_sensor("finger_example").gelpad
    exact = np.sqrt(0.03**2 - x**2 - np.minimum(y, 0.0) ** 2) - 0.03
    assert -pad.sag(x, y) == pytest.approx(exact, abs=2e-6)


@pytest.mark.parametrize(
    ("change", "keys", "message"),
    [
        (lambda z: np.where(z == z.min(), np.nan, z), "", r"gel\.npy: gelpad\.surface = nan: .*row 0, column 0.*4 such nodes"),
        (lambda z: z[:3], "", r"gelpad\.surface = \(3, 121\): .*4 to 4096 rows"),
        (lambda z: z, "surface_pitch_mm = [0.1, 0.2]", r"covers \[12\.0, 20\.0\] mm: must cover the pad of \[24\.0, 20\.0\] mm"),
        (lambda z: 5 * z, "", r"the surface is at z = -10\.\d+ mm.*stay above the bonded face, z > -5 mm"),
        (lambda z: -z, "", r"the surface is at z = 2\.\d+ mm.*the case ends there: z <= 0\.5 mm"),
        (lambda z: z, "dome_radius_mm = [50, 50]", r"dome_radius_mm = .*must be left out where surface gives the shape"),
        (lambda z: z.astype(object), "", r"gel\.npy: gelpad\.surface: the file cannot be read as a map"),
        (lambda z: z, 'surface_scale = 1', r"unknown key; did you mean|choose from"),
    ],
)  # fmt: skip
def test_a_map_that_no_pad_can_have_is_refused(tmp_path: Path, change, keys: str, message: str) -> None:
    np.save(tmp_path / "gel.npy", change(1e3 * bent()), allow_pickle=True)
    with pytest.raises(SpecError) as caught:
        sensor_of(tmp_path, f'surface = "gel.npy"\n{keys}')
    assert re.search(message, str(caught.value)), caught.value


def test_files_that_are_not_there_or_of_no_kind(tmp_path: Path) -> None:
    (tmp_path / "gel.step").write_text("solid")
    for keys, message in (
        ('surface = "none.npy"', "none.npy: gelpad.surface: the file does not exist"),
        ('surface = "gel.step"', "unknown format"),
        ("surface_unit_mm = 1", "is of a surface that no key names"),
    ):
        with pytest.raises(SpecError, match=re.escape(message)):
            sensor_of(tmp_path, keys)


def test_a_mesh_with_an_undercut_or_too_small_is_refused(tmp_path: Path) -> None:
    mushroom = trimesh.util.concatenate(
        [trimesh.creation.box((30, 30, 4), trimesh.transformations.translation_matrix((0, 0, -3))),
         trimesh.creation.icosphere(3, 2.0).apply_translation((0, 0, 2.5))]
    )  # fmt: skip
    mushroom.export(tmp_path / "ball.stl")
    trimesh.creation.box((20, 30, 4), trimesh.transformations.translation_matrix((0, 0, -2))).export(tmp_path / "small.stl")
    with pytest.raises(SpecError, match=r"ball\.stl: gelpad\.surface: the mesh has an undercut.*x = .*mm and \d+ other nodes"):
        sensor_of(tmp_path, 'surface = "ball.stl"')
    with pytest.raises(SpecError, match=r"small\.stl: gelpad\.surface: the mesh does not lie under the whole pad"):
        sensor_of(tmp_path, 'surface = "small.stl"')


def test_a_led_beside_the_pad_is_checked_against_the_map(tmp_path: Path) -> None:
    """A map that falls on one side alone: an LED that a dome would allow there is above the gel."""
    spec = load_sensor("gelsight_dome")
    x = np.linspace(-12e-3, 12e-3, 121)
    falls = np.broadcast_to(-(np.clip(x, 0.0, None) ** 2) / 0.04, (101, 121))
    pad = replace(spec.gelpad, dome_radius=(np.inf, np.inf), surface=HeightMap(falls, (0.2e-3, 0.2e-3)))
    led = replace(spec.lights.leds[0], position=(14e-3, 0.0, -2e-3), axis=(-1.0, 0.0, 0.0), size=(1e-3, 1e-3))
    beside = replace(spec, gelpad=pad, lights=replace(spec.lights, leds=(led,)), source=None)
    with pytest.raises(SpecError, match=r"lies above the gel: .* must have z <= -3\.6 mm"):
        validate_sensor(beside)
    other = replace(led, position=(-14e-3, 0.0, -2e-3), axis=(1.0, 0.0, 0.0))
    validate_sensor(replace(beside, lights=replace(spec.lights, leds=(other,))))


def test_the_shipped_mesh_is_the_scripts(tmp_path: Path) -> None:
    script = runpy.run_path(str(Path(__file__).parents[2] / "experiments" / "make_finger_gel.py"))
    script["main"](script["Args"](out=tmp_path))
    written, shipped = (load_mesh(root / "finger_gel.stl", 0.001) for root in (tmp_path, asset_root("scenes") / "meshes"))
    assert all(np.array_equal(a, b) for a, b in zip(written, shipped, strict=True))
