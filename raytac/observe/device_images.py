"""Observed images of many pads, for a solver and a learner on one device."""

from __future__ import annotations

from typing import Any

from raytac.errors import InputError
from raytac.gel.surface import GelSurface
from raytac.markers.pattern import MarkerPattern, dot_ink
from raytac.observe.observer import TactileObserver
from raytac.sensor import TactileSensor


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
