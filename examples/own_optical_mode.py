"""A new optical mode in one file: the image shows how deep the gel is pressed, as a grey value.

python examples/own_optical_mode.py                            # press with it, and with a Taxim table (baked at first use)
python examples/own_optical_mode.py press coin --optics grey   # every command of raytac knows the new name
python examples/own_optical_mode.py compare --quick            # error and time beside all other modes
python examples/own_optical_mode.py view sphere --optics grey
"""

import sys
from dataclasses import dataclass

import numpy as np

import raytac
from raytac.cli import main
from raytac.gel import GelSurface
from raytac.optics import OpticsConfig, OpticsImages, register


class GreyMode:
    """Maker of the images. Anything with ``label``, ``device`` and ``render`` will do."""

    label, device = "grey", "cpu"

    def __init__(self, spec, config, *, resolution=None, outputs=("rgb",), device="auto", seed=0):
        self.width, self.height = resolution or spec.camera.resolution
        self.deepest = config.deepest

    def render(self, surface: GelSurface) -> OpticsImages:
        depth = surface.grid.rest - surface.height  # (B, Ny, Nx) [m], positive where the gel is pressed
        rows = np.linspace(0, depth.shape[1] - 1, self.height).round().astype(int)
        columns = np.linspace(0, depth.shape[2] - 1, self.width).round().astype(int)
        grey = np.clip(255 * depth[:, rows][:, :, columns] / self.deepest, 0, 255).astype(np.uint8)
        return OpticsImages(rgb=np.repeat(grey[..., None], 3, axis=-1))


@register("grey")
@dataclass(frozen=True)
class Grey(OpticsConfig):
    """Configuration, as users write it: ``optics="grey"`` or ``optics=Grey(deepest=2e-3)``."""

    deepest: float = 1e-3
    """Depth that is white [m]."""
    outputs = ("rgb",)

    def maker(self):
        return GreyMode


def compare(other: str | OpticsConfig = "taxim") -> float:
    """Mean difference [levels] between what both modes show of a sphere pressed into the gel, less the image at rest."""
    changes = []
    for optics in ("grey", other):
        sensor = raytac.TactileSensor("gelsight_mini", optics=optics, resolution=(80, 60))
        changes.append(np.abs(sensor.press("sphere").rgb[0].astype(int) - sensor.rest().rgb[0]))
    return float(np.abs(changes[0] - changes[1]).mean())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]) if sys.argv[1:] else print(f"grey against taxim: {compare():.1f} levels"))
