"""``WarpTouch``: what the sensors of a ``WarpWorld`` observe, as tensors on its device."""

# pyright: reportMissingImports=false
# (PyTorch belongs to the extra "rl", which the tests do without.)

from __future__ import annotations

from typing import Any

import torch
import warp as wp

from raytac.errors import InputError
from raytac.observe import DeviceImages, ObservationSettings, TactileObserver
from raytac.world.pad_touch import PadTouch
from raytac.world.warp_world import WarpWorld

ON_DEVICE = ("rgb", "markers", "wrench")
"""Modalities that are observed without the host."""


class WarpTouch:
    """Observations of all sensors of B environments, named and scaled as those of ``TactileObserver``.

    Attributes:
        pads: surfaces and markers of every sensor by its name; empty where the wrench alone is observed.
    """

    def __init__(self, world: WarpWorld, settings: ObservationSettings, *, pitch: float | None = None, seed: int = 0) -> None:
        """Make the arrays.

        Args:
            world: after a reset.
            settings: of the observation; ``pitch``: of the pads' grids [m], None is that of ``TaskBatch``; ``seed``: of the markers.

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
        self._scale = scale.expand(6) if scale.ndim == 0 else scale
        count, device = world.engine.num_envs, world.engine.device
        self.pads: dict[str, PadTouch] = {}
        self._images: dict[str, DeviceImages] = {}
        if not settings.needs_frames:
            return
        bodies = [body.parts for body in world.composed.touched]
        for k, mounted in enumerate(world.composed.sensors):
            observer = TactileObserver(mounted.spec, settings, num_envs=count, seed=seed + k)
            grid = pad_grid(observer, pitch)
            markers = observer.markers if settings.needs_markers else None
            self.pads[mounted.name] = PadTouch(mounted.spec, grid, bodies, markers, num_envs=count, device=device)
            if "rgb" in settings.modalities:
                sensor = observer.make_sensor(device="cuda" if device.is_cuda else "cpu", pitch=...)
                self._images[mounted.name] = DeviceImages(observer, sensor)
