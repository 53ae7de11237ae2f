"""``python -m tests.optics.render_on DEVICE OUT.npz``: the images that CPU and CUDA are compared on. A process has one device."""

from __future__ import annotations

import sys

import numpy as np

from raytac.optics import RayTraced
from tests.optics.scenes import RESOLUTION, ball, built, grid_of, like_a_mini, relief, surface

MODES = {
    "fast": {},
    "fast_fine": {"led_points": 2, "spp": 4},
    "reference": {"integrator": "reference", "spp": 16},
}


def images(device: str) -> dict[str, np.ndarray]:
    """Arrays by ``mode/output``, of a batch of two surfaces."""
    spec = like_a_mini()
    grid = grid_of(spec)
    surfaces = surface(grid, ball(grid)[0], relief(grid))
    found: dict[str, np.ndarray] = {}
    for name, options in MODES.items():
        outputs = ("rgb", "layers", "normals", "depth")
        image = built(RayTraced, spec, resolution=RESOLUTION, device=device, outputs=outputs, **options).render(surfaces)
        assert image.layers is not None
        arrays = {"rgb": image.rgb, "normals": image.normals, "depth": image.depth, **image.layers}
        found |= {f"{name}/{key}": array for key, array in arrays.items() if array is not None}
    return found


if __name__ == "__main__":
    np.savez(sys.argv[2], **images(sys.argv[1]))  # type: ignore[arg-type]
