"""What is written of a sensor is read back as the same sensor, from any folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from raytac.specs import SensorSpec, load_sensor
from raytac.specs.files import available
from raytac.specs.sensor import OpticsSpec
from raytac.specs.sensor_file import lights_text, sensor_files


def written(sensor: SensorSpec, folder: Path) -> SensorSpec:
    folder.mkdir()
    for name, text in sensor_files(sensor).items():
        (folder / name).write_text(text, "utf-8")
    (folder / "lights.toml").write_text(lights_text(sensor.lights, "of a test"), "utf-8")
    return load_sensor(folder / "sensor.toml")


def same(sensor: SensorSpec, back: SensorSpec) -> bool:
    """All but names and files; lights are written to few digits."""
    return replace(back, name=sensor.name, source=sensor.source, lights=sensor.lights) == sensor


@pytest.mark.parametrize("name", available("sensor"))
def test_a_shipped_sensor_is_named_as_base_and_another_is_written_as_a_whole(name: str, tmp_path: Path) -> None:
    shipped = load_sensor(name)
    response = replace(shipped.response, colour_mix=(-0.1, -0.02, 0.0, 0.3, -0.25, 0.0), tone=(0.2, -0.05))
    sensor = replace(shipped, optics=OpticsSpec(shadows=False), response=response)
    assert sensor_files(sensor)["sensor.toml"].startswith(f'base = "{name}"\n')
    assert same(sensor, written(sensor, tmp_path / "based"))
    x, y, z = sensor.camera.position
    farther = replace(sensor, camera=replace(sensor.camera, position=(x, y, round(1.25 * z, 5))))
    text = sensor_files(farther)["sensor.toml"]
    assert text.startswith(f'base = "{name}"\n') and "[camera]" in text and "[camera]" not in sensor_files(sensor)["sensor.toml"]
    assert same(farther, written(farther, tmp_path / "farther"))
    for other in (
        replace(sensor, source=None),
        replace(sensor, coat=replace(sensor.coat, roughness=0.123456789)),
        replace(sensor, gelpad=replace(sensor.gelpad, dome_radius=(float("inf"), 0.1), surface=None, bonded="back_and_sides")),
    ):
        text = sensor_files(other)["sensor.toml"]
        assert "base" not in text.split("[gelpad]")[0] and str(tmp_path) not in text
        assert same(other, written(other, tmp_path / f"whole{id(other)}"))


def test_the_map_of_a_pads_surface_goes_along(tmp_path: Path) -> None:
    finger = load_sensor("finger_example")
    assert sensor_files(finger).keys() == {"sensor.toml"}
    alone = replace(finger, source=None)
    assert sensor_files(alone).keys() == {"sensor.toml", "surface.csv"}
    back = written(alone, tmp_path / "whole")
    assert same(alone, back) and back.gelpad.surface == finger.gelpad.surface


def test_marker_motion_of_ones_own_goes_along(tmp_path: Path) -> None:
    sensor = load_sensor("gelsight_mini")
    assert sensor.marker_motion is not None
    mine = replace(
        sensor, source=None, marker_motion=replace(sensor.marker_motion, provenance="mine", source=tmp_path / "gone.toml")
    )
    assert set(sensor_files(sensor)) == {"sensor.toml"} and set(sensor_files(mine)) == {"sensor.toml", "marker_motion.toml"}
    back = written(mine, tmp_path / "own").marker_motion
    assert back is not None and back.provenance.strip() == "mine" and back.source == tmp_path / "own" / "marker_motion.toml"
    assert back.dilate_gain == pytest.approx(sensor.marker_motion.dilate_gain, rel=1e-5)
