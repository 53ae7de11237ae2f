"""Lights written as text read back as they were, to the digits that are written."""

from __future__ import annotations

from pathlib import Path

import pytest

from raytac.specs import available, load_lights
from raytac.specs.sensor_file import lights_text


@pytest.mark.parametrize("name", available("lights"))
def test_written_lights_read_back(name: str, tmp_path: Path) -> None:
    lights = load_lights(name)
    path = tmp_path / "lights.toml"
    path.write_text(lights_text(lights, "first line\nsecond line"), "utf-8")
    assert path.read_text("utf-8").startswith("# first line\n# second line\n")
    again = load_lights(path)
    for led, back in zip(lights.leds, again.leds, strict=True):
        assert (back.name, back.layer) == (led.name, led.layer)
        assert back.position == pytest.approx(led.position, abs=6e-6)
        assert back.axis == pytest.approx(led.axis, abs=1e-4)
        assert back.size == pytest.approx(led.size, abs=6e-6)
        assert back.lobe == pytest.approx(led.lobe, abs=6e-3)
        assert back.power == pytest.approx(led.power, rel=6e-4)
