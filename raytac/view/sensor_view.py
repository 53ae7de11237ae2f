"""Drawing of a sensor: gel block, case, lights and camera; coat and image by state."""

from __future__ import annotations

import numpy as np

from raytac.frame import TactileFrame
from raytac.gel.surface import GelSurface, PadGrid, rest_height
from raytac.physics.soft.contact_width import LEAST_CELLS
from raytac.sensor import TactileSensor
from raytac.specs import SensorSpec
from raytac.view.session import Lines, Pad, PadView, Solid

_MOST_VERTICES = 12_000
"""Of a drawn coat: what goes to the browser with every state; finer grids are thinned out."""
_CLEAR = 2e-5
"""Height of lines above the faces below them [m]."""
_GEL, _CASE, _VIEW, _MESH = (176, 205, 212), (105, 112, 122), (190, 150, 60), (205, 212, 222)


def strided(grid: PadGrid) -> PadGrid:
    """The grid thinned to at most ``_MOST_VERTICES`` nodes, edges kept."""
    step = 1
    while True:
        x, y = _thinned(len(grid.x), step), _thinned(len(grid.y), step)
        if len(x) * len(y) <= _MOST_VERTICES:
            return PadGrid(grid.x[x], grid.y[y], grid.rest[np.ix_(y, x)])
        step += 1


def _thinned(count: int, step: int) -> np.ndarray:
    """Every ``step``-th of ``count`` numbers and the last."""
    taken = np.arange(0, count, step)
    return taken if taken[-1] == count - 1 else np.append(taken, count - 1)


def coat_pad(name: str, sensor: TactileSensor, grid: PadGrid) -> Pad:
    """The coat of a sensor over the nodes of ``grid``, with the quantities that it outputs."""
    return Pad(name, grid_faces(grid), ("indentation", *(("pressure", "shear") if "traction" in sensor.outputs else ())))


def coat_lines(name: str) -> Lines:
    """Edges of a soft pad's mesh over its smooth coat, placed by the frames' ``coat_edges``."""
    return Lines(name, np.zeros((1, 2, 3)), _MESH, 0.8)


