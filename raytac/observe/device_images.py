"""Observed images of many pads on one device, from heights or from depth maps."""

# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportAttributeAccessIssue=false, reportAssignmentType=false
# (kernels are written in the language of Warp, which looks like Python and has other types)

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import warp as wp

from raytac.checks import check_kind, check_number
from raytac.device import resolve_device
from raytac.errors import InputError
from raytac.gel.pyramid import ElasticSurround
from raytac.gel.surface import GelSurface
from raytac.markers.pattern import MarkerPattern, dot_ink
from raytac.observe.observer import TactileObserver
from raytac.sensor import TactileSensor
from raytac.specs.sensor import SensorSpec
from raytac.specs.sensor_file import sensor_spec
from raytac.warp_runtime import start_warp

wp.set_module_options({"enable_backward": False, "fast_math": False})

_STEPS = wp.constant(6)
"""Steps of the search for the pixel that sees a node."""
_FAR = 1 << 30
"""Column or row that no grid has."""


class DeviceImages:
    """The ``rgb`` of a ``TactileObserver``, from heights on a device to images on it.

    .. code-block:: python

        observer = TactileObserver("gelsight_mini", ObservationSettings(("rgb",), resolution=(320, 240), difference=True), num_envs=512)
        images = DeviceImages(observer, observer.make_sensor(device="cuda"))
        rgb = as_tensors(images.observe(heights))["rgb"]  # (512, 240, 320, 3) uint8, on the GPU

    Crop, mean over ``downscale`` pixels and difference to rest are those of ``TactileObserver.observe``, to the last bit. There is no
    history and no record of failed environments.
    """

    def __init__(self, observer: TactileObserver, sensor: TactileSensor) -> None:
        """Build the renderer and render the pad at rest.

        Args:
            observer: settings of the observation; of its modalities only ``rgb`` is computed.
            sensor: made with ``observer.make_sensor``; all arrays stay on its device.

        Raises:
            InputError: settings without an implementation on the device: no ``rgb``, a stack, grain, cameras that drift; an optical mode
                without images on the device.
            BackendError: the renderer or the device does not work here.
        """
        from raytac.optics.device_image import DeviceImage, ImageCut

        settings, layout = observer.settings, observer.layout
        if "rgb" not in settings.modalities:
            raise InputError(
                "modalities", value=settings.modalities, rule="must have 'rgb': images stay on the device, nothing else"
            )
        if settings.stack != 1:
            raise InputError("stack", value=settings.stack, rule="must be 1 on the device, where nothing is kept")
        if settings.noise:
            raise InputError("noise", value=True, rule="must be False on the device, where images have no grain")
        if observer.randomization.changes_images:
            raise InputError("randomization", value=observer.randomization, rule="must not change images on the device")
        cut = ImageCut(layout.observed, layout.crop_x, layout.crop_y, layout.downscale)
        self.grid = sensor.grid
        ink = None
        if sensor.markers is not None:
            ink = dot_ink(sensor.grid, MarkerPattern.of(sensor.spec).rest, sensor.spec.markers.radius)
        self._image = DeviceImage(sensor.optical_mode, sensor.grid, cut, difference=settings.difference, ink=ink)

    def upload(self, surface: GelSurface) -> tuple[Any, Any]:
        """Heights and contact of B surfaces as arrays on the device, for ``observe``."""
        return self._image.upload(surface)

    def observe(self, heights: Any, contact: Any = None, ink: Any = None) -> dict[str, Any]:
        """``rgb`` (B, height, width, 3), uint8, on the device; ``as_tensors`` copies nothing.

        Args:
            heights: [m], B·Ny·Nx of them on the device, finite, which is not checked: a Dr.Jit array or a float32 PyTorch tensor.
            contact: 1 where the object touches, else 0, as many bytes; only for optical modes that need it.
            ink: share of marker dots at the nodes, as many numbers in [0, 1]; None shows none.

        Raises:
            InputError: no whole number of grids, a batch too large for the memory, or contact missing.
        """
        return {"rgb": self._image(heights, contact, ink)}


