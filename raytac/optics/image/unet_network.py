"""The U-Net of ``unet_weights`` in PyTorch: its layers, its inputs, its arithmetic."""

# pyright: reportMissingImports=false
# (The tests do without PyTorch.)

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from raytac.optics.image.unet_weights import INPUTS, LEVELS, UnetWeights


class UnetNetwork(nn.Module):
    """Change of an image [levels], (B, 3, H, W), from maps (B, 4, H, W) of ``UnetMode``."""

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.down = [self._level(f"down{k}", a, b) for k, (a, b) in enumerate(itertools.pairwise((INPUTS, *widths)))]
        self.up = [self._level(f"up{k}", a + b, a) for k, (a, b) in enumerate(itertools.pairwise(widths))]
        self.last = nn.Conv2d(widths[0], 3, 1)

    def _level(self, name: str, inputs: int, outputs: int) -> nn.Sequential:
        level = nn.Sequential(
            nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU(), nn.Conv2d(outputs, outputs, 3, padding=1), nn.ReLU()
        )
        self.add_module(name, level)
        return level

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Go down and up again; sizes that are odd come back to their own."""
        x, seen = unet_inputs(maps), []
        for k, level in enumerate(self.down):
            x = level(x if k == 0 else functional.avg_pool2d(x, 2))
            seen.append(x)
        for level, beside in zip(reversed(self.up), reversed(seen[:-1]), strict=True):
            x = functional.interpolate(x, size=beside.shape[-2:], mode="bilinear", align_corners=False)
            x = level(torch.cat([beside, x], dim=1))
        return LEVELS * self.last(x)

    def layers(self) -> dict[str, np.ndarray]:
        """Arrays as ``UnetWeights.layers`` holds them."""
        return {name: array.detach().cpu().numpy() for name, array in self.state_dict().items()}


def network_of(weights: UnetWeights, device: Any) -> UnetNetwork:
    """The network with its weights, which are not trained further."""
    network = UnetNetwork(weights.widths)
    network.load_state_dict({name: torch.from_numpy(np.array(array, np.float32)) for name, array in weights.layers.items()})
    return network.to(device).requires_grad_(False).eval()


def unet_inputs(maps: torch.Tensor) -> torch.Tensor:
    """Inputs (B, ``INPUTS``, H, W) of maps (B, 4, H, W), the places of pixels among them."""
    envs, _, height, width = maps.shape
    own = {"device": maps.device, "dtype": maps.dtype}
    v = ((torch.arange(height, **own) + 0.5) * (2 / height) - 1)[:, None].expand(height, width)
    u = ((torch.arange(width, **own) + 0.5) * (2 / width) - 1)[None, :].expand(height, width)
    places = torch.stack([u, v]).expand(envs, 2, height, width)
    return torch.cat([2 * maps[:, :2], maps[:, 2:], places], dim=1)
