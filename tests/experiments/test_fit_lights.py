"""The fit of lights: photographs that the ray tracer made itself, whose lights it must find again."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from raytac.calibrate.photographs import Photographs, press_balls
from raytac.errors import InputError
from raytac.gel.pad import make_grid
from raytac.io.metrics import read_metrics
from raytac.io.png import read_png, write_png
from raytac.optics.raytrace import RayTracer
from raytac.specs import LightsSpec, SensorSpec, load_lights, load_sensor
from raytac.specs.lights_text import lights_text

CIRCLES = np.array([[100, 80, 31], [220, 80, 30], [160, 120, 32], [100, 160, 30], [220, 160, 31], [160, 60, 30.0]])
DEPTH_FACTOR = 1.1


@pytest.fixture(scope="module")
def fit_lights() -> ModuleType:
    path = Path(__file__).parents[2] / "experiments" / "fit_lights.py"
    spec = importlib.util.spec_from_file_location("fit_lights", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fit_lights"] = module
    spec.loader.exec_module(module)
    return module


def photograph(sensor: SensorSpec, folder: Path) -> None:
    """Write what a real data folder holds, seen by ``sensor``."""
    folder.mkdir()
    shots = Photographs(np.empty(0), np.empty(0), CIRCLES, 3.155e-3)
    surface = press_balls(sensor, make_grid(sensor.gelpad, 0.3e-3), shots, DEPTH_FACTOR)
    rgb = RayTracer(sensor, device="cpu").render(surface).rgb
    assert rgb is not None
    write_png(folder / "background.png", rgb[0])
    rows = ["diameter,index,cx_px,cy_px,r_px,edge_score,fully_visible,depth_px"]
    for k, (image, (x, y, r)) in enumerate(zip(rgb[1:], CIRCLES, strict=True)):
        write_png(folder / f"6.310mm_{k:02d}.png", image)
        rows.append(f"6.310mm,{k},{x},{y},{r},20,1,10")
    (folder / "labels.csv").write_text("\n".join(rows), "utf-8")


def test_lights_that_made_the_photographs_are_found_again(fit_lights: ModuleType, tmp_path: Path) -> None:
    mini = load_sensor("gelsight_mini")
    photograph(mini, tmp_path / "data")
    wrong = []
    for led in mini.lights.leds:
        x, y, z = led.position
        moved = (x - np.sign(x) * 0.6e-3, y - np.sign(y) * 0.2e-3, z - 0.6e-3)
        wrong.append(dataclasses.replace(led, position=moved, power=tuple(1.25 * w for w in led.power)))
    (tmp_path / "wrong.toml").write_text(lights_text(LightsSpec(tuple(wrong)), "moved by 0.9 mm, a quarter too bright"), "utf-8")
    assert mini.source is not None
    sensor_file = mini.source.read_text("utf-8").replace('lights = "gelsight_mini"', 'lights = "wrong.toml"')
    (tmp_path / "start.toml").write_text(sensor_file, "utf-8")
    out = tmp_path / "out"
    data, start = tmp_path / "data", str(tmp_path / "start.toml")
    args = fit_lights.Args(data=data, sensor=start, depth_factor=DEPTH_FACTOR, out=out, device="cpu", quick=True, refine=False)
    fit_lights.main(args)

    # Rounding to 8 bit, averaging over 8 x 8 pixels and the light from the case, fitted about the wrong lights, leave a rest.
    metrics = read_metrics(out / "metrics.json")
    assert float(metrics["start.flat_field.contact_mae"]) > 2 and float(metrics["start.plain.contact_mae"]) > 6
    assert float(metrics["fitted.flat_field.contact_mae"]) < 0.5 and float(metrics["fitted.plain.contact_mae"]) < 0.7
    assert max(float(metrics[f"fitted.rest_rms.{colour}"]) for colour in ("red", "green", "blue")) < 0.7
    found = load_lights(out / "lights.toml").leds
    off = 1e3 * np.linalg.norm(
        [np.subtract(led.position, true.position) for led, true in zip(found, mini.lights.leds, strict=True)], axis=1
    )
    assert off.max() < 0.6 and off.mean() < 0.3, f"LEDs were moved by 0.87 mm and end {off} mm away"
    power = np.array([max(led.power) / max(true.power) for led, true in zip(found, mini.lights.leds, strict=True)])
    np.testing.assert_allclose(power, 1, atol=0.1)
    assert read_png(out / "presses.png").ndim == 3


def test_a_folder_without_photographs_is_refused_before_anything_is_written(fit_lights: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"data = .*none.: must exist"):
        fit_lights.main(fit_lights.Args(data=tmp_path / "none", out=tmp_path / "out", device="cpu"))
    assert not (tmp_path / "out").exists()
