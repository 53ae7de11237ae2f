"""Depth maps against the surfaces and images of the same objects: a sphere whose depth is a formula, seen by both kinds of cameras."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
import pytest
import warp as wp

from raytac.errors import InputError
from raytac.gel import ElasticSurround, GelSurface
from raytac.observe import DepthCamera, DepthImages, ObservationSettings, TactileObserver
from raytac.specs import load_sensor

RADIUS = 4e-3
BALLS = np.array([[0.0, 0.0, 0.6e-3], [3e-3, -2e-3, 0.3e-3], [-4e-3, 1e-3, -0.2e-3]])
"""x, y and depth of each ball below z = 0 [m]; the last does not touch."""
B = len(BALLS)
PINHOLE = DepthCamera.of("gelsight_mini", (320, 240))
PARALLEL = DepthCamera.parallel(60e-6, (340, 260), distance=0.015)


def centres() -> np.ndarray:
    return np.column_stack([BALLS[:, :2], RADIUS - BALLS[:, 2]])


def underside(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """z of each ball over a grid, inf beside it, (B, Ny, Nx)."""
    square = (x - BALLS[:, 0, None, None]) ** 2 + (y[:, None] - BALLS[:, 1, None, None]) ** 2
    with np.errstate(invalid="ignore"):
        z = centres()[:, 2, None, None] - np.sqrt(RADIUS**2 - square)
    return np.where(square < RADIUS**2, z, np.inf)


def depth_map(camera: DepthCamera) -> np.ndarray:
    """Depth of each ball as the camera sees it, (B, H, W), float32; inf beside it."""
    (width, height), (cx, cy), (fx, fy) = camera.resolution, camera.principal, camera.focal
    u, v = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
    position = np.asarray(camera.position)
    if camera.is_parallel:
        return (underside(u[0], v[:, 0]) - position[2]).astype(np.float32)
    ray = np.stack([u, v, np.ones_like(u)], axis=-1)
    to = centres() - position
    along, square = np.einsum("hwk,bk->bhw", ray, to), (ray**2).sum(axis=-1)
    with np.errstate(invalid="ignore"):
        d = (along - np.sqrt(along**2 - square * ((to**2).sum(axis=-1) - RADIUS**2)[:, None, None])) / square
    return np.where(np.isfinite(d), d, np.inf).astype(np.float32)


def make_observer() -> TactileObserver:
    settings = ObservationSettings(("rgb",), resolution=(64, 48), optics="phong")
    return TactileObserver("gelsight_mini", settings, num_envs=B)


@pytest.fixture(scope="module")
def observer() -> TactileObserver:
    return make_observer()


@pytest.fixture(scope="module", params=["pinhole", "parallel"])
def camera(request: pytest.FixtureRequest) -> DepthCamera:
    return {"pinhole": PINHOLE, "parallel": PARALLEL}[request.param]


@pytest.fixture(scope="module")
def images(observer: TactileObserver, camera: DepthCamera) -> DepthImages:
    return DepthImages(observer, camera, device="cpu")


def expected(observer: TactileObserver) -> GelSurface:
    sensor = observer.make_sensor(device="cpu")
    surround = ElasticSurround(sensor.grid, thickness=observer.sensor.gelpad.thickness, num_envs=B)
    return surround.surface(underside(sensor.grid.x, sensor.grid.y))


def test_surface_and_image_are_those_of_the_object(observer: TactileObserver, camera: DepthCamera, images: DepthImages) -> None:
    rgb = np.asarray(images.observe(depth_map(camera))["rgb"])
    surface = expected(observer)
    height = images.height.numpy()
    assert surface.indentation[0].max() > 0.5e-3 and not surface.contact[2].any()
    assert np.abs(height - surface.height).max() < 1e-6  # a pixel is 63 µm, and linear between pixels
    assert np.mean(images.contact.numpy().astype(bool) != surface.contact) < 2e-3
    sensor = observer.make_sensor(device="cpu")
    shown = observer.observe(sensor.update(surface), sensor)["rgb"]
    assert rgb.shape == (B, 48, 64, 3) and rgb.dtype == np.uint8
    difference = np.abs(rgb.astype(int) - shown)
    assert difference.mean() < 0.2 and np.quantile(difference, 0.99) <= 3
    assert np.abs(rgb[0].astype(int) - rgb[2]).max() > 20  # the ball shows
    np.testing.assert_array_equal(rgb[2], shown[2])  # at rest to the last bit


def test_an_environment_does_not_depend_on_the_others(
    observer: TactileObserver, camera: DepthCamera, images: DepthImages
) -> None:
    depth = depth_map(camera)
    whole, height = np.array(images.observe(depth)["rgb"]), images.height.numpy().copy()
    turned = np.array(images.observe(np.ascontiguousarray(depth[::-1]))["rgb"])
    np.testing.assert_array_equal(turned[::-1], whole)
    np.testing.assert_array_equal(images.height.numpy()[::-1], height)


@pytest.mark.parametrize("nothing", [0.0, -1.0, np.inf, np.nan])
def test_where_nothing_is_seen_the_gel_is_at_rest(images: DepthImages, camera: DepthCamera, nothing: float) -> None:
    depth = depth_map(camera)
    rgb = np.array(images.observe(depth)["rgb"])
    depth[~np.isfinite(depth)] = nothing
    np.testing.assert_array_equal(np.asarray(images.observe(depth)["rgb"]), rgb)
    images.observe(np.full_like(depth, nothing))
    assert not images.contact.numpy().any() and not images.lost.numpy().any()
    assert (images.height.numpy() == images.height.numpy()[0]).all()


def test_an_edge_against_the_far_has_no_fringe(images: DepthImages, camera: DepthCamera) -> None:
    """A flat plate over the left half, 0.2 mm deep, before nothing and before a wall."""
    width, height = camera.resolution
    spec = load_sensor("gelsight_mini")
    for far in (np.inf, 5.0):
        depth = np.full((B, height, width), far, np.float32)
        depth[:, :, : width // 2] = -0.2e-3 - camera.position[2]
        images.observe(depth)
        edge = np.flatnonzero(images.contact.numpy()[0].any(axis=0)).max()
        x = np.linspace(-0.5, 0.5, images.contact.shape[2])[edge] * spec.gelpad.size[0]
        assert abs(x) < 150e-6


def test_a_gel_that_is_pressed_through_is_lost_alone(images: DepthImages, camera: DepthCamera) -> None:
    depth = depth_map(camera)
    images.observe(depth)
    height = images.height.numpy().copy()
    depth[1] = 1e-3
    images.observe(depth)
    assert images.lost.numpy().tolist() == [0, 1, 0]
    np.testing.assert_array_equal(images.height.numpy()[[0, 2]], height[[0, 2]])
    assert not images.contact.numpy()[1].any()


def test_arrays_are_read_in_place(images: DepthImages, camera: DepthCamera) -> None:
    depth = depth_map(camera)
    rgb = np.array(images.observe(depth)["rgb"])
    assert images._taken(depth).ptr == depth.ctypes.data
    channel = depth[..., None]  # as Isaac Lab has it
    assert images._taken(channel).ptr == depth.ctypes.data
    strided = np.zeros((B, *depth.shape[1:], 2), np.float32)
    strided[..., 0] = depth
    for given in (channel, strided[..., 0], wp.array(depth, dtype=wp.float32, device="cpu")):
        np.testing.assert_array_equal(np.asarray(images.observe(given)["rgb"]), rgb)


def test_pytorch_gives_and_gets_without_a_copy(images: DepthImages, camera: DepthCamera) -> None:
    torch = pytest.importorskip("torch")
    depth = torch.from_numpy(depth_map(camera))
    assert images._taken(depth).ptr == depth.data_ptr()
    rgb = images.observe(depth)["rgb"]
    tensor = torch.from_dlpack(rgb)
    assert tensor.dtype == torch.uint8 and tensor.data_ptr() == torch.from_dlpack(rgb).data_ptr()
    np.testing.assert_array_equal(tensor.numpy(), np.asarray(images.observe(depth.numpy())["rgb"]))


def test_jax_gives_without_a_copy(images: DepthImages, camera: DepthCamera) -> None:
    jax = pytest.importorskip("jax")
    depth = depth_map(camera)
    given = jax.numpy.asarray(depth)
    assert images._taken(given).ptr == given.unsafe_buffer_pointer()
    np.testing.assert_array_equal(np.asarray(images.observe(given)["rgb"]), np.asarray(images.observe(depth)["rgb"]))


def seen_on_the_cpu(camera: DepthCamera) -> tuple[np.ndarray, np.ndarray]:
    """Image and heights of the depth maps, (B, H, W, 3) and flat."""
    images = DepthImages(make_observer(), camera, device="cpu")
    rgb = np.array(images.observe(depth_map(camera))["rgb"])
    return rgb, images.height.numpy()


@pytest.mark.gpu
def test_a_gpu_gives_what_the_cpu_does(camera: DepthCamera) -> None:
    """The CPU's in a process of its own: a process renders on one device."""
    torch = pytest.importorskip("torch")
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as other:
        rgb, height = other.submit(seen_on_the_cpu, camera).result()
    depth = depth_map(camera)
    device = DepthImages(make_observer(), camera, device="cuda")
    tensor = torch.from_dlpack(device.observe(torch.from_numpy(depth).cuda())["rgb"])
    assert tensor.is_cuda
    assert np.abs(device.height.numpy() - height).max() < 1e-7
    assert np.abs(tensor.cpu().numpy().astype(int) - rgb).max() <= 2
    with pytest.raises(InputError, match="on the device of the images"):
        device.observe(depth)


