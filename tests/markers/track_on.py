"""FOTS along a motion of three environments, on one device; a process has one variant of Mitsuba, so each device needs its own.

python -m tests.markers.track_on cuda out.npz
"""

from __future__ import annotations

import sys

import numpy as np

from raytac.gel.surface import GelSurface, PadGrid
from raytac.markers.tracker import MarkerTracker
from tests.markers.pads import flat_sensor, pad_grid, pose, pressed


def motion(grid: PadGrid) -> list[GelSurface]:
    """One ball sheared and turned, two balls likewise, and none until the end."""
    surfaces = []
    for k in range(5):
        x = 1e-4 * k
        balls = [[(x, 0.0, 6e-4)], [(-4e-3 + x, 1e-3, 4e-4), (4e-3 + x, -2e-3, 5e-4)], [(0.0, 2e-3, 3e-4)] if k == 4 else []]
        surfaces.append(pressed(grid, *balls, poses=[pose(x, 0.0, 0.0, 0.05 * k)] * 3))
    return surfaces


def main(device: str, path: str) -> None:
    sensor = flat_sensor()
    grid = pad_grid(sensor)
    tracker = MarkerTracker(sensor, "fots", grid, num_envs=3, device=device)
    frames = [tracker.update(surface) for surface in motion(grid)]
    moved, pixels = (np.stack([getattr(frame, name) for frame in frames]) for name in ("displacement", "displacement_px"))
    np.savez(path, displacement=moved, displacement_px=pixels, device=tracker.model.device)


if __name__ == "__main__":
    main(*sys.argv[1:])
