"""One picture of the last states of the hard cases: soft bodies coloured by what presses on them, obstacles grey, each with its scale.

Bodies are seen from infinitely far away. Faces are cut into pieces smaller than the bodies' parts and painted from the farthest to the
nearest, which hides what is hidden where bodies do not cross; those of hard cases never do.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray

import ipc

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap, PowerNorm
from matplotlib.patches import Rectangle

__all__ = ["State", "draw_last_states", "load_state", "save_state", "state_of"]

Floats = NDArray[np.floating]

PRESSED = LinearSegmentedColormap.from_list("pressed", ["#9fb8d0", "#f2d7a0", "#e07b39", "#a01818"])
"""From the colour of untouched gel to that of the highest traction."""
ROOT = PowerNorm(0.5, 0.0, 1.0)
OBSTACLE, FLOOR = np.array([0.72, 0.72, 0.72]), np.array([0.93, 0.93, 0.93])
LIGHT = np.array([-0.3, -0.55, 0.78])
VIEWS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("spike_in_hole", "spike_in_crack", "wedge_in_crack"), (32, -58)),
    **dict.fromkeys(("mass_ratio_1e4", "crush"), (-3, -62)),
    **dict.fromkeys(("gears_soft", "gears_affine", "heap_of_30"), (50, -70)),
    **dict.fromkeys(("rollers_draw_in", "rollers_slip", "rollers_coated"), (12, -75)),
}
"""Elevation and azimuth [deg] where the usual ones show little."""
USUAL_VIEW = (20, -62)
SEE_THROUGH = (
    *("spike_in_hole", "spike_in_crack", "wedge_in_crack", "slotted_tetrahedron", "squeeze_and_release", "blocked_drive"),
    *("heap_of_30", "squeeze_out", "trash_compactor_soft", "trash_compactor_mixed", "trash_compactor_affine"),
    *("nut_and_bolt_soft", "nut_and_bolt_affine", "peg_in_hole_soft", "peg_in_hole_affine"),
    *("squeezed_nu_0495", "squeezed_nu_0499"),
)
INSETS = {"mass_ratio_1e4": "lower", "crush": "lower"}
"""Bodies that are too small to be seen beside the others of their case; they are drawn once more."""
PIECES = 20
"""Pieces that the widest body is cut into along its width."""
COLUMNS = 7


@dataclass(frozen=True)
class Surface:
    """One body's boundary."""

    name: str
    triangles: Floats
    """Corners [m], (T, 3, 3)."""
    traction: Floats | None
    """Mean size of the traction on each face [Pa], (T,); None for an obstacle."""


@dataclass(frozen=True)
class State:
    """The first environment of a world: what is drawn of it."""

    surfaces: tuple[Surface, ...]
    floor: float | None
    """Height of the ground [m]; None where there is none."""

    @property
    def highest(self) -> float:
        """Highest traction on a face [Pa]."""
        return max((float(s.traction.max()) for s in self.surfaces if s.traction is not None), default=0.0)

    @property
    def ground(self) -> Floats | None:
        """Corners (4, 3) [m] of what is drawn of the ground: a tenth wider than what stands on it."""
        if self.floor is None:
            return None
        x = np.concatenate([s.triangles.reshape(-1, 3) for s in self.surfaces])[:, :2]
        middle, half = (x.max(axis=0) + x.min(axis=0)) / 2, 0.55 * np.ptp(x, axis=0)
        corner = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) + middle
        return np.column_stack([corner, np.full(4, self.floor)])


def state_of(world: ipc.World) -> State:
    """What is drawn of a world's first environment."""
    surfaces, floor = [], None
    for body in world.bodies:
        if isinstance(body, ipc.HalfSpace):
            floor = float(body.pose.position[2])
            continue
        used, faces = world.surface(body.name)
        x = world.positions(body.name)[0]
        x = x[used] if isinstance(body, ipc.SoftBody) else x
        traction = None
        if not isinstance(body, ipc.KinematicBody):
            traction = np.linalg.norm(world.traction(body.name)[0], axis=-1)[faces].mean(axis=1)
        surfaces.append(Surface(body.name, np.asarray(x[faces]), traction))
    return State(tuple(surfaces), floor)


def save_state(state: State, path: Path) -> None:
    """Keep a state in an ``.npz`` file."""
    arrays = {f"triangles_{s.name}": s.triangles for s in state.surfaces}
    arrays |= {f"traction_{s.name}": s.traction for s in state.surfaces if s.traction is not None}
    path.parent.mkdir(parents=True, exist_ok=True)
    if state.floor is not None:
        arrays["floor"] = np.array(state.floor)
    np.savez_compressed(path, allow_pickle=False, **arrays)


