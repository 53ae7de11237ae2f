"""Surfaces made by geometry alone, for tests of marker models."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from raytac.gel.coat_mesh import CoatMesh, DeformedCoat
from raytac.gel.surface import GelSurface, PadGrid, make_grid
from raytac.markers.calibration_presses import Press, PressFrame
from raytac.markers.config import Fots
from raytac.markers.contact_tracker import ContactTracker
from raytac.markers.contacts import ContactCells
from raytac.specs import MarkerMotionSpec, SensorSpec, load_sensor

PITCH = 0.1e-3
MOTION = MarkerMotionSpec(
    dilate_gain=2.0e8,
    dilate_lambda=1.0e5,
    shear_lambda=0.8e5,
    shear_max=0.6e-3,
    twist_lambda=1.2e5,
    twist_max=math.radians(20),
    field_gain=0.5,
    field_shear=2.0,
    field_friction=1.0,
    provenance="made up",
)
BALL = 4e-3
"""Radius of every ball [m]."""


def flat_sensor(name: str = "gelsight_mini_9x11") -> SensorSpec:
    """A flat pad with dots about its centre, so that what is symmetric is so to rounding."""
    sensor = load_sensor(name)
    markers = replace(sensor.markers, offset=(0.0, 0.0))
    pad = replace(sensor.gelpad, dome_radius=(math.inf, math.inf))
    return replace(sensor, gelpad=pad, markers=markers, marker_motion=MOTION)


def pad_grid(sensor: SensorSpec) -> PadGrid:
    return make_grid(sensor.gelpad, PITCH)


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, twist: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """``pad_from_object``: turned by ``roll`` about y, then by ``twist`` about z, then moved."""
    c, s = math.cos(twist), math.sin(twist)
    cr, sr = math.cos(roll), math.sin(roll)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = turn, (x, y, z)
    return result


def pressed(grid: PadGrid, *envs: list[tuple[float, float, float]], poses: list[np.ndarray] | None = None) -> GelSurface:
    """Environments pressed by balls (x, y, depth) [m]: the surface is the lower of rest and ball, in contact where that is the ball."""
    x, y = np.meshgrid(grid.x, grid.y)
    height = np.repeat(grid.rest[None], len(envs), axis=0)
    for one, balls in zip(height, envs, strict=True):
        for bx, by, depth in balls:
            inside = np.maximum(BALL**2 - (x - bx) ** 2 - (y - by) ** 2, 0)
            under = np.where(inside > 0, BALL - depth - np.sqrt(inside), np.inf)
            np.minimum(one, under, out=one)
    contact = height < grid.rest
    placed = np.stack([pose()] * len(envs) if poses is None else poses)
    return GelSurface(grid, height.astype(np.float32), contact, np.full((len(envs), 2), np.nan), placed)


def coat_mesh(sensor: SensorSpec, nx: int = 12, ny: int = 10) -> CoatMesh:
    """A coat of unevenly spaced lines, its diagonals alternating."""

    def lines(size: float, count: int) -> np.ndarray:
        t = np.linspace(-1, 1, count)
        return 0.5 * size * (0.7 * t + 0.3 * t**3)

    lx, ly = lines(sensor.gelpad.size[0], nx), lines(sensor.gelpad.size[1], ny)
    x, y = np.meshgrid(lx, ly)
    rest = np.stack([x, y, -sensor.gelpad.sag(x, y)], axis=-1).reshape(-1, 3)
    faces = []
    for j in range(ny - 1):
        for i in range(nx - 1):
            a, b, c, d = j * nx + i, j * nx + i + 1, (j + 1) * nx + i, (j + 1) * nx + i + 1
            faces += [(a, b, d), (a, d, c)] if (i + j) % 2 else [(a, b, c), (b, d, c)]
    return CoatMesh(rest, np.array(faces, dtype=np.int32), lx, ly)


def with_coat(surface: GelSurface, mesh: CoatMesh, positions: np.ndarray) -> GelSurface:
    return replace(surface, coat=DeformedCoat(mesh, positions))


def fots_presses(sensor: SensorSpec, grid: PadGrid) -> list[PressFrame]:
    """Presses whose coat is moved by FOTS itself, with the constants of ``MOTION``."""
    mesh, states = coat_mesh(sensor, 76, 62), []
    for name, x, y, deep, shear, twist in (
        ("a", 0.0, 0.0, 8e-4, (5e-4, 2e-4), 0.0), ("b", 1e-3, -2e-3, 6e-4, (-8e-4, 0.0), 0.0), ("c", -2e-3, 1e-3, 7e-4, (0.0, 0.0), 0.45)
    ):  # fmt: skip
        press = Press(name, "sphere", {"radius": 4e-3}, (x, y), deep)
        moves = [("start", -1e-3, 0.0), ("normal", 0.5 * deep, 0.0), ("normal", deep, 0.0)]
        moves += [("twist" if twist else "shear", deep, k / 4) for k in range(1, 5)]
        for load, depth, share in moves:
            px, py = x + share * shear[0], y + share * shear[1]
            balls = [(px, py, depth)] if depth > 0 else []
            surface = pressed(grid, balls, poses=[pose(px, py, -depth, share * twist)])
            states.append((press, load, surface))
    return _with_coats(sensor, grid, mesh, states)


def _with_coats(sensor: SensorSpec, grid: PadGrid, mesh: CoatMesh, states: list) -> list[PressFrame]:
    model, cells, frames, last = Fots().build(sensor, grid, num_envs=1, device="cpu"), ContactCells.over(grid), [], None
    for press, load, surface in states:
        if press is not last:
            tracker, last = ContactTracker(1), press
        samples = cells.sample(surface)
        moved = model.displacement(mesh.rest[None], surface, samples, tracker.update(surface, samples))
        positions = mesh.rest[None] + np.concatenate([moved, np.zeros((1, len(mesh.rest), 1))], axis=-1)
        frames.append(PressFrame(press, load, with_coat(surface, mesh, positions)))
    return frames