def square(size: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a square of ``size`` [m] about the origin in z = 0, two-sided."""
    corners = 0.5 * size * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    return corners, np.array([[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 3, 2]])


def grid_faces(grid: PadGrid) -> np.ndarray:
    """Triangles (F, 3) over the nodes of a grid, row by row, counter-clockwise seen from +z."""
    rows, columns = grid.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (m.ravel() for m in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    return np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])


def pad_view(
    frame: TactileFrame, grid: PadGrid, world_from_pad: np.ndarray, env: int = 0, *, rest_rgb: np.ndarray | None = None
) -> PadView:
    """View of one environment's frame, its coat at the nodes of ``grid`` (from ``strided``)."""
    at, height = places(frame.surface.grid, grid), _thinned_height(frame.surface, grid, env)
    x, y = np.meshgrid(grid.x, grid.y)
    values = {"indentation": (grid.rest - height).ravel()}
    if "traction" in frame.outputs:
        traction = frame.traction[env][at].reshape(-1, 3)
        values["pressure"], values["shear"] = -traction[:, 2], np.hypot(traction[:, 0], traction[:, 1])
    markers = None
    if "markers" in frame.outputs:
        markers = frame.markers.rest_px[env], frame.markers.displacement_px[env]
    return PadView(
        world_from_pad=world_from_pad,
        vertices=np.stack([x.ravel(), y.ravel(), height.ravel()], axis=1),
        values=values,
        rgb=frame.rgb[env] if "rgb" in frame.outputs else None,
        markers_px=markers,
        wrench=frame.wrench[env] if "wrench" in frame.outputs else None,
        rest_rgb=rest_rgb,
        height=frame.position[env, ..., 2] if "position" in frame.outputs else None,
        normals=frame.normals[env] if "normals" in frame.outputs else None,
    )


def rest_image(sensor: TactileSensor) -> np.ndarray | None:
    """Image of the untouched pad, (H, W, 3), uint8; None of a sensor that makes no images."""
    return sensor.rest().rgb[0] if "rgb" in sensor.outputs else None


def narrow_warning(frame: TactileFrame, env: int = 0) -> str:
    """Warning of a contact that the soft pad's cells cannot resolve; empty if they can."""
    if "contact_cells" not in frame.outputs or not frame.contact_cells[env] < LEAST_CELLS:
        return ""
    cells = frame.contact_cells[env]
    return (
        f"The contact is {cells:.1f} cells across: below {LEAST_CELLS:g} the soft pad is too stiff, "
        "the force at a given depth too large, the depth under a given force too small."
    )


def coat_edges(surface: GelSurface, grid: PadGrid, env: int = 0) -> np.ndarray:
    """Grid lines of a soft pad's coat on the surface that is drawn, as segments (N, 2, 3) [m].

    The heights of the mesh's vertices do not count, since the surface is curved between them.

    Args:
        surface: with a coat.
        grid: nodes of ``surface`` that are drawn (from ``strided``).
    """
    assert surface.coat is not None
    mesh = surface.coat.mesh
    at = surface.coat.positions[env][:, :2].reshape(*mesh.shape, 2)
    along = np.stack([at[:, :-1], at[:, 1:]], axis=2).reshape(-1, 2, 2)
    ends = np.concatenate([along, np.stack([at[:-1], at[1:]], axis=2).reshape(-1, 2, 2)])
    needed = int(np.ceil(max(np.diff(mesh.lines_x).max(), np.diff(mesh.lines_y).max()) / (0.5 * min(grid.pitch))))
    pieces = max(min(needed, _MOST_VERTICES // len(ends)), 1)
    share = np.linspace(0.0, 1.0, pieces + 1)[:, None]
    points = ends[:, :1] + share * (ends[:, 1:] - ends[:, :1])  # (E, pieces + 1, 2)
    lifted = _on_faces(grid, _thinned_height(surface, grid, env), points) + _CLEAR
    line = np.concatenate([points, lifted[..., None]], axis=-1)
    return np.stack([line[:, :-1], line[:, 1:]], axis=2).reshape(-1, 2, 3)


def _on_faces(grid: PadGrid, height: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Height of the triangles of ``grid_faces`` at places (..., 2); beyond the grid its edge's."""
    where = [np.clip(points[..., k], axis[0], axis[-1]) for k, axis in enumerate((grid.x, grid.y))]
    i, j = (
        np.clip(np.searchsorted(axis, at, "right") - 1, 0, len(axis) - 2)
        for axis, at in zip((grid.x, grid.y), where, strict=True)
    )
    s = (where[0] - grid.x[i]) / (grid.x[i + 1] - grid.x[i])
    t = (where[1] - grid.y[j]) / (grid.y[j + 1] - grid.y[j])
    a, b, c, d = height[j, i], height[j, i + 1], height[j + 1, i], height[j + 1, i + 1]
    return np.where(s >= t, a + s * (b - a) + t * (d - b), a + t * (c - a) + s * (d - c))


def _thinned_height(surface: GelSurface, grid: PadGrid, env: int) -> np.ndarray:
    """Height [m] at the nodes of a grid from ``strided``, (Ny, Nx)."""
    return surface.height[env][places(surface.grid, grid)].astype(float)


def places(full: PadGrid, grid: PadGrid) -> tuple[np.ndarray, ...]:
    """Index of the nodes of a thinned grid in arrays (Ny, Nx, ...) of the full one."""
    return np.ix_(np.searchsorted(full.y, grid.y), np.searchsorted(full.x, grid.x))


def gel_solid(spec: SensorSpec, name: str = "gel") -> Solid:
    """The gel block down from the coat's resting edge, see-through; pad frame."""
    gel = spec.gelpad
    x, y = (np.linspace(-0.5 * size, 0.5 * size, 25) for size in gel.size)
    around = np.concatenate(
        [
            np.column_stack([x[:-1], np.full(24, y[0])]),
            np.column_stack([np.full(24, x[-1]), y[:-1]]),
            np.column_stack([x[:0:-1], np.full(24, y[-1])]),
            np.column_stack([np.full(24, x[0]), y[:0:-1]]),
        ]
    )
    top = np.column_stack([around, rest_height(gel, around[:, 0], around[:, 1])])
    back = np.column_stack([around, np.full(len(around), -gel.thickness)])
    n = len(around)
    here, after = np.arange(n), (np.arange(n) + 1) % n
    sides = np.concatenate([np.stack([here + n, after + n, after], 1), np.stack([here + n, after, here], 1)])
    floor = np.stack([np.full(n - 2, n), np.arange(n + 2, 2 * n), np.arange(n + 1, 2 * n - 1)], axis=1)
    return Solid(name, np.concatenate([top, back]), np.concatenate([sides, floor]), _GEL, 0.35)


def sensor_solids(spec: SensorSpec) -> tuple[Solid, ...]:
    """The gel block, and every light as a two-sided rectangle in its colour; pad frame."""
    return (gel_solid(spec), *_lights(spec))


def sensor_lines(spec: SensorSpec) -> tuple[Lines, ...]:
    """The inside of the case as a box, and the camera's view of the plane z = 0; pad frame."""
    (wide, long), gel = spec.case.size, spec.gelpad
    case = _box_edges((-0.5 * wide, -0.5 * long, spec.case.floor_z), (0.5 * wide, 0.5 * long, -gel.thickness))
    camera = spec.camera
    (width, height), (cx, cy), (fx, fy) = camera.resolution, camera.principal_point, camera.focal
    eye = np.asarray(camera.position)
    corners = np.array([(0, 0), (width, 0), (width, height), (0, height)], float)
    slope_x, slope_y = camera.lens.slope((corners[:, 0] - cx) / fx, (corners[:, 1] - cy) / fy)
    seen = np.column_stack([eye[0] - eye[2] * slope_x, eye[1] - eye[2] * slope_y, np.zeros(4)])
    rays = [np.stack([np.broadcast_to(eye, (4, 3)), seen], axis=1), np.stack([seen, np.roll(seen, -1, axis=0)], axis=1)]
    return Lines("case", case, _CASE), Lines("camera_view", np.concatenate(rays), _VIEW)


def _lights(spec: SensorSpec) -> tuple[Solid, ...]:
    lights = []
    for led in spec.lights.leds:
        u, v = np.asarray(led.edges)
        half_u, half_v = 0.5 * led.size[0] * u, 0.5 * led.size[1] * v
        corners = np.asarray(led.position) + np.array([-half_u - half_v, half_u - half_v, half_u + half_v, half_v - half_u])
        faces = square(1.0)[1]
        power = np.asarray(led.power)
        red, green, blue = (round(60 + 195 * float(p)) for p in power / max(float(power.max()), 1e-12))
        lights.append(Solid(f"leds/{led.name}", corners, faces, (red, green, blue)))
    return tuple(lights)


def _box_edges(low: tuple[float, float, float], high: tuple[float, float, float]) -> np.ndarray:
    """The twelve edges of a box, (12, 2, 3)."""
    corners = np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)])
    pairs = [(k, k | 1 << axis) for k in range(8) for axis in range(3) if not k >> axis & 1]
    return corners[np.array(pairs)]