def load_state(path: Path) -> State:
    """State that :func:`save_state` kept."""
    with np.load(path) as file:
        names = [key.removeprefix("triangles_") for key in file if key.startswith("triangles_")]
        surfaces = tuple(Surface(n, file[f"triangles_{n}"], file.get(f"traction_{n}")) for n in names)
        return State(surfaces, float(file["floor"]) if "floor" in file else None)


def draw_last_states(states: Mapping[str, State], path: Path) -> None:
    """Draw every state in a panel of its own and save the picture to ``path``."""
    columns = min(COLUMNS, len(states))
    rows = -(-(len(states) + 1) // columns)
    figure = plt.figure(figsize=(1.9 * columns, 2.15 * rows))
    for k, (name, state) in enumerate(states.items()):
        axes = figure.add_subplot(rows, columns, k + 1)
        _draw(axes, state, VIEWS.get(name, USUAL_VIEW), name in SEE_THROUGH, INSETS.get(name))
        axes.set_title(f"{_title(name)}\n{_traction_text(state.highest)}", fontsize=9, linespacing=1.25, pad=4, va="baseline")
    slot = figure.add_subplot(rows, columns, rows * columns)
    slot.set_axis_off()
    bar = figure.colorbar(
        ScalarMappable(ROOT, PRESSED), cax=slot.inset_axes((0.22, 0.08, 0.12, 0.8)), ticks=[0, 0.1, 0.25, 0.5, 1]
    )
    bar.set_label("contact traction over\nthe highest of the panel", fontsize=9)
    bar.ax.tick_params(labelsize=9)
    figure.subplots_adjust(left=0.005, right=0.995, bottom=0.01, top=1 - 0.4 / (2.15 * rows), wspace=0.06, hspace=0.3)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _title(name: str) -> str:
    """A case's name in words: ``dt_10ms`` is dt 10 ms."""
    words = name.replace("_", " ").replace("1e4", "10⁴").replace("nu 0", "ν 0.").replace("mu 5", "μ 5").replace("d hat", "d̂")
    return re.sub(r"(\d)(nm|um|mm|ms|s)\b", r"\1 \2", words).replace(" um", " µm")


def _traction_text(pascal: float) -> str:
    for factor, unit in ((1e-6, "MPa"), (1e-3, "kPa")):
        if pascal * factor >= 1:
            return f"up to {pascal * factor:.3g} {unit}"
    return "no contact at the end" if pascal == 0 else f"up to {pascal:.0f} Pa"


def _draw(axes: Axes, state: State, view: tuple[float, float], see_through: bool, inset: str | None) -> None:
    seen = _seen_from(view)
    width = max(float(np.ptp(s.triangles.reshape(-1, 3), axis=0).max()) for s in state.surfaces)
    _paint(axes, state, seen, see_through, width / PIECES)
    ground = np.zeros((0, 3)) if state.ground is None else state.ground
    corners = np.concatenate([ground, *(s.triangles.reshape(-1, 3) for s in state.surfaces)]) @ seen.T
    low, high = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
    middle, half = (low + high) / 2, 0.56 * float((high - low).max())
    if inset is None:
        _frame(axes, middle, half)
        return
    # Room at the right for the small body; the panel stays a square.
    _frame(axes, middle + np.array([0.35 * half, 0.0]), 1.35 * half)
    small = next(s for s in state.surfaces if s.name == inset).triangles.reshape(-1, 3) @ seen.T
    near, far = small[:, :2].min(axis=0), small[:, :2].max(axis=0)
    around, reach = (near + far) / 2, 0.75 * float((far - near).max())
    axes.add_patch(Rectangle(tuple(around - reach), 2 * reach, 2 * reach, fill=False, edgecolor="black", linewidth=0.7))
    zoomed = axes.inset_axes((0.56, 0.0, 0.44, 0.44))
    _paint(zoomed, state, seen, see_through, reach / PIECES, within=(around - reach, around + reach))
    _frame(zoomed, around, reach)
    zoomed.set_axis_on()
    zoomed.set(xticks=[], yticks=[])


def _frame(axes: Axes, middle: Floats, half: float) -> None:
    """Limits, and a bar of a round length that a fifth to a half of the panel is wide."""
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - 1.12 * half, middle[1] + half), aspect="equal")
    axes.set_axis_off()
    length = max((m * 10.0**e for e in range(-5, 1) for m in (1, 2, 5) if m * 10.0**e < half), default=half)
    x, y = middle[0] - 0.96 * half, middle[1] - 1.0 * half
    axes.plot([x, x + length], [y, y], color="black", linewidth=1.6, solid_capstyle="butt", zorder=5)
    label = f"{1e3 * length:g} mm"
    axes.text(x, y + 0.04 * half, label, fontsize=8, va="bottom", zorder=5).set_bbox(
        {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.6}
    )


