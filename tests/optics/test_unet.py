"""The U-Net's mode: files, the image at rest, agreement with a plain evaluation, batches, dots, sizes, and a fit that lowers the error."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from raytac.assets import asset_root
from raytac.errors import BackendError, CalibrationError, InputError
from raytac.gel.surface import GelSurface
from raytac.optics import Unet, UnetWeights, load_unet, look_digest, save_unet
from raytac.optics.image.network_files import view_size
from raytac.optics.image.unet_weights import INPUTS, layer_shapes
from raytac.specs import load_sensor
from tests.conftest import make_sensor_spec
from tests.optics.scenes import ball, grid_of, surface

RESOLUTION, WIDTHS = (80, 60), (4, 6, 8)


def network(seed: int = 0) -> UnetWeights:
    rng = np.random.default_rng(seed)
    layers = {
        name: rng.normal(0, 0.5 if len(shape) == 1 else (2 / np.prod(shape[1:])) ** 0.5, shape)
        .astype(np.float16)
        .astype(np.float32)
        for name, shape in layer_shapes(WIDTHS).items()
    }
    layers["last.weight"] *= 0.5
    return UnetWeights(WIDTHS, layers, rng.integers(60, 160, (60, 80, 3)).astype(np.uint8))


def pressed(spec: Any, batch: int = 1) -> GelSurface:
    grid = grid_of(spec)
    presses = [ball(grid, centre=(1e-3 * k, -5e-4 * k)) for k in range(batch)]
    return surface(grid, *(height for height, _ in presses), contact=np.stack([contact for _, contact in presses]))


def test_files_come_back_or_are_refused(tmp_path: Path) -> None:
    spec = make_sensor_spec()
    weights = dataclasses.replace(network(), provenance={"sensor": "mine"}, view=view_size(spec))
    save_unet(weights, tmp_path / "unet.npz")
    again = load_unet(tmp_path)
    assert (again.widths, again.provenance, again.view) == (WIDTHS, weights.provenance, pytest.approx(weights.view))
    np.testing.assert_array_equal(again.background, weights.background)
    for name, array in weights.layers.items():
        np.testing.assert_allclose(again.layers[name], array, rtol=1e-3)
    with pytest.raises(CalibrationError, match="holds one"):
        load_unet(tmp_path / "none.npz")
    for name, broken, match in (
        ("shape", dataclasses.replace(weights, layers=weights.layers | {"last.bias": np.zeros(4)}), r"last\.bias"),
        ("number", dataclasses.replace(weights, layers=weights.layers | {"last.bias": np.full(3, np.nan)}), r"last\.bias"),
        ("background", dataclasses.replace(weights, background=weights.background[:5]), "background"),
        ("widths", dataclasses.replace(weights, widths=(4, 6, 0)), "widths"),
    ):
        save_unet(broken, tmp_path / f"{name}.npz")
        with pytest.raises(CalibrationError, match=match):
            load_unet(tmp_path / f"{name}.npz")


def test_without_pytorch_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    import builtins

    real = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.split(".")[0] == "torch":
            raise ImportError("No module named 'torch'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(BackendError, match=r"needs PyTorch .*pip install torch"):
        Unet(weights=network()).build(make_sensor_spec(), device="cpu")


def test_a_look_is_what_the_files_say_wherever_they_lie(tmp_path: Path) -> None:
    mini = load_sensor("gelsight_mini")
    assert mini.source is not None and mini.lights.source is not None
    text = mini.source.read_text("utf-8")
    assert 'lights = "gelsight_mini"' in text
    (tmp_path / "mini.toml").write_text(text.replace('lights = "gelsight_mini"', 'lights = "lights.toml"'), "utf-8")
    lights = mini.lights.source.read_text("utf-8")
    (tmp_path / "lights.toml").write_text(lights, "utf-8")
    assert look_digest(load_sensor(tmp_path / "mini.toml")) == look_digest(mini)
    assert "lobe = 5.11" in lights
    (tmp_path / "lights.toml").write_text(lights.replace("lobe = 5.11", "lobe = 5.12"), "utf-8")
    assert look_digest(load_sensor(tmp_path / "mini.toml")) != look_digest(mini)


def test_the_shipped_network_is_of_the_default_minis_look() -> None:
    shipped = load_unet(asset_root("scenes") / "networks" / "gelsight_mini_unet.npz")
    assert shipped.provenance["sensor"] == "gelsight_mini"
    assert shipped.provenance["look"] == look_digest(load_sensor("gelsight_mini"))


class TestWithTorch:
    """What needs PyTorch, which raytac does not install."""

    @pytest.fixture(autouse=True)
    def _needs_torch(self) -> None:
        pytest.importorskip("torch")

    def test_the_image_at_rest_is_the_background(self) -> None:
        weights, spec = network(), make_sensor_spec()
        mode = Unet(weights=weights).build(spec, resolution=RESOLUTION, device="cpu")
        rgb = mode.render(GelSurface.at_rest(grid_of(spec))).rgb
        assert rgb is not None
        np.testing.assert_array_equal(rgb[0], weights.background)

    def test_a_pixel_is_the_networks_own_by_plain_loops(self) -> None:
        """One level and no pooling: two convolutions written out, on the maps that the mode itself sees."""
        rng = np.random.default_rng(3)
        shapes = layer_shapes((5,))
        layers = {name: rng.normal(0, 0.3, shape).astype(np.float32) for name, shape in shapes.items()}
        weights, spec = UnetWeights((5,), layers, np.full((60, 80, 3), 90, np.uint8)), make_sensor_spec()
        mode = Unet(weights=weights).build(spec, resolution=RESOLUTION, device="cpu")
        shown = pressed(spec)
        levels = mode.render_levels(shown)[0]
        maps = mode.maps(shown)[0].numpy()
        assert maps[2].max() > 0.2 and set(np.unique(maps[3])) == {0.0, 1.0}, "displacement in mm, and contact"
        width, height = RESOLUTION

        def net(maps: np.ndarray, row: int, column: int) -> np.ndarray:
            u, v = np.meshgrid((np.arange(width) + 0.5) * 2 / width - 1, (np.arange(height) + 0.5) * 2 / height - 1)
            x = np.stack([2 * maps[0], 2 * maps[1], maps[2], maps[3], u, v])
            patch = x[:, row - 2 : row + 3, column - 2 : column + 3]

            def convolved(x: np.ndarray, name: str) -> np.ndarray:
                kernel, side = layers[f"{name}.weight"], x.shape[1] - 2
                out = [
                    [(kernel * x[None, :, i : i + 3, j : j + 3]).sum((1, 2, 3)) + layers[f"{name}.bias"] for j in range(side)]
                    for i in range(side)
                ]
                return np.maximum(np.array(out), 0).transpose(2, 0, 1)

            return (
                layers["last.weight"][:, :, 0, 0] @ convolved(convolved(patch, "down0.0"), "down0.2")[:, 0, 0]
                + layers["last.bias"]
            )

        assert len(maps) + 2 == INPUTS
        row, column = divmod(int(np.argmax(np.hypot(maps[0], maps[1])[3:-3, 3:-3])), width - 6)
        for at in ((row + 3, column + 3), (30, 40), (5, 70)):
            expected = 90 + 100 * (net(maps, *at) - net(0 * maps, *at))
            np.testing.assert_allclose(levels[at], expected, atol=0.02)
        assert np.abs(levels - 90).max() > 10

    def test_a_batch_is_its_single_images_and_what_failed_is_marked(self) -> None:
        spec = make_sensor_spec()
        mode = Unet(weights=network(1)).build(spec, resolution=RESOLUTION, device="cpu")
        shown = pressed(spec, 3)
        shown.height[1, 3, 3] = np.nan
        rgb = mode.render(shown).rgb
        assert rgb is not None and (rgb[1] == 0).all()
        for k in (0, 2):
            alone = mode.render(shown.rows([k])).rgb
            assert alone is not None
            assert np.abs(alone[0].astype(int) - rgb[k]).max() <= 1
        assert (rgb[0] != rgb[2]).any()

    def test_other_sizes_are_the_same_image(self) -> None:
        spec, weights = make_sensor_spec(), network(2)
        weights = dataclasses.replace(weights, background=np.full((60, 80, 3), 100, np.uint8))
        shown = pressed(spec)
        whole = Unet(weights=weights).build(spec, resolution=RESOLUTION, device="cpu").render_levels(shown)[0]
        half = Unet(weights=weights).build(spec, resolution=(40, 30), device="cpu").render_levels(shown)[0]
        assert half.shape == (30, 40, 3)
        blocks = whole.reshape(30, 2, 40, 2, 3).mean((1, 3))
        assert np.corrcoef(half.ravel(), blocks.ravel())[0, 1] > 0.98

    def test_dots_darken_the_image(self) -> None:
        spec = make_sensor_spec()
        mode = Unet(weights=dataclasses.replace(network(), background=np.full((60, 80, 3), 120, np.uint8))).build(
            spec, resolution=RESOLUTION, device="cpu"
        )
        rest = GelSurface.at_rest(grid_of(spec))
        ink = np.zeros_like(rest.height)
        ny, nx = ink.shape[1:]
        ink[0, ny // 2 - 3 : ny // 2 + 3, nx // 2 - 3 : nx // 2 + 3] = 1.0
        rgb = mode.render(dataclasses.replace(rest, ink=ink)).rgb
        assert rgb is not None
        assert rgb[0, 30, 40].max() < 80 and (rgb[0, 5, 5] == 120).all()

    def test_the_shipped_network_is_of_the_default_minis_look_alone(self) -> None:
        mini = load_sensor("gelsight_mini")
        mode = Unet().build(mini, device="cpu")
        assert mode.weights.provenance["look"] == look_digest(mini) == look_digest(load_sensor("gelsight_mini_9x11"))
        with pytest.raises(InputError, match="must name a network for the sensor 'gelsight_mini_calibrated'"):
            Unet().build(load_sensor("gelsight_mini_calibrated"), device="cpu")

    def test_a_network_of_another_view_is_refused(self) -> None:
        spec = make_sensor_spec()
        weights = dataclasses.replace(network(), provenance={"sensor": "mine"}, view=tuple(1.2 * w for w in view_size(spec)))
        with pytest.raises(InputError, match="fitted to the sensor 'mine'"):
            Unet(weights=weights).build(spec, device="cpu")
