"""Images that stay on the device against those of the host, here on the CPU: the same to the last bit, the same memory in PyTorch."""

from __future__ import annotations

import numpy as np
import pytest

from raytac.errors import InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.observe import ObservationSettings, Randomization, TactileObserver, as_tensors
from raytac.observe.device_images import DeviceImages
from raytac.optics import RayTraced
from raytac.sensor import TactileSensor

B = 3
DIRECT = {"optics": RayTraced(bounce=False)}
"""Quickest to build: light that comes straight from the LEDs."""


def dented(grid: PadGrid) -> GelSurface:
    """Pads with a dent each, at different places and of different depths."""
    at = np.array([[0.0, 0.0], [3e-3, -2e-3], [-4e-3, 1e-3]])
    square = (grid.x - at[:, :1, None]) ** 2 + (grid.y[:, None] - at[:, 1:, None]) ** 2
    dent = np.array([2e-4, 5e-4, 8e-4])[:, None, None] * np.exp(-square / (2 * (1.5e-3) ** 2))
    return GelSurface(grid, (grid.rest - dent).astype(np.float32), dent > 1e-4, at)


def both(**settings) -> tuple[TactileObserver, TactileSensor, DeviceImages]:
    made = ObservationSettings(("rgb",), **{**DIRECT, "resolution": (24, 16), **settings})
    observer = TactileObserver("gelsight_mini", made, num_envs=B)
    sensor = observer.make_sensor(device="cpu")
    return observer, sensor, DeviceImages(observer, sensor)


@pytest.mark.parametrize(
    "settings",
    [
        {"crop": (0, 0, 0, 0), "optics": "phong"},
        {"crop": (3, 1, 2, 4), "downscale": 3, "difference": True},
        {"resolution": (16, 16), "downscale": 2},
        {"difference": True},
    ],
)
def test_the_device_gives_what_the_host_does(settings: dict) -> None:
    observer, sensor, images = both(**settings)
    surface = dented(images.grid)
    expected = observer.observe(sensor.update(surface), sensor)["rgb"]
    for _ in range(2):  # recorded, then replayed
        found = np.asarray(images.observe(*images.upload(surface))["rgb"])
        np.testing.assert_array_equal(found, expected)
    assert len(np.unique(expected)) > 10 and (expected[0] != expected[1]).any()


def test_a_batch_of_another_size_is_another_recording() -> None:
    _, _, images = both(difference=True)
    surface = dented(images.grid)
    whole = np.asarray(images.observe(*images.upload(surface))["rgb"])
    one = GelSurface(surface.grid, surface.height[1:2], surface.contact[1:2], surface.contact_centre[1:2])
    np.testing.assert_array_equal(np.asarray(images.observe(*images.upload(one))["rgb"]), whole[1:2])


def test_pytorch_gives_and_gets_without_a_copy() -> None:
    torch = pytest.importorskip("torch")
    _, _, images = both()
    surface = dented(images.grid)
    heights = torch.from_numpy(surface.height.reshape(-1).copy())
    seen = images.observe(heights)
    tensors = as_tensors(seen)
    assert tensors["rgb"].shape == (B, 16, 24, 3) and tensors["rgb"].dtype == torch.uint8
    assert tensors["rgb"].data_ptr() == as_tensors(seen)["rgb"].data_ptr()
    np.testing.assert_array_equal(tensors["rgb"].numpy(), np.asarray(images.observe(*images.upload(surface))["rgb"]))


@pytest.mark.gpu
@pytest.mark.parametrize("optics", ["phong", "raytrace"])
def test_a_gpu_hands_its_memory_to_pytorch(optics: str) -> None:
    torch = pytest.importorskip("torch")
    settings = ObservationSettings(("rgb",), resolution=(24, 16), optics=optics, difference=True, downscale=2)
    observer = TactileObserver("gelsight_mini", settings, num_envs=B)
    sensor = observer.make_sensor(device="cuda")
    images = DeviceImages(observer, sensor)
    surface = dented(images.grid)
    expected = observer.observe(sensor.update(surface), sensor)["rgb"]
    for heights in (images.upload(surface)[0], torch.from_numpy(surface.height.reshape(-1)).cuda()):
        tensor = as_tensors(images.observe(heights))["rgb"]
        assert tensor.is_cuda
        np.testing.assert_array_equal(tensor.cpu().numpy(), expected)


def test_what_the_device_does_not_know_is_refused() -> None:
    for settings, randomization, text in (
        ({"modalities": ("markers",)}, None, "must have 'rgb'"),
        ({"modalities": ("rgb",), "stack": 2}, None, "nothing is kept"),
        ({"modalities": ("rgb",)}, Randomization(noise=1.0), "must not change images"),
    ):
        made = ObservationSettings(**{**DIRECT, "resolution": (24, 16), **settings})
        observer = TactileObserver("gelsight_mini_9x11", made, num_envs=B, randomization=randomization)
        with pytest.raises(InputError, match=text):
            DeviceImages(observer, observer.make_sensor(device="cpu"))
    observer = TactileObserver("gelsight_mini", ObservationSettings(("rgb",), resolution=(24, 16), optics="raytrace"))
    with pytest.raises(InputError, match="integrator fast"):
        DeviceImages(observer, observer.make_sensor(device="cpu", optics=RayTraced(integrator="path")))
    _, _, images = both()
    with pytest.raises(InputError, match="whole number of grids"):
        images.observe(images.upload(dented(images.grid))[0][:-1])
