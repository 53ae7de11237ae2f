"""Grain in images: its variance, its seeds, and where it does not go."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from raytac.cli import main
from raytac.errors import InputError, SpecError
from raytac.gel.surface import GelSurface
from raytac.io.images import read_png
from raytac.observe import ObservationSettings, TactileObserver
from raytac.optics.grain import Grain
from raytac.sensor import TactileSensor
from raytac.specs import SensorSpec, load_sensor
from raytac.specs.sensor import NoiseSpec
from raytac.specs.sensor_file import lights_text, sensor_files

DARK, BRIGHT = (1.0, 4.0, 9.0), (16.0, 2.0, 9.0)


@pytest.fixture(scope="module")
def grainy() -> SensorSpec:
    return dataclasses.replace(load_sensor("gelsight_mini"), noise=NoiseSpec(DARK, BRIGHT))


@pytest.mark.parametrize(("resolution", "share"), [((320, 240), 1.0), ((160, 120), 0.25), ((640, 480), 1.0)])
def test_the_variance_is_that_of_the_file(grainy: SensorSpec, resolution: tuple[int, int], share: float) -> None:
    """Rounding to whole levels adds 1/12. A pixel that is the mean of four of the camera's has a quarter of the variance."""
    grain = Grain(grainy, resolution, seed=3, batch=2)
    for level in (60, 200):
        images = np.full((2, 300, 300, 3), level, np.uint8)
        off = grain.added(images, grain.seeds()).astype(float) - level
        expected = share * (np.array(DARK) + (np.array(BRIGHT) - np.array(DARK)) * level / 255) + 1 / 12
        np.testing.assert_allclose(off.var((0, 1, 2)), expected, rtol=0.03)
        assert np.abs(off.mean((0, 1, 2))).max() < 0.03
        white = np.corrcoef(off[0, :, 1:, 0].ravel(), off[0, :, :-1, 0].ravel())[0, 1], np.corrcoef(off[0].reshape(-1, 3).T)[0, 1]
        assert np.abs(white).max() < 0.02, "neither neighbours nor channels are correlated"


def test_draws_of_an_environment_do_not_depend_on_the_others(grainy: SensorSpec) -> None:
    many, one = (Grain(grainy, (320, 240), seed=3, batch=batch) for batch in (3, 1))
    assert many.seeds()[0] == one.seeds()[0]
    row = many.seeds([1, 1])
    assert row[0] == row[1]
    many.reseed(2, 11)
    one.reseed(0, 11)
    assert many.seeds([2]) == one.seeds()


def test_images_of_a_press_have_grain_on_request(grainy: SensorSpec) -> None:
    settings = {"resolution": (160, 120), "device": "cpu", "outputs": ("rgb", "layers")}
    clean, noisy, again = (
        TactileSensor(grainy, noise=noise, **settings).press("sphere")
        for noise in (False, True, True)  # type: ignore[arg-type]
    )
    assert (noisy.rgb != again.rgb).mean() < 1e-3, "one draw; rounding of the renderer may flip a level"
    off = noisy.rgb.astype(float) - clean.rgb
    level = clean.rgb.astype(float)
    sigma = np.sqrt(0.25 * (np.array(DARK) + (np.array(BRIGHT) - np.array(DARK)) * level / 255) + 1 / 12)
    assert (off / sigma).std() == pytest.approx(1, abs=0.02)
    for name, layer in clean.layers.items():
        np.testing.assert_allclose(noisy.layers[name], layer, rtol=1e-4, atol=1e-7, err_msg="rounding alone")
    sensor = TactileSensor(grainy, noise=True, **settings)  # type: ignore[arg-type]
    rest, plain = sensor.rest().rgb, TactileSensor(grainy, **settings).rest().rgb  # type: ignore[arg-type]
    assert (rest != plain).mean() < 1e-3, "no grain in the image at rest"


