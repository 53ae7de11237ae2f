"""The main job with the real physics and the real ray tracer: the command writes its folder, and the README's Python runs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

import raytac
from raytac.cli import main
from raytac.frame import TactileFrame
from raytac.io.images import read_exr, read_png
from raytac.io.metrics import read_metrics
from raytac.specs import load_sensor
from tests import coarse_figures

ROOT = Path(__file__).parents[1]
LAYERS = ("red", "green", "blue")
SIZE = (160, 120)
FILES = {"rgb.png", "frame.exr", "height.npy", "traction.npy", "preview.png", "metrics.json"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("press") / "coin"
    size = "x".join(map(str, SIZE))
    assert main(["press", "coin", "--resolution", size, "--device", "cpu", "--seed", "4", "--out", str(out)]) == 0
    return out


def test_every_file_is_there(folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == FILES
    preview = read_png(folder / "preview.png")
    assert preview.shape[1] > 7.0 * coarse_figures.MOST and preview.std() > 20


def test_exr_has_the_documented_channels_and_its_layers_sum_to_the_image(folder: Path) -> None:
    channels, header = read_exr(folder / "frame.exr")
    lights = {f"led_{name}.{c}" for name in LAYERS for c in "RGB"}
    assert set(channels) == {*"RGB", "Z", *(f"{v}.{c}" for v in "NP" for c in "XYZ"), *lights}
    for name, image in channels.items():
        assert image.shape == SIZE[::-1] and np.isfinite(image).all(), name
    for c in "RGB":
        summed = sum(channels[f"led_{name}.{c}"] for name in LAYERS)
        np.testing.assert_allclose(summed, channels[c], rtol=1e-5, atol=1e-7)
    assert (header["sensor"], header["scene"], header["mode"], header["seed"]) == (
        "gelsight_mini",
        "coin",
        "rigid+raytrace-fast",
        "4",
    )
    assert "version:mitsuba" in header


def test_rgb_is_the_exr_through_the_cameras_response(folder: Path) -> None:
    channels, _ = read_exr(folder / "frame.exr")
    linear = np.stack([channels[c] for c in "RGB"], axis=-1)
    sensor = load_sensor("gelsight_mini")
    response, (a1, a2, a3) = sensor.response, sensor.response.vignetting
    v, u = np.indices(SIZE[::-1]) + 0.5
    scale = SIZE[0] / sensor.camera.resolution[0]
    cx, cy = (scale * c for c in sensor.camera.principal_point)
    r2 = ((u - cx) ** 2 + (v - cy) ** 2) / (0.25 * (SIZE[0] ** 2 + SIZE[1] ** 2))
    gain = response.exposure * (1 + a1 * r2 + a2 * r2**2 + a3 * r2**3)[..., None] * np.array(response.white_balance)
    x, y = 2 * u / SIZE[0] - 1, 2 * v / SIZE[1] - 1
    for c, found in enumerate(response.shading):
        degree = next(n for n in range(20) if (n + 1) * (n + 2) // 2 == len(found))
        table, rest = np.zeros((degree + 1, degree + 1)), list(found)
        for i in range(degree + 1):
            table[i, : degree + 1 - i], rest = rest[: degree + 1 - i], rest[degree + 1 - i :]
        gain[..., c] *= np.exp(np.polynomial.chebyshev.chebval2d(x, y, table))
    value = np.clip(gain * linear + response.black_level, 0, 1)
    rgb = read_png(folder / "rgb.png")
    assert np.abs(rgb - 255 * value ** (1 / response.gamma)).max() <= 1.0
    assert rgb.shape == (SIZE[1], SIZE[0], 3) and rgb.std() > 5 and 20 < rgb.mean() < 235


def test_geometry_agrees_between_the_files(folder: Path) -> None:
    channels, _ = read_exr(folder / "frame.exr")
    height = np.load(folder / "height.npy")
    sensor = load_sensor("gelsight_mini")
    assert height.dtype == np.float32 and height.max() < 2e-4
    np.testing.assert_allclose(channels["Z"], channels["P.Z"] - sensor.camera.position[2], atol=1e-7)
    np.testing.assert_allclose(np.sqrt(sum(channels[f"N.{c}"] ** 2 for c in "XYZ")), 1, atol=1e-4)
    assert channels["N.Z"].max() < 0
    # Each seen point lies on the surface that the physics gave.
    (ny, nx), (width, depth) = height.shape, sensor.gelpad.size
    rows, columns = (channels["P.Y"] / depth + 0.5) * (ny - 1), (channels["P.X"] / width + 0.5) * (nx - 1)
    assert np.abs(channels["P.Z"] - map_coordinates(height, [rows, columns], order=1)).max() < 2e-6


def test_metrics_tell_time_contact_and_versions(folder: Path) -> None:
    metrics = read_metrics(folder / "metrics.json")
    for stage in ("physics", "surface", "optics"):
        assert float(metrics[f"time.{stage}_ms"]) > 0
    assert metrics["device"] == "cpu" and metrics["seed"] == 4 and metrics["mode"] == "rigid+raytrace-fast"
    assert (metrics["image.width_px"], metrics["image.height_px"]) == SIZE
    assert "versions.mitsuba" in metrics and float(metrics["wall_s"]) > 0
    assert float(metrics["contact.max_indentation_mm"]) == pytest.approx(0.7, abs=0.1)
    assert float(metrics["image.change_from_rest_mean_u8"]) > 2


def test_another_sensor_needs_no_python(tmp_path: Path) -> None:
    """Three boards of LEDs on a dome, from its files alone: each board is a layer and lights the side that faces it."""
    size = "128x96"
    out = tmp_path / "dome"
    command = ["press", "sphere", "--sensor", "gelsight_dome", "--resolution", size, "--device", "cpu", "--out", str(out)]
    assert main(command) == 0
    assert {path.name for path in out.iterdir()} == FILES
    sensor = load_sensor("gelsight_dome")
    channels, header = read_exr(out / "frame.exr")
    assert header["sensor"] == "gelsight_dome" and header["layers"].split() == [f"led_{name}" for name in sensor.lights.layers]
    rgb = read_png(out / "rgb.png")
    assert rgb.shape == (96, 128, 3) and rgb.std() > 5 and 20 < rgb.mean() < 235
    metrics = read_metrics(out / "metrics.json")
    assert float(metrics["contact.max_indentation_mm"]) == pytest.approx(0.8, abs=0.05)
    assert float(metrics["image.change_from_rest_max_u8"]) > 20
    # Light comes from the side of its board: the image's brightest half lies there.
    for name in sensor.lights.layers:
        x, y = np.mean([led.position[:2] for led in sensor.lights.leds if led.layer == name], axis=0)
        layer = np.sum([channels[f"led_{name}.{c}"] for c in "RGB"], axis=0)
        towards = channels["P.X"] * x + channels["P.Y"] * y
        assert layer[towards > 0].mean() > 1.2 * layer[towards < 0].mean(), name


def run_snippets(page: str, numbers: tuple[int, ...], folder: Path, monkeypatch: pytest.MonkeyPatch) -> TactileFrame:
    """Last frame of Python blocks of a page, run on the CPU: a process has one device, and the other tests of this one use it."""
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), flags=re.S)
    assert len(snippets) == {"README.md": 2, "docs/guide/first-steps.md": 3}[page]
    monkeypatch.chdir(folder)  # shipped scenes are found from anywhere
    names: dict[str, object] = {"raytac": raytac}
    for number in numbers:
        assert "outputs=(" in snippets[number]
        exec(compile(snippets[number].replace("outputs=(", 'device="cpu", outputs=('), page, "exec"), names)
    frame = names["frame"]
    assert isinstance(frame, TactileFrame)
    return frame


def test_the_readmes_python_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = run_snippets("README.md", (0, 1), tmp_path, monkeypatch)
    assert frame.markers.displacement_px.shape == (1, 99, 2)
    assert not frame.wrench.any()  # the pad starts clear of the ball


def test_the_first_python_of_the_first_steps_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = run_snippets("docs/guide/first-steps.md", (0,), tmp_path, monkeypatch)
    assert frame.rgb.shape == (1, 240, 320, 3) and frame.rgb.dtype == np.uint8
    assert frame.depth.shape == (1, 240, 320) and frame.depth.dtype == np.float32
    assert frame.force.shape == (1, 3)


def test_the_soft_pad_of_the_first_steps_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = run_snippets("docs/guide/first-steps.md", (1,), tmp_path, monkeypatch)
    assert frame.wrench[0, 2] < -1.0
    assert frame.traction[0, ..., 2].min() < -1e4
    assert frame.markers.displacement_px.shape == (1, 63, 2)
    assert np.nanmax(np.abs(frame.markers.displacement_px)) > 0.5


def test_the_world_of_the_first_steps_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = run_snippets("docs/guide/first-steps.md", (2,), tmp_path, monkeypatch)
    assert frame.markers.displacement_px.shape == (1, 99, 2)
    assert not frame.wrench.any()  # the pad starts clear of the ball