@dataclass(frozen=True)
class DepthCamera:
    """Camera of another simulator behind the gel: looks along the pad's +z, x right, y down.

    A depth is along its axis, not along the ray: what Isaac Lab calls ``distance_to_image_plane``, and MuJoCo, Genesis and ManiSkill
    depth. Hide gel and case from it, so that it sees what touches.

    Attributes:
        position: pinhole, pad frame [m]; z < 0. For parallel rays the plane from which depths count.
        focal: (fx, fy) [px]; for parallel rays, pixels a metre.
        principal: (cx, cy) [px] from the top-left corner of the image, where the axis meets it; the first pixel's centre is (0.5, 0.5).
        resolution: (width, height) [px].
        is_parallel: True for parallel rays (orthographic), False for a pinhole.
    """

    position: tuple[float, float, float]
    focal: tuple[float, float]
    principal: tuple[float, float]
    resolution: tuple[int, int]
    is_parallel: bool = False

    def __post_init__(self) -> None:
        for name, value in zip("xyz", self.position, strict=True):
            check_number(f"position {name}", value, "(-inf, 0)" if name == "z" else "(-inf, inf)", "m")
        for value in self.focal:
            check_number("focal", value, "(0, inf)", "px")
        for value in self.principal:
            check_number("principal", value, "(-inf, inf)", "px")
        if not all(isinstance(size, int) and size > 0 for size in self.resolution):
            raise InputError("resolution", value=self.resolution, rule="must be (width, height), whole numbers > 0")

    @classmethod
    def of(cls, sensor: str | Path | SensorSpec, resolution: tuple[int, int] | None = None) -> DepthCamera:
        """Pinhole where the sensor's camera is, which sees what that one would in air.

        ``resolution``: (width, height) [px]; None is the sensor's own. Errors as of ``raytac.load_sensor``.
        """
        camera = sensor_spec(sensor).camera
        width, height = camera.resolution if resolution is None else resolution
        scale, pitch = (width / camera.resolution[0], height / camera.resolution[1]), camera.pitch_at((width, height))
        focal = -camera.position[2] / pitch[0], -camera.position[2] / pitch[1]
        principal = scale[0] * camera.principal_point[0], scale[1] * camera.principal_point[1]
        return cls(camera.position, focal, principal, (width, height))

    @classmethod
    def parallel(cls, pitch: float, resolution: tuple[int, int], *, distance: float = 0.02) -> DepthCamera:
        """Parallel rays, a pixel every ``pitch`` [m] about the pad's centre.

        ``distance``: of the plane from which depths count behind the gel's surface [m].
        """
        each = 1.0 / check_number("pitch", pitch, "(0, inf)", "m")
        width, height = resolution
        return cls((0.0, 0.0, -distance), (each, each), (0.5 * width, 0.5 * height), resolution, True)

    @property
    def fovy_deg(self) -> float:
        """Vertical field of view, as MuJoCo, Genesis and ManiSkill ask for it [degrees]."""
        return math.degrees(2.0 * math.atan(0.5 * self.resolution[1] / self.focal[1]))


