"""Optical mode ``unet``: the whole image by a small U-Net (``unet_weights``), in PyTorch."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import drjit as dr
import numpy as np

from raytac.assets import asset_root
from raytac.errors import BackendError, InputError
from raytac.gel.surface import GelSurface, PadGrid
from raytac.optics.camera import Pinhole
from raytac.optics.device_mode import DeviceFrame, DeviceMode, Float, FrameInputs, UInt8
from raytac.optics.image.base import grey_levels, see_heights
from raytac.optics.image.config import Unet
from raytac.optics.image.network_files import check_straight, check_view, look_digest
from raytac.optics.image.unet_weights import UnetWeights, load_unet
from raytac.optics.ink import darkened

_ACTIVATIONS = 8
"""Peak number of arrays of the finest level's channels, coarser levels counted."""


def new_unet(widths: tuple[int, ...], device: str) -> Any:
    """A U-Net with random weights, a PyTorch module.

    ``widths``: channels of every level, the finest first. Raises ``BackendError`` where PyTorch is not installed.
    """
    return _network_module().UnetNetwork(widths).to(device)


def _network_module() -> Any:
    try:
        return import_module("raytac.optics.image.unet_network")
    except ImportError as error:
        raise BackendError(f"optics='unet' needs PyTorch ({error}): `pip install torch`") from error


class UnetMode(DeviceMode):
    """The optical mode ``unet`` of one sensor, network and resolution, for batches of surfaces.

    The network sees the coat at its own resolution, and the change of the image is resized to the camera's.
    """

    needs_contact = True
    _smallest_side = 3

    config: Unet

    def _set_up(self) -> None:
        module = _network_module()
        torch = import_module("torch")
        self.weights = self._own_weights()
        check_straight("unet", self.sensor)
        check_view("unet", self.sensor, self.weights.view, self.weights.provenance)
        height, width = self.weights.background.shape[:2]
        self._seeing = Pinhole.from_spec(self.sensor.camera, (width, height), self.slab)
        self._torch, self._network = torch, module.network_of(self.weights, self.device)
        with torch.no_grad():
            background = torch.from_numpy(self.weights.background.astype(np.float32))[None].permute(0, 3, 1, 2).to(self.device)
            rest = self._network(torch.zeros((1, 4, height, width), device=self.device))
            self._rest_levels = self._resized(background - rest)

    def _own_weights(self) -> UnetWeights:
        """The network that was asked for, or the shipped one if it is of this sensor's look."""
        weights = self.config.weights
        if weights is not None:
            return weights if isinstance(weights, UnetWeights) else load_unet(weights)
        shipped = load_unet(asset_root("scenes") / "networks" / "gelsight_mini_unet.npz")
        if shipped.provenance.get("look") != look_digest(self.sensor):
            rule = f"must name a network for the sensor {self.sensor.name!r} (`python experiments/train_unet.py` fits one): "
            rule += f"the one that comes with raytac is for lights and camera of {shipped.provenance.get('sensor')!r}"
            raise InputError("weights", rule=rule)
        return shipped

    def _build(self, grid: PadGrid) -> list[Float]:
        return []

    def _bytes_per_env(self, grid: PadGrid) -> int:
        height, width = self.weights.background.shape[:2]
        own, shown = width * height, self.camera.resolution[0] * self.camera.resolution[1]
        channels = 12 + _ACTIVATIONS * self.weights.widths[0]
        return 9 * grid.rest.size + 4 * channels * own + 4 * 12 * shown

    def _maps(self, heights: Float, contact: UInt8 | None, inputs: FrameInputs) -> tuple[Float, Float, Float, Float]:
        """Slopes along x and y, displacement [mm] and contact at the network's pixels, each B·H·W."""
        pitch = self.sensor.camera.pitch_at(self._seeing.resolution)
        seen = see_heights(self.mi, self.layout, self._seeing, pitch, inputs.rest, heights, contact)
        dr.eval(seen.displacement)
        sx, sy, _ = seen.slopes(self.mi, seen.displacement)
        return sx, sy, seen.displacement * (1e3 * pitch[0]), self.mi.Float(seen.contact)

    def _ink(self, heights: Float, contact: UInt8 | None, inputs: FrameInputs) -> Float:
        """Share of ink at the image's pixels, B·H·W."""
        pitch = self.sensor.camera.pitch_at(self.camera.resolution)
        return see_heights(self.mi, self.layout, self.camera, pitch, inputs.rest, heights, None, inputs.ink).ink

    def _resized(self, levels: Any) -> Any:
        width, height = self.camera.resolution
        if levels.shape[-2:] == (height, width):
            return levels
        options = {"mode": "bilinear", "align_corners": False, "antialias": True}
        return self._torch.nn.functional.interpolate(levels, size=(height, width), **options)

    def maps(self, surface: GelSurface) -> Any:
        """Inputs of the network, a tensor (B, 4, H, W).

        They are slopes along x and y, displacement [mm] and contact. Environments whose heights are not finite are at rest.
        Errors as of ``render``.
        """
        heights, failed = self._checked(surface)
        return self._seen_maps(self._upload(heights), self._upload_contact(surface, failed))

    def _seen_maps(self, heights: Float, contact: UInt8 | None) -> Any:
        arrays = self._recorded(self._maps, heights, contact, None)
        dr.eval(*arrays)
        dr.sync_thread()
        height, width = self.weights.background.shape[:2]
        planes = [self._torch.from_dlpack(array).reshape(-1, height, width) for array in arrays]
        return self._torch.stack(planes, dim=1)

    def _levels(self, heights: Float, contact: UInt8 | None) -> Any:
        """The image before rounding [levels], not clipped, (B, H, W, 3), a tensor."""
        with self._torch.no_grad():
            levels = self._rest_levels + self._resized(self._network(self._seen_maps(heights, contact)))
            levels = levels.permute(0, 2, 3, 1).contiguous()
            if self.device == "cuda":
                self._torch.cuda.current_stream().synchronize()
        return levels

    def _made(self, heights: Float, contact: UInt8 | None, ink: Float | None) -> DeviceFrame:
        mi = self.mi
        levels = self._levels(heights, contact)
        if ink is None and not self.sensor.camera.monochrome:
            flat = dr.clip(mi.Float(levels.reshape(-1)) + 0.5, 0, 255)
        else:
            channels = [mi.Float(levels[..., c].reshape(-1)) for c in range(3)]
            if ink is not None:
                channels = darkened(self.sensor, channels, self._recorded(self._ink, heights, None, ink))
            if self.sensor.camera.monochrome:
                channels = grey_levels(channels)
            flat = dr.ravel(mi.Color3f([dr.clip(c + 0.5, 0, 255) for c in channels]))
        rgb = mi.UInt8(flat)
        dr.eval(rgb)
        dr.sync_thread()  # PyTorch may use the memory of the levels again
        return DeviceFrame(rgb, [], mi.UInt8(0))

    def render_levels(self, surface: GelSurface) -> np.ndarray:
        """The image without dots before rounding [levels, 0-255], (B, H, W, 3); NaN where it failed."""
        heights, failed = self._checked(surface)
        levels = self._levels(self._upload(heights), self._upload_contact(surface, failed)).cpu().numpy()
        levels[failed] = np.nan
        return levels
