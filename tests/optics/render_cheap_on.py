"""``python -m tests.optics.render_cheap_on DEVICE MODE OUT.npy``: the images that CPU and CUDA are compared on."""

from __future__ import annotations

import sys

import numpy as np

from raytac.gel.surface import GelSurface
from raytac.optics import Phong, Taxim
from tests.optics.scenes import RESOLUTION, ball, grid_of, like_a_mini, relief
from tests.optics.test_taxim_mode import make_table


def main(device: str, mode: str, out: str) -> None:
    spec = like_a_mini()
    grid = grid_of(spec)
    height, contact = ball(grid)
    heights = np.stack([height, relief(grid), grid.rest]).astype(np.float32)
    contacts = np.stack([contact, grid.rest - relief(grid) > 0.3e-3, np.zeros_like(contact)])
    surfaces = GelSurface(grid, heights, contacts, np.zeros((3, 2)))
    if mode == "phong":
        background = np.full((RESOLUTION[1], RESOLUTION[0], 3), 120, np.uint8)
        images = Phong(background=background).build(spec, resolution=RESOLUTION, device=device).render(surfaces)
    else:
        shadow = mode == "taxim-shadow"
        images = (
            Taxim(calibration=make_table(spec), shadows=shadow).build(spec, resolution=RESOLUTION, device=device).render(surfaces)
        )
    assert images.rgb is not None
    np.save(out, images.rgb)


if __name__ == "__main__":
    main(*sys.argv[1:])