class DepthImages:
    """The ``rgb`` of a ``TactileObserver``, from depth maps on a device to images on it.

    .. code-block:: python

        observer = TactileObserver("gelsight_mini", ObservationSettings(("rgb",), resolution=(320, 240)), num_envs=512)
        images = DepthImages(observer, DepthCamera.of("gelsight_mini", (320, 240)), device="cuda")
        rgb = torch.from_dlpack(images.observe(depth)["rgb"])  # depth (512, 240, 320) of any library, rgb (512, 240, 320, 3) uint8

    Where an object lies below the gel at rest, the gel follows it, and its surroundings as of ``raytac.gel.ElasticSurround``: this is the
    rigid pad's surface. The other simulator must let bodies overlap the gel by the depth of the imprint.

    Attributes:
        grid: nodes of the pad; ``grid.rest`` is its surface at rest.
        height: z of the gel's surface, pad frame [m], (B, Ny, Nx), float32, a Warp array that the next call overwrites.
        contact: 1 where something touches, (B, Ny, Nx), uint8, likewise.
        lost: 1 in environments that press the gel through, which are shown at rest, (B,), int32, likewise.
    """

    def __init__(self, observer: TactileObserver, camera: DepthCamera, *, device: str = "auto") -> None:
        """Build the renderer and render the pad at rest.

        Args:
            observer: settings of the observation, as of ``DeviceImages``.
            camera: that makes the depth maps.
            device: ``auto``, ``cpu`` or ``cuda``: where the depth maps are.

        Raises:
            InputError: settings that ``DeviceImages`` refuses.
            BackendError: the renderer or the device does not work here.
        """
        self.camera = check_kind("camera", camera, DepthCamera)
        start_warp()
        self._device = wp.get_device(resolve_device(device))
        sensor = observer.make_sensor(device="cuda" if self._device.is_cuda else "cpu")
        self._images, self.grid = DeviceImages(observer, sensor), sensor.grid
        grid = self.grid
        self._count, (ny, nx) = observer.num_envs, grid.shape
        thickness = observer.sensor.gelpad.thickness
        self._surround = ElasticSurround(grid, thickness=thickness, num_envs=self._count, device=str(self._device))
        self._thickness = float(thickness)
        self._lines = tuple(wp.array(line, dtype=wp.float32, device=self._device) for line in (grid.x, grid.y))
        self._rest = wp.array(grid.rest, dtype=wp.float32, device=self._device)
        self._box = wp.zeros((self._count, 4), dtype=wp.int32, device=self._device)
        self.height = wp.zeros((self._count, ny, nx), dtype=wp.float32, device=self._device)
        self.contact = wp.zeros((self._count, ny, nx), dtype=wp.uint8, device=self._device)
        self.lost = self._surround.lost
        (x, y, z), (fx, fy), (cx, cy) = camera.position, camera.focal, camera.principal
        self._optics = wp.vec3(x, y, z), wp.vec4(fx, fy, cx, cy), int(camera.is_parallel)

    def observe(self, depth: Any) -> dict[str, Any]:
        """``rgb`` (B, height, width, 3), uint8, on the device; DLPack hands it on without a copy.

        Args:
            depth: depths along the camera's axis [m], (B, H, W) or (B, H, W, 1), float32, on the device: an array of PyTorch, JAX, Warp,
                CuPy or NumPy, which is read in place by ``__dlpack__``. Where nothing is seen: 0 or less, infinite or NaN.

        Raises:
            InputError: an array without ``__dlpack__``, of another type, shape or device.
        """
        self._launch(self._taken(depth))
        if self._device.is_cuda:
            wp.synchronize_stream(wp.get_stream(self._device))  # the renderer's stream does not wait for this one
        return self._images.observe(self.height.flatten(), self.contact.flatten())

    def _taken(self, depth: Any) -> Any:
        """The depths as a Warp array (B, H, W), without a copy."""
        width, height = self.camera.resolution
        shape = self._count, height, width
        kind = f"{getattr(depth, 'dtype', type(depth).__name__)} {tuple(getattr(depth, 'shape', ()))}"
        if isinstance(depth, wp.array):
            taken: Any = depth
        elif hasattr(depth, "__dlpack__"):
            try:
                taken = wp.from_dlpack(depth)
            except Exception as error:  # every library has its own
                raise InputError("depth", value=kind, rule=f"cannot be read by DLPack ({error})") from error
        else:
            raise InputError("depth", value=kind, rule="must be an array with __dlpack__, as of PyTorch, JAX, Warp or NumPy")
        if taken.dtype != wp.float32 or tuple(taken.shape) not in (shape, (*shape, 1)):
            rule = f"must be float32 of shape {shape}: environments, and height and width of the camera"
            raise InputError("depth", value=kind, rule=rule)
        if taken.device != self._device:
            raise InputError("depth", value=str(taken.device), rule=f"must be on the device of the images, {self._device}")
        return taken if taken.ndim == 3 else taken[:, :, :, 0]

    def _launch(self, depth: Any) -> None:
        """Launch overlap and surface."""
        surround, shape = self._surround, self.height.shape
        overlaps = [self._box, surround.deepest, surround.overlap]
        wp.launch(_clear, dim=self._count, inputs=[self._box, surround.deepest], device=self._device)
        inputs = [depth, *self._optics, self._thickness, *self._lines, self._rest, *overlaps]
        wp.launch(_find_overlap, dim=shape, inputs=inputs, device=self._device)
        wp.launch(_find_window, dim=self._count, inputs=[self._box, surround.window], device=self._device)
        surround.launch()
        copied = [surround.height, surround.contact, self.height, self.contact]
        wp.launch(_copy, dim=shape, inputs=copied, device=self._device)


@wp.func
def _is_seen(d: wp.float32):
    return wp.isfinite(d) and d > wp.float32(0.0)


