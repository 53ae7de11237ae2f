"""A press writes the files that were asked for, and they say the same as the frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from raytac.errors import InputError, RaytacError
from raytac.frame import OUTPUTS
from raytac.io.images import read_exr, read_png, write_png, write_sheet
from raytac.io.metrics import read_metrics
from raytac.report.press import run_press
from raytac.sensor import TactileSensor
from raytac.specs import PressScene, SensorSpec, load_press
from tests.conftest import Shader

SIZE = (64, 48)


@pytest.fixture(scope="module")
def scene() -> PressScene:
    return load_press("sphere")


def sensor_with(spec: SensorSpec, mode: Shader) -> TactileSensor:
    return TactileSensor(spec, optics=mode, outputs=OUTPUTS, resolution=SIZE, pitch=0.2e-3)


def test_everything_asked_for_is_written_once(sensor_spec: SensorSpec, scene: PressScene, tmp_path: Path) -> None:
    mode = Shader(sensor_spec, SIZE)
    sensor = sensor_with(sensor_spec, mode)
    written = run_press(sensor, scene, tmp_path / "out", outputs=OUTPUTS)
    names = {"rgb.png", "frame.exr", "height.npy", "traction.npy", "preview.png", "metrics.json"}
    assert {path.name for path in written} == names == {path.name for path in (tmp_path / "out").iterdir()}
    assert mode.rendered == 2  # the untouched pad and the press

    channels, header = read_exr(tmp_path / "out" / "frame.exr")
    lights = {f"led_{name}.{c}" for name in ("red", "green", "blue") for c in "RGB"}
    assert set(channels) == {"R", "G", "B", "N.X", "N.Y", "N.Z", "P.X", "P.Y", "P.Z", "Z"} | lights
    np.testing.assert_allclose(channels["G"], sum(channels[f"led_{name}.G"] for name in ("red", "green", "blue")), rtol=1e-6)
    np.testing.assert_allclose(channels["Z"], channels["P.Z"] - sensor_spec.camera.position[2], atol=1e-8)
    assert (header["sensor"], header["scene"], header["mode"], header["seed"]) == ("test_sensor", "sphere", "rigid+shader", "0")
    assert header["unitsDepth"] == "m" and "version:raytac" in header
    assert header["resolution"] == "64x48" and header["layers"] == "led_red led_green led_blue"

    rgb = read_png(tmp_path / "out" / "rgb.png")
    linear = np.stack([channels[c] for c in "RGB"], axis=-1)
    assert np.abs(rgb - 255 * np.clip(linear, 0, 1) ** (1 / 2.2)).max() <= 0.51

    height = np.load(tmp_path / "out" / "height.npy")
    assert height.dtype == np.float32 and height.shape == sensor.grid.shape
    metrics = read_metrics(tmp_path / "out" / "metrics.json")
    assert metrics["contact.max_indentation_mm"] == pytest.approx(1e3 * float((sensor.grid.rest - height).max()), rel=1e-5)
    assert float(metrics["contact.force_z_n"]) < 0.0
    traction = np.load(tmp_path / "out" / "traction.npy")
    assert traction.shape == (*sensor.grid.shape, 3) and metrics["contact.max_pressure_kpa"] == pytest.approx(
        -1e-3 * traction[..., 2].min()
    )
    assert float(metrics["contact.surface_area_mm2"]) > 0.0 and float(metrics["contact.force_law_area_mm2"]) > 0.0
    assert metrics["image.pixel_x_mm"] == pytest.approx(0.0634 * 320 / 64) == metrics["image.pixel_y_mm"]
    assert {"time.physics_ms", "time.surface_ms", "time.optics_ms", "wall_s", "device"} <= set(metrics)


@pytest.mark.parametrize(
    ("outputs", "files", "channels"),
    [
        (("rgb",), {"rgb.png", "frame.exr"}, {"R", "G", "B"}),
        (("depth",), {"frame.exr"}, {"Z"}),
        (("height",), {"height.npy"}, set()),
        (("wrench", "traction"), {"traction.npy"}, set()),
    ],
)
def test_only_what_was_asked_for_is_written(
    outputs: tuple[str, ...], files: set[str], channels: set[str], sensor_spec: SensorSpec, scene: PressScene, tmp_path: Path
) -> None:
    run_press(sensor_with(sensor_spec, Shader(sensor_spec, SIZE)), scene, tmp_path, outputs=outputs)
    assert {path.name for path in tmp_path.iterdir()} == files | {"preview.png", "metrics.json"}
    if channels:
        assert set(read_exr(tmp_path / "frame.exr")[0]) == channels


def test_a_second_press_leaves_nothing_of_the_first(sensor_spec: SensorSpec, scene: PressScene, tmp_path: Path) -> None:
    sensor = sensor_with(sensor_spec, Shader(sensor_spec, SIZE))
    run_press(sensor, scene, tmp_path, outputs=OUTPUTS)
    (tmp_path / "notes.txt").write_text("mine")
    run_press(sensor, scene, tmp_path, outputs=("height",))
    assert {path.name for path in tmp_path.iterdir()} == {"height.npy", "preview.png", "metrics.json", "notes.txt"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_press_leaves_nothing(
    error: type[BaseException], sensor_spec: SensorSpec, scene: PressScene, tmp_path: Path
) -> None:
    with pytest.raises(error):
        run_press(sensor_with(sensor_spec, Shader(sensor_spec, SIZE, error)), scene, tmp_path / "out", outputs=OUTPUTS)
    assert not list(tmp_path.iterdir())


def test_a_failed_environment_writes_nothing(sensor_spec: SensorSpec, scene: PressScene, tmp_path: Path) -> None:
    class Failing(TactileSensor):
        def press(self, scene: PressScene, **options):  # type: ignore[override]

            return super().press(scene, **options).with_values(failed=np.array([True]))

    sensor = Failing(sensor_spec, optics=Shader(sensor_spec, SIZE), resolution=SIZE, pitch=0.5e-3)
    with pytest.raises(RaytacError, match=r"'sphere' did not settle"):
        run_press(sensor, scene, tmp_path / "out", outputs=("rgb",))
    assert not list(tmp_path.iterdir())


def test_the_image_is_shown_on_a_photograph_that_the_seed_draws(
    sensor_spec: SensorSpec, scene: PressScene, tmp_path: Path
) -> None:
    folder, grey = tmp_path / "untouched", {"a.png": 60, "b.png": 120, "c.png": 200}
    folder.mkdir()
    for name, value in grey.items():
        write_png(folder / name, np.full((SIZE[1], SIZE[0], 3), value, np.uint8))
    drawn = set()
    for seed in (0, 1, 11):
        sensor = TactileSensor(
            sensor_spec, optics=Shader(sensor_spec, SIZE), outputs=("rgb",), resolution=SIZE, pitch=0.5e-3, seed=seed
        )
        run_press(sensor, scene, tmp_path / "out", outputs=("rgb",), background=folder)
        name = str(read_metrics(tmp_path / "out" / "metrics.json")["image.background"])
        drawn.add(name)
        shown, rest, pressed = read_png(tmp_path / "out" / "rgb.png"), sensor.rest().rgb[0], sensor.press(scene).rgb[0]
        untouched = rest == pressed
        assert 0.1 < untouched.mean() < 0.9 and (shown[untouched] == grey[name]).all()
        ratio = grey[name] * (pressed[~untouched] / np.maximum(rest[~untouched], 4.0))
        np.testing.assert_allclose(shown[~untouched], np.minimum(ratio, 255.0), atol=0.51)
    assert len(drawn) == 3


@pytest.mark.parametrize(
    ("background", "outputs", "words"),
    [
        ("missing.png", ("rgb",), "missing.png: must exist"),
        ("empty", ("rgb",), "empty: must be an image file, or a folder with PNG files"),
        ("text.png", ("rgb",), "text.png: must be readable as an image"),
        ("small.png", ("rgb",), "small.png: has 32x24 px and the image 64x48: resolution 32x24 renders at its size"),
        ("small.png", ("height",), "small.png: is shown in rgb, which is not among the outputs"),
    ],
)
def test_a_photograph_that_cannot_be_shown_is_refused_before_the_press(
    background: str, outputs: tuple[str, ...], words: str, sensor_spec: SensorSpec, scene: PressScene, tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.png").write_text("no image")
    write_png(tmp_path / "small.png", np.zeros((24, 32, 3), np.uint8))
    mode = Shader(sensor_spec, SIZE)
    with pytest.raises(InputError, match=words):
        run_press(sensor_with(sensor_spec, mode), scene, tmp_path / "out", outputs=outputs, background=tmp_path / background)
    assert mode.rendered == 0 and not (tmp_path / "out").exists()


def test_sheet_holds_the_pictures_in_order(tmp_path: Path) -> None:
    red, blue = np.zeros((4, 6, 3), np.uint8), np.zeros((5, 3, 3), np.uint8)
    red[..., 0], blue[..., 2] = 255, 255
    write_png(tmp_path / "a.png", red)
    write_png(tmp_path / "b.png", blue)
    write_sheet([tmp_path / "a.png", tmp_path / "b.png"], tmp_path / "sheet.png", gap=2)
    sheet = read_png(tmp_path / "sheet.png")
    assert sheet.shape == (11, 6, 3)
    assert (sheet[:4] == red).all() and (sheet[6:, :3] == blue).all()
    assert (sheet[4:6] == 255).all() and (sheet[6:, 3:] == 255).all()
