"""One picture of the last states of the hard cases: soft bodies coloured by the pressure of contact, obstacles grey."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray

import ipc

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.colors import LinearSegmentedColormap
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

Floats = NDArray[np.floating]

PRESSED = LinearSegmentedColormap.from_list("pressed", ["#9fb8d0", "#f2d7a0", "#e07b39", "#a01818"])
"""From the colour of untouched gel to that of the highest pressure."""
GREY = np.array([0.72, 0.72, 0.72])
LIGHT = np.array([-0.3, -0.55, 0.78])
VIEWS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("spike_in_hole", "spike_in_crack", "wedge_in_crack"), (32, -58)),
    **dict.fromkeys(("mass_ratio_1e4", "crush"), (-4, -62)),
}
"""Elevation and azimuth [deg] where the usual ones show little."""
CENTRED_ON = {"mass_ratio_1e4": "lower", "crush": "lower"}
MARGIN = {"mass_ratio_1e4": 2.2, "crush": 2.2}
SEE_THROUGH = ("spike_in_hole", "spike_in_crack", "wedge_in_crack", "squeeze_and_release", "blocked_drive")


def faces_of(world: ipc.World, see_through: bool) -> tuple[Floats, Floats]:
    """Triangles (T, 3, 3) [m] of the first environment and their colours (T, 4), shaded."""
    corners, colours = [], []
    for body in world.bodies:
        if isinstance(body, ipc.HalfSpace):
            continue
        used, faces = world.surface(body.name)
        x = world.positions(body.name)[0]
        x = x[used] if isinstance(body, ipc.SoftBody) else x
        x = x[faces]
        colour = np.tile([*GREY, 0.25 if see_through else 1.0], (len(faces), 1))
        if not isinstance(body, ipc.KinematicBody):
            force = np.linalg.norm(world.contact_forces(body.name)[0], axis=-1)
            area = world.layout.vert_area[world.layout.vert_start[world.layout.names.index(body.name)] :][: len(force)]
            pressure = (force / area)[faces].mean(axis=1)
            colour = PRESSED(np.sqrt(pressure / max(pressure.max(), 1e-12)))
        normal = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        shade = 0.62 + 0.38 * np.clip(normal @ LIGHT if not see_through else np.abs(normal @ LIGHT), 0, 1)
        corners.append(x)
        colours.append(np.column_stack([colour[:, :3] * shade[:, None], colour[:, 3]]))
    return np.concatenate(corners), np.concatenate(colours)


def draw_last_states(worlds: Mapping[str, ipc.World], path: Path, columns: int = 7) -> None:
    """Draw the first environment of each world and save the picture to ``path``."""
    rows = -(-len(worlds) // columns)
    columns = min(columns, len(worlds))
    figure = plt.figure(figsize=(1.9 * columns, 2.1 * rows))
    for k, (name, world) in enumerate(worlds.items()):
        axis = figure.add_subplot(rows, columns, k + 1, projection="3d", proj_type="ortho")
        triangles, colours = faces_of(world, name in SEE_THROUGH)
        bodies = [b.name for b in world.bodies if not isinstance(b, ipc.HalfSpace | ipc.KinematicBody)]
        x = np.concatenate([world.positions(n)[0] for n in ([CENTRED_ON[name]] if name in CENTRED_ON else bodies)])
        middle = (x.max(axis=0) + x.min(axis=0)) / 2
        reach = 0.66 * MARGIN.get(name, 1.0) * float(np.ptp(x, axis=0).max())
        collection = Poly3DCollection(triangles, facecolors=colours, edgecolors=(0, 0, 0, 0.25), linewidths=0.25)
        axis.add_collection3d(collection)
        for set_limits, centre in zip((axis.set_xlim, axis.set_ylim, axis.set_zlim), middle, strict=True):
            set_limits(centre - reach, centre + reach)
        elevation, azimuth = VIEWS.get(name, (18, -62))
        axis.view_init(elev=elevation, azim=azimuth)
        axis.set_box_aspect((1, 1, 1), zoom=1.3)  # pyright: ignore[reportArgumentType]
        axis.set_axis_off()
        axis.set_title(name.replace("_", " "), fontsize=8, y=0.98, backgroundcolor="white")
    figure.subplots_adjust(left=0, right=1, bottom=0, top=1 - 0.05 * 4 / (rows * 4), wspace=0.02, hspace=0.12)
    figure.savefig(path, dpi=150)
    plt.close(figure)
