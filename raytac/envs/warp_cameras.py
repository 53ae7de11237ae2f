"""``WarpCameras``: cameras of B environments that differ, as tensors on one device.

Exposure, white balance, exponent and noise differ.
"""

# pyright: reportMissingImports=false
# (PyTorch belongs to the extra "rl", which the tests do without.)

from __future__ import annotations

import torch

from raytac.observe import Randomization, TactileObserver
from raytac.observe.randomization import response_curves


class WarpCameras:
    """``CameraDrift`` with draws from one generator of the device."""

    def __init__(self, randomization: Randomization, gamma: float, num_envs: int, generator: torch.Generator) -> None:
        """Draw all cameras; ``gamma`` is the exponent of the sensor's camera."""
        self._settings, self._gamma, self._generator = randomization, gamma, generator
        self._curves = torch.zeros((num_envs, 3, 256), dtype=torch.float32, device=generator.device)
        first = 256 * torch.arange(3 * num_envs, dtype=torch.int32, device=generator.device)
        self._first = first.reshape(num_envs, 1, 1, 3)
        self.begin(torch.ones(num_envs, dtype=torch.bool, device=generator.device))

    @classmethod
    def of(cls, observer: TactileObserver, generator: torch.Generator) -> WarpCameras | None:
        """Cameras of an observer; None if they do not differ."""
        if not observer.randomization.changes_images:
            return None
        return cls(observer.randomization, observer.sensor.response.gamma, observer.num_envs, generator)

    def begin(self, mask: torch.Tensor) -> None:
        """Draw the cameras of the environments of a mask (B,)."""
        shape, device = (len(self._curves), 5), self._curves.device
        u = torch.rand(shape, generator=self._generator, dtype=torch.float64, device=device)
        curves = response_curves(2.0 * u - 1.0, self._settings, self._gamma)
        self._curves = torch.where(mask[:, None, None], curves.float(), self._curves)

    def apply(self, images: torch.Tensor, *, noise: bool = True) -> torch.Tensor:
        """8-bit images (B, H, W, 3) of these cameras; ``noise``: add the noise of a frame."""
        entry = (self._first + images).reshape(-1)
        values = self._curves.reshape(-1).index_select(0, entry).reshape(images.shape)
        if noise and self._settings.noise:
            drawn = torch.randn(images.shape, generator=self._generator, device=images.device)
            values = values + self._settings.noise * drawn
        return (values + 0.5).clamp(0.0, 255.0).to(torch.uint8)
