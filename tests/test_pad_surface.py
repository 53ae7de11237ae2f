"""Pads whose resting shape is a map of heights: that of a dome presses and shows as the dome does."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from raytac.frame import TactileFrame
from raytac.gel.surface import make_grid
from raytac.optics import Taxim
from raytac.optics.taxim.bake.bake import calibrate
from raytac.optics.taxim.bake.presses import pressed as pressed_surface
from raytac.optics.taxim.bake.settings import BakeSettings
from raytac.optics.taxim.bake.views import Calibration
from raytac.physics.rigid.contacts import LoadTables
from raytac.physics.rigid.search import PadSearch
from raytac.sensor import TactileSensor
from raytac.shapes.part import primitive
from raytac.specs import MarkerSpec, SensorSpec, lights_text, load_press, load_sensor, load_task, sensor_files
from raytac.specs.height_map import HeightMap
from raytac.specs.press import StageSpec
from raytac.world import TactileWorld

SIZE = (160, 120)
BALL = replace(load_press("sphere"), trajectory=(StageSpec("indent", depth=0.5e-3),))
BESIDE = (3.0e-3, -2.0e-3)


def as_map(sensor: SensorSpec, spacing: float = 0.2e-3) -> SensorSpec:
    grid = make_grid(sensor.gelpad, spacing)
    pad = replace(sensor.gelpad, dome_radius=(math.inf, math.inf), surface=HeightMap(grid.rest, grid.pitch).centred())
    return replace(sensor, gelpad=pad, source=None)


@cache
def pressed(mapped: bool, physics: str, optics: str = "raytrace") -> TactileFrame:
    spec = load_sensor("gelsight_dome")
    if physics == "ipc":
        spec = replace(spec, markers=MarkerSpec(5, 7, (2e-3, 2e-3), (0.0, 0.0), 0.3e-3, 0.05), source=None)
    sensor = TactileSensor(
        as_map(spec) if mapped else spec, physics=physics, optics=optics, outputs=("rgb", "height", "wrench"), resolution=SIZE,
        device="cpu", markers="surface" if physics == "ipc" else None,
    )  # fmt: skip
    return sensor.press(BALL, offset=BESIDE)


def test_a_map_every_fifth_of_a_millimetre_is_the_dome_within_a_fifth_of_a_nanometre() -> None:
    dome = load_sensor("gelsight_dome").gelpad
    x, y = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 2000)) * np.array(dome.size)[:, None]
    assert np.abs(as_map(load_sensor("gelsight_dome")).gelpad.sag(x, y) - dome.sag(x, y)).max() < 0.2e-9


@pytest.mark.parametrize("physics", ["rigid", "ipc"])
@pytest.mark.filterwarnings("ignore::raytac.physics.soft.contact_width.NarrowContactWarning")
def test_a_map_of_a_dome_presses_as_the_dome(physics: str) -> None:
    dome, mapped = pressed(False, physics), pressed(True, physics)
    assert dome.force[0, 2] < -0.1
    assert mapped.wrench == pytest.approx(dome.wrench, rel=2e-4, abs=1e-4)
    assert np.abs(mapped.height - dome.height).max() < 1e-7 and dome.surface.indentation.max() > 0.4e-3
    difference = np.abs(mapped.rgb.astype(int) - dome.rgb)
    assert difference.max() <= 2 and difference.mean() < 0.02 and dome.rgb.std() > 5.0
    if physics == "ipc":
        moved = dome.markers.displacement
        assert np.abs(mapped.markers.displacement - moved).max() < 1e-6 < np.abs(moved).max()


@pytest.mark.parametrize("kind", ["sphere", "box", "cylinder"])
def test_the_contact_search_of_worlds_measures_a_map_as_the_dome(kind: str) -> None:
    spec = load_sensor("gelsight_dome")
    size = {"sphere": (4e-3,), "box": (3e-3, 2e-3, 2e-3), "cylinder": (2e-3, 5e-3)}[kind]
    poses = np.tile(np.eye(4), (6, 1, 1, 1, 1))
    rng = np.random.default_rng(3)
    poses[:, 0, 0, :2, 3] = rng.uniform(-5e-3, 5e-3, (6, 2))
    turn = 0.15
    poses[:, 0, 0, :3, :3] = [[1, 0, 0], [0, math.cos(turn), -math.sin(turn)], [0, math.sin(turn), math.cos(turn)]]
    x, y = poses[:, 0, 0, 0, 3], poses[:, 0, 0, 1, 3]
    poses[:, 0, 0, 2, 3] = size[-1] - spec.gelpad.sag(x, y) - 0.4e-3
    dome, mapped = (
        PadSearch([gelpad], [(primitive(kind, size),)], num_envs=6).contacts(poses, np.arange(6), 0.0)
        for gelpad in (spec.gelpad, as_map(spec).gelpad)
    )
    assert len(dome.depth) == len(mapped.depth) == 6 and dome.depth.min() > 0.1e-3
    assert mapped.depth == pytest.approx(dome.depth, abs=2e-6)
    assert np.abs(mapped.normal - dome.normal).max() < 0.01 and np.abs(dome.normal[:, :2]).max() > 0.02
    assert np.abs(mapped.centre - dome.centre).max() < 50e-6
    loads = [LoadTables(found, np.full(6, spec.gelpad.thickness)).force(np.full(6, 0.3e-3))[0] for found in (dome, mapped)]
    assert loads[1] == pytest.approx(loads[0], rel=0.02) and loads[0].min() > 0.05


def test_a_table_baked_on_a_map_of_a_dome_is_the_domes() -> None:
    images = []
    for spec in (load_sensor("gelsight_dome"), as_map(load_sensor("gelsight_dome"))):
        at = Calibration(spec, device="cpu", resolution=(64, 48))
        settings = BakeSettings(images=16, n_bins=45, pins=0, radius=(3e-3, 5e-3), depth=(0.2e-3, 0.6e-3), bare_share=1.0)
        mode = Taxim(calibration=calibrate(at, settings=settings).table).build(spec, resolution=(64, 48), device="cpu")
        ball = np.eye(4)
        ball[2, 3] = 4e-3 - 0.5e-3
        images.append(mode.render(pressed_surface(at.grid, [primitive("sphere", (4e-3,), ball)], None)).rgb[0].astype(int))
    assert np.abs(images[1] - images[0]).mean() < 0.1 and np.abs(images[1] - images[0]).max() <= 8
    assert images[0].std() > 5.0


def test_a_world_takes_a_written_sensor_with_a_map_of_its_gel(tmp_path: Path) -> None:
    """Two pads as fingers, whose gels may touch each other, closed until they do."""
    mini, readings = as_map(load_sensor("gelsight_mini")), []
    for name, text in (sensor_files(mini) | {"lights.toml": lights_text(mini.lights, "of a test")}).items():
        (tmp_path / name).write_text(text, "utf-8")
    for sensor in ("gelsight_mini", str(tmp_path / "sensor.toml")):
        scene = load_task("lift_cube")
        world = TactileWorld(
            replace(scene, robot=replace(scene.robot, sensor=sensor)), outputs=("wrench", "height"), device="cpu"
        )
        for _ in range(40):
            state = world.step(lambda data, time, servo=world.composed.opening: data.ctrl.__setitem__(servo, 0.0))
        readings.append((np.concatenate([state.wrench[side][0] for side in ("left", "right")]), world.observe()["left"].height))
        assert not state.failed.any()
    (dome, dome_height), (mapped, mapped_height) = readings
    assert np.abs(dome[:3]).max() > 0.5, "the fingers have not met"
    assert mapped == pytest.approx(dome, rel=0.02, abs=0.02)
    assert np.abs(mapped_height - dome_height).max() < 10e-6