def _seen_from(view: tuple[float, float]) -> Floats:
    """Rows: image right, image up, towards the eye; (3, 3)."""
    elevation, azimuth = np.radians(view)
    eye = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([right, np.cross(eye, right), eye])


def _paint(
    axes: Axes,
    state: State,
    seen: Floats,
    see_through: bool,
    piece: float,
    within: tuple[Floats, Floats] | None = None,
) -> None:
    """Faces in ``piece``s [m] and edges; those wholly out of the image rectangle ``within`` (low, high) are left out."""
    highest = max(state.highest, 1e-12)
    parts: list[tuple[Floats, Floats, Floats, Floats]] = []  # corners (K, 3, 3), fill and line (K, 4), depth (K,)

    def add(corners: Floats, fill: Floats, line: Floats, nearer: float = 0.0) -> None:
        same = (len(corners), 4)
        depth = corners[..., 2].mean(axis=1) + nearer
        parts.append((corners, np.broadcast_to(fill, same), np.broadcast_to(line, same), depth))

    for surface in state.surfaces:
        obstacle = surface.traction is None
        glass = see_through and obstacle
        normal = np.cross(surface.triangles[:, 1] - surface.triangles[:, 0], surface.triangles[:, 2] - surface.triangles[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        lit = normal @ LIGHT
        shade = 0.62 + 0.38 * np.clip(np.abs(lit) if see_through else lit, 0, 1)
        colour = np.tile(OBSTACLE, (len(normal), 1))
        if surface.traction is not None:
            colour = PRESSED(ROOT(surface.traction / highest))[:, :3]
        for triangle, face in zip(surface.triangles @ seen.T, colour * shade[:, None], strict=True):
            fill = np.array([*face, 0.18 if glass else 1.0])
            # Of glass one piece, since the seams of several would show.
            add(triangle[None] if glass else _cut(triangle, piece), fill, np.zeros(4) if glass else fill)
        for start, end in _edges(surface.triangles @ seen.T):
            count = 1 if glass else max(1, int(np.ceil(np.linalg.norm(end - start) / piece)))
            points = start + np.linspace(0, 1, count + 1)[:, None] * (end - start)
            line = np.array([0.0, 0.0, 0.0, 0.3 if glass else 0.45])
            add(np.stack([points[:-1], points[1:], points[1:]], axis=1), np.zeros(4), line, 1.2 * piece)
    corners, fills, lines, depth = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(depth, kind="stable")
    if within is not None:
        low, high = corners[..., :2].min(axis=1), corners[..., :2].max(axis=1)
        order = order[((high >= within[0]) & (low <= within[1])).all(axis=1)[order]]
    ground = state.ground
    if ground is not None:
        axes.add_collection(PolyCollection([(ground @ seen.T)[:, :2]], facecolors=[FLOOR], edgecolors="0.6", linewidths=0.4))
    axes.add_collection(
        PolyCollection(list(corners[order, :, :2]), facecolors=fills[order], edgecolors=lines[order], linewidths=0.35)
    )


def _cut(triangle: Floats, piece: float) -> Floats:
    """A triangle (3, 3) as n² alike, (n², 3, 3), with sides of at most ``piece``."""
    sides = triangle - np.roll(triangle, 1, axis=0)
    n = int(np.clip(np.ceil(np.linalg.norm(sides, axis=1).max() / piece), 1, 64))
    a, u, v = triangle[0], (triangle[1] - triangle[0]) / n, (triangle[2] - triangle[0]) / n
    i, j = np.nonzero(np.add.outer(np.arange(n), np.arange(n)) < n)
    corner = a + i[:, None] * u + j[:, None] * v
    again = corner[i + j < n - 1]
    return np.concatenate([np.stack([corner, corner + u, corner + v], 1), np.stack([again + u, again + u + v, again + v], 1)])


def _edges(triangles: Floats) -> Floats:
    """Each edge once, (E, 2, 3)."""
    points, corner = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    faces = corner.reshape(-1, 3)
    both = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return points[np.unique(both, axis=0)]