@wp.func
def _depth_at(depth: wp.array3d(dtype=wp.float32), env: wp.int32, u: wp.float32, v: wp.float32):
    """Depth at pixel (u, v), between four pixels; at the nearest where one sees nothing.

    Infinite where nothing is seen, and beside the image.
    """
    rows, columns = depth.shape[1], depth.shape[2]
    far = wp.float32(wp.inf)
    if u < wp.float32(0.0) or v < wp.float32(0.0) or u > wp.float32(columns) or v > wp.float32(rows):
        return far
    x = wp.clamp(u - wp.float32(0.5), wp.float32(0.0), wp.float32(columns - 1))
    y = wp.clamp(v - wp.float32(0.5), wp.float32(0.0), wp.float32(rows - 1))
    i, j = wp.min(wp.int32(x), wp.max(columns - 2, 0)), wp.min(wp.int32(y), wp.max(rows - 2, 0))
    k, m = wp.min(i + 1, columns - 1), wp.min(j + 1, rows - 1)
    s, t = x - wp.float32(i), y - wp.float32(j)
    a, b, c, d = depth[env, j, i], depth[env, j, k], depth[env, m, i], depth[env, m, k]
    if _is_seen(a) and _is_seen(b) and _is_seen(c) and _is_seen(d):
        return (wp.float32(1.0) - t) * ((wp.float32(1.0) - s) * a + s * b) + t * ((wp.float32(1.0) - s) * c + s * d)
    upper = wp.where(s < wp.float32(0.5), a, b)
    lower = wp.where(s < wp.float32(0.5), c, d)
    nearest = wp.where(t < wp.float32(0.5), upper, lower)
    return wp.where(_is_seen(nearest), nearest, far)


@wp.kernel
def _clear(box: wp.array2d(dtype=wp.int32), deepest: wp.array(dtype=wp.float32)):
    env = wp.tid()
    deepest[env] = wp.float32(0.0)
    box[env, 0] = _FAR
    box[env, 1] = 0
    box[env, 2] = _FAR
    box[env, 3] = 0


@wp.kernel
def _find_overlap(
    depth: wp.array3d(dtype=wp.float32),
    position: wp.vec3,
    pixels: wp.vec4,
    is_parallel: wp.int32,
    thickness: wp.float32,
    x: wp.array(dtype=wp.float32),
    y: wp.array(dtype=wp.float32),
    rest: wp.array2d(dtype=wp.float32),
    # outputs
    box: wp.array2d(dtype=wp.int32),
    deepest: wp.array(dtype=wp.float32),
    overlap: wp.array3d(dtype=wp.float32),
):
    """Overlap of one node with what the camera sees there, and the box of nodes that overlap.

    The pixel of a pinhole that sees the node depends on the height there: z is corrected by what the pixel of the last z sees. It is
    looked for within the gel, where the ray's slope times the object's is below 1.
    """
    env, j, i = wp.tid()
    z, seen = wp.float32(rest[j, i]), wp.float32(0.0)
    for _ in range(_STEPS):
        away = wp.where(is_parallel != 0, wp.float32(1.0), z - position[2])
        u = pixels[2] + pixels[0] * (x[i] - position[0]) / away
        v = pixels[3] + pixels[1] * (y[j] - position[1]) / away
        seen = _depth_at(depth, env, u, v) + position[2]
        z = wp.clamp(seen, -thickness, rest[j, i])
    u_plus = wp.max(rest[j, i] - seen, wp.float32(0.0))
    overlap[env, j, i] = u_plus
    if u_plus > wp.float32(0.0):
        wp.atomic_max(deepest, env, u_plus)
        wp.atomic_min(box, env, 0, i)
        wp.atomic_max(box, env, 1, i + 1)
        wp.atomic_min(box, env, 2, j)
        wp.atomic_max(box, env, 3, j + 1)


@wp.kernel
def _find_window(box: wp.array2d(dtype=wp.int32), window: wp.array(dtype=wp.vec4i)):
    env = wp.tid()
    window[env] = wp.vec4i(0, 0, 0, 0)
    if box[env, 1] > 0:
        window[env] = wp.vec4i(box[env, 0], box[env, 1], box[env, 2], box[env, 3])


@wp.kernel
def _copy(
    height: wp.array3d(dtype=wp.float32),
    contact: wp.array3d(dtype=wp.uint8),
    # outputs
    all_height: wp.array3d(dtype=wp.float32),
    all_contact: wp.array3d(dtype=wp.uint8),
):
    env, j, i = wp.tid()
    all_height[env, j, i] = height[env, j, i]
    all_contact[env, j, i] = contact[env, j, i]
