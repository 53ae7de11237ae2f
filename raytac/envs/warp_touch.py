"""``WarpTouch``: sensors' observations of a ``WarpWorld``, as tensors on its device."""

# pyright: reportMissingImports=false
# (PyTorch belongs to the extra "rl", which the tests do without.)

from __future__ import annotations

import torch
import warp as wp

from raytac.envs.batch import task_pitch
from raytac.errors import InputError
from raytac.gel.surface import make_grid
from raytac.observe import DeviceImages, ObservationSettings, TactileObserver
from raytac.world.pad_touch import PadTouch
from raytac.world.warp_world import WarpWorld

ON_DEVICE = ("rgb", "markers", "wrench")
"""Modalities that are observed without the host."""


class WarpTouch:
    """Observations of all sensors of B environments, as of ``TactileObserver``.

    Names and scales are the same.

    Attributes:
        pads: surfaces and markers of every sensor by its name; empty where the wrench alone is observed.
    """

    def __init__(
        self, world: WarpWorld, settings: ObservationSettings, *, pitch: float | None = None, patches: int = 8, seed: int = 0
    ) -> None:
        """Make the arrays.

        Args:
            world: after a reset.
            settings: of the observation.
            pitch: spacing of the pads' grids [m]; None is that of ``TaskBatch``.
            patches: most separate contacts of a pad, for its markers.
            seed: of the markers.

        Raises:
            InputError: a modality that is not in ``ON_DEVICE``, a stack, images with markers; as ``PadTouch`` and ``DeviceImages``.
        """
        for name in settings.modalities:
            if name not in ON_DEVICE:
                raise InputError("modalities", value=name, rule="is not observed on the device", choices=ON_DEVICE)
        if settings.stack != 1:
            raise InputError("stack", value=settings.stack, rule="must be 1 on the device, where nothing is kept")
        if {"rgb", "markers"} <= set(settings.modalities):
            raise InputError("modalities", value=settings.modalities, rule="must have rgb or markers on the device, not both")
        self._world, self._settings = world, settings
        self._wrenches = wp.to_torch(world.contact.wrenches)
        scale = torch.tensor(settings.scale("wrench"), dtype=torch.float64, device=self._wrenches.device)
        self._wrench_scale = scale.expand(6)
        self._marker_scale = float(settings.scale("markers"))  # type: ignore[arg-type]  # six numbers are of the wrench alone
        self._names = [mounted.name for mounted in world.composed.sensors]
        count, device = world.engine.num_envs, world.engine.device
        self.pads: dict[str, PadTouch] = {}
        self._markers: dict[str, torch.Tensor] = {}
        self._images: dict[str, DeviceImages] = {}
        if not settings.needs_frames:
            return
        bodies = [body.parts for body in world.composed.touched]
        for k, mounted in enumerate(world.composed.sensors):
            observer = TactileObserver(mounted.spec, settings, num_envs=count, seed=seed + k)
            own = task_pitch(observer) if pitch is None else pitch
            grid = make_grid(mounted.spec.gelpad, own)
            if "rgb" in settings.modalities:
                sensor = observer.make_sensor(device="cuda" if device.is_cuda else "cpu", pitch=own)
                grid = sensor.grid
                self._images[mounted.name] = DeviceImages(observer, sensor)
            self.pads[mounted.name] = pad = PadTouch(
                mounted.spec, grid, bodies, observer.markers, num_envs=count, patches=patches, device=str(device), pad=k
            )
            if pad.fots is not None:
                self._markers[mounted.name] = wp.to_torch(pad.fots.displacement)

    def launch(self) -> None:
        """Launch the surfaces and markers of the present poses."""
        for pad in self.pads.values():
            pad.launch(self._world.contact, self._world.engine.active)

    def forget(self, mask: wp.array) -> None:
        """Forget what the pads of the environments of a mask (B,), bool, went through."""
        for pad in self.pads.values():
            pad.reset(mask)

    def check(self) -> None:
        """Wait for the device. Raises ``InputError`` if contacts were lost for want of memory."""
        for pad in self.pads.values():
            pad.check()

    def observe(self) -> dict[str, torch.Tensor]:
        """Observations (B, …) after ``launch``: ``<sensor>_<modality>``."""
        result, settings = {}, self._settings
        for k, name in enumerate(self._names):
            for modality in settings.modalities:
                match modality:
                    case "wrench":
                        values = (self._wrenches[:, k] / self._wrench_scale).float()
                    case "markers":
                        values = self._markers[name] / self._marker_scale
                    case _:
                        values = self._rendered(name)
                result[f"{name}_{modality}"] = values
        return result

    def _rendered(self, name: str) -> torch.Tensor:
        """8-bit images (B, height, width, 3) of another library, begun once the heights are there."""
        pad = self.pads[name]
        device = self._world.engine.device
        if device.is_cuda:
            wp.synchronize_stream(wp.get_stream(device))
        heights = wp.to_torch(pad.height).reshape(-1)
        contact = wp.to_torch(pad.contact).reshape(-1)
        return torch.from_dlpack(self._images[name].observe(heights, contact)["rgb"])