def test_what_is_no_depth_map_is_refused(images: DepthImages, camera: DepthCamera) -> None:
    width, height = camera.resolution
    good = np.ones((B, height, width), np.float32)
    for depth, message in (
        (good.astype(np.float64), "must be float32 of shape"),
        (good[:2], "must be float32 of shape"),
        (good[:, :-1], "must be float32 of shape"),
        (good.tolist(), "an array with __dlpack__"),
    ):
        with pytest.raises(InputError, match=message):
            images.observe(depth)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"position": (0.0, 0.0, 0.01)}, "position z"),
        ({"focal": (0.0, 100.0)}, "focal"),
        ({"principal": (np.nan, 1.0)}, "principal"),
        ({"resolution": (0, 5)}, "resolution"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(changed: dict[str, Any], message: str) -> None:
    values = {"position": (0.0, 0.0, -0.02), "focal": (100.0, 100.0), "principal": (2.0, 2.0), "resolution": (4, 4)}
    with pytest.raises(InputError, match=message):
        DepthCamera(**{**values, **changed})


def test_the_field_of_view_is_that_of_the_sensors_camera() -> None:
    spec = load_sensor("gelsight_mini")
    height = spec.camera.resolution[1] * spec.camera.pixel_pitch[1]
    angle = 2.0 * np.degrees(np.arctan(0.5 * height / -spec.camera.position[2]))
    assert PINHOLE.fovy_deg == pytest.approx(angle)
