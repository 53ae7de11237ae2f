"""Pictures of a world from the side: the outlines of pads and objects, as a strip and as a film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from raytac.world import TactileWorld

__all__ = ["Snapshot", "draw_strip", "film", "snapshot"]

_COLOURS = ("0.45", "0.45", "#2b6cb0", "#b7791f")


@dataclass(frozen=True)
class Snapshot:
    """Triangles of some surfaces, seen along x."""

    title: str
    polygons: tuple[np.ndarray, ...]
    """One for each surface: (F, 3, 2) [mm], y to the right and z up, those in front last."""


def snapshot(world: TactileWorld, names: Sequence[str], title: str, env: int = 0) -> Snapshot:
    """The surfaces of these bodies and pads as they are; a rigid pad has none and is drawn as a plate."""
    found = []
    for name in names:
        if not world.physics.is_simulated and name in world.sensor_names:
            vertices, faces = _plate(world, name, env)
        else:
            all_vertices, faces = world.mesh(name)
            vertices = all_vertices[env]
        corners = vertices[faces]
        corners = corners[np.argsort(-corners[:, :, 0].mean(axis=1))]
        found.append(1e3 * corners[:, :, 1:])
    return Snapshot(title, tuple(found))


def _plate(world: TactileWorld, name: str, env: int) -> tuple[np.ndarray, np.ndarray]:
    gelpad = world.composed.sensor_specs[world.sensor_names.index(name)].gelpad
    half = 0.5 * np.array([*gelpad.size, gelpad.thickness])
    corners = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)], float)
    local = (2.0 * corners - 1.0) * half - [0.0, 0.0, half[2]]
    pose = world.state().world_from_pad[name][env]
    faces = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
    return local @ pose[:3, :3].T + pose[:3, 3], np.array(faces)


def _draw(axes, shot: Snapshot, limits: tuple[np.ndarray, np.ndarray]) -> None:
    from matplotlib.collections import PolyCollection

    for polygons, colour in zip(shot.polygons, _COLOURS, strict=False):
        axes.add_collection(PolyCollection(list(polygons), facecolor=colour, edgecolor="k", linewidth=0.2, alpha=0.6))
    axes.set(xlim=(limits[0][0], limits[1][0]), ylim=(limits[0][1], limits[1][1]), aspect="equal")
    axes.set_title(shot.title, fontsize="small")
    axes.set_xlabel("y [mm]", fontsize="x-small")
    axes.tick_params(labelsize="x-small")


def _limits(shots: Sequence[Snapshot]) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([polygons.reshape(-1, 2) for shot in shots for polygons in shot.polygons])
    return points.min(axis=0) - 2.0, points.max(axis=0) + 2.0


def draw_strip(shots: Sequence[Snapshot], path: Path, count: int = 6) -> None:
    """Some of the pictures in one row, or in two if they are wide; lengths in mm."""
    from matplotlib.figure import Figure

    chosen = [shots[i] for i in np.unique(np.linspace(0, len(shots) - 1, count).round().astype(int))]
    width, height = np.subtract(*_limits(shots)[::-1])
    rows = 2 if len(chosen) > 3 and width > 0.8 * height else 1
    columns = -(-len(chosen) // rows)
    figure = Figure(figsize=(2.6 * columns, 3.2 * rows), layout="compressed")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, shot in zip(grid.flat, chosen, strict=False):
        _draw(axes, shot, _limits(shots))
        axes.label_outer()
    for axes in grid.flat[len(chosen) :]:
        axes.set_axis_off()
    for axes in grid[:, 0]:
        axes.set_ylabel("z [mm]", fontsize="x-small")
    figure.savefig(path, dpi=110, bbox_inches="tight")


def film(shots: Sequence[Snapshot], path: Path) -> None:
    """All pictures as an animation."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    frames = []
    for shot in shots:
        figure = Figure(figsize=(4, 4), layout="constrained")
        canvas = FigureCanvasAgg(figure)
        axes = figure.subplots()
        _draw(axes, shot, _limits(shots))
        axes.set_ylabel("z [mm]", fontsize="x-small")
        canvas.draw()
        frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=120, loop=0)
