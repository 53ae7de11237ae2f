"""Scripts of the sensors' page: a fit to made-up photographs of a DIGIT beats the image at rest on others, and the gallery draws."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments import fit_digit, sensor_gallery
from raytac.calibrate.imprint import RIGID_PAD, press_surface
from raytac.errors import InputError
from raytac.gel.surface import GelSurface, make_grid
from raytac.io.images import read_png, write_png
from raytac.io.metrics import read_metrics
from raytac.optics import RayTraced
from raytac.specs import load_sensor

PLACES = np.array([[u, v] for v in (100.0, 160.0, 220.0) for u in (80.0, 120.0, 160.0)] + [[100.0, 130.0]])


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten presses of a ball of 6 mm, as the shipped DIGIT shows them without shadows, with noise of one level."""
    folder = tmp_path_factory.mktemp("digit")
    sensor = load_sensor("digit")
    sensor = replace(sensor, response=replace(sensor.response, exposure="auto"))
    mode = RayTraced(shadows=False).build(sensor, device="cpu")
    grid = make_grid(sensor.gelpad, 0.12e-3)
    circles = np.column_stack([PLACES, np.full(len(PLACES), 36.0)])
    images = mode.render(press_surface(sensor, grid, circles, np.full(len(PLACES), 3e-3), RIGID_PAD)).rgb
    assert images is not None and images.std() > 10
    noise = np.random.default_rng(0).normal(size=images.shape)
    for k, image in enumerate(np.clip(np.rint(images + noise), 0, 255).astype(np.uint8)):
        write_png(folder / f"{k:04d}.png", image)
    return folder


def test_a_fit_is_nearer_than_the_image_at_rest(photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By half, after a third of the steps that a fit may take."""
    monkeypatch.setattr("raytac.calibrate.ray_fit.FIRST", 30)
    out = tmp_path / "run"
    fit_digit.main(fit_digit.Args(data=photographs, leds=1, rounds=0, shadows=False, out=out, device="cpu"))
    metrics = read_metrics(out / "metrics.json")
    assert metrics["held_out"] == 2 and metrics["fitted"] == 8
    assert float(metrics["flat_field.contact_mae"]) < 0.5 * float(metrics["background.contact_mae"])
    assert float(metrics["file.contact_mae"]) < 0.6 * float(metrics["background.contact_mae"])
    fitted = load_sensor(out / "sensor.toml")
    assert fitted.gelpad == load_sensor("digit").gelpad and not fitted.optics.shadows
    rest = RayTraced().build(fitted, device="cpu").render(GelSurface.at_rest(make_grid(fitted.gelpad, 0.1e-3))).rgb
    assert rest is not None and rest.std() > 3
    assert read_png(out / "photographs.png").std() > 10


def test_too_few_photographs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must hold at least 10 photographs"):
        fit_digit.main(fit_digit.Args(data=tmp_path, out=tmp_path / "run"))


def test_the_gallery_draws_every_object_in_every_sensor(tmp_path: Path) -> None:
    out = tmp_path / "run"
    sensor_gallery.main(sensor_gallery.Args(sensors="digit, gelsight_r15", objects="sphere", out=out, device="cpu"))
    metrics = read_metrics(out / "metrics.json")
    assert all(float(metrics[f"{name}.sphere.contact_mm2"]) > 3 for name in ("digit", "gelsight_r15"))
    assert all(float(metrics[f"{name}.sphere.change"]) > 10 for name in ("digit", "gelsight_r15"))
    picture = read_png(out / "sensors.png")
    assert picture.shape[1] > 250 and picture.std() > 20