def test_successive_frames_differ_and_seeds_repeat_them(grainy: SensorSpec) -> None:
    sensor = TactileSensor(grainy, noise=True, resolution=(64, 48), device="cpu", num_envs=2)
    first, second = (sensor.press("sphere", seeds=[5, 6]).rgb for _ in range(2))
    np.testing.assert_array_equal(first, second)
    third = sensor.press("sphere").rgb
    assert (third != second).mean() > 0.3 and (first[0] != first[1]).mean() > 0.3


def test_a_seeded_environment_has_the_grain_of_a_single_one(grainy: SensorSpec) -> None:
    """Whichever of a batch it is, and whatever the others do."""
    many, one = (TactileSensor(grainy, noise=True, resolution=(64, 48), device="cpu", num_envs=count) for count in (3, 1))
    many.reseed_noise([2], [9])
    one.reseed_noise([0], [9])
    surface, alone = (GelSurface.at_rest(sensor.grid) for sensor in (many, one))
    for _ in range(2):
        row, single = many.update(surface, [2]).rgb, one.update(alone, [0]).rgb
        np.testing.assert_array_equal(row, single)
    TactileSensor(grainy, device="cpu").reseed_noise([0], [1])


def test_an_observer_hands_the_grain_on(grainy: SensorSpec) -> None:
    frames = []
    for noise in (False, True):
        settings = ObservationSettings(("rgb",), resolution=(80, 60), optics="raytrace", difference=True, noise=noise)
        observer = TactileObserver(grainy, settings)
        sensor = observer.make_sensor(device="cpu")
        frames.append(observer.observe(sensor.press("sphere"), sensor)["rgb"].astype(float))
    off = frames[1] - frames[0]
    # Halves of differences: the image at rest has no grain, so the standard deviation is half of an image's.
    mean = 0.5 * np.sqrt((80 * 60) / (320 * 240) * np.mean([*DARK, *BRIGHT]) + 1 / 12)
    assert off.std() == pytest.approx(mean, rel=0.35) and off.std() > 0.25
    with pytest.raises(InputError, match="is of images"):
        ObservationSettings(("wrench",), noise=True)


def test_a_sensor_without_noise_cannot_have_any() -> None:
    with pytest.raises(InputError, match=r"has no noise: give its file a \[noise\] table"):
        TactileSensor(dataclasses.replace(load_sensor("gelsight_mini"), noise=NoiseSpec()), noise=True)
    with pytest.raises(InputError, match="has no noise"):
        TactileObserver(
            dataclasses.replace(load_sensor("gelsight_mini"), noise=NoiseSpec()), ObservationSettings(("rgb",), noise=True)
        )


def test_the_command_adds_grain_on_request(grainy: SensorSpec, tmp_path: Path) -> None:
    for name, text in (sensor_files(grainy) | {"lights.toml": lights_text(grainy.lights, "")}).items():
        (tmp_path / name).write_text(text, "utf-8")
    args = [
        "press",
        "sphere",
        "--sensor",
        str(tmp_path / "sensor.toml"),
        "--resolution",
        "64x48",
        "--outputs",
        "rgb",
        "--device",
        "cpu",
    ]
    images = []
    for more in ([], ["--noise"]):
        assert main([*args, *more, "--out", str(tmp_path / "out")]) == 0
        images.append(read_png(tmp_path / "out" / "rgb.png").astype(float))
    assert 0.2 < (images[1] - images[0]).std() < 1.5


def test_noise_is_written_and_read(grainy: SensorSpec, tmp_path: Path) -> None:
    for sensor in (grainy, dataclasses.replace(grainy, source=None)):
        for name, text in (sensor_files(sensor) | {"lights.toml": lights_text(sensor.lights, "")}).items():
            (tmp_path / name).write_text(text, "utf-8")
        assert load_sensor(tmp_path / "sensor.toml").noise == grainy.noise
    none = dataclasses.replace(grainy, noise=NoiseSpec(), source=None)
    assert "[noise]" not in sensor_files(none)["sensor.toml"]
    with pytest.raises(SpecError, match=r"noise\.dark_variance"):
        NoiseSpec(dark_variance=(-1.0, 0.0, 0.0))
